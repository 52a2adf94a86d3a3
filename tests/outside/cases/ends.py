"""Processes that end: what they leave behind, deaths on the way down, and what is said of them."""

from __future__ import annotations

import contextlib
import os
import signal
import threading
import time
from pathlib import Path

from tests.outside.case import OK, VIOLATED, Case
from tests.outside.running import Run

DIED = "run.process-died"
FELL = {"exit_code": 6, "verdict": VIOLATED, "findings": (DIED,)}

CHILD = """\
import rclpy, signal, sys
from std_msgs.msg import String
from nodes import mark
rclpy.init()
if "stubborn" in sys.argv:
    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
node = rclpy.create_node("child")
publisher = node.create_publisher(String, "chatter", 10)
node.create_timer(0.1, lambda: publisher.publish(String(data="hello")))
import os
mark("child", f"pid {os.getpid()}")
rclpy.spin(node)
"""

CHATTY = """\
import threading, time
def chat():
    while True:
        print("x" * 80, flush=True)
        time.sleep(0.005)
threading.Thread(target=chat, daemon=True).start()
"""

COMMAND = """\
manifest_version: 1
system: kids
discovery: {{range: localhost}}
nodes:
  child:
    managed: false
    run: {{command: [sh, w.sh]}}
    restart: on-failure
    interface: {{publishers: [{{name: chatter, type: std_msgs/msg/String}}]}}
  listener:
    run: {{python: "nodes:Listener"}}
    interface: {{subscriptions: [{{name: chatter, type: std_msgs/msg/String}}]}}
"""

ENDING = """\
import ctypes, os, signal, subprocess, sys, time
from lifecycle import LifecycleNode, on_timer
from nodes import mark
{body}
"""

PAIR = """\
manifest_version: 1
system: ends
discovery: {range: localhost}
nodes:
  one: {run: {python: "ending:One"}}
  two: {run: {python: "ending:Two"}}
"""

QUIET = "class Two(LifecycleNode): pass\n"


def _dies(handler: str, how: str, others: str = QUIET) -> dict[str, str]:
    one = f"class One(LifecycleNode):\n    def {handler}(self): {how}\n"
    return {"ending.py": ENDING.format(body=one + others)}


def _lives(pid: int) -> bool:
    with contextlib.suppress(OSError, IndexError):
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    return False


def _pids(run: Run, node: str) -> list[int]:
    return [int(what.split()[1]) for _, _, what in run.marks(node, "pid ")]


def _comes_again(run: Run, node: str, before: int, since: float) -> None:
    """Wait until a node runs anew; what was there of it before is gone by then, within seconds."""
    run.wait(lambda: len(_pids(run, node)) > 1, f"{node} again", timeout_s=8.0)
    assert not _lives(before), f"{before} runs beside its successor"
    run.wait(lambda: len(run.of_kind("system", reached="active")) > 1, "active again")
    assert time.monotonic() - since < 8.0, "it took too long"


def _shell_is_killed(run: Run) -> None:
    run.until_active()
    run.wait(lambda: bool(_pids(run, "child")), "child")
    before, since = _pids(run, "child")[0], time.monotonic()
    os.kill(run.pid_of("child"), signal.SIGKILL)
    _comes_again(run, "child", before, since)


def _shell_is_restarted(run: Run) -> None:
    run.until_active()
    run.wait(lambda: bool(_pids(run, "child")), "child")
    before, since = _pids(run, "child")[0], time.monotonic()
    assert run.lifecycle("restart", "kids", "child").returncode == 0
    _comes_again(run, "child", before, since)


HELPERS = """\
class Helped(LifecycleNode):
    def on_configure(self):
        words = ["sleep", "1000"]
        helper = subprocess.Popen(words, start_new_session=True)
        mark(self.get_name(), f"pid {helper.pid}")
class One(Helped): pass
class Two(Helped): pass
"""


def _host_is_killed(run: Run) -> None:
    run.until_active()
    before, since = _pids(run, "one")[0], time.monotonic()
    others = _pids(run, "two")
    os.kill(run.pid_of("one"), signal.SIGKILL)
    _comes_again(run, "one", before, since)
    assert _pids(run, "two") == others, "another was started again"
    assert _lives(others[0]), "another's helper was ended"


def _is_interrupted(run: Run) -> None:
    run.until_active()
    run.signal(signal.SIGINT)


def _is_ended(run: Run) -> None:
    run.until_active()
    assert run.lifecycle("down", "ends").returncode == 0


def _is_paused(run: Run) -> None:
    run.until_active()
    assert run.lifecycle("pause", "ends").returncode == 6


def _down_while_starting(run: Run) -> None:
    """Stop the command before it listens, and have it go on while another asks it to end."""
    held = run.directory / "lifecycle"
    run.wait(lambda: any(held.glob("*/record.json")), "run directory")
    run.signal(signal.SIGSTOP)
    name = next(held.glob("*/record.json")).parent.name
    later = threading.Timer(2.0, run.signal, (signal.SIGCONT,))
    later.start()
    done = run.lifecycle("down", name, "--timeout", "20")
    later.join()
    assert done.returncode == 0, done.stderr


