"""Orders to a supervisor: which fit, in which order nodes are taken down, and who is told."""

from __future__ import annotations

import asyncio
from pathlib import Path
from types import SimpleNamespace

import pytest
from msgspec.structs import replace

from lifecycle.errors import ExitCode, UsageError
from lifecycle.manifest.model import Condition, Mode, RunKind
from lifecycle.supervisor.control.protocol import Answer, ControlRequest, Question, look, order
from lifecycle.supervisor.control.server import ControlServer, SupervisorSnapshot, check
from lifecycle.supervisor.core.orders import FITS, refusal
from lifecycle.supervisor.core.state import Order, new_run
from lifecycle.supervisor.run.options import UpOptions
from lifecycle.verify.observation import Observation
from tests.builders import HERE, plan_of, planned_node
from tests.unit.supervisor.fakes import World
from tests.unit.test_run_directory import STATUS

PLAN = plan_of(
    planned_node("camera"),
    planned_node("viewer", after={"camera": Condition.ACTIVE}),
    planned_node("base", kind=RunKind.ATTACH),
)


@pytest.mark.parametrize("ask", FITS)
@pytest.mark.parametrize("phase", ["active", "paused", "held", "connecting"])
def test_an_order_fits_some_phases_and_no_others(ask: ControlRequest, phase: str) -> None:
    run = new_run(PLAN, UpOptions())
    run.held_s, run.passage = (None if phase == "connecting" else 0.0), None
    run.paused = phase == "paused"
    run.nodes["camera"].refused = phase == "held"
    why = refusal(run, Order(id=0, ask=ask))
    fits = phase in FITS[ask][0]
    what = {ControlRequest.MODE: "switch the mode of", ControlRequest.APPLY: "apply another"}
    said = f"cannot {what.get(ask, ask.value)}"
    assert (f"it is {phase};" in why) is not fits
    assert fits or why.startswith(said)


def test_a_mode_that_there_is_not_is_refused_with_the_nearest() -> None:
    modes = tuple(Mode(name=each, at=HERE) for each in ("normal", "blind"))
    run = new_run(replace(PLAN, modes=modes), UpOptions())
    run.held_s, run.passage = 0.0, None
    assert refusal(run, Order(id=0, ask=ControlRequest.MODE, mode="blnd")) == (
        "cannot enter mode 'blnd' of 'robot': it has the modes normal, blind; did you mean 'blind'?"
    )


@pytest.mark.parametrize(
    ("node", "message"),
    [
        (
            "camrea",
            "cannot restart 'camrea': this supervisor runs no such node; it runs: /camera, /viewer",
        ),
        ("/base", "cannot restart '/base': it is attached, no process of this supervisor"),
        ("camera", ""),
        ("/camera", ""),
    ],
)
def test_a_node_that_is_not_ours_is_not_restarted(node: str, message: str) -> None:
    run = new_run(PLAN, UpOptions())
    run.held_s, run.passage = 0.0, None
    assert refusal(run, Order(id=0, ask=ControlRequest.RESTART, node=node)) == message


CHANGED = "a running supervisor cannot change this:\n{}; end it and start it anew: lifecycle down, "
NO_PLAN = "it is no plan; its nodes and processes do not fit together"


@pytest.mark.parametrize(
    ("changed", "why"),
    [
        ({"system": "other"}, CHANGED.format('system: was "robot", is "other"')),
        ({"domain_id": 31}, CHANGED.format("ROS_DOMAIN_ID: was 30, is 31")),
        ({"rmw": "rmw_zenoh"}, CHANGED.format("RMW_IMPLEMENTATION: was , is rmw_zenoh")),
        ({"nodes": ()}, NO_PLAN),
        ({"nodes": PLAN.nodes * 2}, NO_PLAN),
        ({"nodes": PLAN.nodes[1:]}, NO_PLAN),
        (
            {"processes": (replace(PLAN.processes[0], nodes=("nobody",)), *PLAN.processes[1:])},
            NO_PLAN,
        ),
        ({"levels": (("nobody",),)}, NO_PLAN),
        ({"modes": (Mode(name="m", inactive=("nobody",), at=HERE),)}, NO_PLAN),
    ],
)
async def test_a_manifest_that_a_running_supervisor_cannot_take_is_refused_with_the_reason(
    tmp_path: Path, changed: dict[str, object], why: str
) -> None:
    system = World(PLAN, tmp_path).system
    given = Order(ask=ControlRequest.APPLY, plan=replace(PLAN, **changed))
    with pytest.raises(UsageError) as refused:
        check(given, system)
    what = "cannot apply robot.lifecycle.yaml to 'robot' while it runs"
    assert str(refused.value).startswith(f"{what}: {why}")
    # What no command line sends is refused, too.
    for each in (Order(ask=ControlRequest.APPLY), replace(given, timeout_s=-1.0)):
        with pytest.raises(UsageError, match="cannot apply a manifest to 'robot' without one"):
            check(each, system)


def test_the_control_socket_looks_and_orders(tmp_path: Path) -> None:
    seen = SupervisorSnapshot(plan=PLAN, status=STATUS, observation=Observation(), verdict=None)
    asked: list[Order] = []

    async def carry_out(given: Order) -> Answer:
        asked.append(given)
        return Answer(exit_code=ExitCode.VIOLATED, error="cannot activate: no")

    async def test() -> None:
        session = SimpleNamespace(look=lambda: seen, order=carry_out)
        server = ControlServer(tmp_path / "control", session)  # type: ignore[arg-type]
        await server.open()
        loop = asyncio.get_running_loop()
        assert await loop.run_in_executor(None, look, tmp_path) == seen
        answer = await loop.run_in_executor(
            None, lambda: order(tmp_path, Question(ask=ControlRequest.RESTART, node="camera"), 5.0)
        )
        assert (answer.exit_code, answer.error) == (ExitCode.VIOLATED, "cannot activate: no")
        assert asked == [Order(ask=ControlRequest.RESTART, node="camera")]

        await server.close(0)

    asyncio.run(test())
