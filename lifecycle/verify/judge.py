"""Verifies a running ROS 2 system against its plan: Plan × Observation → Verdict. Pure.

Also one FlowReport per planned flow, and the one-line summaries of what a verdict still waits for
or accepts unverified.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence

from msgspec.structs import replace

from lifecycle.manifest.model import EndpointKind, EndpointPolicy, Policy, UniqueHow
from lifecycle.network.medium import Medium
from lifecycle.network.nfe import NetworkFlowEndpoint, TransportProtocol
from lifecycle.plan.model import Plan
from lifecycle.printable import listed
from lifecycle.verify.matcher import lay_out
from lifecycle.verify.network_flows import Uniqueness, effective_transport
from lifecycle.verify.observation import Observation
from lifecycle.verify.outcome import Outcome
from lifecycle.verify.rules import CHECKS, rule
from lifecycle.verify.rules.matching import is_unreported
from lifecycle.verify.rules.measured import NOT_MEASURED, OF_NUMBERS, measurements
from lifecycle.verify.tool_filter import OUR_NODES
from lifecycle.verify.verdict import (
    Finding,
    FlowReport,
    Stage,
    ToleratedNode,
    Verdict,
)
from lifecycle.verify.view import Actual, FlowView, View, Whose, flow_subject

_OF_NUMBERS = frozenset(each.id for each in OF_NUMBERS)
_HOW = (UniqueHow.NOT, UniqueHow.WEAKLY, UniqueHow.STRONGLY)


def flow_reports(view: View, findings: Sequence[Finding]) -> tuple[FlowReport, ...]:
    """Report every planned flow, in plan order."""
    spoiled = _spoiled(findings)
    return tuple(_reported(flow, view.uniqueness, spoiled) for flow in view.flows)


_Place = tuple[str, str, EndpointKind | None]


_OTHER_PROTOCOL = {
    each.value: TransportProtocol.UDP if each.is_tcp else TransportProtocol.TCP
    for each in Medium
    if each.is_network
}


def _spoiled(findings: Iterable[Finding]) -> dict[_Place, Outcome]:
    """Worst outcome of the findings that concern flows, by (subject, node, endpoint kind)."""
    worst: dict[_Place, Outcome] = {}
    for finding in findings:
        if not rule(finding.rule).concerns_flow:
            continue
        place = (finding.subject, finding.node, finding.endpoint)
        if worst.get(place) is not Outcome.VIOLATED:
            worst[place] = finding.outcome
    return worst


def _places(topic: str, publisher: str, subscription: str) -> tuple[_Place, ...]:
    """Return where findings are that concern the flow between two nodes."""
    return (
        (flow_subject(topic, publisher, subscription), "", None),
        (publisher, publisher, None),
        (subscription, subscription, None),
        (topic, publisher, EndpointKind.PUBLISHER),
        (topic, subscription, EndpointKind.SUBSCRIPTION),
    )


def _outcome(flow: FlowView, spoiled: dict[_Place, Outcome]) -> Outcome:
    places = _places(flow.planned.topic, *flow.ends)
    unreported = (Outcome.UNVERIFIABLE,) if is_unreported(flow) else ()
    return Outcome.worst((*unreported, *(spoiled[each] for each in places if each in spoiled)))


def _reported(flow: FlowView, uniqueness: Uniqueness, spoiled: dict[_Place, Outcome]) -> FlowReport:
    ends = (uniqueness.is_unique(flow.writer), uniqueness.is_unique(flow.reader))
    carrier = effective_transport(flow)
    return FlowReport(
        topic=flow.planned.topic,
        publisher=flow.publisher,
        subscription=flow.subscription,
        source=_used(uniqueness.nfes(flow.writer), carrier),
        destination=_used(uniqueness.nfes(flow.reader), carrier),
        unique=None if None in ends else _HOW[ends.count(True)],
        dscp=_dscp(flow.writer, carrier),
        reader_dscp=_dscp(flow.reader, carrier),
        requirement=flow.requirement,
        demanded=flow.planned.unique,
        outcome=_outcome(flow, spoiled),
        max_delay_ms=flow.planned.max_delay_ms,
        five_qi=flow.five_qi,
        five_qi_reason=flow.writer.planned.five_qi_reason if flow.writer else "",
        effective_transport=carrier,
    )


def _used(nfes: tuple[NetworkFlowEndpoint, ...], carrier: str) -> tuple[NetworkFlowEndpoint, ...]:
    """Leave out sockets of the other protocol, where it is known that TCP or UDP carries the flow.

    An endpoint on a connection of several transports lists the sockets of all of them, and a rule
    made from those would catch other flows.
    """
    other = _OTHER_PROTOCOL.get(carrier)
    return tuple(each for each in nfes if each.transport_protocol is not other)


def _dscp(end: Actual | None, carrier: str) -> int | None:
    """The DSCP that was read back; None if none was.

    Only UDP sockets are marked and read: of a connection that has both, TCP does not carry it.
    """
    if end is None or end.report is None:
        return None
    return None if _OTHER_PROTOCOL.get(carrier) is TransportProtocol.UDP else end.report.dscp


def verify(
    plan: Plan,
    observation: Observation,
    *,
    stage: Stage,
    machines: frozenset[str] | None = None,
    ahead: frozenset[str] = frozenset(),
    over: Mapping[str, str] | None = None,
) -> Verdict:
    """Judge what was seen of a system against what was planned.

    Every rule is applied, so that all findings come at once. The result depends on the content of
    the arguments alone, not on the order of what was observed.

    Args:
        plan: what must be.
        observation: what was seen, tools and client library endpoints left in or not.
        stage: which moment it is judged against.
        machines: names of the machines whose nodes the caller brings up; those of others are
            brought up elsewhere and may be active before ours. None: all are ours.
        ahead: fully qualified names of nodes that an earlier gate let through, which may be active
            although this one has not opened yet.
        over: how the process ended of nodes that may end by themselves, by fully qualified name;
            empty where it is not known whether it has.
    """
    view = lay_out(plan, observation, stage, machines=machines, ahead=ahead, over=over)
    findings = tuple(finding for check in CHECKS for finding in check(view))
    judged = Verdict(
        verdict=Outcome.OK,
        blocking=False,
        findings=(),
        flows=flow_reports(view, findings),
        tolerated=_tolerated(view),
        measured=measurements(view),
    )
    return with_only(judged, findings, plan.policy)


def without_measured(verdict: Verdict, policy: Policy) -> Verdict:
    """Return `verdict` as it is while nodes pass a gate: what has arrived does not close it."""
    kept = tuple(each for each in verdict.findings if not rule(each.rule).measured)
    return replace(with_only(verdict, kept, policy), measured=())


def with_measured(verdict: Verdict, others: Iterable[Verdict], policy: Policy) -> Verdict:
    """Return `verdict` with what `others` measured of flows, and found, in place of its own."""
    others = tuple(others)
    theirs = {each.pair: each for other in others for each in other.measured}

    def is_theirs(finding: Finding) -> bool:
        """Whether it is of a number of such a flow, or of an endpoint that has no other flows."""
        pairs = {
            each.pair
            for each in verdict.flows
            if finding.subject in (each.topic, flow_subject(*each.pair))
            and set(finding.nodes) <= {*each.pair}
        }
        return finding.rule in _OF_NUMBERS and bool(pairs) and pairs <= theirs.keys()

    own = (each for each in verdict.findings if not is_theirs(each))
    found = (each for other in others for each in other.findings if is_theirs(each))
    measured = {each.pair: each for each in verdict.measured} | theirs
    taken = with_only(verdict, (*own, *found), policy)
    return replace(taken, measured=tuple(measured.values()))


def apart_from_numbers(verdict: Verdict) -> Verdict:
    """Return `verdict` without what is another number each time it is measured."""
    findings = tuple(
        replace(each, observed="", message="")
        if rule(each.rule).measured or each.rule == NOT_MEASURED.id
        else each
        for each in verdict.findings
    )
    return replace(verdict, findings=findings, measured=())


def with_only(verdict: Verdict, findings: tuple[Finding, ...], policy: Policy) -> Verdict:
    """Return `verdict` with these of its findings, and what follows from them."""
    return replace(
        verdict,
        verdict=Outcome.worst(each.outcome for each in findings if not is_trusted(each, policy)),
        blocking=_blocks(findings, policy),
        findings=findings,
    )


def without_findings(verdict: Verdict, dropped: Collection[Finding], policy: Policy) -> Verdict:
    """Return `verdict` as if these findings had not been made; its flows follow, too."""
    kept = tuple(each for each in verdict.findings if each not in dropped)
    spoiled, freed = _spoiled(kept), _spoiled(dropped)

    def judged(flow: FlowReport) -> FlowReport:
        places = _places(flow.topic, flow.publisher, flow.subscription)
        if freed.keys().isdisjoint(places):
            return flow
        left = (spoiled[each] for each in places if each in spoiled)
        return replace(flow, outcome=Outcome.worst(left))

    return replace(with_only(verdict, kept, policy), flows=tuple(map(judged, verdict.flows)))


def with_findings(verdict: Verdict, findings: tuple[Finding, ...], policy: Policy) -> Verdict:
    """Return `verdict` with what the supervisor itself found, before the other findings.

    It makes a verdict worse, never better.
    """
    if not findings:
        return verdict
    added = with_only(verdict, (*findings, *verdict.findings), policy)
    worst = Outcome.worst((verdict.verdict, added.verdict))
    return replace(added, verdict=worst, blocking=verdict.blocking or added.blocking)


def _tolerated(view: View) -> tuple[ToleratedNode, ...]:
    """List the undeclared nodes that the policy lets be there, sorted by name."""
    tools = {name: pattern for name, pattern in view.tools.items() if pattern != OUR_NODES}
    because = {name: f"tolerated_nodes: {pattern}" for name, pattern in tools.items()}
    if view.plan.policy.undeclared_nodes is EndpointPolicy.OPEN:
        others = {*view.observed, *(each.node for each in view.of(Whose.FOREIGN, Whose.UNKNOWN))}
        because |= dict.fromkeys(others - view.planned.keys(), "undeclared_nodes: open")
    return tuple(ToleratedNode(node=name, because=because[name]) for name in sorted(because))


def is_trusted(finding: Finding, policy: Policy) -> bool:
    """Return whether the manifest takes what a finding could not verify on trust."""
    return finding.outcome is Outcome.UNVERIFIABLE and finding.rule in policy.trust


def _blocks(findings: Sequence[Finding], policy: Policy) -> bool:
    return any(
        finding.outcome is Outcome.VIOLATED
        or (
            policy.unverifiable_blocks
            and rule(finding.rule).may_block
            and not is_trusted(finding, policy)
        )
        for finding in findings
    )


_NAMED_EACH = 2
_NAMED_RULES = 4
_LONGEST = 500


def summary(findings: Iterable[Finding]) -> str:
    """Summarise findings in one bounded line, for the message of a deadline or of a gate.

    Returns:
        `/camera, /viewer and 3 more (graph.missing-node); max_delay_ms 5 of /video: /camera →
        /viewer (flow.not-measured)`: by rule, at most two of each; empty without any. What is not
        known while what would show it is missing is not named.
    """
    by_rule: dict[str, dict[str, None]] = {}
    for each in findings:
        what = f"{each.expected} of {each.subject}" if rule(each.rule).numbers else each.subject
        by_rule.setdefault(each.rule, {})[what] = None
    awaited = {each: rule(each).awaits for each in by_rule}
    parts = [
        f"{listed(list(subjects), _NAMED_EACH)} ({rule_id})"
        for rule_id, subjects in by_rule.items()
        if (awaits := awaited[rule_id]) is None or awaits.id not in by_rule
    ]
    if len(parts) > _NAMED_RULES:
        parts[_NAMED_RULES:] = [f"and {len(parts) - _NAMED_RULES} more rules"]
    line = "; ".join(parts)
    return line if len(line) <= _LONGEST else f"{line[: _LONGEST - 1]}…"


def missing(verdict: Verdict) -> str:
    """Summarise the findings that keep the gate closed; empty when nothing is waited for."""
    violated = [each for each in verdict.findings if each.outcome is Outcome.VIOLATED]
    return summary(violated or (verdict.findings if verdict.blocking else ()))


def not_ok(verdict: Verdict) -> str:
    """Summarise what keeps a verdict from being ok, whether it closes the gate or not."""
    return missing(verdict) or summary(verdict.findings)


def taken_on_trust(verdict: Verdict) -> str:
    """Summarise what is unverifiable, for a gate that opens in spite of it."""
    return summary(each for each in verdict.findings if each.outcome is Outcome.UNVERIFIABLE)
