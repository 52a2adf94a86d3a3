"""Print a plan as text: what `lifecycle plan` shows. Pure."""

from __future__ import annotations

import shlex
from collections.abc import Callable

from lifecycle.manifest.model import (
    DataLayer,
    DataLayerSource,
    DiscoveryMode,
    FlowTransport,
    RunKind,
    UniqueHow,
)
from lifecycle.manifest.qos import BEST_AVAILABLE_NS, History, Liveliness, QosProfile
from lifecycle.network.dscp import describe
from lifecycle.network.nfe import UniqueRequirement
from lifecycle.plan.model import (
    HeldBy,
    ParticipantConnections,
    Plan,
    PlannedEndpoint,
    PlannedNode,
    PlannedProcess,
)
from lifecycle.printable import columns, count


def _data_layer(plan: Plan, width: int) -> list[str]:
    """Describe how participants find each other and who connects them; nothing if all is usual."""
    rows: list[tuple[str, str]] = []
    mode, transport = plan.discovery.mode, plan.discovery.transport
    if mode is not DiscoveryMode.DYNAMIC or transport is not FlowTransport.ANY:
        told = "" if transport is FlowTransport.ANY else f", own participants by {transport.value}"
        rows.append(("discovery", f"{mode.value}{told}"))
    if plan.server is not None:
        protocol = "TCP" if plan.server.tcp else "UDP"
        where = f" on machine {plan.server.machine}" if plan.server.machine else ""
        at = f"{plan.server.address}:{plan.server.port}"
        rows.append(("discovery server", f"{protocol} {at}{where}"))
    layer, usual = plan.data_layer, DataLayer()
    if (layer.authority, layer.source) != (usual.authority, usual.source) or layer.events:
        source = "the manifest" if layer.source is DataLayerSource.STATIC else "node configurations"
        again = "; what is lost is made again" if layer.events else ""
        rows.append(("authority", f"{layer.authority.value}, from {source}{again}"))
    for machine, each in plan.observers:
        named = f"observer on {machine}" if machine else "observer"
        if machine and any(not other for other, _ in plan.observers):
            continue  # the one host's, under another name
        rows += [(named if not i else "", text) for i, text in enumerate(_spelled(each))]
    return columns(rows, indent=2, width=width)


def _connections(plan: Plan, width: int) -> list[str]:
    """List each node's participants with their URLs and what they carry."""
    lines: list[str] = []
    for node in plan.nodes:
        extra = [each for each in node.participants if each.connection or each.connections.urls]
        entries = [(each.connection or each.name, each.connections, each.name) for each in extra]
        if not extra and not node.connections.urls:
            continue
        rows: list[tuple[str, str]] = []
        for name, each, participant in (("own participant", node.connections, ""), *entries):
            carried = [
                f"{endpoint.kind.noun} {endpoint.resolved}"
                for endpoint in node.endpoints
                if endpoint.participant == participant
            ]
            texts = _spelled(each) + [f"carries {', '.join(carried)}"] * bool(carried)
            rows += [("" if index else name, text) for index, text in enumerate(texts)]
        lines += [f"  {node.full_name}", *columns(rows, indent=4, width=width)]
    return lines


def _spelled(each: ParticipantConnections) -> list[str]:
    texts = list(each.urls) or ["as the RMW chooses"]
    if each.static_name:
        texts.append(f"known to others as {each.static_name}, without being told")
    if each.super_client:
        texts.append("is told of everything that the server knows")
    return texts


def _participants(plan: Plan, width: int) -> list[str]:
    """List extra participants."""
    rows = [
        (f"{node.namespace.rstrip('/')}/{each.name}", each.reason)
        for node in plan.nodes
        for each in node.participants
    ]
    return columns(rows, indent=2, width=width)


def render_text(plan: Plan, *, width: int = 100) -> str:
    """Print processes, order, nodes with endpoints, extra participants and flows.

    Lines fit into `width` columns, at least 40, where words allow it.
    """
    width = max(width, 40)
    sections: tuple[tuple[str, Callable[[Plan, int], list[str]]], ...] = (
        ("processes", _processes),
        ("order", _order),
        ("data layer", _data_layer),
        ("nodes", _nodes),
        ("connections", _connections),
        ("extra participants", _participants),
        ("flows", _flows),
    )
    lines = [_headline(plan)]
    for title, section in sections:
        body = section(plan, width)
        if body:
            lines += ["", title, *body]
    return "\n".join(lines) + "\n"


def _headline(plan: Plan) -> str:
    counts = (
        count(len(plan.nodes), "node"),
        count(len(plan.processes), "process"),
        count(len(plan.flows), "flow"),
    )
    return (
        f"system {plan.system}: {', '.join(counts)};"
        f" domain {plan.domain_id}, discovery range {plan.discovery_range.value}"
    )


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
    waits = " and ".join(map(str, node.after))
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
        kept = "" if endpoint.enforce_dscp else ", not enforced"
        facts.append(f"{describe(endpoint.dscp)}{kept}")
    if endpoint.five_qi is not None:
        facts.append(endpoint.five_qi_reason or f"5QI {endpoint.five_qi}")
    if endpoint.transport is FlowTransport.NETWORK:
        facts.append("by the network only")
    facts += [
        text
        for value, text in (
            (endpoint.max_delay_ms, f"at most {endpoint.max_delay_ms or 0:g} ms"),
            (endpoint.max_message_size, f"at most {endpoint.max_message_size} bytes"),
        )
        if value is not None
    ]
    facts += [str(each) for each in endpoint.quantities if each.name in _SHOWN]
    if endpoint.participant:
        facts.append(f"in {endpoint.participant}")
    return "; ".join(facts)


_SHOWN = ("rate_hz", "loss", "max_silence_s")
"""Numbers that are shown as they are written."""


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
    names = {node.key: node.full_name for node in plan.nodes}
    for flow in plan.flows:
        needs = []
        if flow.unique is not UniqueHow.NOT:
            needs.append(f"{flow.unique.value} unique")
        if flow.max_delay_ms is not None:
            needs.append(f"at most {flow.max_delay_ms:g} ms")
        needs += [str(each) for each in flow.quantities if each.name in _SHOWN]
        if flow.measure:
            needs.append("measured by a subscription of ours")
        if flow.linked and not needs:
            needs.append("linked")
        ends = f"{names[flow.publisher]} → {names[flow.subscription]}"
        by = f"{flow.medium} ({flow.medium_reason})" if flow.medium else flow.medium_reason
        told = filter(None, (by, ", ".join(needs)))
        rows.append((flow.topic, ends, "; ".join(told)))
    return columns(rows, indent=2, width=width)
