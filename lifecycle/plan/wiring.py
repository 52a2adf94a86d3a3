"""Wire a plan: connect participants, place endpoints on declared or negotiated connections. Pure.

In this order: ports that are written down are kept free, own participants and observers are
connected, endpoints are negotiated for, observers are extended to see the result. With static
endpoint discovery (Fast DDS STATIC EDP) the connection `data` carries a node's topics, and a table
has all endpoints: DDS names, ids that are unique in the system, and rmw_fastrtps's own topic
`ros_discovery_info` of each participant.

On Fast DDS a publisher sends from the sender sockets of its participant, so only one of its own
makes it unique, and only all publishers of one participant together can carry a DSCP. From the same
sockets subscriptions send their acknowledgements.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from msgspec.structs import replace

from lifecycle.manifest.diagnostics import Diagnostic, ManifestError, Position
from lifecycle.manifest.flows import FlowNeeds, ResolvedNeed
from lifecycle.manifest.model import (
    ConnectionDeclaration,
    DataLayerSource,
    DiscoveryMode,
    EndpointKind,
    FlowTransport,
    Link,
    Node,
    RunKind,
)
from lifecycle.manifest.qos import Durability, Reliability
from lifecycle.network.dscp import describe
from lifecycle.network.medium import Medium, udp_to
from lifecycle.plan.discovery import (
    Hosts,
    PortPool,
    connect_control,
    connect_observers,
    meshed,
)
from lifecycle.plan.media import (
    DataLayerGraph,
    NegotiatedConnection,
    party_of_node,
    rmw_of,
    terms_of,
    wishes_of,
    written_ports,
)
from lifecycle.plan.model import (
    GRAPH_TOPIC,
    GRAPH_TYPE,
    ParticipantConnections,
    Plan,
    PlannedEndpoint,
    PlannedFlow,
    PlannedNode,
    PlannedParticipant,
    StaticEndpoint,
    StaticParticipant,
)
from lifecycle.plan.negotiate import negotiate
from lifecycle.plan.processes import variables_of
from lifecycle.printable import count


def participant_name(node_name: str, connection: str) -> str:
    """Return the base name of the hidden node that carries a connection, `_camera_net`."""
    return f"_{node_name}_{connection}"


def own_transports(node: Node, needs: FlowNeeds) -> tuple[Medium, ...]:
    """Return all that a node's own participant may use, and its subscriptions receive by.

    Empty for any.
    """
    own = (
        each.transports
        for each in needs.of_node(node)
        # A marked subscription receives on a participant beside it.
        if each.need.kind is EndpointKind.SUBSCRIPTION and each.dscp is None and each.transports
    )
    return next(own, ())


def place(
    node: Node, endpoints: Sequence[PlannedEndpoint], needs: FlowNeeds
) -> tuple[tuple[PlannedEndpoint, ...], tuple[PlannedParticipant, ...]]:
    """Put endpoints on the connections that are declared for them, the others on what flows need.

    Names of the latter count from 0 in the order in which the interface first needs them, so they
    are the same in every run. What is in no connection and no group is left alone. Returns the
    endpoints with `participant` filled in, and the participants, connections first.
    """
    places = {
        entry: participant_name(node.name, connection.name)
        for connection in node.connections
        for entry in connection.map
    }
    # Only a node in our own host can be given more participants; what others start keeps its own.
    groups = _groups(node, needs) if node.run.kind is RunKind.PYTHON else []
    participants = [_connection(node.name, each, groups) for each in node.connections]
    for group in groups:
        left = [each for each in group if (each.need.kind, each.need.name) not in places]
        if left:
            number = len(participants) - len(node.connections)
            flow = participant_name(node.name, f"flow_{number}")
            places |= {(each.need.kind, each.need.name): flow for each in left}
            transports = left[0].transports or own_transports(node, needs)
            asked = _asked(left)
            reason = _reason(left, transports, asked["max_datagram_bytes"])
            participants.append(
                PlannedParticipant(name=flow, reason=reason, transports=transports, **asked)
            )
    placed = tuple(
        replace(each, participant=places.get((each.kind, each.name), "")) for each in endpoints
    )
    return placed, tuple(participants)


def _groups(node: Node, needs: FlowNeeds) -> list[list[ResolvedNeed]]:
    """Return the needs of endpoints by the extra participant that they share: as few as meet all.

    A publisher that needs an NFE of its own shares with none. Others share if they ask for the
    same; the smaller datagram size serves both. Subscriptions need one if they are marked, as
    acknowledgements leave by the sockets of the participant; they never share with publishers,
    whose flow a network that looks at marks must not take theirs for. Within one node only: a
    participant belongs to a node, whose hidden node is what the graph shows.
    """
    found: dict[object, list[ResolvedNeed]] = {}
    own = own_transports(node, needs)
    for endpoint in node.interface.endpoints:
        each = needs.of(node.key, endpoint.kind, endpoint.name)
        if each is None or not endpoint.kind.is_topic:
            continue
        class_ = (each.dscp, each.five_qi, each.transports or own, each.non_blocking_send)
        if each.unique and endpoint.kind is EndpointKind.PUBLISHER:
            found[endpoint.name] = [each]
        elif class_ != (None, None, own, False) or each.max_datagram_bytes is not None:
            found.setdefault((endpoint.kind, class_), []).append(each)
    return list(found.values())


def _asked(needs: Sequence[ResolvedNeed] | Sequence[PlannedParticipant]) -> dict[str, Any]:
    """Return what a participant must do for all that it carries; it can have one mark."""
    sizes = [each.max_datagram_bytes for each in needs if each.max_datagram_bytes is not None]
    return {
        "dscp": next((each.dscp for each in needs if each.dscp is not None), None),
        "max_datagram_bytes": min(sizes, default=None),
        "non_blocking_send": any(each.non_blocking_send for each in needs),
    }


def _connection(
    node_name: str, connection: ConnectionDeclaration, groups: Sequence[Sequence[ResolvedNeed]]
) -> PlannedParticipant:
    """Return the participant of a connection, with what the flows of its endpoints ask for."""
    needs = [
        each
        for group in groups
        for each in group
        if (each.need.kind, each.need.name) in connection.map
    ]
    return PlannedParticipant(
        name=participant_name(node_name, connection.name),
        reason=f"connection {connection.name} for {count(len(connection.map), 'endpoint')}",
        connection=connection.name,
        connections=ParticipantConnections(urls=tuple(str(url) for url in connection.urls)),
        declared=True,
        **_asked(needs),
    )


def _reason(
    needs: Sequence[ResolvedNeed], transports: tuple[Medium, ...], datagram_bytes: int | None
) -> str:
    first, names = needs[0], ", ".join(each.need.name for each in needs)
    unique = first.unique and first.need.kind is EndpointKind.PUBLISHER
    noun = f"{first.need.kind.noun}{'s' if len(needs) > 1 else ''}"
    facts = [f"{'unique ' if unique else ''}{noun} {names}"]
    if first.dscp is not None:
        facts.append(f"marked {describe(first.dscp)}")
    if first.five_qi is not None and not first.unique:
        facts.append(f"for 5QI {first.five_qi}")
    if transports:
        facts.append(f"by {' and '.join(transports)} only")
    if datagram_bytes is not None:
        facts.append(f"in datagrams of at most {datagram_bytes} bytes")
    if first.non_blocking_send:
        facts.append("sent without waiting")
    return " ".join(facts)


def place_negotiated(node: PlannedNode, connections: Sequence[NegotiatedConnection]) -> PlannedNode:
    """Give a node the connections that were negotiated for it.

    An extra participant that made a publisher's flow unique and carries none any more is removed;
    the publisher's connection takes its purpose.
    """
    places = {label: each for each in connections for label in each.map}
    endpoints = []
    carriers = {each.name: each for each in node.participants}
    takes: dict[str, list[PlannedParticipant]] = {}
    for each in node.endpoints:
        connection = places.get(each.kind.spell(each.name))
        if connection is None:
            endpoints.append(each)
            continue
        if each.participant in carriers:
            takes.setdefault(connection.name, []).append(carriers[each.participant])
        name = participant_name(node.name, connection.name)
        endpoints.append(replace(each, participant=name))
    used = {each.participant for each in endpoints}
    kept = [each for each in node.participants if each.connection or each.name in used]
    for connection in connections:
        replaced = takes.get(connection.name, [])
        reason = f"connection {connection.name}, {connection.reason}"
        made = PlannedParticipant(
            name=participant_name(node.name, connection.name),
            reason="; ".join([reason, *dict.fromkeys(each.reason for each in replaced)]),
            connection=connection.name,
            connections=ParticipantConnections(urls=connection.urls),
            **_asked(replaced),
        )
        kept.append(made)
    return replace(node, endpoints=tuple(endpoints), participants=tuple(kept))


def wire(plan: Plan, links: Sequence[Link]) -> Plan:
    """Connect everything, beside declared connections and the extra participants of flows.

    Raises:
        ManifestError: pairs cannot be connected.
        PlanError: there are not enough ports.
    """
    discovery, data_layer = plan.discovery, plan.data_layer
    hosts = Hosts.of(plan)
    pool = PortPool(discovery.first_port, written_ports(plan, hosts))
    plan, own = connect_control(plan, hosts, pool)
    nodes = plan.nodes
    if discovery.mode is DiscoveryMode.STATIC_ENDPOINTS:
        nodes = place_static(nodes, hosts, pool)
    # A node that can join at any time must announce it where others work out connections from it.
    comes_and_goes = (
        discovery.mode is DiscoveryMode.DYNAMIC and data_layer.source is DataLayerSource.DYNAMIC
    )
    nodes = tuple(
        replace(
            node,
            authority=data_layer.authority,
            events=data_layer.events,
            membership=data_layer.events or comes_and_goes,
        )
        for node in nodes
    )
    plan = replace(
        plan,
        nodes=nodes,
        observers=_by_machine(own, hosts),
    )
    variables = dict(variables_of(plan))
    parties = {
        node.key: party_of_node(node, hosts, rmw=rmw_of(node, plan), variables=variables)
        for node in nodes
    }
    static = data_layer.source is DataLayerSource.STATIC
    if static:
        graph = negotiate(tuple(parties.values()), wishes_of(plan.flows), terms_of(plan))
        if found := tuple(_unconnectable(graph, links)):
            raise ManifestError(found)
        plan = with_graph(plan, graph)
    may_use_tcp = not static and _may_use_tcp(plan)
    observers = connect_observers(plan, hosts, own, may_use_tcp=may_use_tcp)
    return replace(plan, observers=_by_machine(observers, hosts))


def with_graph(plan: Plan, graph: DataLayerGraph) -> Plan:
    """Return a plan with the connections and media that a data layer graph gives its nodes."""
    connections: dict[str, list[NegotiatedConnection]] = {}
    for each in graph.connections:
        connections.setdefault(each.node, []).append(each)
    negotiated = {(each.topic, each.publisher, each.subscription): each for each in graph.flows}

    def with_medium(flow: PlannedFlow) -> PlannedFlow:
        found = negotiated.get((flow.topic, flow.publisher, flow.subscription), flow)
        return replace(flow, medium=found.medium, medium_reason=found.medium_reason)

    return replace(
        plan,
        nodes=tuple(place_negotiated(node, connections.get(node.key, ())) for node in plan.nodes),
        flows=tuple(map(with_medium, plan.flows)),
    )


def _by_machine(
    observers: Mapping[str, ParticipantConnections], hosts: Hosts
) -> tuple[tuple[str, ParticipantConnections], ...]:
    """Return observers by machine; by no name where there is one host or none has a name."""
    found = []
    for host, each in observers.items():
        names = hosts.names(host)
        if not hosts.several or not names:
            found.append(("", each))
        found += [(name, each) for name in names]
    return tuple(found)


def _may_use_tcp(plan: Plan) -> bool:
    """Whether anything declares that TCP may be negotiated while the system runs."""
    endpoints = [each for node in plan.nodes for each in node.endpoints]
    wishes = {each.transport.medium for each in plan.flows}
    wishes |= {each.transport.medium for each in endpoints}
    reliable = any(each.lossy is False for each in endpoints)
    return reliable or any(each and (each.is_tcp or each.is_group) for each in wishes)


def _unconnectable(graph: DataLayerGraph, links: Sequence[Link]) -> Iterator[Diagnostic]:
    """Yield what cannot be connected, at the link or else the publisher that asks."""
    asked: dict[tuple[str, str, str], Position] = {}
    for link in links:
        if link.transport is not FlowTransport.ANY:
            asked.setdefault((link.topic, link.from_node, link.to_node), link.at)
    for each in graph.problems:
        ends = (each.flow.topic, each.flow.publisher, each.flow.subscription)
        yield replace(each.why, at=asked.get(ends, each.why.at))


DATA = "data"
"""Name of the connection that carries a node's topics."""


