"""Print a plan as text: what `lifecycle plan` shows.

Owns: that text. JSON is written by `lifecycle.codec`, pictures by export/. Pure.
"""

from __future__ import annotations

import shlex
from collections.abc import Callable, Iterator

from lifecycle.manifest import (
    BEST_AVAILABLE_NS,
    OWN_FLOW,
    DataLayer,
    DataLayerSource,
    DiscoveryMode,
    EndpointKind,
    FlowIdentification,
    FlowTransport,
    History,
    Liveliness,
    QosProfile,
    Reliability,
    RunKind,
    UniqueHow,
)
from lifecycle.network import (
    Capability,
    FlowSide,
    UniqueRequirement,
    capabilities,
    describe,
    unique_flow_ports,
)
from lifecycle.plan.connections.hosts import demand
from lifecycle.plan.model import (
    HeldBy,
    ParticipantConnections,
    Plan,
    PlannedEndpoint,
    PlannedFlow,
    PlannedNode,
    PlannedProcess,
)
from lifecycle.plan.participants import ParticipantCost, participants_cost
from lifecycle.printable import columns

RMW_CHOOSES = "as the RMW chooses"


def data_layer(plan: Plan, width: int) -> list[str]:
    """Describe how participants find each other and who connects them; nothing if all is usual."""
    rows: list[tuple[str, str]] = []
    if plan.discovery_mode is not DiscoveryMode.DYNAMIC or (
        plan.discovery.transport is not FlowTransport.ANY
    ):
        transport = plan.discovery.transport
        told = "" if transport is FlowTransport.ANY else f", own participants by {transport.value}"
        rows.append(("discovery", f"{plan.discovery_mode.value}{told}"))
    if plan.server is not None:
        protocol = "TCP" if plan.server.tcp else "UDP"
        where = f" on machine {plan.server.machine}" if plan.server.machine else ""
        at = f"{plan.server.address}:{plan.server.port}"
        rows.append(("discovery server", f"{protocol} {at}{where}"))
    layer = plan.data_layer
    if (layer.authority, layer.source, layer.events) != (
        DataLayer().authority,
        DataLayer().source,
        DataLayer().events,
    ):
        source = "the manifest" if layer.source is DataLayerSource.STATIC else "node configurations"
        again = "; what is lost is made again" if layer.events else ""
        rows.append(("authority", f"{layer.authority.value}, from {source}{again}"))
    for machine, each in plan.observers:
        named = f"observer on {machine}" if machine else "observer"
        if machine and any(not other for other, _ in plan.observers):
            continue  # the one host's, under another name
        rows += [(named if not i else "", text) for i, text in enumerate(_spelled(each))]
    return columns(rows, indent=2, width=width)


def connections(plan: Plan, width: int) -> list[str]:
    """List each node's participants with their URLs and what they carry."""
    lines: list[str] = []
    for node in plan.nodes:
        rows = list(_rows(node))
        if rows:
            lines += [f"  {node.full_name}", *columns(rows, indent=4, width=width)]
    return lines


def _rows(node: PlannedNode) -> Iterator[tuple[str, str, str]]:
    connected = [each for each in node.participants if each.connection or each.connections.urls]
    if not connected and not node.connections.urls:
        return
    entries = [("own participant", node.connections, "")]
    entries += [(each.connection or each.name, each.connections, each.name) for each in connected]
    for name, each, participant in entries:
        carried = [
            f"{_WORDS.get(endpoint.kind, endpoint.kind.value)} {endpoint.resolved}"
            for endpoint in node.endpoints
            if endpoint.participant == participant
        ]
        texts = (*_spelled(each), *([f"carries {', '.join(carried)}"] if carried else []))
        for index, text in enumerate(texts):
            yield ("" if index else name, "", text)


_WORDS = {EndpointKind.PUBLISHER: "publisher", EndpointKind.SUBSCRIPTION: "subscription"}


def _spelled(each: ParticipantConnections) -> list[str]:
    texts = list(each.urls) or [RMW_CHOOSES]
    if each.static_name:
        texts.append(f"known to others as {each.static_name}, without being told")
    if each.super_client:
        texts.append("is told of everything that the server knows")
    return texts


