"""Negotiate transports and connections: node configurations, placement, hints → data layer graph.

A node gets a connection only where its own participant would not carry the data anyway, and as few
as carry its endpoints. What exists already keeps its name and, while its transports are the same,
its URLs. Deterministic, and independent of the order of the parties: equal systems have equal
names, ports and groups. Pure.
"""

from __future__ import annotations

import ipaddress
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence

import msgspec
from msgspec.structs import replace

from lifecycle.manifest.model import EndpointKind, FlowTransport
from lifecycle.manifest.names import free_name
from lifecycle.network.connection_url import ConnectionUrl, parse
from lifecycle.network.medium import CONNECTABLE, LOOPBACK, UDP_UNICAST, Medium, medium_of
from lifecycle.plan.discovery import Contact, PortPool, contacts_of, fixed_url, peers_by, ports_of
from lifecycle.plan.media import (
    MEETING,
    DataLayerGraph,
    End,
    NegotiatedConnection,
    Pair,
    Party,
    Terms,
    Unconnectable,
    carried,
    choose,
    discover,
)
from lifecycle.plan.model import PlanError, PlannedEndpoint, PlannedFlow

Wishes = Mapping[tuple[str, str, str], FlowTransport]
"""What links demand: (topic, key of the publishing party, key of the subscribing one)."""


def negotiate(
    parties: Sequence[Party],
    wishes: Wishes,
    terms: Terms,
    *,
    before: DataLayerGraph | None = None,
) -> DataLayerGraph:
    """Choose how data get from every publisher to every subscription of its topic.

    The rules are in `media.py`. What cannot be made is a problem; everything else is negotiated all
    the same. Of what is there `before`, connections that still fit keep their names, ports, groups
    and URLs, so that little is made anew.
    """
    pairs = tuple(_pairs(sorted(parties, key=lambda each: each.key), wishes))
    chosen, problems = _choices(pairs, terms)
    carriers = _Carriers([each for each in chosen if each[1].medium], terms)
    flows = [*carriers.settle(problems), *(flow for _, flow in chosen if not flow.medium)]
    return DataLayerGraph(
        flows=tuple(sorted(dict.fromkeys(flows), key=_ends)),
        connections=connections_of(tuple(carriers.moved()), parties, terms, before=before),
        problems=tuple(sorted(problems, key=lambda each: _ends(each.flow))),
    )


def _ends(flow: PlannedFlow) -> tuple[str, str, str]:
    return flow.topic, flow.publisher, flow.subscription


def _pairs(parties: Sequence[Party], wishes: Wishes) -> Iterator[Pair]:
    readers: dict[str, list[tuple[Party, PlannedEndpoint]]] = {}
    for party in parties:
        for each in _sorted(party, EndpointKind.SUBSCRIPTION):
            readers.setdefault(each.resolved, []).append((party, each))
    for party in parties:
        for writer in _sorted(party, EndpointKind.PUBLISHER):
            for other, reader in readers.get(writer.resolved, ()):
                yield Pair(
                    publisher=party,
                    writer=writer,
                    subscription=other,
                    reader=reader,
                    link=wishes.get((writer.resolved, party.key, other.key), FlowTransport.ANY),
                )


def _sorted(party: Party, kind: EndpointKind) -> list[PlannedEndpoint]:
    found = [each for each in party.endpoints if each.kind is kind]
    return sorted(found, key=lambda each: (each.resolved, each.name))


def _choices(
    pairs: Sequence[Pair], terms: Terms
) -> tuple[list[tuple[Pair, PlannedFlow]], list[Unconnectable]]:
    """Choose on each host first: whether a publisher uses a group decides what others can have."""
    listeners: dict[End, set[str]] = {}
    for pair in pairs:
        if pair.same_host and not pair.same_process:
            listeners.setdefault(pair.ends[0], set()).add(pair.subscription.process)
    by_group: set[End] = set()
    found: dict[int, tuple[Pair, PlannedFlow]] = {}
    problems: list[Unconnectable] = []
    for index, pair in sorted(enumerate(pairs), key=lambda each: not each[1].same_host):
        writer = pair.ends[0]
        flow = choose(
            pair,
            by_multicast=writer in by_group,
            listeners=len(listeners.get(writer, ())),
            max_datagram_bytes=terms.max_datagram_bytes,
        )
        if isinstance(flow, Unconnectable):
            problems.append(flow)
            continue
        found[index] = pair, flow
        if flow.medium == Medium.UDPM:
            by_group.add(writer)
    return [found[index] for index in sorted(found)], problems


_INTRODUCING = tuple(each for each in CONNECTABLE if each.is_network and not each.is_group)
"""By what a connection beside shared memory can be discovered."""

