"""What a killed process leaves: for its supervisor nothing, at once; for others its lease."""

from __future__ import annotations

import json
import os
import signal
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from rclpy.node import Node
from std_msgs.msg import String

from lifecycle.errors import ExitCode
from lifecycle.middleware.process.shared_memory import leftovers, sweep
from tests.ros.middleware.free_ports import first_port
from tests.ros.stranger import stranger
from tests.ros.supervisor.running import ENOUGH, Up, pair, up, verb

pytestmark = pytest.mark.thorough

AT_ONCE_S = 8.0
"""Less than the lease of 10 s, on a machine that runs something else meanwhile."""

GONE_S = 16.0
"""After the lease of 10 s of what `lifecycle up` starts, and before that of 20 s by default."""

CROWD = {
    # Two nodes in the process that is killed, one of them with a participant of its own for its
    # publisher: all three participants' worth must go.
    "policy/undeclared_nodes": "open",
    "nodes/talker/process": "crowd",
    "nodes/talker/flows": {"publishers": {"chatter": {"unique": "strictly_required"}}},
    "nodes/quiet": {
        "run": {"python": "tests.ros.supervisor.systems:Quiet", "environment": {"MISBEHAVE": ""}},
        "process": "crowd",
    },
}


@pytest.fixture
def open_ports() -> Iterator[set[str]]:
    """Ports that a bystander may have open until after the end of a run that owned them.

    A process that was killed never gives its own share of a port back, so nobody else removes it.
    """
    ports: set[str] = set()
    yield ports
    sweep(within_s=0.5)


@pytest.fixture
def bystander(fresh_domain: int, open_ports: set[str]) -> Iterator[Node]:
    """A node of somebody else's in the domain, which knows nothing of the system."""
    with stranger(fresh_domain, "_bystander") as node:
        yield node


def kill(run: Up, process: str) -> float:
    """Kill a process; return the time of it."""
    os.kill(run.pid_of(process), signal.SIGKILL)
    return time.monotonic()


def until(holds: Callable[[], object], since: float, *, within_s: float = AT_ONCE_S) -> None:
    """Wait until something holds, at most so many seconds after `since`."""
    while not holds():
        assert time.monotonic() - since < within_s, f"not within {within_s} s"
        time.sleep(0.005)


def status(runtime: Path) -> dict[str, dict[str, Any]]:
    """Return the status of each node."""
    told = verb("status", "pair", "--format", "json", runtime=runtime)
    return {each["node"]: each for each in json.loads(told.stdout)["nodes"]}


def restarts_at_once(run: Up, runtime: Path, node: str = "talker") -> None:
    """Restart a node; the whole command takes a moment."""
    begun = len(run.events)
    began = time.monotonic()
    done = verb("restart", "pair", node, runtime=runtime)
    took_s = time.monotonic() - began
    assert done.returncode == ExitCode.OK, done.stderr
    assert done.stderr == ""
    run.until("system", reached="active")
    rules = {
        each["rule"]
        for event in run.events[begun:]
        if event.get("event") == "verdict"
        for each in event["verdict"]["findings"]
    }
    assert "graph.duplicate-node" not in rules
    assert run.of_kind("verdict")[-1]["verdict"]["verdict"] == "ok"
    assert took_s < AT_ONCE_S


def test_a_killed_process_is_gone_for_everybody_within_its_lease_and_comes_back_at_once(
    tmp_path: Path, fresh_domain: int, bystander: Node, open_ports: set[str]
) -> None:
    with up(pair(tmp_path, fresh_domain, edit=CROWD), "--keep-going", runtime=tmp_path) as run:
        run.until("system", reached="active")
        run.note_segments()
        dead = {"talker", "quiet"}
        until(lambda: dead < {*bystander.get_node_names()}, time.monotonic())
        until(lambda: bystander.count_publishers("/chatter") == 1, time.monotonic())
        pid = run.pid_of("crowd")
        since = run.catch_up()
        at = kill(run, "crowd")
        run.until("failure", rule="run.process-died")
        assert time.monotonic() - at < AT_ONCE_S
        until(lambda: not dead & {*bystander.get_node_names()}, at, within_s=GONE_S)
        until(lambda: bystander.count_publishers("/chatter") == 0, at, within_s=GONE_S)
        until(lambda: status(tmp_path)["/listener"]["matched"] == 0, at, within_s=GONE_S)
        seen = status(tmp_path)
        for name in ("/talker", "/quiet"):
            assert seen[name]["died"] == f"pid {pid} died: killed by SIGKILL"
            assert (seen[name]["state"], seen[name]["matched"]) == ("", 0)
        # The verdict follows the death by a moment.
        run.until_found("graph.missing-node", "/quiet", since=since)
        told = verb("status", "pair", runtime=tmp_path).stdout.splitlines()
        assert told[0].startswith(
            "pair: active 1/3, verdict violated (/quiet, /talker (graph.missing-node)"
        )
        states = [line.split()[3] for line in told if line.startswith("/")]
        assert sorted(states) == ["active", "dead", "dead"]
        # Also who looks on from outside.
        judged = verb(
            "verify", str(tmp_path / "pair.lifecycle.yaml"), "--timeout", "5", runtime=tmp_path
        )
        assert judged.returncode == ExitCode.VIOLATED
        assert "/talker" in judged.stdout
        restarts_at_once(run, tmp_path)
        assert status(tmp_path)["/talker"]["state"] == "active"
        judged = verb("verify", str(tmp_path / "pair.lifecycle.yaml"), *ENOUGH, runtime=tmp_path)
        assert judged.returncode == ExitCode.OK, judged.stdout
        run.note_segments()
        assert verb("down", "pair", runtime=tmp_path).returncode == ExitCode.OK
        assert run.finish() == ExitCode.OK
        open_ports |= {each for each in run.segments if "_port" in each}
        run.segments -= open_ports
        run.assert_nothing_left()


