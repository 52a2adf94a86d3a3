"""Systems whose nodes meet by services: the gate waits until clients are matched with servers."""

from __future__ import annotations

import signal
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.ros.supervisor.running import ROOT, Event, up

pytestmark = pytest.mark.thorough

ASK = {"name": "ask", "type": "std_srvs/srv/Trigger"}
SERVER = ROOT / "tests" / "ros" / "supervisor" / "answering.py"


def asking(directory: Path, domain_id: int, reliability: str) -> Path:
    """Write the manifest of a client of ours and a server that is an ordinary node."""
    nodes: dict[str, Any] = {
        "answering": {
            "run": {"command": [sys.executable, str(SERVER), "/ask", reliability]},
            "managed": False,
            "interface": {"service_servers": [ASK]},
        },
        "asking": {
            "run": {"python": "tests.ros.supervisor.systems:Quiet"},
            "interface": {"service_clients": [ASK]},
        },
    }
    document = {
        "manifest_version": 1,
        "system": "asking",
        "discovery": {"domain_id": domain_id, "range": "localhost"},
        "nodes": nodes,
    }
    file = directory / "asking.lifecycle.yaml"
    file.write_text(yaml.safe_dump(document))
    return file


def violations(verdict: Event) -> list[Any]:
    return [each for each in verdict["findings"] if each["outcome"] == "violated"]


def test_a_system_is_activated_once_its_client_is_matched(
    tmp_path: Path, fresh_domain: int
) -> None:
    with up(asking(tmp_path, fresh_domain, "RELIABLE"), runtime=tmp_path) as run:
        run.until("system", reached="active")
        run.assert_gate_held()
        run.signal(signal.SIGINT)
        run.finish()
        run.assert_nothing_left()


def test_a_server_that_dds_does_not_match_keeps_the_gate_closed(
    tmp_path: Path, fresh_domain: int
) -> None:
    with up(asking(tmp_path, fresh_domain, "BEST_EFFORT"), runtime=tmp_path) as run:
        verdict = run.until_verdict(
            lambda each: [one["rule"] for one in violations(each)] == ["graph.unmatched-client"]
        )
        (finding,) = violations(verdict)
        assert finding["subject"] == "/ask: /asking → /answering"
        assert finding["message"] == (
            "cannot see /asking → /answering matched on service /ask: the client counts no server "
            "as available"
        )
        run.signal(signal.SIGINT)
        run.finish()
        assert run.of_kind("gate") == []
        run.assert_gate_held()
        run.assert_nothing_left()
