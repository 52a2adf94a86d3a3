"""Runs `lifecycle up` on a faulty system to its end, beside its intruder; owns `ended`."""

from __future__ import annotations

import contextlib
import re
import subprocess
import threading
from collections.abc import Iterator
from pathlib import Path

import psutil

from tests.installation import PYTHON
from tests.ros.faults.system import Fault
from tests.ros.supervisor.running import Up, up
from tests.shared_memory import left_behind, used_by


@contextlib.contextmanager
def ended(fault: Fault, directory: Path) -> Iterator[tuple[Up, int]]:
    """Yield a run that has ended and its exit code; nothing of it may be left.

    What its callbacks marked is in `directory/markers`, one line `<node> <callback>` each.
    """
    manifest = directory / "faults.lifecycle.yaml"
    manifest.write_text(fault.manifest)
    (directory / "markers").touch()
    variables = {
        "FAULT_MARKERS": str(directory / "markers"),
        "FAULT_SHARED_MEMORY_ONLY": str(Path(__file__).with_name("shared_memory_only.xml")),
        "FAULT_FOREIGN_PARTITION": str(Path(__file__).with_name("foreign_partition.xml")),
    }
    # Should the fault go unnoticed, the run ends by itself and with status 0.
    options = () if "--stop-after" in fault.options else ("--stop-after", "0.2")
    # What somebody killed has left before is not ours to answer for, though we may use its port.
    before = left_behind()
    with (
        _intruder(fault),
        up(manifest, *options, *fault.options, runtime=directory, variables=variables) as run,
    ):
        with _mapped(run.process.pid) as mapped:
            code = run.finish()
        yield run, code
        run.assert_nothing_left()
        # Unique ports are the same in every domain: others may leave or take one meanwhile.
        left = left_behind(mapped) - before
        assert not [name for name in left if not re.search(r"port7[0-3]\d\d(?!\d)", name)], left


@contextlib.contextmanager
def _intruder(fault: Fault) -> Iterator[None]:
    if not fault.intruder:
        yield
        return
    words = [str(PYTHON), fault.intruder_is, *fault.intruder]
    with subprocess.Popen(words, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == b"ready\n"
        try:
            yield
        finally:
            process.terminate()


@contextlib.contextmanager
def _mapped(pid: int) -> Iterator[set[str]]:
    """Yield the names of the Fast DDS files that a process and its descendants use meanwhile.

    Other systems on this computer make and leave such files too; only our own are our business.
    """
    names: set[str] = set()
    root, end = psutil.Process(pid), threading.Event()

    def watch() -> None:
        while not end.wait(0.1):
            with contextlib.suppress(psutil.NoSuchProcess):
                names.update(used_by(each.pid for each in (root, *root.children(recursive=True))))

    thread = threading.Thread(target=watch)
    thread.start()
    try:
        yield names
    finally:
        end.set()
        thread.join()
