"""Which transport carries a publisher → subscription pair: the rules of negotiation for one pair.

The first rule that applies decides; what both ends cannot have is a problem with its reason.

1.  Asked for, by a link, else the publisher, else the subscription: that, if both ends can have it.
    Inside a process only `shm` and `multicast` can be asked for, and are handed over directly.
    `multicast` to another host is TCP; `network` is what is there if that is one IP transport, else
    UDP before TCP, IPv6 first where a host has an IPv6 address.
2.  One process: handed over inside it.
3.  An end whose transports are not known: its RMW chooses.
4.  One host: what is there anyway if that is one transport; shared memory; one datagram to a group
    (TTL 0, loopback) where several processes listen; UDP, TCP.
5.  Two hosts: TCP if the publisher sends to a group, which stays on its host, or if the data may
    not be lost and are more than one datagram; else what is there anyway, UDP, TCP.

An end that asked for something else than what was chosen, where no link decides, is a problem.
Parties and terms are made of a plan, before anything runs and while it does. Pure.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from types import MappingProxyType

import msgspec

from lifecycle.manifest.diagnostics import Diagnostic, error
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
    is_fragmented,
)
from lifecycle.network.ports import DG, domain_base
from lifecycle.plan.discovery import Contact, Hosts, contacts_of, is_fixed, ports_of
from lifecycle.plan.model import (
    Plan,
    PlannedEndpoint,
    PlannedFlow,
    PlannedNode,
    PlannedParticipant,
)

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


class Unconnectable(msgspec.Struct, frozen=True, kw_only=True):
    """What nothing carries, and why, at its publisher."""

    flow: PlannedFlow
    why: Diagnostic


Choice = PlannedFlow | Unconnectable


class DataLayerGraph(msgspec.Struct, frozen=True, kw_only=True):
    """Everything that was negotiated; sorted throughout."""

    flows: tuple[PlannedFlow, ...] = ()
    connections: tuple[NegotiatedConnection, ...] = ()
    problems: tuple[Unconnectable, ...] = ()


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


class Pair(msgspec.Struct, frozen=True, kw_only=True):
    """A publisher and a subscription of one topic, and what a link demands for them."""

    publisher: Party
    writer: PlannedEndpoint
    subscription: Party
    reader: PlannedEndpoint
    link: FlowTransport = FlowTransport.ANY

    @property
    def ends(self) -> tuple[End, End]:
        """The publisher and the subscription, as keys."""
        return (
            (self.publisher.key, EndpointKind.PUBLISHER, self.writer.name),
            (self.subscription.key, EndpointKind.SUBSCRIPTION, self.reader.name),
        )

    @property
    def same_host(self) -> bool:
        """Whether both are on one host."""
        return self.publisher.host == self.subscription.host

    @property
    def same_process(self) -> bool:
        """Whether both are in one process."""
        return self.same_host and self.publisher.process == self.subscription.process

    @property
    def common(self) -> set[str]:
        """Media that both ends can have."""
        both = {*_able(self.publisher)} & {*_able(self.subscription)}
        if not self.same_host:
            hosts = {self.publisher.host, self.subscription.host} - {""}
            versions = {6 if ":" in each else 4 for each in hosts}
            both -= {each for each in Medium if each.stays_on_host or versions - {each.ip_version}}
        return both

    @property
    def wish(self) -> tuple[FlowTransport, str]:
        """What is asked for, and who asks: a link, else the publisher, else the subscription."""
        for wish, who in (
            (self.link, "a link says so"),
            (self.writer.transport, "the publisher asks for it"),
            (self.reader.transport, "the subscription asks for it"),
        ):
            if wish is not FlowTransport.ANY:
                return wish, who
        return FlowTransport.ANY, ""

    def by(self, medium: str, reason: str) -> PlannedFlow:
        """Return the flow between the two by this medium."""
        return PlannedFlow(
            topic=self.writer.resolved,
            publisher=self.publisher.key,
            subscription=self.subscription.key,
            medium=medium,
            medium_reason=reason,
        )

    def problem(self, how: str, why: str, hint: str = "") -> Unconnectable:
        """Return that nothing carries the flow `how` it was asked for, ` by tcpv4`, and why."""
        ends = f"from {self.publisher.key!r} to {self.subscription.key!r}"
        message = f"cannot carry {self.writer.resolved!r} {ends}{how}: {why}"
        why_not = error("plan.unconnectable", self.writer.at, message, hint)
        return Unconnectable(flow=self.by("", ""), why=why_not)


MEETING = Medium.SHM
"""By what participants of one process find each other, if they have nothing else in common."""


def carried(writer: Collection[str], reader: Collection[str], *, same_host: bool) -> list[Medium]:
    """Return by what Fast DDS 2.14 sends from a participant with some transports to another.

    Shared memory wins on one host. Of IP transports all that are common carry every sample, so
    more than one means that it arrives twice; none, that they never meet.

    Args:
        writer: transports of one participant, values of Medium; a group is
            `udpm@239.255.1.9:7901`.
        reader: of the other one.
        same_host: whether they share memory and loopback.
    """
    common = _unicast(writer, same_host=same_host) & _unicast(reader, same_host=same_host)
    found = {each for each in common if each.is_network}
    if same_host and found != common:
        return sorted(common - found)
    if same_host:
        for group in (each for each in CONNECTABLE if each.is_group):
            if any(each.startswith(group) for each in {*writer} & {*reader}):
                found = {*found - {group.unicast}, group}
    return sorted(found)


def discover(one: Collection[str], other: Collection[str]) -> bool:
    """Return whether two participants of one host discover each other without a server.

    Fast DDS 2.14 announces participants by shared memory only where they have nothing else
    (`fastdds.shm.enforce_metatraffic`, by default `none`).
    """
    networks = [
        {each for each in _unicast(transports, same_host=True) if each.is_network}
        for transports in (one, other)
    ]
    return bool(networks[0] & networks[1]) or not any(networks)


def _unicast(transports: Collection[str], *, same_host: bool) -> set[Medium]:
    """Return by what a participant receives what is sent to it alone.

    A group with TTL 0 also receives what is sent to loopback by unicast.
    """
    words = {each.partition("@")[0] for each in transports}
    return {
        each.unicast for each in CONNECTABLE if each in words and (same_host or not each.is_group)
    }


def choose(
    pair: Pair, *, by_multicast: bool, listeners: int, max_datagram_bytes: int | None
) -> Choice:
    """Return what carries a pair.

    Args:
        pair: a publisher and a subscription.
        by_multicast: another subscription of this publisher gets its data from a group.
        listeners: processes of the publisher's host, but its own, that subscribe to the topic.
        max_datagram_bytes: UDP payload that the path carries unfragmented; None assumes Ethernet.
    """
    wish, who = pair.wish
    if pair.same_process:
        if wish in (FlowTransport.ANY, FlowTransport.SHM, FlowTransport.MULTICAST):
            return pair.by(Medium.INTRAPROCESS, "same process")
        return pair.problem(
            f" by {wish.value}",
            f"both are in process {pair.publisher.process!r}, and inside a process no transport is "
            "used",
            "give one of the two another 'process:'",
        )
    if wish is not FlowTransport.ANY:
        choice = _asked(pair, wish, who, by_multicast=by_multicast)
    elif not (pair.publisher.own and pair.subscription.own):
        return pair.by("", "its RMW chooses")
    elif pair.same_host:
        choice = _near(pair, listeners)
    else:
        choice = _far(pair, by_multicast=by_multicast, max_datagram_bytes=max_datagram_bytes)
    if isinstance(choice, Unconnectable):
        return choice
    other = pair.reader.transport
    if pair.link is FlowTransport.ANY and choice.medium and not other.accepts(choice.medium):
        return pair.problem(
            "",
            f"the publisher asks for {pair.writer.transport.value}, the subscription for "
            f"{other.value}",
            "ask for the same at both ends, or let a link decide with 'transport:'",
        )
    return choice


def _list(words: Iterable[str]) -> str:
    return ", ".join(words) or "none"


def _none_common(pair: Pair, how: str = "") -> Unconnectable:
    one, other = pair.publisher, pair.subscription
    hint = (
        f"shared memory does not leave a host, and an IP transport needs addresses of its version: "
        f"{one.host or 'this host'} and {other.host or 'this host'}"
    )
    return pair.problem(
        how,
        f"{one.key!r} can be connected by {_list(_able(one))}; {other.key!r} by "
        f"{_list(_able(other))}",
        "" if pair.same_host else hint,
    )


def _able(party: Party) -> tuple[str, ...]:
    return party.transports if party.connectable else party.own


def _asked(pair: Pair, wish: FlowTransport, who: str, *, by_multicast: bool) -> Choice:
    if wish is FlowTransport.NETWORK:
        default = _default(pair)
        medium = default if default in wish.media else _first_ip(pair)
        return pair.by(medium, who) if medium else _none_common(pair, " by the network")
    if wish is FlowTransport.MULTICAST and not pair.same_host:
        wish, who = FlowTransport.TCPV4, "multicast stays on its host"
    (medium,) = wish.media
    if medium not in pair.common:
        return _none_common(pair, f" by {wish.value}, as {who}")
    if by_multicast and not pair.same_host and medium is Medium.UDPV4:
        return pair.problem(
            " by udpv4",
            "the publisher sends by multicast with TTL 0 on its own host, and one participant has "
            "one TTL for UDP",
            "let it go by tcpv4",
        )
    return pair.by(medium, who)


def _first_ip(pair: Pair) -> str:
    """Return the first IP transport that both can have: UDP before TCP; empty for none."""
    ipv6 = ":" in pair.publisher.host or ":" in pair.subscription.host
    common = pair.common
    ip = [each for each in CONNECTABLE if each.is_network and not each.is_group and each in common]
    return min(ip, key=lambda each: (each.is_tcp, (each.ip_version == 6) is not ipv6), default="")


def _default(pair: Pair) -> str:
    """Return what carries the pair anyway; empty if that is nothing, or arrives twice."""
    present = carried(
        pair.publisher.transports_at(pair.writer),
        pair.subscription.transports_at(pair.reader),
        same_host=pair.same_host,
    )
    return present[0] if len(present) == 1 else ""


def _near(pair: Pair, listeners: int) -> Choice:
    """Choose on one host: what is there anyway, shared memory, one datagram for all, unicast."""
    default, common = _default(pair), pair.common
    if default or Medium.SHM in common:
        return pair.by(default or Medium.SHM, "same host")
    if listeners > 1 and Medium.UDPM in common:
        reason = f"{listeners} processes of the host listen, and not by shared memory"
        return pair.by(Medium.UDPM, reason)
    medium = _first_ip(pair)
    if medium:
        return pair.by(medium, "same host, and no common shared memory")
    return _none_common(pair)


def _far(pair: Pair, *, by_multicast: bool, max_datagram_bytes: int | None) -> Choice:
    """Choose between hosts: TCP where UDP would not do, what is there anyway, UDP, TCP."""
    default = _default(pair)
    tcp = "multicast stays on its host" if by_multicast else _too_large(pair, max_datagram_bytes)
    if tcp and Medium.TCPV4 in {*pair.common, default}:
        return pair.by(Medium.TCPV4, tcp)
    if by_multicast:
        return _none_common(pair, " by tcpv4, as multicast stays on its host")
    medium = default or _first_ip(pair)
    if not medium:
        return _none_common(pair)
    usual = medium in (default, Medium.UDPV4)
    return pair.by(medium, "other host" if usual else "other host, and no UDP over IPv4 between")


def _too_large(pair: Pair, max_datagram_bytes: int | None) -> str:
    """Return why data may not be lost, and would be if one fragment was; empty if they may.

    Either end can deny that the data bear an unreliable transport.
    """
    size = pair.writer.max_message_size
    denied = False in (pair.writer.lossy, pair.reader.lossy)
    if denied and size is not None and is_fragmented(size, pair.publisher.host, max_datagram_bytes):
        return f"not lossy, and {size} bytes are more than one datagram"
    return ""
