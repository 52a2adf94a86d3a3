"""One system on two hosts: two supervisors, one verdict, and each activates only its own."""

from __future__ import annotations

import contextlib
import signal
import sys
import time
from pathlib import Path

import pytest

from lifecycle.errors import ExitCode
from lifecycle.supervisor.control.protocol import down, status
from tests.net.hosts import Host, Hosts
from tests.net.running import UNIQUE, article, run_directory, up_on, up_on_both
from tests.ros.supervisor.running import BOUND_S, ROOT, Up

_TOPICS = [
    {"name": "video", "type": "std_msgs/msg/String", "qos": "sensor_data"},
    {"name": "battery", "type": "std_msgs/msg/String"},
]
_NODE_OF = {"a": "/n1", "b": "/n2"}


def _driven(up: Up) -> set[str]:
    return {each["node"] for each in up.of_kind("request")}


def _doing(runtime: Path, machine: str) -> str:
    (node,) = status(run_directory(runtime, machine)).nodes
    return node.doing


def test_both_supervisors_activate_their_own_on_the_same_verified_flows(
    pair: tuple[Host, Host], tmp_path: Path
) -> None:
    manifest = article(tmp_path, pair[0].ipv4, pair[1].ipv4, edit=UNIQUE)
    with up_on_both(*pair, manifest, runtime=tmp_path) as ups:
        for up in ups:
            up.until("system", reached="active")
        ups[1].met("log", line="heard both")
        flows = ups[0].of_kind("verdict")[-1]["verdict"]["flows"]
        # Each looks at its own time; what they come to is the same.
        ups[1].until_verdict(lambda verdict: verdict["flows"] == flows)
        for up in ups:
            up.signal(signal.SIGTERM)
        assert [up.finish() for up in ups] == [ExitCode.OK, ExitCode.OK]
    for up, machine in zip(ups, "ab", strict=True):
        up.assert_gate_held()
        up.assert_nothing_left()
        assert _driven(up) == {_NODE_OF[machine]}
    assert [(each["topic"], each["unique"], each["outcome"]) for each in flows] == [
        ("/video", "strongly", "ok"),
        ("/battery", "strongly", "ok"),
    ]
    assert {each["effective_transport"] for each in flows} == {"udpv4"}


_MONITOR = {
    "machine": "a",
    "run": {"python": "tests.ros.supervisor.systems:Monitor"},
    "interface": {
        "subscriptions": [{"name": "/diagnostics", "type": "diagnostic_msgs/msg/DiagnosticArray"}]
    },
}


def test_each_supervisor_says_how_its_own_nodes_are_to_a_node_of_either(
    pair: tuple[Host, Host], tmp_path: Path
) -> None:
    edit = {**UNIQUE, "nodes/monitor": _MONITOR}
    manifest = article(tmp_path, pair[0].ipv4, pair[1].ipv4, edit=edit)
    with up_on_both(*pair, manifest, runtime=tmp_path) as ups:
        begun = []
        for up in ups:
            up.until("system", reached="active")
            begun.append(len(up.events))
        for said in ("a: /n1", "a: /monitor", "b: /n2"):
            ups[0].met("log", line=f"diagnosed article/{said} as active")
        for up, since in zip(ups, begun, strict=True):
            up.catch_up()
            later = [each for each in up.events[since:] if each.get("event") == "verdict"]
            assert [each["verdict"]["findings"] for each in later] == [[]] * len(later)


def test_the_gate_on_one_host_waits_for_the_nodes_of_the_other(
    pair: tuple[Host, Host], tmp_path: Path
) -> None:
    go = tmp_path / "go"
    held = {**UNIQUE, "nodes/n2/run/environment": {"HOLD_CONFIGURE_FILE": str(go)}}
    manifest = article(tmp_path, pair[0].ipv4, pair[1].ipv4, edit=held)
    with up_on_both(*pair, manifest, runtime=tmp_path) as (up_a, up_b):
        up_a.until("system", reached="connected")
        up_b.until("request", operation="configure")
        # A sees that B's node is there; what it does not say of itself is not believed.
        up_a.until_found("config.missing-report", "/n2")
        assert up_a.of_kind("gate") == []
        go.touch()
        gate = up_a.until("gate")
        assert gate["outcome"] == "ok"
        # One that leaves before the other has judged would be missed by it.
        for up in (up_a, up_b):
            up.until("system", reached="active")
        for up in (up_a, up_b):
            up.signal(signal.SIGTERM)
        assert (up_a.finish(), up_b.finish()) == (ExitCode.OK, ExitCode.OK)
    up_a.assert_gate_held()
    up_b.assert_gate_held()


