"""Negotiate transports and connections: node configurations, placement, hints → data layer graph.

Owns: `negotiate`, which chooses a medium for every publisher → subscription pair and gives a node a
connection only where its own participant would not carry the data anyway; `connections_of`, as few
connections as carry the endpoints, with names, ports, groups and URLs. What exists already keeps
its name and, while its transports are the same, its URLs. Deterministic, and independent of the
order of the parties. Pure.
"""

from __future__ import annotations

import ipaddress
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence

from lifecycle import dataclasses
from lifecycle.manifest.model import EndpointKind, FlowTransport
from lifecycle.manifest.names import free_name
from lifecycle.network.connection_url import ConnectionUrl, parse
from lifecycle.network.medium import CONNECTABLE, LOOPBACK, UDP_UNICAST, Medium, medium_of
from lifecycle.plan.connections.hosts import (
    Contact,
    PortPool,
    contacts_of,
    peers_by,
    ports_of,
)
from lifecycle.plan.model import PlanError
from lifecycle.plan.negotiation.data_layer import (
    DataLayerGraph,
    NegotiatedConnection,
    NegotiatedFlow,
    NegotiationProblem,
    Party,
    PartyEndpoint,
    Terms,
)
from lifecycle.plan.negotiation.media import (
    MEETING,
    Choice,
    Pair,
    carried,
    choose,
    discover,
    wish_of,
)

GROUP_PORTS_FROM = 1000
"""How far above `first_port` the ports of groups begin: out of the way of participants' own."""

_NOT_WORD = re.compile(r"[^A-Za-z0-9]+")


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Wanted:
    """One endpoint that must leave its node's own participant.

    Attributes:
        transports: what its connection must have; a group is `udpm@/topic`.
        partners: (party, kind, endpoint) of all that it exchanges data with.
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
        parties: all that take part.
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
        unique = free_name(_name(transports, group, alone), taken)
        taken.add(unique)
        drafts.append(
            _Draft(party=party, name=unique, transports=transports, members=tuple(members))
        )
    return sorted(drafts, key=lambda each: each.key)


def _name(transports: Iterable[str], group: str, alone: str) -> str:
    """Name a connection by what it is: `tcpv4`, `udpm_tcpv4_video`, `udpv4_publishers_video`."""
    topics = [each.partition("@")[2] for each in transports if "@" in each]
    words: list[str] = [each for each in Medium if each in _plain(transports)]
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
            if url.transport.is_group:
                found.setdefault(_topic(draft), url)
    return found


def _reason(draft: _Draft) -> str:
    ends = [each.endpoint for each in draft.members]
    topics = ", ".join(dict.fromkeys(each.resolved for each in ends))
    media = " and ".join(each for each in Medium if each in _plain(draft.transports))
    return f"{topics} by {media}"


def _address(host: str, transport: Medium) -> str:
    """Return where a participant of a host listens; on loopback for the other IP version."""
    is_other = (":" in host) != (transport.ip_version == 6)
    return transport.loopback if is_other else host or transport.loopback


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
            transport=Medium.UDPM,
            address=group,
            port=self._pool.take_everywhere(self._hosts, lowest),
            ttl=0,
            interfaces=(LOOPBACK,),
        )

    def _bare(self, draft: _Draft) -> Iterable[ConnectionUrl]:
        """Return a connection's transports with its own ports, still without peers."""
        host = draft.party.host
        fixed = self._terms.fixed
        for transport in Medium:
            if transport not in _plain(draft.transports):
                continue
            if not transport.is_network:
                yield ConnectionUrl(transport=transport)
            elif transport.is_group:
                group = self._groups[_topic(draft)]
                bare = dataclasses.replace(group, metatraffic_port=None, peers=(), multicast=True)
                if fixed:
                    (port,) = self._pool.take(host)
                    bare = dataclasses.replace(bare, metatraffic_port=port, multicast=False)
                yield bare
            elif transport.is_tcp:
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
                own = host if transport.ip_version == 6 and ":" in host else ""
                yield ConnectionUrl(transport=transport, address=own)
        server = self._terms.server_medium
        if self._terms.server is not None and server not in _plain(draft.transports):
            yield ConnectionUrl(transport=server)

    def urls(self, draft: _Draft) -> tuple[str, ...]:
        """Return a new connection's URLs."""
        contacts = self._contacts(draft)
        found = []
        for url in self._plain[draft.key]:
            if self._terms.server is not None:
                served = url.transport is self._terms.server_medium
                server = (self._terms.server,) if served else ()
                found.append(dataclasses.replace(url, server=server))
            elif not url.transport.is_network:
                found.append(url)
            elif self._terms.fixed or url.transport.is_tcp:
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


