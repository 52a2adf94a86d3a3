"""The data layer of a plan: control plane, declared and negotiated connections, put together.

Owns: `wire`, in this order: ports that are written down are kept free, own participants and
observers are connected, endpoints are negotiated for, observers learn to see the outcome. Pure.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence

from lifecycle.manifest.diagnostics import Diagnostic, Position
from lifecycle.manifest.model import (
    DataLayerSource,
    Discovery,
    DiscoveryMode,
    EndpointKind,
    FlowTransport,
    Manifest,
)
from lifecycle.manifest.yaml.document import error
from lifecycle.plan.connections.control import connect_control, is_fixed
from lifecycle.plan.connections.feasible import infeasible
from lifecycle.plan.connections.hosts import Hosts, PortPool
from lifecycle.plan.connections.observers import connect_observers, with_tcp
from lifecycle.plan.connections.static_endpoints import place_static
from lifecycle.plan.errors import PlanError
from lifecycle.plan.model import (
    ParticipantConnections,
    Plan,
    PlannedFlow,
    PlannedNode,
    PlannedServer,
)
from lifecycle.plan.negotiation.data_layer import DataLayerGraph
from lifecycle.plan.negotiation.negotiate import negotiate
from lifecycle.plan.negotiation.parties import party_of_node, place_negotiated, wishes_of
from lifecycle.plan.negotiation.terms import make_terms, written_ports


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Wired:
    """Nodes and flows with their data layer.

    Attributes:
        observers: (machine, connections), see `Plan.observers`.
    """

    nodes: tuple[PlannedNode, ...]
    flows: tuple[PlannedFlow, ...]
    server: PlannedServer | None
    observers: tuple[tuple[str, ParticipantConnections], ...]


def wire(
    manifest: Manifest,
    nodes: Sequence[PlannedNode],
    flows: Sequence[PlannedFlow],
    *,
    domain_id: int,
    rmws: Mapping[str, str],
) -> Wired:
    """Connect everything.

    Args:
        manifest: valid.
        nodes: with their declared connections and the extra participants that flows need.
        flows: of these nodes.
        domain_id: 0–232.
        rmws: RMW identifier of each node, by key.

    Raises:
        PlanError: a pair cannot be connected, a participant cannot do what is asked of it, or there
            are not enough ports.
    """
    discovery, data_layer = manifest.discovery, manifest.data_layer
    machines = [node.machine for node in nodes]
    if discovery.mode is DiscoveryMode.SERVER:
        first = next((each.name for each in manifest.machines), "")
        machines.append(discovery.server_machine or first)
    hosts = Hosts.of(manifest.machines, machines)
    taken = written_ports(nodes, hosts, discovery, domain_id=domain_id)
    pool = PortPool(discovery.first_port, taken)
    nodes, control = connect_control(nodes, discovery, hosts, pool)
    if discovery.mode is DiscoveryMode.STATIC_ENDPOINTS:
        nodes = place_static(nodes, hosts, pool)
    # Who can come at any time must say so where others work out connections from it.
    comes_and_goes = (
        discovery.mode is DiscoveryMode.DYNAMIC and data_layer.source is DataLayerSource.DYNAMIC
    )
    nodes = tuple(
        dataclasses.replace(
            node,
            authority=data_layer.authority,
            events=data_layer.events,
            membership=data_layer.events or comes_and_goes,
        )
        for node in nodes
    )
    variables = dict(variables_of(discovery, control.server))
    parties = {
        node.key: party_of_node(node, hosts, rmw=rmws[node.key], variables=variables)
        for node in nodes
    }
    static = data_layer.source is DataLayerSource.STATIC
    found: list[Diagnostic] = []
    if static:
        terms = make_terms(
            discovery,
            data_layer,
            nodes,
            hosts,
            observers=with_tcp(control, hosts),
            server=control.server,
            domain_id=domain_id,
            max_datagram_bytes=manifest.network.max_datagram_bytes,
        )
        graph = negotiate(tuple(parties.values()), wishes_of(flows), terms)
        found += _unconnectable(graph, nodes, manifest)
        nodes = tuple(
            place_negotiated(node, [each for each in graph.connections if each.node == node.key])
            for node in nodes
        )
        flows = [_with_medium(flow, graph) for flow in flows]
    found += infeasible(nodes, parties, negotiated=static)
    if found:
        raise PlanError.of(tuple(found))
    observers = connect_observers(
        nodes,
        hosts,
        control,
        fixed=is_fixed(discovery),
        may_use_tcp=not static and _may_use_tcp(nodes, flows),
    )
    return Wired(
        nodes=tuple(nodes),
        flows=tuple(flows),
        server=control.server,
        observers=tuple(_by_machine(observers, hosts)),
    )


def with_graph(plan: Plan, graph: DataLayerGraph) -> Plan:
    """Return a plan as it must be seen once a data layer graph is made.

    Args:
        plan: without negotiated connections, as `build_plan` returns it where the data layer graph
            is made from node configurations.
        graph: what was negotiated; what it gives to nodes that the plan does not know is left out.
    """
    return dataclasses.replace(
        plan,
        nodes=tuple(
            place_negotiated(node, [each for each in graph.connections if each.node == node.key])
            for node in plan.nodes
        ),
        flows=tuple(_with_medium(flow, graph) for flow in plan.flows),
    )


def variables_of(discovery: Discovery, server: PlannedServer | None) -> tuple[tuple[str, str], ...]:
    """Return what connects a process whose participant is its own code's to the control plane.

    Only what Fast DDS 2.14 reads from the environment: transports and a discovery server. With
    FASTDDS_BUILTIN_TRANSPORTS other than NONE beside a server, every sample would arrive twice.

    Args:
        discovery: as declared.
        server: the discovery server; None without.
    """
    if server is not None:
        at = f"{server.address}:{server.port}"
        if server.tcp:
            return (
                ("ROS_DISCOVERY_SERVER", f"TCPv4:[{server.address}]:{server.port}"),
                ("FASTDDS_BUILTIN_TRANSPORTS", "NONE"),
            )
        return (("ROS_DISCOVERY_SERVER", at), ("FASTDDS_BUILTIN_TRANSPORTS", "UDPv4"))
    value = _BUILTIN.get(discovery.transport)
    return (("FASTDDS_BUILTIN_TRANSPORTS", value),) if value else ()


_BUILTIN = {
    FlowTransport.SHM: "SHM",
    FlowTransport.UDPV4: "UDPv4",
    FlowTransport.UDPV6: "UDPv6",
}


def _by_machine(
    observers: Sequence[tuple[str, ParticipantConnections]], hosts: Hosts
) -> list[tuple[str, ParticipantConnections]]:
    """Return observers by machine; by no name where there is one host or none has a name."""
    found = []
    for host, each in observers:
        names = hosts.names(host)
        if not hosts.several or not names:
            found.append(("", each))
        found += [(name, each) for name in names]
    return found


def _may_use_tcp(nodes: Sequence[PlannedNode], flows: Sequence[PlannedFlow]) -> bool:
    """Whether something says that TCP may be negotiated while the system runs."""
    wishes = {each.transport for each in flows}
    wishes |= {each.transport for node in nodes for each in node.endpoints}
    reliable = any(each.lossy is False for node in nodes for each in node.endpoints)
    return reliable or bool({FlowTransport.TCPV4, FlowTransport.MULTICAST} & wishes)


def _unconnectable(
    graph: DataLayerGraph, nodes: Sequence[PlannedNode], manifest: Manifest
) -> Iterator[Diagnostic]:
    """Yield what cannot be connected, at the link or else the publisher that asks."""
    start = Position(file=manifest.path, line=1, column=1)
    for problem in graph.problems:
        links = [
            link.at
            for link in manifest.links
            if link.topic == problem.topic
            and link.from_node in (problem.publisher, "*")
            and link.to_node in (problem.subscription, "*")
            and link.transport is not FlowTransport.ANY
        ]
        endpoints = [
            each.at or node.at
            for node in nodes
            if node.key == problem.publisher
            for each in node.endpoints
            if each.kind is EndpointKind.PUBLISHER and each.resolved == problem.topic
        ]
        at = next(iter((*links, *endpoints)), None) or start
        yield error("plan.unconnectable", at, problem.message, problem.hint)


def _with_medium(flow: PlannedFlow, graph: DataLayerGraph) -> PlannedFlow:
    found = [
        each
        for each in graph.flows
        if (each.topic, each.publisher, each.subscription)
        == (flow.topic, flow.publisher, flow.subscription)
    ]
    if not found:
        return flow
    media = dict.fromkeys(each.medium for each in found)
    reasons = dict.fromkeys(each.reason for each in found)
    return dataclasses.replace(flow, medium=" and ".join(media), medium_reason=", ".join(reasons))