SETSID = "setsid python3 child.py stubborn & wait\n"
CLEARED = (
    'env -i HOME="$HOME" PATH="$PATH" PYTHONPATH="$PYTHONPATH" OUTSIDE="$OUTSIDE" '
    'ROS_DOMAIN_ID="$ROS_DOMAIN_ID" ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST '
    'ROS_LOG_DIR="$ROS_LOG_DIR" setsid python3 child.py & wait\n'
)
RESTARTED = ("up", "--stop-after", "12")

TALKATIVE = {
    "talkative.py": """\
import sys
from lifecycle import on_timer
from nodes import Marked, mark
class Talkative(Marked):
    written = 0
    @on_timer(period_s=0.05)
    def write(self):
        for _ in range(20):
            print("x" * 1000, flush=True)
        self.written += 20
        if self.written == 1000:
            mark("one", "a megabyte")
"""
}

TALKS = """\
manifest_version: 1
system: talks
discovery: {range: localhost}
nodes:
  one: {run: {python: "talkative:Talkative"}}
  two: {run: {python: "nodes:Marked"}}
"""


def nobody_reads(run: Run) -> None:
    """Leave all output unread, and kill a node once far more was printed than a pipe takes."""
    run.until_active()
    two = run.pid_of("two")
    run.stop_reading()
    run.wait(lambda: bool(run.marks("one", "a megabyte")), "a megabyte of output")
    assert run.process is not None
    assert run.process.poll() is None
    os.kill(two, signal.SIGKILL)
    run.process.wait(20.0)
    run.read_on()


