"""Rules about data as they arrive: delay, rate, loss and silence of flows. Pure.

Judged is what a subscription has counted, in nodes of ours, once that can decide the declared
number (`lifecycle.measure.bounds`). Until then a bound is "measuring": it is neither ok nor
violated. What nothing counts is unverifiable by name, from the first gate on.

A 5QI stands for its packet delay budget, which 98 % of the packets keep, and its packet error rate
(TS 23.501 Table 5.7.4-1, clause 5.7.3.4).
"""

from __future__ import annotations

import functools
from collections.abc import Iterator

from lifecycle.manifest.model import EndpointKind, Quantity, TargetState
from lifecycle.measure.bounds import RATE_SLACK, Bound, Judgement, Kind, apart, judge, ms
from lifecycle.measure.clock import SAME_CLOCK, ClockOffset
from lifecycle.measure.sample import DELAY_S, Sample
from lifecycle.network.five_qi import five_qi_of
from lifecycle.plan.model import Plan
from lifecycle.verify.outcome import Outcome
from lifecycle.verify.rules.catalogue import Heals, Rule
from lifecycle.verify.rules.flows import is_missing
from lifecycle.verify.verdict import Finding, FlowMeasurement, MeasuredBound, Stage
from lifecycle.verify.view import Actual, FlowView, NodeFacts, View, brings_up

PROBATION_S = 10.0
"""What can be decided at all in a system that was brought up is waited for this long."""

_FIVE_QI_QUANTILE = 0.98

_DELAYS = frozenset({Kind.DELAY, Kind.NETWORK_DELAY})


def _rule(id_: str, meaning: str, fix: str) -> Rule:
    return Rule(
        id=id_,
        meaning=meaning,
        outcomes=(Outcome.VIOLATED,),
        fix=fix,
        heals=Heals.WITH_TIME,
        measured=True,
    )


DELAY = _rule(
    "flow.delay",
    "data arrive later than the manifest allows",
    "see what is slow: the network (`lifecycle flows`, `--program`), or the subscribing node, whose"
    " callbacks begin late",
)
RATE = _rule(
    "flow.rate",
    "data arrive less often, or more often, than the manifest says",
    "see whether the publisher is slow, or what is lost on the way",
)
LOSS = _rule(
    "flow.loss",
    "more messages are lost than the manifest allows",
    "lost is what does not reach the callback: on the network, or because a QoS depth is too small"
    " for a callback that is slow",
)
SILENT = _rule(
    "flow.silent",
    "nothing has arrived for longer than the manifest allows",
    "see whether the publisher publishes; its node is active and matched",
)
NOT_MEASURED = Rule(
    id="flow.not-measured",
    meaning="a number that the manifest declares of a flow has not been measured",
    outcomes=(Outcome.UNVERIFIABLE,),
    fix="have the subscribing node run in our host (`run: python`), or leave the number out of the"
    " manifest; `--strict` refuses it, and so does `policy.unverifiable: block`",
    heals=Heals.NEVER,
    names_expected=True,
)
SILENT_SO_FAR = Rule(
    id="flow.nothing-arrived",
    meaning="a number cannot be measured, because nothing has arrived since activation",
    outcomes=(Outcome.UNVERIFIABLE,),
    fix="see whether the publisher publishes; declare `max_silence_s` where it must",
    heals=Heals.WITH_TIME,
    names_expected=True,
    measured=True,
)
RULES = (DELAY, RATE, LOSS, SILENT, NOT_MEASURED, SILENT_SO_FAR)

_RULES = {
    Kind.DELAY: DELAY,
    Kind.NETWORK_DELAY: DELAY,
    Kind.RATE: RATE,
    Kind.LOSS: LOSS,
    Kind.SILENCE: SILENT,
}


