"""Shell completion, as the shells ask for it; bash itself where it is installed."""

from __future__ import annotations

import os
import pty
import select
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest

from lifecycle.run_directory import RunDirectory

BREAKS = " \t\n\"'><=;|&(:@"
MANIFEST = """
manifest_version: 1
system: arm
arguments:
  rate: {default: '10', choices: ['5', '10'], description: frames per second}
  robot: {description: its name}
machines: {robot: {address: 192.0.2.1}}
nodes:
  camera: {run: {attach: true}, namespace: /left}
  viewer: {run: {attach: true}}
"""


@pytest.fixture
def place(tmp_path: Path) -> Path:
    (tmp_path / "arm.lifecycle.yaml").write_text(MANIFEST)
    broken = MANIFEST.replace("run: {attach", "rum: {attach")
    (tmp_path / "broken.lifecycle.yaml").write_text(broken)
    (tmp_path / "notes.txt").write_text("")
    (tmp_path / "folder").mkdir()
    (tmp_path / "bare").mkdir()
    (tmp_path / "bare" / "notes.txt").write_text("")
    for run in ("13-00-00-000000-host-1-17-arm", "12-00-00-000000-host-16-leg"):
        (tmp_path / "log" / f"2026-11-23-{run}").mkdir(parents=True)
    (tmp_path / "log/2026-11-23-13-00-00-000000-host-1-17-arm/camera.log").write_text("")
    (tmp_path / "log/2026-11-23-13-00-00-000000-host-1-17-arm/journal.jsonl").write_text("")
    return tmp_path


def _environment(place: Path) -> dict[str, str]:
    own = {"XDG_RUNTIME_DIR": str(place), "ROS_LOG_DIR": str(place / "log")}
    path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    return {**os.environ, **own, "PATH": path}


def _asked(line: str, place: Path, shell: str = "bash") -> list[str]:
    """Return kind and value of what is offered, in one word each."""
    program = (
        "import sys; from lifecycle.cli import program; code = program(); "
        "assert 'rclpy' not in sys.modules; sys.exit(code)"
    )
    done = subprocess.run(
        [sys.executable, "-c", program],
        cwd=place,
        env={
            **_environment(place),
            "_LIFECYCLE_COMPLETE": shell,
            "COMP_LINE": line,
            "COMP_BREAKS": BREAKS,
        },
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stderr == ""
    return [" ".join(each.split("\t")[:2]) for each in done.stdout.splitlines()]


@pytest.mark.parametrize(
    ("line", "offered"),
    [
        ("lifecycle resu", ["plain resume"]),
        ("lifecycle nonsense x", []),
        ("lifecycle check --for", ["plain --format"]),
        ("lifecycle check --format=te", ["plain text"]),
        ("lifecycle check a", ["path arm.lifecycle.yaml"]),
        ("lifecycle check ./f", ["file "]),
        ("lifecycle check bare/", ["file "]),
        (
            "lifecycle up ",
            [
                "path arm.lifecycle.yaml",
                "open bare/",
                "path broken.lifecycle.yaml",
                "open folder/",
                "open log/",
            ],
        ),
        ("lifecycle check notes", ["file "]),
        ("lifecycle run arm.lifecycle.yaml ", ["plain camera", "plain viewer"]),
        ("lifecycle run broken.lifecycle.yaml v", ["plain viewer"]),
        ("lifecycle restart arm.lifecycle.yaml /l", ["plain /left/camera"]),
        ("lifecycle restart arm.lifecycle.yaml r", ["open rate:=", "open robot:="]),
        ("lifecycle up arm.lifecycle.yaml --except c", ["plain camera"]),
        ("lifecycle up arm.lifecycle.yaml --machine ", ["plain robot"]),
        ("lifecycle up arm.lifecycle.yaml rate:=5 ", ["open robot:="]),
        ("lifecycle up arm.lifecycle.yaml rate:=", ["plain 5", "plain 10"]),
        ("lifecycle logs ", ["plain camera"]),
        ("lifecycle logs --system ", ["plain arm", "plain leg"]),
        ("lifecycle history ", ["plain 2026-11-23-13-00-00-000000-host-1-17-arm"]),
        ("lifecycle history --system leg ", []),
    ],
)
def test_what_can_come_next_is_offered(line: str, offered: list[str], place: Path) -> None:
    assert _asked(line, place) == offered


def test_other_shells_get_whole_words(place: Path) -> None:
    line = "lifecycle up arm.lifecycle.yaml rate:="
    assert _asked(line, place, "zsh") == ["plain rate:=5", "plain rate:=10"]
    assert _asked("lifecycle check --format=te", place, "fish") == ["plain --format=text"]


def test_running_systems_are_offered(place: Path) -> None:
    (place / "lifecycle").mkdir(mode=0o700)
    held = RunDirectory.acquire(place / "lifecycle", "arm@7", "id", domain_id=7)
    assert _asked("lifecycle status ar", place) == ["path arm.lifecycle.yaml", "plain arm@7"]
    assert _asked("lifecycle down arm@", place) == ["plain 7"]  # the rest is bash's word
    held.release()


@pytest.mark.skipif(shutil.which("bash") is None, reason="bash is not installed")
@pytest.mark.parametrize(
    ("typed", "becomes"),
    [
        ("lifecycle check ar\t", "lifecycle check arm.lifecycle.yaml "),
        ("lifecycle check no\t", "lifecycle check notes.txt "),
        ("lifecycle check fo\t", "lifecycle check folder/"),
        ("lifecycle up arm.lifecycle.yaml ro\t", "lifecycle up arm.lifecycle.yaml robot:="),
        ("lifecycle up arm.lifecycle.yaml rate:=1\t", "lifecycle up arm.lifecycle.yaml rate:=10 "),
    ],
)
def test_bash_completes_the_line(typed: str, becomes: str, place: Path) -> None:
    settings = place / ".bashrc"
    settings.write_text('eval "$(lifecycle completion bash)"\nPS1="ready> "\n')
    pid, terminal = pty.fork()
    if pid == 0:
        os.chdir(place)
        variables = {**_environment(place), "TERM": "dumb", "INPUTRC": str(place / "notes.txt")}
        os.execvpe("bash", ["bash", "--rcfile", str(settings), "-i"], variables)
    try:
        _read_until(terminal, b"ready> ")
        os.write(terminal, typed.encode())
        _read_until(terminal, becomes.encode())
    finally:
        os.kill(pid, 9)
        os.waitpid(pid, 0)
        os.close(terminal)


def _read_until(terminal: int, wanted: bytes) -> None:
    shown = b""
    deadline = time.monotonic() + 20
    while wanted not in shown:
        ready, _, _ = select.select([terminal], [], [], max(0.0, deadline - time.monotonic()))
        assert ready, shown
        shown += os.read(terminal, 4096)
