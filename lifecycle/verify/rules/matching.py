"""Decides when a publisher and a subscription are matched; rules about pairs and clients. Pure.

Judged pair by pair: each end that reports counts the peers that it is matched with. A count that is
that of all endpoints of the graph that can match it, tools' included, proves the pair; a lower one
is settled by the other end's, and one of zero is a violation. An end counts a peer whose process
was killed until that one's lease ends. Where neither end reports, discovery
has to do: both ends are there, of one type, and compatible, which is DDS's own condition for a
match (DDS 1.4 §2.2.2.5, §2.2.3) but for the partition, which no layer reports upward; that is not
enough for a declared link.

A client of a service or action reports whether a server is matched with it both ways; a server
reports nothing about its clients.
"""

from __future__ import annotations

import functools
from collections import Counter
from collections.abc import Iterator, Sequence

from lifecycle.manifest.model import EndpointKind, EndpointPolicy
from lifecycle.manifest.names import DIAGNOSTICS_TOPIC
from lifecycle.manifest.qos import Certainty, incompatibilities
from lifecycle.printable import count, listed
from lifecycle.verify.outcome import Outcome
from lifecycle.verify.rules.catalogue import About, Heals, Rule
from lifecycle.verify.tool_filter import NOISE_TOPICS
from lifecycle.verify.verdict import Finding
from lifecycle.verify.view import FlowView, SeenEndpoint, TopicEnds, View, Whose, brings_up

_rule = functools.partial(
    Rule,
    outcomes=(Outcome.VIOLATED, Outcome.UNVERIFIABLE),
    about=About.MATCH,
    heals=Heals.WITH_TIME,
    if_undiscovered=True,
    says="{who} is not matched: {observed}",
    unproven="nothing proves that {who} is matched: {observed}",
)

UNMATCHED_LINK = _rule(
    id="graph.unmatched-link",
    meaning="the two ends of a declared link are not matched",
    fix="see the other findings on its ends; if there are none, look at the network between them",
    concerns_flow=True,
)
UNMATCHED_FLOW = _rule(
    id="graph.unmatched-flow",
    meaning="a declared publisher and a declared subscription of its topic are not matched",
    fix="look at the network between the two: discovery range, multicast, firewall, peers",
    concerns_flow=True,
)
UNKNOWN_PEER = Rule(
    id="graph.unknown-peer",
    meaning="a declared endpoint is matched with more peers than the graph shows",
    says="{who} is matched with {observed}, and may be with {expected}",
    fix="look for a participant that is found by the node's addresses alone (initial peers, a"
    " discovery server) and not by the supervisor; give the system a domain of its own",
    concerns_flow=True,
    heals=Heals.WITH_TIME,
)
UNREPORTED_FLOW = Rule(
    id="flow.unreported",
    meaning="neither end of a flow reports anything, so that nothing proves that data can flow",
    outcomes=(Outcome.UNVERIFIABLE,),
    unproven="nothing proves that data can flow, as neither end reports anything: {who}",
    fix="run one of its nodes in our host (`run: python`), or write it under `policy.trust`",
    heals=Heals.WITH_TIME,
)
Match = tuple[Outcome, str]
"""What is known of a pair, and why it is not ok."""

_OK: Match = (Outcome.OK, "")


_NO_ENDS: TopicEnds = ([], [])


def obstacle(publisher: SeenEndpoint, subscription: SeenEndpoint) -> str:
    """Return why two ends cannot match at all (DDS 1.4 §2.2.2.5, §2.2.3); empty if they can.

    QoS that nobody observed is no reason: what an end only declares excludes it from no count.
    """
    if publisher.type != subscription.type:
        return f"the types differ, {publisher.type} and {subscription.type}"
    if publisher.qos is None or subscription.qos is None:
        return ""
    found = incompatibilities(publisher.qos, subscription.qos)
    if any(each.severity is Certainty.CERTAIN for each in found):
        return "the QoS is incompatible"
    return ""


