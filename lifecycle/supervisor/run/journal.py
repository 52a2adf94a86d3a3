"""Journal of a run: its events, kept on disk for afterwards.

Owns: the lines of `journal.jsonl` (schema: schemas/journal.v1.schema.json), beside the logs of the
run's processes, and `Journal`, which writes each at once, so that a supervisor that is killed
leaves all of it. A file that is full becomes `journal.jsonl.1`. Must not import rclpy.
"""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated, Any

import msgspec
from msgspec.structs import replace

from lifecycle import codec
from lifecycle.codec import Count, says
from lifecycle.supervisor.processes.logs import JOURNAL_NAME, RotatedFile
from lifecycle.supervisor.run.events import Event, LogLine, VerdictChanged

LARGEST_JOURNAL = 16 * 2**20
"""Bytes of a file; there is one, and one older."""

_TRIED_AGAIN_S = 1.0
"""How often a journal is tried that could not be written."""


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
    """Writes a run's journal; what cannot be written is said once and counted as missing.

    Args:
        system: its name.
        run_id: of the run.
        say: takes what a person should know.
    """

    def __init__(self, system: str, run_id: str, *, say: Callable[[str], None]) -> None:
        self._run = JournaledRun(
            journal_version=1, system=system, run_id=run_id, supervisor=os.getpid()
        )
        self._say = say
        self._began = time.monotonic()
        self._waiting: list[bytes] | None = []
        self._file: RotatedFile | None = None
        self._failed_s: float | None = None

    @contextlib.contextmanager
    def writing(self, directory: Path) -> Iterator[None]:
        """Write into the directory of the run's logs meanwhile; what came before waits for it."""
        path = directory / JOURNAL_NAME
        self._file = file = RotatedFile(path, 0o600, lambda: self._line(run=self._run))
        waiting, self._waiting = self._waiting or [], None
        for line in waiting:
            self._write(line)
        try:
            yield
        finally:
            file.close()
            self._file = None

    def on_event(self, event: Event) -> None:
        """Note an event; a listener of the run."""
        if isinstance(event, LogLine):
            return
        if isinstance(event, VerdictChanged):
            verdict = replace(event.verdict, flows=(), open_endpoints=())
            event = replace(event, verdict=verdict)
        line = self._line(event=event)
        if self._waiting is not None:
            self._waiting.append(line)
        else:
            self._write(line)

    def _line(self, **content: object) -> bytes:
        elapsed_s = round(time.monotonic() - self._began, 6)
        now = {"at": round(time.time(), 6), "elapsed_s": elapsed_s}
        return codec.to_json({**now, **content}) + b"\n"

    def _write(self, line: bytes) -> None:
        if self._file is None:
            return  # the run is over
        if self._failed_s is not None and time.monotonic() - self._failed_s < _TRIED_AGAIN_S:
            return
        try:
            self._file.write(line, LARGEST_JOURNAL)
            self._failed_s = None
        except OSError as error:
            first, self._failed_s = self._failed_s is None, time.monotonic()
            if first:
                self._say(
                    f"cannot write {str(self._file.path)!r}: {error.strerror}; the run goes on, "
                    "and what happens meanwhile is missing there"
                )
