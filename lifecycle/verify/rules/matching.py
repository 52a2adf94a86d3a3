"""Rules about declared pairs that do not match. Pure.

Judged pair by pair: each end that reports names the peers that it is matched with, and both must
name each other. Where an end's RMW only counts its peers, the count must be that of all endpoints
of the graph that can match it, tools' included: a count that is lower or higher proves nothing
about this pair. Where neither end reports, discovery has to do: both ends are there, of one type,
and compatible, which is DDS's own condition for a match (DDS 1.4 §2.2.2.5, §2.2.3) but for the
partition, which nobody announces upward; that is not enough for a declared link.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence

from lifecycle.manifest.model import EndpointKind
from lifecycle.manifest.qos import Certainty, QosProfile, incompatibilities
from lifecycle.verify.rules.catalogue import About, Heals, Rule
from lifecycle.verify.verdict import Finding, Outcome
from lifecycle.verify.view import UNKNOWN_QOS, Actual, FlowView, Seen, View, actual_qos

UNMATCHED_LINK = Rule(
    id="graph.unmatched-link",
    meaning="the two ends of a declared link are not matched",
    outcomes=(Outcome.VIOLATED, Outcome.UNVERIFIABLE),
    fix="see the other findings on its ends; if there are none, look at the network between them",
    concerns_flow=True,
    about=About.MATCH,
    heals=Heals.WITH_TIME,
    if_unheard=True,
    absence="match",
)
UNMATCHED_FLOW = Rule(
    id="graph.unmatched-flow",
    meaning="a declared publisher and a declared subscription of its topic are not matched",
    outcomes=(Outcome.VIOLATED, Outcome.UNVERIFIABLE),
    fix="look at the network between the two: discovery range, multicast, firewall, peers",
    concerns_flow=True,
    about=About.MATCH,
    heals=Heals.WITH_TIME,
    if_unheard=True,
    absence="match",
)
RULES = (UNMATCHED_LINK, UNMATCHED_FLOW)


_Answer = tuple[Outcome, str]
"""What is known of a pair, and why it is not ok."""

_OK: _Answer = (Outcome.OK, "")


def check(view: View) -> Iterator[Finding]:
    """Judge every planned flow."""
    topics: dict[tuple[str, EndpointKind], list[Seen]] = {}
    for seen in (*view.seen, *view.seen_of_tools):
        topics.setdefault((seen.name, seen.kind), []).append(seen)
    for flow in view.flows:
        cause = _cause(flow)
        if cause and not flow.planned.linked:
            continue  # the cause has its own finding already
        outcome, reason = (Outcome.VIOLATED, cause) if cause else _judge(flow, topics)
        if outcome is Outcome.OK:
            continue
        rule = UNMATCHED_LINK if flow.planned.linked else UNMATCHED_FLOW
        violated = outcome is Outcome.VIOLATED
        pair = f"{flow.publisher} → {flow.subscription}"
        yield rule.finding(
            outcome,
            subject=flow.subject,
            ends=flow.ends,
            expected="matched",
            observed=reason,
            message=f"cannot see {pair} matched on {flow.planned.topic}: {reason}"
            if violated
            else f"cannot verify that {pair} are matched on {flow.planned.topic}: {reason}",
            at=flow.at,
        )


def _cause(flow: FlowView) -> str:
    """Return why the two ends cannot match at all; empty if they can."""
    for word, node, ends in (
        ("publisher", flow.publisher, flow.publishers),
        ("subscription", flow.subscription, flow.subscriptions),
    ):
        if not ends:
            return f"{node} declares no {word} of it"
        if any(end.observed is None and not end.beyond for end in ends):
            return f"the {word} is missing"
    for publisher in flow.publishers:
        for subscription in flow.subscriptions:
            if _type(publisher) != _type(subscription):
                return f"the types differ, {_type(publisher)} and {_type(subscription)}"
            if not _compatible(_qos(publisher), _qos(subscription)):
                return "the QoS is incompatible"
    return ""


def _judge(flow: FlowView, topics: Mapping[tuple[str, EndpointKind], Sequence[Seen]]) -> _Answer:
    """Return the worst that is known of any of the flow's pairs, whose ends are all seen."""
    answers = [
        _pair(
            publisher,
            subscription,
            topics[flow.planned.topic, EndpointKind.PUBLISHER],
            topics[flow.planned.topic, EndpointKind.SUBSCRIPTION],
        )
        for publisher in flow.publishers
        for subscription in flow.subscriptions
    ]
    if flow.planned.linked and None in answers:
        return Outcome.UNVERIFIABLE, "neither end reports whom it is matched with"
    return _worst(each for each in answers if each is not None)