Wishes = Mapping[tuple[str, str, str], FlowTransport]
"""What links demand: (topic, key of the publishing party, key of the subscribing one)."""

_Key = tuple[str, EndpointKind, str]


def negotiate(
    parties: Sequence[Party],
    wishes: Wishes,
    terms: Terms,
    *,
    before: DataLayerGraph | None = None,
) -> DataLayerGraph:
    """Choose how data get from every publisher to every subscription of its topic.

    In this order: what a link demands, what the publisher asks for, what the subscription asks for,
    the same process, the same host, another host (see `media.py`). What cannot be made
    is a problem; everything else is negotiated all the same.

    Args:
        parties: nodes with their endpoints, in any order.
        wishes: what links demand.
        terms: what the system gives.
        before: what is there already: connections that still fit keep their names, ports, groups
            and URLs, so that little is made anew.
    """
    pairs = tuple(_pairs(sorted(parties, key=lambda each: each.key), wishes))
    chosen, problems = _choose(pairs, terms)
    made = _PairCarriers(chosen, fixed=terms.fixed, served=terms.server is not None)
    problems += made.problems
    flows = {
        NegotiatedFlow(
            topic=pair.writer.resolved,
            publisher=pair.publisher.key,
            subscription=pair.subscription.key,
            medium=choice.medium,
            reason=choice.reason,
        )
        for pair, choice in made.chosen
    }
    return DataLayerGraph(
        flows=tuple(sorted(flows)),
        connections=connections_of(made.wanted(), parties, terms, before=before),
        problems=tuple(sorted(problems, key=_place)),
    )


def _place(each: NegotiationProblem) -> tuple[str, str, str, str]:
    return each.topic, each.publisher, each.subscription, each.message


def _pairs(parties: Sequence[Party], wishes: Wishes) -> Iterator[Pair]:
    readers: dict[str, list[tuple[Party, PartyEndpoint]]] = {}
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


def _sorted(party: Party, kind: EndpointKind) -> list[PartyEndpoint]:
    found = [each for each in party.endpoints if each.kind is kind]
    return sorted(found, key=lambda each: (each.resolved, each.name))


def _choose(
    pairs: Sequence[Pair], terms: Terms
) -> tuple[list[tuple[Pair, Choice]], list[NegotiationProblem]]:
    """Choose on each host first: whether a publisher uses a group decides what others can have."""
    groups: set[_Key] = set()
    choices: dict[int, Choice] = {}
    writers = [_writer(pair) for pair in pairs]
    listeners = _listeners(pairs, writers)
    for near in (True, False):
        for index, pair in enumerate(pairs):
            if pair.same_host is not near:
                continue
            writer = writers[index]
            choices[index] = choose(
                pair,
                by_multicast=writer in groups,
                listeners=len(listeners.get(writer, ())),
                max_datagram_bytes=terms.max_datagram_bytes,
            )
            if choices[index].by_group:
                groups.add(writer)
    chosen, problems = [], []
    for index, pair in enumerate(pairs):
        choice = choices[index]
        if choice.problem:
            problems.append(_problem(pair, choice.problem, choice.hint))
        else:
            chosen.append((pair, choice))
    return chosen, problems


def _writer(pair: Pair) -> _Key:
    return pair.publisher.key, EndpointKind.PUBLISHER, pair.writer.name


def _reader(pair: Pair) -> _Key:
    return pair.subscription.key, EndpointKind.SUBSCRIPTION, pair.reader.name


