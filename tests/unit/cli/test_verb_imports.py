"""What a verb loads that asks a supervisor, or finds none to ask, and what that costs."""

from __future__ import annotations

import contextlib
import json
import os
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from lifecycle.run_directory import RunDirectory, short_path

ROOT = Path(__file__).parents[3]
HEAVY = (
    "asyncio",
    "jsonschema",
    "lifecycle.graph",
    "lifecycle.manifest",
    "lifecycle.middleware",
    "lifecycle.network",
    "lifecycle.node",
    "lifecycle.plan",
    "lifecycle.supervisor",
    "lifecycle.verify",
    "logging",
    "msgspec",
    "rclpy",
    "rich",
    "subprocess",
    "yaml",
)
TO_ASK = {
    "lifecycle.codec",
    "lifecycle.dataclasses",
    "lifecycle.errors",
    "lifecycle.printable",
    "lifecycle.public",
    "lifecycle.run_directory",
    "lifecycle.supervisor",
    "lifecycle.supervisor.control",
    "lifecycle.supervisor.control.client",
    "lifecycle.supervisor.control.protocol",
    "lifecycle.verify",
    "lifecycle.verify.outcome",
}
"""All of this package, but the command line, that is loaded to ask a supervisor."""


def _run(environment: dict[str, str], *arguments: str) -> str:
    """Return what a Python printed."""
    return subprocess.run(
        [sys.executable, *arguments],
        cwd=ROOT,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        check=False,
    ).stdout


@pytest.fixture
def environment(tmp_path: Path) -> dict[str, str]:
    """Of a user who runs nothing."""
    return {**os.environ, "XDG_RUNTIME_DIR": str(tmp_path)}


class _Supervisor:
    """Answers on the control socket of a system `arm`, as one that runs two nodes does.

    Args:
        root: of run directories.
    """

    def __init__(self, root: Path) -> None:
        self._directory = RunDirectory.acquire(root, "arm@7", "abc")
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        with short_path(self._directory.socket_path) as name:
            self._socket.bind(name)
        self._socket.listen()
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()

    def _serve(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                client, _ = self._socket.accept()
                with client, client.makefile("rb") as questions:
                    asked = json.loads(questions.readline())["ask"]
                    answer = {"status": _STATUS} if asked == "status" else {"exit_code": 0}
                    if asked == "down":
                        self._directory.release()
                    client.sendall(json.dumps(answer).encode() + b"\n")

    def close(self) -> None:
        self._socket.shutdown(socket.SHUT_RDWR)
        self._socket.close()
        self._thread.join()
        self._directory.release()


_STATUS = {
    "system": "arm",
    "domain_id": 7,
    "phase": "active",
    "verdict": "ok",
    "supervisor": 1,
    "elapsed_s": 1.5,
    "nodes": [
        {
            "node": name,
            "process": name[1:],
            "process_state": "running",
            "pid": 7,
            "managed": True,
            "reach": "active",
            "state": "active",
            "doing": "",
            "matched": 1,
            "endpoints": 1,
            "unique_flows": 0,
            "flows": 1,
            "findings": 0,
            "connections": [{"name": "net", "urls": ["shm://"], "established": True}],
        }
        for name in ("/camera", "/viewer")
    ],
}


@pytest.fixture
def running(environment: dict[str, str]) -> Iterator[dict[str, str]]:
    """Environment of a user who runs the system `arm`."""
    supervisor = _Supervisor(Path(environment["XDG_RUNTIME_DIR"]) / "lifecycle")
    yield environment
    supervisor.close()


def _loaded(environment: dict[str, str], words: list[str]) -> tuple[str, set[str]]:
    """Return what a verb printed, and the modules that it loaded."""
    program = (
        "import sys\n"
        "from lifecycle.cli import main\n"
        f"main({words!r})\n"
        "print('loaded:', *sys.modules)\n"
    )
    printed = _run(environment, "-c", program)
    said, _, names = printed.rpartition("loaded:")
    return said, set(names.split())


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["status"], "no system runs"),
        (["status", "arm"], "cannot find a running system 'arm'"),
        (["down", "arm"], "cannot find a running system 'arm'"),
        (["pause", "arm"], "cannot find a running system 'arm'"),
        (["--help"], "Usage: lifecycle"),
        (["down", "--help"], "Usage: lifecycle down"),
    ],
    ids=" ".join,
)
def test_a_verb_that_finds_nothing_to_ask_loads_no_room(
    words: list[str], said: str, environment: dict[str, str]
) -> None:
    printed, loaded = _loaded(environment, words)
    assert said in printed
    assert loaded & {*HEAVY} == set()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["status", "arm"], "arm: active, verdict ok, domain 7, supervisor 1, up for 1.5 s\n"),
        (["status", "arm", "--format", "json"], '{"system":"arm","domain_id":7,'),
        (["pause", "arm"], ""),
        (["resume", "arm"], ""),
        (["restart", "arm", "camera"], ""),
        (["down", "arm"], ""),
    ],
    ids=" ".join,
)
def test_a_verb_that_asks_a_supervisor_loads_no_plan_and_no_rule(
    words: list[str], said: str, running: dict[str, str]
) -> None:
    printed, loaded = _loaded(running, words)
    assert printed.startswith(said) if said else not printed
    assert loaded & {*HEAVY} == {"lifecycle.supervisor", "lifecycle.verify", "msgspec"}
    ours = {each for each in loaded if each.startswith("lifecycle.")}
    assert {each for each in ours if not each.startswith("lifecycle.cli")} == TO_ASK


def test_checking_a_manifest_loads_nothing_of_ros(
    environment: dict[str, str],
) -> None:
    printed, loaded = _loaded(environment, ["check", "manifests/first_node.lifecycle.yaml"])
    assert printed.endswith(": ok\n")
    assert loaded & {"asyncio", "rclpy", "rich"} == set()
