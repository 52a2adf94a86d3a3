"""One process of a system: how it is started, its states, its output, and its bounded end.

Owns: `ManagedProcess`, whose states are not called as those of nodes: only nodes are "active"; and
deadlines on a loaded machine: time in which a process was ready to run but had no CPU does not
count. What starts it is fork_server.py, or a test; what the whole system does is nodes/system.py's.
Must not import rclpy.
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
import os
import signal
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from lifecycle.manifest.model import Output
from lifecycle.middleware.process.stacks import brief
from lifecycle.plan.model import PlannedProcess
from lifecycle.printable import log_line
from lifecycle.supervisor.control.protocol import ProcessState
from lifecycle.supervisor.processes.control_channel import ControlChannel
from lifecycle.supervisor.processes.fork_server_main import GRACE_S
from lifecycle.supervisor.processes.logs import (
    LineReader,
    LogDirectory,
    ProcessLog,
    Traceback,
    logger_in,
    logger_of,
)
from lifecycle.supervisor.run.events import Emitter, LogLine, ProcessChanged

if TYPE_CHECKING:
    from lifecycle.supervisor.processes.fork_server import ForkServer, ForkServerChild


class ProcessExit(msgspec.Struct, frozen=True, kw_only=True):
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

    @property
    def is_clean(self) -> bool:
        """Whether it is an end that was asked for, by whomever, as systemd.service(5) has it."""
        return self.status == 0 or self.signal in _CLEAN

    @property
    def is_crash(self) -> bool:
        """Whether the program broke; shells say so of what they ran by 128 + the signal."""
        return self.signal in _CRASHES or (self.status or 0) - 128 in _CRASHES

    @property
    def signal_name(self) -> str:
        """`SIGKILL`, or the number of one without a name; empty if no signal ended it."""
        if self.signal is None:
            return ""
        try:
            return signal.Signals(self.signal).name
        except ValueError:
            return str(self.signal)

    def __str__(self) -> str:
        if self.signal is not None:
            name = self.signal_name
            return f"killed by signal {name}" if name.isdigit() else f"killed by {name}"
        if self.status is not None:
            return f"exit status {self.status}"
        return "ended, exit status unknown"


_CLEAN = (signal.SIGHUP, signal.SIGINT, signal.SIGTERM, signal.SIGPIPE)
_CRASHES = (
    signal.SIGILL,
    signal.SIGTRAP,
    signal.SIGABRT,
    signal.SIGBUS,
    signal.SIGFPE,
    signal.SIGSEGV,
    signal.SIGSYS,
)


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

_LONGEST_WORDS = 300
"""Characters of an error that a message repeats."""

COMMAND_ESCALATION: Escalation = ESCALATION[1:]
"""For foreign commands: rclpy and rclcpp end on SIGINT."""


class ManagedProcess:
    """An operating system process of the plan.

    Args:
        nodes: keys of its nodes by their full names; of several, each has a log file of its own
            beside the process's, with the lines of its logger.
        variables: (name, value) that it gets beside its own.
        grace_s: seconds that it gets to end by itself should the supervisor be killed.

    Attributes:
        planned: what the plan declares of it.
        environment: (name, value) on top of the supervisor's own environment.
        carries: full names of the nodes that are gone with it, loaded components included.
        state: in the order of ProcessState; from any but the last it may be EXITED next.
        channel: to our host; None for a foreign command.
        child: None before it was spawned.
        ended: resolves with how it ended.
        asked_to_end: `end` was called while it lived.
        on_stop: called with True when a signal stopped it, False when it continues; set before
            `spawn`.
        may_end: it may end by itself, with exit status 0.
        started_s: when it was spawned, in seconds since the supervisor started.
        is_restarted: another one ran in its place before.
        last_stderr: the last line that it wrote to standard error; empty if none.
    """

    def __init__(
        self,
        planned: PlannedProcess,
        *,
        logs: LogDirectory,
        emit: Emitter,
        variables: tuple[tuple[str, str], ...] = (),
        nodes: Mapping[str, str] | None = None,
        may_end: bool = False,
        grace_s: float = GRACE_S,
        carries: Iterable[str] = (),
    ) -> None:
        self.planned = planned
        self.carries = tuple(carries)
        self.grace_s = grace_s
        self.may_end = may_end
        self.environment = tuple({**dict(variables), **dict(planned.environment)}.items())
        self.state = ProcessState.STARTING
        self.channel: ControlChannel | None = None
        self.child: ForkServerChild | None = None
        self.ended: asyncio.Future[ProcessExit] = asyncio.get_running_loop().create_future()
        self.asked_to_end = False
        self.started_s = emit.elapsed_s
        self.last_stderr = ""
        self._traceback = Traceback()
        self._signals: set[int] = set()
        self.is_restarted = False
        self.on_stop: Callable[[bool], None] = lambda _: None
        kept = planned.run.output is not Output.SCREEN
        self.log = ProcessLog(logs, planned.name, kept=kept)
        self._node_logs: dict[str, ProcessLog] = {}
        if kept and nodes is not None and len(nodes) > 1:
            self._node_logs = {
                logger_of(name): ProcessLog(logs, key)
                for name, key in nodes.items()
                if key != planned.name
            }
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

    def where(self) -> str:
        """Return where a callback of it stands, in short, and write all of it into the log.

        Empty of a process that does not say: it is a command, or was stopped.
        """
        sign = None if self.channel is None else self.channel.sign
        stacks = "" if sign is None else sign.where(self.pid)
        for line in stacks.splitlines():
            self.log.add(line)
        return brief(stacks)

    async def spawn(self, spawner: ForkServer, channel: ControlChannel | None) -> None:
        """Start the process; returns once it exists.

        Raises:
            BringUpError: it cannot be started.
            OSError: the system is out of descriptors.
        """
        for log in (self.log, *self._node_logs.values()):
            log.open()
        self._emit(ProcessChanged(process=self.name, state=self.state))
        ends: list[int] = []
        control = None
        try:
            for stream in ("stdout", "stderr"):
                read, write = os.pipe()
                ends.append(write)
                self._readers.append(LineReader(read, functools.partial(self._line, stream)))
            if channel is not None:
                self.channel = channel
                control = await channel.open()
            self.child = await spawner.spawn(
                self, ends, None if control is None else control.fileno()
            )
        finally:
            for descriptor in ends:
                os.close(descriptor)
            if control is not None:
                control.close()
        self.started_s = self._emit.elapsed_s
        self.child.exited.add_done_callback(self._exited)

    def run_delay_s(self) -> float:
        """Return its run delay and ours, seconds: ready to run, but without CPU."""
        return own_run_delay_s() + (0.0 if self.child is None else self.child.run_delay_s())

    def running(self) -> None:
        """Note that the process does its work: its nodes are there."""
        if self.state is ProcessState.STARTING:
            self._change(ProcessState.RUNNING)

    def back_off(self) -> None:
        """Note that it has ended and that another one is to be started in its place."""
        if self.state is ProcessState.STARTING and self.child is None:
            self.state = ProcessState.EXITED
        if self.state is ProcessState.EXITED:
            self._change(ProcessState.BACKOFF)

    @property
    def is_gone(self) -> bool:
        """Whether it has ended, in backoff or for good."""
        return self.state in (ProcessState.EXITED, ProcessState.BACKOFF)

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
                self._signals.add(number)
                self.child.signal(number)
                needed = signal.Signals(number).name if index else ""
            if await self._wait(wait_s, hurry if number != signal.SIGKILL else None):
                break
        await self._release()
        return needed

    async def _wait(self, wait_s: float, hurry: asyncio.Event | None) -> bool:
        """Wait for the end; False when `wait_s` passed or there is a hurry first."""
        waits: set[asyncio.Future[Any]] = {self.ended}
        hurried = None if hurry is None else asyncio.ensure_future(hurry.wait())
        if hurried is not None:
            waits.add(hurried)
        try:
            await asyncio.wait(waits, timeout=wait_s, return_when=asyncio.FIRST_COMPLETED)
        finally:
            if hurried is not None:
                hurried.cancel()
        return self.ended.done()

    @property
    def died(self) -> bool:
        """Whether it ended although it was not asked to, and not as it may."""
        return self.state is ProcessState.EXITED and not self.asked_to_end and not self.is_over

    @property
    def crashed(self) -> bool:
        """Whether it was asked to end, and died instead: of nothing that we sent it.

        A host of ours exits with 0, or with 1 where a callback kept it from shutting down, which it
        says. Commands have exit statuses of their own for SIGINT.
        """
        if not self.asked_to_end or not self.ended.done():
            return False
        end = self.ended.result()
        if end.signal is not None:
            return end.signal not in self._signals and not end.is_clean
        return end.is_crash or (self.channel is not None and (end.status or 0) > 1)

    @property
    def last_words(self) -> str:
        """What it said of its end: one line of printable characters, or nothing.

        That is the exception of its last traceback with its place, of a program that ended by
        itself; else its last line on standard error. One that others killed said nothing of it.
        """
        end = self.ended.result() if self.ended.done() else ProcessExit()
        if end.status == 0 or (end.signal is not None and not end.is_crash):
            return ""
        text = self._traceback.last if end.signal is None else ""
        text = log_line(text or self.last_stderr.strip())
        return text if len(text) <= _LONGEST_WORDS else f"{text[: _LONGEST_WORDS - 1]}…"

    @property
    def is_over(self) -> bool:
        """Whether it has ended by itself as all of its nodes may: with exit status 0."""
        return self.may_end and self.ended.done() and self.ended.result().status == 0

    def _exited(self, exited: asyncio.Future[ProcessExit]) -> None:
        # Before anybody is notified: a listener that raises must not lose it.
        self.state = ProcessState.EXITED
        self.ended.set_result(exited.result())
        for each in self._readers:
            each.drain()
        self._say(detail=str(exited.result()))

    async def _release(self) -> None:
        if self.channel is not None:
            await self.channel.close()
        for reader in self._readers:
            reader.close()
        for log in (self.log, *self._node_logs.values()):
            log.close()

    def _change(self, state: ProcessState, detail: str = "") -> None:
        self.state = state
        self._say(detail)

    def _say(self, detail: str = "") -> None:
        self._emit(ProcessChanged(process=self.name, state=self.state, pid=self.pid, detail=detail))

    def _line(self, stream: str, line: str) -> None:
        self.log.add(line)
        if stream == "stderr" and line.strip():
            self.last_stderr = line
            self._traceback.add(line)
        if self._node_logs and (logger := logger_in(line, self._node_logs)):
            self._node_logs[logger].add(line)
        if self.planned.run.output is not Output.LOG:
            self._emit(LogLine(process=self.name, stream=stream, line=line))


PROMPT_S = 1.0
"""What is done within this, or a tenth of its limit, is not worth looking, which takes a file of
each thread: most steps are, of many nodes at once, too."""

SLICE_S = 1.0
"""How often is looked whether a process could run, while it is waited for."""

_LEAST_S = 0.01
"""What is left of a limit may shrink by half each time, and never end."""

AT_MOST = 10.0
"""However loaded the machine is, a limit lasts no longer than so many times its seconds."""


async def wait_under_load(
    waits: Collection[asyncio.Future[Any]], limit_s: float, run_delay: Callable[[], float]
) -> bool:
    """Wait until one of some futures is done, or the limit is over; whether one is done.

    Args:
        waits: not cancelled here.
        limit_s: seconds, > 0, in which the process can run. Its run delay comes on top, up to
            `AT_MOST` times the limit in all.
        run_delay: seconds of run delay so far, of all threads together.
    """
    prompt_s = min(PROMPT_S, limit_s / 10)
    done, _ = await asyncio.wait(waits, timeout=prompt_s, return_when=asyncio.FIRST_COMPLETED)
    if done:
        return True
    loop = asyncio.get_running_loop()
    began_s = now_s = loop.time()
    left_s = limit_s - prompt_s
    waited_s = run_delay()
    while left_s > 0 and now_s - began_s < AT_MOST * limit_s:
        done, _ = await asyncio.wait(
            waits, timeout=min(max(left_s, _LEAST_S), SLICE_S), return_when=asyncio.FIRST_COMPLETED
        )
        if done:
            return True
        before_s, now_s = now_s, loop.time()
        waited_before_s, waited_s = waited_s, run_delay()
        # Threads that wait at once have waited no longer for it, and one that ends takes its own
        # along.
        passed_s = now_s - before_s
        left_s -= passed_s - min(max(waited_s - waited_before_s, 0.0), passed_s)
    return any(each.done() for each in waits)


def run_delay_s(pid: int) -> float:
    """Return how long the threads of a process have waited for a processor, all together.

    Returns:
        Seconds, see "run delay" in sched-stats(Documentation/scheduler); 0 where the kernel does
        not count it or the process has ended.
    """
    total_ns = 0
    with contextlib.suppress(FileNotFoundError, ProcessLookupError, PermissionError):
        for thread in Path(f"/proc/{pid}/task").iterdir():
            total_ns += _run_delay_ns(f"{thread}/schedstat")
    return total_ns / 1e9


def own_run_delay_s() -> float:
    """Return how long this thread has waited for a processor, in seconds."""
    return _run_delay_ns("/proc/thread-self/schedstat") / 1e9


def _run_delay_ns(path: str) -> int:
    with contextlib.suppress(OSError, ValueError, IndexError):
        descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
        try:
            return int(os.read(descriptor, 128).split()[1])
        finally:
            os.close(descriptor)
    return 0
