"""What a supervisor offers in ROS: diagnostics, status and orders, as the policy allows."""

from __future__ import annotations

import asyncio
import json
from pathlib import Path

import jsonschema
import pytest
from msgspec.structs import replace

from lifecycle.errors import ExitCode
from lifecycle.manifest.model import Policy, RosInterfaceAccess
from lifecycle.measure.flows import FlowMeasurement, Kind, MeasuredBound
from lifecycle.supervisor.control.ros_interface import (
    BRINGS_UP_S,
    ERROR,
    OK,
    STALE,
    WARN,
    Entry,
    Reported,
    diagnostics,
)
from lifecycle.supervisor.nodes.liveliness import Cause
from lifecycle.verify.outcome import Outcome
from tests import result_schemas
from tests.unit.supervisor.fakes import verdict_of
from tests.unit.supervisor.session_world import CHAIN, INTRUDED, SessionWorld
from tests.unit.supervisor.test_supervisor_output import FLOW, STATUS

OFF, FULL = RosInterfaceAccess.OFF, RosInterfaceAccess.FULL


OFFERING = replace(CHAIN, policy=Policy(ros_interface=FULL))


@pytest.mark.parametrize(
    ("policy", "services"), [(Policy(), ("get_status",)), (Policy(ros_interface=OFF), None)]
)
async def test_it_reads_only_by_default_and_off_leaves_nothing(
    tmp_path: Path, policy: Policy, services: tuple[str, ...] | None
) -> None:
    world = SessionWorld(replace(CHAIN, policy=policy), tmp_path, stop_after_s=3.0)
    await world.run()
    assert (world.graph.ros and world.graph.ros.services) == services


async def test_a_bring_up_that_is_held_up_says_why_before_it_is_active(tmp_path: Path) -> None:
    world = SessionWorld(CHAIN, tmp_path, stop_after_s=1.0)
    world.hide("/camera")
    async with world.running("[joined] /viewer"):
        await asyncio.sleep(BRINGS_UP_S - 0.2)
        assert world.graph.ros is None
        await asyncio.sleep(0.4)
        ros = world.graph.ros
        assert ros is not None
        said = json.loads(ros.statuses[-1])
        assert (said["phase"], said["verdict"]) == ("verifying", "violated")
        assert said["not_ok"] == "/camera (graph.missing-node)"
        assert [each[:3] for each in ros.diagnostics[-1]] == [
            (ERROR, "robot: /camera", "inactive"),
            (WARN, "robot: /viewer", "inactive, the system is verifying"),
            (ERROR, "robot: graph.missing-node", "there is no node /camera in domain 30"),
        ]
        world.hide()
        await world.story.until("[system] active")
        await asyncio.sleep(0.1)
        assert json.loads(ros.statuses[-1])["phase"] == "active"


async def test_what_cannot_be_offered_is_said_once_and_the_system_runs_without(
    tmp_path: Path,
) -> None:
    world = SessionWorld(CHAIN, tmp_path, stop_after_s=5.0)
    world.graph.no_ros = "No module named 'diagnostic_msgs'"
    await world.run()
    said = [each for each in world.outline if each.startswith("[notice]")]
    why = "cannot offer diagnostics and status in ROS: No module named 'diagnostic_msgs'"
    off = "the system runs without; 'policy: {ros_interface: off}' does not try"
    assert said == [f"[notice] {why}; {off}"]
    assert world.result is not None
    assert world.result.exit_code is ExitCode.OK


async def test_diagnostics_come_from_active_on_each_second_and_at_once_when_something_changed(
    tmp_path: Path,
) -> None:
    world = SessionWorld(CHAIN, tmp_path, stop_after_s=9.9)
    async with world.running("[gate]"):
        assert world.graph.ros is None  # bring-up pays nothing for it
        await world.story.until("[system] active")
        await asyncio.sleep(3.5)
        ros = world.graph.ros
        assert ros is not None
        assert (ros.prefix, ros.services) == ("/lifecycle/robot", ("get_status",))
        assert 4 <= len(ros.diagnostics) <= 6
        assert [each[:3] for each in ros.diagnostics[-1]] == [
            (OK, "robot: /camera", "active"),
            (OK, "robot: /viewer", "active"),
        ]
        schema = json.loads(result_schemas.generate("status"))
        jsonschema.Draft202012Validator(schema).validate(json.loads(ros.statuses[-1]))
        before = len(ros.statuses)
        world.intrude()
        await world.story.until(f"[verdict] active violated {INTRUDED}")
        await asyncio.sleep(0.1)
        rule = ros.diagnostics[-1][-1]
        assert rule[:2] == (ERROR, "robot: graph.undeclared-node")
        assert len(ros.statuses) == before + 1
        assert json.loads(ros.statuses[-1])["verdict"] == "violated"
        assert (await ros.call("get_status"))[0] is False
        world.retreat()
        await asyncio.sleep(3.0)
        assert ros.diagnostics[-1][-1][:3] == (OK, "robot: graph.undeclared-node", "ok")
        assert (await ros.call("get_status"))[0] is True
    assert world.graph.ros is not None
    assert world.graph.ros.destroyed
    assert json.loads(world.graph.ros.statuses[-1])["phase"] == "stopping"


