"""What a supervisor offers in ROS: diagnostics, status and orders, as the policy allows."""

from __future__ import annotations

import asyncio
import dataclasses
import json
from pathlib import Path

from lifecycle.manifest import Policy, RosInterfaceAccess
from lifecycle.plan import Plan
from lifecycle.supervisor.control.ros_interface import ERROR, OK, STALE, WARN
from lifecycle.supervisor.health.liveliness import Cause
from tests.unit.supervisor.fakes import run
from tests.unit.supervisor.session_world import CHAIN, INTRUDED, SessionWorld

FULL = RosInterfaceAccess.FULL


def offering(access: RosInterfaceAccess, plan: Plan = CHAIN) -> Plan:
    return dataclasses.replace(plan, policy=Policy(ros_interface=access))


def test_it_is_off_by_default(tmp_path: Path) -> None:
    async def main() -> None:
        world = SessionWorld(CHAIN, tmp_path, stop_after_s=3.0)
        await world.run()
        assert world.graph.ros is None

    run(main())


def test_diagnostics_come_from_active_on_each_second_and_at_once_when_something_changed(
    tmp_path: Path,
) -> None:
    async def main() -> None:
        world = SessionWorld(offering(RosInterfaceAccess.READ_ONLY), tmp_path, stop_after_s=9.9)

        async def intrude() -> None:
            await world.story.until("[gate]")
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

        await world.run(intrude())
        assert world.graph.ros is not None
        assert world.graph.ros.destroyed
        assert json.loads(world.graph.ros.statuses[-1])["phase"] == "stopping"

    run(main())


def test_services_give_the_orders_of_the_control_socket(tmp_path: Path) -> None:
    async def main() -> None:
        world = SessionWorld(offering(FULL), tmp_path)

        async def order() -> None:
            await world.story.until("[system] active")
            await asyncio.sleep(0.1)
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

        await world.run(order())
        assert "the down service" in world.report

    run(main())


def test_a_node_that_is_silent_is_stale(tmp_path: Path) -> None:
    async def main() -> None:
        world = SessionWorld(offering(FULL), tmp_path, stop_after_s=5.0)

        async def hush() -> None:
            await world.story.until("[system] active")
            world.system.liveliness.fell_silent(["/camera"], Cause.STOPPED, "pid 7")
            await asyncio.sleep(1.1)
            assert world.graph.ros is not None
            assert world.graph.ros.diagnostics[-1][0][0] == STALE

        await world.run(hush())

    run(main())
