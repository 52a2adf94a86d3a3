"""What others have started by hand is captured, verified and brought up again, without an edit."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import psutil
import pytest

from lifecycle.errors import ExitCode
from lifecycle.manifest.loading import load
from lifecycle.manifest.model import RosArguments, TargetState
from tests.ros.supervisor.running import BOUND_S, verb

PROGRAM = Path(__file__).parent / "programs.py"
ROS = ("--ros-args", "-r", "__ns:=/robot", "-r", "reset:=clear", "-p", "limit:=4")


def _started(folder: Path, domain_id: int) -> list[subprocess.Popen[bytes]]:
    variables = {**os.environ, "ROS_DOMAIN_ID": str(domain_id), "CAMERA_SERIAL": "A1"}
    variables["ACCESS_TOKEN"] = "hunter2"
    commands = [("several", "go"), ("managed", "go"), ("client",), ("server", *ROS)]
    script = os.path.relpath(PROGRAM, folder)
    processes = [
        subprocess.Popen(
            [sys.executable, script, *words], cwd=folder, env=variables, stdout=subprocess.PIPE
        )
        for words in commands
    ]
    for each in processes:  # until then a capture would only keep them from the processor
        assert each.stdout is not None
        assert each.stdout.readline() == b"ready\n"
    return processes


def _end(processes: list[subprocess.Popen[bytes]]) -> None:
    for each in processes:
        each.send_signal(signal.SIGINT)
    _, late = psutil.wait_procs([psutil.Process(each.pid) for each in processes], BOUND_S / 4)
    for each in late:
        each.kill()
    for each in processes:
        assert each.stdout is not None
        each.stdout.close()
        each.wait(BOUND_S)


def _captured(manifest: Path, domain_id: int, nodes: int, runtime: Path) -> None:
    """Capture until all programs are there: discovery shows each as it comes."""
    deadline = time.monotonic() + BOUND_S
    while True:
        result = verb(
            "capture", "--domain", str(domain_id), "--output", str(manifest), runtime=runtime
        )
        text = manifest.read_text() if manifest.exists() else ""
        if result.returncode == 0 and text.count("    run:\n") == nodes and "7.5" in text:
            return
        assert time.monotonic() < deadline, result.stderr + text


def _up(manifest: Path, *options: str, runtime: Path) -> list[dict[str, Any]]:
    """Return the events of a short run that succeeds."""
    words = ("up", str(manifest), "--stop-after", "0.5", "--format", "json", *options)
    raised = verb(*words, runtime=runtime)
    assert raised.returncode == ExitCode.OK, raised.stdout[-3000:] + raised.stderr
    lines = [json.loads(line) for line in raised.stdout.splitlines()]
    return [each for each in lines if "event" in each]


def _is_left_alone(events: list[dict[str, Any]], processes: list[subprocess.Popen[bytes]]) -> None:
    """Check that a run adopted all that runs: it started, asked and ended nothing."""
    by_hand = {str(each.pid) for each in processes}
    adopted = [
        re.match(r"'(\S+)' is adopted, found (\w+): pid (\d+), ", each["message"])
        for each in events
        if each["event"] == "notice"
    ]
    found = {each[1]: each[2] for each in adopted if each}
    assert found == {
        **dict.fromkeys(("/client", "/left", "/right", "/robot/server"), "running"),
        "/managed": "active",
        "/new": "unconfigured",
    }
    assert {each[3] for each in adopted if each} == by_hand
    assert not [each for each in events if each["event"] in ("process", "request")]
    assert [each.poll() for each in processes] == [None] * len(processes)


@pytest.mark.thorough
def test_programs_started_by_hand_are_adopted_and_come_up_again_from_what_was_captured(
    tmp_path: Path, domain_id: int
) -> None:
    manifest = tmp_path / "found.lifecycle.yaml"
    folder = tmp_path / "work"
    folder.mkdir()
    processes = _started(folder, domain_id)
    try:
        _captured(manifest, domain_id, 6, tmp_path)
        _is_left_alone(_up(manifest, "--adopt", runtime=tmp_path), processes)
    finally:
        _end(processes)
    assert "hunter2" not in manifest.read_text()
    nodes = {each.key: each for each in load(str(manifest), {}).manifest.nodes}
    assert nodes["left"].process == nodes["right"].process != ""
    assert nodes["managed"].process == nodes["new"].process != nodes["left"].process
    assert dict(nodes["left"].run.environment) == {"CAMERA_SERIAL": "A1"}
    assert nodes["left"].run.ros_args is RosArguments.NONE
    assert nodes["server"].remap == (("reset", "clear"),)
    assert nodes["server"].run.command[-1] == "server"
    assert (nodes["new"].state, nodes["managed"].state) == (
        TargetState.UNCONFIGURED,
        TargetState.ACTIVE,
    )
    assert nodes["client"].may_end

    (folder / "go").touch()  # from now on nothing is done by hand
    events = _up(manifest, runtime=tmp_path)
    over = [each["verdict"] for each in events if each["event"] == "verdict"][-1]
    assert {each["node"] for each in over["findings"] if each["rule"] == "graph.ended-node"} == {
        "/client"
    }


@pytest.mark.thorough
def test_a_program_that_ends_while_it_is_captured_may_end(tmp_path: Path, domain_id: int) -> None:
    manifest = tmp_path / "found.lifecycle.yaml"
    deadline = time.monotonic() + BOUND_S
    node = None
    while node is None or not node.may_end:  # where it takes long to end, it has not yet
        assert time.monotonic() < deadline, node
        brief = subprocess.Popen(
            [sys.executable, str(PROGRAM), "brief"],
            env={**os.environ, "ROS_DOMAIN_ID": str(domain_id)},
        )
        try:
            verb("capture", "--domain", str(domain_id), "--output", str(manifest), runtime=tmp_path)
        finally:
            brief.terminate()
            brief.wait(BOUND_S)
        if manifest.exists():
            (node,) = load(str(manifest), {}).manifest.nodes
    assert node.run.command[1:] == (str(PROGRAM), "brief")
    judged = verb(
        *("verify", str(manifest), "--timeout", "0.2", "--format", "json"), runtime=tmp_path
    )
    assert judged.returncode == ExitCode.OK, judged.stdout
    rules = [each["rule"] for each in json.loads(judged.stdout)["findings"]]
    assert rules == ["graph.ended-node"]
