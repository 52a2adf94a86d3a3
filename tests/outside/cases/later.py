"""What a node of the system itself does after the gate, or a namesake: seen, named, and counted."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable

from tests.outside.case import NOBODY, REFUSED, VIOLATED, Case
from tests.outside.cases.identity import PAIR as TWO
from tests.outside.running import Run

PAIR = TWO % ""

CHANGES = {
    "changes.py": '''
import os

from nodes import Listener
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile, ReliabilityPolicy
from std_msgs.msg import String


class Plain(Node):
    """A node of rclpy, which we host; `later` runs once, after the gate."""

    def __init__(self, **options):
        super().__init__("talker", **options)
        self.out = self.create_publisher(String, "chatter", 10)
        self.create_timer(0.1, lambda: self.out and self.out.publish(String(data="hello")))
        self.once = self.create_timer(2.5, self.turn)

    def turn(self):
        self.once.cancel()
        self.later()


class Drops(Plain):
    def later(self):
        self.destroy_publisher(self.out)
        self.out = None


class Weakens(Plain):
    def later(self):
        self.destroy_publisher(self.out)
        self.out = self.create_publisher(
            String, "chatter", QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
        )


class Adds(Plain):
    def later(self):
        self.more = self.create_publisher(String, "more", 10)


class AddsNode(Plain):
    def later(self):
        self.second = Node("second")
        self.more = self.second.create_publisher(String, "chatter", 10)


class Sets(Plain):
    def __init__(self):
        super().__init__()
        self.declare_parameter("gain", 1.0)

    def later(self):
        self.set_parameters([Parameter("gain", value=2.0)])


class SetsAtOnce(Listener):
    def __init__(self, **options):
        super().__init__(**options)
        if not self.has_parameter("gain"):
            self.declare_parameter("gain", 1.0)

    def on_configure(self):
        self.set_parameters([Parameter("gain", value=2.0)])


class Ends(Plain):
    def later(self):
        os._exit(0)
'''
}


def changing(name: str, more: str = "") -> str:
    """The pair, whose talker is a plain node of `changes.py`."""
    return TWO.replace("nodes:Talker", f"changes:{name}") % f"    managed: false\n{more}"


def when_active(*words: str) -> Callable[[Run], None]:
    """A story: once all are active, a stranger comes and stays."""

    def story(run: Run) -> None:
        run.until_active()
        run.stranger(*words)

    return story


def stopped(run: Run) -> None:
    run.until_active()
    os.kill(run.pid_of("talker"), signal.SIGSTOP)
    run.until_says("run.silent-node")
    time.sleep(2.0)  # what lasts for more than 1 s counts
    os.kill(run.pid_of("talker"), signal.SIGCONT)


LONG = ("up", "--strict", "--stop-after", "5")


def row(what: str, name: str, finding: str, more: str = "") -> Case:
    """A plain node of ours does something once it is active."""
    return Case(
        attack=f"a node of ours {what} once it is active",
        manifest=changing(name, more),
        files=CHANGES,
        verb=LONG,
        exit_code=4,
        verdict=VIOLATED,
        findings=(finding,) if finding else (),
    )


CASES = (
    row("destroys its declared publisher", "Drops", "graph.missing-endpoint"),
    row("makes its publisher again with less than is declared", "Weakens", ""),
    row("makes a publisher that nobody declared", "Adds", "graph.undeclared-publisher"),
    row("makes another node in its process", "AddsNode", ""),
    row("sets a declared parameter by itself", "Sets", "", "    parameters: {gain: 1.0}"),
    Case(
        attack="a node of ours ends by itself with exit status 0",
        manifest=changing("Ends"),
        files=CHANGES,
        verb=LONG,
        exit_code=6,
        verdict=VIOLATED,
    ),
    Case(
        attack="a node sets a declared parameter in on_configure",
        findings=("param.value-differs",),
        manifest=TWO.replace("nodes:Listener", "changes:SetsAtOnce").replace(
            "    interface: {sub", "    parameters: {gain: 1.0}\n    interface: {sub"
        )
        % "",
        files=CHANGES,
        verb=("up", "--strict", "--stop-after", "2", "--timeout", "6"),
        **REFUSED,
    ),
    Case(
        attack="a stranger has the name of a declared node",
        manifest=PAIR,
        strangers=(("talker", "sub:/elsewhere"),),
        verb=("up", "--strict", "--stop-after", "2", "--timeout", "6"),
        exit_code=(4, 6),
        verdict=VIOLATED,
        activated=NOBODY,
    ),
    Case(
        attack="a namesake of a declared node publishes on its topic after the gate",
        manifest=PAIR,
        verb=("up", "--strict", "--stop-after", "3"),
        story=when_active("talker", "pub:/chatter"),
        exit_code=4,
        verdict=VIOLATED,
    ),
    Case(
        attack="a namesake of a declared node without endpoints comes after the gate",
        manifest=PAIR,
        verb=("up", "--strict", "--stop-after", "3"),
        story=when_active("talker"),
        exit_code=4,
        verdict=VIOLATED,
    ),
    Case(
        attack="a stranger in a hidden namespace publishes on a declared topic after the gate",
        manifest=PAIR,
        verb=("up", "--strict", "--stop-after", "3"),
        story=when_active("x", "pub:/chatter", "ns:/_hidden"),
        exit_code=4,
        verdict=VIOLATED,
    ),
    Case(
        attack="a node is stopped for a while by a signal",
        manifest=PAIR,
        verb=("up", "--strict", "--stop-after", "6"),
        story=stopped,
        exit_code=4,
    ),
)