def match(
    publisher: SeenEndpoint,
    subscription: SeenEndpoint,
    publishers: Sequence[SeenEndpoint],
    subscriptions: Sequence[SeenEndpoint],
) -> Match | None:
    """Judge whether two ends that can match are matched, by what both say of each other.

    `publishers` and `subscriptions` are all of the topic in the graph, tools' included. None if
    neither end reports its matches.
    """
    answers = [
        answer
        for answer in (
            _of_one_end(publisher, subscriptions),
            _of_one_end(subscription, publishers),
        )
        if answer is not None
    ]
    if not answers:
        return None
    worst = Outcome.worst(outcome for outcome, _ in answers)
    if worst is not Outcome.VIOLATED and _OK in answers:
        return _OK  # a count that is that of all who can match one end proves the pair
    reasons = dict.fromkeys(reason for outcome, reason in answers if outcome is worst)
    return worst, ", ".join(reasons)


def check(view: View) -> Iterator[Finding]:
    """Judge every planned flow, every end that reports how many peers it has, every client."""
    for flow in view.flows:
        yield from _judge_flow(flow, view.topics.get(flow.planned.topic, _NO_ENDS))
    yield from _unknown_peers(view)
    yield from _unreported_flows(view)
    yield from _clients(view)


def _unknown_peers(view: View) -> Iterator[Finding]:
    """Find declared ends that are matched with more than all that can match them.

    That is what the graph shows, and what is declared and not seen (yet), which has a finding of
    its own. Where any node may be there, so may what nobody shows. What every client library
    subscribes to by itself, /clock, is left out of the graph, and so cannot be counted. Nodes of
    another machine are for its supervisor: it sees tools that look no further than that machine.
    """
    if view.plan.policy.undeclared_nodes is EndpointPolicy.OPEN:
        return
    unseen = Counter((each.kind, each.name) for each in view.actual if each.observed is None)
    if any(each.health is not None and each.health.diagnostics for each in view.plan.nodes):
        unseen[(EndpointKind.SUBSCRIPTION, DIAGNOSTICS_TOPIC)] += 1  # the supervisor's own
    for actual in view.actual:
        report = actual.report
        if report is None or not report.matched or not actual.kind.is_topic:
            continue
        if not brings_up(actual.owner, view.machines):
            continue
        publishers, subscriptions = view.topics.get(actual.name, _NO_ENDS)
        publishes = actual.kind is EndpointKind.PUBLISHER
        known = _possible(actual, subscriptions if publishes else publishers)
        possible = sum(each.whose is not Whose.DEPARTED for each in known)
        other = actual.kind.other_end
        place = (other, actual.name)
        if place in NOISE_TOPICS or report.matched <= len(known) + unseen[place]:
            continue
        yield UNKNOWN_PEER.on(
            actual,
            expected=f"at most the {count(possible, other.noun)} that the graph shows",
            observed=str(report.matched),
        )


def _unreported_flows(view: View) -> Iterator[Finding]:
    """Name all flows at once of which neither end reports anything."""
    flows = [each for each in view.flows if is_unreported(each)]
    if not flows:
        return
    names = [each.subject for each in flows]
    yield UNREPORTED_FLOW.finding(
        subject=names[0] if len(names) == 1 else f"{len(names)} flows",
        who=listed(names, 6),
        ends=flows[0].ends if len(names) == 1 else (),
        expected="a report of one end",
        observed="no report",
        at=flows[0].at,
    )


def is_unreported(flow: FlowView) -> bool:
    """Return whether both ends of a flow are there and fit, and neither reports its matches."""
    if flow.planned.linked or _cause(flow):
        return False  # a link has a finding of its own, and so has what cannot match
    return all(end.report is None or end.report.matched is None for end in flow.endpoints)


def _judge_flow(flow: FlowView, ends: TopicEnds) -> Iterator[Finding]:
    linked = flow.planned.linked
    if cause := _cause(flow):
        outcome, reason = Outcome.VIOLATED, cause
    else:
        writer, reader = flow.endpoints
        outcome, reason = match(writer, reader, *ends) or (
            Outcome.UNVERIFIABLE if linked else Outcome.OK,
            "neither end reports whom it is matched with",
        )
    if outcome is Outcome.OK or (cause and not linked):
        return  # a cause has its own finding already
    rule = UNMATCHED_LINK if linked else UNMATCHED_FLOW
    yield rule.on(flow, outcome=outcome, expected="matched", observed=reason)


