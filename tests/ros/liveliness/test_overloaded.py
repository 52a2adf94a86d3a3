"""A machine without time for a node: nothing of the node hangs, and nobody says that it does."""

from __future__ import annotations

import contextlib
import os
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.ros.liveliness.nodes import WORKS_S
from tests.ros.supervisor.running import up, write

pytestmark = pytest.mark.alone

SILENT_S = 0.8
"""`timeouts.silent_s` where a manifest does not say."""

OTHERS = 60
"""Each gets as much of the processor as the node: its fiftieth of a second takes over a second."""

LASTS_S = 6.0
_END_S = 40


@contextlib.contextmanager
def overloaded(pid: int) -> Iterator[None]:
    """Leave a process one processor, with many others that always have something to do."""
    processor = min(os.sched_getaffinity(0))
    for thread in Path(f"/proc/{pid}/task").iterdir():
        os.sched_setaffinity(int(thread.name), {processor})
    loop = f"exec timeout {_END_S} sh -c 'while :; do :; done'"
    others = [
        # A session each: the kernel may share the processor among sessions (sched(7), autogroup).
        subprocess.Popen(
            ["taskset", "-c", str(processor), "sh", "-c", loop], start_new_session=True
        )
        for _ in range(OTHERS)
    ]
    try:
        yield
    finally:
        for each in others:
            os.killpg(each.pid, 9)
            each.wait()
        for thread in Path(f"/proc/{pid}/task").iterdir():
            with contextlib.suppress(ProcessLookupError):
                os.sched_setaffinity(int(thread.name), os.sched_getaffinity(0))


def waited_s(pid: int) -> float:
    """Return how long the process's executor has waited for a processor, as the kernel counts."""
    return int(Path(f"/proc/{pid}/schedstat").read_text().split()[1]) / 1e9


def test_a_callback_that_gets_no_processor_is_not_called_hung(
    tmp_path: Path, fresh_domain: int
) -> None:
    run = {"python": "tests.ros.liveliness.nodes:Working"}
    file = write(tmp_path, fresh_domain, {"working": {"run": run}}, "busy")
    with up(file, runtime=tmp_path) as running:
        running.until("system", reached="active")
        pid = running.pid_of("working")
        before_s = waited_s(pid)
        with overloaded(pid):
            time.sleep(LASTS_S)  # the overload itself
            starved_s = waited_s(pid) - before_s
        running.catch_up()
    # Or there was no overload: each of its callbacks took longer than a callback may.
    assert starved_s > LASTS_S / 2
    assert WORKS_S * OTHERS > SILENT_S
    silent = [(each["cause"], each["message"]) for each in running.of_kind("silent")]
    assert [each for each in silent if each[0] == "hung"] == [], silent
