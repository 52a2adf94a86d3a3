"""The verbs on the ROS 2 that is installed, from outside; `make test-kilted` asks Kilted's.

What they answer does not depend on the distribution.
"""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from lifecycle.errors import ExitCode
from tests.ros.supervisor.running import BOUND_S, ENOUGH, ROOT, up, verb

pytestmark = pytest.mark.thorough

MANIFESTS = sorted((ROOT / "manifests").glob("*.yaml"))
TELEOP = str(ROOT / "manifests" / "teleop.lifecycle.yaml")


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

    with up(Path(TELEOP), runtime=tmp_path) as run:
        run.until("system", reached="active")
        run.note_segments()
        assert json.loads(ask("status", "teleop", "--format", "json"))["phase"] == "active"
        # What nothing measures is unverifiable, and nothing else is open.
        judged = json.loads(ask("verify", TELEOP, *ENOUGH, "--format", "json"))
        assert {each["rule"] for each in judged["findings"]} == {"flow.not-measured"}
        flows = json.loads(ask("flows", TELEOP, "--format", "json"))
        assert {each["unique"] for each in flows} == {"weakly", "strongly"}
        assert {each["effective_transport"] for each in flows} == {"shm"}
        assert {each["dscp"] for each in flows} >= {46, 40}  # video and cmd_vel
        assert "/robot/camera" in ask("graph", TELEOP)
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
