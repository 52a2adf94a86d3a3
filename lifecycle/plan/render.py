"""Print a plan as text: what `lifecycle plan` shows. Pure."""

from __future__ import annotations

import shlex
from collections.abc import Iterator

from lifecycle.manifest.model import (
    DataLayer,
    DataLayerSource,
    DiscoveryMode,
    FlowTransport,
    Quantity,
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

_Rows = Iterator[tuple[str, ...]]


def render_text(plan: Plan, *, width: int = 100) -> str:
    """Print processes, order, nodes with endpoints, participants and flows.

    Lines fit into `width` columns, at least 40, where words allow it.
    """
    counts = (
        count(len(plan.nodes), "node"),
        count(len(plan.processes), "process"),
        count(len(plan.flows), "flow"),
    )
    where = f"domain {plan.domain_id}, discovery range {plan.discovery_range.value}"
    lines = [f"system {plan.system}: {', '.join(counts)}; {where}"]
    for title, section in (
        ("processes", _processes(plan)),
        ("order", _order(plan)),
        ("data layer", _data_layer(plan)),
        ("nodes", _nodes(plan)),
        ("participants", _participants(plan)),
        ("flows", _flows(plan)),
    ):
        if rows := list(section):
            lines += ["", title, *columns(rows, indent=2, width=max(width, 40))]
    return "\n".join(lines) + "\n"


def _processes(plan: Plan) -> _Rows:
    for each in plan.processes:
        yield each.name, each.machine, each.run.kind.value, _started_as(plan, each)


def _started_as(plan: Plan, process: PlannedProcess) -> str:
    if process.run.kind is RunKind.COMMAND:
        return shlex.join(process.argv)
    if process.run.kind is RunKind.ATTACH:
        return "started by others"
    return ", ".join(plan.node(key).run.python for key in process.nodes)


def _order(plan: Plan) -> _Rows:
    for number, level in enumerate(plan.levels, start=1):
        yield f"{number}.", ", ".join(_waiting(plan.node(key)) for key in level)


def _waiting(node: PlannedNode) -> str:
    waits = " and ".join(map(str, node.after))
    return f"{node.key} (after {waits})" if waits else node.key


def _data_layer(plan: Plan) -> _Rows:
    """Describe how participants find each other and who connects them; nothing if all is usual."""
    discovery, layer, usual = plan.discovery, plan.data_layer, DataLayer()
    transport = discovery.transport
    how = "" if transport is FlowTransport.ANY else f", own participants by {transport.value}"
    if how or discovery.mode is not DiscoveryMode.DYNAMIC:
        yield "discovery", f"{discovery.mode.value}{how}"
    if plan.server is not None:
        protocol = "TCP" if plan.server.tcp else "UDP"
        where = f" on machine {plan.server.machine}" if plan.server.machine else ""
        yield "discovery server", f"{protocol} {plan.server.address}:{plan.server.port}{where}"
    if (layer.authority, layer.source) != (usual.authority, usual.source) or layer.events:
        source = "the manifest" if layer.source is DataLayerSource.STATIC else "node configurations"
        again = "; what is lost is made again" if layer.events else ""
        yield "authority", f"{layer.authority.value}, from {source}{again}"
    for machine, each in plan.observers:
        yield f"observer {machine}".rstrip(), _spelled(each)


def _spelled(each: ParticipantConnections) -> str:
    texts = list(each.urls) or ["as the RMW chooses"]
    if each.static_name:
        texts.append(f"known to others as {each.static_name} without announcement")
    if each.super_client:
        texts.append("finds everything that the server knows")
    return " ".join(texts)


def _nodes(plan: Plan) -> _Rows:
    for node in plan.nodes:
        facts = (
            "managed" if node.managed else "not managed",
            f"process {node.process}",
            *([f"machine {node.machine}"] if node.machine else []),
            f"endpoints {node.endpoint_policy.value}",
            _HELD[node.held_by],
        )
        yield node.full_name, ", ".join(facts)
        for each in node.endpoints:
            yield f"  {each.kind.noun} {each.resolved}", "; ".join(_endpoint_facts(each))


_HELD = {
    HeldBy.STATE_MACHINE: "held by its state machine until verified",
    HeldBy.SERVICES: "held by its lifecycle services until verified",
    HeldBy.EXECUTOR: "held by its executor and its publishers until verified",
    HeldBy.NOTHING: "not held: works as soon as it is started",
}


def _endpoint_facts(endpoint: PlannedEndpoint) -> Iterator[str]:
    yield endpoint.type
    if endpoint.qos:
        yield spell_qos(endpoint.qos)
    if endpoint.unique is not UniqueRequirement.NOT_REQUIRED:
        yield f"unique {endpoint.unique.value}"
    if endpoint.dscp is not None:
        yield describe(endpoint.dscp) + ("" if endpoint.enforce_dscp else ", not enforced")
    if endpoint.five_qi is not None:
        yield endpoint.five_qi_reason or f"5QI {endpoint.five_qi}"
    if endpoint.transport is FlowTransport.NETWORK:
        yield "by the network only"
    if endpoint.max_message_size is not None:
        yield f"at most {endpoint.max_message_size} bytes"
    yield from _numbers(endpoint.max_delay_ms, endpoint.quantities)


def _numbers(max_delay_ms: float | None, quantities: tuple[Quantity, ...]) -> Iterator[str]:
    if max_delay_ms is not None:
        yield f"at most {max_delay_ms:g} ms"
    for each in quantities:
        if each.name in ("rate_hz", "loss", "max_silence_s"):
            yield str(each)


def spell_qos(qos: QosProfile) -> str:
    """Spell a profile in one line: `BEST_EFFORT VOLATILE KEEP_LAST(1), deadline 100 ms`."""
    depth = f"({qos.depth})" if qos.history is History.KEEP_LAST else ""
    words = [f"{qos.reliability.value} {qos.durability.value} {qos.history.value}{depth}"]
    for word, value in (
        ("deadline", qos.deadline_ns),
        ("lifespan", qos.lifespan_ns),
        ("lease", qos.liveliness_lease_duration_ns),
    ):
        if value:
            best = value == BEST_AVAILABLE_NS
            words.append(f"{word} {'BEST_AVAILABLE' if best else f'{value / 1e6:g} ms'}")
    if qos.liveliness not in (Liveliness.AUTOMATIC, Liveliness.SYSTEM_DEFAULT):
        words.append(f"liveliness {qos.liveliness.value}")
    return ", ".join(words)


def _participants(plan: Plan) -> _Rows:
    """List participants beside nodes' own, and those that are not as the RMW chooses."""
    for node in plan.nodes:
        if node.connections.urls:
            yield f"of {node.full_name} itself", _spelled(node.connections)
        for each in node.participants:
            carried = (e.kind.spell(e.name) for e in node.endpoints if e.participant == each.name)
            name = f"{node.namespace.rstrip('/')}/{each.name}"
            yield name, f"{each.reason}: {_spelled(each.connections)}"
            yield "", f"carries {', '.join(carried) or 'nothing'}"


def _flows(plan: Plan) -> _Rows:
    for flow in plan.flows:
        by = f"{flow.medium} ({flow.medium_reason})" if flow.medium else flow.medium_reason
        said = [by] if by else []
        if flow.unique is not UniqueHow.NOT:
            said.append(f"{flow.unique.value} unique")
        said += _numbers(flow.max_delay_ms, flow.quantities)
        if flow.measure:
            said.append("measured by a subscription of ours")
        ends = [plan.node(key).full_name for key in (flow.publisher, flow.subscription)]
        yield flow.topic, " → ".join(ends), "; ".join(said)
