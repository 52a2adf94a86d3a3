"""Bring-up and take-down: order, parallelism, deadlines, and what a failure says."""

from __future__ import annotations

import asyncio
import signal
from pathlib import Path
from typing import Any

import pytest

from lifecycle.errors import BringUpError
from lifecycle.manifest.model import Condition, RunKind, Timeouts
from lifecycle.node.host.control import HostSpec, Operation
from lifecycle.supervisor.control.protocol import Reach
from lifecycle.supervisor.gate.gate import Gate, Permit
from lifecycle.supervisor.gate.verification_loop import ChangeCounter, VerificationLoop
from lifecycle.supervisor.health.process_monitor import ProcessMonitor
from lifecycle.supervisor.nodes.bring_up import ALSO_S
from lifecycle.supervisor.processes.control_channel import ControlChannel
from lifecycle.supervisor.processes.process import ManagedProcess, ProcessExit
from lifecycle.supervisor.run.events import Notice
from lifecycle.supervisor.run.failure import StepFailedError
from lifecycle.supervisor.run.shutdown import TakeDown
from lifecycle.verify.outcome import Outcome
from lifecycle.verify.verdict import Stage, Verdict
from tests.builders import plan_of, planned_node
from tests.unit.supervisor.fakes import FakeGraph, FakeProcess, World, run, verdict_of

LIMIT_S = 30.0


def _world(tmp_path: Path, *nodes: object) -> World:
    return World(plan_of(*nodes), tmp_path)  # type: ignore[arg-type]


async def _down(world: World, hurry: asyncio.Event | None = None) -> None:
    await world.bring_up.close()
    await TakeDown(world.system, world.emit, hurry or asyncio.Event()).run()


async def test_nodes_without_an_order_come_up_side_by_side(tmp_path: Path) -> None:
    world = _world(tmp_path, planned_node("a"), planned_node("b"))
    for what in ("a start", "b start", "/a configure", "/b configure"):
        world.spawner.takes_s[what] = 3.0
    began = asyncio.get_running_loop().time()
    await world.bring_up.connect(LIMIT_S)
    assert asyncio.get_running_loop().time() - began == pytest.approx(6.0, abs=0.1)
    await _down(world)


async def test_a_bring_up_that_was_cancelled_twice_starts_everything_anew_the_next_time(
    tmp_path: Path,
) -> None:
    """Who is slow to end is cancelled again (run/failure.py), perhaps while it cleans up."""

    world = _world(tmp_path, planned_node("a"), planned_node("b"))
    spawn, asked = world.spawner.spawn, []

    async def slow(process: ManagedProcess, *descriptors: Any) -> FakeProcess:
        asked.append(process.name)
        if len(asked) > 2:
            return await spawn(process, *descriptors)
        try:
            return await asyncio.get_running_loop().create_future()
        except asyncio.CancelledError:
            await asyncio.sleep(5.0)  # what was begun is undone
            raise

    world.spawner.spawn = slow  # type: ignore[method-assign]
    connecting = asyncio.ensure_future(world.bring_up.connect(LIMIT_S))
    await asyncio.sleep(0.1)
    for _ in range(2):
        connecting.cancel()
        await asyncio.sleep(0.1)
    with pytest.raises(asyncio.CancelledError):
        await connecting
    await world.bring_up.connect(LIMIT_S)
    assert sorted(asked) == ["a", "a", "b", "b"]
    assert {each.reach for each in world.system.nodes.values()} == {Reach.CONNECTED}
    await _down(world)


@pytest.mark.parametrize(
    ("condition", "reached", "held"),
    [
        (Condition.STARTED, "a start", "b start"),
        (Condition.CONFIGURED, "/a configure", "/b configure"),
        (Condition.CONNECTED, "/a connect", "/b connect"),
        (Condition.ACTIVE, "/a activate", "/b activate"),
    ],
)
def test_a_condition_holds_the_step_that_it_names(
    tmp_path: Path, condition: Condition, reached: str, held: str
) -> None:
    async def main() -> list[str]:
        world = _world(tmp_path, planned_node("b", after={"a": condition}), planned_node("a"))
        world.spawner.takes_s[reached] = 5.0
        await world.bring_up.connect(LIMIT_S)
        permit = Gate(strict=False).judge(verdict_of(Outcome.OK))
        await world.bring_up.activate(permit, LIMIT_S)
        log = list(world.log)
        await _down(world)
        return log

    log = run(main())
    assert log.index(reached) < log.index(held)
    # The step before it was not held: b went as far as it may while a was busy.
    steps = ["b start", "/b configure", "/b connect", "/b activate"]
    before = steps[: steps.index(held)]
    if condition is not Condition.ACTIVE:
        assert all(log.index(step) < log.index(held) for step in before)


