"""Callbacks that hang or take too long, and a supervisor that does not read what is reported."""

from __future__ import annotations

import signal
import time
from pathlib import Path

from tests.outside.case import NOBODY, OK, VIOLATED, Case
from tests.outside.running import Run

NODES = """\
import ctypes
import time
from pathlib import Path

from nodes import Marked, mark
from rclpy.node import Node
from std_msgs.msg import String
from std_srvs.srv import Trigger

from lifecycle import on_message, on_timer


def wait_for_the_sensor():
    time.sleep(60)


class Sleeper(Marked):
    @on_timer(period_s=1.0)
    def read_sensor(self):
        wait_for_the_sensor()


class Locked(Marked):
    @on_timer(period_s=1.0)
    def call_library(self):
        ctypes.PyDLL(None).sleep(60)  # with the interpreter's lock


class SlowListener(Marked):
    @on_message("chatter")
    def take(self, message):
        wait_for_the_sensor()


class Short(Marked):
    @on_timer(period_s=0.5)
    def read_sensor(self):
        time.sleep(0.2)


class Configures(Marked):
    def on_configure(self, state):
        wait_for_the_sensor()


class Constructs(Marked):
    def __init__(self, *arguments, **options):
        wait_for_the_sensor()


class Plain(Node):
    def __init__(self):
        super().__init__("sleeper")
        self.create_timer(1.0, self.poll_hardware)

    def poll_hardware(self):
        wait_for_the_sensor()


class Churning(Marked):
    made = late = None

    @on_timer(period_s=0.005)
    def turn(self):
        if self.late is not None:
            return
        if self.made is None and Path("quiet").exists():
            self.late = self.create_publisher(String, "/late", 1)
            mark("sleeper", "quiet")
            return
        mark("sleeper", "turn")
        if self.made is None:
            self.made = self.create_publisher(String, "/extra", 1)
        else:
            self.destroy_publisher(self.made)
            self.made = None
"""


def one(name: str, interface: str = "{}", more: str = "") -> str:
    """Return the manifest of one node."""
    return f"""\
manifest_version: 1
system: hangs
discovery: {{range: localhost}}
nodes:
  sleeper:
    run: {{python: "hanging:{name}"{more}}}
    interface: {interface}
"""


def message(run: Run) -> str:
    """Return what the report says of the node that is silent."""
    found = [each for each in run.result["findings"] if each["rule"] == "run.silent-node"]
    assert len(found) == 1, run.result
    return str(found[0]["message"])


def hang_on(run: Run) -> None:
    """Let it hang for some seconds: the report at the end says for how long."""
    run.until("silent", node="/sleeper")
    time.sleep(3.0)
    run.signal(signal.SIGINT)
    assert run.process is not None
    run.process.wait(30.0)
    seconds = float(message(run).rpartition(";")[2].split()[0])
    assert 3.0 <= seconds < 30.0, message(run)


def stop_the_supervisor(run: Run) -> None:
    run.until_active()
    run.wait(lambda: len(run.marks("sleeper", "turn")) > 20, "turns")
    run.signal(signal.SIGSTOP)
    time.sleep(4.0)
    before = len(run.marks("sleeper", "turn"))
    time.sleep(2.0)
    assert len(run.marks("sleeper", "turn")) > before + 20, "its callbacks wait"
    Path(run.directory, "quiet").touch()
    run.wait(lambda: bool(run.marks("sleeper", "quiet")), "quiet")
    run.signal(signal.SIGCONT)

    def is_newest() -> bool:
        verdicts = run.of_kind("verdict")
        found = verdicts[-1]["verdict"]["findings"] if verdicts else []
        return [each["subject"] for each in found] == ["/late"]

    run.wait(is_newest, "the newest state")
    run.signal(signal.SIGINT)


HANG = frozenset({"sleeper"})
FILES = {"hanging.py": NODES}

CASES = (
    Case(
        attack="a timer's callback hangs",
        manifest=one("Sleeper"),
        files=FILES,
        verb=("up", "--strict"),
        story=hang_on,
        exit_code=(4, 130),
        verdict=VIOLATED,
        findings=("run.silent-node",),
        activated=HANG,
        says=("of a timer of 1 s", "read_sensor (", "hanging.py:14", "wait_for_the_sensor ("),
        quick=True,
    ),
    Case(
        attack="a message's handler hangs",
        manifest=one(
            "SlowListener", "{subscriptions: [{name: chatter, type: std_msgs/msg/String}]}"
        )
        + """\
  talker:
    run: {python: "nodes:Talker"}
    interface: {publishers: [{name: chatter, type: std_msgs/msg/String}]}
""",
        files=FILES,
        verb=("up", "--strict"),
        story=hang_on,
        exit_code=(4, 130),
        verdict=VIOLATED,
        findings=("run.silent-node",),
        says=("of the subscription of /chatter", "take (", "hanging.py:14"),
    ),
    Case(
        attack="a callback hangs in a library with the interpreter's lock",
        manifest=one("Locked"),
        files=FILES,
        verb=("up", "--strict"),
        story=hang_on,
        exit_code=(4, 130),
        verdict=VIOLATED,
        findings=("run.silent-node",),
        says=("call_library (", "hanging.py:26"),
    ),
    Case(
        attack="a callback of a plain rclpy node hangs",
        manifest=one("Plain", "{}\n    managed: false"),
        files=FILES,
        verb=("up", "--strict"),
        story=hang_on,
        exit_code=(4, 130),
        verdict=VIOLATED,
        findings=("run.silent-node",),
        says=("poll_hardware (", "hanging.py:14"),
    ),
    Case(
        attack="a callback of a multi-threaded executor hangs",
        manifest=one("Sleeper", more=", executor: multi"),
        files=FILES,
        verb=("up", "--strict"),
        story=hang_on,
        exit_code=(4, 130),
        verdict=VIOLATED,
        findings=("run.silent-node",),
        says=("read_sensor (", "hanging.py:14"),
    ),
    Case(
        attack="on_configure takes longer than configure_s",
        manifest=one("Configures", "{}\n    timeouts: {configure_s: 1.5}"),
        files=FILES,
        exit_code=6,
        activated=NOBODY,
        says=("still configuring after 1.5 s", "on_configure (", "hanging.py:14"),
    ),
    Case(
        attack="a constructor takes longer than start_s",
        manifest=one("Constructs", "{}\n    timeouts: {start_s: 2}"),
        files=FILES,
        exit_code=6,
        activated=NOBODY,
        says=("still starting after 2 s", "__init__ (", "hanging.py:14"),
    ),
    Case(
        attack="callbacks are slow, and within silent_s",
        manifest=one("Short"),
        files=FILES,
        verb=("up", "--strict", "--stop-after", "3"),
        verdict=OK,
        not_findings=("run.silent-node",),
        activated=HANG,
    ),
    Case(
        attack="the supervisor is stopped while a node reports and reports",
        manifest=one("Churning"),
        files=FILES,
        verb=("up",),
        story=stop_the_supervisor,
        exit_code=(4, 130),
        activated=HANG,
        within_s=90.0,
    ),
)