def bounds_of(quantity: Quantity) -> tuple[Bound, ...]:
    """Return what a declared number means; none for one that is no property of what arrives."""
    value = quantity.value
    if quantity.name == "max_delay_ms":
        return (Bound(kind=Kind.DELAY, most=value, quantile=quantity.quantile),)
    if quantity.name == "rate_hz":
        slack = RATE_SLACK if quantity.most is None else 0.0
        return (Bound(kind=Kind.RATE, least=value, most=quantity.most, slack=slack),)
    if quantity.name == "loss":
        return (Bound(kind=Kind.LOSS, most=value),)
    if quantity.name == "max_silence_s":
        return (Bound(kind=Kind.SILENCE, most=value),)
    if quantity.name == "five_qi":
        return _of_five_qi(int(value))
    return ()


@functools.cache
def _of_five_qi(value: int) -> tuple[Bound, ...]:
    try:
        class_ = five_qi_of(value)
    except ValueError:  # one of an operator's own
        return ()
    budget_ms = class_.packet_delay_budget_ms
    return (
        Bound(kind=Kind.NETWORK_DELAY, most=budget_ms, quantile=_FIVE_QI_QUANTILE),
        Bound(kind=Kind.LOSS, most=class_.packet_error_rate),
    )


def compares_clocks(plan: Plan) -> bool:
    """Return whether a plan bounds delays, and data pass between its machines."""
    machines = {node.key: node.machine for node in plan.nodes}
    return any(machines[each.publisher] != machines[each.subscription] for each in plan.flows) and (
        any(bound.kind in _DELAYS for number in plan.bounds for bound in bounds_of(number))
    )


def check(view: View) -> Iterator[Finding]:
    """Judge every number that is declared of a flow, or name it as not measured."""
    for actual in view.actual:
        if actual.planned.kind is EndpointKind.PUBLISHER and _is_there(actual):
            flows = [flow for flow in view.flows if actual in flow.publishers]
            for quantity in actual.planned.quantities:
                yield from _unmeasured_at(view, actual, quantity, flows)
    for flow in view.flows:
        if is_missing(flow):
            continue
        for quantity in flow.planned.quantities:
            why = _why_not(view, flow, quantity)
            if why:
                where = f"the flow {flow.publisher} → {flow.subscription} on {flow.planned.topic}"
                yield NOT_MEASURED.finding(
                    subject=flow.subject,
                    expected=str(quantity),
                    observed="not measured",
                    message=f"{quantity} of {where} is not measured: {why}",
                    at=quantity.at,
                    ends=flow.ends,
                )
        yield from _judged(view, flow)


def measurements(view: View) -> tuple[FlowMeasurement, ...]:
    """Return what has arrived of every flow that is counted, in plan order."""
    found = []
    for flow in view.flows:
        sample = None if is_missing(flow) else _sample(view, flow)
        if sample is None or not _is_active(view, flow):
            continue
        past = sample.last(seconds=DELAY_S)
        clock = _clock(view, flow, sample)
        found.append(
            FlowMeasurement(
                topic=flow.planned.topic,
                publisher=flow.publisher,
                subscription=flow.subscription,
                messages=past.messages,
                lost=None if sample.lost is None or _publishers(view, flow) > 1 else past.lost,
                rate_hz=past.rate_hz,
                p50_ms=_corrected(sample, 0.5, clock),
                p99_ms=_corrected(sample, 0.99, clock),
                clock=clock if clock != SAME_CLOCK else None,
                bounds=tuple(
                    _bound(quantity, judgement)
                    for quantity, _, judgement in _judgements(view, flow, sample)
                ),
            )
        )
    return tuple(found)


def _corrected(sample: Sample, quantile: float, clock: ClockOffset | None) -> float | None:
    """Return a quantile of delays as one clock shows them, milliseconds; None if not known."""
    found = sample.used.quantile_ms(quantile)
    return None if found is None or clock is None else max(0.0, found + clock.offset_ms)


def _bound(quantity: Quantity, judgement: Judgement) -> MeasuredBound:
    undecided = "unverifiable" if _is_given_up(judgement) else "measuring"
    outcome = {None: undecided, True: "ok", False: "violated"}[judgement.kept]
    between = f", {undecided} " if judgement.observed and judgement.kept is None else " "
    return MeasuredBound(
        name=quantity.name,
        outcome=outcome,
        text=f"{judgement.observed}{between}{judgement.allowed}".strip(),
        decides_in_s=judgement.decides_in_s,
    )