def medium(flow: PlannedFlow) -> str:
    """Describe what carries a flow and why; empty if that is not known yet."""
    if not flow.medium:
        return flow.medium_reason
    return f"{flow.medium} ({flow.medium_reason})"


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
        *columns(rows, indent=2, width=width),
        "  cost",
        *columns(costs, indent=4, width=width),
        *columns([(_alternatives(plan, extra),)], indent=2, width=width),
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
    """Describe what each RMW of the system can do of what the system asks for."""
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
    return columns(rows, indent=2, width=width)


def _own_rmws(plan: Plan) -> Iterator[str]:
    for process in plan.processes:
        rmw = dict(process.environment).get("RMW_IMPLEMENTATION", "")
        if rmw:
            yield rmw


def _asks(each: PlannedEndpoint) -> bool:
    return each.unique is not UniqueRequirement.NOT_REQUIRED or each.dscp is not None


def notes(plan: Plan, width: int) -> list[str]:
    """Describe what a need brings with it that a user may not expect."""
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
        lines += [
            *columns([(head,)], indent=2, width=width),
            *columns([(text,)], indent=6, width=width),
        ]
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


def render_text(plan: Plan, *, width: int = 100) -> str:
    """Print processes, order, nodes with endpoints, extra participants, flows, notes and ports.

    Args:
        plan: what to print.
        width: columns to fit into where words allow it, >= 40.

    Returns:
        Lines, each ended by a newline.
    """
    width = max(width, 40)
    sections: tuple[tuple[str, Callable[[Plan, int], list[str]]], ...] = (
        ("processes", _processes),
        ("order", _order),
        ("data layer", data_layer),
        ("nodes", _nodes),
        ("connections", connections),
        ("extra participants", participants),
        ("middleware", middleware),
        ("flows", _flows),
        ("notes", notes),
        ("ports, if participants start in this order and none is taken", _ports),
    )
    lines = [_headline(plan)]
    for title, section in sections:
        body = section(plan, width)
        if body:
            lines += ["", title, *body]
    return "\n".join(lines) + "\n"


def _headline(plan: Plan) -> str:
    counts = (
        _count(len(plan.nodes), "node"),
        _count(len(plan.processes), "process", "processes"),
        _count(len(plan.flows), "flow"),
    )
    return (
        f"system {plan.system}: {', '.join(counts)};"
        f" domain {plan.domain_id}, discovery range {plan.discovery_range.value}"
    )


def _count(number: int, word: str, plural: str = "") -> str:
    return f"{number} {word if number == 1 else plural or word + 's'}"


def _processes(plan: Plan, width: int) -> list[str]:
    rows = [
        (process.name, process.machine, process.run.kind.value, _started_as(plan, process))
        for process in plan.processes
    ]
    return columns(rows, indent=2, width=width)


def _started_as(plan: Plan, process: PlannedProcess) -> str:
    if process.run.kind is RunKind.COMMAND:
        return shlex.join(process.argv)
    if process.run.kind is RunKind.ATTACH:
        return "started by others"
    return ", ".join(plan.node(key).run.python for key in process.nodes)


def _order(plan: Plan, width: int) -> list[str]:
    return columns(
        [
            (f"{number}.", ", ".join(_waiting(plan.node(key)) for key in level))
            for number, level in enumerate(plan.levels, start=1)
        ],
        indent=2,
        width=width,
    )


def _waiting(node: PlannedNode) -> str:
    waits = " and ".join(f"{each.node} {each.condition.value}" for each in node.after)
    return f"{node.key} (after {waits})" if waits else node.key


def _nodes(plan: Plan, width: int) -> list[str]:
    lines: list[str] = []
    for node in plan.nodes:
        facts = [
            "managed" if node.managed else "not managed",
            f"process {node.process}",
            *([f"machine {node.machine}"] if node.machine else []),
            f"endpoints {node.endpoint_policy.value}",
        ]
        lines.append(f"  {node.full_name} ({', '.join(facts)})")
        lines.append(f"    {_HELD[node.held_by]}")
        lines += _endpoints(node, width)
    return lines


_HELD = {
    HeldBy.STATE_MACHINE: "held by its state machine until verified",
    HeldBy.SERVICES: "held by its lifecycle services until verified",
    HeldBy.EXECUTOR: "held by its executor and its publishers until verified",
    HeldBy.NOTHING: "not held: works as soon as it is started",
}