def _pair(
    publisher: Actual,
    subscription: Actual,
    publishers: Sequence[Seen],
    subscriptions: Sequence[Seen],
) -> _Answer | None:
    """Return what the two ends say of each other; None if neither reports its matches."""
    told = [
        answer
        for answer in (
            _of_one_end(publisher, subscription, subscriptions),
            _of_one_end(subscription, publisher, publishers),
        )
        if answer is not None
    ]
    return _worst(told) if told else None


def _worst(answers: Iterable[_Answer]) -> _Answer:
    """Return the worst outcome with every reason for it."""
    found = list(answers)
    outcome = Outcome.worst(each for each, _ in found)
    reasons = dict.fromkeys(reason for each, reason in found if each is outcome)
    return outcome, ", ".join(reasons)


def _of_one_end(end: Actual, other: Actual, others: Sequence[Seen]) -> _Answer | None:
    """Return what one end says of the other; None if it does not report its matches."""
    report = end.report
    if report is None or report.matched is None:
        return None
    word = f"the {end.planned.kind.noun}"
    gid = _gid(other)
    if report.peers is None or not gid:
        return _by_count(word, report.matched, end, others)
    if gid in report.peers:
        return _OK
    unknown = report.matched - len(report.peers)
    if unknown > 0:
        return (
            Outcome.UNVERIFIABLE,
            f"{word} matched {report.matched}, of which {unknown} are not known to its node",
        )
    if report.matched == 0:
        return Outcome.VIOLATED, f"{word} matched nobody"
    return Outcome.VIOLATED, f"{word} matched {report.matched} others, not this one"


def _by_count(word: str, matched: int, end: Actual, others: Sequence[Seen]) -> _Answer:
    """Conclude from a number alone: it proves the pair only if it is that of all who can match."""
    publishes = end.planned.kind is EndpointKind.PUBLISHER
    own = _qos(end)
    possible = [
        other
        for other in others
        if other.type == _type(end)
        and (
            _compatible(own, other.qos or UNKNOWN_QOS)
            if publishes
            else _compatible(other.qos or UNKNOWN_QOS, own)
        )
    ]
    reason = f"{word} matched {matched} of {len(possible)}"
    if matched == len(possible):
        return _OK
    if matched < len(possible) and (
        matched == 0 or all(each.planned is not None for each in possible)
    ):
        return Outcome.VIOLATED, reason
    return Outcome.UNVERIFIABLE, f"{reason}, and does not tell which"


def _gid(end: Actual) -> str:
    """Return the GID of an end: as discovery shows it, else as its node says; empty if unknown."""
    shown = end.observed.gid if end.observed is not None else ""
    return shown or (end.report.gid if end.report is not None else "")


def _compatible(offered: QosProfile, requested: QosProfile) -> bool:
    """Tell whether nothing certain stands against a match."""
    return all(
        each.severity is not Certainty.CERTAIN for each in incompatibilities(offered, requested)
    )


def _type(end: Actual) -> str:
    return end.observed.type if end.observed else end.planned.type


def _qos(end: Actual) -> QosProfile:
    return (
        actual_qos(
            end.observed.qos if end.observed else None, end.report.qos if end.report else None
        )
        or UNKNOWN_QOS
    )
