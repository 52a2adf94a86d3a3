"""What a run leaves word of: its processes and the shared memory they were seen to use.

Owns: `Records`, which keeps the run directory true, for whoever has to clean up after a supervisor
that was killed.
"""

from __future__ import annotations

import asyncio
import os

from lifecycle.middleware.shm import segments_of
from lifecycle.supervisor.rundir import ChildRecord, RunDirectory, start_ticks
from lifecycle.supervisor.system import System


class Records:
    """The records of one run.

    Attributes:
        segments: shared memory files that our processes were seen to use.
    """

    def __init__(self, directory: RunDirectory, system: System, zygote_pid: int) -> None:
        self._directory = directory
        self._system = system
        self._zygote_pid = zygote_pid
        self.segments: frozenset[str] = frozenset()

    def write(self) -> None:
        """Write down which processes run."""
        pids = {"zygote": self._zygote_pid}
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
        """Remember the shared memory of our processes: one that is killed cannot remove its own."""
        pids = [os.getpid(), *(each.pid for each in self._system.living)]
        loop = asyncio.get_running_loop()
        self.segments |= await loop.run_in_executor(None, segments_of, pids)
        self.write()
