"""Modes: what a plan is in one, and a session that is switched; see core/test_changes.py, too."""

from __future__ import annotations

import asyncio
from pathlib import Path

from msgspec.structs import replace

from lifecycle.manifest.model import (
    Mode,
    ModeParameter,
    ParameterDeclaration,
    Policy,
    RosInterfaceAccess,
    TargetState,
)
from lifecycle.plan.model import Plan, in_mode
from lifecycle.supervisor.control.server import ControlRequest
from tests.builders import HERE, node, plan_of, planned, planned_node
from tests.unit.supervisor.session_world import SessionWorld

MODE = ControlRequest.MODE


def test_a_mode_keeps_its_nodes_inactive_and_the_next_has_them_active_again() -> None:
    modes = (
        Mode(name="normal", at=HERE),
        Mode(name="degraded", inactive=("camera",), at=HERE),
        Mode(name="blind", inactive=("base",), at=HERE),
    )
    plan = replace(plan_of(planned_node("base"), planned_node("camera")), modes=modes)
    assert in_mode(plan, "normal").nodes == plan.nodes
    degraded = in_mode(plan, "degraded")
    assert [each.state.value for each in degraded.nodes] == ["active", "inactive"]
    assert degraded.nodes[0] is plan.nodes[0]
    blind = in_mode(degraded, "blind")
    assert [each.state for each in blind.nodes] == [TargetState.INACTIVE, TargetState.ACTIVE]
    assert in_mode(blind, "unknown") is blind


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
        world.hosts.ways["/base given speed=0.2"] = "cannot set 'speed=0.2'"
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
