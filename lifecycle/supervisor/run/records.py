"""Records what a run owns: its processes and the shared memory that they were seen to own.

Owns: `Records`, which keeps the run directory true, for the next `up` or `down` that has to clean
up after a supervisor that was killed.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import time
from collections.abc import Iterator

from lifecycle.middleware import Creations, segments_by_holder, segments_of, still_there
from lifecycle.run_directory import FORK_SERVER, ChildRecord, RunDirectory, start_ticks
from lifecycle.supervisor.nodes.system import System
from lifecycle.supervisor.processes.orphans import ProcessFamily
from lifecycle.supervisor.run.events import Emitter, Notice
from lifecycle.supervisor.run.failure import Worker

_AGAIN_S = 2.0
"""How often a record is tried that could not be written."""

_LOCKED_S = 0.02
"""Shared memory is locked a moment after it was made."""

_QUIET_S = 0.2
"""Shared memory is made in bursts. After one it is looked whose it is, a millisecond for each."""

_BURST_S = 2.0
"""How long a burst lasts at most; until then all of it counts as what may be ours."""


class Records:
    """The records of one run.

    Attributes:
        segments: shared memory files that our processes were seen to own.
        unattributed: groups of such files that were made while we run, and whose owner was not seen
            yet: perhaps a process of ours that was killed at once.
    """

    def __init__(
        self,
        directory: RunDirectory,
        system: System,
        fork_server: ProcessFamily,
        worker: Worker,
        emit: Emitter,
    ) -> None:
        self._worker = worker
        self._emit = emit
        self._again: asyncio.TimerHandle | None = None
        self._said = False
        self._directory = directory
        self._system = system
        self._fork_server = fork_server
        self._start_ticks: dict[tuple[str, int], int | None] = {}
        self._started: frozenset[int] = frozenset()
        self._of_others: set[int] = set()
        self.segments: frozenset[str] = frozenset()
        self.unattributed: frozenset[str] = frozenset()
        self._made_s = float("-inf")

    def write(self) -> None:
        """Write down which processes run; where that fails it is said once, and tried again."""
        try:
            self._write()
        except OSError as error:
            if not self._said:
                self._said = True
                self._emit(
                    Notice(
                        message=f"cannot write {str(self._directory.path / 'record.json')!r}: "
                        f"{error.strerror}; the run goes on, but should this supervisor be killed, "
                        "the next one may not find all that it leaves"
                    )
                )
            if self._again is None:
                self._again = asyncio.get_running_loop().call_later(_AGAIN_S, self._try_again)
        else:
            self._said = False

    def _try_again(self) -> None:
        self._again = None
        self.write()

    def close(self) -> None:
        """Write nothing any more."""
        if self._again is not None:
            self._again.cancel()

    def _write(self) -> None:
        pids = {FORK_SERVER: self._fork_server.pid}
        pids.update({each.name: each.pid for each in self._system.living})
        known = self._start_ticks
        self._start_ticks = {
            each: known[each] if each in known else start_ticks(each[1]) for each in pids.items()
        }
        self._directory.record(
            tuple(
                ChildRecord(name=name, pid=pid, start_ticks=ticks)
                for (name, pid), ticks in self._start_ticks.items()
                if ticks is not None
            ),
            self.segments | self.unattributed,
        )

    def left(self) -> frozenset[str]:
        """Return what a sweep after the end of all processes is about, for `middleware.sweep`.

        It waits, bounded, so that a stranger's process has locked what it just makes.
        """
        self.unattributed = still_there(self.unattributed)
        if self.unattributed:
            time.sleep(max(0.0, self._made_s + _LOCKED_S - time.monotonic()))
        return self.segments | self.unattributed

    def made(self, groups: frozenset[str]) -> None:
        """Note what was made, before anybody looks whose it is: its owner may be killed."""
        self._made_s = time.monotonic()
        if not groups <= self.segments | self.unattributed:
            self.unattributed |= groups
            # What cannot be written now is written with the next record.
            with contextlib.suppress(OSError):
                self._directory.note_made(groups)

    async def note_segments(self) -> None:
        """Note the shared memory of our processes: one that is killed cannot remove its own."""
        self._add(await self._worker.run(self._owned))

    def _add(self, found: frozenset[str], of_others: frozenset[str] = frozenset()) -> None:
        """Take what is owned by ours, and forget what is owned by others."""
        self.unattributed -= found | of_others
        if not found <= self.segments:
            self.segments |= found
            self.write()

    def _owned(self) -> frozenset[str]:
        """Return what is owned now, also by what our processes started: `ros2 run` does."""
        return segments_of((os.getpid(), self._fork_server.pid, *self._fork_server.family()))

    def _locked(self, ours: frozenset[int]) -> tuple[frozenset[str], frozenset[str]]:
        """Return what ours own now, and what others do, at a glance where no owner is new.

        Args:
            ours: pids of our processes, perhaps without what they started.
        """
        try:
            held = segments_by_holder()
        except (OSError, ValueError):
            return self._owned(), frozenset()
        ours |= self._started
        if not held.keys() <= ours | self._of_others:
            # Perhaps of what one of ours has started, or not ours at all.
            family = self._fork_server.family()
            self._started |= family & held.keys()
            ours |= family
            # One that ended meanwhile may have been ours.
            others = held.keys() - ours
            self._of_others |= {each for each in others if start_ticks(each) is not None}
        theirs = held.keys() & self._of_others - ours
        return (
            frozenset[str]().union(*(held[pid] for pid in held.keys() & ours)),
            frozenset[str]().union(*(held[pid] for pid in theirs)),
        )

    async def note_each(self, created: asyncio.Event) -> None:
        """Note the shared memory of our processes each time that the event is set, for ever."""
        loop = asyncio.get_running_loop()
        while True:
            await created.wait()
            until_s = loop.time() + _BURST_S
            while created.is_set() and loop.time() < until_s:
                created.clear()
                # Not at each of them: there are a hundred for each process.
                await asyncio.sleep(_QUIET_S)
            living = (each.pid for each in self._system.living)
            ours = frozenset((os.getpid(), self._fork_server.pid, *living))
            self._add(*await self._worker.run(self._locked, ours))
            await self.note_segments()
            self._add(frozenset(), self.unattributed - still_there(self.unattributed))


@contextlib.contextmanager
def noting(
    directory: RunDirectory,
    system: System,
    fork_server: ProcessFamily,
    worker: Worker,
    emit: Emitter,
) -> Iterator[Records]:
    """Keep records that note shared memory once it is made: its owner may be killed at any time.

    Where the kernel does not announce it, it is noted when `note_segments` is called.
    """
    records = Records(directory, system, fork_server, worker, emit)
    records.write()
    try:
        creations = Creations()
    except OSError:
        try:
            yield records
        finally:
            records.close()
        return
    loop = asyncio.get_running_loop()
    created = asyncio.Event()

    def take() -> None:
        if groups := creations.take():
            records.made(groups)
            created.set()

    loop.add_reader(creations.descriptor, take)
    noted = asyncio.ensure_future(records.note_each(created))
    try:
        yield records
    finally:
        loop.remove_reader(creations.descriptor)
        creations.close()
        noted.cancel()
        records.close()
