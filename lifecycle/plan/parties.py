"""The parties of a negotiation, the terms of their system, and the data layer graph that results.

Negotiation is used before anything runs, and while it does: `party_of_node` and `terms_of` make
them of a plan. Pure.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from types import MappingProxyType

import msgspec

from lifecycle.manifest.model import DiscoveryMode, EndpointKind, FlowTransport, RunKind
from lifecycle.network.connection_url import Peer, parse
from lifecycle.network.medium import (
    BUILTIN_TRANSPORTS,
    CONNECTABLE,
    DEFAULT_TCP,
    FAST_DDS,
    RMW_DEFAULT,
    RMW_DISCOVERY,
    TRANSPORTS_VARIABLE,
    Medium,
)
from lifecycle.network.ports import DG, domain_base
from lifecycle.plan.discovery import Contact, Hosts, contacts_of, is_fixed, ports_of
from lifecycle.plan.model import Plan, PlannedEndpoint, PlannedFlow, PlannedNode, PlannedParticipant

End = tuple[str, EndpointKind, str]
"""An endpoint that takes part: key of its party, kind, declared name."""


class Party(msgspec.Struct, frozen=True, kw_only=True):
    """One node, as negotiation sees it. Its endpoints are on the participant that they name.

    Attributes:
        key: manifest key; the full name of a node that no manifest declares.
        host: its host, see `lifecycle.plan.discovery`; parties of equal hosts share memory.
        process: unique on the host.
        transports: all that it can be connected by.
        own: transports of its own participant; empty if not known.
        connectable: `connect_to` is there to be called.
        endpoints: its publishers and subscriptions; one that no interface declares has its resolved
            name.
        participants: those beside its own. What is on a connection of theirs stays there; else
            those that share one may share a connection, and no others.
        contacts: where its own participant is reached.
    """

    key: str
    host: str
    process: str
    transports: tuple[str, ...] = CONNECTABLE
    own: tuple[str, ...] = RMW_DEFAULT
    connectable: bool = True
    endpoints: tuple[PlannedEndpoint, ...] = ()
    participants: tuple[PlannedParticipant, ...] = ()
    contacts: tuple[Contact, ...] = ()

    def participant_of(self, endpoint: PlannedEndpoint) -> PlannedParticipant | None:
        """Return the participant beside the party's own that an endpoint is on; None for its own.

        Of two that share a name the first is meant.
        """
        return next((each for each in self.participants if each.name == endpoint.participant), None)

    def transports_at(self, endpoint: PlannedEndpoint) -> tuple[str, ...]:
        """Return by what an endpoint is reached where it is; nothing where that is not known."""
        on = self.participant_of(endpoint)
        if on is None:
            return self.own
        return transports_of(on.connections.urls) or on.transports or RMW_DEFAULT

    def may_move(self, endpoint: PlannedEndpoint) -> bool:
        """Whether an endpoint may be mapped onto another connection."""
        on = self.participant_of(endpoint)
        return self.connectable and (on is None or not on.connection)


class Terms(msgspec.Struct, frozen=True, kw_only=True):
    """What a system's data layer is made under.

    Attributes:
        fixed: every port is planned, and nothing is found by multicast.
        server: the discovery server that every connection must know; None without.
        server_medium: it listens on TCPV4 or UDPV4.
        first_port: first of the ports given out, per host.
        taken: by host, ports that are not given out.
        multicast_group: first of the groups given out.
        max_datagram_bytes: UDP payload that the path carries unfragmented; None assumes Ethernet.
        observers: where the supervisors' observers are reached: every connection looks for them.
    """

    fixed: bool = False
    server: Peer | None = None
    server_medium: Medium = DEFAULT_TCP
    first_port: int = 7910
    taken: Mapping[str, Collection[int]] = msgspec.field(default_factory=dict)
    multicast_group: str = "239.255.1.1"
    max_datagram_bytes: int | None = None
    observers: tuple[Contact, ...] = ()


class NegotiatedFlow(msgspec.Struct, frozen=True, kw_only=True, order=True):
    """What carries one topic from one node to another, or why nothing does.

    Attributes:
        publisher: key of the publishing party.
        subscription: key of the subscribing party.
        medium: as `PlannedFlow.medium`; empty where the RMW decides and it is not known, and where
            nothing carries it.
        reason: one phrase for people.
        problem: why it cannot be carried, a sentence; empty if it can.
        hint: what may help.
    """

    topic: str
    publisher: str
    subscription: str
    medium: str = ""
    reason: str = ""
    problem: str = ""
    hint: str = ""


class NegotiatedConnection(msgspec.Struct, frozen=True, kw_only=True):
    """One connection that a node must have because its own participant does not do it.

    Attributes:
        node: key of the party.
        name: unique in the node.
        urls: the arguments of `connect_to`.
        map: the endpoints that it carries, `publishers/video`, sorted.
        reason: one phrase for people.
    """

    node: str
    name: str
    urls: tuple[str, ...]
    map: tuple[str, ...]
    reason: str


class DataLayerGraph(msgspec.Struct, frozen=True, kw_only=True):
    """Everything that was negotiated; sorted throughout. `problems` are what nothing carries."""

    flows: tuple[NegotiatedFlow, ...] = ()
    connections: tuple[NegotiatedConnection, ...] = ()
    problems: tuple[NegotiatedFlow, ...] = ()


def transports_of(urls: Iterable[str]) -> tuple[str, ...]:
    """Return the transports of a participant with these URLs; a group as `udpm@ADDRESS:PORT`."""
    return tuple(
        dict.fromkeys(
            f"{url.transport}@{url.address}:{url.port}" if url.transport.is_group else url.transport
            for url in map(parse, urls)
        )
    )


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
    """Return a node without negotiated participants as a party, from its manifest alone.

    `variables` are what a COMMAND node's process gets beside its own.
    """
    host = hosts.host(node.machine)
    known = rmw.startswith(FAST_DDS)
    ours = node.run.kind is RunKind.PYTHON and known
    own = transports_of(node.connections.urls) or node.transports or _by_variable(node, variables)
    return Party(
        key=node.key,
        host=host,
        process=node.process,
        transports=CONNECTABLE if ours else own if known else (),
        own=own if known else (),
        connectable=ours,
        endpoints=tuple(each for each in node.endpoints if each.kind.is_topic),
        participants=node.participants,
        contacts=contacts_of(host, node.connections.urls),
    )


def _by_variable(node: PlannedNode, variables: Mapping[str, str]) -> tuple[str, ...]:
    """Return the transports that variables give a node; () for any other value."""
    environment = dict(node.run.environment)
    if node.run.kind is RunKind.COMMAND:
        environment = {**variables, **environment}
    word = environment.get(TRANSPORTS_VARIABLE, "").partition("?")[0]
    return BUILTIN_TRANSPORTS.get(word or "DEFAULT", ())


def rmw_of(node: PlannedNode, plan: Plan) -> str:
    """Return the RMW identifier that a node of a plan runs with."""
    return dict(node.run.environment).get("RMW_IMPLEMENTATION", "") or plan.rmw


def terms_of(plan: Plan) -> Terms:
    """Return what the nodes of a plan can negotiate under, whatever they have negotiated so far."""
    hosts, server = Hosts.of(plan), plan.server
    observers = {hosts.host(machine): each for machine, each in plan.observers}
    taken = written_ports(plan, hosts)
    for host, each in observers.items():
        taken.setdefault(host, set()).update(ports_of(parse(text) for text in each.urls))
    if server is not None:
        taken.setdefault(hosts.host(server.machine), set()).add(server.port)
    return Terms(
        fixed=is_fixed(plan.discovery),
        server=None if server is None else Peer(address=server.address, port=server.port),
        server_medium=DEFAULT_TCP if server is None or server.tcp else RMW_DISCOVERY,
        first_port=plan.discovery.first_port,
        taken=taken,
        multicast_group=plan.data_layer.multicast_group,
        max_datagram_bytes=plan.network.max_datagram_bytes,
        observers=tuple(
            contact for host, each in observers.items() for contact in contacts_of(host, each.urls)
        ),
    )


def written_ports(plan: Plan, hosts: Hosts) -> dict[str, set[int]]:
    """Return the ports of each host that URLs name, and those that a domain uses by itself."""
    base = domain_base(plan.domain_id)
    dynamic = plan.discovery.mode is DiscoveryMode.DYNAMIC
    taken = {host: set(range(base, base + DG)) if dynamic else set() for host in hosts.used}
    for node in plan.nodes:
        ports = taken.setdefault(hosts.host(node.machine), set())
        ports.update(ports_of(parse(text) for text in urls_of(node)))
    return taken


def urls_of(node: PlannedNode) -> Iterable[str]:
    """Return every connection URL of a node: its own participant's and all others'."""
    yield from node.connections.urls
    for each in node.participants:
        yield from each.connections.urls