def _endpoints(node: PlannedNode, width: int) -> list[str]:
    """One line each where all of them fit, else what it is and below it what it needs."""
    rows = [
        (each.kind.noun, each.resolved, each.type, _endpoint_facts(each)) for each in node.endpoints
    ]
    lines = columns(rows, indent=4, width=width)
    if len(lines) == len(rows) and all(len(line) <= width for line in lines):
        return lines
    lines = []
    heads = columns([row[:3] for row in rows], indent=4, width=width)
    for head, row in zip(heads, rows, strict=True):
        lines += [head, *columns([row[3:]], indent=8, width=width)] if row[3] else [head]
    return lines


def _endpoint_facts(endpoint: PlannedEndpoint) -> str:
    facts = [spell_qos(endpoint.qos)] if endpoint.qos else []
    if endpoint.unique is not UniqueRequirement.NOT_REQUIRED:
        facts.append(f"unique {endpoint.unique.value}")
    if endpoint.dscp is not None:
        facts.append(describe(endpoint.dscp) + ("" if endpoint.enforce_dscp else ", not enforced"))
    if endpoint.five_qi is not None:
        facts.append(f"5QI {endpoint.five_qi}" + (" (auto)" if endpoint.five_qi_reason else ""))
    if endpoint.transport is FlowTransport.NETWORK:
        facts.append("by the network only")
    facts += [
        text
        for value, text in (
            (endpoint.max_delay_ms, f"at most {endpoint.max_delay_ms or 0:g} ms"),
            (endpoint.loss, f"loss at most {endpoint.loss or 0:g}"),
            (endpoint.rate_hz, f"{endpoint.rate_hz or 0:g} Hz"),
            (endpoint.max_message_size, f"at most {endpoint.max_message_size} bytes"),
        )
        if value is not None
    ]
    if endpoint.participant:
        facts.append(f"in {endpoint.participant}")
    return "; ".join(facts)


def spell_qos(qos: QosProfile) -> str:
    """Spell a profile in one line: `BEST_EFFORT VOLATILE KEEP_LAST(1), deadline 100 ms`."""
    history = qos.history.value
    if qos.history is History.KEEP_LAST:
        history += f"({qos.depth})"
    text = f"{qos.reliability.value} {qos.durability.value} {history}"
    extras = [
        f"{word} {_duration(value)}"
        for word, value in (
            ("deadline", qos.deadline_ns),
            ("lifespan", qos.lifespan_ns),
            ("lease", qos.liveliness_lease_duration_ns),
        )
        if value
    ]
    if qos.liveliness not in (Liveliness.AUTOMATIC, Liveliness.SYSTEM_DEFAULT):
        extras.append(f"liveliness {qos.liveliness.value}")
    return ", ".join([text, *extras])


def _duration(duration_ns: int) -> str:
    return "BEST_AVAILABLE" if duration_ns == BEST_AVAILABLE_NS else f"{duration_ns / 1e6:g} ms"


def _flows(plan: Plan, width: int) -> list[str]:
    rows = []
    for flow in plan.flows:
        needs = []
        if flow.unique is not UniqueHow.NOT:
            needs.append(f"{flow.unique.value} unique")
        if flow.max_delay_ms is not None:
            needs.append(f"at most {flow.max_delay_ms:g} ms")
        if flow.linked and not needs:
            needs.append("linked")
        ends = f"{plan.node(flow.publisher).full_name} → {plan.node(flow.subscription).full_name}"
        told = filter(None, (medium(flow), ", ".join(needs)))
        rows.append((flow.topic, ends, "; ".join(told)))
    return columns(rows, indent=2, width=width)


def _ports(plan: Plan, width: int) -> list[str]:
    lines: list[str] = []
    for machine in demand(plan):
        if machine.machine:
            lines.append(f"  machine {machine.machine}")
        rows = [
            (
                str(each.index),
                each.owner,
                f"discovery {each.discovery_port}, user {each.user_port}"
                if each.user_port
                else "none: shared memory alone"
                if each.shared_memory
                else "no port left in this domain",
            )
            for each in machine.participants
        ]
        lines += columns(rows, indent=4, width=width)
        if machine.unique_subscriptions:
            ports = unique_flow_ports()
            lines.append(
                f"    {_count(machine.unique_subscriptions, 'unique subscription')}:"
                f" the first free of {ports[0]}–{ports[-1]}"
            )
    return lines
