"""A supervisor that wires its nodes, on real DDS: before, while and after, and what it repairs."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import psutil
import pytest

from lifecycle.errors import ExitCode
from lifecycle.supervisor.core.gate import SETTLED_S
from tests.ros.middleware.free_ports import first_port
from tests.ros.stranger import ask
from tests.ros.supervisor.running import BOUND_S, ENOUGH, ROOT, Up, left_of, pair, up, verb

pytestmark = pytest.mark.thorough

GROWING = "examples.nine_systems.nodes"
NET = {"urls": ["udpv4://127.0.0.1"]}
AUTHORITY = {
    "discovery/transport": "shm",
    "data_layer": {"authority": "supervisor", "events": True},
    "nodes/talker/connections": {"net": {**NET, "map": {"publishers": ["chatter"]}}},
    "nodes/listener/connections": {"net": {**NET, "map": {"subscriptions": ["chatter"]}}},
}
"""Nothing is open for data until the supervisor says connect."""

DYNAMIC = {
    "data_layer": {"authority": "supervisor", "source": "dynamic", "events": True},
    "policy": {"unheard": "ignore"},
    "links": [],
    "nodes/talker/run": {"python": f"{GROWING}:GrowingTalker"},
    "nodes/talker/endpoints": "open",
    "nodes/talker/interface/service_servers": [{"name": "~/grow", "type": "std_srvs/srv/Trigger"}],
    "nodes/talker/interface/parameters": {
        "grow_after_s": {"type": "double", "default_value": 0.0, "description": "s"}
    },
    "nodes/talker/parameters": {"grow_after_s": 0.3},
    "nodes/talker/flows": {"publishers": {"chatter": {"transport": "udpv4"}}},
}
"""The talker's chatter goes by UDP although both are on one host; and it grows one more topic."""


def ip_sockets(pid: int) -> list[str]:
    """Every IP socket that a process has, as the kernel says."""
    found = psutil.Process(pid).net_connections(kind="inet")
    return [f"{each.type.name} {each.laddr.ip}:{each.laddr.port}" for each in found]


def told(run: Up, node: str) -> list[tuple[str, str, str]]:
    """What a node was told, in order."""
    return [
        (each["operation"], each["endpoint"], each["connection"])
        for each in run.of_kind("wiring")
        if each["node"] == node and not each["error"]
    ]


def until_ok(run: Up, since: int) -> None:
    """Read on until a verdict is ok; it may have come already, after the first `since` events."""
    run.until_verdict(lambda verdict: verdict["verdict"] == "ok", since=since)


def test_a_pair_is_wired_over_udp_where_nothing_was_open_before(
    tmp_path: Path, fresh_domain: int
) -> None:
    edit = {**AUTHORITY, "nodes/listener/after": {"talker": "connected"}}
    manifest = pair(tmp_path, fresh_domain, misbehave="connect:hang", edit=edit)
    with up(manifest, runtime=tmp_path) as run:
        run.until("log", line="about to hang in connect")
        run.met("node", node="/listener", reach="configured")
        # The talker was told, the listener was not: it waits for the talker.
        assert ip_sockets(run.pid_of("listener")) == []
        assert any("DGRAM 127.0.0.1" in each for each in ip_sockets(run.pid_of("talker")))
    with up(pair(tmp_path, fresh_domain, edit=AUTHORITY), runtime=tmp_path) as run:
        run.until("system", reached="active")
        run.met("log", line="heard hello")
        run.signal(signal.SIGTERM)
        assert run.finish() == ExitCode.OK
        run.assert_gate_held()
        for node, endpoint in (("/talker", "publishers/chatter"), ("/listener", None)):
            assert told(run, node) == [
                ("connect_to", "", "net"),
                ("map_to", endpoint or "subscriptions/chatter", "net"),
                ("disconnect_from", "", "net"),
            ]
        (flow,) = run.verdict["flows"]
        assert (flow["effective_transport"], flow["outcome"]) == ("udpv4", "ok")


def test_a_connection_that_cannot_be_made_ends_bring_up_with_the_nodes_reason(
    tmp_path: Path, fresh_domain: int
) -> None:
    # TEST-NET-1 (RFC 5737): an address of nobody's.
    edit = {
        **AUTHORITY,
        "nodes/talker/connections": {
            "net": {"urls": ["udpv4://192.0.2.1"], "map": {"publishers": ["chatter"]}}
        },
    }
    with up(pair(tmp_path, fresh_domain, edit=edit), runtime=tmp_path) as run:
        assert run.finish() == ExitCode.BRING_UP_FAILED
        finding = run.verdict["findings"][0]
        assert (finding["rule"], finding["subject"]) == ("run.not-wired", "/talker")
        assert finding["message"].startswith(
            "cannot connect '/talker' to 'net' (udpv4://192.0.2.1): "
        )
        assert "192.0.2.1" in finding["message"].partition("): ")[2]


