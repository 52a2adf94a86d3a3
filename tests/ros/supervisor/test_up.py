"""`lifecycle up` from the first process to the last, on real DDS through the real command line."""

from __future__ import annotations

import json
import os
import signal
import sys
import time
from pathlib import Path

import pytest

from lifecycle.errors import ExitCode
from lifecycle.middleware import segments_of
from tests.ros.supervisor.running import BOUND_S, marked, pair, up, verb


def test_a_healthy_system_is_connected_verified_activated_held_and_taken_down(
    tmp_path: Path, fresh_domain: int
) -> None:
    report = tmp_path / "verdict.json"
    options = ("--stop-after", "2", "--report", str(report))
    with up(pair(tmp_path, fresh_domain), *options, runtime=tmp_path) as run:
        run.until("system", reached="active")
        run.note_segments()
        run.met("log", line="heard hello")
        assert run.finish() == ExitCode.OK
        assert [each["reached"] for each in run.of_kind("system")] == [
            "connected",
            "verified",
            "active",
        ]
        assert run.verdict["verdict"] == "ok"
        assert json.loads(report.read_text())["verdict"] == "ok"
        activated = [e["node"] for e in run.of_kind("request") if e["operation"] == "activate"]
        assert sorted(activated) == ["/listener", "/talker"]
        run.assert_gate_held()
        run.assert_nothing_left()
        logs = Path(run.of_kind("run")[0]["log_directory"])
        assert logs.parent == tmp_path / "log"
        assert (logs / "listener.log").read_text() == "heard hello\n"


@pytest.mark.parametrize("until", ["connected", "verified"])
def test_until_stops_short_of_activating(tmp_path: Path, fresh_domain: int, until: str) -> None:
    with up(pair(tmp_path, fresh_domain), "--until", until, runtime=tmp_path) as run:
        assert run.finish() == ExitCode.OK
        assert run.of_kind("system")[-1]["reached"] == until
        assert run.verdict["run"] == {"reason": "done", "reached": until, "exit_code": 0}
        assert run.of_kind("gate") == []
        assert "activate" not in [each["operation"] for each in run.of_kind("request")]
        run.assert_nothing_left()


def test_an_interrupt_takes_the_system_down_in_reverse_order(
    tmp_path: Path, fresh_domain: int
) -> None:
    with up(pair(tmp_path, fresh_domain), runtime=tmp_path) as run:
        run.until("system", reached="active")
        run.note_segments()
        run.signal(signal.SIGINT)
        assert run.finish() == ExitCode.INTERRUPTED
        assert run.verdict["run"] == {
            "reason": "interrupted",
            "reached": "active",
            "exit_code": ExitCode.INTERRUPTED,
        }
        last = [each["node"] for each in run.of_kind("request") if each["operation"] == "shutdown"]
        assert last == ["/listener", "/talker"]
        run.assert_nothing_left()


def test_a_signal_during_bring_up_rolls_back(tmp_path: Path, fresh_domain: int) -> None:
    manifest = pair(tmp_path, fresh_domain, misbehave="configure:hang")
    with up(manifest, runtime=tmp_path) as run:
        run.until("log", line="about to hang in configure")
        run.note_segments()
        run.signal(signal.SIGINT)
        assert run.finish() == ExitCode.INTERRUPTED
        assert run.verdict["run"].pop("reason").endswith("; /talker is still configuring")
        assert run.verdict["run"] == {"reached": None, "exit_code": ExitCode.INTERRUPTED}
        run.assert_nothing_left()


def test_a_signal_while_the_supervisor_itself_is_starting_leaves_nothing(
    tmp_path: Path, fresh_domain: int
) -> None:
    with up(pair(tmp_path, fresh_domain), runtime=tmp_path) as run:
        deadline = time.monotonic() + BOUND_S
        while not segments_of([run.process.pid]):  # its participant, which it makes before all else
            assert run.process.poll() is None
            assert time.monotonic() < deadline
            time.sleep(0.001)
        run.note_segments()
        run.signal(signal.SIGTERM)
        assert run.finish() == ExitCode.OK
        assert run.verdict["verdict"] == "unverifiable"
        assert run.verdict["run"]["reason"].startswith("terminated")
        run.assert_gate_held()
        run.assert_nothing_left()


def test_a_second_interrupt_kills_what_does_not_end(tmp_path: Path, fresh_domain: int) -> None:
    manifest = pair(
        tmp_path,
        fresh_domain,
        misbehave="deactivate:hang",
        edit={"nodes/talker/timeouts": {"deactivate_s": 60, "shutdown_s": 60}},
    )
    with up(manifest, runtime=tmp_path) as run:
        run.until("system", reached="active")
        run.note_segments()
        run.signal(signal.SIGINT)
        run.until("log", line="about to hang in deactivate")
        run.signal(signal.SIGINT)
        assert run.finish() == ExitCode.INTERRUPTED
        ends = {each["process"]: each["detail"] for each in run.of_kind("process")}
        assert ends["talker"] == "killed by SIGKILL"
        run.assert_nothing_left()


