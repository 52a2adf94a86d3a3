"""Orders to a supervisor: which fit, in which order nodes are taken down, and who is told."""

from __future__ import annotations

import asyncio
import threading
from pathlib import Path
from types import SimpleNamespace

import pytest

from lifecycle.errors import ExitCode, UsageError
from lifecycle.manifest.model import Condition, RunKind
from lifecycle.supervisor.control.client import look, order
from lifecycle.supervisor.control.orders import (
    ACTIVE,
    HELD,
    PAUSED,
    Mailbox,
    Order,
    check_order,
)
from lifecycle.supervisor.control.protocol import Answer, ControlRequest, Question
from lifecycle.supervisor.control.server import ControlServer, SupervisorSnapshot, follow
from lifecycle.verify.observation import Observation
from tests.builders import plan_of, planned_node
from tests.unit.supervisor.fakes import World
from tests.unit.test_run_directory import STATUS

PLAN = plan_of(
    planned_node("camera"),
    planned_node("viewer", after={"camera": Condition.ACTIVE}),
    planned_node("base", kind=RunKind.ATTACH),
)


@pytest.mark.parametrize(
    ("kind", "fits"),
    [
        (ControlRequest.PAUSE, {ACTIVE, HELD}),
        (ControlRequest.RESUME, {PAUSED, HELD}),
        (ControlRequest.RESTART, {ACTIVE, PAUSED, HELD}),
    ],
)
@pytest.mark.parametrize(
    "phase", [ACTIVE, PAUSED, HELD, "connecting", "verifying", "restarting", "stopping"]
)
async def test_an_order_fits_some_phases_and_no_others(
    tmp_path: Path, kind: ControlRequest, fits: set[str], phase: str
) -> None:
    system = World(PLAN, tmp_path).system
    if phase in fits:
        check_order(Order(ask=kind), system, phase)
    else:
        with pytest.raises(UsageError, match=rf"^cannot {kind.value} 'robot': it is {phase};"):
            check_order(Order(ask=kind), system, phase)


@pytest.mark.parametrize(
    ("node", "message"),
    [
        (
            "camrea",
            "cannot restart 'camrea': this supervisor runs no such node; it runs: /camera, /viewer",
        ),
        ("/base", "cannot restart '/base': it is attached, no process of this supervisor"),
    ],
)
async def test_a_node_that_is_not_ours_is_not_restarted(
    tmp_path: Path, node: str, message: str
) -> None:
    system = World(PLAN, tmp_path).system
    for known in ("camera", "/camera"):
        check_order(Order(ask=ControlRequest.RESTART, node=known), system, ACTIVE)
    with pytest.raises(UsageError) as caught:
        check_order(Order(ask=ControlRequest.RESTART, node=node), system, ACTIVE)
    assert str(caught.value) == message


async def test_orders_are_carried_out_one_by_one_and_refused_once_all_is_over() -> None:
    mailbox = Mailbox()
    first = asyncio.ensure_future(mailbox.place(Order(ask=ControlRequest.PAUSE)))
    second = asyncio.ensure_future(mailbox.place(Order(ask=ControlRequest.RESUME)))
    pending = await mailbox.next()
    assert pending.order.ask is ControlRequest.PAUSE
    pending.finish(Answer(exit_code=0))
    assert await first == Answer(exit_code=0)
    mailbox.close("cannot go on: over")
    assert await second == Answer(exit_code=ExitCode.BRING_UP_FAILED, error="cannot go on: over")


def test_the_control_socket_looks_follows_and_orders(tmp_path: Path) -> None:
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

        heard: list[SupervisorSnapshot] = []
        came = [threading.Event(), threading.Event()]

        def listen() -> None:
            for each in follow(tmp_path / "control"):
                came[len(heard)].set()
                heard.append(each)

        listening = loop.run_in_executor(None, listen)
        assert await loop.run_in_executor(None, came[0].wait, 5.0)
        server.changed()
        assert await loop.run_in_executor(None, came[1].wait, 5.0)
        await server.close(0)
        await asyncio.wait_for(listening, 5.0)
        assert heard == [seen, seen]

    asyncio.run(test())
