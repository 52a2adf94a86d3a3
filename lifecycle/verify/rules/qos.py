"""Rules about QoS: declared against actual, and offered against requested. Pure."""

from __future__ import annotations

import enum
from collections.abc import Iterator

from lifecycle.manifest.model import EndpointKind
from lifecycle.manifest.qos import (
    BEST_AVAILABLE_NS,
    INFINITE_NS,
    POLICIES,
    UNKNOWN_QOS,
    Certainty,
    History,
    Incompatibility,
    QosProfile,
    incompatibilities,
)
from lifecycle.plan.model import PlannedEndpoint, PlannedNode
from lifecycle.verify.outcome import Outcome
from lifecycle.verify.rules.catalogue import Rule
from lifecycle.verify.verdict import Finding
from lifecycle.verify.view import Actual, NodeFacts, SeenEndpoint, View

QOS_DIFFERS = Rule(
    id="graph.qos-differs",
    meaning="an endpoint's QoS is not the declared one",
    says="{who} has {observed}, and must have {expected}",
    fix="correct the profile in the manifest or in the node; look for an XML profile or a"
    " qos_overrides parameter",
)
QOS_UNVERIFIABLE = Rule(
    id="graph.qos-unverifiable",
    meaning="declared QoS policies can be read neither from discovery nor from the node",
    outcomes=(Outcome.UNVERIFIABLE,),
    unproven="nothing shows the QoS of {who} on {expected}: {observed}",
    fix="Fast DDS does not announce history and depth, only nodes in our host report them: leave"
    " both out, write the other policies instead of a preset, or `trust` this rule",
)
QOS_INCOMPATIBLE = Rule(
    id="graph.qos-incompatible",
    meaning="a publisher offers less than a subscription of its topic requests",
    outcomes=(Outcome.VIOLATED, Outcome.UNVERIFIABLE),
    says="{who} do not match: {observed} is offered, {expected} is requested",
    unproven="{who} may not match: {observed} is offered, {expected} is requested",
    fix="offer more or request less: DDS does not match them, and no data flows",
    concerns_flow=True,
)
RULES = (QOS_DIFFERS, QOS_UNVERIFIABLE, QOS_INCOMPATIBLE)

_FREE = frozenset({"SYSTEM_DEFAULT", "BEST_AVAILABLE", "UNKNOWN"})
"""Declared values that leave the choice to the middleware, or mark a gap: nothing to compare."""

_Unknown = list[tuple[Actual, list[tuple[str, str]]]]
"""Endpoints of a node with the policies that are declared and not known, each with its value."""


def check(view: View) -> Iterator[Finding]:
    """Judge the QoS of every declared endpoint as far as it is written, then of every pair."""
    for facts in view.nodes.values():
        yield from _of_node(facts)
    for name in sorted(view.topics):
        yield from _pairs(view, *view.topics[name])


def _of_node(facts: NodeFacts) -> Iterator[Finding]:
    unknown: _Unknown = []
    for actual in facts.actual:
        if actual.observed is not None or actual.report is not None:
            yield from _against_declaration(actual, unknown)
    if unknown:
        yield _unverifiable(facts.node, unknown)


def _against_declaration(actual: Actual, unknown: _Unknown) -> Iterator[Finding]:
    """Judge what is written of one endpoint; what is written and not known goes to `unknown`."""
    planned = actual.planned
    if planned.qos is None or _leaves_all(planned.qos):
        return
    known = actual.qos
    differing: list[tuple[str, str, str]] = []
    hidden: list[tuple[str, str]] = []
    for policy in _comparable(planned, planned.qos):
        want = spell(planned.qos, policy)
        have = spell(known or UNKNOWN_QOS, policy)
        if known is None or have == "UNKNOWN":
            hidden.append((policy, want))
        elif have != want:
            differing.append((policy, want, have))
    for policy, want, have in differing:
        yield QOS_DIFFERS.on(actual, expected=f"{policy} {want}", observed=f"{policy} {have}")
    if hidden:
        unknown.append((actual, hidden))


