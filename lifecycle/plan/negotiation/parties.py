"""Nodes of a plan as parties of a negotiation, the terms of the system, and the result in the plan.

Owns: `party_of_node`, `place_negotiated` and the wishes that links make; `terms_of` and `Terms` of
a plan in the making: ports that are taken, groups, observers. It is used before anything runs and
while it does. Pure.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from types import MappingProxyType

from msgspec.structs import replace

from lifecycle.manifest.model import (
    DataLayer,
    Discovery,
    DiscoveryMode,
    EndpointKind,
    FlowTransport,
    RunKind,
)
from lifecycle.network.connection_url import ConnectionUrl, Peer, parse
from lifecycle.network.medium import (
    BUILTIN_TRANSPORTS,
    CONNECTABLE,
    DEFAULT_TCP,
    FAST_DDS,
    RMW_DEFAULT,
    RMW_DISCOVERY,
    TRANSPORTS_VARIABLE,
)
from lifecycle.network.ports import DG, domain_base
from lifecycle.plan.connections.control import is_fixed, participant_name
from lifecycle.plan.connections.hosts import Hosts, contacts_of, ports_of
from lifecycle.plan.model import (
    ParticipantConnections,
    Plan,
    PlannedEndpoint,
    PlannedFlow,
    PlannedNode,
    PlannedParticipant,
    PlannedServer,
)
from lifecycle.plan.negotiation.data_layer import (
    NegotiatedConnection,
    Party,
    PartyEndpoint,
    Terms,
)


def transports_of(urls: Iterable[str]) -> tuple[str, ...]:
    """Return the transports of a participant with these URLs; a group as `udpm@ADDRESS:PORT`."""
    return tuple(dict.fromkeys(_transport(parse(text)) for text in urls))


def _transport(url: ConnectionUrl) -> str:
    if url.transport.is_group:
        return f"{url.transport}@{url.address}:{url.port}"
    return url.transport


def wishes_of(flows: Iterable[PlannedFlow]) -> Mapping[tuple[str, str, str], FlowTransport]:
    """Return the transport that links demand for each pair."""
    return {
        (each.topic, each.publisher, each.subscription): each.transport
        for each in flows
        if each.transport is not FlowTransport.ANY
    }


_NO_VARIABLES: Mapping[str, str] = MappingProxyType({})


def party_of_node(
    node: PlannedNode, hosts: Hosts, *, rmw: str, variables: Mapping[str, str] = _NO_VARIABLES
) -> Party:
    """Return a node as a party, from what its manifest declares alone.

    Args:
        node: its participants that are declared or make flows unique in place, no negotiated ones.
        hosts: of the system.
        rmw: the RMW identifier that it runs with.
        variables: what a COMMAND node's process gets beside its own.
    """
    host = hosts.host(node.machine)
    known = rmw.startswith(FAST_DDS)
    ours = node.run.kind is RunKind.PYTHON and known
    own = transports_of(node.connections.urls) or node.transports or _by_variable(node, variables)
    return Party(
        key=node.key,
        full_name=node.full_name,
        host=host,
        process=node.process,
        transports=CONNECTABLE if ours else own if known else (),
        own=own if known else (),
        connectable=ours,
        endpoints=tuple(endpoint_of(node, each) for each in node.endpoints if each.kind.is_topic),
        connections=tuple(each.connection for each in node.participants if each.connection),
        contacts=contacts_of(host, node.connections.urls),
    )


def _by_variable(node: PlannedNode, variables: Mapping[str, str]) -> tuple[str, ...]:
    """Return the transports that variables give a node; () for any other value."""
    environment = dict(node.run.environment)
    if node.run.kind is RunKind.COMMAND:
        environment = {**variables, **environment}
    word = environment.get(TRANSPORTS_VARIABLE, "").partition("?")[0]
    return BUILTIN_TRANSPORTS.get(word or "DEFAULT", ())


def endpoint_of(node: PlannedNode, each: PlannedEndpoint) -> PartyEndpoint:
    """Return an endpoint as the manifest declares it, on the participant that the plan puts it."""
    carrier = next((one for one in node.participants if one.name == each.participant), None)
    by: tuple[str, ...] = ()
    if carrier is not None:
        by = transports_of(carrier.connections.urls) or carrier.transports or RMW_DEFAULT
    publishes = each.kind is EndpointKind.PUBLISHER
    return PartyEndpoint(
        kind=each.kind,
        name=each.name,
        resolved=each.resolved,
        type=each.type,
        qos=each.qos,
        by=by,
        fixed=carrier is not None and bool(carrier.connection),
        alone=publishes and each.unique.asks,
        # Who shares a participant already may share a connection; who does not may not.
        group=each.participant if carrier and not carrier.connection else "",
        transport=each.transport,
        lossy=each.lossy,
        size_bytes=each.max_message_size,
    )


def place_negotiated(node: PlannedNode, connections: Sequence[NegotiatedConnection]) -> PlannedNode:
    """Give a node the connections that were negotiated for it.

    An extra participant that made a publisher's flow unique and carries none any more is removed;
    the publisher's connection takes its purpose.
    """
    places: dict[str, NegotiatedConnection] = {
        label: each for each in connections for label in each.map
    }
    endpoints = []
    carriers: dict[str, PlannedParticipant] = {each.name: each for each in node.participants}
    takes: dict[str, list[PlannedParticipant]] = {}
    for each in node.endpoints:
        connection = places.get(f"{each.kind.value}/{each.name}")
        if connection is None:
            endpoints.append(each)
            continue
        if each.participant in carriers:
            takes.setdefault(connection.name, []).append(carriers[each.participant])
        name = participant_name(node.name, connection.name)
        endpoints.append(replace(each, participant=name))
    used = {each.participant for each in endpoints}
    kept = [each for each in node.participants if each.connection or each.name in used]
    made = [_participant(node.name, each, takes.get(each.name, ())) for each in connections]
    return replace(node, endpoints=tuple(endpoints), participants=(*kept, *made))


def _participant(
    node_name: str, connection: NegotiatedConnection, replaced: Sequence[PlannedParticipant]
) -> PlannedParticipant:
    sizes = [each.max_datagram_bytes for each in replaced if each.max_datagram_bytes is not None]
    reasons = ", ".join(dict.fromkeys(each.reason for each in replaced))
    return PlannedParticipant(
        name=participant_name(node_name, connection.name),
        dscp=next((each.dscp for each in replaced), None),
        reason=f"connection {connection.name}, {connection.reason}"
        f"{f'; {reasons}' if reasons else ''}",
        max_datagram_bytes=min(sizes, default=None),
        non_blocking_send=any(each.non_blocking_send for each in replaced),
        connection=connection.name,
        connections=ParticipantConnections(urls=connection.urls),
    )


def hosts_of(plan: Plan) -> Hosts:
    """Return the hosts of a plan."""
    machines = [node.machine for node in plan.nodes]
    if plan.server is not None:
        machines.append(plan.server.machine)
    return Hosts.of(plan.machines, machines)


def terms_of(plan: Plan) -> Terms:
    """Return what the nodes of a running plan can negotiate under."""
    hosts = hosts_of(plan)
    observers = {hosts.host(machine): each for machine, each in plan.observers}
    return make_terms(
        plan.discovery,
        plan.data_layer,
        plan.nodes,
        hosts,
        observers=observers,
        server=plan.server,
        domain_id=plan.domain_id,
        max_datagram_bytes=plan.network.max_datagram_bytes,
    )


def make_terms(
    discovery: Discovery,
    data_layer: DataLayer,
    nodes: Sequence[PlannedNode],
    hosts: Hosts,
    *,
    observers: Mapping[str, ParticipantConnections],
    server: PlannedServer | None,
    domain_id: int,
    max_datagram_bytes: int | None,
) -> Terms:
    """Return the terms of a plan's parts.

    Args:
        discovery: as declared.
        data_layer: as declared.
        nodes: with the connections that they have whatever is negotiated.
        hosts: of the system.
        observers: by host, how its supervisor's own participant is connected.
        server: the discovery server; None without.
        domain_id: 0–232.
        max_datagram_bytes: UDP payload that the path carries unfragmented; None assumes Ethernet.
    """
    taken = written_ports(nodes, hosts, discovery, domain_id=domain_id)
    for host, each in observers.items():
        taken.setdefault(host, set()).update(ports_of(parse(text) for text in each.urls))
    if server is not None:
        taken.setdefault(hosts.host(server.machine), set()).add(server.port)
    return Terms(
        fixed=is_fixed(discovery),
        server=None if server is None else Peer(address=server.address, port=server.port),
        server_medium=DEFAULT_TCP if server is None or server.tcp else RMW_DISCOVERY,
        first_port=discovery.first_port,
        taken=tuple((host, tuple(sorted(ports))) for host, ports in sorted(taken.items())),
        multicast_group=data_layer.multicast_group,
        max_datagram_bytes=max_datagram_bytes,
        observers=tuple(
            contact for host, each in observers.items() for contact in contacts_of(host, each.urls)
        ),
    )


def written_ports(
    nodes: Sequence[PlannedNode], hosts: Hosts, discovery: Discovery, *, domain_id: int
) -> dict[str, set[int]]:
    """Return the ports of each host that URLs name, and those that a domain uses by itself."""
    base = domain_base(domain_id)
    domain = set(range(base, base + DG)) if discovery.mode is DiscoveryMode.DYNAMIC else set()
    taken: dict[str, set[int]] = {host: set(domain) for host in hosts.used}
    for node in nodes:
        ports = taken.setdefault(hosts.host(node.machine), set())
        ports.update(ports_of(parse(text) for text in urls_of(node)))
    return taken


def urls_of(node: PlannedNode) -> Iterable[str]:
    """Return every connection URL of a node: its own participant's and all others'."""
    yield from node.connections.urls
    for each in node.participants:
        yield from each.connections.urls
