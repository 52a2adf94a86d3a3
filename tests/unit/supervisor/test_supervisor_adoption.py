"""`up --adopt`: what ran before is verified in place, activated or left active, and left running.

Each test prepares a world in which others run nodes of the plan, and compares what became of them.
What must hold in every run is checked by `SessionWorld.run` each time.
"""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest
from msgspec.structs import replace

from lifecycle.errors import ExitCode, UsageError
from lifecycle.manifest.model import Condition, Run, RunKind, TargetState
from lifecycle.plan.model import Plan
from lifecycle.supervisor.control.server import ControlRequest
from lifecycle.supervisor.run.options import Until
from tests.builders import plan_of, planned_node
from tests.unit.supervisor.session_world import INTRUDED, SessionWorld, over

ROBOT = plan_of(
    planned_node("camera", after={"lidar": Condition.ACTIVE}),
    planned_node("new"),
    planned_node("arm"),
    planned_node("lidar"),
    planned_node("logger", managed=False),
)
"""Somebody runs all of it but the camera."""

FOUND = {"/new": "unconfigured", "/arm": "inactive", "/lidar": "active", "/logger": ""}

ADOPTED = [
    "[notice] '/arm' is adopted, found inactive",
    "[notice] '/lidar' is adopted, found active: pid 7, by hand",
    "[notice] '/logger' is adopted, found running",
    "[notice] '/new' is adopted, found unconfigured",
]


def world_of(tmp_path: Path, plan: Plan = ROBOT, **options: object) -> SessionWorld:
    world = SessionWorld(plan, tmp_path, adopt=True, **options)
    names = {each.full_name for each in plan.nodes}
    world.graph.others.update({name: state for name, state in FOUND.items() if name in names})
    return world


def requests(world: SessionWorld, node: str) -> list[str]:
    """What was asked of a node."""
    return [line.split()[1] for line in world.story if line.startswith(f"{node} ")]


def notices(world: SessionWorld) -> list[str]:
    return sorted(line for line in world.story if line.startswith("[notice]"))


async def test_what_runs_is_verified_in_place_and_in_the_end_as_it_was_found(
    tmp_path: Path,
) -> None:
    world = world_of(tmp_path, stop_after_s=3.0)
    world.graph.pids["/lidar"] = 7
    await world.run()
    assert world.result is not None
    assert world.result.exit_code == ExitCode.OK
    assert notices(world) == ADOPTED
    assert [each for each in world.outline if each.endswith("start")] == ["camera start"]
    assert "[gate] ok: /camera, /new, /arm" in world.outline
    assert requests(world, "/lidar") == requests(world, "/logger") == []
    assert requests(world, "/arm") == ["activate", "deactivate"]
    assert requests(world, "/new") == ["configure", "activate", "deactivate", "cleanup"]
    assert world.graph.others == FOUND


async def test_a_system_of_which_all_is_found_one_after_the_other_is_connected_once(
    tmp_path: Path,
) -> None:
    names = ("arm", "new", "logger")
    command = Run(kind=RunKind.COMMAND)
    plain = (replace(planned_node(each, managed=False), run=command) for each in names)
    world = world_of(tmp_path, plan_of(*plain), stop_after_s=3.0)
    world.graph.others = dict.fromkeys((f"/{each}" for each in names), "")
    await world.run()
    assert [each.startswith("[system] connected") for each in world.story].count(True) == 1


LIDAR = planned_node("lidar")


