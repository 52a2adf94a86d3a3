"""Connections of negotiated endpoints: as few as carry them, with names, ports, groups and URLs.

Owns: `connections_of`. What exists already keeps its name and, while its transports are the same,
its URLs. Pure.
"""

from __future__ import annotations

import dataclasses
import ipaddress
import re
from collections.abc import Iterable, Mapping, Sequence

from lifecycle.manifest.model import EndpointKind
from lifecycle.network.connection_url import ConnectionTransport, ConnectionUrl, parse
from lifecycle.plan.connections.contacts import Contact, contacts_of, peers_by, ports_of
from lifecycle.plan.connections.hosts import LOOPBACK, LOOPBACK6, PortPool
from lifecycle.plan.errors import PlanError
from lifecycle.plan.negotiation.data_layer import (
    DataLayerGraph,
    NegotiatedConnection,
    Party,
    PartyEndpoint,
    Terms,
)

GROUP_PORTS_FROM = 1000
"""How far above `first_port` the ports of groups begin: out of the way of everybody's own."""

_NOT_WORD = re.compile(r"[^A-Za-z0-9]+")
_ORDER = ("shm", "udpm", "udpv4", "udpv6", "tcpv4")


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Wanted:
    """One endpoint that must leave its node's own participant.

    Attributes:
        transports: what its connection must have; a group is `udpm@/topic`.
        partners: (party, kind, endpoint) of everybody whom it exchanges data with.
    """

    party: Party
    endpoint: PartyEndpoint
    transports: tuple[str, ...]
    partners: tuple[tuple[str, str, str], ...]

    @property
    def key(self) -> tuple[str, str, str]:
        """How partners know it."""
        return self.party.key, self.endpoint.kind.value, self.endpoint.name


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class _Draft:
    """A connection that has no URLs yet."""

    party: Party
    name: str
    transports: tuple[str, ...]
    members: tuple[Wanted, ...]

    @property
    def key(self) -> tuple[str, str]:
        return self.party.key, self.name


def connections_of(
    wanted: Sequence[Wanted],
    parties: Sequence[Party],
    terms: Terms,
    *,
    before: DataLayerGraph | None = None,
) -> tuple[NegotiatedConnection, ...]:
    """Return the connections that carry these endpoints, sorted by node and name.

    Args:
        wanted: the endpoints.
        parties: everybody who takes part.
        terms: what the system gives.
        before: what is there already.

    Raises:
        PlanError: there are not enough ports or groups.
    """
    drafts = _drafts(wanted)
    old = {(each.node, each.name): each for each in before.connections} if before else {}
    kept = {
        draft.key: old[draft.key].urls
        for draft in drafts
        if draft.key in old and _kinds(old[draft.key].urls) == _plain(draft.transports)
    }
    groups = _groups(drafts, kept)
    writer = _Writer(drafts, parties, kept, groups, terms)
    return tuple(
        NegotiatedConnection(
            node=draft.party.key,
            name=draft.name,
            urls=kept.get(draft.key) or writer.urls(draft),
            map=tuple(sorted(each.endpoint.label for each in draft.members)),
            reason=_reason(draft),
        )
        for draft in drafts
    )


def _drafts(wanted: Sequence[Wanted]) -> list[_Draft]:
    """Group endpoints that may share a participant, and name each group."""
    groups: dict[tuple[str, tuple[str, ...], str, str], list[Wanted]] = {}
    for each in wanted:
        alone = each.endpoint.label if each.endpoint.alone else ""
        place = (each.party.key, each.transports, each.endpoint.group, alone)
        groups.setdefault(place, []).append(each)
    drafts = []
    names: dict[str, set[str]] = {}
    for (key, transports, group, alone), members in sorted(groups.items()):
        party = members[0].party
        taken = names.setdefault(key, set(party.connections))
        name = _name(transports, group, alone)
        number = 2
        unique = name
        while unique in taken:
            unique, number = f"{name}_{number}", number + 1
        taken.add(unique)
        drafts.append(
            _Draft(party=party, name=unique, transports=transports, members=tuple(members))
        )
    return sorted(drafts, key=lambda each: each.key)


def _name(transports: Iterable[str], group: str, alone: str) -> str:
    """Name a connection by what it is: `tcpv4`, `udpm_tcpv4_video`, `udpv4_publishers_video`."""
    topics = [each.partition("@")[2] for each in transports if "@" in each]
    words = [each for each in _ORDER if each in _plain(transports)]
    words += [_NOT_WORD.sub("_", each).strip("_") for each in (*topics, group, alone) if each]
    return "_".join(words)


def _plain(transports: Iterable[str]) -> set[str]:
    return {each.partition("@")[0] for each in transports}


def _kinds(urls: Iterable[str]) -> set[str]:
    return {text.partition(":")[0] for text in urls}


def _topic(draft: _Draft) -> str:
    return next((each.partition("@")[2] for each in draft.transports if "@" in each), "")


def _groups(
    drafts: Sequence[_Draft], kept: Mapping[tuple[str, str], tuple[str, ...]]
) -> dict[str, ConnectionUrl]:
    """Return the group of each topic that has one already."""
    found: dict[str, ConnectionUrl] = {}
    for draft in drafts:
        for text in kept.get(draft.key, ()):
            url = parse(text)
            if url.transport is ConnectionTransport.UDPM:
                found.setdefault(_topic(draft), url)
    return found


def _reason(draft: _Draft) -> str:
    ends = [each.endpoint for each in draft.members]
    topics = ", ".join(dict.fromkeys(each.resolved for each in ends))
    media = " and ".join(each for each in _ORDER if each in _plain(draft.transports))
    return f"{topics} by {media}"


