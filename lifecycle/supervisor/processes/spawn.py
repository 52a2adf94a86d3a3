"""Interface for starting operating system processes, and process states with their legal changes.

Owns: `SpawnRequest`, `Child`, `Spawner`, `ProcessState`, `ProcessExit` and the table of changes.
The names of process states are not those of node states: only nodes are "active". The real spawner
and child live in fork_server.py; tests bring their own. Must not import rclpy.
"""

from __future__ import annotations

import asyncio
import dataclasses
import enum
import os
import signal
from collections.abc import Callable
from typing import Protocol


class ProcessState(enum.Enum):
    """The life of one operating system process; BACKOFF is the wait before it is started again."""

    STARTING = "starting"
    RUNNING = "running"
    BACKOFF = "backoff"
    STOPPING = "stopping"
    EXITED = "exited"


CHANGES: dict[ProcessState, frozenset[ProcessState]] = {
    ProcessState.STARTING: frozenset(
        {ProcessState.RUNNING, ProcessState.STOPPING, ProcessState.EXITED}
    ),
    ProcessState.RUNNING: frozenset({ProcessState.STOPPING, ProcessState.EXITED}),
    ProcessState.STOPPING: frozenset({ProcessState.EXITED}),
    ProcessState.EXITED: frozenset({ProcessState.BACKOFF, ProcessState.STARTING}),
    ProcessState.BACKOFF: frozenset({ProcessState.STARTING, ProcessState.EXITED}),
}
"""Every legal change; a pair that is missing is a bug of the caller."""


def change(old: ProcessState, new: ProcessState) -> ProcessState:
    """Return `new` if a process may go there from `old`.

    Raises:
        ValueError: it may not; a bug of the caller.
    """
    if new not in CHANGES[old]:
        allowed = ", ".join(sorted(state.value for state in CHANGES[old]))
        raise ValueError(
            f"cannot change a process from {old.value!r} to {new.value!r}; allowed: {allowed}"
        )
    return new


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class ProcessExit:
    """How a process ended.

    Attributes:
        status: exit status, 0–255; None if a signal ended it or it is not known.
        signal: number of the signal that ended it; None otherwise.
    """

    status: int | None = None
    signal: int | None = None

    @classmethod
    def from_wait(cls, raw: int) -> ProcessExit:
        """Decode the status of waitpid(2)."""
        code = os.waitstatus_to_exitcode(raw)
        return cls(status=code) if code >= 0 else cls(signal=-code)

    def __str__(self) -> str:
        if self.signal is not None:
            try:
                return f"killed by {signal.Signals(self.signal).name}"
            except ValueError:
                return f"killed by signal {self.signal}"
        if self.status is not None:
            return f"exit status {self.status}"
        return "ended, exit status unknown"


def _ignore(is_stopped: bool) -> None:
    """Ignore that it stopped or continues."""


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class SpawnRequest:
    """One process to start, in a session of its own.

    Attributes:
        name: of the planned process, for messages.
        argv: command line; empty for a process that serves the control channel as our node host.
        environment: (name, value) on top of the spawner's own environment.
        working_directory: empty for the spawner's own.
        stdout: descriptor; the spawner does not close it.
        stderr: descriptor.
        control: descriptor of the host's end of the control channel; None for a foreign command.
        on_stop: called with True when a signal stopped the process (signal(7), Stop), False when it
            continues.
    """

    name: str
    argv: tuple[str, ...]
    environment: tuple[tuple[str, str], ...]
    working_directory: str
    stdout: int
    stderr: int
    control: int | None = None
    on_stop: Callable[[bool], None] = _ignore


class Child(Protocol):
    """A started process, which is the leader of its own session and process group.

    Attributes:
        pid: process id in our pid namespace.
        exited: resolves as soon as it ended.
    """

    pid: int
    exited: asyncio.Future[ProcessExit]

    def signal(self, number: int) -> None:
        """Send a signal to the process and everything in its group; harmless once it ended."""

    def starved_s(self) -> float:
        """Return the seconds that its threads have waited for a processor, added up.

        Those of all its descendants count, too; 0 where the kernel does not say.
        """


class Spawner(Protocol):
    """Starts processes."""

    async def ready(self) -> None:
        """Wait, bounded, until processes can be started.

        Raises:
            BringUpError: they cannot.
        """

    async def spawn(self, request: SpawnRequest) -> Child:
        """Start one process.

        Raises:
            BringUpError: it cannot be started.
        """

    async def close(self) -> None:
        """Give up the spawner; its children must have ended."""
