"""Records the processes of a run, for the next `up` or `down` after a supervisor that was killed.

Owns: `Records`, which keeps the run directory true.
"""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from lifecycle.run_directory import FORK_SERVER, ChildRecord, RunDirectory, start_ticks
from lifecycle.supervisor.nodes.system import System
from lifecycle.supervisor.run.events import Emitter, Notice

if TYPE_CHECKING:
    from lifecycle.supervisor.processes.fork_server import ForkServer

_AGAIN_S = 2.0
"""How often a record is tried that could not be written."""


class Records:
    """The records of one run; `close` it."""

    def __init__(
        self, directory: RunDirectory, system: System, fork_server: ForkServer, emit: Emitter
    ) -> None:
        self._emit = emit
        self._again: asyncio.TimerHandle | None = None
        self._said = False
        self._directory = directory
        self._system = system
        self._fork_server = fork_server
        self._start_ticks: dict[tuple[str, int], int | None] = {}

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
            )
        )