CASES = (
    Case(
        attack="a shell is killed whose child is the node, and restarted",
        manifest=COMMAND.format(),
        files={"w.sh": "python3 child.py & wait\n", "child.py": CHILD},
        verb=RESTARTED,
        story=_shell_is_killed,
        verdict=OK,
        says=("restarted: 'child' 1 time",),
    ),
    Case(
        attack="a shell is killed whose child has a session of its own and ignores signals",
        manifest=COMMAND.format(),
        files={"w.sh": SETSID, "child.py": CHILD},
        verb=RESTARTED,
        story=_shell_is_killed,
        verdict=OK,
    ),
    Case(
        attack="a shell is killed whose child writes all the time",
        manifest=COMMAND.format(),
        files={
            "w.sh": "python3 child.py & wait\n",
            "child.py": CHILD.replace("rclpy.spin", f"{CHATTY}rclpy.spin"),
        },
        verb=RESTARTED,
        story=_shell_is_killed,
        verdict=OK,
    ),
    Case(
        attack="a shell whose child has a session of its own is restarted by order",
        manifest=COMMAND.format(),
        files={"w.sh": SETSID, "child.py": CHILD},
        verb=RESTARTED,
        story=_shell_is_restarted,
        verdict=OK,
    ),
    Case(
        attack="a shell whose child has neither its session nor its variables is restarted",
        manifest=COMMAND.format(),
        files={"w.sh": CLEARED, "child.py": CHILD},
        verb=RESTARTED,
        story=_shell_is_restarted,
        verdict=OK,
    ),
    Case(
        attack="a hosted node is killed that had started a helper, and restarted",
        manifest=PAIR.replace('"ending:One"}', '"ending:One"}, restart: on-failure'),
        files={"ending.py": ENDING.format(body=HELPERS)},
        verb=RESTARTED,
        story=_host_is_killed,
        verdict=OK,
    ),
    Case(
        attack="a node aborts in on_deactivate at the end of a run",
        manifest=PAIR,
        files=_dies("on_deactivate", "os.abort()"),
        verb=("up", "--stop-after", "1"),
        says=("/one", "SIGABRT"),
        quick=True,
        **FELL,
    ),
    *(
        Case(
            attack=f"a node ends in {handler} by {how}",
            manifest=PAIR,
            files=_dies(handler, how),
            verb=("up", "--stop-after", "1"),
            within_s=20.0,
            **FELL,
        )
        for handler, how in (
            ("on_disconnect", "os.kill(os.getpid(), signal.SIGKILL)"),
            ("on_cleanup", "os._exit(0)"),
            ("on_shutdown", "ctypes.string_at(0)"),
        )
    ),
    Case(
        attack="two nodes die on the way down",
        manifest=PAIR,
        files=_dies(
            "on_deactivate",
            "os.abort()",
            "class Two(LifecycleNode):\n    def on_cleanup(self): os._exit(3)\n",
        ),
        verb=("up", "--stop-after", "1"),
        says=("/one (run.process-died)", "/two (run.process-died)"),
        **FELL,
    ),
    Case(
        attack="a node aborts on the way down after Ctrl-C",
        manifest=PAIR,
        files=_dies("on_deactivate", "os.abort()"),
        verb=("up",),
        story=_is_interrupted,
        exit_code=130,
        verdict=VIOLATED,
        findings=(DIED,),
    ),
    Case(
        attack="a node aborts on the way down after lifecycle down",
        manifest=PAIR,
        files=_dies("on_cleanup", "os.abort()"),
        verb=("up",),
        story=_is_ended,
        **FELL,
    ),
    Case(
        attack="a node aborts while the system is paused",
        manifest=PAIR,
        files=_dies("on_deactivate", "os.abort()"),
        verb=("up",),
        story=_is_paused,
        not_findings=("graph.missing-node",),
        **FELL,
    ),
    Case(
        attack="a command segfaults when it is asked to end",
        manifest=COMMAND.format()
        .replace("sh, w.sh", "python3, child.py")
        .replace("    restart: on-failure\n", ""),
        files={
            "child.py": CHILD.replace(
                "rclpy.spin(node)",
                "import ctypes\ntry:\n    rclpy.spin(node)\n"
                "except BaseException:\n    ctypes.string_at(0)",
            )
        },
        verb=("up", "--stop-after", "1"),
        says=("SIGSEGV",),
        **FELL,
    ),
    Case(
        attack="a command that ends with a traceback on Ctrl-C is healthy",
        manifest=COMMAND.format()
        .replace("sh, w.sh", "python3, child.py")
        .replace("    restart: on-failure\n", ""),
        files={
            "child.py": CHILD.replace(
                "rclpy.spin(node)",
                "try:\n    rclpy.spin(node)\nexcept BaseException:\n    sys.exit(1)",
            )
        },
        verb=("up", "--stop-after", "1"),
        verdict=OK,
        not_findings=(DIED,),
    ),
    Case(
        attack="a command that ignores every request to end is killed, which is no death",
        manifest=COMMAND.format()
        .replace("sh, w.sh", "python3, child.py, stubborn")
        .replace("    restart: on-failure\n", ""),
        files={
            "child.py": CHILD.replace(
                "rclpy.init()",
                "rclpy.init(signal_handler_options=rclpy.signals.SignalHandlerOptions.NO)",
            ).replace("import rclpy,", "import rclpy, rclpy.signals,")
        },
        verb=("up", "--stop-after", "1"),
        verdict=OK,
        not_findings=(DIED,),
        says=("had to be ended with SIGKILL",),
    ),
    Case(
        attack="a hosted node dies of an exception in a callback",
        manifest=PAIR,
        files={
            "ending.py": ENDING.format(
                body="class One(LifecycleNode):\n    @on_timer(period_s=0.3)\n"
                "    def tick(self): 1 / 0\n" + QUIET
            )
        },
        verb=("up", "--stop-after", "20"),
        not_findings=("graph.missing-node", "state.not-active"),
        says=("ZeroDivisionError: division by zero", "ending.py:6)"),
        quick=True,
        **FELL,
    ),
    Case(
        attack="a command dies of an exception with control characters in it",
        manifest=COMMAND.format()
        .replace("sh, w.sh", "python3, child.py")
        .replace("    restart: on-failure\n", ""),
        files={
            "child.py": CHILD.replace(
                "rclpy.spin(node)",
                "for _ in range(30): rclpy.spin_once(node)\n"
                "raise KeyError('\\x1b[2J' + 'x' * 5000)",
            ).replace(
                "import rclpy,", "class Key(Exception):\n    pass\nKeyError = Key\nimport rclpy,"
            )
        },
        verb=("up", "--stop-after", "20"),
        not_findings=("graph.missing-node", "graph.missing-endpoint", "graph.unmatched"),
        says=("Key: \\\\x1b[2Jxxx",),
        not_says=("x" * 400 + " (",),
        **FELL,
    ),
    Case(
        attack="a node fails later than start_limit_interval_sec at each start",
        manifest=PAIR.replace(
            '"ending:One"}',
            '"ending:One"}, restart: on-failure, start_limit_interval_sec: 1, '
            "start_limit_burst: 3, restart_sec: 0.1",
        ),
        files=_dies("on_configure", "time.sleep(1.2); os._exit(1)"),
        verb=("up",),
        exit_code=7,
        verdict=VIOLATED,
        findings=("run.gave-up",),
        within_s=30.0,
    ),
    Case(
        attack="lifecycle down comes while the run only starts",
        manifest=PAIR,
        files=_dies("on_cleanup", "pass"),
        verb=("up",),
        story=_down_while_starting,
        exit_code=(6, 143),
        within_s=30.0,
    ),
    Case(
        attack="nobody reads what the supervisor prints, and a node is killed",
        manifest=TALKS,
        files=TALKATIVE,
        verb=("up", "--strict"),
        story=nobody_reads,
        **FELL,
    ),
)