async def test_services_give_the_orders_of_the_control_socket(tmp_path: Path) -> None:
    world = SessionWorld(OFFERING, tmp_path)
    async with world.running("[system] active"):
        await asyncio.sleep(0.3)
        ros = world.graph.ros
        assert ros is not None
        assert ros.services == ("get_status", "pause", "resume", "restart", "down")
        assert await ros.call("pause") == (True, "paused")
        await asyncio.sleep(1.0)
        assert ros.diagnostics[-1][0][:3] == (
            WARN,
            "robot: /camera",
            "inactive, the system is paused",
        )
        assert await ros.call("pause") == (
            False,
            "cannot pause 'robot': it is paused; only an active system can be paused",
        )
        assert await ros.call("resume") == (True, "active")
        assert await ros.call("restart") == (True, "active")
        assert await ros.call("down") == (True, "the system is being taken down")
    assert "the down service" in world.report


async def test_a_node_that_is_silent_is_stale(tmp_path: Path) -> None:
    world = SessionWorld(OFFERING, tmp_path, stop_after_s=5.0)
    async with world.running("[system] active"):
        world.system.liveliness.note(["/camera"], Cause.STOPPED, "pid 7")
        await asyncio.sleep(1.1)
        assert world.graph.ros is not None
        assert world.graph.ros.diagnostics[-1][0][0] == STALE


def test_a_flow_with_declared_numbers_has_an_entry_that_stays_while_it_is_not_measured() -> None:
    def shown(phase: str, outcome: Outcome, *measured: FlowMeasurement) -> list[Entry]:
        status = replace(STATUS, phase=phase, nodes=(), measured=measured)
        flow = replace(FLOW, outcome=outcome)
        verdict = replace(verdict_of(Outcome.OK), flows=(flow, replace(flow, topic="/other")))
        return [*diagnostics(status, verdict, reported, label="robot", source="us")]

    def measured(outcome: str, text: str) -> FlowMeasurement:
        bound = MeasuredBound(name="max_delay_ms", kind=Kind.DELAY, outcome=outcome, text=text)
        ends = {"topic": "/video", "publisher": "/camera", "subscription": "/viewer"}
        numbers = {"messages": 74, "lost": 1, "rate_hz": 14.8, "p50_ms": 0.5}
        return FlowMeasurement(bounds=(bound,), **ends, **numbers)

    reported = Reported()
    name = "robot: /video /camera → /viewer"
    assert shown("activating", Outcome.OK) == []
    undeclared = replace(measured("ok", ""), bounds=())
    assert shown("active", Outcome.OK, undeclared) == []
    late = measured("violated", "delay p99 7.2 ms > 5 ms")
    numbers = (("messages", "74"), ("lost", "1"), ("rate_hz", "14.800"), ("p50_ms", "0.500"))
    values = (*numbers, ("p99_ms", ""), ("max_delay_ms", "delay p99 7.2 ms > 5 ms"))
    assert shown("active", Outcome.OK, late) == [
        (ERROR, name, "violated: max_delay_ms", "us", values)
    ]
    for outcome, level in (("measuring", OK), ("ok", OK), ("unverifiable", WARN)):
        (entry,) = shown("measuring", Outcome.OK, measured(outcome, "delay"))
        assert entry[:3] == (level, name, outcome)
    assert [each[:3] for each in shown("paused", Outcome.OK)] == [
        (WARN, name, "not measured, the system is paused")
    ]
    assert [each[:3] for each in shown("active", Outcome.OK)] == [(OK, name, "not measured")]
    assert [each[:3] for each in shown("active", Outcome.VIOLATED)] == [
        (ERROR, name, "not measured")
    ]
