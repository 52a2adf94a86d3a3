"""Ending processes that escaped: what our children left, and what a killed supervisor left.

Owns: finding them without guessing, and ending them bounded. A process is ours if it descends from
us, or if its environment carries a run's id; a pid alone never proves it. Must not import rclpy.
"""

from __future__ import annotations

import contextlib
import os
import select
import signal
import threading
import time
from collections.abc import Collection, Iterable
from pathlib import Path

import psutil

from lifecycle.middleware.shm import port_files_of, sweep
from lifecycle.supervisor.rundir import RUN_VARIABLE, RunRecord, boot_id, start_ticks

GRACE_S = 3.0
"""Between asking an orphan to end and killing it."""

KILL_S = 5.0
"""How long the kernel may take to end a killed process, before it is reported."""

OWN_CHILD = threading.Lock()
"""Held by whoever runs a program and waits for it himself. If it were buried as an orphan first,
its exit code would be lost, and `subprocess` takes a lost one for success."""


class _Orphan:
    """A process held by its pidfd, so that no signal can reach a later owner of the pid."""

    def __init__(self, pid: int, pidfd: int) -> None:
        self.pid = pid
        self.pidfd = pidfd

    def signal(self, number: int) -> None:
        with contextlib.suppress(ProcessLookupError):
            signal.pidfd_send_signal(self.pidfd, number)


def end_descendants(spare: Iterable[int], grace_s: float = 0.5) -> tuple[int, ...]:
    """End everything that descends from this process, but for `spare` and this process's threads.

    Returns:
        The pids that had to be ended.
    """
    spared = set(spare)
    pids = [each.pid for each in psutil.Process().children(recursive=True)]
    ended = _end((pid for pid in pids if pid not in spared), grace_s)
    reap_adopted(spared)
    return ended


def reap_adopted(spare: Iterable[int]) -> None:
    """Bury ended orphans that the kernel gave us (PR_SET_CHILD_SUBREAPER).

    While a program of OWN_CHILD runs they wait: for the next time, or for our own end.
    """
    if not OWN_CHILD.acquire(blocking=False):
        return
    try:
        spared = set(spare)
        for child in psutil.Process().children():
            if child.pid not in spared:
                with contextlib.suppress(ChildProcessError):
                    os.waitpid(child.pid, os.WNOHANG)
    finally:
        OWN_CHILD.release()


def end_run(record: RunRecord) -> tuple[int, ...]:
    """End what is left of a run whose supervisor was killed.

    Returns:
        The pids that were ended.
    """
    if record.boot_id != boot_id():
        return ()
    known = {child.pid for child in record.children if start_ticks(child.pid) == child.start_ticks}
    return _end(known | _carrying(record.run_id), GRACE_S)


def sweep_of(began_s: float, segments: Collection[str], domain_id: int | None) -> tuple[str, ...]:
    """Remove a run's shared memory that nobody uses any more; return the names.

    Args:
        began_s: seconds since the epoch; what is newer and abandoned is ours, or nobody's.
        segments: what its processes were seen to use.
        domain_id: of the run: a port's file may be older than the run, left by somebody killed,
            and the process that used it again may have died before it was seen. None: not known.
    """
    newer = sweep(created_after_s=began_s)
    older = {*segments, *(() if domain_id is None else port_files_of(domain_id))}
    return newer + (sweep(only=older) if older else ())


def _carrying(run_id: str) -> set[int]:
    """Pids of every process of ours whose environment carries the run's id."""
    mark = f"{RUN_VARIABLE}={run_id}".encode()
    found = set()
    for entry in Path("/proc").iterdir():
        if not entry.name.isdigit() or int(entry.name) == os.getpid():
            continue
        with contextlib.suppress(OSError):
            if mark in (entry / "environ").read_bytes().split(b"\0"):
                found.add(int(entry.name))
    return found


def _end(pids: Iterable[int], grace_s: float) -> tuple[int, ...]:
    orphans = []
    for pid in pids:
        with contextlib.suppress(ProcessLookupError):
            orphans.append(_Orphan(pid, os.pidfd_open(pid)))
    try:
        left = _living(orphans, 0.0)
        ended = tuple(sorted(each.pid for each in left))
        for number, wait_s in ((signal.SIGTERM, grace_s), (signal.SIGKILL, KILL_S)):
            for each in left:
                each.signal(number)
                each.signal(signal.SIGCONT)  # a stopped process ends only once it goes on
            left = _living(left, wait_s)
        return ended
    finally:
        for each in orphans:
            os.close(each.pidfd)


def _living(orphans: list[_Orphan], wait_s: float) -> list[_Orphan]:
    """Wait until all have ended or the time is up; return those that have not."""
    deadline = time.monotonic() + wait_s
    poll = select.poll()
    left = {each.pidfd: each for each in orphans}
    for pidfd in left:
        poll.register(pidfd, select.POLLIN)
    while left:
        ready = poll.poll(max(0.0, deadline - time.monotonic()) * 1000)
        if not ready:
            break
        for pidfd, _ in ready:
            poll.unregister(pidfd)
            del left[pidfd]
    return list(left.values())
