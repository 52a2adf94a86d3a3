"""What was measured of flows, for people and spreadsheets: cells with small bars, rows of a record.

Owns: how a number and its bound look in a table, with `!` for a bound that is not kept and `?` for
one that is not decided, so that no colour is needed to read it; and the file that
`lifecycle flows --record` writes.
"""

from __future__ import annotations

import contextlib
import csv
import datetime as dt
import time
from collections.abc import Iterable
from pathlib import Path

from lifecycle.errors import UsageError
from lifecycle.measure.flows import NUMBERS, FlowMeasurement, Kind

_MARKS = {
    "violated": ("!", "\x1b[31m"),
    "unverifiable": ("?", "\x1b[33m"),
    "measuring": ("?", "\x1b[33m"),
    "ok": (" ", ""),
}
"""Of an outcome, the worst first: what follows the number, and the colour of the cell."""

_EIGHTHS = " ▏▎▍▌▋▊▉█"
_BAR = 3
_DIGITS = 5


def cells(flow: FlowMeasurement | None, *, colour: bool) -> tuple[str, str, str, str]:
    """Return rate in hertz, p50 and p99 of the delay in milliseconds, and what was lost.

    Args:
        flow: None where nothing is measured.
        colour: mark outcomes with ANSI colours.
    """
    if flow is None:
        return ("–", "–", "–", "–")
    lost = "–" if flow.lost is None else f"{flow.lost}/{flow.messages + flow.lost}"
    delays = (Kind.DELAY, Kind.NETWORK_DELAY)
    return (
        _cell(f"{flow.rate_hz:.1f}", flow, (Kind.RATE, Kind.SILENCE), colour=colour),
        _ms(flow.p50_ms).rjust(_DIGITS),
        _cell(_ms(flow.p99_ms), flow, delays, colour=colour),
        _cell(lost, flow, (Kind.LOSS,), colour=colour),
    )


def _ms(value: float | None) -> str:
    if value is None:
        return "–"
    return f"{value:.{2 if value < 10 else 1 if value < 100 else 0}f}"


def _cell(number: str, flow: FlowMeasurement, kinds: tuple[Kind, ...], *, colour: bool) -> str:
    """Write a number, and beside it how much of its bound it is."""
    text = number.rjust(_DIGITS)
    bounds = [each for kind in kinds for each in flow.bounds if each.kind is kind]
    if not bounds:
        return text
    worst = min(bounds, key=lambda each: [*_MARKS].index(each.outcome))
    mark, style = _MARKS[worst.outcome]
    text = f"{text}{mark}{bar(worst.share or 0.0)}".rstrip()
    return f"{style}{text}\x1b[0m" if colour and style else text


def bar(share: float) -> str:
    """Return a bar of three columns: empty for 0, full from 1 on, and never empty in between."""
    eighths = min(round(share * _BAR * 8), _BAR * 8) or (1 if share > 0 else 0)
    full, part = divmod(eighths, 8)
    return ("█" * full + _EIGHTHS[part] * (part > 0)).ljust(_BAR)


COLUMNS = ("time", "seconds", "topic", "publisher", "subscription", *NUMBERS, "outcome")


class Record:
    """A CSV file that gets a row for each flow again and again; `close` it.

    Attributes:
        path: of the file.
        rows: how many were written.

    Args:
        path: of the file.
        replaces: it may be there already.

    Raises:
        UsageError: it is there, or cannot be written.
    """

    def __init__(self, path: Path, *, replaces: bool) -> None:
        self.rows = 0
        self.path = path
        self._began_s = time.monotonic()
        try:
            self._file = path.open("w" if replaces else "x", encoding="utf-8", newline="")
        except FileExistsError as error:
            raise UsageError(
                f"cannot record into {str(path)!r}: it is there already",
                hint="name another file, or replace it with --force",
            ) from error
        except (OSError, ValueError) as error:
            raise self._unwritable(error) from error
        self._writer = csv.writer(self._file, lineterminator="\n")
        try:
            self._write([COLUMNS])
        except UsageError:
            self.close()
            raise

    def add(self, measured: Iterable[FlowMeasurement]) -> None:
        """Write what is measured now, at once.

        Raises:
            UsageError: it cannot be written any more.
        """
        now = dt.datetime.now(dt.timezone.utc).isoformat(timespec="milliseconds")
        seconds = f"{time.monotonic() - self._began_s:.3f}"
        rows = [
            (now, seconds, *each.pair, *each.numbers().values(), each.outcome) for each in measured
        ]
        self._write(rows)
        self.rows += len(rows)

    def _write(self, rows: Iterable[tuple[object, ...]]) -> None:
        try:
            self._writer.writerows(rows)
            self._file.flush()
        except OSError as error:
            raise self._unwritable(error) from error

    def _unwritable(self, error: OSError | ValueError) -> UsageError:
        why = error.strerror if isinstance(error, OSError) else error
        return UsageError(f"cannot write {str(self.path)!r}: {why}")

    def close(self) -> None:
        """Write no more; what could not be written was said."""
        with contextlib.suppress(OSError):
            self._file.close()
