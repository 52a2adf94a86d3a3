"""Systems whose nodes meet by actions: brought up, judged, drawn and ended."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from lifecycle.errors import ExitCode
from tests.ros.supervisor.running import up, verb, write

pytestmark = pytest.mark.thorough

TYPE = "test_msgs/action/Fibonacci"
HIDDEN = ("send_goal", "cancel_goal", "get_result", "feedback", "status")
_NODES = "tests.ros.supervisor.acting"


def acting(directory: Path, domain_id: int) -> Path:
    """Write the manifest of a counter and a caller."""
    nodes: dict[str, Any] = {
        "counter": {
            "run": {"python": f"{_NODES}:Counter"},
            "namespace": "/robot",
            "remap": {f"count/_action/{each}": f"/tally/_action/{each}" for each in HIDDEN},
            "interface": {"action_servers": [{"name": "count", "type": TYPE}]},
            "connections": {
                "net": {"urls": ["udpv4://127.0.0.1"], "map": {"action_servers": ["count"]}}
            },
        },
        "caller": {
            "run": {"python": f"{_NODES}:Caller"},
            "after": {"counter": "active"},
            "remap": {f"count/_action/{each}": f"/tally/_action/{each}" for each in HIDDEN},
            "interface": {"action_clients": [{"name": "count", "type": TYPE}]},
        },
    }
    return write(directory, domain_id, nodes, "acting")


def test_a_remapped_action_on_a_connection_is_brought_up_judged_drawn_and_ended(
    tmp_path: Path, fresh_domain: int
) -> None:
    manifest = acting(tmp_path, fresh_domain)
    with up(manifest, runtime=tmp_path) as run:
        run.until("system", reached="active")
        run.met("log", line="counted [0, 1, 2], status 4")
        run.met("log", line="counts for ever")
        judged = verb("verify", str(manifest), "--format", "json", runtime=tmp_path)
        verdict = json.loads(judged.stdout)
        assert (verdict["verdict"], verdict["findings"], verdict["flows"]) == ("ok", [], [])
        drawn = verb("graph", str(manifest), runtime=tmp_path).stdout
        assert f"  action /tally  {TYPE}\n    /caller ──▶ /robot/counter\n" in drawn
        stopped = verb("down", "acting", runtime=tmp_path)
        assert stopped.returncode == ExitCode.OK, stopped.stderr
        assert run.finish() == ExitCode.OK
        run.assert_gate_held()
        run.assert_nothing_left()


def test_a_system_whose_action_raises_at_every_goal_does_not_end_well(
    tmp_path: Path, fresh_domain: int
) -> None:
    interface = {"name": "count", "type": TYPE}
    nodes: dict[str, Any] = {
        "counter": {
            "run": {"python": f"{_NODES}:Failing"},
            "interface": {"action_servers": [interface]},
        },
        "caller": {
            "run": {"python": f"{_NODES}:Asking"},
            "interface": {"action_clients": [interface]},
        },
    }
    with up(write(tmp_path, fresh_domain, nodes, "failing"), runtime=tmp_path) as run:
        run.until("system", reached="active")
        found = run.until_found("node.unhealthy", "/counter")
        assert any(
            "raised OSError: no such number" in each["message"] for each in found["findings"]
        )
        assert verb("down", "failing", runtime=tmp_path).returncode == ExitCode.OK
        assert run.finish() == ExitCode.VIOLATED