def test_an_endpoint_that_appears_while_running_is_wired_and_verified(
    tmp_path: Path, fresh_domain: int
) -> None:
    manifest = pair(tmp_path, fresh_domain, edit=DYNAMIC)
    with up(manifest, runtime=tmp_path) as run:
        run.until("system", reached="active")
        # It may come while the supervisor still makes sure that all are active.
        run.met("wiring", node="/talker", operation="map_to", endpoint="publishers/news")
        before = told(run, "/talker")
        assert before.count(("map_to", "publishers/news", "")) == 1
        # Only the difference was made: nobody touched what was there.
        assert [each for each in before if "chatter" in each[1]] == [before[1]]
        # Whoever looks on comes to the same, although no manifest says what was negotiated.
        judged = verb("verify", str(manifest), *ENOUGH, "--format", "json", runtime=tmp_path)
        assert json.loads(judged.stdout)["findings"] == []
        assert judged.returncode == ExitCode.OK
        run.signal(signal.SIGTERM)
        assert run.finish() == ExitCode.OK


def test_a_node_that_nobody_declared_is_negotiated_with_wired_and_never_driven(
    tmp_path: Path, fresh_domain: int
) -> None:
    edit = {
        **DYNAMIC,
        "policy": {"unheard": "ignore", "undeclared_nodes": "open"},
        "nodes/talker/parameters": {"grow_after_s": 0.0},
        "nodes/talker/flows": {"publishers": {"chatter": {"transport": "tcpv4"}}},
        "discovery/first_port": first_port(),
    }
    with up(pair(tmp_path, fresh_domain, edit=edit), runtime=tmp_path) as run:
        run.until("system", reached="active")
        guest = subprocess.Popen(
            [sys.executable, "-m", "examples.nine_systems.guest"],
            cwd=ROOT,
            env={**os.environ, "ROS_DOMAIN_ID": str(fresh_domain)},
            stdout=subprocess.PIPE,
            text=True,
        )
        assert guest.stdout is not None
        bound = threading.Timer(BOUND_S, guest.kill)  # which ends its output
        bound.start()
        try:
            run.until("wiring", node="/guest", operation="map_to", error="")
            assert "heard hello\n" in guest.stdout
            assert told(run, "/guest")[0][0] == "connect_to"
            assert not [each for each in run.of_kind("request") if each["node"] == "/guest"]
            run.signal(signal.SIGTERM)
            assert run.finish() == ExitCode.OK, run.said()
            # It is somebody else's: it goes on without us, and without what we gave it.
            assert guest.poll() is None
            assert told(run, "/guest")[-1][0] == "disconnect_from"
        finally:
            bound.cancel()
            guest.kill()
            guest.wait()
            guest.stdout.close()


def test_a_lost_connection_is_told_and_made_again(tmp_path: Path, fresh_domain: int) -> None:
    edit = {**AUTHORITY, "discovery/transport": "udpv4"}
    with up(pair(tmp_path, fresh_domain, edit=edit), runtime=tmp_path) as run:
        run.until("system", reached="active")
        began = time.monotonic()
        ask(
            fresh_domain,
            lambda each: each.wire("/talker", "disconnect", "net", timeout_s=BOUND_S),
        )
        run.until("lost", node="/talker", connection="net", endpoint="")
        since = len(run.events)
        run.until("wiring", node="/talker", operation="map_to", connection="net")
        until_ok(run, since)
        healed_s = time.monotonic() - began
        run.signal(signal.SIGTERM)
        # It was violated for a moment, and healed before that counted; a busy machine may be slow.
        assert run.finish() == ExitCode.OK or healed_s > SETTLED_S


def served() -> dict[str, Any]:
    return {
        "discovery/mode": "server",
        "discovery/range": "system_default",
        "discovery/first_port": first_port(),
    }


def test_the_server_starts_before_any_node_and_ends_after_all_of_them(
    tmp_path: Path, fresh_domain: int
) -> None:
    options = ("--until", "connected")
    with up(pair(tmp_path, fresh_domain, edit=served()), *options, runtime=tmp_path) as run:
        assert run.finish() == ExitCode.OK
        told = [(each["process"], each["state"]) for each in run.of_kind("process")]
        assert told[:2] == [("discovery_server", "starting"), ("discovery_server", "running")]
        assert told[-1] == ("discovery_server", "exited")
        run.assert_nothing_left()


def test_a_killed_supervisor_leaves_no_discovery_server(tmp_path: Path, fresh_domain: int) -> None:
    manifest = pair(tmp_path, fresh_domain, edit=served())
    options = ("--until", "connected", "--stop-after", "30")
    with up(manifest, *options, runtime=tmp_path) as run:
        run.until("system", reached="connected")
        server = psutil.Process(run.pid_of("discovery_server"))
        run.signal(signal.SIGKILL)
        run.process.wait(BOUND_S)
        assert left_of(run.mark, within_s=10) == []
        assert not server.is_running() or server.status() == psutil.STATUS_ZOMBIE
    assert verb("down", "pair", runtime=tmp_path).returncode == 0
