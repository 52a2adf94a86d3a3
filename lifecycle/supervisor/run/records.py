"""Records the processes of a run, for the next `up` or `down` after a supervisor that was killed.

Owns: `Records`, which keeps the run directory true.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from lifecycle.run_directory import FORK_SERVER, ChildRecord, RunDirectory, start_ticks
from lifecycle.supervisor.nodes.system import System
from lifecycle.supervisor.run.events import Notice

if TYPE_CHECKING:
    from lifecycle.supervisor.processes.fork_server import ForkServer


class Records:
    """The records of one run, in its directory."""

    def __init__(self, directory: RunDirectory, system: System, fork_server: ForkServer) -> None:
        self._directory = directory
        self._system = system
        self._fork_server = fork_server
        self._known: dict[int, ChildRecord] = {}
        self._said = False

    def write(self) -> None:
        """Write down which processes run; where that fails it is said once, and the run goes on."""
        names = {each.pid: each.name for each in self._system.living}
        names[self._fork_server.pid] = FORK_SERVER
        known, self._known = self._known, {}
        for pid, name in names.items():
            if pid in known:
                self._known[pid] = known[pid]
            elif (ticks := start_ticks(pid)) is not None:
                self._known[pid] = ChildRecord(name=name, pid=pid, start_ticks=ticks)
        try:
            self._directory.record(tuple(self._known.values()))
        except OSError as error:
            if not self._said:
                self._said = True
                self._system.emit(
                    Notice(
                        message=f"cannot write {str(self._directory.path / 'record.json')!r}: "
                        f"{error.strerror}; the run goes on, but should this supervisor be killed, "
                        "the next one may not find all that it leaves"
                    )
                )
        else:
            self._said = False