_ONE_TRANSPORT = "ask for one transport for all that these two endpoints talk to"


class _Carriers:
    """Which endpoints leave their own participant, and for what.

    An endpoint moves only when a pair of its gets another medium than was chosen: the publisher
    first, then the subscription. What moves takes all its media along.
    """

    def __init__(self, chosen: Sequence[tuple[Pair, PlannedFlow]], terms: Terms) -> None:
        self._fixed = terms.fixed
        self._served = terms.server is not None
        self._chosen = chosen
        self._moved: dict[End, set[str]] = {}
        self._sides: dict[End, tuple[Party, PlannedEndpoint]] = {}
        self._needs: dict[End, set[str]] = {}
        for pair, flow in chosen:
            # A topic has a group of its own.
            token = f"{flow.medium}@{flow.topic}" if flow.medium == Medium.UDPM else flow.medium
            sides = ((pair.publisher, pair.writer), (pair.subscription, pair.reader))
            for end, side in zip(pair.ends, sides, strict=True):
                self._sides[end] = side
                self._needs.setdefault(end, set()).update(
                    () if flow.medium == Medium.INTRAPROCESS else (token,)
                )

    def settle(self, problems: list[Unconnectable]) -> list[PlannedFlow]:
        """Move endpoints until every pair has its medium; return flows, and add what has it not."""
        # A pair that held may not do so any more after others have moved.
        changed = 1
        while changed:
            changed = sum(self._move(*each) for each in self._chosen if not self._holds(*each))
        flows = []
        for pair, flow in self._chosen:
            flows.append(flow)
            impossible = any(map(self._is_impossible, pair.ends))
            if self._holds(pair, flow) and not impossible:
                continue
            ours = pair.publisher.connectable and pair.subscription.connectable
            if pair.wish[0] is FlowTransport.NETWORK and not ours:
                # `lifecycle check` has warned; from outside it may have been seen to.
                flows[-1] = pair.by("", "its participant is not ours")
            elif impossible:
                why = (
                    "an end of it also needs another of shared memory and UDP, and beside fixed "
                    "ports Fast DDS does not listen to shared memory"
                )
                problems.append(pair.problem(f" by {flow.medium}", why, _ONE_TRANSPORT))
            else:
                problems.append(self._conflict(pair, flow))
        return flows

    def moved(self) -> Iterator[Moved]:
        """Yield the endpoints that have moved, with those whom each connection must find."""
        partners: dict[End, set[End]] = {}
        for pair, _ in self._chosen if self._moved else ():
            for end, other in (pair.ends, pair.ends[::-1]):
                partners.setdefault(end, set()).add(other)
        for end in sorted(self._moved, key=lambda each: (each[0], each[1].value, each[2])):
            party, endpoint = self._sides[end]
            yield Moved(
                end=end,
                party=party,
                endpoint=endpoint,
                transports=tuple(sorted(self._moved[end])),
                partners=frozenset(partners.get(end, ())),
            )

    def _is_impossible(self, end: End) -> bool:
        """Whether an endpoint's connection would need shared memory beside fixed UDP ports."""
        found = self._moved.get(end, set())
        in_memory = any(not medium_of(each).is_network for each in found)
        return self._fixed and in_memory and bool({*UDP_UNICAST} & found)

    def _transports(self, end: End) -> set[str]:
        party, endpoint = self._sides[end]
        return self._moved.get(end) or {*party.transports_at(endpoint)}

    def _present(self, pair: Pair) -> list[Medium]:
        writer, reader = map(self._transports, pair.ends)
        return carried(writer, reader, same_host=pair.same_host)

    def _holds(self, pair: Pair, flow: PlannedFlow) -> bool:
        present = self._present(pair)
        # Inside a process it is enough that the participants find each other.
        if flow.medium == Medium.INTRAPROCESS:
            return bool(present)
        meet = self._served or not pair.same_host or discover(*map(self._transports, pair.ends))
        return present == [flow.medium] and meet

    def _move(self, pair: Pair, flow: PlannedFlow) -> bool:
        if self._present(pair) == [flow.medium] and self._introduce(pair):
            return True
        for end in pair.ends:
            if end in self._moved:
                if flow.medium == Medium.INTRAPROCESS and MEETING not in self._moved[end]:
                    self._moved[end].add(MEETING)
                    return True
                continue
            party, endpoint = self._sides[end]
            if party.may_move(endpoint) and self._needs[end]:
                # A group on loopback also receives by unicast.
                groups = {medium_of(each) for each in self._needs[end]}
                unicast = {each.unicast for each in groups if each.is_group}
                self._moved[end] = self._needs[end] - unicast
                return True
        return False

    def _introduce(self, pair: Pair) -> bool:
        """Give an end that has moved by what the other one discovers participants."""
        for end, other in (pair.ends, pair.ends[::-1]):
            known = self._transports(other)
            medium = next((each for each in _INTRODUCING if each in known), None)
            if end in self._moved and medium is not None:
                self._moved[end].add(medium)
                return True
        return False

    def _conflict(self, pair: Pair, flow: PlannedFlow) -> Unconnectable:
        present = self._present(pair)
        one, other = (", ".join(sorted(self._transports(end))) or "none" for end in pair.ends)
        happens = "it would not arrive"
        if present == [flow.medium]:
            happens = "they would not discover each other"
        elif present:
            twice = ", twice" if len(present) > 1 else ""
            happens = f"it would go by {' and '.join(present)}{twice}"
        wish, who = pair.wish
        asked = f", as {who}" if wish is not FlowTransport.ANY else ""
        return pair.problem(
            f" by {flow.medium}{asked}",
            f"the publisher's participant has {one}, the subscription's {other}, so {happens}",
            _ONE_TRANSPORT,
        )


