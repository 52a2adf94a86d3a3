"""Flows and what was measured of them as tables: text, JSON, CSV, and the file of `--record`.

Owns: how a number and its bound look, with `!` for a bound that is not kept and `?` for one that is
not decided, so that no colour is needed to read it. Columns of CSV are only ever added at the end.
"""

from __future__ import annotations

import contextlib
import csv
import datetime as dt
import io
import time
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from msgspec import to_builtins
from msgspec.structs import asdict, replace

from lifecycle.cli.common import json_of, terminal_width, unwritable, wrapped
from lifecycle.errors import UsageError
from lifecycle.manifest.model import UniqueHow
from lifecycle.measure.flows import NUMBERS, FlowMeasurement, Kind, Pair, measured_summary
from lifecycle.network.dscp import describe, dscp_name, tos
from lifecycle.printable import columns, lines, one_line, shown_length
from lifecycle.verify.outcome import Outcome
from lifecycle.verify.verdict import FlowReport, Verdict

_MEASURED = ("Hz", "p50 ms", "p99 ms", "lost")
_NONE = ("",) * len(_MEASURED)
_HEADS = ("unique", "required", "demanded", "dscp", "5qi", "transport", "flow")
_UNIQUE = {UniqueHow.NOT: "no", UniqueHow.WEAKLY: "weakly", UniqueHow.STRONGLY: "strongly"}


def render_flows(
    flows: Sequence[FlowReport],
    format_: str,
    measured: Sequence[FlowMeasurement] = (),
    *,
    colour: bool = False,
) -> str:
    """Return `flows` as "text", "json" (an array) or "csv" (with a head line).

    In text a pair has a line, below which are the network flows that its ends form; in CSV it has
    one line for each of these, in JSON they are its `tuples`. `transport` is what carries it, not
    what could. In JSON `measured` is null where nothing was.
    """
    found = {each.pair: each for each in measured}
    flows = [replace(each, outcome=_outcome(each, found.get(each.pair))) for each in flows]
    if format_ == "json":
        documents = [{**asdict(each), "measured": found.get(each.pair)} for each in flows]
        return json_of(documents)
    if format_ == "csv":
        return lines(flows_to_csv(flows, found).replace("\r\n", "\n").rstrip("\n"))
    if not flows:
        return "no flow"
    rows = [
        (each.outcome.value, *cells(found.get(each.pair), colour=colour), *_treated(each))
        for each in flows
    ]
    head, *shown = columns([("verdict", *_MEASURED, *_HEADS), *rows])
    for flow, line in zip(flows, shown, strict=True):
        ends = [each.describe() for each in flow.tuples] or [_unpaired(flow)]
        head = "\n".join((head, line, *(one_line(f"    {each}") for each in ends)))
    return head


def watched_flows(verdict: Verdict, format_: str) -> str:
    """Return the flows for `--watch`: on a terminal what fits its width, what is not ok first."""
    width = terminal_width()
    if format_ != "text" or not width:
        return render_flows(verdict.flows, format_, verdict.measured)
    from lifecycle.cli.up_output import verdict_line

    found, names = {each.pair: each for each in verdict.measured}, _short_names(verdict.flows)
    rows = [("verdict", *(_MEASURED if found else _NONE), "unique", "dscp", "transport", "flow")]
    outcomes = [(_outcome(each, found.get(each.pair)), each) for each in verdict.flows]
    for outcome, flow in sorted(outcomes, key=lambda each: each[0] is Outcome.OK):
        numbers = cells(found.get(flow.pair), colour=True) if found else _NONE
        unique = "unknown" if flow.unique is None else _UNIQUE[flow.unique]
        dscp = "–" if flow.dscp is None else dscp_name(flow.dscp)
        name = f"{flow.topic} {names[flow.publisher]} → {names[flow.subscription]}"
        rest = (unique, dscp, flow.effective_transport, one_line(name))
        rows.append((outcome.value, *numbers, *rest))
    if max(map(shown_length, columns(rows))) > width:
        rows = [(*row[:5], row[-1]) for row in rows]
    head = filter(None, (verdict_line(verdict), measured_summary(verdict.measured)))
    return "\n".join((wrapped(map(one_line, head), width), *columns(rows, width=width)))


def _short_names(flows: Sequence[FlowReport]) -> dict[str, str]:
    """Return nodes' names without their namespaces, where no other node has the same."""
    names = {name for flow in flows for name in (flow.publisher, flow.subscription)}
    short = {name: name.rpartition("/")[2] for name in names}
    taken = [*short.values()]
    return {name: each if taken.count(each) == 1 else name for name, each in short.items()}


