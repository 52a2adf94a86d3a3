"""Silent nodes on real DDS: what is noticed, how soon, in which order, and when it heals."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest

from tests.ros.supervisor.running import Event, Up, up, verb, write
from tests.stalls import Stalls, assert_in_time, noted_stalls

pytestmark = pytest.mark.thorough

NODES = "benchmarks.liveliness_nodes"
WITHIN_S = 1.0
"""What is promised."""

BUSY_MACHINE_S = 0.5
"""For work that a busy machine takes longer for, beside the stalls that are noted."""

SILENT_S = 0.8
"""`timeouts.silent_s` where a manifest does not say."""

_PLACE = r"\(benchmarks/liveliness_nodes\.py:\d+\)"
_WHERE = rf"tick {_PLACE} > hang {_PLACE}"

LASTS_S = 3.0
"""So long that it is noticed before its end even on a busy machine."""


@pytest.fixture
def stalls() -> Iterator[Stalls]:
    """What the machine loses during the test."""
    with noted_stalls() as stalls:
        yield stalls


@pytest.fixture
def start(tmp_path: Path, fresh_domain: int) -> Iterator[Callable[..., Up]]:
    """Bring a node that hangs when told to and a quiet one up: `start(timeouts={...})`."""
    environment = {"HANG_FILE": str(tmp_path / "hang")}
    run = {"python": f"{NODES}:Hanging", "environment": environment}
    with contextlib.ExitStack() as stack:

        def begin(*options: str, hanging: Mapping[str, Any] | None = None, **keys: Any) -> Up:
            quiet = {"run": {"python": f"{NODES}:Quiet"}}
            nodes = {"hanging": {**(hanging or {"run": run}), **keys}, "quiet": quiet}
            file = write(tmp_path, fresh_domain, nodes, "silence")
            return stack.enter_context(up(file, *options, runtime=tmp_path))

        yield begin


def hang(directory: Path, way: str, seconds: float = LASTS_S) -> None:
    """Have the node hang; whole, whenever it looks."""
    part = directory / "part"
    part.write_text(f"{way} {seconds}", encoding="ascii")
    part.rename(directory / "hang")


def at(running: Up, kind: str, **fields: object) -> float:
    """Return when an event came."""
    running.until(kind, **fields)
    return time.monotonic()


def _silent_by(verdict: Event) -> str:
    """Return the causes of a finding that a node is silent."""
    found = (each for each in verdict["findings"] if each["rule"] == "run.silent-node")
    return " ".join(each["observed"] for each in found)


def until_verdict(running: Up, outcome: str) -> Event:
    """Read on until the verdict is this, and return it."""
    since = len(running.events)
    return running.until_verdict(lambda verdict: verdict["verdict"] == outcome, since=since)


def said(running: Up, word: str, since: int) -> float:
    """Return when the node did what it says in its log, which may come a little later."""
    prefix = f"{word} "
    for event in running.events[since:]:
        if event.get("event") == "log" and event["line"].startswith(prefix):
            return float(event["line"].removeprefix(prefix))
    while not (line := running.until("log")["line"]).startswith(prefix):
        pass
    return float(line.removeprefix(prefix))


def turns(running: Up, node: str, since: int = 0) -> list[str]:
    """Return what was said of a node, and how the verdict turned, in order."""
    found: list[str] = []
    for event in running.events[since:]:
        if event.get("event") in ("silent", "alive") and event["node"] == node:
            found.append(event["event"])
        elif event.get("event") == "verdict" and [event["verdict"]["verdict"]] != found[-1:]:
            found.append(event["verdict"]["verdict"])
    return found


def joined(running: Up) -> list[str]:
    """Return the nodes that came into the graph, in the order they were seen."""
    return [event["node"] for event in running.of_kind("joined")]


def silences(running: Up, node: str) -> list[Event]:
    """Return what was said of the silence of a node."""
    return [event for event in running.of_kind("silent") if event["node"] == node]


@pytest.mark.alone
@pytest.mark.parametrize("way", ["sleep", "busy", "locked"])
def test_a_hung_executor_is_noticed_within_a_second_and_so_is_its_end(
    start: Callable[..., Up], tmp_path: Path, way: str, stalls: Stalls
) -> None:
    running = start()
    running.until("system", reached="active")
    pid = running.pid_of("hanging")

    def late_s() -> float:
        since = len(running.events)
        asked = time.monotonic()
        hang(tmp_path, way)
        silent = at(running, "silent", node="/hanging", cause="hung")
        verdict = until_verdict(running, "violated")
        violated = time.monotonic()
        alive = at(running, "alive", node="/hanging")
        until_verdict(running, "ok")
        began, ended = said(running, "hangs", since), said(running, "is back", since)
        # Not before its time, and not before it ended. The callback began before it said so, and
        # if the machine stood still meanwhile, before it was asked to hang.
        assert silent - asked >= SILENT_S / 2
        assert ended <= alive
        assert turns(running, "/hanging", since) == ["silent", "violated", "alive", "ok"]
        (finding,) = [each for each in verdict["findings"] if each["node"] == "/hanging"]
        assert finding["rule"] == "run.silent-node"
        message, _, where = finding["message"].partition(", in ")
        assert message == (
            "cannot rely on '/hanging': a callback of a timer of 0.02 s in its process 'hanging' "
            f"(pid {pid}) has been running for more than 0.8 s"
        )
        assert re.fullmatch(_WHERE, where)
        return max(
            stalls.taken(began, violated) - WITHIN_S - BUSY_MACHINE_S,
            stalls.taken(ended, alive) - WITHIN_S,
        )

    assert_in_time(late_s)


@pytest.mark.alone
def test_a_stopped_process_is_noticed_at_once_and_so_is_its_continuation(
    start: Callable[..., Up], stalls: Stalls
) -> None:
    running = start()
    running.until("system", reached="active")
    pid = running.pid_of("quiet")

    def late_s() -> float:
        since = len(running.events)
        began = time.monotonic()
        os.kill(pid, signal.SIGSTOP)
        silent = at(running, "silent", node="/quiet", cause="stopped")
        until_verdict(running, "violated")
        ended = time.monotonic()
        os.kill(pid, signal.SIGCONT)
        alive = at(running, "alive", node="/quiet")
        until_verdict(running, "ok")
        assert turns(running, "/quiet", since) == ["silent", "violated", "alive", "ok"]
        return max(stalls.taken(began, silent), stalls.taken(ended, alive)) - WITHIN_S

    assert_in_time(late_s)


def test_status_says_which_node_is_silent_and_why(start: Callable[..., Up], tmp_path: Path) -> None:
    running = start()
    running.until("system", reached="active")
    pid = running.pid_of("quiet")
    os.kill(pid, signal.SIGSTOP)
    running.until("silent", node="/quiet")
    told = verb("status", "silence", runtime=tmp_path)
    os.kill(pid, signal.SIGCONT)
    (line,) = [each for each in told.stdout.splitlines() if each.startswith("/quiet")]
    assert line.endswith(f"silent: its process 'quiet' (pid {pid}) was stopped by a signal")


def test_a_system_with_a_stopped_node_is_taken_down_without_waiting_for_it(
    start: Callable[..., Up],
) -> None:
    running = start()
    running.until("system", reached="active")
    os.kill(running.pid_of("quiet"), signal.SIGSTOP)
    running.until("silent", node="/quiet")
    running.signal(signal.SIGINT)
    running.until("stopping")
    before = len(running.events)
    running.finish()
    asked = [each["node"] for each in running.events[before:] if each.get("event") == "request"]
    assert set(asked) == {"/hanging"}
    # A stopped process takes no other signal.
    ends = {each["process"]: each["detail"] for each in running.of_kind("process")}
    assert ends["quiet"] == "killed by SIGKILL"
    running.assert_nothing_left()


@pytest.mark.alone
def test_a_killed_node_is_dead_and_not_silent(start: Callable[..., Up], stalls: Stalls) -> None:
    running = start("--keep-going")
    running.until("system", reached="active")
    before = len(running.events)
    began = time.monotonic()
    os.kill(running.pid_of("quiet"), signal.SIGKILL)
    exited = at(running, "process", process="quiet", state="exited")
    running.until_found("graph.missing-node", "/quiet", since=before)
    # A process dies once, so there is no second try.
    assert stalls.taken(began, exited) <= WITHIN_S + BUSY_MACHINE_S
    assert silences(running, "/quiet") == []


@pytest.mark.alone
def test_a_callback_may_take_as_long_as_the_manifest_allows(
    start: Callable[..., Up], tmp_path: Path
) -> None:
    running = start(timeouts={"silent_s": 10})
    running.until("system", reached="active")
    hang(tmp_path, "busy", 1.5)
    said(running, "is back", 0)
    running.signal(signal.SIGINT)
    running.finish()
    assert silences(running, "/hanging") == []


@pytest.mark.alone
def test_a_transition_that_takes_long_is_not_a_hang(start: Callable[..., Up]) -> None:
    slow = {"run": {"python": "tests.ros.liveliness.nodes:Slow"}}
    running = start("--stop-after", "0", hanging=slow)
    assert running.finish() == 0
    assert silences(running, "/hanging") == []


def test_nodes_join_and_leave_the_graph_as_events(start: Callable[..., Up]) -> None:
    running = start("--keep-going")
    running.until("system", reached="active")
    # Two processes start side by side, so either may be first.
    assert sorted(joined(running)) == ["/hanging", "/quiet"]
    os.kill(running.pid_of("quiet"), signal.SIGTERM)
    running.until("left", node="/quiet")
