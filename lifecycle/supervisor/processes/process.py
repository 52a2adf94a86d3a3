"""One process of a system: its output, its channel, its scope, and how it ended.

Owns: `ManagedProcess`; how long a process was ready to run but had no CPU, which counts in no
deadline; and the scopes of systemd, which limit what a process and all that it starts may use
(systemd-run(1), systemd.resource-control(5)). When it is started and ended is the core's; what
starts it is fork_server.py, or a test. Must not import rclpy.
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
import os
import shutil
import signal
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec

from lifecycle.manifest.model import Output, Resources
from lifecycle.middleware.process.busy_sign import brief
from lifecycle.plan.model import PlannedProcess
from lifecycle.printable import log_line
from lifecycle.supervisor.processes.control_channel import ControlChannel
from lifecycle.supervisor.processes.fork_server_main import GRACE_S
from lifecycle.supervisor.processes.logs import (
    LineReader,
    LogDirectory,
    ProcessLog,
    Traceback,
)
from lifecycle.supervisor.run.events import Emitter, LogLine
from lifecycle.verify.outcome import Outcome
from lifecycle.verify.rules import rule
from lifecycle.verify.verdict import Finding

if TYPE_CHECKING:
    from lifecycle.supervisor.processes.fork_server import ForkServer


class ProcessExit(msgspec.Struct, frozen=True, kw_only=True):
    """How a process ended.

    Attributes:
        status: exit status, 0–255; None if a signal ended it or it is not known.
        signal: number of the signal that ended it; None otherwise.
    """

    status: int | None = None
    signal: int | None = None

    @classmethod
    def of(cls, code: int) -> ProcessExit:
        """Return what an exit code says, as `subprocess` has it: below 0 for a signal."""
        return cls(status=code) if code >= 0 else cls(signal=-code)

    @property
    def is_clean(self) -> bool:
        """Whether it is an end that was asked for, by whomever, as systemd.service(5) has it."""
        return self.status == 0 or self.signal in _CLEAN

    @property
    def is_crash(self) -> bool:
        """Whether the program broke; shells say so of what they ran by 128 + the signal."""
        return self.signal in _CRASHES or (self.status or 0) - 128 in _CRASHES

    def __str__(self) -> str:
        if self.signal is not None:
            try:
                return f"killed by {signal.Signals(self.signal).name}"
            except ValueError:
                return f"killed by signal {self.signal}"
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


_LONGEST_WORDS = 300
"""Characters of an error that a message repeats."""


class ManagedProcess:
    """An operating system process of the plan.

    Args:
        variables: (name, value) that it gets beside its own.
        grace_s: seconds that it gets to end by itself should the supervisor be killed.

    Attributes:
        planned: what the plan declares of it.
        environment: (name, value) on top of the supervisor's own environment.
        channel: to our host; None for a foreign command.
        pid: process id; 0 before it was spawned.
        ended: resolves with how it ended.
        on_stop: called with True when a signal stopped it, False when it continues; set before
            `spawn`.
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
        grace_s: float = GRACE_S,
    ) -> None:
        self.planned = planned
        self.grace_s = grace_s
        self.environment = tuple({**dict(variables), **dict(planned.environment)}.items())
        self.channel: ControlChannel | None = None
        self.pid = 0
        self._spawner: ForkServer | None = None
        self.ended: asyncio.Future[ProcessExit] = asyncio.get_running_loop().create_future()
        self.started_s = emit.elapsed_s
        self.last_stderr = ""
        self._traceback = Traceback()
        self.is_restarted = False
        self.on_stop: Callable[[bool], None] = lambda _: None
        kept = planned.run.output is not Output.SCREEN
        self.log = ProcessLog(logs, planned.name, kept=kept)
        self._emit = emit
        self._readers: list[LineReader] = []

    @property
    def name(self) -> str:
        """The planned name."""
        return self.planned.name

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
        self.log.open()
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
            self.pid = await spawner.spawn(
                self, ends, None if control is None else control.fileno()
            )
            self._spawner = spawner
        finally:
            for descriptor in ends:
                os.close(descriptor)
            if control is not None:
                control.close()
        self.started_s = self._emit.elapsed_s

    def signal(self, number: int) -> None:
        """Send a signal to the process and everything in its group; harmless once it ended."""
        if self._spawner is not None and not self.ended.done():
            self._spawner.signal(self.pid, number)

    def run_delay_s(self) -> float:
        """Return how long its main thread has waited for a processor."""
        return 0.0 if self._spawner is None else self._spawner.run_delay_s(self.pid)

    def settle(self, how: ProcessExit) -> None:
        """Take how it ended, after what it wrote before; called by what spawned it."""
        for each in self._readers:
            each.drain()
        self.ended.set_result(how)

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

    async def release(self) -> None:
        """Let go of its channel, its output and its logs, once it has ended or was never there."""
        if self.channel is not None:
            await self.channel.close()
        for reader in self._readers:
            reader.close()
        self.log.close()

    def _line(self, stream: str, line: str) -> None:
        self.log.add(line)
        if stream == "stderr" and line.strip():
            self.last_stderr = line
            self._traceback.add(line)
        if self.planned.run.output is not Output.LOG:
            self._emit(LogLine(process=self.name, stream=stream, line=line))


def run_delay_s(task: str = "thread-self") -> float:
    """Return how long this thread, or the main thread of a process, has waited for a processor.

    Returns:
        Seconds, see "run delay" in sched-stats(Documentation/scheduler); 0 where the kernel does
        not count it or the process has ended.
    """
    with contextlib.suppress(OSError, ValueError, IndexError):
        return int(Path(f"/proc/{task}/schedstat").read_text().split()[1]) / 1e9
    return 0.0


def why_unlimited() -> str:
    """Return why no process can have a scope here; empty if they can."""
    folder = "/run"
    if os.geteuid():
        folder = os.environ.get("XDG_RUNTIME_DIR") or f"/run/user/{os.geteuid()}"
    if not Path("/run/systemd/system").is_dir():  # sd_booted(3)
        return "systemd does not run here"
    if shutil.which("systemd-run") is None:
        return "there is no systemd-run here"
    if not Path(folder, "systemd", "private").exists():
        return f"this user has no service manager here ({folder}/systemd)"
    return ""


def scope(resources: Resources | None) -> tuple[str, ...]:
    """Return the words before a command that limit it; none where nothing is to, or can be.

    The command replaces systemd-run: it has its pid, descriptors, session and environment.
    """
    properties = () if resources is None else resources.properties()
    if not properties or why_unlimited():
        return ()
    user = ("--user",) if os.geteuid() else ()
    limits = (f"--property={each}" for each in properties)
    return ("systemd-run", "--scope", "--quiet", "--collect", *user, *limits, "--")


def unlimited(processes: Iterable[PlannedProcess]) -> tuple[Finding, ...]:
    """Return an unverifiable finding for each process here that nothing limits as declared."""
    limited = [
        (each.name, each.run.resources)
        for each in processes
        if each.run.resources is not None and each.run.resources.properties()
    ]
    why = why_unlimited() if limited else ""
    return tuple(
        rule("declaration.unproven").finding(
            outcome=Outcome.UNVERIFIABLE,
            subject=name,
            expected=f"limited: {', '.join(resources.properties())}",
            observed="run.resources",
            message=f"cannot limit the resources of process {name!r}: {why}",
            at=resources.at,
            hint="start lifecycle where systemd runs, or limit the whole container",
        )
        for name, resources in limited
        if why
    )