GROUP_PORTS_FROM = 1000
"""How far above `first_port` the ports of groups begin: out of the way of participants' own."""

_NOT_WORD = re.compile(r"[^A-Za-z0-9]+")


class Moved(msgspec.Struct, frozen=True, kw_only=True):
    """One endpoint that must leave its node's own participant.

    Attributes:
        transports: what its connection must have, sorted; a group is `udpm@/topic`.
        partners: all that it exchanges data with.
    """

    end: End
    party: Party
    endpoint: PlannedEndpoint
    transports: tuple[str, ...]
    partners: frozenset[End]

    @property
    def label(self) -> str:
        """How `map_to` knows it, `publishers/video`."""
        return self.endpoint.kind.spell(self.endpoint.name)

    @property
    def alone(self) -> str:
        """Its label if it shares its participant with no other; else empty."""
        alone = self.endpoint.kind is EndpointKind.PUBLISHER and self.endpoint.unique.asks
        return self.label if alone else ""

    @property
    def media(self) -> list[Medium]:
        """What its connection has."""
        plain = {each.partition("@")[0] for each in self.transports}
        return [each for each in Medium if each in plain]

    @property
    def group(self) -> str:
        """The topic of the group of its connection; empty without."""
        return next((each.partition("@")[2] for each in self.transports if "@" in each), "")


_Place = tuple[str, str]
"""A connection: key of its party, and its name."""

_Drafts = Mapping[_Place, Sequence[Moved]]
"""What each connection carries: all of one party, with the same transports; sorted."""

_Urls = Mapping[_Place, tuple[ConnectionUrl, ...]]


def connections_of(
    moved: Sequence[Moved],
    parties: Sequence[Party],
    terms: Terms,
    *,
    before: DataLayerGraph | None = None,
) -> tuple[NegotiatedConnection, ...]:
    """Return the connections that carry these endpoints, sorted by node and name.

    Raises:
        PlanError: there are not enough ports or groups.
    """
    drafts = _drafts(moved)
    old = {(each.node, each.name): each for each in before.connections} if before else {}
    kept: _Urls = {
        place: tuple(map(parse, old[place].urls))
        for place, (first, *_) in drafts.items()
        if place in old and {text.partition(":")[0] for text in old[place].urls} == {*first.media}
    }
    bare: _Urls = {**kept, **_with_ports(drafts, kept, terms)}
    carriers = {each.end: place for place, members in drafts.items() for each in members}
    own_contacts = {each.key: each.contacts for each in parties}

    def contacts(place: _Place) -> Iterator[Contact]:
        """Yield observers, and those whom the connection exchanges data with.

        Of two that are new the subscribing one looks for the other, so that one TCP connection is
        made and not two; of a new one and one that is there, the new one does.
        """
        yield from terms.observers
        for member in drafts[place]:
            publishes = member.endpoint.kind is EndpointKind.PUBLISHER
            for partner in member.partners:
                other = carriers.get(partner)
                if other is None:
                    yield from own_contacts[partner[0]]
                elif other != place and (not publishes or other in kept):
                    yield from contacts_of(drafts[other][0].party.host, map(str, bare[other]))

    def looking(url: ConnectionUrl, found: Iterable[Contact], host: str) -> ConnectionUrl:
        if terms.server is not None:
            served = url.transport is terms.server_medium
            return replace(url, server=(terms.server,) if served else ())
        if url.transport.is_network and (terms.fixed or url.transport.is_tcp):
            return replace(url, peers=peers_by(url.transport, found, host=host))
        return url

    def urls(place: _Place) -> tuple[str, ...]:
        if place in kept:
            return old[place].urls
        found, host = tuple(contacts(place)), drafts[place][0].party.host
        return tuple(str(looking(url, found, host)) for url in bare[place])

    return tuple(
        NegotiatedConnection(
            node=place[0],
            name=place[1],
            urls=urls(place),
            map=tuple(sorted(each.label for each in members)),
            reason=f"{', '.join(dict.fromkeys(each.endpoint.resolved for each in members))} "
            f"by {' and '.join(members[0].media)}",
        )
        for place, members in drafts.items()
    )