def _is_given_up(judgement: Judgement) -> bool:
    """Return whether a delay is not decided for the clocks of two hosts, and not before long."""
    return judgement.needs_clocks and judgement.decides_in_s is None


def _judged(view: View, flow: FlowView) -> Iterator[Finding]:
    sample = _sample(view, flow)
    if sample is None or not _is_active(view, flow):
        return
    where = f"the flow {flow.publisher} → {flow.subscription} on {flow.planned.topic}"
    for quantity, bound, judgement in _judgements(view, flow, sample):
        observed = f"{judgement.observed} {judgement.allowed}"
        if judgement.kept is False:
            yield _RULES[bound.kind].finding(
                subject=flow.subject,
                expected=str(quantity),
                observed=judgement.observed,
                message=f"{where}: {observed}",
                at=quantity.at,
                ends=flow.ends,
            )
        elif _is_given_up(judgement) and view.clocks is not None:
            clock = _clock(view, flow, sample)
            why = _too_uncertain(quantity, bound, judgement.observed, flow, clock)
            yield NOT_MEASURED.finding(
                subject=flow.subject,
                expected=str(quantity),
                observed=judgement.observed or "not measured",
                message=f"{quantity} of {where} is not measured: {why}",
                at=quantity.at,
                ends=flow.ends,
            )
        elif judgement.kept is None and not sample.messages and sample.seconds > PROBATION_S:
            yield SILENT_SO_FAR.finding(
                subject=flow.subject,
                expected=str(quantity),
                observed="no message",
                message=f"{quantity} of {where} is not measured: nothing has arrived for"
                f" {sample.silent_s:.0f} s",
                at=quantity.at,
                ends=flow.ends,
            )


def _judgements(
    view: View, flow: FlowView, sample: Sample
) -> Iterator[tuple[Quantity, Bound, Judgement]]:
    """Judge each number of a flow that can be measured, the same one only once."""
    publisher = flow.nodes[0].configuration
    counts = publisher is not None and publisher.measured is not None
    near = brings_up(flow.nodes[0].node, view.machines)
    publishes_s = publisher.measured.active_s if counts and near else None  # type: ignore[union-attr]
    clock = _clock(view, flow, sample)
    seen: set[Bound] = set()
    ends = (each for end in flow.publishers for each in end.planned.quantities)
    for quantity in (*flow.planned.quantities, *ends):
        if _why_not(view, flow, quantity):
            continue
        for bound in bounds_of(quantity):
            if bound not in seen and not (bound.kind is Kind.LOSS and sample.lost is None):
                seen.add(bound)
                yield quantity, bound, judge(bound, sample, publishes_s=publishes_s, clock=clock)


def _unmeasured_at(
    view: View, actual: Actual, quantity: Quantity, flows: list[FlowView]
) -> Iterator[Finding]:
    """Name a number of a publisher that is not measured at each of its subscriptions."""
    reasons = [_why_not(view, flow, quantity) for flow in flows if not is_missing(flow)]
    if not flows:
        reasons = ["nothing in the manifest subscribes to it"]
    why = next(filter(None, reasons), "")
    if not why:
        return
    where = f"the publisher of {actual.planned.resolved} in {actual.node.full_name}"
    yield NOT_MEASURED.finding(
        subject=actual.planned.resolved,
        expected=str(quantity),
        observed="not measured",
        message=f"{quantity} of {where} is not measured: {why}",
        at=quantity.at,
        node=actual.node.full_name,
        endpoint=actual.planned.kind,
    )


def _why_not(view: View, flow: FlowView, quantity: Quantity) -> str:
    """Return why a number of a flow cannot be measured; empty if it can."""
    bounds = bounds_of(quantity)
    kinds = {each.kind for each in bounds}
    subscriber = flow.nodes[1]
    if not bounds:
        return "nothing measures it"
    if not subscriber.is_ours:
        return f"{flow.subscription} does not run in our host"
    if kinds & _DELAYS and not _has_clocks(view, flow):
        return "the clocks of the two hosts are not compared"
    several = _publishers(view, flow)
    if several > 1 and kinds - _DELAYS:
        return f"nothing shows which of the {several} publishers of the topic a message is from"
    sample = _sample(view, flow)
    if Kind.LOSS in kinds and sample is not None and sample.lost is None:
        return "its RMW gives messages no publication sequence numbers"
    return ""


