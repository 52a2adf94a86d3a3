"""What others have started by hand is captured, verified and brought up again, without an edit."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil

from lifecycle.errors import ExitCode
from lifecycle.manifest import load
from lifecycle.manifest.model import RosArguments, TargetState
from tests.ros.supervisor.running import BOUND_S, ENOUGH, verb

PROGRAM = Path(__file__).parent / "programs.py"
ROS = ("--ros-args", "-r", "__ns:=/robot", "-r", "reset:=clear", "-p", "limit:=4")


def _started(folder: Path, domain_id: int) -> list[subprocess.Popen[bytes]]:
    variables = {**os.environ, "ROS_DOMAIN_ID": str(domain_id), "CAMERA_SERIAL": "A1"}
    variables["ACCESS_TOKEN"] = "secret"
    commands = [("both",), ("strict", "go"), ("managed", "go"), ("new",), ("client",)]
    script = os.path.relpath(PROGRAM, folder)
    return [
        subprocess.Popen([sys.executable, script, *words], cwd=folder, env=variables)
        for words in (*commands, ("server", *ROS))
    ]


def _end(processes: list[subprocess.Popen[bytes]]) -> None:
    for each in processes:
        each.send_signal(signal.SIGINT)
    _, late = psutil.wait_procs([psutil.Process(each.pid) for each in processes], BOUND_S / 4)
    for each in late:
        each.kill()
    for each in processes:
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


def test_programs_started_by_hand_come_up_again_from_what_was_captured(
    tmp_path: Path, domain_id: int
) -> None:
    manifest = tmp_path / "found.lifecycle.yaml"
    folder = tmp_path / "work"
    folder.mkdir()
    processes = _started(folder, domain_id)
    try:
        _captured(manifest, domain_id, 7, tmp_path)
        judged = verb("verify", str(manifest), *ENOUGH, runtime=tmp_path)
        assert judged.returncode == ExitCode.OK, judged.stdout
    finally:
        _end(processes)
    assert "secret" not in manifest.read_text()
    nodes = {each.key: each for each in load(str(manifest), {}).manifest.nodes}
    assert nodes["left"].process == nodes["right"].process == "programs"
    assert dict(nodes["strict"].run.environment) == {"CAMERA_SERIAL": "A1"}
    assert nodes["strict"].run.ros_args is RosArguments.NONE
    assert nodes["server"].remap == (("reset", "clear"),)
    assert nodes["server"].run.command[-1] == "server"
    assert (nodes["new"].state, nodes["managed"].state) == (
        TargetState.UNCONFIGURED,
        TargetState.ACTIVE,
    )
    assert nodes["client"].may_end

    (folder / "go").touch()  # from now on nothing is done by hand
    raised = verb(
        *("up", str(manifest), "--stop-after", "0.5", "--format", "json"), runtime=tmp_path
    )
    assert raised.returncode == ExitCode.OK, raised.stdout[-3000:] + raised.stderr
    events = [json.loads(line) for line in raised.stdout.splitlines()]
    over = [
        each["verdict"] for each in events if each.get("verdict") and "findings" in each["verdict"]
    ][-1]
    assert {each["node"] for each in over["findings"] if each["rule"] == "graph.ended-node"} == {
        "/client"
    }


def test_a_program_that_ends_while_it_is_captured_may_end(tmp_path: Path, domain_id: int) -> None:
    manifest = tmp_path / "found.lifecycle.yaml"
    deadline = time.monotonic() + BOUND_S
    while not manifest.exists():
        assert time.monotonic() < deadline
        brief = subprocess.Popen(
            [sys.executable, str(PROGRAM), "brief"],
            env={**os.environ, "ROS_DOMAIN_ID": str(domain_id)},
        )
        try:
            verb("capture", "--domain", str(domain_id), "--output", str(manifest), runtime=tmp_path)
        finally:
            brief.terminate()
            brief.wait(BOUND_S)
    (node,) = load(str(manifest), {}).manifest.nodes
    assert (node.may_end, node.run.command[1:]) == (True, (str(PROGRAM), "brief"))
    judged = verb(
        *("verify", str(manifest), "--timeout", "0.2", "--format", "json"), runtime=tmp_path
    )
    assert judged.returncode == ExitCode.OK, judged.stdout
    rules = [each["rule"] for each in json.loads(judged.stdout)["findings"]]
    assert rules == ["graph.ended-node"]
