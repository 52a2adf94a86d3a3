"""Flows as a table, JSON or CSV. Owns: their columns and how an endpoint is written."""

from __future__ import annotations

from collections.abc import Sequence

from lifecycle.codec import to_json
from lifecycle.export.flows_csv import flows_to_csv
from lifecycle.manifest.model import UniqueHow
from lifecycle.network.dscp import describe
from lifecycle.network.nfe import InternetProtocol, NetworkFlowEndpoint, TransportProtocol
from lifecycle.verify import FlowReport

_HEADS = (
    "topic",
    "publisher",
    "subscription",
    "source",
    "destination",
    "protocol",
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

    In text, a pair is one line with all network flow endpoints of its ends; in CSV it has one for
    each flow that they form. `transport` is what carries it, not what could.
    """
    if format_ == "json":
        return to_json(tuple(flows)).decode()
    if format_ == "csv":
        return flows_to_csv(flows).rstrip("\n")
    if not flows:
        return "no flow"
    rows = [_HEADS, *(_row(flow) for flow in flows)]
    widths = [max(len(row[index]) for row in rows) for index in range(len(_HEADS))]
    return "\n".join(
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
        for row in rows
    )


def _row(flow: FlowReport) -> tuple[str, ...]:
    return (
        flow.topic,
        flow.publisher,
        flow.subscription,
        _ends(flow.source),
        _ends(flow.destination),
        _protocols(flow),
        "–" if flow.dscp is None else describe(flow.dscp),
        _five_qi(flow),
        "unknown" if flow.unique is None else _UNIQUE[flow.unique],
        " / ".join(each.value for each in flow.requirement),
        flow.demanded.value,
        flow.effective_transport,
        flow.outcome.value,
    )


def _five_qi(flow: FlowReport) -> str:
    if flow.five_qi is None:
        return "–"
    return f"{flow.five_qi} (auto)" if flow.five_qi_reason else str(flow.five_qi)


def _ends(nfes: Sequence[NetworkFlowEndpoint]) -> str:
    """Write network flow endpoints, each as address:port, or address#label with a flow label."""
    return " ".join(dict.fromkeys(_end(nfe) for nfe in nfes)) or "unknown"


def _end(nfe: NetworkFlowEndpoint) -> str:
    if nfe.transport_protocol is TransportProtocol.UNKNOWN:
        return "shm"
    v6 = nfe.internet_protocol is InternetProtocol.IPV6
    address = f"[{nfe.internet_address}]" if v6 else nfe.internet_address
    label = f"#{nfe.flow_label:#07x}" if nfe.flow_label else ""
    return f"{address}:{nfe.transport_port}{label}"


def _protocols(flow: FlowReport) -> str:
    found = dict.fromkeys(
        nfe.transport_protocol.value
        for nfe in (*flow.source, *flow.destination)
        if nfe.transport_protocol is not TransportProtocol.UNKNOWN
    )
    return "/".join(found) or "–"
