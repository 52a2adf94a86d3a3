"""Nodes of the tests of what is measured: a source and a sink whose faults a file switches on."""

from __future__ import annotations

import os
import time
from pathlib import Path

import rclpy.node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from std_msgs.msg import UInt64

from lifecycle import LifecycleNode, on_message

HERTZ = 100.0
BUSY_S = 0.03
"""For so long a busy sink blocks its executor, ..."""

EVERY_S = 0.1
"""... so often: of its messages far more than one in a hundred begin late."""


def fault() -> str:
    """What is wrong at this moment; empty for nothing."""
    return Path(os.environ["FAULT"]).read_text(encoding="utf-8").strip()


class Source(LifecycleNode):
    """Publishes numbers at HERTZ, at half of that while it is slow, or nothing while silent."""

    def on_configure(self, state):
        self._number = 0
        self.create_timer(1 / HERTZ, self._tick)

    def _tick(self) -> None:
        self._number += 1
        wrong = fault()
        if wrong == "silent" or (wrong == "slow" and self._number % 2):
            return
        self.publisher("numbers").publish(UInt64(data=self._number))


def block() -> None:
    """Block the executor of a sink while it is to be busy."""
    if fault() == "busy":
        time.sleep(BUSY_S)


class Sink(LifecycleNode):
    """Takes numbers; while busy its callbacks begin late, and while lossy many are lost."""

    def on_configure(self, state):
        self.create_timer(EVERY_S, block)

    @on_message("numbers")
    def take(self, message: UInt64) -> None:
        if fault() == "lossy":
            time.sleep(0.05)


class Informed(LifecycleNode):
    """Takes the message info, too."""

    @on_message("numbers")
    def take(self, message: UInt64, info: dict[str, int]) -> None:
        pass


def qos() -> QoSProfile:
    """Of plain nodes, RELIABLE or not as their environment says."""
    reliability = ReliabilityPolicy[os.environ.get("RELIABILITY", "BEST_EFFORT")]
    return QoSProfile(depth=5, reliability=reliability)


class PlainSink(rclpy.node.Node):
    """Likewise, a node that knows nothing of a lifecycle."""

    def __init__(self) -> None:
        super().__init__("sink")
        self.create_subscription(UInt64, "numbers", self._take, qos())
        self.create_timer(EVERY_S, block)

    def _take(self, message: UInt64) -> None:
        if fault() == "lossy":
            time.sleep(0.05)


class PlainSource(rclpy.node.Node):
    """Publishes numbers at HERTZ."""

    def __init__(self) -> None:
        super().__init__("source")
        self._publisher = self.create_publisher(UInt64, "numbers", qos())
        self.create_timer(1 / HERTZ, lambda: self._publisher.publish(UInt64()))


def main(kind: str = "PlainSink") -> None:
    """Run a plain node as a program of its own."""
    rclpy.init()
    rclpy.spin(globals()[kind]())
