"""Modes: what a plan is in one, and sessions that are switched; outlines of runs are compared."""

from __future__ import annotations

import asyncio
from pathlib import Path

from msgspec.structs import replace

from lifecycle.manifest.model import (
    Consequence,
    Mode,
    ModeParameter,
    ParameterDeclaration,
    Policy,
    Reaction,
    Restart,
    RosInterfaceAccess,
    Supervision,
    TargetState,
)
from lifecycle.plan.model import Plan, in_mode
from lifecycle.supervisor.control.server import ControlRequest
from tests.builders import HERE, node, plan_of, planned, planned_node
from tests.unit.supervisor.session_world import INTRUDED, SessionWorld

MODE = ControlRequest.MODE


def _plan(restart: Restart = Restart.NO) -> Plan:
    supervision = Supervision(restart=restart, restart_sec=1.0)
    plan = plan_of(*(planned_node(each, supervision=supervision) for each in ("base", "camera")))
    modes = (
        Mode(name="normal", at=HERE),
        Mode(name="degraded", inactive=("camera",), at=HERE),
        Mode(name="blind", inactive=("base",), at=HERE),
    )
    return in_mode(replace(plan, modes=modes), "normal")


def test_a_mode_keeps_its_nodes_inactive_and_the_next_has_them_active_again() -> None:
    plan = _plan()
    assert in_mode(plan, "normal").nodes == plan.nodes
    degraded = in_mode(plan, "degraded")
    assert [each.state.value for each in degraded.nodes] == ["active", "inactive"]
    assert degraded.nodes[0] is plan.nodes[0]
    blind = in_mode(degraded, "blind")
    assert [each.state for each in blind.nodes] == [TargetState.INACTIVE, TargetState.ACTIVE]
    assert in_mode(blind, "unknown") is blind


async def test_a_mode_takes_nodes_out_at_once_and_back_in_through_the_gate(tmp_path: Path) -> None:
    world = SessionWorld(_plan(), tmp_path, stop_after_s=10.0)
    async with world.running("[system] active"):
        assert await world.order(MODE, mode="degraded") == "0"
        await asyncio.sleep(2.0)
        status = world.status()
        assert (status.mode, status.phase, status.not_ok) == ("degraded", "active", "")
        assert await world.order(MODE, mode="blind") == "0"
        await asyncio.sleep(2.0)
        assert await world.order(MODE, mode="blnd") == (
            "2 cannot enter mode 'blnd' of 'robot': it has the modes normal, degraded, blind; "
            "did you mean 'blind'?"
        )
        assert await world.order(MODE, mode="normal") == "0"
    outline = world.since("[mode]")
    assert outline[: outline.index("[stopping] at 10.0 s: done")] == [
        "[mode] degraded without /camera",
        "[system] active at 0.0 s",
        "/base deactivate",
        "[mode] blind without /base",
        *_through("/camera", 2.0),
        "[mode] normal",
        *_through("/base", 4.0),
    ]
    assert world.outline[world.outline.index(outline[0]) - 1] == "/camera deactivate"
    assert world.story[-1] == "[stopped] 0"


def _through(node: str, at_s: float) -> list[str]:
    return [
        f"[system] verified at {at_s:.1f} s",
        "networks programmed (ok)",
        f"[gate] ok: {node}",
        f"{node} activate",
        f"[system] active at {at_s:.1f} s",
    ]


async def test_a_mode_with_less_is_entered_whatever_is_violated_and_one_with_more_is_not(
    tmp_path: Path,
) -> None:
    world = SessionWorld(_plan(), tmp_path, stop_after_s=20.0)
    async with world.running("[system] active"):
        world.intrude()
        await world.story.until("[verdict] active violated")
        assert await world.order(MODE, mode="degraded") == "0"
        answer = await world.order(MODE, mode="normal")
        assert answer.startswith("4 cannot activate: the verdict is violated")
        status = world.status()
        assert (status.mode, status.phase) == ("degraded", "active")
        # This one would take another node out: it waits at the gate of the mode before.
        assert (await world.order(MODE, mode="blind"))[0] == "4"
        status = world.status()
        assert (status.mode, status.phase) == ("degraded", "held")
        world.retreat()
        assert await world.order(ControlRequest.RESUME) == "0"
        assert world.status().phase == "active"
    assert any(INTRUDED in each for each in world.outline)
    assert "[notice] cannot enter mode 'normal': back to 'degraded'" in world.outline
    assert world.outline.count("/camera activate") == 1
    assert world.outline.count("/base activate") == 2


