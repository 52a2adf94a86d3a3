"""Rules about declared pairs that do not match. Pure.

A pair is proven to match when one of its ends reports at least as many matched endpoints as the
graph has for it. Where neither end reports a count, discovery has to do: both ends are there, of
one type, and compatible, which is DDS's own condition for a match (DDS 1.4 §2.2.2.5, §2.2.3).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from lifecycle.manifest.model import EndpointKind
from lifecycle.manifest.qos import Certainty, QosProfile, incompatibilities
from lifecycle.verify.rules.catalogue import Rule
from lifecycle.verify.verdict import Finding, Outcome
from lifecycle.verify.view import UNKNOWN_QOS, Actual, FlowView, Seen, View, actual_qos

UNMATCHED_LINK = Rule(
    id="graph.unmatched-link",
    meaning="the two ends of a declared link are not matched",
    outcomes=(Outcome.VIOLATED,),
    fix="see the other findings on its ends; if there are none, look at the network between them",
    concerns_flow=True,
)
UNMATCHED_FLOW = Rule(
    id="graph.unmatched-flow",
    meaning="a declared publisher and a declared subscription of its topic are not matched",
    outcomes=(Outcome.VIOLATED,),
    fix="look at the network between the two: discovery range, multicast, firewall, peers",
    concerns_flow=True,
)
RULES = (UNMATCHED_LINK, UNMATCHED_FLOW)


def check(view: View) -> Iterator[Finding]:
    """Judge every planned flow."""
    topics: dict[tuple[str, EndpointKind], list[Seen]] = {}
    for seen in view.seen:
        topics.setdefault((seen.name, seen.kind), []).append(seen)
    for flow in view.flows:
        cause = _cause(flow)
        reason = cause or _shortfall(
            flow,
            topics.get((flow.planned.topic, EndpointKind.PUBLISHER), []),
            topics.get((flow.planned.topic, EndpointKind.SUBSCRIPTION), []),
        )
        # Without a link the cause has its own finding already.
        if not reason or (cause and not flow.planned.linked):
            continue
        rule = UNMATCHED_LINK if flow.planned.linked else UNMATCHED_FLOW
        yield rule.finding(
            Outcome.VIOLATED,
            subject=flow.subject,
            expected="matched",
            observed=reason,
            message=f"cannot see {flow.publisher} → {flow.subscription} matched on"
            f" {flow.planned.topic}: {reason}",
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


def _shortfall(flow: FlowView, publishers: Iterable[Seen], subscriptions: Iterable[Seen]) -> str:
    """Return how many matches are missing; empty if the match is proven as far as can be."""
    for publisher in flow.publishers:
        at_publisher = _count(publisher, subscriptions, publishes=True)
        for subscription in flow.subscriptions:
            at_subscription = _count(subscription, publishers, publishes=False)
            known = [each for each in (at_publisher, at_subscription) if each]
            if not known or any(matched >= expected for matched, expected in known):
                continue
            parts = []
            if at_publisher:
                parts.append(f"the publisher matched {at_publisher[0]} of {at_publisher[1]}")
            if at_subscription:
                parts.append(
                    f"the subscription matched {at_subscription[0]} of {at_subscription[1]}"
                )
            return ", ".join(parts)
    return ""


def _count(end: Actual, others: Iterable[Seen], *, publishes: bool) -> tuple[int, int] | None:
    """Return (matched, expected) at one end; None if it does not report a count."""
    if end.report is None or end.report.matched is None:
        return None
    own = _qos(end)
    expected = sum(
        other.type == _type(end)
        and (
            _compatible(own, other.qos or UNKNOWN_QOS)
            if publishes
            else _compatible(other.qos or UNKNOWN_QOS, own)
        )
        for other in others
    )
    return end.report.matched, expected


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
