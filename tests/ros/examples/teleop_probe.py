"""Looks at the running teleop system from outside and prints what it sees as one JSON object.

Its node is named as the ros2 command line names its own, so that the system tolerates it.
"""

from __future__ import annotations

import gc
import json
import os
import sys
import time
from collections.abc import Callable

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from nav_msgs.msg import Odometry
from rclpy.node import Node
from sensor_msgs.msg import BatteryState
from std_srvs.srv import SetBool, Trigger

LIMIT_S = 30.0
START_X_M = -2.0  # it drives along +x


def _is_of_supervisor(message: DiagnosticArray) -> bool:
    return all(each.name.startswith("teleop: ") for each in message.status)


class Probe:
    """Polls by spinning; every wait is bounded."""

    def __init__(self) -> None:
        self.node = Node("_ros2cli_teleop_probe")
        self.latest: dict[str, object] = {}
        for topic, type_ in (
            ("/robot/odometry", Odometry),
            ("/robot/battery", BatteryState),
            ("/diagnostics", DiagnosticArray),
        ):
            self.node.create_subscription(type_, topic, self._keep(topic), 10)
        self._status = self.node.create_client(Trigger, "/operator/station/status")
        self.stop = self.node.create_client(SetBool, "/operator/station/stop")

    def _keep(self, topic: str) -> Callable[[object], None]:
        def keep(message: object) -> None:
            # What the supervisor says of the system is not what its health monitor says of topics.
            if not (isinstance(message, DiagnosticArray) and _is_of_supervisor(message)):
                self.latest[topic] = message

        return keep

    def until(self, what: str, true: Callable[[], object]) -> None:
        deadline = time.monotonic() + LIMIT_S
        while not true():
            if time.monotonic() >= deadline:
                sys.exit(f"still waiting for {what} after {LIMIT_S} s; saw {list(self.latest)}")
            rclpy.spin_once(self.node, timeout_sec=0.05)

    def call(self, client: object, request: object) -> object:
        """Call with retries: a first reply may be lost while the two find each other."""
        self.until("the service", client.service_is_ready)
        for _ in range(10):
            future = client.call_async(request)
            deadline = time.monotonic() + 2.0
            while not future.done() and time.monotonic() < deadline:
                rclpy.spin_once(self.node, timeout_sec=0.05)
            if future.done():
                return future.result()
        sys.exit("no answer from the service")

    def status(self) -> dict[str, object]:
        answer = self.call(self._status, Trigger.Request())
        return {"success": answer.success, **json.loads(answer.message)}

    def speed_mps(self) -> float:
        odometry = self.latest.get("/robot/odometry")
        return odometry.twist.twist.linear.x if odometry else 0.0


def look(probe: Probe) -> dict[str, object]:
    """Wait until the system works, note what can be seen, stop the robot."""
    probe.until("every topic", lambda: len(probe.latest) == 3)
    probe.until("the robot to drive", lambda: probe.speed_mps() > 0.3)
    status: dict[str, object] = {}

    def is_well() -> bool:
        status.update(probe.status())
        return status["frames"] >= 10 and status["video_hz"] > 5 and status["x_m"] > START_X_M

    probe.until("ten frames and more than five a second", is_well)
    battery = probe.latest["/robot/battery"]
    probe.until(
        "healthy diagnostics",
        lambda: all(each.level == b"\0" for each in probe.latest["/diagnostics"].status),
    )
    diagnosed = sorted(each.name for each in probe.latest["/diagnostics"].status)
    answer = probe.call(probe.stop, SetBool.Request(data=True))
    probe.until("the robot to stand", lambda: probe.speed_mps() == 0.0)
    return {
        "status": status,
        "battery": {
            "percentage": battery.percentage,
            "voltage": battery.voltage,
            "current": battery.current,
        },
        "diagnosed": diagnosed,
        "stopped": [answer.success, answer.message],
    }


def main() -> None:
    rclpy.init()
    probe = Probe()
    print(json.dumps(look(probe)), flush=True)
    probe.node.destroy_node()
    rclpy.shutdown()
    del probe
    gc.collect()
    os._exit(0)


if __name__ == "__main__":
    main()
