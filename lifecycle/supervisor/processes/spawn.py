"""What starting one operating system process means: the request, the child, the Protocols.

Owns: `SpawnRequest`, `Child`, `Spawner`. The real ones live in fork_server.py; tests bring their
own. Must not import rclpy.
"""

from __future__ import annotations

import asyncio
import dataclasses
from collections.abc import Callable
from typing import Protocol

from lifecycle.supervisor.processes.states import ProcessExit


def _ignore(is_stopped: bool) -> None:
    """Nobody wants to know."""


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
        on_stop: told True when a signal stopped the process (signal(7), Stop), False when it
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