def _outcome(flow: FlowReport, measured: FlowMeasurement | None) -> Outcome:
    """Return how a flow is, with what has arrived of it."""
    found = [flow.outcome]
    if measured is not None and measured.outcome in ("violated", "unverifiable"):
        found.append(Outcome(measured.outcome))
    return Outcome.worst(found)


def _treated(flow: FlowReport) -> tuple[str, ...]:
    """Return the cells below _HEADS, printable."""
    # What the data carry, and where that is known what the subscription acknowledges with.
    dscp = "–" if flow.dscp is None else describe(flow.dscp)
    dscp += "" if flow.reader_dscp is None else f"; back {describe(flow.reader_dscp)}"
    five_qi = "–" if flow.five_qi is None else str(flow.five_qi)
    cells = (
        "unknown" if flow.unique is None else _UNIQUE[flow.unique],
        " / ".join(each.value for each in flow.requirement),
        flow.demanded.value,
        dscp,
        f"{five_qi} (auto)" if flow.five_qi_reason else five_qi,
        flow.effective_transport,
        f"{flow.topic} {flow.publisher} → {flow.subscription}",
    )
    return tuple(map(one_line, cells))


def _unpaired(flow: FlowReport) -> str:
    """Return the network flow endpoints of two ends that form no IP flow with each other."""
    ends = ([each.describe() for each in nfes] for nfes in (flow.source, flow.destination))
    return " → ".join(" ".join(dict.fromkeys(each)) or "unknown" for each in ends)


COLUMNS = (
    *("topic", "publisher", "subscription", "transport_protocol", "internet_protocol"),
    *("source_address", "source_port", "destination_address", "destination_port", "flow_label"),
    *("dscp", "dscp_name", "tos", "unique", "demanded"),
    *("publisher_requirement", "subscription_requirement", "max_delay_ms", "outcome"),
    *("five_qi", "five_qi_reason", "effective_transport"),
)
"""Of CSV. What is not known or does not apply is an empty cell.

`flow_label` is five hex digits, or `unset` where the sender sets none; empty on IPv4.
"""


def flows_to_csv(flows: Iterable[FlowReport], measured: Mapping[Pair, FlowMeasurement] = {}) -> str:
    """Return flow reports as CSV with a header line (RFC 4180, but lines end with a newline).

    A pair whose NFEs form several flows has one line each; a pair without any known IP flow (shared
    memory, or NFEs that were not reported) has one line whose 5-tuple is empty. The last columns
    are what has arrived of the pair, empty where that is not measured.
    """
    text = io.StringIO()
    heads = (*COLUMNS, *NUMBERS)
    writer = csv.DictWriter(text, heads, extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    for report in flows:
        numbers = measured[report.pair].numbers() if report.pair in measured else {}
        of_pair = {**to_builtins(report), **numbers}
        of_pair["publisher_requirement"], of_pair["subscription_requirement"] = (
            each.value for each in report.requirement
        )
        if report.dscp is not None:
            of_pair |= {"dscp_name": dscp_name(report.dscp), "tos": tos(report.dscp)}
        if report.max_delay_ms is not None:
            of_pair["max_delay_ms"] = f"{report.max_delay_ms:g}"
        for flow in report.tuples or (None,):
            of_flow = to_builtins(flow) | {"flow_label": flow.label} if flow else {}
            writer.writerow({**of_flow, **of_pair})
    return text.getvalue()


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
    """Return rate in hertz, p50 and p99 of the delay in milliseconds, and what was lost."""
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


RECORDED = ("time", "seconds", "topic", "publisher", "subscription", *NUMBERS, "outcome")


class Record:
    """A CSV file, in the place of any of its name, that gets a row for each flow again and again.

    Attributes:
        path: of the file.
        rows: how many were written.

    Raises:
        UsageError: it cannot be written.
    """

    def __init__(self, path: Path) -> None:
        self.rows = 0
        self.path = path
        self._began_s = time.monotonic()
        try:
            self._file = path.open("w", encoding="utf-8", newline="")
        except (OSError, ValueError) as error:
            raise unwritable(self.path, error) from error
        self._writer = csv.writer(self._file, lineterminator="\n")
        try:
            self._write([RECORDED])
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
            raise unwritable(self.path, error) from error

    def close(self) -> None:
        """Write no more; what could not be written was said."""
        with contextlib.suppress(OSError):
            self._file.close()
