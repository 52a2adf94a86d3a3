"""Bring-up of whole systems: what runs side by side, what waits, and how failures are named."""

from __future__ import annotations

import asyncio
import signal
from pathlib import Path
from typing import Any

import pytest

from lifecycle.errors import ExitCode
from lifecycle.manifest.model import Condition, RunKind, Timeouts
from lifecycle.plan.model import PlannedNode
from lifecycle.supervisor.core.failure import ALSO_S
from lifecycle.supervisor.processes.process import ProcessExit
from lifecycle.supervisor.run.events import Failure, Notice
from tests.builders import plan_of, planned_node
from tests.unit.supervisor.session_world import SessionWorld


def _world(tmp_path: Path, *nodes: PlannedNode, **options: Any) -> SessionWorld:
    return SessionWorld(plan_of(*nodes), tmp_path, **{"stop_after_s": 0.0, **options})


def _failed(world: SessionWorld) -> list[tuple[str, str, str]]:
    return [(each.rule, each.subject, each.message) for each in world.heard(Failure)]


async def test_nodes_without_an_order_come_up_side_by_side(tmp_path: Path) -> None:
    world = _world(tmp_path, planned_node("a"), planned_node("b"))
    for what in ("a start", "b start", "/a configure", "/b configure"):
        world.hosts.takes_s[what] = 3.0
    await world.run()
    assert "[system] connected at 6.0 s" in world.outline


@pytest.mark.parametrize(
    ("condition", "reached", "held"),
    [
        (Condition.STARTED, "a start", "b start"),
        (Condition.CONFIGURED, "/a configure", "/b configure"),
        (Condition.CONNECTED, "/a connect", "/b connect"),
        (Condition.ACTIVE, "/a activate", "/b activate"),
    ],
)
async def test_a_condition_holds_the_step_that_it_names(
    tmp_path: Path, condition: Condition, reached: str, held: str
) -> None:
    world = _world(tmp_path, planned_node("b", after={"a": condition}), planned_node("a"))
    world.hosts.takes_s[reached] = 4.0
    await world.run()
    log = world.story
    assert log.index(reached) < log.index(held)
    # The step before it was not held: b went as far as it may while a was busy.
    steps = ["b start", "/b configure", "/b connect", "/b activate"]
    assert all(log.index(step) < log.index(held) for step in steps[: steps.index(held)])


async def test_nodes_that_are_activated_side_by_side_are_not_judged_one_by_one(
    tmp_path: Path,
) -> None:
    world = _world(tmp_path, *(planned_node(f"n{index}") for index in range(20)))
    looks: list[int] = []
    opened: list[int] = []
    observe = world.graph.observe

    async def counted(plan: Any, **how: Any) -> Any:
        looks.append(0)
        return await observe(plan, **how)

    world.graph.observe = counted  # type: ignore[method-assign]
    world.story.in_the_moment["[gate]"] = lambda: opened.append(len(looks))
    await world.run()
    assert world.outline[-1] == "[stopped] 0"
    assert len(looks) - opened[0] <= 4


@pytest.mark.parametrize("step", ["a start", "/a configure"])
async def test_time_that_a_process_waits_for_a_processor_is_not_its_own(
    tmp_path: Path, step: str
) -> None:
    timeouts = Timeouts(start_s=2.0, configure_s=2.0)
    world = _world(tmp_path, planned_node("a", timeouts=timeouts), planned_node("b"))
    world.hosts.takes_s[step] = 15.0
    world.hosts.starves["a"] = 3.0  # three of its threads, all the time
    await world.run()
    assert world.outline[-1] == "[stopped] 0"


@pytest.mark.parametrize(("starves", "after_s"), [(0.0, 2.0), (0.5, 4.0), (3.0, 20.0)])
async def test_a_start_that_hangs_is_noticed_on_a_loaded_machine_too(
    tmp_path: Path, starves: float, after_s: float
) -> None:
    world = _world(tmp_path, planned_node("a", timeouts=Timeouts(start_s=2.0)))
    world.hosts.ways["a start"] = "hang"
    world.hosts.starves["a"] = starves
    async with world.running("[failure]"):
        took_s = asyncio.get_running_loop().time()
    assert "was still starting after 2 s" in world.messages[0]
    assert took_s == pytest.approx(after_s, abs=1.0)