async def test_no_activate_request_is_sent_without_a_permit(tmp_path: Path) -> None:
    world = _world(tmp_path, planned_node("a"))
    await world.bring_up.connect(LIMIT_S)
    with pytest.raises(BringUpError, match="cannot activate '/a' without a permit"):
        await world.system.nodes["a"].perform(Operation.ACTIVATE)
    gate = Gate(strict=False)
    permit = gate.judge(verdict_of(Outcome.OK))
    gate.close()
    with pytest.raises(StepFailedError, match="the gate was closed again"):
        await world.bring_up.activate(permit, LIMIT_S)
    assert "/a activate" not in world.log
    await _down(world)


async def test_nodes_that_are_activated_side_by_side_are_not_judged_one_by_one(
    tmp_path: Path,
) -> None:
    world = _world(tmp_path, *(planned_node(f"n{index}") for index in range(20)))
    judging = _Judging(world)
    await world.bring_up.connect(LIMIT_S)
    permit = await judging.opened()
    looks = judging.looks
    judging.graph.changed.set()
    await world.bring_up.activate(permit, LIMIT_S)
    assert {node.reach for node in world.system.nodes.values()} == {Reach.ACTIVE}
    assert 1 <= judging.looks - looks <= 3
    await _down(world)
    await judging.changes.close()


class _Judging:
    """The real judge of a world, whose verdict is always ok."""

    def __init__(self, world: World) -> None:
        self.graph = FakeGraph()
        self.changes = ChangeCounter(world.system, self.graph)
        self.looks = 0
        self._judge = VerificationLoop(
            world.system, self.graph, self.changes, world.emit, strict=False, verify_=self._verify
        )

    async def opened(self) -> Permit:
        return Gate(strict=False, judging=self._judge).judge(
            await self._judge.once(Stage.CONNECTED)
        )

    def _verify(self, *_: object, **__: object) -> Verdict:
        self.looks += 1
        return verdict_of(Outcome.OK)


@pytest.mark.parametrize("step", ["a start", "/a configure"])
async def test_time_that_a_process_waits_for_a_processor_is_not_its_own(
    tmp_path: Path, step: str
) -> None:
    timeouts = Timeouts(start_s=2.0, configure_s=2.0)
    world = _world(tmp_path, planned_node("a", timeouts=timeouts), planned_node("b"))
    world.spawner.takes_s[step] = 15.0
    world.spawner.starves["a"] = 3.0  # three of its threads, all the time
    await world.bring_up.connect(LIMIT_S)
    assert world.system.nodes["a"].reach is Reach.CONNECTED
    await _down(world)


@pytest.mark.parametrize(("starves", "after_s"), [(0.0, 2.0), (0.5, 4.0), (3.0, 20.0)])
async def test_a_start_that_hangs_is_noticed_on_a_loaded_machine_too(
    tmp_path: Path, starves: float, after_s: float
) -> None:
    world = _world(tmp_path, planned_node("a", timeouts=Timeouts(start_s=2.0)))
    world.spawner.ways["a start"] = "hang"
    world.spawner.starves["a"] = starves
    began = asyncio.get_running_loop().time()
    with pytest.raises(StepFailedError, match="was still starting after 2 s"):
        await world.bring_up.connect(LIMIT_S)
    took_s = asyncio.get_running_loop().time() - began
    assert took_s == pytest.approx(after_s + ALSO_S, abs=1.0)
    await _down(world)


async def test_nodes_of_one_process_share_it_and_its_start_waits_for_both(tmp_path: Path) -> None:
    world = _world(
        tmp_path,
        planned_node("a", process="both"),
        planned_node("b", process="both", after={"c": Condition.STARTED}),
        planned_node("c"),
    )
    world.spawner.takes_s["c start"] = 4.0
    await world.bring_up.connect(LIMIT_S)
    assert sorted(world.spawner.processes) == ["both", "c"]
    assert world.log.index("c start") < world.log.index("both start")
    await _down(world)


async def test_a_plain_command_is_only_started_and_whoever_stands_on_it_waits_for_its_name(
    tmp_path: Path,
) -> None:
    world = _world(
        tmp_path,
        planned_node("plain", kind=RunKind.COMMAND, managed=False),
        planned_node("a", after={"plain": Condition.CONFIGURED}),
    )
    connecting = asyncio.ensure_future(world.bring_up.connect(LIMIT_S))
    await asyncio.sleep(1.0)
    assert "/a configure" not in world.log
    world.appeared["/plain"].set()
    await connecting
    assert world.log == ["a start", "/a configure", "/a connect"]
    world.spawner.ends_at["plain"] = signal.SIGINT
    await _down(world)
    assert "plain SIGINT" in world.log


def _failed(caught: pytest.ExceptionInfo[StepFailedError]) -> list[tuple[str, str, str]]:
    return [(each.rule.id, each.subject, each.message) for each in caught.value.every]


