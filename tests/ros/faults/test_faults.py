"""Every fault through the real `lifecycle up`: caught, named, and nothing left behind."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.ros.faults.catalogue import FAULTS
from tests.ros.faults.running import ended
from tests.ros.faults.system import ExitCode, Fault
from tests.ros.supervisor.running import Up

pytestmark = pytest.mark.ros


def _everything_said(run: Up) -> str:
    """Only what states a cause counts: any event may name a node, and a log holds everything."""
    causes = [each for each in run.events if each.get("event") in {"failure", "verdict", None}]
    return "\n".join([*(json.dumps(each, ensure_ascii=False) for each in causes), run.said()])


def _assert_gate_held(run: Up, fault: Fault, markers: list[str]) -> None:
    run.assert_gate_held()
    activated = [e for e in run.of_kind("request") if e["operation"] == "activate"]
    assert fault.activates or not activated, f"activated a system with a fault: {fault.name}"
    if not fault.activates:
        assert run.of_kind("gate") == []
        assert not [line for line in markers if line.endswith((" activate", " active"))]


@pytest.mark.parametrize(
    "fault",
    [
        pytest.param(each, id=each.name, marks=() if each.quick else pytest.mark.thorough)
        for each in FAULTS
    ],
)
def test_a_broken_system_is_refused_named_and_cleared_away(fault: Fault, tmp_path: Path) -> None:
    with ended(fault, tmp_path) as (run, code):
        said = _everything_said(run)
        assert code == fault.exit_code, said
        assert fault.subject in said
        assert fault.message in said
        if run.events:
            assert run.verdict["run"]["exit_code"] == fault.exit_code
            assert fault.subject in run.verdict["run"]["reason"]
        if fault.rule:
            named = [(each["rule"], each["subject"]) for each in run.verdict["findings"]]
            assert any(each == fault.rule and fault.subject in subject for each, subject in named)
        _assert_gate_held(run, fault, _markers(tmp_path))


def _markers(directory: Path) -> list[str]:
    return (directory / "markers").read_text().splitlines()


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
    with ended(healthy, tmp_path) as (run, code):
        assert code == ExitCode.OK, _everything_said(run)
        assert run.verdict["verdict"] == "ok"
        assert len([e for e in run.of_kind("request") if e["operation"] == "activate"]) == 2
        markers = _markers(tmp_path)
        _assert_gate_held(run, healthy, markers)
        activated = markers.index("listener activate")
        assert "listener message" in markers[activated:]
        assert "listener message" not in markers[:activated]


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
    with ended(echo, tmp_path) as (run, code):
        assert code == ExitCode.OK, _everything_said(run)
        assert run.verdict["verdict"] == "ok"
        (tolerated,) = run.verdict["tolerated"]
        assert (tolerated["node"], tolerated["because"]) == (
            "/_ros2cli_4711",
            "tolerated_nodes: _ros2cli_*",
        )
