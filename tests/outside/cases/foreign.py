"""Nodes that are not in our hosts: they drive themselves, hang, change, and say what is untrue."""

from __future__ import annotations

import time

from tests.outside.case import NOBODY, OK, VIOLATED, Case
from tests.outside.running import Run

EAGER = {
    "eager.py": '''\
"""A managed node of rclpy's that activates itself."""

import os
import time
from pathlib import Path

import rclpy
from rclpy.lifecycle import LifecycleNode, TransitionCallbackReturn


class Eager(LifecycleNode):
    def __init__(self):
        super().__init__("base")
        self.delay_s = float(os.environ["DELAY"])
        self.after = os.environ["AFTER"]
        self.left = int(os.environ["TIMES"])
        if self.after == "start":
            self.soon(self.up)

    def soon(self, what):
        def once():
            self.destroy_timer(timer)
            what()

        timer = self.create_timer(self.delay_s, once)

    def up(self):
        try:
            self.trigger_configure()
        except Exception as error:
            print("not configured:", error, flush=True)
        self.act()

    def act(self):
        if self.left:
            self.left -= 1
            try:
                self.trigger_activate()
            except Exception as error:
                print("not activated:", error, flush=True)

    def mark(self, what):
        with Path(os.environ["OUTSIDE"], "marks").open("a") as file:
            file.write(f"{time.time():.3f} base {what}\\n")

    def on_configure(self, state):
        if self.after == "configure":
            self.soon(self.act)
        return TransitionCallbackReturn.SUCCESS

    def on_activate(self, state):
        self.mark("activated")
        return super().on_activate(state)

    def on_deactivate(self, state):
        self.mark("deactivated")
        if self.left:
            self.soon(self.act)
        return super().on_deactivate(state)


rclpy.init()
try:
    rclpy.spin(Eager())
except (KeyboardInterrupt, rclpy.executors.ExternalShutdownException):
    pass
'''
}


def eager(delay_s: float, *, after: str, times: int = 1) -> str:
    """A node that activates itself so long after its start, or its configure, so many times."""
    return f"""\
manifest_version: 1
system: eager
discovery: {{range: localhost}}
policy: {{unpublished: ignore}}
nodes:
  base:
    run:
      command: [python3, eager.py]
      environment: {{DELAY: "{delay_s}", AFTER: {after}, TIMES: "{times}"}}
    managed: true
  listener:
    run: {{python: "nodes:Listener"}}
    interface: {{subscriptions: [{{name: chatter, type: std_msgs/msg/String}}]}}
"""


HANGING = {
    "hang.py": """\
import os
import time

import rclpy
from rclpy.lifecycle import LifecycleNode
from rclpy.node import Node

managed = os.environ.get("MANAGED") == "yes"
base = LifecycleNode if managed else Node


class Hang(base):
    def __init__(self):
        super().__init__("base", start_parameter_services=os.environ.get("SERVES") != "no")
        self.began = time.monotonic()
        self.timer = self.create_timer(0.2, self.work)

    def work(self):
        hang_s = float(os.environ["HANG"])
        if hang_s and time.monotonic() - self.began > float(os.environ["BEGINS"]):
            time.sleep(hang_s)
            self.began = time.monotonic() + float(os.environ.get("PAUSE", "1000"))


rclpy.init()
try:
    rclpy.spin(Hang())
except (KeyboardInterrupt, rclpy.executors.ExternalShutdownException):
    pass
"""
}


def hanging(hang_s: float, *, managed: bool = False, serves: bool = True) -> str:
    """A node of which one callback sleeps for so long, beginning 1.5 s after it was made."""
    return f"""\
manifest_version: 1
system: hanging
discovery: {{range: localhost}}
policy: {{unpublished: ignore}}
nodes:
  base:
    run:
      command: [python3, hang.py]
      environment:
        HANG: "{hang_s:g}"
        BEGINS: "1.5"
        MANAGED: "{"yes" if managed else ""}"
        SERVES: "{"" if serves else "no"}"
    managed: {str(managed).lower()}
  listener:
    run: {{python: "nodes:Listener"}}
    interface: {{subscriptions: [{{name: chatter, type: std_msgs/msg/String}}]}}
"""


def noticed(run: Run) -> None:
    """Wait until the verdict names the node, no longer than 10 s from when it hangs."""
    run.until_active()
    run.until_says(r'"rule":"run\.not-answering"', timeout_s=12.0)


def noticed_and_healed(run: Run) -> None:
    """Wait for the finding, and for its end."""
    noticed(run)
    run.until_says(r"'/base' answers again", timeout_s=12.0)


def verify_beside_a_hang(run: Run) -> None:
    """Ask for a verdict from outside while the node hangs."""
    run.until_active()
    time.sleep(2.0)
    beside = run.lifecycle("verify", "{}", "--strict")
    assert beside.returncode == 5, beside.stdout + beside.stderr
    assert "run.not-answering" in beside.stdout, beside.stdout


