"""Journal of a run: its events, kept on disk for afterwards, and read again by `lifecycle history`.

Owns: the lines of `journal.jsonl` (schema: schemas/journal.v1.schema.json), beside the logs of the
run's processes, and `Journal`, which writes each at once, so that a supervisor that is killed
leaves all of it. A file that is full becomes `journal.jsonl.1`. What is read may be torn or
foreign. Must not import rclpy.
"""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Annotated, Any

import msgspec
from msgspec.structs import replace

from lifecycle import codec
from lifecycle.codec import Count, says
from lifecycle.errors import UsageError
from lifecycle.supervisor.processes.logs import JOURNAL_NAME, RotatedFile
from lifecycle.supervisor.run.events import Event, LogLine, VerdictChanged, from_record

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

    Args:
        system: its name.
        run_id: of the run.
        say: takes what a person should know.
    """

    def __init__(
        self,
        system: str,
        run_id: str,
        *,
        say: Callable[[str], None],
    ) -> None:
        self._run = JournaledRun(
            journal_version=1, system=system, run_id=run_id, supervisor=os.getpid()
        )
        self._say = say
        self._began = time.monotonic()
        self._waiting: list[bytes] = []
        self._file: RotatedFile | None = None

    @contextlib.contextmanager
    def writing(self, directory: Path) -> Iterator[None]:
        """Write into the directory of the run's logs meanwhile; what came before waits for it."""
        self._file = RotatedFile(
            directory / JOURNAL_NAME,
            LARGEST_JOURNAL,
            mode=0o600,
            head=lambda: self._line(run=self._run),
        )
        for line in self._waiting:
            self._write(self._file, line)
        try:
            yield
        finally:
            self._file.close()
            self._file = None

    def on_event(self, event: Event) -> None:
        """Note an event; a listener of the run."""
        if isinstance(event, LogLine):
            return
        if isinstance(event, VerdictChanged):
            verdict = replace(event.verdict, flows=(), open_endpoints=())
            event = replace(event, verdict=verdict)
        line = self._line(event=event)
        if self._file is None:
            self._waiting.append(line)
        else:
            self._write(self._file, line)

    def _line(self, **content: object) -> bytes:
        elapsed_s = round(time.monotonic() - self._began, 6)
        now = {"at": round(time.time(), 6), "elapsed_s": elapsed_s}
        return codec.to_json({**now, **content}) + b"\n"

    def _write(self, file: RotatedFile, line: bytes) -> None:
        failed = file.error is not None
        if not file.add(line) and not failed and file.error is not None:
            self._say(
                f"cannot write {str(file.path)!r}: {file.error.strerror}; the run goes on, "
                "and what happens meanwhile is missing there"
            )


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


class RecordedRun(msgspec.Struct, frozen=True, kw_only=True):
    """A journal that was read.

    Attributes:
        run: which run it is of; None where no line says so.
        moments: every line, oldest first.
        unreadable: (file and line, why) of what was passed over.
    """

    run: JournaledRun | None
    moments: tuple[Moment, ...]
    unreadable: tuple[tuple[str, str], ...]


def journal_files(path: Path) -> tuple[Path, ...]:
    """Return the files of a journal, oldest first.

    Args:
        path: of a run's log directory, or of one file.

    Raises:
        UsageError: there is none.
    """
    newest = path / JOURNAL_NAME if os.path.isdir(path) else path
    older = newest.with_name(f"{newest.name}.1")
    found = tuple(each for each in (older, newest) if os.path.isfile(each))
    if not found or not os.path.exists(path):
        raise UsageError(
            f"cannot find a journal at {str(path)!r}",
            hint=f"name the log directory of a run, or the file {JOURNAL_NAME} in it",
        )
    return found


def read_run(files: Iterable[Path]) -> RecordedRun:
    """Read a journal; a line that cannot be read is passed over, and named.

    Raises:
        UsageError: a file cannot be read at all.
    """
    moments: list[Moment] = []
    unreadable: list[tuple[str, str]] = []
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
                unreadable.append((f"{path.name}:{number}", why))
                continue
            text = data.decode(errors="replace").rstrip("\n")
            moments.append(Moment(line=line, event=event, text=text))
    run = next((each.line.run for each in moments if each.line.run), None)
    return RecordedRun(run=run, moments=tuple(moments), unreadable=tuple(unreadable))