def place_static(
    nodes: Sequence[PlannedNode], hosts: Hosts, pool: PortPool
) -> tuple[PlannedNode, ...]:
    """Put every topic that no declared connection carries onto a connection with fixed ports.

    A participant that makes a publisher's flow unique becomes a connection as well.

    Raises:
        PlanError: too few ports.
    """
    placed = [_place(node) for node in nodes]
    kind = udp_to("".join(hosts.used))
    ports = {
        (node.key, each.name): (hosts.host(node.machine), pool.take(hosts.host(node.machine), 3))
        for node in placed
        for each in node.participants
        if _is_static(each)
    }
    urls = meshed(ports, kind)
    table = tuple(_table(placed))

    def connected(node: PlannedNode, each: PlannedParticipant) -> PlannedParticipant:
        if (node.key, each.name) not in urls:
            return each
        connections = ParticipantConnections(
            urls=(urls[node.key, each.name],),
            static_name=_enclave(node, each),
            static_participants=table,
        )
        return replace(each, connections=connections)

    return tuple(
        replace(node, participants=tuple(connected(node, each) for each in node.participants))
        for node in placed
    )


def _is_static(participant: PlannedParticipant) -> bool:
    return not participant.connections.urls


def _place(node: PlannedNode) -> PlannedNode:
    """Give a node the participants that its topics need; still without URLs."""
    if node.run.kind is not RunKind.PYTHON:
        return node
    name = participant_name(node.name, DATA)
    moved = [each for each in node.endpoints if each.kind.is_topic and not each.participant]
    endpoints = tuple(
        replace(each, participant=name) if each in moved else each for each in node.endpoints
    )
    extra = tuple(
        each
        if each.connection
        else replace(each, transports=(), connection=each.name.removeprefix(f"_{node.name}_"))
        for each in node.participants
    )
    data = PlannedParticipant(
        name=name,
        dscp=None,
        reason=f"connection {DATA}, {count(len(moved), 'endpoint')} not announced",
        connection=DATA,
    )
    return replace(node, endpoints=endpoints, participants=(*extra, *((data,) if moved else ())))