def _listeners(pairs: Sequence[Pair], writers: Sequence[_Key]) -> dict[_Key, set[str]]:
    """Return, by publisher, the processes of its host, but its own, that subscribe to its topic."""
    found: dict[_Key, set[str]] = {}
    for pair, writer in zip(pairs, writers, strict=True):
        if pair.same_host and not pair.same_process:
            found.setdefault(writer, set()).add(pair.subscription.process)
    return found


def _problem(pair: Pair, message: str, hint: str = "") -> NegotiationProblem:
    return NegotiationProblem(
        topic=pair.writer.resolved,
        publisher=pair.publisher.key,
        subscription=pair.subscription.key,
        message=message,
        hint=hint,
    )


def _foreign(pair: Pair) -> bool:
    """Whether an end of a pair has a participant that is not made here."""
    return not (pair.publisher.connectable and pair.subscription.connectable)


def _token(pair: Pair, choice: Choice) -> str:
    """Spell what was chosen as a transport; a topic has a group of its own."""
    return f"{choice.medium}@{pair.writer.resolved}" if choice.by_group else choice.medium


_INTRODUCING = tuple(each for each in CONNECTABLE if each.is_network and not each.is_group)
"""By what a connection beside shared memory can be discovered."""


class _PairCarriers:
    """Which endpoints leave their own participant, and for what.

    An endpoint moves only when a pair of its gets another medium than was chosen: the publisher
    first, then the subscription. What moves takes all its media along.
    """

    def __init__(self, chosen: Sequence[tuple[Pair, Choice]], *, fixed: bool, served: bool) -> None:
        self._fixed = fixed
        self._served = served
        self.problems: list[NegotiationProblem] = []
        self._chosen = [(pair, choice) for pair, choice in chosen if choice.medium]
        self._unknown = [(pair, choice) for pair, choice in chosen if not choice.medium]
        self._moved: dict[_Key, set[str]] = {}
        self._ends: dict[_Key, tuple[Party, PartyEndpoint]] = {}
        self._needs: dict[_Key, set[str]] = {}
        for pair, choice in self._chosen:
            ends = (_writer(pair), _reader(pair))
            self._ends[ends[0]] = pair.publisher, pair.writer
            self._ends[ends[1]] = pair.subscription, pair.reader
            for key in ends:
                found = self._needs.setdefault(key, set())
                if not choice.inside:
                    found.add(_token(pair, choice))
        self._settle()

    def _settle(self) -> None:
        stuck: dict[int, None] = {}
        changed = True
        while changed:
            changed = False
            for index, (pair, choice) in enumerate(self._chosen):
                if index in stuck or self._holds(pair, choice):
                    continue
                if self._move(pair, choice):
                    changed = True
                else:
                    stuck[index] = None
        # A pair that was stuck, or held, may not be so any more after others have moved.
        for index, (pair, choice) in enumerate(self._chosen):
            if not self._moved and index not in stuck:
                continue  # it held, and nothing has changed since
            impossible = any(self._impossible(key) for key in (_writer(pair), _reader(pair)))
            if self._holds(pair, choice) and not impossible:
                continue
            if wish_of(pair)[0] is FlowTransport.NETWORK and _foreign(pair):
                # `lifecycle check` has warned; from outside it may have been seen to.
                self._chosen[index] = pair, Choice(reason="its participant is not ours")
            elif impossible:
                self.problems.append(
                    _problem(
                        pair,
                        f"cannot carry {pair.subject} by {choice.medium}: an end of it also needs "
                        "another of shared memory and UDP, and beside fixed ports Fast DDS does "
                        "not listen to shared memory",
                        "ask for one transport for all that these two endpoints talk to",
                    )
                )
            else:
                self.problems.append(self._conflict(pair, choice))

    @property
    def chosen(self) -> Sequence[tuple[Pair, Choice]]:
        """The pairs with what carries them."""
        return (*self._chosen, *self._unknown)

    def _impossible(self, key: _Key) -> bool:
        """Whether an endpoint's connection would need shared memory beside fixed UDP ports."""
        found = self._moved.get(key, set())
        in_memory = any(not medium_of(each).is_network for each in found)
        return self._fixed and in_memory and bool({*UDP_UNICAST} & found)

    def _transports(self, key: _Key) -> set[str]:
        if key in self._moved:
            return self._moved[key]
        party, endpoint = self._ends[key]
        return {*(endpoint.by or party.own)}

    def _present(self, pair: Pair) -> list[str]:
        return carried(
            self._transports(_writer(pair)),
            self._transports(_reader(pair)),
            same_host=pair.same_host,
        )

    def _holds(self, pair: Pair, choice: Choice) -> bool:
        present = self._present(pair)
        # Inside a process it is enough that the participants find each other.
        if choice.inside:
            return bool(present)
        return present == [choice.medium] and self._discover(pair)

    def _discover(self, pair: Pair) -> bool:
        """Whether the ends have by what to discover each other, beside what carries their data."""
        ends = (self._transports(_writer(pair)), self._transports(_reader(pair)))
        return self._served or not pair.same_host or discover(*ends)

    def _move(self, pair: Pair, choice: Choice) -> bool:
        if self._present(pair) == [choice.medium] and self._introduce(pair):
            return True
        for key in (_writer(pair), _reader(pair)):
            if key in self._moved:
                if choice.inside and MEETING not in self._moved[key]:
                    self._moved[key].add(MEETING)
                    return True
                continue
            party, endpoint = self._ends[key]
            if party.connectable and not endpoint.fixed and self._needs[key]:
                self._moved[key] = _together(self._needs[key])
                return True
        return False

    def _introduce(self, pair: Pair) -> bool:
        """Give an end that has moved by what the other one discovers participants."""
        keys = (_writer(pair), _reader(pair))
        for key, other in (keys, keys[::-1]):
            known = self._transports(other)
            medium = next((each for each in _INTRODUCING if each in known), None)
            if key in self._moved and medium is not None:
                self._moved[key].add(medium)
                return True
        return False

    def _conflict(self, pair: Pair, choice: Choice) -> NegotiationProblem:
        present = self._present(pair)
        one, other = (
            ", ".join(sorted(self._transports(key))) or "none"
            for key in (_writer(pair), _reader(pair))
        )
        happens = "it would not arrive"
        if present == [choice.medium]:
            happens = "they would not discover each other"
        elif present:
            happens = f"it would go by {' and '.join(present)}"
            happens += ", twice" if len(present) > 1 else ""
        wish, who = wish_of(pair)
        asked = f", as {who}" if wish is not FlowTransport.ANY else ""
        return _problem(
            pair,
            f"cannot carry {pair.subject} by {choice.medium}{asked}: the publisher's participant "
            f"has {one}, the subscription's {other}, so {happens}",
            "ask for one transport for all that these two endpoints talk to",
        )

    def wanted(self) -> tuple[Wanted, ...]:
        """Return what each node must have, with those whom each connection must find."""
        partners = self._partners()
        return tuple(
            Wanted(
                party=self._ends[key][0],
                endpoint=self._ends[key][1],
                transports=tuple(sorted(transports)),
                partners=tuple(sorted(partners.get(key, ()))),
            )
            for key, transports in sorted(self._moved.items(), key=lambda each: _order(each[0]))
        )

    def _partners(self) -> dict[_Key, set[tuple[str, str, str]]]:
        """Return (party, kind, endpoint) of all that each moved endpoint exchanges data with."""
        found: dict[_Key, set[tuple[str, str, str]]] = {}
        for pair, _ in self._chosen if self._moved else ():
            ends = (_writer(pair), _reader(pair))
            for key, other in (ends, ends[::-1]):
                if key in self._moved:
                    found.setdefault(key, set()).add((other[0], other[1].value, other[2]))
        return found


def _together(transports: set[str]) -> set[str]:
    """Return the transports of one participant: a group on loopback also receives by unicast."""
    media = map(medium_of, transports)
    return transports - {each.unicast for each in media if each.is_group}


def _order(key: _Key) -> tuple[str, str, str]:
    return key[0], key[1].value, key[2]