def _address(host: str, transport: ConnectionTransport) -> str:
    """Return where a participant of a host listens; on loopback for the other IP version."""
    if transport is ConnectionTransport.UDPV6:
        return host if ":" in host else LOOPBACK6
    return LOOPBACK if ":" in host else host or LOOPBACK


class _Writer:
    """Writes URLs, giving out ports and groups in the order of nodes and connections."""

    def __init__(
        self,
        drafts: Sequence[_Draft],
        parties: Sequence[Party],
        kept: Mapping[tuple[str, str], tuple[str, ...]],
        groups: dict[str, ConnectionUrl],
        terms: Terms,
    ) -> None:
        self._terms = terms
        self._pool = PortPool(terms.first_port, dict(terms.taken))
        self._hosts = sorted({each.party.host for each in drafts})
        hosts = {each.key: each.party.host for each in drafts}
        for key, urls in kept.items():
            for port in ports_of(parse(text) for text in urls):
                self._pool.reserve((hosts[key],), port)
        for url in groups.values():
            if url.port is not None:
                self._pool.reserve(self._hosts, url.port)
        self._groups = groups
        for topic in sorted({_topic(each) for each in drafts} - {"", *groups}):
            self._groups[topic] = self._new_group()
        self._drafts = {each.key: each for each in drafts}
        self._of = {member.key: draft.key for draft in drafts for member in draft.members}
        self._parties = {each.key: each for each in parties}
        self._plain: dict[tuple[str, str], tuple[ConnectionUrl, ...]] = {
            key: tuple(parse(text) for text in urls) for key, urls in kept.items()
        }
        self._kept = frozenset(kept)
        for draft in drafts:
            if draft.key not in kept:
                self._plain[draft.key] = tuple(self._bare(draft))

    def _new_group(self) -> ConnectionUrl:
        used = {url.address for url in self._groups.values()}
        first = ipaddress.IPv4Address(self._terms.multicast_group)
        try:
            group = next(
                str(first + step) for step in range(len(used) + 1) if str(first + step) not in used
            )
        except ipaddress.AddressValueError:
            group = ""
        if not group or not ipaddress.IPv4Address(group).is_multicast:
            raise PlanError(
                f"cannot give out {len(used) + 1} multicast groups from "
                f"{self._terms.multicast_group}: the highest is 239.255.255.255",
                hint="lower 'data_layer.multicast_group'",
            )
        lowest = min(self._terms.first_port + GROUP_PORTS_FROM, 65535)
        return ConnectionUrl(
            transport=ConnectionTransport.UDPM,
            address=group,
            port=self._pool.take_everywhere(self._hosts, lowest),
            ttl=0,
            interfaces=(LOOPBACK,),
        )

    def _bare(self, draft: _Draft) -> Iterable[ConnectionUrl]:
        """Return a connection's transports with its own ports, still without peers."""
        host = draft.party.host
        fixed = self._terms.fixed
        for kind in _ORDER:
            if kind not in _plain(draft.transports):
                continue
            transport = ConnectionTransport(kind)
            if transport is ConnectionTransport.SHM:
                yield ConnectionUrl(transport=transport)
            elif transport is ConnectionTransport.UDPM:
                group = self._groups[_topic(draft)]
                bare = dataclasses.replace(group, metatraffic_port=None, peers=(), multicast=True)
                if fixed:
                    (port,) = self._pool.take(host)
                    bare = dataclasses.replace(bare, metatraffic_port=port, multicast=False)
                yield bare
            elif transport is ConnectionTransport.TCPV4:
                (port,) = self._pool.take(host)
                yield ConnectionUrl(
                    transport=transport, address=_address(host, transport), port=port
                )
            elif fixed:
                metatraffic, user, output = self._pool.take(host, 3)
                yield ConnectionUrl(
                    transport=transport,
                    address=_address(host, transport),
                    port=user,
                    metatraffic_port=metatraffic,
                    output_port=output,
                    multicast=False,
                )
            else:
                # Each sample would go twice to IPv6's global and link-local addresses.
                own = host if transport is ConnectionTransport.UDPV6 and ":" in host else ""
                yield ConnectionUrl(transport=transport, address=own)
        if self._terms.server is not None:
            server = "tcpv4" if self._terms.server_tcp else "udpv4"
            if server not in _plain(draft.transports):
                yield ConnectionUrl(transport=ConnectionTransport(server))

    def urls(self, draft: _Draft) -> tuple[str, ...]:
        """Return a new connection's URLs."""
        contacts = self._contacts(draft)
        found = []
        for url in self._plain[draft.key]:
            if self._terms.server is not None:
                served = "tcpv4" if self._terms.server_tcp else "udpv4"
                server = (self._terms.server,) if url.transport.value == served else ()
                found.append(dataclasses.replace(url, server=server))
            elif url.transport is ConnectionTransport.SHM:
                found.append(url)
            elif self._terms.fixed or url.transport is ConnectionTransport.TCPV4:
                known = peers_by(url.transport, contacts, host=draft.party.host)
                found.append(dataclasses.replace(url, peers=known))
            else:
                found.append(url)
        return tuple(str(each) for each in found)

    def _contacts(self, draft: _Draft) -> list[Contact]:
        """Return whom a connection looks for: observers, and those whom it exchanges data with.

        Of two that are new the subscribing one looks for the other, so that one TCP connection is
        made and not two; of a new one and one that is there, the new one does.
        """
        contacts = list(self._terms.observers)
        for member in draft.members:
            publishes = member.endpoint.kind is EndpointKind.PUBLISHER
            for partner in member.partners:
                other = self._of.get(partner)
                if other is None:
                    contacts += self._parties[partner[0]].contacts
                elif other != draft.key and (not publishes or other in self._kept):
                    host = self._drafts[other].party.host
                    contacts += contacts_of(host, map(str, self._plain[other]))
        return contacts
