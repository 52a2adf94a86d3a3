"""`lifecycle apply` to a running system, on real DDS: what is the same is not touched."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from lifecycle.errors import ExitCode
from lifecycle.supervisor.control.protocol import SystemStatus
from lifecycle.supervisor.control.protocol import status as ask_status
from lifecycle.verify.outcome import Outcome
from tests.ros.supervisor.running import Up, pair, up, verb

_NODES = "tests.ros.supervisor.systems"
RATE = {"rate": {"type": "double", "default_value": 10.0}}


def manifest(directory: Path, domain_id: int, *, rate: float, **nodes: Mapping[str, Any]) -> Path:
    """Write a pair, a bystander with a parameter, and more nodes; return the path."""
    bystander = {
        "run": {"python": f"{_NODES}:Quiet"},
        "interface": {"parameters": RATE},
        "parameters": {"rate": rate},
    }
    edit = {"nodes/bystander": bystander, **{f"nodes/{key}": each for key, each in nodes.items()}}
    return pair(directory, domain_id, edit=edit)


CHATTER = {"name": "chatter", "type": "std_msgs/msg/String"}


def listener(**qos: object) -> dict[str, Any]:
    return {
        "run": {"python": f"{_NODES}:Listener"},
        "interface": {"subscriptions": [{**CHATTER, **({"qos": qos} if qos else {})}]},
    }


BROKEN = {
    "run": {"python": f"{_NODES}:Talker", "environment": {"MISBEHAVE": "configure:raise"}},
    "interface": {"publishers": [CHATTER]},
}


def apply(path: Path, *options: str) -> dict[str, Any]:
    """Apply a manifest; return its report."""
    done = verb("apply", str(path), "--format", "json", *options, runtime=path.parent)
    report = json.loads(done.stdout)
    assert isinstance(report, dict)
    assert report["exit_code"] == done.returncode, done.stderr
    return report


def status(runtime: Path) -> tuple[SystemStatus, dict[str, int]]:
    """Status of the system, and the pid of each node."""
    (run,) = (runtime / "lifecycle").iterdir()
    told = ask_status(run)
    assert {each.state for each in told.nodes} == {"active"}
    return told, {each.node: each.pid for each in told.nodes}


def transitions(run: Up, since: int) -> set[str]:
    """Nodes that were asked for a transition after the first `since` events."""
    run.catch_up()
    asked = {"configure", "connect", "activate", "deactivate", "disconnect", "cleanup", "shutdown"}
    return {
        each["node"]
        for each in run.events[since:]
        if each.get("event") == "request" and each["operation"] in asked
    }


def test_nodes_come_and_go_and_take_parameters_while_all_others_run_on(
    tmp_path: Path, fresh_domain: int
) -> None:
    with up(manifest(tmp_path, fresh_domain, rate=1.0), runtime=tmp_path) as run:
        run.until("system", reached="active")
        since = len(run.events)
        _, before = status(tmp_path)

        path = manifest(tmp_path, fresh_domain, rate=2.0, second=listener())
        shown = verb("apply", str(path), "--dry-run", runtime=tmp_path)
        assert shown.returncode == ExitCode.VIOLATED
        assert "nodes.second: was not declared, is declared\n" in shown.stdout
        assert "nodes.bystander.parameters.rate: was 1.0, is 2.0\n" in shown.stdout
        assert shown.stdout.endswith("added: /second\ngiven parameters: /bystander\n")

        report = apply(path)
        assert (report["outcome"], report["revision"]) == ("applied", 2)
        assert (report["added"], report["parameters"]) == (["/second"], ["/bystander"])
        told, now = status(tmp_path)
        assert {name: now[name] for name in before} == before
        assert (told.phase, told.verdict, told.revision) == ("active", Outcome.OK, 2)
        assert transitions(run, since) == {"/second"}

        since = len(run.events)
        assert apply(manifest(tmp_path, fresh_domain, rate=2.0))["removed"] == ["/second"]
        assert status(tmp_path)[1] == before
        assert transitions(run, since) == {"/second"}
        assert run.met("process", since=since, process="second", state="exited")
        assert verb("down", "pair", runtime=tmp_path).returncode == ExitCode.OK
        assert run.finish() == ExitCode.OK
        run.assert_gate_held()
        run.assert_nothing_left()


@pytest.mark.thorough
def test_endpoints_that_change_restart_their_nodes_and_what_fails_is_as_if_it_had_not_been(
    tmp_path: Path, fresh_domain: int
) -> None:
    with up(manifest(tmp_path, fresh_domain, rate=1.0), runtime=tmp_path) as run:
        run.until("system", reached="active")
        _, before = status(tmp_path)

        report = apply(manifest(tmp_path, fresh_domain, rate=3.0, second=BROKEN))
        assert (report["outcome"], report["exit_code"]) == ("rolled_back", ExitCode.BRING_UP_FAILED)
        assert "the sensor is on fire" in report["error"]
        assert report["error"].endswith("is in force again, revision 1, active and verified")
        told, now = status(tmp_path)
        assert (told.verdict, told.revision, now) == (Outcome.OK, 1, before)

        deeper = listener(history="KEEP_LAST", depth=3, reliability="RELIABLE")
        report = apply(manifest(tmp_path, fresh_domain, rate=1.0, listener=deeper))
        assert (report["outcome"], report["restarted"]) == ("applied", ["/listener"])
        told, now = status(tmp_path)
        changed = now.pop("/listener")
        assert changed != before.pop("/listener")
        assert (told.verdict, now) == (Outcome.OK, before)

        # Another name or domain is another system, and this one is named.
        for other in (
            pair(tmp_path, fresh_domain, edit={"system": "other"}),
            pair(tmp_path, fresh_domain + 1),
        ):
            refused = verb("apply", str(other), runtime=tmp_path)
            assert refused.returncode == ExitCode.USAGE
            assert f"running: pair@{fresh_domain}" in refused.stderr
        assert status(tmp_path)[1] == {**before, "/listener": changed}

        # It goes on by the manifest in force.
        assert verb("restart", "pair", runtime=tmp_path).returncode == ExitCode.OK
        assert verb("down", "pair", runtime=tmp_path).returncode == ExitCode.OK
        assert run.finish() == ExitCode.OK
        run.assert_gate_held()
        run.assert_nothing_left()
        history = verb("history", runtime=tmp_path).stdout
        assert "the manifest before is in force again, revision 1" in history


@pytest.mark.thorough
def test_a_running_node_is_connected_otherwise_where_the_supervisor_connects_it(
    tmp_path: Path, fresh_domain: int
) -> None:
    how = {"data_layer": {"source": "dynamic", "authority": "supervisor"}}
    with up(pair(tmp_path, fresh_domain, edit=how), runtime=tmp_path) as run:
        run.until("system", reached="active")
        since = len(run.events)
        _, before = status(tmp_path)
        link = {"topic": "/chatter", "from": "talker", "to": "listener", "transport": "network"}
        report = apply(pair(tmp_path, fresh_domain, edit={**how, "links": [link]}))
        assert (report["outcome"], report["restarted"]) == ("applied", [])
        told, now = status(tmp_path)
        assert (told.verdict, now) == (Outcome.OK, before)
        assert transitions(run, since) == set()
        run.met("wiring", since=since, operation="map_to", endpoint="publishers/chatter")
        assert apply(pair(tmp_path, fresh_domain, edit=how))["outcome"] == "applied"
        assert status(tmp_path)[1] == before
        assert verb("down", "pair", runtime=tmp_path).returncode == ExitCode.OK
        assert run.finish() == ExitCode.OK
        run.assert_gate_held()
        run.assert_nothing_left()