async def test_nodes_of_one_process_share_it_and_its_start_waits_for_both(tmp_path: Path) -> None:
    world = _world(
        tmp_path,
        planned_node("a", process="both"),
        planned_node("b", process="both", after={"c": Condition.STARTED}),
        planned_node("c"),
    )
    world.hosts.takes_s["c start"] = 4.0
    await world.run()
    assert sorted(world.hosts.processes) == ["both", "c"]
    assert world.story.index("c start") < world.story.index("both start")


async def test_a_plain_command_is_only_started_and_whoever_needs_it_waits_for_its_name(
    tmp_path: Path,
) -> None:
    world = _world(
        tmp_path,
        planned_node("plain", kind=RunKind.COMMAND, managed=False),
        planned_node("a", after={"plain": Condition.CONFIGURED}),
    )
    world.hosts.takes_s["plain start"] = 3.0
    async with world.running("a start"):
        await asyncio.sleep(1.0)
        assert "/a configure" not in world.story
    assert "[system] connected at 3.0 s" in world.outline
    assert "plain SIGINT" in world.story


async def test_everything_that_fails_side_by_side_is_named_once_and_no_other_step_begins(
    tmp_path: Path,
) -> None:
    world = _world(tmp_path, *(planned_node(key) for key in "abcd"))
    world.hosts.ways |= {"/b configure": "no camera", "/c configure": "no arm"}
    world.hosts.takes_s |= {"/c configure": 0.2, "/d configure": 0.1, "/a configure": 60.0}
    await world.run()
    assert _failed(world) == [
        ("run.transition-failed", "/b", "cannot configure '/b': no camera"),
        ("run.transition-failed", "/c", "cannot configure '/c': no arm"),
    ]
    assert f"[stopping] at {ALSO_S:.1f} s: rolling back" in world.outline
    assert "/d connect" not in world.story


async def test_a_lone_failure_waits_for_nobody_who_is_not_in_a_step(tmp_path: Path) -> None:
    world = _world(tmp_path, planned_node("a"), planned_node("b", after={"a": Condition.ACTIVE}))
    world.hosts.ways["/a connect"] = "no network"
    world.hosts.takes_s["/a connect"] = 1.0
    await world.run()
    assert len(_failed(world)) == 1
    assert "[stopping] at 1.0 s: rolling back" in world.outline


async def test_a_process_is_blamed_once_for_each_node_that_it_cannot_host_and_for_no_other(
    tmp_path: Path,
) -> None:
    nodes = (*(planned_node(key, process="all") for key in "abc"), planned_node("d"))
    world = _world(tmp_path, *nodes)
    error = "ModuleNotFoundError: No module named 'camera_driver'"
    world.hosts.unhosted["all"] = {"/b": error, "/c": "cannot import 'm:C': no module 'm'"}
    world.hosts.takes_s["d start"] = 60.0
    await world.run()
    assert _failed(world) == [
        ("run.start-failed", "/b", f"cannot start '/b': {error}"),
        ("run.start-failed", "/c", "cannot import 'm:C': no module 'm'"),
    ]


async def test_processes_that_die_one_after_the_other_are_all_named(tmp_path: Path) -> None:
    plain = (planned_node(key, kind=RunKind.COMMAND, managed=False) for key in "ab")
    world = _world(tmp_path, *plain, planned_node("c"))
    world.hosts.takes_s["c start"] = 60.0
    async with world.running("c start"):
        await asyncio.sleep(1.0)
        world.hosts.processes["a"].end(ProcessExit(status=127))
        await asyncio.sleep(0.1)
        world.hosts.processes["b"].end(ProcessExit(status=127))
    died = [(rule, subject) for rule, subject, _ in _failed(world)]
    assert died == [("run.process-died", "/a"), ("run.process-died", "/b")]
    assert "failed: /a (run.process-died), /b (run.process-died)" in world.report


@pytest.mark.parametrize("kind", [RunKind.PYTHON, RunKind.COMMAND])
async def test_a_process_that_is_still_starting_is_ended_at_once_and_not_by_an_interrupt(
    tmp_path: Path, kind: RunKind
) -> None:
    """SIGINT would have Python print a traceback from the middle of an import."""
    managed = kind is RunKind.PYTHON
    world = _world(tmp_path, planned_node("a", kind=kind, managed=managed), planned_node("b"))
    world.hosts.takes_s["a start"] = 60.0
    world.hosts.ends_at["a"] = signal.SIGTERM
    world.hosts.ways["/b configure"] = "no arm"
    await world.run()
    assert [each for each in world.story if each.startswith("a SIG")] == ["a SIGTERM"]
    assert world.result is not None
    assert world.result.exit_code is ExitCode.BRING_UP_FAILED
    assert world.heard(Notice) == []
