"""Processes that are killed come again by policy, on real DDS; see also the unit tests of it.

What is measured here is bounded loosely: benchmarks/restart.py measures.
"""

from __future__ import annotations

import json
import os
import signal
import time
from pathlib import Path

import pytest

from lifecycle.errors import ExitCode
from tests.ros.supervisor.running import pair, up, verb

_THIRD = {
    "run": {"python": "tests.ros.supervisor.systems:Listener"},
    "timeouts": {"silent_s": 8},
    "interface": {"subscriptions": [{"name": "chatter", "type": "std_msgs/msg/String"}]},
}
"""Another listener."""


def test_a_killed_node_of_three_is_active_and_verified_again_and_the_others_go_on(
    tmp_path: Path, fresh_domain: int
) -> None:
    edit = {
        "restart": "on-failure",
        "nodes/third": _THIRD,
        "nodes/talker/run/python": "tests.ros.supervisor.systems:Numbered",
    }
    with up(pair(tmp_path, fresh_domain, edit=edit), runtime=tmp_path) as run:
        run.until("system", reached="active")
        others = {each: run.pid_of(each) for each in ("listener", "third")}
        killed = run.pid_of("talker")
        os.kill(killed, signal.SIGKILL)
        assert not run.until("failure", rule="run.process-died")["ends_run"]
        scheduled = run.until("backoff")
        assert (scheduled["process"], scheduled["nodes"]) == ("talker", ["/talker"])
        begun = len(run.events)
        done = run.until("restarted")
        assert (done["process"], done["restarts"]) == ("talker", 1)
        for each, pid in others.items():
            line = f"heard pid {run.pid_of('talker')}"
            run.met("log", since=begun, process=each, line=line)
            assert run.pid_of(each) == pid
        status = verb("status", "pair", "--format", "json", runtime=tmp_path)
        assert status.returncode == ExitCode.OK, status.stdout
        found = {each["node"]: each for each in json.loads(status.stdout)["nodes"]}
        talker = found["/talker"]
        assert (talker["state"], talker["restarts"], talker["process_state"]) == (
            "active",
            1,
            "running",
        )
        assert talker["last_failure"]["signal"] == "SIGKILL"
        assert found["/listener"]["restarts"] == 0
        assert found["/listener"]["uptime_s"] > talker["uptime_s"]
        assert verb("down", "pair", runtime=tmp_path).returncode == ExitCode.OK
        assert run.finish() == ExitCode.OK
        assert run.verdict["run"]["reason"] == "lifecycle down; restarted: 'talker' 1 time"
        run.assert_nothing_left()


@pytest.mark.thorough
def test_a_node_that_is_killed_before_its_name_is_known_does_not_haunt_the_gate(
    tmp_path: Path, fresh_domain: int
) -> None:
    once = tmp_path / "once"
    once.touch()
    edit = {
        "restart": "on-failure",
        "nodes/talker/run/python": "tests.ros.supervisor.systems:Stillborn",
        "nodes/talker/run/environment": {"MISBEHAVE_IF": str(once)},
    }
    with up(pair(tmp_path, fresh_domain, edit=edit), runtime=tmp_path) as run:
        assert not run.until("failure", process="talker")["ends_run"]
        began = time.monotonic()
        run.until("system", reached="active")
        # Its endpoints would be there for the rest of its lease, 10 s, and nobody's.
        assert time.monotonic() - began < 8.0
        assert run.until("restarted")["process"] == "talker"


def test_a_node_that_fails_each_time_is_given_up_with_exit_code_7_and_its_last_failure(
    tmp_path: Path, fresh_domain: int
) -> None:
    edit = {"restart": "on-failure", "start_limit_burst": 2}
    manifest = pair(tmp_path, fresh_domain, misbehave="configure:exit", edit=edit)
    with up(manifest, runtime=tmp_path) as run:
        assert run.finish() == ExitCode.SUPERVISION_GAVE_UP
        finding = run.verdict["findings"][0]
        assert (finding["rule"], finding["subject"]) == ("run.gave-up", "/talker")
        assert finding["message"].count("exit status 9") == 1
        assert len(run.of_kind("gave_up")) == 1
        run.assert_nothing_left()
