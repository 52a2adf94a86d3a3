"""Flow reports as CSV: one line per network flow, for spreadsheets and other tools.

Columns are only ever added at the end. Pure.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Iterator

from lifecycle.network.dscp import dscp_name, tos
from lifecycle.network.nfe import FlowTuple
from lifecycle.verify.verdict import FlowReport

COLUMNS = (
    "topic",
    "publisher",
    "subscription",
    "transport_protocol",
    "internet_protocol",
    "source_address",
    "source_port",
    "destination_address",
    "destination_port",
    "flow_label",
    "dscp",
    "dscp_name",
    "tos",
    "unique",
    "demanded",
    "publisher_requirement",
    "subscription_requirement",
    "max_delay_ms",
    "transport",
    "outcome",
    "five_qi",
    "five_qi_reason",
    "effective_transport",
)
"""Header line. An empty cell is something that is not known or does not apply.

`flow_label` is five hex digits, or `unset` where the sender sets none; empty on IPv4.
"""


def flows_to_csv(flows: Iterable[FlowReport]) -> str:
    """Return flow reports as CSV with a header line (RFC 4180, but lines end with a newline).

    A pair whose NFEs form several flows has one line each; a pair without any known IP flow (shared
    memory, or NFEs that were not reported) has one line whose 5-tuple is empty.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    for report in flows:
        writer.writerows(_rows(report))
    return text.getvalue()


def _rows(report: FlowReport) -> Iterator[tuple[object, ...]]:
    for flow in report.tuples or (None,):
        yield (
            report.topic,
            report.publisher,
            report.subscription,
            *_tuple_cells(flow),
            *_dscp_cells(report.dscp),
            "" if report.unique is None else report.unique.value,
            report.demanded.value,
            *(each.value for each in report.requirement),
            "" if report.max_delay_ms is None else f"{report.max_delay_ms:g}",
            report.transport,
            report.outcome.value,
            "" if report.five_qi is None else report.five_qi,
            report.five_qi_reason,
            report.effective_transport,
        )


def _tuple_cells(flow: FlowTuple | None) -> tuple[object, ...]:
    if flow is None:
        return ("",) * 7
    return (
        flow.transport_protocol.value,
        flow.internet_protocol.value,
        flow.source_address,
        flow.source_port,
        flow.destination_address,
        flow.destination_port,
        flow.label,
    )


def _dscp_cells(dscp: int | None) -> tuple[object, ...]:
    """Only what was read back from the sockets: an RMW reports 0 whatever is marked."""
    return ("", "", "") if dscp is None else (dscp, dscp_name(dscp), tos(dscp))
