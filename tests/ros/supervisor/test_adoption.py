"""`up --adopt` on real DDS: who was started by hand is verified where it is, and left there."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from lifecycle.errors import ExitCode
from tests.ros.supervisor.running import BOUND_S, LIMITS, Up, pair, up, verb

_ELSEWHERE = str(Path(__file__).with_name("managed_elsewhere.py"))
_EDIT = {
    "nodes": {
        "base": {"run": {"command": [sys.executable, _ELSEWHERE]}, "timeouts": LIMITS},
        "talker": {"run": {"python": "tests.ros.supervisor.systems:Talker"}, "timeouts": LIMITS},
    },
    "nodes/talker/interface": {"publishers": [{"name": "chatter", "type": "std_msgs/msg/String"}]},
    "links": [],
}


@pytest.fixture
def base(fresh_domain: int) -> Iterator[subprocess.Popen[str]]:
    """A managed node that somebody started by hand."""
    with subprocess.Popen(
        [sys.executable, _ELSEWHERE],
        env={**os.environ, "ROS_DOMAIN_ID": str(fresh_domain)},
        stdout=subprocess.PIPE,
        text=True,
    ) as process:
        assert process.stdout is not None
        yield process
        process.kill()


def adopts(run: Up, state: str, pid: int) -> None:
    """Wait until a run says how it found the node, and that its system is active."""
    run.until("system", reached="active")
    said = [each["message"] for each in run.of_kind("notice")]
    assert any(
        each.startswith(f"'/base' is adopted, found {state}: pid {pid}, ") for each in said
    ), said


def asked(run: Up) -> list[str]:
    return [each["operation"] for each in run.of_kind("request") if each["node"] == "/base"]


@pytest.mark.thorough
def test_a_node_is_not_touched_but_adopted_and_outlives_a_supervisor_that_is_killed(
    tmp_path: Path, fresh_domain: int, base: subprocess.Popen[str]
) -> None:
    manifest = pair(tmp_path, fresh_domain, edit=_EDIT)
    refused = verb("up", str(manifest), runtime=tmp_path)
    assert refused.returncode == ExitCode.VIOLATED, refused.stdout
    assert f"ran before (pid {base.pid}, " in refused.stdout
    assert "lifecycle up MANIFEST --adopt" in refused.stdout
    with up(manifest, "--adopt", runtime=tmp_path) as killed:
        adopts(killed, "unconfigured", base.pid)
        assert asked(killed) == ["configure", "connect", "activate"]
        killed.process.kill()
        killed.process.wait(BOUND_S)
        with up(manifest, "--adopt", runtime=tmp_path) as following:
            adopts(following, "active", base.pid)
            assert asked(following) == []
            assert following.pid_of("talker") != killed.pid_of("talker")
            assert verb("down", str(manifest), runtime=tmp_path).returncode == ExitCode.OK
            following.assert_nothing_left()
            assert base.poll() is None