def test_a_step_waits_for_a_node_on_another_host(pair: tuple[Host, Host], tmp_path: Path) -> None:
    go = tmp_path / "go"
    edit = {
        "nodes/n1/run/environment": {"HOLD_CONFIGURE_FILE": str(go)},
        "nodes/n2/after": {"n1": "configured"},
    }
    manifest = article(tmp_path, pair[0].ipv4, pair[1].ipv4, edit=edit)
    with up_on_both(*pair, manifest, runtime=tmp_path) as (up_a, up_b):
        up_a.until("request", operation="configure")
        up_b.until("node", reach="started")
        deadline = time.monotonic() + BOUND_S
        while _doing(tmp_path / "b", "b") != "waits to configure until /n1 is configured":
            assert time.monotonic() < deadline
            time.sleep(0.01)
        assert up_b.of_kind("request") == []
        go.touch()
        up_b.until("request", operation="configure")
        for up in (up_a, up_b):
            up.until("system", reached="active")
        assert [down(run_directory(tmp_path / each, each), BOUND_S) for each in "ab"] == [
            ExitCode.OK,
            ExitCode.OK,
        ]
        assert (up_a.finish(), up_b.finish()) == (ExitCode.OK, ExitCode.OK)


def test_a_step_waits_for_what_a_driver_shows_on_another_host(
    pair: tuple[Host, Host], tmp_path: Path
) -> None:
    notes = tmp_path / "notes"
    run = {
        "command": [sys.executable, "-m", "tests.ros.supervisor.late_driver", "driver"],
        "environment": {"NOTES": str(notes), "COMES": "publishes:2 serves:1", "READY": "1"},
        "working_directory": str(ROOT),
    }
    edit = {
        "nodes/driver": {"run": run, "machine": "a", "managed": False, "endpoints": "open"},
        "nodes/n2/after": {
            "driver": {"publishes": "scan", "serves": "~/reset", "parameter": "ready"}
        },
    }
    manifest = article(tmp_path, pair[0].ipv4, pair[1].ipv4, edit=edit)
    with up_on_both(*pair, manifest, runtime=tmp_path) as (up_a, up_b):
        up_b.until("node", reach="started")
        up_b.until("request", operation="configure")
        configured_s = time.time()
        (served_s,) = (
            float(each.rpartition(" ")[2])
            for each in notes.read_text().splitlines()
            if each.startswith("driver serves ")
        )
        assert served_s < configured_s < served_s + 2.0
        for up in (up_a, up_b):
            up.until("system", reached="active")
            up.signal(signal.SIGTERM)
        assert (up_a.finish(), up_b.finish()) == (ExitCode.OK, ExitCode.OK)


def test_no_host_activates_when_a_node_of_one_fails(
    pair: tuple[Host, Host], tmp_path: Path
) -> None:
    edit = {"nodes/n2/run/environment": {"FAIL_CONFIGURE": "1"}}
    manifest = article(tmp_path, pair[0].ipv4, pair[1].ipv4, edit=edit)
    with up_on_both(*pair, manifest, "--timeout", "6", runtime=tmp_path) as (up_a, up_b):
        assert up_b.finish() == ExitCode.BRING_UP_FAILED
        assert up_a.finish() == ExitCode.VIOLATED
    for up in (up_a, up_b):
        assert "activate" not in {each["operation"] for each in up.of_kind("request")}
        up.assert_nothing_left()
    missing = {
        each["subject"]: each["hint"]
        for each in up_a.verdict["findings"]
        if each["rule"] == "graph.missing-node"
    }
    assert missing == {
        "/n2": "its machine has a supervisor of its own: lifecycle up MANIFEST --machine b"
    }


def test_a_host_that_is_held_reports_when_the_other_one_leaves(
    pair: tuple[Host, Host], tmp_path: Path
) -> None:
    manifest = article(tmp_path, pair[0].ipv4, pair[1].ipv4)
    with up_on_both(*pair, manifest, runtime=tmp_path) as (up_a, up_b):
        for up in (up_a, up_b):
            up.until("system", reached="active")
        since = len(up_b.events)
        up_a.signal(signal.SIGTERM)
        assert up_a.finish() == ExitCode.OK
        up_b.until_found("graph.missing-node", "/n1", since=since)
        assert up_b.of_kind("stopping") == []
        up_b.signal(signal.SIGTERM)
        assert up_b.finish() == ExitCode.OK


