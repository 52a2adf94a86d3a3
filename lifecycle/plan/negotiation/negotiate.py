"""Negotiate transports and connections: node configurations, placement, hints → data layer graph.

Owns: `negotiate`, which has a medium chosen for every publisher → subscription pair (`media`), and
gives a node a connection (`connecting`) only where its own participant would not carry the data
anyway. Deterministic, and independent of the order of the parties. Pure.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

from lifecycle.manifest.model import EndpointKind, FlowTransport
from lifecycle.network.medium import CONNECTABLE, UDP_UNICAST, Medium, medium_of
from lifecycle.plan.model import PlannedEndpoint
from lifecycle.plan.negotiation.connecting import Moved, connections_of
from lifecycle.plan.negotiation.media import (
    MEETING,
    Pair,
    carried,
    choose,
    discover,
    is_by_group,
    is_inside,
)
from lifecycle.plan.negotiation.parties import DataLayerGraph, End, NegotiatedFlow, Party, Terms

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
    the same.

    Args:
        parties: nodes with their endpoints, in any order.
        wishes: what links demand.
        terms: what the system gives.
        before: what is there already: connections that still fit keep their names, ports, groups
            and URLs, so that little is made anew.
    """
    pairs = tuple(_pairs(sorted(parties, key=lambda each: each.key), wishes))
    chosen = _choices(pairs, terms)
    carriers = _Carriers(
        [(pair, flow) for pair, flow in zip(pairs, chosen, strict=True) if flow.medium], terms
    )
    flows, problems = carriers.settle()
    flows += [each for each in chosen if not each.medium and not each.problem]
    problems += [each for each in chosen if each.problem]
    return DataLayerGraph(
        flows=tuple(sorted(set(flows))),
        connections=connections_of(tuple(carriers.moved()), parties, terms, before=before),
        problems=tuple(sorted(problems)),
    )


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


def _choices(pairs: Sequence[Pair], terms: Terms) -> list[NegotiatedFlow]:
    """Choose on each host first: whether a publisher uses a group decides what others can have."""
    listeners: dict[End, set[str]] = {}
    for pair in pairs:
        if pair.same_host and not pair.same_process:
            listeners.setdefault(pair.ends[0], set()).add(pair.subscription.process)
    by_group: set[End] = set()
    found: dict[int, NegotiatedFlow] = {}
    for near in (True, False):
        for index, pair in enumerate(pairs):
            if pair.same_host is not near:
                continue
            writer = pair.ends[0]
            found[index] = choose(
                pair,
                by_multicast=writer in by_group,
                listeners=len(listeners.get(writer, ())),
                max_datagram_bytes=terms.max_datagram_bytes,
            )
            if is_by_group(found[index]):
                by_group.add(writer)
    return [found[index] for index in range(len(pairs))]


_INTRODUCING = tuple(each for each in CONNECTABLE if each.is_network and not each.is_group)
"""By what a connection beside shared memory can be discovered."""

_ONE_TRANSPORT = "ask for one transport for all that these two endpoints talk to"


class _Carriers:
    """Which endpoints leave their own participant, and for what.

    An endpoint moves only when a pair of its gets another medium than was chosen: the publisher
    first, then the subscription. What moves takes all its media along.
    """

    def __init__(self, chosen: Sequence[tuple[Pair, NegotiatedFlow]], terms: Terms) -> None:
        self._fixed = terms.fixed
        self._served = terms.server is not None
        self._chosen = chosen
        self._moved: dict[End, set[str]] = {}
        self._sides: dict[End, tuple[Party, PlannedEndpoint]] = {}
        self._needs: dict[End, set[str]] = {}
        for pair, flow in chosen:
            # A topic has a group of its own.
            token = f"{flow.medium}@{flow.topic}" if is_by_group(flow) else flow.medium
            sides = ((pair.publisher, pair.writer), (pair.subscription, pair.reader))
            for end, side in zip(pair.ends, sides, strict=True):
                self._sides[end] = side
                self._needs.setdefault(end, set()).update(() if is_inside(flow) else (token,))

    def settle(self) -> tuple[list[NegotiatedFlow], list[NegotiatedFlow]]:
        """Move endpoints until every pair has its medium; return flows, and what has it not."""
        stuck: set[int] = set()
        changed = True
        while changed:
            changed = False
            for index, (pair, flow) in enumerate(self._chosen):
                if index in stuck or self._holds(pair, flow):
                    continue
                if self._move(pair, flow):
                    changed = True
                else:
                    stuck.add(index)
        flows, problems = [], []
        # A pair that was stuck, or held, may not be so any more after others have moved.
        for index, (pair, flow) in enumerate(self._chosen):
            flows.append(flow)
            if not self._moved and index not in stuck:
                continue  # it held, and nothing has changed since
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
        return flows, problems

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

    def _holds(self, pair: Pair, flow: NegotiatedFlow) -> bool:
        present = self._present(pair)
        # Inside a process it is enough that the participants find each other.
        if is_inside(flow):
            return bool(present)
        meet = self._served or not pair.same_host or discover(*map(self._transports, pair.ends))
        return present == [flow.medium] and meet

    def _move(self, pair: Pair, flow: NegotiatedFlow) -> bool:
        if self._present(pair) == [flow.medium] and self._introduce(pair):
            return True
        for end in pair.ends:
            if end in self._moved:
                if is_inside(flow) and MEETING not in self._moved[end]:
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

    def _conflict(self, pair: Pair, flow: NegotiatedFlow) -> NegotiatedFlow:
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
