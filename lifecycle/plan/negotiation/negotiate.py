"""Negotiation: node configurations, placement and hints → the data layer graph.

Owns: `negotiate`, which chooses a medium for every publisher → subscription pair and gives a node a
connection only where its own participant would not carry the data anyway. Deterministic, and
independent of the order of the parties. Pure.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

from lifecycle.manifest.model import EndpointKind, FlowTransport
from lifecycle.plan.negotiation.connection_set import Wanted, connections_of
from lifecycle.plan.negotiation.data_layer import (
    DataLayerGraph,
    NegotiatedFlow,
    NegotiationProblem,
    Party,
    PartyEndpoint,
    Terms,
)
from lifecycle.plan.negotiation.media import (
    INTRAPROCESS,
    MULTICAST,
    Choice,
    Pair,
    carried,
    choose,
    wish_of,
)

Wishes = Mapping[tuple[str, str, str], FlowTransport]
"""What links say: (topic, key of the publishing party, key of the subscribing one)."""

_Key = tuple[str, EndpointKind, str]


def negotiate(
    parties: Sequence[Party],
    wishes: Wishes,
    terms: Terms,
    *,
    before: DataLayerGraph | None = None,
) -> DataLayerGraph:
    """Choose how data get from every publisher to every subscription of its topic.

    In this order: what a link says, what the publisher asks for, what the subscription asks for,
    the same process, the same host, another host (see `media.py`). What cannot be made
    is a problem; everything else is negotiated all the same.

    Args:
        parties: nodes with their endpoints, in any order.
        wishes: what links say.
        terms: what the system gives.
        before: what is there already: connections that still fit keep their names, ports, groups
            and URLs, so that little is made anew.
    """
    pairs = tuple(_pairs(sorted(parties, key=lambda each: each.key), wishes))
    chosen, problems = _choose(pairs, terms)
    made = _Carriers(chosen, fixed=terms.fixed)
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
    for near in (True, False):
        for index, pair in enumerate(pairs):
            if pair.same_host is not near:
                continue
            writer = _writer(pair)
            choices[index] = choose(
                pair,
                by_multicast=writer in groups,
                listeners=_listeners(pair, pairs),
                max_datagram_bytes=terms.max_datagram_bytes,
            )
            if choices[index].medium == MULTICAST:
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


def _listeners(pair: Pair, pairs: Sequence[Pair]) -> int:
    """Count processes of the publisher's host, but its own, that subscribe to its topic."""
    return len(
        {
            each.subscription.process
            for each in pairs
            if _writer(each) == _writer(pair) and each.same_host and not each.same_process
        }
    )


def _problem(pair: Pair, message: str, hint: str = "") -> NegotiationProblem:
    return NegotiationProblem(
        topic=pair.writer.resolved,
        publisher=pair.publisher.key,
        subscription=pair.subscription.key,
        message=message,
        hint=hint,
    )


def _foreign(pair: Pair) -> bool:
    """Whether an end of a pair has a participant that nobody here makes."""
    return not (pair.publisher.connectable and pair.subscription.connectable)


def _token(pair: Pair, medium: str) -> str:
    """Spell a medium as a transport; a topic has a group of its own."""
    return f"{MULTICAST}@{pair.writer.resolved}" if medium == MULTICAST else medium


class _Carriers:
    """Which endpoints leave their own participant, and for what.

    An endpoint moves only when a pair of its gets another medium than was chosen: the publisher
    first, then the subscription. What moves takes all its media along.
    """

    def __init__(self, chosen: Sequence[tuple[Pair, Choice]], *, fixed: bool) -> None:
        self._fixed = fixed
        self.problems: list[NegotiationProblem] = []
        self._chosen = [(pair, choice) for pair, choice in chosen if choice.medium]
        self._unknown = [(pair, choice) for pair, choice in chosen if not choice.medium]
        self._moved: dict[_Key, set[str]] = {}
        self._ends: dict[_Key, tuple[Party, PartyEndpoint]] = {}
        self._needs: dict[_Key, set[str]] = {}
        for pair, choice in self._chosen:
            self._ends[_writer(pair)] = pair.publisher, pair.writer
            self._ends[_reader(pair)] = pair.subscription, pair.reader
            for key in (_writer(pair), _reader(pair)):
                found = self._needs.setdefault(key, set())
                if choice.medium != INTRAPROCESS:
                    found.add(_token(pair, choice.medium))
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
        return self._fixed and "shm" in found and bool({"udpv4", "udpv6"} & found)

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
        return bool(present) if choice.medium == INTRAPROCESS else present == [choice.medium]

    def _move(self, pair: Pair, choice: Choice) -> bool:
        for key in (_writer(pair), _reader(pair)):
            if key in self._moved:
                if choice.medium == INTRAPROCESS and "shm" not in self._moved[key]:
                    self._moved[key].add("shm")
                    return True
                continue
            party, endpoint = self._ends[key]
            if party.connectable and not endpoint.fixed and self._needs[key]:
                self._moved[key] = _together(self._needs[key])
                return True
        return False

    def _conflict(self, pair: Pair, choice: Choice) -> NegotiationProblem:
        present = self._present(pair)
        one, other = (
            ", ".join(sorted(self._transports(key))) or "none"
            for key in (_writer(pair), _reader(pair))
        )
        happens = "it would not arrive"
        if present:
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
        return tuple(
            Wanted(
                party=self._ends[key][0],
                endpoint=self._ends[key][1],
                transports=tuple(sorted(transports)),
                partners=tuple(sorted(self._partners(key))),
            )
            for key, transports in sorted(self._moved.items(), key=lambda each: _order(each[0]))
        )

    def _partners(self, key: _Key) -> set[tuple[str, str, str]]:
        """Return (party, kind, endpoint) of everybody whom an endpoint exchanges data with."""
        found = set()
        for pair, _ in self._chosen:
            ends = (_writer(pair), _reader(pair))
            if key in ends:
                other = ends[1] if ends[0] == key else ends[0]
                found.add((other[0], other[1].value, other[2]))
        return found


def _together(transports: set[str]) -> set[str]:
    """Return the transports of one participant: a group on loopback also receives by unicast."""
    grouped = any(each.startswith(MULTICAST) for each in transports)
    return transports - {"udpv4"} if grouped else set(transports)


def _order(key: _Key) -> tuple[str, str, str]:
    return key[0], key[1].value, key[2]