@pytest.mark.parametrize("at_once", [False, True], ids=["once it is missed", "at once"])
def test_after_a_supervisor_was_killed_the_next_one_takes_its_place_within_the_lease(
    pair: tuple[Host, Host], tmp_path: Path, *, at_once: bool
) -> None:
    """The next one ends what was kept, and has its own there within 0.1 s, if nothing holds it."""
    manifest = article(tmp_path, pair[0].ipv4, pair[1].ipv4, edit={"nodes/monitor": _MONITOR})
    diagnosed = {"line": "diagnosed article/b: /n2 as active"}
    with up_on_both(*pair, manifest, "--keep-going", runtime=tmp_path) as (up_a, up_b):
        for up in (up_a, up_b):
            up.until("system", reached="active")
        up_a.met("log", **diagnosed)
        since = up_a.catch_up()
        up_b.signal(signal.SIGKILL)
        up_b.process.wait(BOUND_S)
        go = tmp_path / "go"
        held = {} if at_once else {"HOLD_START_FILE": str(go)}
        with up_on(
            pair[1], manifest, "--machine", "b", runtime=tmp_path / "b", variables=held
        ) as again:
            if not at_once:
                up_a.until_found("graph.missing-node", "/n2", since=since)
                go.touch()
            again.until("system", reached="active")
            up_a.catch_up()
            up_a.until("log", **diagnosed)
            up_a.until_verdict(lambda verdict: verdict["verdict"] == "ok", since=since)
        verdicts = [
            each["verdict"] for each in up_a.events[since:] if each.get("event") == "verdict"
        ]
        of_n2 = {
            each["rule"]
            for verdict in verdicts
            for each in verdict["findings"]
            if each["node"] == "/n2"
        }
        # At once, the next one is seen as not active yet, or the killed one as missing.
        assert of_n2 if at_once else "graph.missing-node" in of_n2
        # The killed one is in the graph until its lease is over: none is taken for the supervisor.
        undeclared = [
            each
            for verdict in verdicts
            for each in verdict["findings"]
            if each["rule"].startswith("graph.undeclared")
        ]
        assert all("/_lifecycle_observer_" in each["message"] for each in undeclared), undeclared


def test_without_a_machine_named_a_host_runs_those_that_have_its_address(
    pair: tuple[Host, Host], tmp_path: Path
) -> None:
    manifest = article(tmp_path, pair[0].ipv4, pair[1].ipv4)
    with contextlib.ExitStack() as stack:
        ups = [
            stack.enter_context(up_on(host, manifest, runtime=tmp_path / host.name))
            for host in pair
        ]
        for up in ups:
            up.until("system", reached="active")
        for up in ups:
            up.signal(signal.SIGTERM)
        assert [up.finish() for up in ups] == [ExitCode.OK, ExitCode.OK]
    assert [_driven(up) for up in ups] == [{"/n1"}, {"/n2"}]


def test_hosts_beyond_a_router_find_each_other_by_their_addresses(
    hosts: Hosts, tmp_path: Path
) -> None:
    left, _, right = hosts.routed("A", "B")
    # Each in a process of its own: more participants than rmw looks for by itself.
    more = {
        f"nodes/{name}{number}": {
            "run": {"python": f"tests.net.systems:{kind}"},
            "machine": machine,
            "interface": {"publishers" if kind == "Source" else "subscriptions": _TOPICS},
        }
        for number in range(3, 8)
        for name, kind, machine in (("out", "Source", "a"), ("in", "Sink", "b"))
    }
    link = {"topic": "/video", "from": "out7", "to": "in7"}
    manifest = article(tmp_path, left.ipv4, right.ipv4, edit={**more, "links": [link]})
    with up_on_both(left, right, manifest, "--timeout", "60", runtime=tmp_path) as ups:
        for up in ups:
            up.until("system", reached="active")
        ups[1].met("log", process="in7", line="heard both")
        for up in ups:
            up.signal(signal.SIGTERM)
        assert [up.finish() for up in ups] == [ExitCode.OK, ExitCode.OK]
