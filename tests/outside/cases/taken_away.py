"""What a system does when what watches it is taken away: its supervisor, or the fork server."""

from __future__ import annotations

import contextlib
import os
import signal
from pathlib import Path

from tests.outside.case import NOBODY, OK, UNVERIFIABLE, VIOLATED, Case
from tests.outside.running import Run

GONE_S = 15.0
"""Within which nothing of a run lives any more; on an idle machine it is less than a second."""

NODES = """\
import rclpy, sys
from rclpy.node import Node
from std_msgs.msg import String
from lifecycle import LifecycleNode, on_timer
from nodes import Marked, mark

class Chatty(Marked):
    @on_timer(period_s=0.01)
    def chat(self):
        print("x" * 80)
        self.publisher("chatter").publish(String(data="hello"))

    def on_deactivate(self):
        print("arms down")
        super().on_deactivate()

class Failing(LifecycleNode):
    def on_deactivate(self):
        mark(self.get_name(), "tried")
        raise RuntimeError("stuck")

class Plain(Node):
    def __init__(self, **rest):
        super().__init__("plain", **rest)

if __name__ == "__main__":
    rclpy.init()
    try:
        rclpy.spin(Node("command"))
    except KeyboardInterrupt:
        mark("command", "interrupted")
"""

SYSTEM = """\
manifest_version: 1
system: robot
discovery: {range: localhost}
nodes:
  talker:
    run: {python: "parts:Chatty"}
    interface: {publishers: [{name: chatter, type: std_msgs/msg/String}]}
  listener:
    run: {python: "nodes:Listener"}
    interface: {subscriptions: [{name: chatter, type: std_msgs/msg/String}]}
  failing: {run: {python: "parts:Failing"}}
  plain: {managed: false, run: {python: "parts:Plain"}}
  command: {managed: false, run: {command: [python3, parts.py]}}
"""

ATTACHED = """\
manifest_version: 1
system: robot
discovery: {range: localhost}
nodes:
  others:
    attach: true
    managed: false
    interface: {publishers: [{name: chatter, type: std_msgs/msg/String}]}
  listener:
    run: {python: "nodes:Listener"}
    interface: {subscriptions: [{name: chatter, type: std_msgs/msg/String}]}
"""


def _kill(run: Run) -> None:
    run.until_active()
    run.wait(lambda: len(run.marks("listener", "received")) > 2, "messages")
    run.signal(signal.SIGKILL)
    try:
        run.wait(lambda: run.processes() == [], "the end of all processes", timeout_s=GONE_S)
    finally:
        for each in run.processes():
            with contextlib.suppress(ProcessLookupError):
                os.kill(int(each.split()[0]), signal.SIGKILL)


def _supervisor_is_killed(run: Run) -> None:
    _kill(run)
    for node in ("talker", "listener"):
        assert len(run.marks(node, "deactivated")) == 1, run.marks()
    assert run.marks("failing", "tried")
    assert run.marks("command", "interrupted")
    (log,) = (run.directory / "log").glob("20*/talker.log")
    assert "arms down" in log.read_text()
    left = run.lifecycle("status", "robot")
    assert left.returncode == 2
    assert "none of its processes runs any more" in left.stderr
    assert run.lifecycle("down", "robot").returncode == 0


def _attached(run: Run) -> None:
    others = run.stranger("others", "pub:/chatter")
    _kill(run)
    assert others.poll() is None
    assert len(run.marks("listener", "deactivated")) == 1


def _fork_server_is_killed(run: Run) -> None:
    run.until_active()
    assert run.process is not None
    for each in run.processes():
        pid = int(each.split()[0])
        parent = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[1]
        if "fork_server_main" in each and int(parent) == run.process.pid:
            os.kill(pid, signal.SIGKILL)
            return
    raise AssertionError(run.processes())


def _down(run: Run) -> None:
    run.until_active()
    assert run.lifecycle("down", "robot").returncode == 0


LIMITED = """\
manifest_version: 1
system: robot
discovery: {range: localhost}
nodes:
  talker:
    run: {python: "parts:Chatty", resources: {memory_max_mib: 900}}
    interface: {publishers: [{name: chatter, type: std_msgs/msg/String}]}
  listener:
    run: {python: "nodes:Listener"}
    interface: {subscriptions: [{name: chatter, type: std_msgs/msg/String}]}
"""

PAIR = SYSTEM[: SYSTEM.index("  failing:")]
FILES = {"parts.py": NODES}

CASES = (
    Case(
        attack="the supervisor is killed: nodes deactivate and every process of the run ends",
        manifest=SYSTEM,
        files=FILES,
        verb=("up",),
        story=_supervisor_is_killed,
        exit_code=-signal.SIGKILL,
        activated=frozenset({"talker", "listener"}),
        quick=True,
    ),
    Case(
        attack="the supervisor is killed: nodes that others started are left as they are",
        manifest=ATTACHED,
        verb=("up",),
        story=_attached,
        exit_code=-signal.SIGKILL,
        activated=frozenset({"listener"}),
    ),
    Case(
        attack="the fork server is killed: the run fails, and nothing of it is left",
        manifest=PAIR,
        files=FILES,
        verb=("up",),
        story=_fork_server_is_killed,
        exit_code=6,
        verdict=VIOLATED,
        findings=("run.process-died",),
        says=("the fork server",),
    ),
    Case(
        attack="a system that is taken down in order deactivates as before",
        manifest=PAIR,
        files=FILES,
        verb=("up",),
        story=_down,
        verdict=OK,
        says=("lifecycle down",),
    ),
    Case(
        attack="a manifest that would keep nodes running without a supervisor is refused",
        manifest=PAIR.replace("system: robot", "system: robot\non_supervisor_lost: keep"),
        files=FILES,
        verb=("check",),
        exit_code=3,
        says=("system.lifecycle.yaml:3:1: on_supervisor_lost: cannot use",),
    ),
)

UNLIMITED = (
    Case(
        attack="limits of resources that nothing sets are unverifiable",
        manifest=LIMITED,
        files=FILES,
        verb=("up", "--stop-after", "1"),
        verdict=UNVERIFIABLE,
        findings=("declaration.unproven",),
        says=("systemd does not run here",),
        activated=frozenset({"talker", "listener"}),
    ),
    Case(
        attack="limits of resources that nothing sets are refused by --strict",
        manifest=LIMITED,
        files=FILES,
        verb=("up", "--strict", "--timeout", "8"),
        exit_code=5,
        verdict=UNVERIFIABLE,
        findings=("declaration.unproven",),
        activated=NOBODY,
    ),
    Case(
        attack="limits of resources that nothing sets pass --strict where the manifest trusts that",
        manifest=LIMITED + "policy: {trust: [declaration.unproven]}\n",
        files=FILES,
        verb=("up", "--strict", "--stop-after", "1", "--timeout", "8"),
        verdict=OK,
        findings=("declaration.unproven",),
        activated=frozenset({"talker", "listener"}),
    ),
)

if not Path("/run/systemd/system").is_dir():
    CASES += UNLIMITED