@pytest.mark.parametrize(
    ("plan", "until", "intrudes", "verdict", "code"),
    [
        (ROBOT, Until.ACTIVE, True, f"violated {INTRUDED}", 4),
        (ROBOT, Until.CONNECTED, False, "ok", 0),
        (
            plan_of(replace(LIDAR, state=TargetState.INACTIVE)),
            Until.ACTIVE,
            False,
            "violated state.wrong-state /lidar",
            4,
        ),
    ],
)
async def test_where_nothing_may_be_activated_it_is_judged_and_left_as_it_was_found(
    tmp_path: Path, plan: Plan, until: Until, intrudes: bool, verdict: str, code: int
) -> None:
    world = world_of(tmp_path, plan, until=until)
    if intrudes:
        world.intrude()
    found = dict(world.graph.others)
    await world.run()
    verdicts = [each for each in world.outline if each.startswith("[verdict]")]
    assert verdicts == [f"[verdict] connected {verdict}"]
    assert world.outline[-1] == f"[stopped] {code}"
    assert not [each for each in world.outline if each.endswith(" activate")]
    assert requests(world, "/lidar") == []
    assert world.graph.others == found


async def test_a_process_of_which_some_nodes_run_is_not_started_beside_them(tmp_path: Path) -> None:
    plan = plan_of(planned_node("lidar", process="both"), planned_node("new", process="both"))
    world = world_of(tmp_path, plan)
    with pytest.raises(UsageError, match="cannot leave out 'lidar' alone"):
        world.system.adopt({"/lidar": ""})


async def test_a_node_in_a_transition_is_adopted_as_what_it_becomes(tmp_path: Path) -> None:
    world = world_of(tmp_path, plan_of(LIDAR), stop_after_s=0.0)
    world.graph.others["/lidar"] = "activating"
    async with world.running():
        await asyncio.sleep(1.0)
        world.graph.others["/lidar"] = "active"
    assert notices(world) == ["[notice] '/lidar' is adopted, found active"]
    assert world.outline[-1] == "[stopped] 0"


@pytest.mark.parametrize("adopt", [False, True])
async def test_an_attached_node_that_is_active_is_refused_but_for_adopt(
    tmp_path: Path, adopt: bool
) -> None:
    plan = plan_of(planned_node("lidar", kind=RunKind.ATTACH))
    world = SessionWorld(plan, tmp_path, adopt=adopt, stop_after_s=0.0)
    world.graph.others["/lidar"] = "active"
    await world.run()
    assert world.graph.others == {"/lidar": "active"}
    refused = (
        "cannot configure '/lidar': it is active already, and nobody verified it; "
        "have it adopted as it is with 'lifecycle up --adopt', or deactivate it first: "
        "ros2 lifecycle set /lidar deactivate"
    )
    assert world.messages == ([] if adopt else [refused])


async def test_a_pause_deactivates_what_was_found_active_and_a_resume_leaves_it_so(
    tmp_path: Path,
) -> None:
    world = world_of(tmp_path, plan_of(LIDAR))
    async with world.running("[system] active"):
        for ask in (ControlRequest.PAUSE, ControlRequest.RESUME, ControlRequest.RESTART):
            assert await world.order(ask) == "0"
        assert await world.order(ControlRequest.RESTART, "lidar") == (
            "2 cannot restart '/lidar': it is attached, no process of this supervisor"
        )
        await world.order(ControlRequest.DOWN)
    assert requests(world, "/lidar") == ["deactivate", "activate"]
    assert world.graph.others == {"/lidar": "active"}
    assert world.outline[-1] == "[stopped] 0"


async def test_nothing_is_asked_of_a_node_that_ran_before_one_of_ours(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Both have the services by which ours is driven."""
    older = "lifecycle.supervisor.shell.requests.start_ticks"
    monkeypatch.setattr(older, lambda pid: 1 if pid == 7 else 2)

    world = SessionWorld(plan_of(planned_node("new", kind=RunKind.COMMAND)), tmp_path)
    world.graph.others["/new"] = "unconfigured"
    world.graph.pids["/new"] = 7
    await world.run()
    assert world.outline == [
        "[verdict] connected violated graph.duplicate-node /new",
        "[stopping] at 0.0 s: the verdict keeps the gate closed",
        "new SIGTERM",
        *over(4),
    ]
    assert world.messages == [
        ("cannot drive /new: a node of this name ran before (pid 7, by hand), and would obey, too")
    ]