async def test_a_paused_system_stays_paused_and_what_is_restarted_comes_back_as_its_mode_says(
    tmp_path: Path,
) -> None:
    world = SessionWorld(_plan(Restart.ON_FAILURE), tmp_path, stop_after_s=20.0)
    async with world.running("[system] active"):
        assert await world.order(ControlRequest.PAUSE) == "0"
        assert await world.order(MODE, mode="degraded") == "0"
        assert world.status().phase == "paused"
        assert await world.order(ControlRequest.RESUME) == "0"
        world.kill("camera")
        await world.story.until("[restarted] camera")
        assert world.status().phase == "active"
        assert await world.order(ControlRequest.RESTART) == "0"
        assert world.status().mode == "degraded"
    assert world.outline.count("/camera activate") == 1
    assert world.outline.count("/base activate") == 3
    assert world.story[-1] == "[stopped] 0"


def _with_speeds() -> Plan:
    """Two nodes with a speed, another one in mode `slow`, which keeps the camera inactive."""
    speed = ParameterDeclaration(name="speed", type="double", default=1.0, at=HERE)
    nodes = [node(each) for each in ("base", "camera")]
    nodes[0] = replace(nodes[0], interface=replace(nodes[0].interface, parameters=(speed,)))
    slow = ModeParameter(node="base", name="speed", value=0.2, at=HERE)
    modes = (
        Mode(name="normal", at=HERE),
        Mode(name="slow", inactive=("camera",), parameters=(slow,), at=HERE),
    )
    return planned(*nodes, modes=modes)


def test_a_mode_has_parameters_and_the_next_has_them_as_they_are_declared() -> None:
    plan = _with_speeds()
    assert plan.nodes[0].parameters == (("speed", 1.0),)
    (expected,) = in_mode(plan, "slow").nodes[0].expected_parameters
    assert (expected.name, expected.value, expected.source) == ("speed", 0.2, "mode slow")
    assert in_mode(plan, "slow").nodes[0].parameters == (("speed", 0.2),)
    assert in_mode(in_mode(plan, "slow"), "normal") == plan


async def test_parameters_are_set_before_what_comes_in_is_activated_and_set_back_if_one_is_refused(
    tmp_path: Path,
) -> None:
    plan = replace(_with_speeds(), policy=Policy(ros_interface=RosInterfaceAccess.FULL))
    world = SessionWorld(plan, tmp_path, stop_after_s=10.0)
    async with world.running("[system] active"):
        await asyncio.sleep(0.3)
        ros = world.graph.ros
        assert ros is not None
        assert ros.services[-2:] == ("mode/normal", "mode/slow")
        assert await ros.call("mode/slow") == (True, "active")
        assert await world.order(MODE, mode="normal") == "0"
        world.graph.refuses = "speed=0.2"
        assert await world.order(MODE, mode="slow") == (
            "6 cannot enter mode 'slow': cannot set 'speed=0.2'"
        )
        status = world.status()
        assert (status.mode, status.phase) == ("normal", "active")
    outline = [each for each in world.since("[system] active")[1:] if "[system]" not in each]
    # Fake nodes report no parameters.
    through = ["networks programmed (unverifiable)", "[gate] unverifiable: /camera"]
    through.append("/camera activate")
    assert outline[: outline.index("[stopping] at 10.0 s: done")] == [
        "/camera deactivate",
        "/base given speed=0.2",
        "[mode] slow without /camera",
        "/base given speed=1.0",
        "[mode] normal",
        *through,
        "/camera deactivate",
        "/base given speed=0.2",
        "[notice] cannot enter mode 'slow': back to 'normal'",
        "/base given speed=1.0",
        "[mode] normal",
        *through,
    ]


async def test_a_consequence_that_a_node_refuses_is_reported_and_the_system_goes_on(
    tmp_path: Path,
) -> None:
    what = Reaction(rule="graph", what=Consequence.MODE, mode="slow")
    world = SessionWorld(replace(_with_speeds(), on_violation=(what,)), tmp_path, stop_after_s=10.0)
    world.graph.refuses = "speed=0.2"
    async with world.running("[system] active"):
        world.intrude()
        await world.story.until("[notice] cannot enter mode 'slow': cannot set")
    assert world.status().mode == "normal"
