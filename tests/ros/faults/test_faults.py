"""Every fault through the real `lifecycle up`: caught, named, and nothing left behind."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.ros.faults.catalogue import FAULTS
from tests.ros.faults.running import UpRun, processes_of, run_up
from tests.ros.faults.system import ExitCode, Fault

pytestmark = pytest.mark.ros


def _of_kind(run: UpRun, kind: str) -> list[dict[str, object]]:
    return [event for event in run.events if event.get("event") == kind]


def _everything_said(run: UpRun) -> str:
    said = [json.dumps(event, ensure_ascii=False) for event in run.events if _is_told(event)]
    return "\n".join([*said, run.errors])


def _is_told(event: dict[str, object]) -> bool:
    """Only what states a cause counts: any event may name a node, and a log holds everything."""
    return event.get("event") in {"failure", "verdict", None}


def _assert_gate_held(run: UpRun, fault: Fault) -> None:
    kinds = [event.get("event") for event in run.events]
    activations = [
        index
        for index, event in enumerate(run.events)
        if event.get("event") == "request" and event.get("operation") == "activate"
    ]
    if activations:
        assert fault.activates, f"activated a system with a fault: {fault.name}"
        opened = kinds.index("gate")
        assert opened < min(activations)
        judged = [event["verdict"] for event in run.events[:opened] if event["event"] == "verdict"]
        assert not judged[-1]["blocking"]  # type: ignore[index]
    if not fault.activates:
        assert "gate" not in kinds
        assert not [line for line in run.markers if line.endswith((" activate", " active"))]


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.name)
def test_a_broken_system_is_refused_named_and_cleared_away(fault: Fault, tmp_path: Path) -> None:
    run = run_up(fault, tmp_path)

    said = _everything_said(run)
    assert run.exit_code == fault.exit_code, said
    assert fault.subject in said
    assert fault.message in said
    if run.events:
        end = run.events[-1]["run"]
        assert isinstance(end, dict)
        assert end["exit_code"] == fault.exit_code
        assert fault.subject in end["reason"]
    if fault.rule:
        findings = run.events[-1]["findings"]
        assert isinstance(findings, list)
        named = [(finding["rule"], finding["subject"]) for finding in findings]
        assert any(rule == fault.rule and fault.subject in subject for rule, subject in named), said
    _assert_gate_held(run, fault)
    assert processes_of(run.token) == []
    assert run.shared_memory == ()


def test_the_healthy_system_passes(tmp_path: Path) -> None:
    """Without it, every fault above could be caught for a reason of its own making."""
    healthy = Fault(
        name="none",
        edits={},
        exit_code=ExitCode.OK,
        subject="",
        activates=True,
        options=("--stop-after", "2"),
    )
    run = run_up(healthy, tmp_path)
    assert run.exit_code == ExitCode.OK, _everything_said(run)
    assert run.events[-1]["verdict"] == "ok"
    assert len([each for each in _of_kind(run, "request") if each["operation"] == "activate"]) == 2
    _assert_gate_held(run, healthy)
    activated = run.markers.index("listener activate")
    assert "listener message" in run.markers[activated:]
    assert "listener message" not in run.markers[:activated]
    assert processes_of(run.token) == []
    assert run.shared_memory == ()


def test_a_tool_that_only_listens_is_tolerated_and_listed(tmp_path: Path) -> None:
    """What `ros2 topic echo` is: it must neither stop the system nor go unsaid."""
    echo = Fault(
        name="none",
        edits={},
        exit_code=ExitCode.OK,
        subject="",
        activates=True,
        intruder=("_ros2cli_4711", "--subscribe", "/chatter:std_msgs/msg/String:RELIABLE"),
        options=("--strict", "--stop-after", "1"),
    )
    run = run_up(echo, tmp_path)
    assert run.exit_code == ExitCode.OK, _everything_said(run)
    assert run.events[-1]["verdict"] == "ok"
    assert run.events[-1]["tolerated"] == [
        {
            "node": "/_ros2cli_4711",
            "because": "tolerated_nodes: _ros2cli_*",
            "endpoints": [
                {
                    "kind": "subscriptions",
                    "node": "/_ros2cli_4711",
                    "name": "/chatter",
                    "type": "std_msgs/msg/String",
                }
            ],
        }
    ]