async def test_everything_that_fails_side_by_side_is_named_once_and_no_other_step_begins(
    tmp_path: Path,
) -> None:
    world = _world(tmp_path, *(planned_node(key) for key in "abcd"))
    world.spawner.ways["/b configure"] = "no camera"
    world.spawner.ways["/c configure"] = "no arm"
    world.spawner.takes_s["/c configure"] = 0.2
    world.spawner.takes_s["/d configure"] = 0.1
    world.spawner.takes_s["/a configure"] = 60.0
    loop = asyncio.get_running_loop()
    began = loop.time()
    with pytest.raises(StepFailedError) as caught:
        await world.bring_up.connect(LIMIT_S)
    assert _failed(caught) == [
        ("run.transition-failed", "/b", "cannot configure '/b': no camera"),
        ("run.transition-failed", "/c", "cannot configure '/c': no arm"),
    ]
    assert loop.time() - began == pytest.approx(ALSO_S, abs=0.1)
    assert "/d connect" not in world.log
    await _down(world)


async def test_a_lone_failure_waits_for_nobody_who_is_not_in_a_step(tmp_path: Path) -> None:
    world = _world(tmp_path, planned_node("a"), planned_node("b", after={"a": Condition.ACTIVE}))
    world.spawner.ways["/a connect"] = "no network"
    world.spawner.takes_s["/a connect"] = 1.0
    loop = asyncio.get_running_loop()
    began = loop.time()
    with pytest.raises(StepFailedError) as caught:
        await world.bring_up.connect(LIMIT_S)
    assert len(caught.value.every) == 1
    assert loop.time() - began == pytest.approx(1.0, abs=0.1)
    await _down(world)


@pytest.mark.parametrize("begun", [True, False])
async def test_a_process_is_blamed_once_for_each_node_that_it_cannot_host_and_for_no_other(
    tmp_path: Path, begun: bool
) -> None:
    """Whether a step of its nodes has begun by then or not."""

    nodes = (*(planned_node(key, process="all") for key in "abc"), planned_node("d"))
    world = _world(tmp_path, *nodes)
    error = "ModuleNotFoundError: No module named 'camera_driver'"
    world.spawner.unhosted["all"] = {"/b": error, "/c": "cannot import 'm:C': no module 'm'"}
    world.spawner.takes_s["d start"] = 60.0

    async def start_others() -> None:
        process = world.system.processes["all"]
        spec = HostSpec(
            system="s",
            process="all",
            domain_id=0,
            discovery_range=world.system.plan.discovery_range,
            nodes=world.system.plan.nodes[:3],
        )
        await process.spawn(world.spawner, ControlChannel(spec, world.system.on_host_event))
        await asyncio.sleep(60.0)

    starting = world.bring_up.connect(LIMIT_S) if begun else start_others()
    with pytest.raises(StepFailedError) as caught:
        await ProcessMonitor(world.system).during(starting)
    assert _failed(caught) == [
        ("run.start-failed", "/b", f"cannot start '/b': {error}"),
        ("run.start-failed", "/c", "cannot import 'm:C': no module 'm'"),
    ]
    await _down(world)


async def test_every_process_that_died_by_then_is_named(tmp_path: Path) -> None:
    world = _world(
        tmp_path,
        *(planned_node(key, kind=RunKind.COMMAND, managed=False) for key in "ab"),
        planned_node("c"),
    )
    world.spawner.takes_s["c start"] = 60.0

    async def die() -> None:
        await asyncio.sleep(1.0)
        world.spawner.processes["a"].end(ProcessExit(status=127))
        await asyncio.sleep(0.1)
        world.spawner.processes["b"].end(ProcessExit(status=127))

    dying = asyncio.ensure_future(die())
    with pytest.raises(StepFailedError) as caught:
        await ProcessMonitor(world.system).during(world.bring_up.connect(LIMIT_S))
    await dying
    assert [(each.rule.id, each.subject) for each in caught.value.every] == [
        ("run.process-died", "/a"),
        ("run.process-died", "/b"),
    ]
    assert caught.value.reason == "failed: /a (run.process-died), /b (run.process-died)"
    await _down(world)


@pytest.mark.parametrize("kind", [RunKind.PYTHON, RunKind.COMMAND])
async def test_a_process_that_is_still_starting_is_ended_at_once_and_not_by_an_interrupt(
    tmp_path: Path, kind: RunKind
) -> None:
    """SIGINT would have Python print a traceback from the middle of an import."""

    managed = kind is RunKind.PYTHON
    world = _world(tmp_path, planned_node("a", kind=kind, managed=managed), planned_node("b"))
    world.spawner.takes_s["a start"] = 60.0
    world.spawner.ends_at["a"] = signal.SIGTERM
    world.spawner.ways["/b configure"] = "no arm"
    with pytest.raises(StepFailedError):
        await world.bring_up.connect(LIMIT_S)
    loop = asyncio.get_running_loop()
    began = loop.time()
    await _down(world)
    assert [each for each in world.log if each.startswith("a SIG")] == ["a SIGTERM"]
    assert loop.time() - began < 0.1
    assert world.heard(Notice) == []
