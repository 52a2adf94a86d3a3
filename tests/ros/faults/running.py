"""Runs `lifecycle up` on a faulty system in a process of its own, and looks at what it left behind.

Owns: `run_up`, `UpRun`, `processes_of`.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import re
import subprocess
import threading
import time
import uuid
from collections.abc import Iterator
from pathlib import Path

import psutil

from tests.installation import LIFECYCLE, PYTHON, modules
from tests.ros.faults.system import Fault
from tests.shared_memory import left_behind, used_by

LIMIT_S = 50.0
"""Far more than any fault takes; a run that needs it hangs."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class UpRun:
    """What one run of `lifecycle up` said and left behind.

    Attributes:
        events: what it printed, one object per line.
        markers: `<node> <callback>` lines, in the order in which callbacks ran.
        token: every process of the run has it in its environment.
        shared_memory: Fast DDS files that the run used and that nobody uses any more.
    """

    exit_code: int
    events: tuple[dict[str, object], ...]
    errors: str
    markers: tuple[str, ...]
    token: str
    shared_memory: tuple[str, ...]


def run_up(fault: Fault, directory: Path) -> UpRun:
    """Run a faulty system to its end, in the domain that the environment names.

    It is ended after `LIMIT_S`, which shows as a wrong exit code.
    """
    manifest = directory / "faults.lifecycle.yaml"
    manifest.write_text(fault.manifest)
    markers = directory / "markers"
    markers.touch()
    token = uuid.uuid4().hex
    environment = {
        **os.environ,
        "ROS_LOG_DIR": str(directory / "log"),
        "XDG_RUNTIME_DIR": str(directory),
        "FAULT_SHARED_MEMORY_ONLY": str(Path(__file__).with_name("shared_memory_only.xml")),
        "FAULT_FOREIGN_PARTITION": str(Path(__file__).with_name("foreign_partition.xml")),
    }
    # What somebody killed has left before is not ours to answer for, though we may use its port.
    before = left_behind()
    with _intruder(fault, environment):
        up = subprocess.Popen(
            [
                *(str(LIFECYCLE), "up", str(manifest)),
                *("--format", "json"),
                # Should the fault go unnoticed, the run ends by itself and with status 0.
                *(() if "--stop-after" in fault.options else ("--stop-after", "0.2")),
                *fault.options,
            ],
            cwd=modules(),
            env={**environment, "FAULT_MARKERS": str(markers), "FAULT_RUN": token},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        with _Mapped(up.pid) as mapped:
            try:
                output, errors = up.communicate(timeout=LIMIT_S)
            except subprocess.TimeoutExpired:
                up.terminate()
                output, errors = up.communicate(timeout=LIMIT_S)
                errors += f"\nended by the test: still running after {LIMIT_S} s"
    lines = [line for line in output.splitlines() if line]
    return UpRun(
        exit_code=up.returncode,
        events=tuple(json.loads(line) for line in lines),
        errors=errors,
        markers=tuple(markers.read_text().splitlines()),
        token=token,
        shared_memory=tuple(
            name
            for name in sorted(left_behind(mapped))
            # Unique ports are the same in every domain: others may leave or take one meanwhile.
            if name not in before and not re.search(r"port7[0-3]\d\d(?!\d)", name)
        ),
    )


def processes_of(token: str, within_s: float = 1.0) -> list[str]:
    """Return the processes of a run that still live; polls until none does or time is up."""
    deadline = time.monotonic() + within_s
    while True:
        alive = [
            f"{process.pid} {' '.join(process.info['cmdline'] or ())}"
            for process in psutil.process_iter(["environ", "cmdline", "status"])
            if (process.info["environ"] or {}).get("FAULT_RUN") == token
            and process.info["status"] != psutil.STATUS_ZOMBIE
        ]
        if not alive or time.monotonic() >= deadline:
            return alive
        time.sleep(0.05)


@contextlib.contextmanager
def _intruder(fault: Fault, environment: dict[str, str]) -> Iterator[None]:
    if not fault.intruder:
        yield
        return
    process = subprocess.Popen(
        [str(PYTHON), fault.intruder_is, *fault.intruder],
        env=environment,
        stdout=subprocess.PIPE,
    )
    try:
        assert process.stdout is not None
        assert process.stdout.readline() == b"ready\n"
        yield
    finally:
        process.terminate()
        process.wait(30)
        assert process.stdout is not None
        process.stdout.close()


class _Mapped:
    """Notes which Fast DDS files a process and its descendants use, for as long as it runs.

    Other systems on this computer make and leave such files too; only our own are our business.

    Attributes:
        names: file names below /dev/shm.
    """

    def __init__(self, pid: int) -> None:
        self.names: set[str] = set()
        self._root = psutil.Process(pid)
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._watch)

    def __enter__(self) -> set[str]:
        self._thread.start()
        return self.names

    def __exit__(self, *_: object) -> None:
        self._end.set()
        self._thread.join()

    def _watch(self) -> None:
        while not self._end.wait(0.1):
            with contextlib.suppress(psutil.NoSuchProcess):
                family = [self._root, *self._root.children(recursive=True)]
                self.names |= used_by(each.pid for each in family)