def test_a_process_that_dies_in_a_step_ends_the_run_and_is_named_with_its_last_words(
    tmp_path: Path, fresh_domain: int
) -> None:
    with up(pair(tmp_path, fresh_domain, misbehave="activate:kill"), runtime=tmp_path) as run:
        assert run.finish() == ExitCode.BRING_UP_FAILED
        failure = run.of_kind("failure")[0]
        assert failure["rule"] == "run.process-died"
        assert failure["subject"] == "/talker"
        assert failure["message"] == (
            f"cannot keep '/talker' running: pid {run.pid_of('talker')} died while activating: "
            "killed by SIGKILL"
        )
        assert failure["log_tail"][-1] == "about to kill in activate"
        assert run.verdict["verdict"] == "violated"
        assert run.verdict["findings"][0]["rule"] == "run.process-died"
        assert run.verdict["run"] == {
            "reason": failure["message"],
            "reached": "verified",
            "exit_code": ExitCode.BRING_UP_FAILED,
        }
        run.assert_gate_held()
        run.assert_nothing_left()


def test_keep_going_reports_the_death_and_the_verdict_and_goes_on(
    tmp_path: Path, fresh_domain: int
) -> None:
    with up(pair(tmp_path, fresh_domain), "--keep-going", runtime=tmp_path) as run:
        run.until("system", reached="active")
        run.note_segments()
        before = len(run.events)
        os.kill(run.pid_of("talker"), signal.SIGKILL)
        run.until("failure", rule="run.process-died")
        # A judgement that was under way may see the death a moment before it is reported.
        verdict = run.until_found("graph.missing-node", "/talker", since=before)
        assert verdict["verdict"] == "violated"
        run.signal(signal.SIGTERM)
        assert run.finish() == ExitCode.OK
        run.assert_nothing_left()


def test_a_grandchild_that_escaped_into_its_own_session_is_ended_too(
    tmp_path: Path, fresh_domain: int
) -> None:
    manifest = pair(tmp_path, fresh_domain, misbehave="configure:fork")
    with up(manifest, "--stop-after", "0", runtime=tmp_path) as run:
        assert run.finish() == ExitCode.OK
        notices = [each["message"] for each in run.of_kind("notice")]
        assert any(each.startswith("ended processes that were left behind") for each in notices)
        run.assert_nothing_left()


def test_a_second_up_of_the_same_system_is_refused(tmp_path: Path, fresh_domain: int) -> None:
    manifest = pair(tmp_path, fresh_domain)
    with up(manifest, runtime=tmp_path) as run:
        run.until("system", reached="active")
        second = verb("up", str(manifest), runtime=tmp_path)
        assert second.returncode == ExitCode.USAGE
        assert second.stderr == (
            f"cannot bring up 'pair@{fresh_domain}': another supervisor "
            f"(pid {run.process.pid}) runs it already; "
            f"end it first: lifecycle down pair@{fresh_domain}\n"
        )
        run.signal(signal.SIGTERM)
        assert run.finish() == ExitCode.OK


def test_status_and_down_talk_to_a_running_supervisor(tmp_path: Path, fresh_domain: int) -> None:
    manifest = pair(tmp_path, fresh_domain)
    with up(manifest, runtime=tmp_path) as run:
        run.until("system", reached="active")
        run.note_segments()
        told = json.loads(verb("status", "pair", "--format", "json", runtime=tmp_path).stdout)
        assert told["phase"] == "active"
        assert told["verdict"] == "ok"
        states = {each["node"]: (each["state"], each["matched"]) for each in told["nodes"]}
        assert states == {"/talker": ("active", 1), "/listener": ("active", 1)}
        down = verb("down", str(manifest), runtime=tmp_path)
        assert (down.returncode, down.stderr) == (ExitCode.OK, "")
        assert run.finish() == ExitCode.OK
        run.assert_nothing_left()
    gone = verb("down", str(manifest), runtime=tmp_path)
    assert gone.returncode == ExitCode.USAGE
    assert gone.stderr == (
        f"cannot find a running system 'pair@{fresh_domain}'; running: none; "
        "start it: lifecycle up MANIFEST\n"
    )


def test_the_next_up_sweeps_what_a_killed_supervisor_left(
    tmp_path: Path, fresh_domain: int
) -> None:
    manifest = pair(tmp_path, fresh_domain, misbehave="configure:fork")
    with up(manifest, runtime=tmp_path) as killed:
        killed.until("system", reached="active")
        killed.note_segments()
        os.kill(killed.pid_of("talker"), signal.SIGSTOP)
        killed.signal(signal.SIGKILL)
        killed.process.wait(30)
        assert marked(killed.mark) != []
        with up(manifest, "--stop-after", "0", runtime=tmp_path) as following:
            assert following.finish() == ExitCode.OK
            assert any(
                each["message"].startswith(
                    f"cleaned up after supervisor {killed.process.pid}, which was killed"
                )
                for each in following.of_kind("notice")
            )
            following.assert_nothing_left()
        killed.assert_nothing_left()


def test_a_plain_command_is_started_verified_and_ended(tmp_path: Path, fresh_domain: int) -> None:
    code = (
        "import rclpy; from rclpy.node import Node; from std_msgs.msg import String\n"
        "rclpy.init(); node = Node('x'); node.create_publisher(String, 'chatter', 10)\n"
        "rclpy.spin(node)"
    )
    edit = {
        "nodes/talker/run": {"command": [sys.executable, "-c", code]},
        "nodes/talker/managed": False,
        "nodes/talker/interface": {
            "publishers": [{"name": "/chatter", "type": "std_msgs/msg/String"}]
        },
    }
    with up(pair(tmp_path, fresh_domain, edit=edit), "--stop-after", "0", runtime=tmp_path) as run:
        run.until("system", reached="active")
        run.note_segments()
        assert run.finish() == ExitCode.OK
        assert run.verdict["verdict"] in {"ok", "unverifiable"}
        run.assert_nothing_left()
