"""Ending processes that escaped: what our children left, and what a killed supervisor left.

Owns: finding them without guessing, and ending them bounded; what each process of a run has started
is fork_server.py's. A process belongs to a run if it descends from the run's fork server, which
adopts all that its descendants leave behind, or if its environment carries the run's id. Other
children of this process do not: it may have become the supervisor by exec of a shell with
background jobs. A pid alone never proves it. Must not import rclpy.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import select
import signal
import time
from collections.abc import Iterable
from pathlib import Path

from lifecycle.run_directory import (
    OWN_CHILD,
    PROCESS_VARIABLE,
    RUN_VARIABLE,
    RunRecord,
    boot_id,
    is_process,
    parent_of,
)

GRACE_S = 3.0
"""Between asking an orphan to end and killing it."""

KILL_S = 5.0
"""How long the kernel may take to end a killed process, before it is reported."""

_LOOK_S = 0.02


def reap_adopted(spare: Iterable[int]) -> None:
    """Bury ended orphans that the kernel gave us (PR_SET_CHILD_SUBREAPER).

    While a program of OWN_CHILD runs they wait: for the next time, or for our own end.
    """
    if not OWN_CHILD.acquire(blocking=False):
        return
    try:
        spared = set(spare)
        for pid in Lineage().children(os.getpid()) - spared:
            with contextlib.suppress(ChildProcessError):
                os.waitpid(pid, os.WNOHANG)
    finally:
        OWN_CHILD.release()


def end_run(record: RunRecord) -> tuple[int, ...]:
    """End what is left of a run whose supervisor was killed; return the pids. Blocks."""
    if record.boot_id != boot_id():
        return ()
    pids = {child.pid for child in record.children if is_process(child.pid, child.start_ticks)}
    pids |= marked(record.run_id).keys()
    lineage = Lineage()
    for pid in tuple(pids):
        pids |= lineage.of(pid)
    pids.discard(os.getpid())
    return asyncio.run(end(pids, GRACE_S))


class Lineage:
    """Which processes descend from which, as it was at most `FRESH_S` ago: reading all costs ms."""

    FRESH_S = 0.5

    def __init__(self) -> None:
        self._read_s = float("-inf")
        self._children: dict[int, list[int]] = {}

    def children(self, pid: int) -> set[int]:
        """Return the children of a process, adopted ones included."""
        if time.monotonic() - self._read_s > self.FRESH_S:
            self._children = {}
            for entry in os.listdir("/proc"):  # noqa: PTH208 - hot loop
                if entry.isdigit() and (parent := parent_of(int(entry))) is not None:
                    self._children.setdefault(parent, []).append(int(entry))
            self._read_s = time.monotonic()
        return set(self._children.get(pid, ()))

    def of(self, pid: int) -> set[int]:
        """Return a process and all that descends from it."""
        found: set[int] = set()
        left = {pid}
        while left:
            found |= left
            left = set().union(*map(self.children, left)) - found
        return found


def marked(run_id: str) -> dict[int, str]:
    """Return the planned process whose name each process carries that carries the run's id."""
    mark = f"{RUN_VARIABLE}={run_id}".encode()
    prefix = f"{PROCESS_VARIABLE}=".encode()
    found = {}
    for entry in Path("/proc").iterdir():
        if not entry.name.isdigit() or int(entry.name) == os.getpid():
            continue
        with contextlib.suppress(OSError):
            words = (entry / "environ").read_bytes().split(b"\0")
            if mark in words:
                names = [each.removeprefix(prefix) for each in words if each.startswith(prefix)]
                found[int(entry.name)] = os.fsdecode(names[-1]) if names else ""
    return found


async def end(pids: Iterable[int], grace_s: float) -> tuple[int, ...]:
    """End processes, killing what has not ended after `grace_s`; return those that lived."""
    # Held by their pidfds, so that no signal can reach a later owner of a pid.
    held: dict[int, int] = {}
    for pid in pids:
        with contextlib.suppress(ProcessLookupError):
            held[os.pidfd_open(pid)] = pid
    try:
        left = _living(held)
        ended = tuple(sorted(held[each] for each in left))
        for number, wait_s in ((signal.SIGTERM, grace_s), (signal.SIGKILL, KILL_S)):
            for each in left:
                with contextlib.suppress(ProcessLookupError):
                    signal.pidfd_send_signal(each, number)
                    # A stopped process ends only once it goes on.
                    signal.pidfd_send_signal(each, signal.SIGCONT)
            deadline = time.monotonic() + wait_s
            while (left := _living(left)) and time.monotonic() < deadline:  # noqa: ASYNC110
                await asyncio.sleep(_LOOK_S)
        return ended
    finally:
        for each in held:
            os.close(each)


def _living(pidfds: Iterable[int]) -> list[int]:
    """Return those whose processes have not ended: then a pidfd can be read."""
    poll = select.poll()
    for each in pidfds:
        poll.register(each, select.POLLIN)
    ended = {pidfd for pidfd, _ in poll.poll(0)}
    return [each for each in pidfds if each not in ended]
