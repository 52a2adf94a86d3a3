"""The verbs on the ROS 2 that is installed, from outside; `make test-kilted` asks Kilted's.

What they answer does not depend on the distribution.
"""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from lifecycle.errors import ExitCode
from tests.ros.supervisor.running import BOUND_S, ENOUGH, ROOT, up, verb

pytestmark = pytest.mark.thorough

MANIFESTS = sorted((ROOT / "manifests").glob("*.yaml"))
TELEOP = ROOT / "manifests" / "teleop.lifecycle.yaml"


def patient(directory: Path) -> str:
    """Write the teleop example with delays that a busy machine keeps; return its path."""
    text = TELEOP.read_text(encoding="utf-8")
    text, delays = re.subn(r"max_delay_ms: \d+", "max_delay_ms: 500", text)
    text, classes = re.subn(r"five_qi: \d+", "five_qi: 9", text)
    assert (delays, classes) == (3, 1)
    path = directory / TELEOP.name
    path.write_text(text, encoding="utf-8")
    return str(path)


@pytest.mark.parametrize("manifest", MANIFESTS, ids=lambda path: path.name.partition(".")[0])
def test_a_manifest_is_checked_and_planned(manifest: Path, tmp_path: Path) -> None:
    done = verb("plan", str(manifest), runtime=tmp_path)
    assert (done.returncode, done.stderr) == (ExitCode.OK, "")


@pytest.mark.usefixtures("fresh_domain")
def test_every_verb_of_a_running_system(tmp_path: Path) -> None:
    """Unique flows with their DSCP, plain nodes of rclpy, a restart, and nothing left behind."""

    def ask(name: str, *words: str) -> str:
        done = verb(name, *words, runtime=tmp_path)
        assert done.returncode == ExitCode.OK, f"{name}: {done.stdout}{done.stderr}"
        return done.stdout

    manifest = patient(tmp_path)
    with up(Path(manifest), runtime=tmp_path) as run:
        run.until("system", reached="active")
        run.note_segments()
        phases = {json.loads(ask("status", "teleop", "--format", "json"))["phase"]}
        while "active" not in phases and len(run.of_kind("notice")) < 20:
            run.until("notice")  # what was measured, at the end of the phase
            phases.add(json.loads(ask("status", "teleop", "--format", "json"))["phase"])
        assert phases <= {"measuring", "active"}
        assert "active" in phases
        # Everything is verified and measured, and nothing is open.
        judged = json.loads(ask("verify", manifest, *ENOUGH, "--format", "json"))
        assert judged["findings"] == []
        assert {bound["name"] for each in judged["measured"] for bound in each["bounds"]} == {
            "max_delay_ms",
            "five_qi",
        }
        flows = json.loads(ask("flows", manifest, "--format", "json"))
        assert {each["unique"] for each in flows} == {"weakly", "strongly"}
        assert {each["effective_transport"] for each in flows} == {"shm"}
        assert {each["dscp"] for each in flows} >= {46, 40}  # video and cmd_vel
        assert "/robot/camera" in ask("graph", manifest)
        captured = tmp_path / "captured.lifecycle.yaml"
        ask("capture", "--attach", "--wait", str(BOUND_S / 2), "--output", str(captured))
        ask("check", str(captured))
        since = run.catch_up()
        ask("restart", "teleop", "/robot/lidar")
        run.met("node", since=since, node="/robot/lidar", reach="active")
        ask("down", "teleop")
        assert run.finish() == ExitCode.OK
        run.assert_nothing_left()
        assert run.said() == ""
    assert "Traceback" not in ask("logs")
    assert "/robot/lidar: active" in ask("history")


@pytest.mark.usefixtures("fresh_domain")
@pytest.mark.parametrize("name", ["client_server_master", "statically_configured_graph"])
def test_connections_by_a_discovery_server_and_by_url(name: str, tmp_path: Path) -> None:
    manifest = ROOT / "manifests" / f"{name}.lifecycle.yaml"
    with up(manifest, "--strict", "--stop-after", "1", runtime=tmp_path) as run:
        assert run.finish() == ExitCode.OK, run.said()
        assert run.said() == ""
