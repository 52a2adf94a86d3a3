"""What the gate requires, and what it takes on trust and says so, on real DDS."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import pytest

from lifecycle.errors import ExitCode
from tests.ros.supervisor.running import ENOUGH, ROOT, pair, up, verb, write

pytestmark = pytest.mark.thorough

_FOREIGN = str(ROOT / "tests" / "ros" / "faults" / "foreign.py")
_NUMBERS = {"max_delay_ms": 0.0001, "rate_hz": 500, "loss": 1e-6, "max_message_size": 3}


def _ordinary(*arguments: str, **interface: list[dict[str, Any]]) -> dict[str, Any]:
    """A plain rclpy node, whose manifest says nothing of QoS."""
    run = {"command": [sys.executable, _FOREIGN, *arguments]}
    return {"run": run, "managed": False, "interface": interface}


def test_ordinary_ros_2_nodes_whose_qos_nobody_wrote_pass_the_strict_gate(
    tmp_path: Path, fresh_domain: int
) -> None:
    chatter = {"name": "/chatter", "type": "std_msgs/msg/String"}
    ask = {"name": "/ask", "type": "std_srvs/srv/Trigger"}
    dock = {"name": "/dock", "type": "test_msgs/action/Fibonacci"}
    best_effort = "/chatter:std_msgs/msg/String:BEST_EFFORT"
    nodes = {
        "talker": _ordinary(
            *("talker", "--publish", best_effort, "--answer", "/ask:std_srvs/srv/Trigger"),
            *("--serve", "/dock:test_msgs/action/Fibonacci"),
            publishers=[chatter],
            service_servers=[ask],
            action_servers=[dock],
        ),
        "listener": _ordinary(
            *("listener", "--subscribe", best_effort, "--call", "/ask:std_srvs/srv/Trigger"),
            subscriptions=[chatter],
            service_clients=[ask],
        ),
    }
    # Nothing proves that data flow between two that report nothing, so that has to be trusted.
    trust = {"trust": ["flow.unreported"]}
    manifest = write(tmp_path, fresh_domain, nodes, "ordinary", policy=trust)
    with up(manifest, "--strict", "--stop-after", "0.2", runtime=tmp_path) as run:
        assert run.finish() == ExitCode.OK, run.verdict
        assert run.verdict["verdict"] == "ok"
        assert [each["rule"] for each in run.verdict["findings"]] == ["flow.unreported"]
        (gate,) = run.of_kind("gate")
        assert gate["outcome"] == "ok"
        assert gate["trusted"] == "/chatter: /talker → /listener (flow.unreported)"


def test_numbers_that_nobody_measures_are_named_at_the_gate_and_refused_when_strict(
    tmp_path: Path, fresh_domain: int
) -> None:
    # Its host would count what arrives; a program of others counts nothing.
    listener = _ordinary(
        *("listener", "--subscribe", "/chatter:std_msgs/msg/String:RELIABLE"),
        subscriptions=[{"name": "/chatter", "type": "std_msgs/msg/String"}],
    )
    edit = {
        "nodes/talker/flows": {"publishers": {"chatter": _NUMBERS}},
        "nodes/listener": listener,
    }
    manifest = pair(tmp_path, fresh_domain, edit=edit)
    trusted = (
        "max_delay_ms 0.0001 of /chatter, loss 1e-06 of /chatter and 2 more (flow.not-measured)"
    )
    with up(manifest, runtime=tmp_path) as run:
        gate = run.until("gate")
        assert (gate["outcome"], gate["trusted"]) == ("unverifiable", trusted)
        run.met("system", reached="active")
        strict = verb(
            "verify", str(manifest), *ENOUGH, "--strict", "--format", "json", runtime=tmp_path
        )
        assert strict.returncode == ExitCode.UNVERIFIABLE
        findings = json.loads(strict.stdout)["findings"]
        assert {each["rule"] for each in findings} == {"flow.not-measured"}
        named = [each["expected"].partition(" ")[0] for each in findings]
        assert sorted(named) == sorted(_NUMBERS)
        assert all(each["at"].startswith(f"{manifest}:") for each in findings)
        assert len({each["at"] for each in findings}) == len(_NUMBERS)
        lenient = verb("verify", str(manifest), *ENOUGH, runtime=tmp_path)
        assert lenient.returncode == ExitCode.OK
        assert verb("down", str(manifest), runtime=tmp_path).returncode == ExitCode.OK
        run.finish()
        assert run.verdict["verdict"] == "unverifiable"
        assert run.verdict["run"]["trusted"] == trusted
