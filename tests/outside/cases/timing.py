"""When things happen: violations that last or pass, a supervisor that stands still, latecomers."""

from __future__ import annotations

import os
import signal
import time

from tests.outside.case import NOBODY, OK, REFUSED, VIOLATED, Case
from tests.outside.running import Run

_PAIR = """\
manifest_version: 1
system: timing
discovery: {{range: localhost}}
{more}nodes:
  talker:
    run: {{python: "nodes:Talker"}}
    interface: {{publishers: [{{name: chatter, type: std_msgs/msg/String}}]}}
  listener:
    run: {{python: "{listener}", environment: {{SLOW: "{slow}"}}}}
    timeouts: {{silent_s: 30}}
    interface: {{subscriptions: [{{name: chatter, type: std_msgs/msg/String}}]}}
"""
PAIR = _PAIR.format(more="", listener="nodes:Listener", slow=0)
SLOW = {
    "slow.py": """\
import os
import time

import rclpy
from nodes import Listener
from std_msgs.msg import String


class Configures(Listener):
    def on_configure(self):
        time.sleep(float(os.environ["SLOW"]))


class Connects(Listener):
    def on_connect(self):
        time.sleep(float(os.environ["SLOW"]))


class Smuggles(Listener):
    def on_configure(self):
        time.sleep(float(os.environ["SLOW"]))
        self.context_of_its_own = rclpy.Context()
        self.context_of_its_own.init()
        self.smuggler = rclpy.create_node("smuggler", context=self.context_of_its_own)
        self.smuggled = self.smuggler.create_publisher(String, "chatter", 10)
        time.sleep(1.2)
"""
}
LATE_S = 4.0
"""What a slow node takes: the supervisor announces itself often in its first two seconds only."""


def slow(listener: str, seconds: float = LATE_S) -> str:
    """The pair, with a listener of `slow.py`."""
    return _PAIR.format(more="", listener=f"slow:{listener}", slow=seconds)


TOLERANT = _PAIR.format(
    more="policy: {tolerated_nodes: [/tool]}\n", listener="nodes:Listener", slow=0
)
TOOL = ("tool", "sub:/tool_a", "churn:0.12")


LONG_ENOUGH = ("up", "--strict", "--stop-after", "20")
"""For four visits on a busy machine, on which a program takes three seconds to start."""

_WRONG = '"stage":"active","verdict":{"verdict":"violated"'
_NAMED = '"rule":"graph.undeclared-node"'


def visit(run: Run, seconds: float) -> None:
    """Have a stranger on /chatter for so long."""
    run.stranger("stranger", "pub:/chatter", f"for:{seconds}")


def glance(run: Run, name: str = "stranger") -> None:
    """Have a stranger on /chatter until it is noticed, and no longer."""
    before = run.output.count(_NAMED)
    stranger = run.stranger(name, "pub:/chatter")
    run.wait(lambda: run.output.count(_NAMED) > before, "it is noticed by its name")
    stranger.terminate()
    stranger.wait()


def lasting(run: Run) -> None:
    run.until_active()
    visit(run, 3.0)


def brief(run: Run) -> None:
    run.until_active()
    glance(run)


def flapping(run: Run) -> None:
    run.until_active()
    for _ in range(4):
        glance(run)
        time.sleep(0.6)


def taking_turns(run: Run) -> None:
    run.until_active()
    for number in range(4):
        glance(run, f"stranger_{number}")


def in_the_end(run: Run) -> None:
    run.until_active()
    time.sleep(1.5)
    visit(run, 9.0)


def then_down(run: Run) -> None:
    lasting(run)
    run.wait(lambda: _WRONG in run.output, "it is noticed")
    time.sleep(3.0)
    assert run.lifecycle("down", "{}").returncode == 0


def across_a_restart(run: Run) -> None:
    run.until_active()
    run.stranger("stranger", "pub:/chatter", "for:3.0", wait=False)
    time.sleep(0.3)
    run.lifecycle("restart", "{}", "talker")


def restart_of_a_slow_node(run: Run) -> None:
    run.until_active()
    assert run.lifecycle("restart", "{}", "listener").returncode == 0


def _still(run: Run, seconds: float, *, stranger: bool = True) -> None:
    """Stop the supervisor while a stranger comes, and have it go on."""
    run.signal(signal.SIGSTOP)
    try:
        if stranger:
            run.stranger("stranger", "pub:/chatter")
        time.sleep(seconds)
    finally:
        run.signal(signal.SIGCONT)


def still_before_the_gate(run: Run) -> None:
    run.until("node", node="/talker", reach="connected")
    time.sleep(0.5)
    _still(run, LATE_S)


def nothing_comes_meanwhile(run: Run) -> None:
    run.until("node", node="/talker", reach="connected")
    time.sleep(0.5)
    _still(run, LATE_S, stranger=False)


def still_in_a_restart(run: Run) -> None:
    run.until_active()
    before = len(run.of_kind("process", process="listener", state="running"))
    pid = os.fork()
    if pid == 0:
        run.lifecycle("restart", "{}", "listener")
        os._exit(0)
    run.wait(
        lambda: len(run.of_kind("process", process="listener", state="running")) > before,
        "the listener is started again",
    )
    time.sleep(1.0)
    _still(run, LATE_S)
    os.waitpid(pid, 0)