def _unverifiable(node: PlannedNode, unknown: _Unknown) -> Finding:
    """One finding for a node: what is not announced is the same for all of its endpoints."""
    wanted = [
        f"{_spell_end(each)}: " + ", ".join(f"{policy} {want}" for policy, want in hidden)
        for each, hidden in unknown
    ]
    return QOS_UNVERIFIABLE.on(
        node,
        expected="; ".join(wanted),
        observed="neither discovery nor the node reports the actual value",
        at=unknown[0][0].planned.at,
    )


def _spell_end(end: Actual) -> str:
    return f"{end.name} ({end.kind.noun})"


def _leaves_all(declared: QosProfile) -> bool:
    """Whether a profile is rmw's system default, which leaves everything to the middleware."""
    policies = (declared.history, declared.reliability, declared.durability, declared.liveliness)
    durations = (
        declared.deadline_ns,
        declared.lifespan_ns,
        declared.liveliness_lease_duration_ns,
    )
    return all(each.value == "SYSTEM_DEFAULT" for each in policies) and not any(durations)


def _comparable(planned: PlannedEndpoint, declared: QosProfile) -> Iterator[str]:
    """Policies that are written and mean something definite on this kind of endpoint."""
    for policy in POLICIES:
        if policy in planned.qos_defaults:
            continue
        value = getattr(declared, policy)
        if policy == "depth" and declared.history is not History.KEEP_LAST:
            continue
        # A DataReader has no lifespan (DDS 1.4 §2.2.3.16).
        if policy == "lifespan_ns" and planned.kind is EndpointKind.SUBSCRIPTION:
            continue
        if value == BEST_AVAILABLE_NS and policy.endswith("_ns"):
            continue
        if isinstance(value, enum.Enum) and value.value in _FREE:
            continue
        yield policy


def spell(profile: QosProfile, policy: str) -> str:
    """Spell one policy's value for people; every form of infinite is `infinite`.

    A depth is unknown where the history is: 0 means "not observable" then.
    """
    if policy == "depth" and profile.history is History.UNKNOWN:
        return "UNKNOWN"
    value = getattr(profile, policy)
    if isinstance(value, enum.Enum):
        return str(value.value)
    if not policy.endswith("_ns"):
        return str(value)
    return "infinite" if value in (None, 0, INFINITE_NS) else f"{value} ns"


def _pairs(
    view: View, publishers: list[SeenEndpoint], subscriptions: list[SeenEndpoint]
) -> Iterator[Finding]:
    """Every publisher against every subscription of a topic, at least one of them ours.

    Of an end that nobody observed there is no QoS to compare: its node is named as out of reach,
    and its flows are proven by those that count whom they are matched with.
    """
    publishers, subscriptions = (
        [each for each in ends if each.is_shown and not each.is_passing]
        for ends in (publishers, subscriptions)
    )
    done: set[tuple[str, str, str, str, str]] = set()
    for publisher in publishers:
        for subscription in subscriptions:
            if publisher.node not in view.planned and subscription.node not in view.planned:
                continue
            if publisher.type != subscription.type:
                continue
            offered, requested = publisher.qos or UNKNOWN_QOS, subscription.qos or UNKNOWN_QOS
            for each in incompatibilities(offered, requested):
                key = (
                    publisher.node,
                    subscription.node,
                    each.policy,
                    each.offered,
                    each.requested,
                )
                if key not in done:
                    done.add(key)
                    yield _incompatible(publisher, subscription, each)


def _incompatible(
    publisher: SeenEndpoint, subscription: SeenEndpoint, found: Incompatibility
) -> Finding:
    certain = found.severity is Certainty.CERTAIN
    offers, requests = publisher.node or "an unknown node", subscription.node or "an unknown node"
    declared = publisher.planned or subscription.planned
    return QOS_INCOMPATIBLE.finding(
        outcome=Outcome.VIOLATED if certain else Outcome.UNVERIFIABLE,
        subject=f"{publisher.name}: {offers} → {requests}",
        who=f"{offers} → {requests} on {publisher.name}",
        ends=tuple(filter(None, (publisher.node, subscription.node))),
        expected=f"{found.policy} {found.requested}",
        observed=f"{found.policy} {found.offered}",
        at=declared.at if declared else None,
    )
