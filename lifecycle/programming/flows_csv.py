"""Flow reports as CSV: one line per network flow, for spreadsheets and other tools.

Columns are only ever added at the end. Pure.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from lifecycle.measure.flows import NUMBERS, FlowMeasurement, Pair
from lifecycle.network.dscp import dscp_name, tos
from lifecycle.verify.verdict import FlowReport

COLUMNS: dict[str, Callable[[FlowReport, Any], object]] = {
    "topic": lambda report, _: report.topic,
    "publisher": lambda report, _: report.publisher,
    "subscription": lambda report, _: report.subscription,
    "transport_protocol": lambda _, flow: flow and flow.transport_protocol.value,
    "internet_protocol": lambda _, flow: flow and flow.internet_protocol.value,
    "source_address": lambda _, flow: flow and flow.source_address,
    "source_port": lambda _, flow: flow and flow.source_port,
    "destination_address": lambda _, flow: flow and flow.destination_address,
    "destination_port": lambda _, flow: flow and flow.destination_port,
    "flow_label": lambda _, flow: flow and flow.label,
    # Only what was read back from the sockets: an RMW reports 0 whatever is marked.
    "dscp": lambda report, _: report.dscp,
    "dscp_name": lambda report, _: None if report.dscp is None else dscp_name(report.dscp),
    "tos": lambda report, _: None if report.dscp is None else tos(report.dscp),
    "unique": lambda report, _: report.unique and report.unique.value,
    "demanded": lambda report, _: report.demanded.value,
    "publisher_requirement": lambda report, _: report.requirement[0].value,
    "subscription_requirement": lambda report, _: report.requirement[1].value,
    "max_delay_ms": lambda report, _: (
        None if report.max_delay_ms is None else f"{report.max_delay_ms:g}"
    ),
    "outcome": lambda report, _: report.outcome.value,
    "five_qi": lambda report, _: report.five_qi,
    "five_qi_reason": lambda report, _: report.five_qi_reason,
    "effective_transport": lambda report, _: report.effective_transport,
}
"""Header → cell, of a report and one of its flows. None, something that is not known or does not
apply, is an empty cell.

`flow_label` is five hex digits, or `unset` where the sender sets none; empty on IPv4.
"""


def flows_to_csv(flows: Iterable[FlowReport], measured: Mapping[Pair, FlowMeasurement] = {}) -> str:
    """Return flow reports as CSV with a header line (RFC 4180, but lines end with a newline).

    A pair whose NFEs form several flows has one line each; a pair without any known IP flow (shared
    memory, or NFEs that were not reported) has one line whose 5-tuple is empty. The last columns
    are what has arrived of the pair, empty where that is not measured.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow((*COLUMNS, *NUMBERS))
    for report in flows:
        found = measured.get(report.pair)
        numbers = [None] * len(NUMBERS) if found is None else [*found.numbers().values()]
        for flow in report.tuples or (None,):
            writer.writerow([*(cell(report, flow) for cell in COLUMNS.values()), *numbers])
    return text.getvalue()
