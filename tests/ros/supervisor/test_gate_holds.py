"""Nothing is active that the gate has not let through, or on a verdict that is not of now."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import pytest
from rclpy.node import Node
from std_msgs.msg import String

from lifecycle.errors import ExitCode
from tests.ros.faults.system import BARE_DDS, FOREIGN
from tests.ros.stranger import ask, stranger
from tests.ros.supervisor.running import (
    BOUND_S,
    LIMITS,
    ROOT,
    Up,
    command,
    environment,
    pair,
    up,
    verb,
)

_ELSEWHERE = str(Path(__file__).with_name("managed_elsewhere.py"))
_CHATTER = "/chatter:std_msgs/msg/String:RELIABLE"
_UNATTRIBUTED = "graph.unattributed-endpoint"
_BASE = {
    "nodes/base": {"run": {"command": [sys.executable, _ELSEWHERE]}, "timeouts": LIMITS},
}


def change(domain_id: int, node: str, transition: str) -> bool:
    """Ask for a transition as anybody may; whether it succeeded."""
    return bool(ask(domain_id, lambda each: each.change_state(node, transition, timeout_s=20.0)))


def activated(run: Up) -> list[str]:
    return [each["node"] for each in run.of_kind("request") if each["operation"] == "activate"]


def test_a_paused_system_stays_inactive_whoever_activates_its_nodes(
    tmp_path: Path, fresh_domain: int
) -> None:
    edit = {**_BASE, "policy": {"undeclared_nodes": "open"}}
    with up(pair(tmp_path, fresh_domain, edit=edit), runtime=tmp_path) as run:
        run.until("system", reached="active")
        # Who was let through may be driven by others, for as long as nothing takes it back.
        assert change(fresh_domain, "/talker", "deactivate")
        assert change(fresh_domain, "/talker", "activate")
        assert verb("pause", "pair", runtime=tmp_path).returncode == ExitCode.OK
        run.until("system", reached="paused")
        begun = len(run.events)

        assert not change(fresh_domain, "/talker", "activate")
        said = "cannot activate /talker: the gate of its supervisor is closed"
        assert said in run.until("log", process="talker")["line"]

        change(fresh_domain, "/base", "activate")
        run.met("log", since=begun, line="base is active")
        run.met("log", since=begun, line="base is inactive")
        run.until_found("state.activated-at-closed-gate", "/base", since=begun)
        run.until_not_found("state.activated-at-closed-gate", since=begun)
        assert verb("resume", "pair", runtime=tmp_path).returncode == ExitCode.OK
        run.until("system", reached="active")
        assert verb("down", "pair", runtime=tmp_path).returncode == ExitCode.OK
        assert run.finish() == ExitCode.OK


def test_a_node_whose_own_code_activates_it_is_refused_while_the_gate_is_closed(
    tmp_path: Path, fresh_domain: int
) -> None:
    edit = {"nodes/talker/run/python": "tests.ros.supervisor.systems:Eager"}
    options = ("--until", "verified", "--stop-after", "60")
    with up(pair(tmp_path, fresh_domain, edit=edit), *options, runtime=tmp_path) as run:
        run.until("system", reached="verified")
        for whence in ("timer", "thread"):
            run.met(
                "log",
                line=f"{whence}: cannot activate /talker: the gate of its supervisor is closed; "
                "it is activated once 'pair' is verified; a paused system: lifecycle resume pair",
            )
        status = json.loads(verb("status", "pair", "--format", "json", runtime=tmp_path).stdout)
        assert {each["state"] for each in status["nodes"]} == {"inactive"}
        assert verb("down", "pair", runtime=tmp_path).returncode == ExitCode.OK
        run.finish()
        assert "active" not in {each["state"] for each in run.of_kind("node")}
        run.assert_nothing_left()


@contextlib.contextmanager
def a_publisher(domain_id: int) -> Iterator[Node]:
    """Have a publisher that nobody declared."""
    with stranger(domain_id) as node:
        node.create_publisher(String, "chatter", 10)
        yield node


def test_who_appears_while_a_chain_is_activated_keeps_its_last_node_inactive(
    tmp_path: Path, fresh_domain: int
) -> None:
    """The last one would be activated on a verdict that is seconds old."""
    edit = {
        "nodes/listener/after": {"talker": "active"},
        "nodes/talker/run/environment": {
            "MISBEHAVE": "activate:wait",
            "MISBEHAVE_IF": str(tmp_path / "never"),
        },
    }
    with up(pair(tmp_path, fresh_domain, edit=edit), runtime=tmp_path) as run:
        run.until("log", line="about to wait in activate")
        with a_publisher(fresh_domain):
            # The step ends by itself: until then discovery has shown the newcomer to everybody.
            assert run.finish() == ExitCode.VIOLATED
        assert activated(run) == ["/talker"]
        reason = run.verdict["run"]["reason"]
        assert reason.startswith("the system changed before every node was activated; ")
        assert "/intruder (graph.undeclared-node)" in reason
        run.assert_nothing_left()


def test_who_appears_while_a_network_is_programmed_keeps_every_node_inactive(
    tmp_path: Path, fresh_domain: int
) -> None:
    """Programming takes seconds: the verdict that it was begun on is none of now."""
    begun, go = tmp_path / "begun", tmp_path / "go"
    tool = tmp_path / "nft"
    tool.write_text(
        f"#!/bin/sh\ntouch {begun}\nfor each in $(seq 200); do\n"
        f"  test -e {go} && break; sleep 0.05\ndone\n"
        "case $1 in -f) exit 0; esac\n"
        "echo 'Error: No such file or directory' >&2; exit 1\n"
    )
    tool.chmod(0o755)
    variables = {"PATH": f"{tmp_path}:{os.environ['PATH']}"}
    marked = {"publishers": {"chatter": {"dscp": "EF", "transport": "network"}}}
    manifest = pair(tmp_path, fresh_domain, edit={"nodes/talker/flows": marked})
    with up(manifest, "--program", "nft", runtime=tmp_path, variables=variables) as run:
        run.until("system", reached="verified")
        until(begun.exists)
        assert run.of_kind("verdict")[-1]["verdict"]["verdict"] == "ok"
        with a_publisher(fresh_domain) as node:
            # They have found each other both ways, or are about to.
            until(lambda: node.count_subscribers("chatter") == 1)
            until(lambda: any("lifecycle_observer" in each for each in node.get_node_names()))
            time.sleep(0.3)
            go.touch()
            assert run.finish() == ExitCode.VIOLATED
        assert activated(run) == []
        assert run.of_kind("gate") == []
        assert "active" not in {each["state"] for each in run.of_kind("node")}
        reason = run.verdict["run"]["reason"]
        assert reason.startswith("the system changed before every node was activated; ")
        assert "/intruder (graph.undeclared-node)" in reason
        run.assert_nothing_left()


@pytest.mark.parametrize(
    ("program", "rule"),
    [
        ((FOREIGN, "late", "--publish", _CHATTER), "graph.undeclared-node"),
        ((BARE_DDS, "--write", "rt/chatter:std_msgs::msg::dds_::String_"), _UNATTRIBUTED),
    ],
    ids=["a node", "a plain DDS program"],
)
def test_a_participant_that_gets_no_cpu_time_is_waited_for(
    tmp_path: Path, fresh_domain: int, program: Sequence[str], rule: str
) -> None:
    """As on a loaded machine, or by a limit of its control group: for longer than answers take."""
    with subprocess.Popen([sys.executable, *program], stdout=subprocess.PIPE) as intruder:
        try:
            assert intruder.stdout is not None
            assert intruder.stdout.readline() == b"ready\n"
            intruder.send_signal(signal.SIGSTOP)
            options = ("--timeout", "8", "--stop-after", "1")
            with up(pair(tmp_path, fresh_domain), *options, runtime=tmp_path) as run:
                run.until("node", node="/listener", state="inactive")
                # Until then the gate would be open: all that is declared is there.
                go_on = threading.Timer(0.5, intruder.send_signal, [signal.SIGCONT])
                go_on.start()
                assert run.finish() == ExitCode.VIOLATED
                go_on.join()
                assert activated(run) == []
                assert rule in {each["rule"] for each in run.verdict["findings"]}
                run.assert_nothing_left()
        finally:
            intruder.kill()


@pytest.mark.parametrize("order", ["resume", "restart"])
def test_who_appears_while_a_system_is_activated_again_has_it_held_and_not_ended(
    tmp_path: Path, fresh_domain: int, order: str
) -> None:
    go = tmp_path / "go"
    go.touch()
    edit = {
        "nodes/listener/after": {"talker": "active"},
        "nodes/talker/run/environment": {"MISBEHAVE": "activate:wait", "MISBEHAVE_IF": str(go)},
    }
    with up(pair(tmp_path, fresh_domain, edit=edit), runtime=tmp_path) as run:
        run.until("system", reached="active")
        if order == "resume":
            assert verb("pause", "pair", runtime=tmp_path).returncode == ExitCode.OK
            run.until("system", reached="paused")
        since = run.catch_up()
        go.unlink()
        with contextlib.ExitStack() as present:
            with ordered(order, tmp_path) as told:
                run.met("log", since=since, line="about to wait in activate")
                node = present.enter_context(a_publisher(fresh_domain))
                until(lambda: any("lifecycle_observer" in each for each in node.get_node_names()))
                time.sleep(0.3)
                go.touch()
                _, said = told.communicate(timeout=BOUND_S)
            assert told.returncode == ExitCode.VIOLATED
            assert said.startswith(
                "cannot activate: the system changed before every node was activated"
            )
            assert "graph.undeclared-node" in said
            run.met("notice", since=since, message="the gate closed again: /talker is deactivated")
            status = json.loads(verb("status", "pair", "--format", "json", runtime=tmp_path).stdout)
            assert status["phase"] == ("paused" if order == "resume" else "held")
            assert {each["state"] for each in status["nodes"]} == {"inactive"}
            run.catch_up()
            sent = [
                each["node"] for each in run.events[since:] if each.get("operation") == "activate"
            ]
            assert sent == ["/talker"]

        # As for one that is violated at once, the run goes on: it can be resumed later.
        until(lambda: verb("resume", "pair", runtime=tmp_path).returncode == ExitCode.OK)
        run.until("system", reached="active")
        assert verb("down", "pair", runtime=tmp_path).returncode == ExitCode.OK
        assert run.finish() == ExitCode.OK
        run.assert_nothing_left()


def until(holds: Callable[[], object]) -> None:
    """Wait, bounded, until something holds that no event tells of."""
    deadline = time.monotonic() + BOUND_S
    while not holds():
        assert time.monotonic() < deadline
        time.sleep(0.02)


@contextlib.contextmanager
def ordered(order: str, runtime: Path) -> Iterator[subprocess.Popen[str]]:
    """Give an order, and do something else while it is carried out."""
    with subprocess.Popen(
        [*command(order), "pair"],
        cwd=ROOT,
        env=environment(runtime, ""),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as told:
        try:
            yield told
        finally:
            told.kill()
