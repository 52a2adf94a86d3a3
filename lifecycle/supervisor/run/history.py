"""History of a run, read from its journal, which may be torn or foreign. Needs no ROS."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

import msgspec

from lifecycle import codec
from lifecycle.errors import UsageError
from lifecycle.supervisor.processes.logs import JOURNAL_NAME
from lifecycle.supervisor.run.events import Event, from_record
from lifecycle.supervisor.run.journal import JournaledRun, JournalLine

LONGEST_LINE = 64 * 2**20
"""Bytes of a line that is read at all."""


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
    found = [each for each in (older, newest) if os.path.isfile(each)]
    if not os.path.isdir(path) and path not in found:
        found = []
    if not found:
        raise UsageError(
            f"cannot find a journal at {str(path)!r}",
            hint=f"name the log directory of a run, or the file {JOURNAL_NAME} in it",
        )
    return tuple(found)


def read_run(files: Iterable[Path]) -> RecordedRun:
    """Read a journal; a line that cannot be read is passed over, and named.

    Raises:
        UsageError: a file cannot be read at all.
    """
    run: JournaledRun | None = None
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
            run = run or line.run
            text = data.decode(errors="replace").rstrip("\n")
            moments.append(Moment(line=line, event=event, text=text))
    return RecordedRun(run=run, moments=tuple(moments), unreadable=tuple(unreadable))
