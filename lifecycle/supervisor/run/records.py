"""Records what a run owns: its processes and the shared memory that they were seen to own.

Owns: `Records`, which keeps the run directory true, for the next `up` or `down` that has to clean
up after a supervisor that was killed.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
from collections.abc import Iterator

from lifecycle.middleware import Creations, segments_of
from lifecycle.run_directory import ChildRecord, RunDirectory, start_ticks
from lifecycle.supervisor.nodes.system import System
from lifecycle.supervisor.processes.orphans import ProcessFamily
from lifecycle.supervisor.run.events import Emitter, Notice
from lifecycle.supervisor.run.failure import Worker

_AGAIN_S = 2.0
"""How often a record is tried that could not be written."""


class Records:
    """The records of one run.

    Attributes:
        segments: shared memory files that our processes were seen to own.
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
        self.segments: frozenset[str] = frozenset()

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
        pids = {"zygote": self._fork_server.pid}
        pids.update({each.name: each.pid for each in self._system.living})
        self._directory.record(
            tuple(
                ChildRecord(name=name, pid=pid, start_ticks=ticks)
                for name, pid in pids.items()
                if (ticks := start_ticks(pid)) is not None
            ),
            self.segments,
        )

    async def note_segments(self) -> None:
        """Note the shared memory of our processes: one that is killed cannot remove its own."""
        found = await self._worker.run(self._owned)
        if not found <= self.segments:
            self.segments |= found
            self.write()

    def _owned(self) -> frozenset[str]:
        """Return what is owned now, also by what our processes started: `ros2 run` does."""
        return segments_of((os.getpid(), self._fork_server.pid, *self._fork_server.family()))

    async def note_each(self, created: asyncio.Event) -> None:
        """Note the shared memory of our processes each time that the event is set, for ever."""
        while True:
            await created.wait()
            created.clear()
            await self.note_segments()


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
        if creations.take():
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
