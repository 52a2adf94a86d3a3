"""One process of a system: its state, its output, and its bounded end.

Owns: `ManagedProcess`. How it is forked is fork_server.py's, what the whole system does is
nodes/system.py's. Must not import rclpy.
"""

from __future__ import annotations

import asyncio
import functools
import os
import signal
from collections.abc import Callable, Sequence

from lifecycle.plan import PlannedProcess
from lifecycle.supervisor.processes.control_channel import ControlChannel
from lifecycle.supervisor.processes.logs import LineReader, LogDirectory, ProcessLog
from lifecycle.supervisor.processes.patience import own_starved_s
from lifecycle.supervisor.processes.spawn import (
    Child,
    ProcessExit,
    ProcessState,
    Spawner,
    SpawnRequest,
    change,
)
from lifecycle.supervisor.run.events import Emitter, LogLine, ProcessChanged

Escalation = Sequence[tuple[int, float]]
"""Steps to end a process: (signal number, 0 for none; seconds to wait for its end after it)."""

ESCALATION: Escalation = (
    (0, 2.0),
    (signal.SIGINT, 2.0),
    (signal.SIGTERM, 1.0),
    (signal.SIGKILL, 5.0),
)
"""For hosts, whose control channel was closed: destroying a participant may hang for good."""

STUCK_ESCALATION: Escalation = (
    (0, 1.0),
    (signal.SIGTERM, 0.5),
    (signal.SIGKILL, 5.0),
)
"""For a host with a callback in progress: asked politely, it would first have to finish it."""

STARTING_ESCALATION: Escalation = (
    (signal.SIGTERM, 1.5),
    (signal.SIGKILL, 5.0),
)
"""For a process whose nodes are not there yet: nothing to undo, and nothing to wait for.

Not SIGINT: Python answers that with a traceback from the middle of an import."""

COMMAND_ESCALATION: Escalation = ESCALATION[1:]
"""For foreign commands: rclpy and rclcpp end on SIGINT."""


class ManagedProcess:
    """An operating system process of the plan.

    Attributes:
        planned: what the plan declares of it.
        state: see spawn.py.
        channel: to our host; None for a foreign command.
        child: None before it was spawned.
        ended: resolves with how it ended.
        asked_to_end: `end` was called while it lived.
        on_stop: called with True when a signal stopped it, False when it continues; set before
            `spawn`.
    """

    def __init__(
        self,
        planned: PlannedProcess,
        *,
        logs: LogDirectory,
        emit: Emitter,
        variables: tuple[tuple[str, str], ...] = (),
    ) -> None:
        self.planned = planned
        self._variables = variables
        self.state = ProcessState.STARTING
        self.channel: ControlChannel | None = None
        self.child: Child | None = None
        self.ended: asyncio.Future[ProcessExit] = asyncio.get_running_loop().create_future()
        self.asked_to_end = False
        self.on_stop: Callable[[bool], None] = lambda _: None
        self.log = ProcessLog(logs, planned.name)
        self._emit = emit
        self._readers: list[LineReader] = []

    @property
    def name(self) -> str:
        """The planned name."""
        return self.planned.name

    @property
    def pid(self) -> int:
        """Process id; 0 before it was spawned."""
        return 0 if self.child is None else self.child.pid

    async def spawn(self, spawner: Spawner, channel: ControlChannel | None) -> None:
        """Start the process; returns once it exists.

        Raises:
            BringUpError: it cannot be started.
            OSError: the system is out of descriptors.
        """
        self.log.open()
        self._emit(ProcessChanged(process=self.name, state=self.state))
        ends: list[int] = []
        control = None
        own = dict(self.planned.environment)
        try:
            for stream in ("stdout", "stderr"):
                read, write = os.pipe()
                ends.append(write)
                self._readers.append(LineReader(read, functools.partial(self._line, stream)))
            if channel is not None:
                self.channel = channel
                control = await channel.open()
            self.child = await spawner.spawn(
                SpawnRequest(
                    name=self.name,
                    argv=self.planned.argv,
                    environment=tuple({**dict(self._variables), **own}.items()),
                    working_directory=self.planned.run.working_directory,
                    stdout=ends[0],
                    stderr=ends[1],
                    control=None if control is None else control.fileno(),
                    on_stop=self.on_stop,
                )
            )
        finally:
            for descriptor in ends:
                os.close(descriptor)
            if control is not None:
                control.close()
        self.child.exited.add_done_callback(self._exited)

    def starved_s(self) -> float:
        """Return how long it has waited for a processor, and we to hear of it; see patience.py."""
        return own_starved_s() + (0.0 if self.child is None else self.child.starved_s())

    def running(self) -> None:
        """Note that the process does its work: its nodes are there."""
        if self.state is ProcessState.STARTING:
            self._change(ProcessState.RUNNING)

    async def end(self, escalation: Escalation, hurry: asyncio.Event) -> str:
        """End the process and everything in its group, bounded.

        Args:
            escalation: tried in order until it ended.
            hurry: once set, waits are cut short and SIGKILL comes at once.

        Returns:
            The name of the signal that was needed beyond the first step; empty if none was.
        """
        if self.child is None or self.ended.done():
            await self._release()
            return ""
        if self.state in (ProcessState.STARTING, ProcessState.RUNNING):
            self.asked_to_end = True
            self._change(ProcessState.STOPPING)
        if self.channel is not None:
            await self.channel.close()
        needed = ""
        for index, (number, wait_s) in enumerate(escalation):
            if hurry.is_set() and number != signal.SIGKILL:
                continue
            if number:
                self.child.signal(number)
                needed = signal.Signals(number).name if index else ""
            if await self._wait(wait_s, hurry if number != signal.SIGKILL else None):
                break
        await self._release()
        return needed

    async def _wait(self, wait_s: float, hurry: asyncio.Event | None) -> bool:
        """Wait for the end; False when `wait_s` passed or there is a hurry first."""
        waits: list[asyncio.Future[object]] = [asyncio.ensure_future(asyncio.shield(self.ended))]
        if hurry is not None:
            waits.append(asyncio.ensure_future(hurry.wait()))
        try:
            await asyncio.wait(waits, timeout=wait_s, return_when=asyncio.FIRST_COMPLETED)
        finally:
            for each in waits:
                each.cancel()
        return self.ended.done()

    @property
    def died(self) -> bool:
        """Whether it ended although it was not asked to."""
        return self.state is ProcessState.EXITED and not self.asked_to_end

    def _exited(self, exited: asyncio.Future[ProcessExit]) -> None:
        self._change(ProcessState.EXITED, detail=str(exited.result()))
        self.ended.set_result(exited.result())

    async def _release(self) -> None:
        if self.channel is not None:
            await self.channel.close()
        for reader in self._readers:
            reader.close()
        self.log.close()

    def _change(self, state: ProcessState, detail: str = "") -> None:
        self.state = change(self.state, state)
        self._emit(ProcessChanged(process=self.name, state=state, pid=self.pid, detail=detail))

    def _line(self, stream: str, line: str) -> None:
        self.log.add(line)
        self._emit(LogLine(process=self.name, stream=stream, line=line))
