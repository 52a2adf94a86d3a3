"""What every process of a run is doing and has open, at the moment when a round failed."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import psutil

_WITH = (
    ("py-spy", ("dump", "--pid")),
    ("gdb", ("-batch", "-nx", "-ex", "thread apply all bt 25", "-p")),
)


def keep_stacks(pid: int, directory: Path) -> None:
    """Write stacks and shared memory of a process, of all that descend from it, and of our own.

    Args:
        pid: process; one that ended leaves nothing.
        directory: one file for each process, named by its number; made.
    """
    directory.mkdir(parents=True, exist_ok=True)
    try:
        top = psutil.Process(pid)
        family = [top, *top.children(recursive=True)]
    except psutil.Error:
        family = []
    pids = (*(one.pid for one in family), os.getpid())
    shared = {pid: _shared(pid) for pid in pids}
    for pid in pids:
        (directory / f"{pid}.txt").write_text(f"{shared[pid]}\n\n{_stacks(pid)}")


def _shared(pid: int) -> str:
    """Return which shared memory of Fast DDS a process has; what has no name any more, too."""
    try:
        maps = Path(f"/proc/{pid}/maps").read_text().splitlines()
    except OSError:
        return "ended"
    return "\n".join(dict.fromkeys(each.split(None, 5)[-1] for each in maps if "fastrtps_" in each))


def _stacks(pid: int) -> str:
    said = []
    for tool, words in _WITH:
        if path := shutil.which(tool):
            try:
                done = subprocess.run(
                    [path, *words, str(pid)],
                    capture_output=True,
                    text=True,
                    errors="replace",
                    timeout=60,
                    check=False,
                )
                said.append(done.stdout or done.stderr)
            except subprocess.TimeoutExpired:
                said.append(f"{tool} did not end")
    try:
        line = Path(f"/proc/{pid}/cmdline").read_bytes().replace(b"\0", b" ").decode()
    except OSError:
        line = "ended"
    return "\n".join((line, *said))