SHIFTY = {
    "shifty.py": '''\
import os

import rclpy
from rclpy.lifecycle import LifecycleNode, TransitionCallbackReturn
from rclpy.parameter import Parameter


class Shifty(LifecycleNode):
    """Changes its gain, or undeclares it, and publishes no event of that."""

    def __init__(self):
        super().__init__("base")
        self.declare_parameter("gain", 2.0)
        if os.environ["AFTER_S"]:
            self.timer = self.create_timer(float(os.environ["AFTER_S"]), self.shift)

    def on_configure(self, state):
        if not os.environ["AFTER_S"]:
            self.shift()
        return TransitionCallbackReturn.SUCCESS

    def shift(self):
        how = os.environ["HOW"]
        if how == "change":
            self._parameters["gain"] = Parameter("gain", value=3.0)
        elif how == "undeclare" and self.has_parameter("gain"):
            del self._parameters["gain"]


rclpy.init()
try:
    rclpy.spin(Shifty())
except (KeyboardInterrupt, rclpy.executors.ExternalShutdownException):
    pass
'''
}


def shifty(how: str) -> str:
    """A node that changes, or undeclares, its parameter in on_configure; or does not."""
    return f"""\
manifest_version: 1
system: shifty
discovery: {{range: localhost}}
policy: {{unpublished: ignore}}
nodes:
  base:
    run: {{command: [python3, shifty.py], environment: {{HOW: {how}, AFTER_S: ""}}}}
    managed: true
    parameters: {{gain: 2.0}}
  listener:
    run: {{python: "nodes:Listener"}}
    interface: {{subscriptions: [{{name: chatter, type: std_msgs/msg/String}}]}}
"""


CASES = (
    *(
        Case(
            attack=f"a managed node activates itself {delay_s:g} s after its {after}",
            manifest=eager(delay_s, after=after),
            files=EAGER,
            verb=("up", "--strict", "--stop-after", "1"),
            verdict=OK,
            activated=frozenset({"base", "listener"}),
            quick=(delay_s, after) == (0.01, "start"),
        )
        for after, delay_s in (
            ("start", 0.01),
            ("start", 0.1),
            ("start", 0.5),
            ("configure", 0.03),
            ("configure", 0.2),
        )
    ),
    *(
        Case(
            attack=f"a managed node activates itself again, {times - 1} times at once",
            manifest=eager(0.0, after="start", times=times),
            files=EAGER,
            verb=("up", "--strict", "--stop-after", "1"),
            verdict=OK,
            activated=frozenset({"base", "listener"}),
        )
        for times in (2, 3)
    ),
    Case(
        attack="a managed node activates itself each time that it is deactivated",
        manifest=eager(0.01, after="start", times=1000),
        files=EAGER,
        verb=("up", "--strict", "--stop-after", "1"),
        exit_code=(4, 6),
        not_says=("--adopt",),
        says=("remove trigger_activate or change_state from its code",),
        within_s=15.0,
    ),
    *(
        Case(
            attack=f"a {'managed' if managed else 'plain'} node of a command hangs in a callback",
            manifest=hanging(9.0, managed=managed),
            files=HANGING,
            verb=("up", "--strict", "--stop-after", "16"),
            story=noticed_and_healed,
            exit_code=(0, 4, 5),
        )
        for managed in (False, True)
    ),
    *(
        Case(
            attack=f"verify is asked while a {'managed' if managed else 'plain'} node hangs",
            manifest=hanging(20.0, managed=managed),
            files=HANGING,
            verb=("up", "--stop-after", "12"),
            story=verify_beside_a_hang,
            exit_code=(0, 4, 5),
            findings=("run.not-answering",),
        )
        for managed in (False, True)
    ),
    *(
        Case(
            attack=f"a {'managed' if managed else 'plain'} node of a command is busy for 2 s",
            manifest=hanging(2.0, managed=managed),
            files=HANGING,
            verb=("up", "--strict", "--stop-after", "6"),
            verdict=OK,
            not_says=("run.not-answering",),
        )
        for managed in (False, True)
    ),
    Case(
        attack="a plain node of a command serves no parameters",
        manifest=hanging(0.0, serves=False),
        files=HANGING,
        verb=("up", "--strict", "--stop-after", "12"),
        verdict=OK,
        says=("'/base' serves no parameters: whether it hangs is not seen",),
        not_says=("run.not-answering",),
    ),
    *(
        Case(
            attack=f"a managed node would {how} a parameter in on_configure without an event",
            manifest=shifty(how),
            files=SHIFTY,
            verb=("up", "--strict", "--stop-after", "1", "--timeout", "6"),
            exit_code=0 if how == "keep" else 4,
            verdict=OK if how == "keep" else VIOLATED,
            findings=() if how == "keep" else (rule,),
            activated=frozenset({"listener"}) if how == "keep" else NOBODY,
        )
        for how, rule in (
            ("change", "param.value-differs"),
            ("undeclare", "param.missing"),
            ("keep", ""),
        )
    ),
)
