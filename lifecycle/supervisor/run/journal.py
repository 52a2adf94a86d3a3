"""What a run leaves and reports while it lasts: its journal, and notices to systemd.

Owns: the lines of `journal.jsonl` (schema: schemas/journal.v1.schema.json), beside the logs of the
run's processes, and `Journal`, which writes each at once, so that a supervisor that is killed
leaves all of it. A file that is full becomes `journal.jsonl.1`. `lifecycle history` reads it: what
is read may be torn or foreign. And `ServiceManager`, by the sd_notify protocol: READY is sent when
the system is verified and active, never before. Until then EXTEND_TIMEOUT_USEC, and always
WATCHDOG, come from the supervisor's event loop, so that a supervisor that hangs is ended.
Source: sd_notify(3), sd_watchdog_enabled(3), systemd.service(5) "Type=notify". Must not import
rclpy.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import socket
import time
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any

import msgspec
from msgspec.structs import replace

from lifecycle import codec
from lifecycle.codec import Count, says
from lifecycle.errors import UsageError
from lifecycle.printable import one_line
from lifecycle.supervisor.processes.logs import JOURNAL_NAME, RotatedFile
from lifecycle.supervisor.run.events import (
    Event,
    Failure,
    GateOpened,
    LogLine,
    RunStarted,
    Stopping,
    SystemReached,
    VerdictChanged,
    from_record,
)

LARGEST_JOURNAL = 16 * 2**20
"""Bytes of a file; there is one, and one older."""

LONGEST_LINE = 64 * 2**20
"""Bytes of a line that is read at all."""


class JournaledRun(msgspec.Struct, frozen=True, kw_only=True):
    """Which run a journal is of; the first line of each file.

    Attributes:
        journal_version: of the lines, 1.
        run_id: value of LIFECYCLE_RUN in each process of the run.
        supervisor: pid.
    """

    journal_version: Annotated[int, says(const=1)]
    system: str
    run_id: str
    supervisor: Count


class JournalLine(msgspec.Struct, frozen=True, kw_only=True):
    """One line of a journal: the run, or an event.

    Attributes:
        at: when, in seconds since the epoch, by the clock of the host, which may be set.
        elapsed_s: seconds since the supervisor began, by a clock that only goes forward.
        run: which run it is.
        event: as `up --format json` prints it, verdicts without their flows; lines of processes are
            in their logs.
    """

    at: float
    elapsed_s: float
    run: JournaledRun | None = None
    event: dict[str, Any] | None = None


class Journal:
    """Writes a run's journal; what cannot be written is said once, and is missing there.

    It is beside the logs of the run, in a directory that is made with the first event.
    """

    def __init__(
        self, directory: Path, system: str, run_id: str, *, say: Callable[[str], None]
    ) -> None:
        self._run = JournaledRun(
            journal_version=1, system=system, run_id=run_id, supervisor=os.getpid()
        )
        self._say = say
        self._began = time.monotonic()
        self._file = RotatedFile(
            directory / JOURNAL_NAME,
            LARGEST_JOURNAL,
            mode=0o600,
            head=lambda: self._line(run=self._run),
        )

    def close(self) -> None:
        """Close its file; the run is over."""
        self._file.close()

    def on_event(self, event: Event) -> None:
        """Note an event; a listener of the run."""
        if isinstance(event, LogLine):
            return
        if isinstance(event, VerdictChanged):
            verdict = replace(event.verdict, flows=())
            event = replace(event, verdict=verdict)
        file = self._file
        failed = file.error is not None
        if not file.add(self._line(event=event)) and not failed and file.error is not None:
            self._say(
                f"cannot write {str(file.path)!r}: {file.error.strerror}; the run goes on, "
                "and what happens meanwhile is missing there"
            )

    def _line(self, **content: object) -> bytes:
        elapsed_s = round(time.monotonic() - self._began, 6)
        now = {"at": round(time.time(), 6), "elapsed_s": elapsed_s}
        return codec.to_json({**now, **content}) + b"\n"


class Moment(msgspec.Struct, frozen=True, kw_only=True):
    """One line of a journal.

    Attributes:
        line: as it is there.
        event: of a line that has one; None also where this version does not know its kind.
        text: of the file.
    """

    line: JournalLine
    event: Event | None
    text: str


def journal_files(path: Path) -> tuple[Path, ...]:
    """Return the files of a journal, oldest first, by a run's log directory or one of the files.

    Raises:
        UsageError: there is none.
    """
    newest = path / JOURNAL_NAME if os.path.isdir(path) else path
    older = newest.with_name(f"{newest.name}.1")
    found = tuple(each for each in (older, newest) if os.path.isfile(each))
    if not found or not os.path.exists(path):
        raise UsageError(
            f"cannot find a journal at {str(path)!r}",
            hint=f"name a run by its log directory, by {JOURNAL_NAME} in it, or --system NAME",
        )
    return found


def read_run(files: Iterable[Path], passed_over: Callable[[str], None]) -> list[Moment]:
    """Read a journal, oldest first; a line that cannot be read is passed over, and named.

    Raises:
        UsageError: a file cannot be read at all.
    """
    moments: list[Moment] = []
    for path in files:
        try:
            content = path.read_bytes().splitlines(keepends=True)
        except OSError as error:
            raise UsageError(f"cannot read {str(path)!r}: {error.strerror}") from error
        for number, data in enumerate(content, start=1):
            try:
                line = codec.from_json(data, JournalLine, longest=LONGEST_LINE)
                event = None if line.event is None else from_record(line.event)
            except ValueError as error:
                why = str(error) if data.endswith(b"\n") else "it is incomplete"
                passed_over(f"{path.name}:{number}: {why}")
                continue
            text = data.decode(errors="replace").rstrip("\n")
            moments.append(Moment(line=line, event=event, text=text))
    return moments


_TIMES_PER_LIMIT = 2
"""sd_watchdog_enabled(3): send in half of the time that is given."""

_EXTENSION_S = 20.0
"""For how much longer it may be starting. Bring-up has its own deadlines, which count anew for what
is restarted; the service manager's is for a supervisor that hangs."""