def _cause(flow: FlowView) -> str:
    """Return why the two ends cannot match at all; empty if they can."""
    for word, node, end in (
        ("publisher", flow.publisher, flow.writer),
        ("subscription", flow.subscription, flow.reader),
    ):
        if end is None:
            return f"{node} declares no {word} of it"
        if end.observed is None and not end.beyond:
            return f"the {word} is missing"
    return obstacle(*flow.endpoints)


def _of_one_end(end: SeenEndpoint, others: Sequence[SeenEndpoint]) -> Match | None:
    """Return what one end's count says; None if it does not report its matches.

    It proves a pair only if it is that of all who can match the end.
    """
    report = end.report
    if report is None or report.matched is None:
        return None
    matched, known = report.matched, _possible(end, others)
    possible = [each for each in known if each.whose is not Whose.DEPARTED]
    word = f"the {end.kind.noun}"
    reason = f"{word} matched {matched} of {len(possible)}" if matched else f"{word} matched none"
    if matched in (len(possible), len(known)):
        return _OK
    knows_all = all(each.whose is Whose.DECLARED for each in possible)
    if matched < len(possible) and (matched == 0 or knows_all):
        return Outcome.VIOLATED, reason
    return Outcome.UNVERIFIABLE, f"{reason}, and does not tell which"


def _possible(end: SeenEndpoint, others: Sequence[SeenEndpoint]) -> list[SeenEndpoint]:
    """Return the ends that can match one."""
    publishes = end.kind is EndpointKind.PUBLISHER
    return [
        other
        for other in others
        if not (obstacle(end, other) if publishes else obstacle(other, end))
    ]


UNMATCHED_CLIENT = _rule(
    id="graph.unmatched-client",
    meaning="a declared client and a declared server of its service or action are not matched",
    fix="look at the QoS of both ends, and at the network between the two",
)
RULES = (UNMATCHED_LINK, UNMATCHED_FLOW, UNKNOWN_PEER, UNREPORTED_FLOW, UNMATCHED_CLIENT)

SERVER_OF = {
    EndpointKind.SERVICE_CLIENT: EndpointKind.SERVICE_SERVER,
    EndpointKind.ACTION_CLIENT: EndpointKind.ACTION_SERVER,
}


def _clients(view: View) -> Iterator[Finding]:
    """Judge every declared client that reports and of which declared servers are there.

    A client without a report has its own finding if it is ours; of others no more can be seen than
    that both ends are there and of one type, as of their topics. Which server it is matched with is
    not reported: one is enough.
    """
    servers: dict[tuple[EndpointKind, str, str], list[str]] = {}
    for each in view.actual:
        if each.observed is not None and each.kind in SERVER_OF.values():
            servers.setdefault((each.kind, each.name, each.type), []).append(each.node)
    for client in view.actual:
        report, kind = client.report, SERVER_OF.get(client.kind)
        if kind is None or client.observed is None or report is None:
            continue
        found = servers.get((kind, client.name, client.type))
        # One that is not mapped is about to go, or discovery is ahead of the report.
        if not found or not report.mapped or report.server_matched:
            continue
        violated = report.server_matched is False
        whom = f"{client.node} → {listed(sorted({*found}), 2)}"
        why = "the client counts no server as available"
        says = f"{whom} are not matched"
        if not violated:
            why, says = "its client does not report it", f"nothing proves that {whom} are matched"
        yield UNMATCHED_CLIENT.on(
            client,
            outcome=Outcome.VIOLATED if violated else Outcome.UNVERIFIABLE,
            subject=f"{client.name}: {whom}",
            ends=(client.node, found[0]),
            expected="matched",
            observed=why,
            message=f"{says} on {client.kind.meets_in} {client.name}: {why}",
        )
