"""Connections for endpoints that leave their node's own participant: names, ports, groups, URLs.

Owns: `connections_of`, as few connections as carry the endpoints. What exists already keeps its
name and, while its transports are the same, its URLs. Ports and groups are given out in the order
of nodes and connections, so that equal systems have equal ones. Pure.
"""

from __future__ import annotations

import ipaddress
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence

import msgspec
from msgspec.structs import replace

from lifecycle.manifest.model import EndpointKind
from lifecycle.manifest.names import free_name
from lifecycle.network.connection_url import ConnectionUrl, parse
from lifecycle.network.medium import LOOPBACK, Medium
from lifecycle.plan.connections.hosts import (
    Contact,
    PortPool,
    contacts_of,
    fixed_url,
    peers_by,
    ports_of,
)
from lifecycle.plan.model import PlanError, PlannedEndpoint
from lifecycle.plan.negotiation.parties import (
    DataLayerGraph,
    End,
    NegotiatedConnection,
    Party,
    Terms,
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


class _Draft(msgspec.Struct, frozen=True, kw_only=True):
    """A connection that has no URLs yet; `topic` is that of its group, empty without."""

    party: Party
    name: str
    transports: tuple[str, ...]
    members: tuple[Moved, ...]

    @property
    def key(self) -> tuple[str, str]:
        return self.party.key, self.name

    @property
    def media(self) -> list[Medium]:
        plain = {each.partition("@")[0] for each in self.transports}
        return [each for each in Medium if each in plain]

    @property
    def topic(self) -> str:
        return next((each.partition("@")[2] for each in self.transports if "@" in each), "")


_Urls = Mapping[tuple[str, str], tuple[ConnectionUrl, ...]]


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
        draft.key: tuple(map(parse, old[draft.key].urls))
        for draft in drafts
        if draft.key in old
        and {text.partition(":")[0] for text in old[draft.key].urls} == {*draft.media}
    }
    bare: _Urls = {**kept, **_with_ports(drafts, kept, terms)}
    return tuple(
        NegotiatedConnection(
            node=draft.party.key,
            name=draft.name,
            urls=old[draft.key].urls if draft.key in kept else urls,
            map=tuple(sorted(each.label for each in draft.members)),
            reason=f"{', '.join(dict.fromkeys(each.endpoint.resolved for each in draft.members))} "
            f"by {' and '.join(draft.media)}",
        )
        for draft, urls in _with_peers(drafts, bare, kept, parties, terms)
    )


def _drafts(moved: Sequence[Moved]) -> list[_Draft]:
    """Group endpoints that may share a participant, and name each group by what it is.

    Names are `tcpv4`, `udpm_tcpv4_video`, `udpv4_publishers_video`.
    """
    groups: dict[tuple[str, tuple[str, ...], str, str], list[Moved]] = {}
    for each in moved:
        place = (each.party.key, each.transports, each.endpoint.participant, each.alone)
        groups.setdefault(place, []).append(each)
    drafts = []
    taken: dict[str, set[str]] = {}
    for (key, transports, group, alone), members in sorted(groups.items()):
        party = members[0].party
        draft = _Draft(party=party, name="", transports=transports, members=tuple(members))
        words = [*map(str, draft.media)]
        words += [
            _NOT_WORD.sub("_", each).strip("_") for each in (draft.topic, group, alone) if each
        ]
        names = taken.setdefault(key, {each.connection for each in party.participants})
        name = free_name("_".join(words), names)
        names.add(name)
        drafts.append(replace(draft, name=name))
    return sorted(drafts, key=lambda each: each.key)


def _with_ports(drafts: Sequence[_Draft], kept: _Urls, terms: Terms) -> _Urls:
    """Return the URLs of new connections with ports and groups of their own, without peers."""
    pool = PortPool(terms.first_port, terms.taken)
    hosts = sorted({each.party.host for each in drafts})
    groups: dict[str, ConnectionUrl] = {}
    for draft in drafts:
        for url in kept.get(draft.key, ()):
            for port in ports_of([url]):
                pool.reserve((draft.party.host,), port)
            if url.transport.is_group:
                groups.setdefault(draft.topic, url)
    for url in groups.values():
        if url.port is not None:
            pool.reserve(hosts, url.port)
    for topic in sorted({each.topic for each in drafts} - {"", *groups}):
        groups[topic] = ConnectionUrl(
            transport=Medium.UDPM,
            address=_new_group({url.address for url in groups.values()}, terms.multicast_group),
            port=pool.take_everywhere(hosts, min(terms.first_port + GROUP_PORTS_FROM, 65535)),
            ttl=0,
            interfaces=(LOOPBACK,),
        )
    return {
        draft.key: tuple(_bare(draft, groups.get(draft.topic), pool, terms))
        for draft in drafts
        if draft.key not in kept
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
    draft: _Draft, group: ConnectionUrl | None, pool: PortPool, terms: Terms
) -> Iterator[ConnectionUrl]:
    host = draft.party.host
    for transport in draft.media:
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
    if terms.server is not None and terms.server_medium not in draft.media:
        yield ConnectionUrl(transport=terms.server_medium)


def _with_peers(
    drafts: Sequence[_Draft], bare: _Urls, kept: _Urls, parties: Sequence[Party], terms: Terms
) -> Iterator[tuple[_Draft, tuple[str, ...]]]:
    """Yield each connection with its URLs: what it looks for is in them."""
    carrier = {member.end: draft for draft in drafts for member in draft.members}
    own_contacts = {each.key: each.contacts for each in parties}

    def contacts(draft: _Draft) -> Iterator[Contact]:
        """Yield observers, and those whom the connection exchanges data with.

        Of two that are new the subscribing one looks for the other, so that one TCP connection is
        made and not two; of a new one and one that is there, the new one does.
        """
        yield from terms.observers
        for member in draft.members:
            publishes = member.endpoint.kind is EndpointKind.PUBLISHER
            for partner in member.partners:
                other = carrier.get(partner)
                if other is None:
                    yield from own_contacts[partner[0]]
                elif other is not draft and (not publishes or other.key in kept):
                    yield from contacts_of(other.party.host, map(str, bare[other.key]))

    def looking(url: ConnectionUrl, found: Iterable[Contact], host: str) -> ConnectionUrl:
        if terms.server is not None:
            served = url.transport is terms.server_medium
            return replace(url, server=(terms.server,) if served else ())
        if url.transport.is_network and (terms.fixed or url.transport.is_tcp):
            peers = peers_by(url.transport, found, host=host)
            return replace(url, peers=peers)
        return url

    for draft in drafts:
        found = () if draft.key in kept else tuple(contacts(draft))
        urls = (looking(url, found, draft.party.host) for url in bare[draft.key])
        yield draft, tuple(map(str, urls))