def still_in_a_resume(run: Run) -> None:
    """A stranger comes while the paused system is resumed, and the supervisor does not run."""
    run.until_active()
    assert run.lifecycle("pause", "{}").returncode == 0
    run.signal(signal.SIGSTOP)
    run.stranger("stranger", "pub:/chatter")
    pid = os.fork()
    if pid == 0:
        run.lifecycle("resume", "{}")  # waits for the supervisor
        os._exit(0)
    time.sleep(1.0)
    run.signal(signal.SIGCONT)
    os.waitpid(pid, 0)


def late(run: Run) -> None:
    """A stranger comes 1.3 s before the gate would open."""
    run.until("node", node="/talker", reach="connected")
    time.sleep(LATE_S - 1.5)
    run.stranger("stranger", "pub:/chatter")


NOT_COUNTED = "and not counted: "
STAYS_8 = ("up", "--strict", "--stop-after", "8")
NOTICED = {**REFUSED, "findings": ("graph.undeclared-node",), "received": NOBODY}
STRICT_12 = ("up", "--strict", "--stop-after", "2", "--timeout", "12")

CASES = (
    Case(
        attack="a stranger publishes for 3 s while a tolerated tool makes and destroys endpoints",
        manifest=TOLERANT,
        verb=STAYS_8,
        strangers=(TOOL,),
        story=lasting,
        exit_code=4,
        says=("violated meanwhile", "/stranger (graph.undeclared-node)"),
    ),
    Case(
        attack="a tolerated tool makes and destroys endpoints, and nothing is wrong",
        manifest=TOLERANT,
        verb=("up", "--strict", "--stop-after", "3"),
        strangers=(TOOL,),
        verdict=OK,
        not_says=(NOT_COUNTED,),
    ),
    Case(
        attack="a stranger publishes for a moment: said, not counted",
        manifest=TOLERANT,
        verb=STAYS_8,
        story=brief,
        says=(NOT_COUNTED, "/stranger (graph.undeclared-node)"),
    ),
    Case(
        attack="a stranger comes and goes again and again, never for a second",
        manifest=PAIR,
        verb=LONG_ENOUGH,
        story=flapping,
        says=(NOT_COUNTED, "/stranger (graph.undeclared-node)"),
    ),
    Case(
        attack="strangers relieve each other, none for a second",
        manifest=PAIR,
        verb=LONG_ENOUGH,
        story=taking_turns,
        says=(NOT_COUNTED, "/stranger_0 (graph.undeclared-node)"),
    ),
    Case(
        attack="a stranger publishes when the time of --stop-after is over",
        manifest=PAIR,
        verb=("up", "--strict", "--stop-after", "6"),
        story=in_the_end,
        exit_code=4,
        verdict=VIOLATED,
    ),
    Case(
        attack="a violation that lasted and is over is said by a run that is ended by `down`",
        manifest=PAIR,
        verb=("up", "--strict"),
        story=then_down,
        says=("violated meanwhile",),
    ),
    Case(
        attack="a stranger publishes while a node is restarted by hand",
        manifest=PAIR,
        verb=("up", "--strict", "--stop-after", "9"),
        story=across_a_restart,
        exit_code=4,
    ),
    Case(
        attack="a slow node is restarted by hand, and nothing is wrong",
        manifest=slow("Configures", 2.0),
        files=SLOW,
        verb=("up", "--strict", "--stop-after", "6"),
        story=restart_of_a_slow_node,
        verdict=OK,
        not_says=(NOT_COUNTED,),
    ),
    Case(
        attack="the supervisor is stopped before its gate while a stranger comes",
        manifest=slow("Configures"),
        files=SLOW,
        verb=STRICT_12,
        story=still_before_the_gate,
        **NOTICED,
    ),
    Case(
        attack="the supervisor is stopped while a slow node connects and a stranger comes",
        manifest=slow("Connects"),
        files=SLOW,
        verb=STRICT_12,
        story=still_before_the_gate,
        **NOTICED,
    ),
    Case(
        attack="the supervisor is stopped before its gate, and nothing comes meanwhile",
        manifest=slow("Configures"),
        files=SLOW,
        story=nothing_comes_meanwhile,
        verdict=OK,
        activated=frozenset({"talker", "listener"}),
    ),
    Case(
        attack="the supervisor is stopped in a restart while a stranger comes",
        manifest=slow("Configures"),
        files=SLOW,
        verb=("up", "--strict", "--stop-after", "16", "--timeout", "12"),
        story=still_in_a_restart,
        exit_code=4,
        verdict=VIOLATED,
        findings=("graph.undeclared-node",),
    ),
    Case(
        attack="the supervisor is stopped in a pause, a stranger comes, and it is to resume",
        manifest=PAIR,
        verb=("up", "--strict", "--stop-after", "12", "--timeout", "5"),
        story=still_in_a_resume,
        exit_code=4,
        verdict=VIOLATED,
        findings=("graph.undeclared-node",),
        received=frozenset({"hello"}),
    ),
    Case(
        attack="a stranger comes shortly before the gate, long after the supervisor",
        manifest=slow("Configures"),
        files=SLOW,
        verb=STRICT_12,
        story=late,
        **NOTICED,
    ),
    Case(
        attack="a declared node opens another participant in on_configure",
        manifest=slow("Smuggles", 2.5),
        files=SLOW,
        verb=STRICT_12,
        findings=("graph.undeclared-node",),
        **REFUSED,
    ),
)