@pytest.mark.alone  # all of /dev/shm is compared
def test_shared_memory_of_a_process_killed_as_soon_as_it_has_made_it_is_removed(
    tmp_path: Path, fresh_domain: int
) -> None:
    """Nobody has looked whose it is by then, and afterwards nobody can tell."""
    before = set(leftovers())
    manifest = pair(tmp_path, fresh_domain, misbehave="configure:kill-with-participant")
    with up(manifest, runtime=tmp_path) as killed:
        assert killed.finish() == ExitCode.BRING_UP_FAILED
    assert set(leftovers()) <= before


_NOTES_LEASES = """
import fcntl, os, sys

def note(event, arguments):
    if event == "fcntl.fcntl" and arguments[1] == fcntl.F_SETLEASE:
        with open(os.environ["LEASES"], "a") as file:
            file.write(f"{os.getpid()}\\n")
    elif event == "fcntl.flock":
        open(os.environ["LOCKS"], "a").close()

sys.addaudithook(note)
"""


def test_nobody_keeps_others_from_opening_shared_memory(tmp_path: Path, fresh_domain: int) -> None:
    """Who opens a file with a lease on it waits, with the GIL where Fast DDS opens it."""
    (tmp_path / "sitecustomize.py").write_text(_NOTES_LEASES)
    noted, locks = tmp_path / "leases", tmp_path / "locks"
    variables = {"PYTHONPATH": str(tmp_path), "LEASES": str(noted), "LOCKS": str(locks)}
    manifest = pair(tmp_path, fresh_domain, edit={"restart": "on-failure"})
    with up(manifest, runtime=tmp_path, variables=variables) as run:
        run.until("system", reached="active")
        kill(run, "talker")
        run.until("restarted")
        run.signal(signal.SIGTERM)
        assert run.finish() == ExitCode.OK
    assert locks.exists(), "nobody has looked"
    assert not noted.exists()


@pytest.mark.parametrize("mode", ["static", "server"])
def test_where_ports_are_fixed_a_killed_node_is_gone_and_comes_back_at_once(
    mode: str, tmp_path: Path, fresh_domain: int
) -> None:
    """The supervisor knows better than DDS, which has it until its lease is over."""
    how = {"domain_id": fresh_domain, "mode": mode, "first_port": first_port()}
    manifest = pair(tmp_path, fresh_domain, edit={"discovery": how})
    with up(manifest, "--keep-going", runtime=tmp_path) as run:
        run.until("system", reached="active")
        since = run.catch_up()
        at = kill(run, "talker")
        run.until("failure", rule="run.process-died")
        run.until_found("graph.missing-node", "/talker", since=since)
        assert time.monotonic() - at < AT_ONCE_S
        restarts_at_once(run, tmp_path)
        assert verb("down", "pair", runtime=tmp_path).returncode == ExitCode.OK
        assert run.finish() == ExitCode.OK


HEARER = (
    "import rclpy, std_msgs.msg; rclpy.init(); node = rclpy.create_node('listener'); "
    "node.create_subscription(std_msgs.msg.String, 'chatter', lambda _: None, 10); rclpy.spin(node)"
)
"""It reports nothing, so that the publisher's count alone proves the pair."""

SETTLED_S = 1.0
LEASE_S = 12.0
"""By then a participant of Fast DDS that was killed is forgotten by all."""


def test_a_killed_peer_that_others_count_still_casts_no_doubt_on_the_one_that_replaced_it(
    tmp_path: Path, fresh_domain: int, bystander: Node
) -> None:
    edit = {
        "policy/undeclared_nodes": "open",
        "nodes/listener/run": {"command": [sys.executable, "-c", HEARER]},
        "nodes/listener/managed": False,
        "nodes/listener/restart": "always",
        "nodes/listener/restart_sec": 0.5,
    }
    with up(pair(tmp_path, fresh_domain, edit=edit), runtime=tmp_path) as run:
        run.until("system", reached="active")
        killed_s = kill(run, "listener")
        since = run.catch_up()
        run.met("system", since=since, reached="active")
        time.sleep(SETTLED_S)
        run.catch_up()
        back = len(run.of_kind("verdict"))
        while time.monotonic() < killed_s + LEASE_S:  # each change is looked at
            bystander.destroy_publisher(bystander.create_publisher(String, "elsewhere", 1))
            time.sleep(0.3)
        run.catch_up()
        said = [each["verdict"]["verdict"] for each in run.of_kind("verdict")[back - 1 :]]
        assert set(said) == {"ok"}
