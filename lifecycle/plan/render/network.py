"""What a plan does to the network, as text for people.

Owns: the sections of `lifecycle plan` about extra participants and what they cost, about what the
RMW can do, and the notes on what a need brings with it. Pure.
"""

from __future__ import annotations

from collections.abc import Iterator

from lifecycle.manifest.flows.flow_needs import OWN_FLOW
from lifecycle.manifest.model import EndpointKind, FlowIdentification, FlowTransport, RunKind
from lifecycle.manifest.qos import Reliability
from lifecycle.network.nfe import UniqueRequirement
from lifecycle.network.rmw_capabilities import Capability, FlowSide, capabilities
from lifecycle.plan.connections.demand import demand
from lifecycle.plan.model import Plan, PlannedEndpoint, PlannedNode
from lifecycle.plan.participants import ParticipantCost, participants_cost
from lifecycle.plan.render.table import table

_DSCP_VALUES = 64
_NEEDS_A_RULE = (
    "changes nothing by itself: each router and switch on the way needs a rule that uses it "
    "(docs/flows.md)"
)


def participants(plan: Plan, width: int) -> list[str]:
    """List extra participants, and what they cost each process and the system."""
    rows = [
        (f"{node.namespace.rstrip('/')}/{each.name}", each.reason)
        for node in plan.nodes
        for each in node.participants
    ]
    if not rows:
        return []
    total = sum(len(machine.participants) for machine in demand(plan))
    costs: list[tuple[str, str]] = []
    for process in plan.processes:
        extra = sum(len(plan.node(key).participants) for key in process.nodes)
        if extra:
            costs.append((f"process {process.name}", _cost(participants_cost(extra))))
    extra = len(rows)
    cost = participants_cost(extra, others=total - extra)
    discovery = (
        f"discovery between {total} participants instead of {total - extra}, "
        f"{cost.discovery_pairs} pairs more"
    )
    costs.append(("system", f"{_cost(cost)}; {discovery}"))
    return [
        *table(rows, width=width),
        "  cost",
        *table(costs, indent=4, width=width),
        *table([(_alternatives(plan, extra),)], width=width),
    ]


def _cost(cost: ParticipantCost) -> str:
    low, high = cost.start_ms
    return (
        f"about {cost.rss_mb:g} MB, {cost.threads} threads, {cost.sockets} sockets,"
        f" {low}–{high} ms to make"
    )


def _alternatives(plan: Plan, extra: int) -> str:
    """Name what the article *Unique Network Flows* lists besides; each has its limits."""
    if plan.flow_identification is FlowIdentification.DSCP:
        told = sum(
            each.unique in OWN_FLOW and each.dscp is not None
            for node in plan.nodes
            for each in node.endpoints
            if each.kind is EndpointKind.PUBLISHER
        )
        return (
            f"{told} of {_DSCP_VALUES} DSCP values are identifiers here: no router may read them "
            f"as classes, reset or erase them (docs/flows.md)"
        )
    nodes = "a dedicated node" if extra == 1 else f"{extra} dedicated nodes"
    return (
        f"instead: {nodes} in processes of their own, which cost more and break the node up, or "
        f"'flow_identification: dscp', for at most {_DSCP_VALUES} publishers (docs/flows.md)"
    )


def middleware(plan: Plan, width: int) -> list[str]:
    """Say what each RMW of the system can do of what the system asks for."""
    asked = [each for node in plan.nodes for each in node.endpoints if _asks(each)]
    if not asked:
        return []
    kinds = {each.kind for each in asked if each.unique is not UniqueRequirement.NOT_REQUIRED}
    rows: list[tuple[str, str, str]] = []
    for rmw in dict.fromkeys((plan.rmw, *_own_rmws(plan))):
        row = capabilities(rmw)
        cells: list[tuple[str, Capability]] = []
        if EndpointKind.SUBSCRIPTION in kinds:
            cells.append(("unique subscription", row.unique(FlowSide.SUBSCRIPTION)))
        if EndpointKind.PUBLISHER in kinds:
            cells.append(("unique publisher", row.unique(FlowSide.PUBLISHER)))
        if any(each.dscp is not None for each in asked):
            cells.append(("DSCP", row.dscp))
        cells.append(("reading back", row.getter))
        for word, cell in cells:
            support = cell.support.value.replace("_", " ")
            rows.append(
                ("" if rows and word != cells[0][0] else rmw, word, f"{support}: {cell.how}")
            )
    return table(rows, width=width)


def _own_rmws(plan: Plan) -> Iterator[str]:
    for process in plan.processes:
        rmw = dict(process.environment).get("RMW_IMPLEMENTATION", "")
        if rmw:
            yield rmw


def _asks(each: PlannedEndpoint) -> bool:
    return each.unique is not UniqueRequirement.NOT_REQUIRED or each.dscp is not None


def notes(plan: Plan, width: int) -> list[str]:
    """Say what a need brings with it that a user may not expect."""
    rows = [
        (f"{node.full_name} {each.resolved}", text)
        for node in plan.nodes
        for each in node.endpoints
        for text in _notes(node, each)
    ]
    if any(_asks(each) for node in plan.nodes for each in node.endpoints):
        rows.append(("every unique or marked flow", _NEEDS_A_RULE))
    lines: list[str] = []
    for head, text in rows:
        lines += [*table([(head,)], width=width), *table([(text,)], indent=6, width=width)]
    return lines


def _notes(node: PlannedNode, each: PlannedEndpoint) -> Iterator[str]:
    if each.dscp_reason:
        yield f"DSCP {each.dscp}: {each.dscp_reason}"
    if each.five_qi_reason:
        yield each.five_qi_reason
    if each.kind is not EndpointKind.PUBLISHER:
        if each.transport is FlowTransport.NETWORK and node.transports:
            yield "by the network only: so does everything that the node's own participant receives"
        return
    prioritised = each.unique in OWN_FLOW or each.dscp is not None or each.five_qi is not None
    participant = next((one for one in node.participants if one.name == each.participant), None)
    limited = participant is not None and participant.max_datagram_bytes is not None
    if prioritised and each.max_message_size is None and not limited:
        yield (
            "how large its messages get is unknown: declare 'max_message_size' to learn whether IP "
            "fragments them, of which only the first has ports"
        )
    if participant is not None and participant.non_blocking_send:
        lost = (
            "a datagram that finds the socket's buffer full is lost, and as the publisher is "
            "BEST_EFFORT the message with it"
            if each.qos is not None and each.qos.reliability is Reliability.BEST_EFFORT
            else "a datagram that finds the socket's buffer full is lost and sent again when the "
            "subscription asks for it, which takes longer than to wait"
        )
        yield f"non-blocking send: {lost}"
    if node.run.kind is not RunKind.PYTHON and prioritised:
        yield "started by others: it keeps the one participant that its own code makes"
