"""Flows as a table, JSON or CSV. Owns: the columns of the table, and words for the unknown."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from lifecycle.codec import to_json
from lifecycle.manifest.model import UniqueHow
from lifecycle.network.dscp import describe
from lifecycle.network.nfe import NetworkFlowEndpoint
from lifecycle.printable import json_text, lines, one_line
from lifecycle.programming.rules.flows_csv import flows_to_csv
from lifecycle.verify import FlowReport

_HEADS = (
    "topic",
    "publisher",
    "subscription",
    "source",
    "destination",
    "protocol",
    "flow_label",
    "dscp",
    "5qi",
    "unique",
    "required",
    "demanded",
    "transport",
    "verdict",
)
_UNIQUE = {UniqueHow.NOT: "no", UniqueHow.WEAKLY: "weakly", UniqueHow.STRONGLY: "strongly"}


def render_flows(flows: Sequence[FlowReport], format_: str) -> str:
    """Return `flows` as "text", "json" (an array) or "csv" (with a head line).

    In text and CSV a pair has one line for each network flow that its ends form, in JSON they are
    its `tuples`. `transport` is what carries it, not what could.
    """
    if format_ == "json":
        return json_text(to_json(tuple(flows)).decode())
    if format_ == "csv":
        return lines(flows_to_csv(flows).replace("\r\n", "\n").rstrip("\n"))
    if not flows:
        return "no flow"
    rows = [_HEADS, *(tuple(map(one_line, row)) for flow in flows for row in _rows(flow))]
    widths = [max(len(row[index]) for row in rows) for index in range(len(_HEADS))]
    return "\n".join(
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
        for row in rows
    )


def _rows(flow: FlowReport) -> Iterator[tuple[str, ...]]:
    pair = (flow.topic, flow.publisher, flow.subscription)
    demands_and_verdict = (
        _dscps(flow),
        _five_qi(flow),
        "unknown" if flow.unique is None else _UNIQUE[flow.unique],
        " / ".join(each.value for each in flow.requirement),
        flow.demanded.value,
        flow.effective_transport,
        flow.outcome.value,
    )
    for each in _tuples(flow):
        yield (*pair, *each, *demands_and_verdict)


def _tuples(flow: FlowReport) -> Sequence[tuple[str, ...]]:
    """Source, destination, protocol and flow label of each network flow of a pair."""
    found = [
        (each.source, each.destination, each.transport_protocol.value, each.label or "–")
        for each in flow.tuples
    ]
    return found or [(_ends(flow.source), _ends(flow.destination), "–", "–")]


def _dscps(flow: FlowReport) -> str:
    """What the data carry, and where that is known what the subscription acknowledges with."""
    data = "–" if flow.dscp is None else describe(flow.dscp)
    return data if flow.reader_dscp is None else f"{data}; back {describe(flow.reader_dscp)}"


def _five_qi(flow: FlowReport) -> str:
    if flow.five_qi is None:
        return "–"
    return f"{flow.five_qi} (auto)" if flow.five_qi_reason else str(flow.five_qi)


def _ends(nfes: Sequence[NetworkFlowEndpoint]) -> str:
    """Write the network flow endpoints of an end that forms no IP flow with the other."""
    return " ".join(dict.fromkeys(each.describe() for each in nfes)) or "unknown"
