"""Nothing is active that the gate has not let through, or on a verdict that is not of now."""

from __future__ import annotations

import asyncio
import contextlib
import gc
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import rclpy
from rclpy.node import Node
from std_msgs.msg import String

from lifecycle.errors import ExitCode
from lifecycle.middleware import GraphObserver, NodeClients
from tests.ros.supervisor.running import Up, pair, up, verb

_ELSEWHERE = str(Path(__file__).with_name("managed_elsewhere.py"))
_LIMITS = {"start_s": 8, "configure_s": 8, "connect_s": 8, "activate_s": 8, "silent_s": 8}
_BASE = {
    "nodes/base": {"run": {"command": [sys.executable, _ELSEWHERE]}, "timeouts": _LIMITS},
}


def change(domain_id: int, node: str, transition: str) -> bool:
    """Ask for a transition as anybody may; whether it succeeded."""
    observer = GraphObserver(domain_id)
    clients = NodeClients(observer)
    try:
        return asyncio.run(clients.change_state(node, transition, timeout_s=20.0))
    finally:
        clients.destroy()
        observer.destroy()


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


@pytest.fixture
def make_publisher() -> Iterator[object]:
    """A publisher that nobody declared."""
    with contextlib.ExitStack() as whole:

        def make(domain_id: int) -> None:
            context = rclpy.Context()
            context.init(args=[], domain_id=domain_id)
            whole.callback(gc.collect)
            whole.callback(context.destroy)
            whole.callback(context.try_shutdown)
            node = Node("intruder", context=context, enable_rosout=False)
            whole.callback(node.destroy_node)
            node.create_publisher(String, "chatter", 10)

        yield make


def test_who_appears_while_a_chain_is_activated_keeps_its_last_node_inactive(
    tmp_path: Path, fresh_domain: int, make_publisher
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
        make_publisher(fresh_domain)
        # The step ends by itself: until then discovery has shown the newcomer to everybody.
        assert run.finish() == ExitCode.VIOLATED
        assert activated(run) == ["/talker"]
        reason = run.verdict["run"]["reason"]
        assert reason.startswith("the system changed before every node was activated; ")
        assert "/intruder (graph.undeclared-node)" in reason
        run.assert_nothing_left()
