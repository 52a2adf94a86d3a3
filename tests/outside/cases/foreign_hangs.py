"""Nodes that are not in our hosts and hang before the gate: it asks them first."""

from __future__ import annotations

from tests.outside.case import NOBODY, OK, UNVERIFIABLE, Case

STILL = {
    "still.py": '''\
"""A node that nobody spins, or not from the start."""

import os
import time

import rclpy
from rclpy.lifecycle import LifecycleNode
from rclpy.node import Node

managed = os.environ.get("MANAGED") == "yes"
rclpy.init()
node = (LifecycleNode if managed else Node)(
    "base", start_parameter_services=os.environ.get("SERVES") != "no"
)
try:
    time.sleep(float(os.environ["STILL_S"]))
    rclpy.spin(node)
except (KeyboardInterrupt, rclpy.executors.ExternalShutdownException):
    pass
''',
    "configured.py": '''\
"""A managed node that hangs once it is configured."""

import time

import rclpy
from rclpy.lifecycle import LifecycleNode, TransitionCallbackReturn


class Configured(LifecycleNode):
    def on_configure(self, state):
        self.create_timer(0.0, lambda: time.sleep(60))
        return TransitionCallbackReturn.SUCCESS


rclpy.init()
try:
    rclpy.spin(Configured("base"))
except (KeyboardInterrupt, rclpy.executors.ExternalShutdownException):
    pass
''',
}


def still(still_s: float, *, serves: bool = True, managed: bool = False, more: str = "") -> str:
    """A node of a command that nobody spins for so long."""
    return f"""\
manifest_version: 1
system: still
discovery: {{range: localhost}}
policy: {{unpublished: ignore{more}}}
nodes:
  base:
    run:
      command: [python3, still.py]
      environment: {{STILL_S: "{still_s:g}", SERVES: "{"" if serves else "no"}",
                     MANAGED: "{"yes" if managed else ""}"}}
    managed: {str(managed).lower()}
    timeouts: {{start_s: 4}}
  listener:
    run: {{python: "nodes:Listener"}}
    interface: {{subscriptions: [{{name: chatter, type: std_msgs/msg/String}}]}}
"""


CONFIGURED = """\
manifest_version: 1
system: configured
discovery: {range: localhost}
policy: {unpublished: ignore}
nodes:
  base:
    run: {command: [python3, configured.py]}
    managed: true
  listener:
    run: {python: "nodes:Listener"}
    interface: {subscriptions: [{name: chatter, type: std_msgs/msg/String}]}
"""

LISTENER = frozenset({"listener"})
NOT_SEEN = "'/base' serves no parameters: whether it hangs is not seen"

CASES = (
    Case(
        attack="a plain node of a command is never spun",
        manifest=still(60.0),
        files=STILL,
        verdict=UNVERIFIABLE,
        exit_code=5,
        findings=("run.not-answering",),
        activated=NOBODY,
        within_s=30.0,
    ),
    Case(
        attack="a plain node of a command is never spun, and that is no reason to wait",
        manifest=still(60.0),
        files=STILL,
        verb=("up", "--stop-after", "1"),
        verdict=UNVERIFIABLE,
        findings=("run.not-answering",),
        activated=LISTENER,
        within_s=30.0,
    ),
    Case(
        attack="a plain node of a command is never spun, and its hang is taken on trust",
        manifest=still(60.0, more=", trust: [run.not-answering]"),
        files=STILL,
        verdict=OK,
        findings=("run.not-answering",),
        activated=LISTENER,
        within_s=30.0,
    ),
    Case(
        attack="a plain node of a command is never spun and serves no parameters",
        manifest=still(60.0, serves=False),
        files=STILL,
        verb=("up", "--strict", "--stop-after", "1"),
        verdict=OK,
        not_findings=("run.not-answering",),
        says=(NOT_SEEN,),
        activated=LISTENER,
        within_s=20.0,
    ),
    Case(
        attack="a plain node of a command is spun 2 s after it was made",
        manifest=still(2.0),
        files=STILL,
        verdict=OK,
        not_says=("run.not-answering",),
        activated=LISTENER,
    ),
    Case(
        attack="a managed node of a command is never spun",
        manifest=still(60.0, managed=True),
        files=STILL,
        exit_code=6,
        activated=NOBODY,
        within_s=30.0,
    ),
    Case(
        attack="a managed node of a command hangs once it is configured",
        manifest=CONFIGURED,
        files=STILL,
        exit_code=(5, 6),  # it hangs before its state is read again, or behind that
        says=("/base",),
        activated=NOBODY,
        within_s=40.0,
    ),
)