class ServiceManager:
    """Reports one run to the service manager that has started this process, if one has.

    Args:
        environment: NOTIFY_SOCKET names its socket, a leading `@` an abstract one; WATCHDOG_USEC
            the microseconds within which it wants a sign of life, of the process WATCHDOG_PID.
    """

    def __init__(self, environment: Mapping[str, str]) -> None:
        address = environment.get("NOTIFY_SOCKET", "")
        self._address = address if address.startswith(("/", "@")) else ""
        if address.startswith("@"):
            self._address = f"\0{address[1:]}"
        self._watchdog_s: float | None = None
        with contextlib.suppress(ValueError):
            pid = int(environment.get("WATCHDOG_PID", "") or os.getpid())
            limit_us = int(environment.get("WATCHDOG_USEC", ""))
            if pid == os.getpid() and limit_us > 0:
                self._watchdog_s = limit_us / 1e6
        self._timer: asyncio.TimerHandle | None = None
        self._starting = True
        self._active = False
        self._system = ""

    def on_event(self, event: Event) -> None:
        """Report what an event means for the service."""
        if isinstance(event, RunStarted):
            self._system = event.system
            self._send(STATUS=f"{event.system}: connecting {len(event.nodes)} nodes")
        elif isinstance(event, GateOpened):
            trusted = f"; taken on trust: {event.trusted}" if event.trusted else ""
            self._send(STATUS=f"{self._system}: verified, activating{trusted}")
        elif isinstance(event, SystemReached) and event.reached == "active":
            self._starting, self._active = False, True
            self._send(READY="1", STATUS=f"{self._system}: active and verified")
        elif isinstance(event, VerdictChanged):
            found = f", {len(event.verdict.findings)} findings" if event.verdict.findings else ""
            phase = "active" if self._active else "connecting"
            self._send(STATUS=f"{self._system}: {phase}, {event.verdict.verdict.value}{found}")
        elif isinstance(event, Failure):
            self._send(STATUS=f"{self._system}: {event.message}")
        elif isinstance(event, Stopping):
            self._starting = self._active = False
            self._send(STOPPING="1", STATUS=f"{self._system}: stopping, {event.reason}")

    def watch(self) -> Callable[[], None]:
        """Send signs of life from the running event loop; return what ends that."""
        if self._address:
            limit_s = min(self._watchdog_s or _EXTENSION_S, _EXTENSION_S)
            self._alive(asyncio.get_running_loop(), limit_s / _TIMES_PER_LIMIT)

        def end() -> None:
            if self._timer is not None:
                self._timer.cancel()

        return end

    def _alive(self, loop: asyncio.AbstractEventLoop, period_s: float) -> None:
        if self._starting:
            self._send(EXTEND_TIMEOUT_USEC=f"{_EXTENSION_S * 1e6:.0f}")
        if self._watchdog_s is not None:
            self._send(WATCHDOG="1")
        self._timer = loop.call_later(period_s, self._alive, loop, period_s)

    def _send(self, **state: str) -> None:
        """Send without waiting: a service manager that does not read is no reason to stop."""
        if not self._address:
            return
        text = "\n".join(f"{name}={one_line(value)}" for name, value in state.items())
        with (
            contextlib.suppress(OSError),
            socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK) as sender,
        ):
            sender.sendto(text.encode(), self._address)