def _drafts(moved: Sequence[Moved]) -> _Drafts:
    """Group endpoints that may share a participant, and name each group by what it is.

    Names are `tcpv4`, `udpm_tcpv4_video`, `udpv4_publishers_video`.
    """
    groups: dict[tuple[str, tuple[str, ...], str, str], list[Moved]] = {}
    for each in moved:
        place = (each.party.key, each.transports, each.endpoint.participant, each.alone)
        groups.setdefault(place, []).append(each)
    drafts: dict[_Place, list[Moved]] = {}
    for (key, _, participant, alone), members in sorted(groups.items()):
        words = [*map(str, members[0].media)]
        words += [
            _NOT_WORD.sub("_", each).strip("_")
            for each in (members[0].group, participant, alone)
            if each
        ]
        taken = {each.connection for each in members[0].party.participants}
        taken |= {name for node, name in drafts if node == key}
        drafts[key, free_name("_".join(words), taken)] = members
    return dict(sorted(drafts.items()))


def _with_ports(drafts: _Drafts, kept: _Urls, terms: Terms) -> _Urls:
    """Return the URLs of new connections with ports and groups of their own, without peers."""
    pool = PortPool(terms.first_port, terms.taken)
    firsts = {place: members[0] for place, members in drafts.items()}
    hosts = sorted({each.party.host for each in firsts.values()})
    groups: dict[str, ConnectionUrl] = {}
    for place, urls in kept.items():
        for port in ports_of(urls):
            pool.reserve((firsts[place].party.host,), port)
        for url in urls:
            if url.transport.is_group:
                groups.setdefault(firsts[place].group, url)
    for url in groups.values():
        if url.port is not None:
            pool.reserve(hosts, url.port)
    for topic in sorted({each.group for each in firsts.values()} - {"", *groups}):
        groups[topic] = ConnectionUrl(
            transport=Medium.UDPM,
            address=_new_group({url.address for url in groups.values()}, terms.multicast_group),
            port=pool.take_everywhere(hosts, min(terms.first_port + GROUP_PORTS_FROM, 65535)),
            ttl=0,
            interfaces=(LOOPBACK,),
        )
    return {
        place: tuple(_bare(first, groups.get(first.group), pool, terms))
        for place, first in firsts.items()
        if place not in kept
    }


def _new_group(used: set[str], lowest: str) -> str:
    first = ipaddress.IPv4Address(lowest)
    group = ""
    if int(first) + len(used) < 2**32:
        free = (str(first + step) for step in range(len(used) + 1))
        group = next(each for each in free if each not in used)
    if not group or not ipaddress.IPv4Address(group).is_multicast:
        raise PlanError(
            f"cannot give out {len(used) + 1} multicast groups from {lowest}: the highest is "
            "239.255.255.255",
            hint="lower 'data_layer.multicast_group'",
        )
    return group


def _bare(
    first: Moved, group: ConnectionUrl | None, pool: PortPool, terms: Terms
) -> Iterator[ConnectionUrl]:
    host = first.party.host
    for transport in first.media:
        other_version = (":" in host) != (transport.ip_version == 6)
        address = transport.loopback if other_version else host or transport.loopback
        if not transport.is_network:
            yield ConnectionUrl(transport=transport)
        elif transport.is_group:
            assert group is not None
            if not terms.fixed:
                yield replace(group, metatraffic_port=None, peers=(), multicast=True)
                continue
            (port,) = pool.take(host)
            yield replace(group, metatraffic_port=port, peers=(), multicast=False)
        elif transport.is_tcp or terms.fixed:
            yield fixed_url(transport, address, pool.take(host, transport.ports))
        else:
            # Each sample would go twice to IPv6's global and link-local addresses.
            own = host if transport.ip_version == 6 and ":" in host else ""
            yield ConnectionUrl(transport=transport, address=own)
    if terms.server is not None and terms.server_medium not in first.media:
        yield ConnectionUrl(transport=terms.server_medium)