def _enclave(node: PlannedNode, participant: PlannedParticipant) -> str:
    return f"{node.namespace.rstrip('/')}/{participant.name.lstrip('_')}"


def _table(nodes: Sequence[PlannedNode]) -> Iterator[StaticParticipant]:
    number = 0
    for node in nodes:
        for participant in node.participants:
            if not _is_static(participant):
                continue
            carried = [each for each in node.endpoints if each.participant == participant.name]
            lines = []
            for entry in (*(_line(each) for each in carried), *_GRAPH):
                number += 1
                lines.append(replace(entry, user_id=number))
            yield StaticParticipant(name=_enclave(node, participant), endpoints=tuple(lines))


_GRAPH = tuple(
    StaticEndpoint(
        writer=writer,
        topic=GRAPH_TOPIC,
        type=GRAPH_TYPE,
        profile=GRAPH_TOPIC,
        user_id=0,
        transient_local=True,
    )
    for writer in (True, False)
)


def _line(each: PlannedEndpoint) -> StaticEndpoint:
    package, _, name = each.type.split("/")
    qos = each.qos
    return StaticEndpoint(
        writer=each.kind is EndpointKind.PUBLISHER,
        topic=f"rt{each.resolved}",
        type=f"{package}::msg::dds_::{name}_",
        profile=each.resolved,
        user_id=0,
        reliable=qos is None or qos.reliability is not Reliability.BEST_EFFORT,
        transient_local=qos is not None and qos.durability is Durability.TRANSIENT_LOCAL,
    )