def _too_uncertain(
    quantity: Quantity, bound: Bound, observed: str, flow: FlowView, clock: ClockOffset | None
) -> str:
    """Return why a delay is not decided, for what is known of the clocks of the two hosts."""
    assert bound.most is not None
    clocks = f"the clocks of {' and '.join(each.node.machine for each in flow.nodes)}"
    if clock is None:
        return f"{clocks} are not compared yet, or one was set a moment ago"
    if clock.uncertainty_ms <= bound.most:
        differ = f"{clocks} differ by {apart(clock)}"
        return f"{observed} may be more than {ms(bound.most)}, or not: {differ}"
    named = "" if quantity.name == "max_delay_ms" else f"the {ms(bound.most)} of "
    return f"{clocks} differ by {apart(clock)}, which is more than {named}{quantity}"


def _publishing(view: View, flow: FlowView) -> Iterator[FlowView]:
    """Yield the flows by which a subscription of the flow gets its messages."""
    for each in view.flows:
        if (each.planned.topic, each.subscription) == (flow.planned.topic, flow.subscription):
            yield each


def _clock(view: View, flow: FlowView, sample: Sample) -> ClockOffset | None:
    """Return what is known of the clocks of all who publish to a subscription; None if one is not.

    Nothing shows which of several publishers a message is from.
    """
    far = {each.nodes[0].node.machine for each in _publishing(view, flow) if _differ(each)}
    if not far:
        return SAME_CLOCK
    clocks = view.clocks or {}
    # Where no shift is, it was counted as of this host's clock: the plan was another then.
    if sample.used.shift_ns is None or not far <= clocks.keys():
        return None
    near = [SAME_CLOCK] if not all(map(_differ, _publishing(view, flow))) else []
    return ClockOffset.any_of((*near, *(clocks[each] for each in far)))


def _has_clocks(view: View, flow: FlowView) -> bool:
    """Return whether a supervisor on each host of a flow compares its clock with the other's."""
    machines = {each.node.machine for each in flow.nodes}
    return not _differ(flow) or (
        view.machines is not None and len(machines) == len(flow.nodes) and "" not in machines
    )


def _differ(flow: FlowView) -> bool:
    """Return whether the two ends are on different hosts, as planned where they do not say."""
    hosts = [each.configuration.identity.machine_id for each in flow.nodes if each.configuration]
    if len(hosts) < len(flow.nodes):
        hosts = [each.node.machine for each in flow.nodes]
    return len({*hosts}) > 1


def _publishers(view: View, flow: FlowView) -> int:
    """Return how many publishers a subscription of the flow has, planned or matched."""
    planned = sum(len(each.publishers) or 1 for each in _publishing(view, flow))
    matched = [each.report.matched or 0 for each in flow.subscriptions if each.report is not None]
    return max((planned, *matched))


def _sample(view: View, flow: FlowView) -> Sample | None:
    """Return what a subscription has counted, where its node is one that is brought up here."""
    facts: NodeFacts = flow.nodes[1]
    configuration = facts.configuration
    # Of a node of another supervisor, that one has what it counts.
    if configuration is None or not facts.is_ours or not brings_up(facts.node, view.machines):
        return None
    measured = configuration.measured
    found = None if measured is None else measured.of(flow.planned.topic)
    return found or Sample(seconds=0.0)  # it has not reported yet


def _is_active(view: View, flow: FlowView) -> bool:
    """Return whether both ends are to be active, and are as far as they say."""
    return view.stage is Stage.ACTIVE and all(
        not facts.absent
        and (not facts.node.managed or facts.node.state is TargetState.ACTIVE)
        and (facts.configuration is None or facts.configuration.state in ("", "active"))
        for facts in flow.nodes
    )


def _is_there(actual: Actual) -> bool:
    return actual.observed is not None or actual.report is not None
