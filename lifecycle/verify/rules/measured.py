"""Rules about data as they arrive: delay, rate, loss and silence of flows. Pure.

Judged is what a subscription has counted, once that can decide the declared number
(`lifecycle.measure.flows`); until then a bound is "measuring". What nothing counts is unverifiable
by name, from the first gate on. A 5QI stands for its packet delay budget, which 98 % of the packets
keep, and its packet error rate (TS 23.501 Table 5.7.4-1, clause 5.7.3.4).
"""

from __future__ import annotations

import functools
from collections.abc import Iterable, Iterator, Sequence

import msgspec

from lifecycle.manifest.model import EndpointKind, Executor, Quantity, TargetState
from lifecycle.measure.clock import SAME_CLOCK, ClockOffset
from lifecycle.measure.flows import (
    Bound,
    FlowMeasurement,
    Judgement,
    Kind,
    MeasuredBound,
    Pair,
    apart,
    judge,
    ms,
)
from lifecycle.measure.sample import DELAY_S, Sample
from lifecycle.network.dscp import describe
from lifecycle.network.five_qi import five_qi_of
from lifecycle.plan.model import Plan
from lifecycle.verify.outcome import Outcome
from lifecycle.verify.rules.catalogue import Heals, Rule
from lifecycle.verify.rules.flows import is_missing
from lifecycle.verify.verdict import Finding, Stage
from lifecycle.verify.view import Actual, FlowView, NodeFacts, View, Whose, brings_up

PROBATION_S = 10.0
"""What can be decided at all in a system that was brought up is waited for this long."""

_FIVE_QI_QUANTILE = 0.98
_DELAYS = frozenset({Kind.DELAY, Kind.NETWORK_DELAY})

_rule = functools.partial(Rule, heals=Heals.WITH_TIME, measured=True)

DELAY = _rule(
    id="flow.delay",
    meaning="data arrive later than the manifest allows",
    fix="see what is slow: the network (`lifecycle flows`, `--program`), or the subscribing node,"
    " whose callbacks begin late",
)
RATE = _rule(
    id="flow.rate",
    meaning="data arrive less often, or more often, than the manifest says",
    fix="see whether the publisher is slow, or what is lost on the way",
)
LOSS = _rule(
    id="flow.loss",
    meaning="more messages are lost than the manifest allows",
    fix="lost is what does not reach the callback: on the network, or because a QoS depth is too"
    " small for a callback that is slow",
)
SILENT = _rule(
    id="flow.silent",
    meaning="nothing has arrived for longer than the manifest allows",
    fix="see whether the publisher publishes; its node is active and matched",
)
_UNMEASURED = "{expected} of {who} is not measured: {observed}"
NOT_MEASURED = Rule(
    id="flow.not-measured",
    meaning="a number that the manifest declares of a flow has not been measured",
    outcomes=(Outcome.UNVERIFIABLE,),
    unproven=_UNMEASURED,
    fix="have the subscribing node run in our host (`run: python`), write `measure: true`, or leave"
    " the number out; `--strict` refuses it, and so does `policy.unverifiable: block`",
    heals=Heals.NEVER,
    numbers=True,
)
NOTHING_ARRIVED = Rule(
    id="flow.nothing-arrived",
    meaning="a number cannot be measured, because nothing has arrived since activation",
    outcomes=(Outcome.UNVERIFIABLE,),
    unproven=_UNMEASURED,
    fix="see whether the publisher publishes; declare `max_silence_s` where it must",
    heals=Heals.WITH_TIME,
    numbers=True,
    measured=True,
)
DSCP_LOST = Rule(
    id="flow.dscp-lost",
    meaning="the DSCP of a flow does not arrive at the other host",
    outcomes=(Outcome.VIOLATED, Outcome.UNVERIFIABLE),
    says="what is sent as {expected} beside {who} arrives as {observed}",
    unproven="what is sent as {expected} beside {who} does not arrive",
    fix="have what is between the hosts keep the DSCP (RFC 2474): a router or switch that does not"
    " trust it, a tunnel or a radio link that does not copy it; or have it set it again",
    heals=Heals.WITH_TIME,
    measured=True,
)
OF_NUMBERS = (DELAY, RATE, LOSS, SILENT, NOT_MEASURED, NOTHING_ARRIVED)
RULES = (*OF_NUMBERS, DSCP_LOST)

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
        return (
            Bound(kind=Kind.RATE, least=value or None, most=quantity.most, slack=quantity.slack),
        )
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


class _Counted(msgspec.Struct, frozen=True, kw_only=True, eq=False):
    """A flow of which both ends are seen, and what is declared and counted of it.

    Attributes:
        sample: what its subscription has counted; None where it is judged by another supervisor or
            cannot count.
        several: how many publishers its subscription has.
        publish_s: for how long those that are active have been let publish, seconds; empty where
            that is not known of one.
        has_clocks: both ends are on one host, or a supervisor on each compares its clock.
        clock: what is known of the clocks of all who publish to the subscription; None if one is
            not known.
        own: numbers of its links and its publishers.
        of_topic: numbers of its subscription: they are of the topic, by all its publishers.
    """

    flow: FlowView
    sample: Sample | None
    several: int
    publish_s: tuple[float, ...]
    has_clocks: bool
    clock: ClockOffset | None
    own: tuple[Quantity, ...]
    of_topic: tuple[Quantity, ...]

    @property
    def awaited_s(self) -> float:
        """So long what is declared of it lets it be without a message, at least PROBATION_S."""
        bounds = [bound for each in (*self.own, *self.of_topic) for bound in bounds_of(each)]
        silences = (each.most for each in bounds if each.kind is Kind.SILENCE and each.most)
        periods = (1 / each.least for each in bounds if each.kind is Kind.RATE and each.least)
        return max([PROBATION_S, *silences, *periods])

    def finding(self, rule: Rule, quantity: Quantity, observed: str, message: str = "") -> Finding:
        """Return a finding on one of its numbers."""
        return rule.on(
            self.flow, expected=str(quantity), observed=observed, message=message, at=quantity.at
        )

    def why_not(self, quantity: Quantity) -> str:
        """Return why a number of it cannot be measured; empty if it can."""
        return next(self._reasons(quantity), "")

    def _reasons(self, quantity: Quantity) -> Iterator[str]:
        kinds = {each.kind for each in bounds_of(quantity)}
        if quantity.name == "max_message_size":
            yield "a callback does not show the size of a message"
        elif not kinds:
            yield "128 to 254 are an operator's own classes"
        if not self.flow.nodes[1].is_ours and not self.flow.planned.measure:
            yield f"{self.flow.subscription} does not run in our host"
        elif self.flow.nodes[1].node.run.executor is Executor.EVENTS:
            yield "executor: events gives callbacks no message info"
        if kinds & _DELAYS and not self.has_clocks:
            yield "the clocks of the two hosts are not compared"
        if self.several > 1 and kinds - _DELAYS:
            publishers = f"{self.several} publishers of the topic"
            if quantity not in self.of_topic:
                yield f"nothing shows which of the {publishers} sent what"
            elif Kind.LOSS in kinds:
                yield f"with {publishers} nothing counts what the subscription's full queue drops"
        if Kind.LOSS in kinds and self.sample is not None and self.sample.lost is None:
            yield "its RMW gives messages no publication sequence numbers"

    def judgements(self) -> Iterator[tuple[Quantity, Bound, Judgement]]:
        """Judge each of its numbers that can be measured, the same one only once."""
        if self.sample is None:
            return
        seen: set[Bound] = set()
        for quantity in (*self.own, *self.of_topic):
            if self.why_not(quantity):
                continue
            for bound in bounds_of(quantity):
                if bound not in seen:
                    seen.add(bound)
                    # All of them make the rate of a topic; one is enough for it not to be silent.
                    which = max if bound.kind is Kind.SILENCE else min
                    publishes_s = which(self.publish_s, default=None)
                    judged = judge(bound, self.sample, publishes_s=publishes_s, clock=self.clock)
                    yield quantity, bound, judged


def check(view: View) -> Iterator[Finding]:
    """Judge every number that is declared of a flow, or name it as not measured."""
    counted = _counted(view)
    of_end: dict[tuple[str, EndpointKind, str], list[_Counted]] = {}
    for each in counted:
        for end in {(one.node, one.kind, one.name) for one in each.flow.endpoints}:
            of_end.setdefault(end, []).append(each)
    for actual in view.actual:
        if actual.observed is not None or actual.report is not None:
            for quantity in actual.planned.quantities:
                flows = of_end.get((actual.node, actual.kind, actual.name), [])
                yield from _unmeasured_at(actual, quantity, flows)
    for each in counted:
        for quantity in each.flow.planned.quantities:
            if why := each.why_not(quantity):
                yield each.finding(NOT_MEASURED, quantity, why)
        if _is_active(view, each.flow):
            yield from _judged(view, each)
    yield from _marks(view)


def _marks(view: View) -> Iterator[Finding]:
    """Judge with what DSCP arrives what is sent beside each flow from another host to this one."""
    for flow in view.flows if view.marks else ():
        publisher, subscriber = (each.node for each in flow.nodes)
        if not brings_up(subscriber, view.machines) or not _differ(flow):
            continue
        dscp = flow.writer.planned.dscp if flow.writer else None
        if dscp is None:
            continue
        arrives_as = view.marks.get((publisher.machine, dscp), dscp)
        if arrives_as == dscp:
            continue  # or it is too early
        yield DSCP_LOST.on(
            flow,
            outcome=Outcome.UNVERIFIABLE if arrives_as is None else Outcome.VIOLATED,
            expected=describe(dscp),
            observed="nothing" if arrives_as is None else describe(arrives_as),
        )


def measurements(view: View) -> tuple[FlowMeasurement, ...]:
    """Return what has arrived of every flow that is counted, in plan order."""
    found = []
    for each in _counted(view):
        flow, sample = each.flow, each.sample
        if sample is None or not _is_active(view, flow):
            continue
        past = sample.last(seconds=DELAY_S)
        clock = each.clock
        found.append(
            FlowMeasurement(
                topic=flow.planned.topic,
                publisher=flow.publisher,
                subscription=flow.subscription,
                messages=past.messages,
                lost=None if sample.lost is None or each.several > 1 else past.lost,
                rate_hz=past.rate_hz,
                p50_ms=_corrected(sample, 0.5, clock),
                p99_ms=_corrected(sample, 0.99, clock),
                clock=clock if clock != SAME_CLOCK else None,
                bounds=tuple(
                    _bound(quantity, bound, judgement)
                    for quantity, bound, judgement in each.judgements()
                ),
            )
        )
    return tuple(found)


def decided_by_clocks(
    measured: Iterable[FlowMeasurement],
) -> frozenset[tuple[Pair, Kind, str]]:
    """Return the outcomes of bounds that were decided by what is known of the clocks of two hosts.

    What is known may be from before a clock was set, and is confirmed by an exchange that begins
    after the last message of the sample.
    """
    return frozenset(
        (flow.pair, bound.kind, bound.outcome)
        for flow in measured
        for bound in flow.bounds
        if flow.clock is not None and bound.kind in _DELAYS
    )


def _corrected(sample: Sample, quantile: float, clock: ClockOffset | None) -> float | None:
    """Return a quantile of delays as one clock shows them, milliseconds; None if not known."""
    found = sample.used.quantile_ms(quantile)
    return None if found is None or clock is None else max(0.0, found + clock.offset_ms)


def _bound(quantity: Quantity, bound: Bound, judgement: Judgement) -> MeasuredBound:
    undecided = "unverifiable" if _is_given_up(judgement) else "measuring"
    outcome = {None: undecided, True: "ok", False: "violated"}[judgement.kept]
    between = f", {undecided} " if judgement.observed and judgement.kept is None else " "
    return MeasuredBound(
        name=quantity.name,
        kind=bound.kind,
        outcome=outcome,
        text=f"{judgement.observed}{between}{judgement.allowed}".strip(),
        share=judgement.share,
        decides_in_s=judgement.decides_in_s,
    )


def _is_given_up(judgement: Judgement) -> bool:
    """Return whether a delay is not decided for the clocks of two hosts, and not before long."""
    return judgement.needs_clocks and judgement.decides_in_s is None


def _judged(view: View, each: _Counted) -> Iterator[Finding]:
    for quantity, bound, judgement in each.judgements():
        sample = each.sample
        assert sample is not None
        if judgement.kept is False:
            message = f"{each.flow.where}: {judgement.observed} {judgement.allowed}"
            yield each.finding(_RULES[bound.kind], quantity, judgement.observed, message)
        elif _is_given_up(judgement) and view.clocks is not None:
            why = _too_uncertain(quantity, bound, judgement, each)
            yield each.finding(NOT_MEASURED, quantity, why)
        elif judgement.kept is None and not sample.messages and sample.seconds > each.awaited_s:
            why = f"nothing has arrived for {sample.silent_s:.0f} s"
            yield each.finding(NOTHING_ARRIVED, quantity, why)


def _unmeasured_at(
    actual: Actual, quantity: Quantity, flows: Sequence[_Counted]
) -> Iterator[Finding]:
    """Name a number of an endpoint that is not measured in its flows.

    How often something is published shows wherever it arrives; the rest is another thing in each
    flow.
    """
    reasons = [each.why_not(quantity) for each in flows]
    anywhere = {each.kind for each in bounds_of(quantity)} <= {Kind.RATE, Kind.SILENCE}
    why = next(filter(None, reasons), "")
    if not flows:
        verb = "subscribes to" if actual.kind is EndpointKind.PUBLISHER else "publishes"
        why = f"nothing that is there and declared {verb} it"
    if why and not (anywhere and "" in reasons):
        yield NOT_MEASURED.on(actual, expected=str(quantity), observed=why, at=quantity.at)


def _counted(view: View) -> list[_Counted]:
    arriving: dict[tuple[str, str], list[FlowView]] = {}
    for flow in view.flows:
        arriving.setdefault((flow.planned.topic, flow.subscription), []).append(flow)
    found = []
    for (topic, _), flows in arriving.items():
        reader = flows[0].reader
        numbers = reader.planned.quantities if reader else ()
        seen, _ = view.topics.get(topic, ((), ()))
        publishers = sum(each.whose is not Whose.DEPARTED for each in seen)
        sample = _sample(view, flows[0])
        there = [each for each in flows if not is_missing(each)]
        active = [each for each in there if _is_active(view, each)]
        times = [_publishes_s(view, each.nodes[0]) for each in active]
        publish_s = tuple(each for each in times if each is not None)
        judging = (active or there or flows)[0]
        for flow in there:
            published = flow.writer.planned.quantities if flow.writer else ()
            counted = _Counted(
                flow=flow,
                sample=sample,
                several=max(len(flows), publishers),
                publish_s=() if None in times else publish_s,
                has_clocks=_has_clocks(view, flow),
                clock=_clock(view, flows, sample),
                own=(*flow.planned.quantities, *published),
                of_topic=numbers if flow is judging else (),  # once, for all publishers
            )
            found.append(counted)
    return found


def _publishes_s(view: View, node: NodeFacts) -> float | None:
    """Return for how long a node has been let publish; None if that is not known."""
    if node.name in view.active_s:
        return view.active_s[node.name]
    report = None if node.configuration is None else node.configuration.measured
    if report is None:
        return 0.0 if node.is_ours else None  # one of ours says so within a moment
    return report.active_s


def _too_uncertain(quantity: Quantity, bound: Bound, judgement: Judgement, of: _Counted) -> str:
    """Return why a delay is not decided, for what is known of the clocks of the two hosts."""
    assert bound.most is not None
    publisher, subscriber = (each.node.machine for each in of.flow.nodes)
    clocks, clock = f"the clocks of {publisher} and {subscriber}", of.clock
    if clock is None:
        return f"{clocks} are not compared yet, or one was set a moment ago"
    if clock.uncertainty_ms <= bound.most:
        differ = f"{clocks} differ by {apart(clock)}"
        return f"{judgement.observed} may be more than {ms(bound.most)}, or not: {differ}"
    named = "" if quantity.name == "max_delay_ms" else f"the {ms(bound.most)} of "
    return f"{clocks} differ by {apart(clock)}, which is more than {named}{quantity}"


def _clock(view: View, flows: Sequence[FlowView], sample: Sample | None) -> ClockOffset | None:
    """Return what is known of the clocks of all who publish to a subscription; None if one is not.

    Nothing shows which of several publishers a message is from.

    Args:
        view: has the clocks.
        flows: by which the subscription gets its messages.
        sample: what it has counted.
    """
    far = {each.nodes[0].node.machine for each in flows if _differ(each)}
    if not far:
        return SAME_CLOCK
    clocks = view.clocks or {}
    # It may have been counted as of this host's clock: the plan was another then.
    if sample is None or not sample.used.apart or not far <= clocks.keys():
        return None
    near = [] if all(map(_differ, flows)) else [SAME_CLOCK]
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


def _sample(view: View, flow: FlowView) -> Sample | None:
    """Return what a subscription has counted, where its node is one that is brought up here."""
    facts: NodeFacts = flow.nodes[1]
    if not brings_up(facts.node, view.machines):
        return None  # its own supervisor has what it counts
    if flow.planned.measure and view.measured is not None:
        return view.measured.of(flow.planned.topic)
    configuration = facts.configuration
    if configuration is None or not facts.is_ours:
        return None
    if facts.node.run.executor is Executor.EVENTS:
        return None  # it counts nothing
    measured = configuration.measured
    found = None if measured is None else measured.of(flow.planned.topic)
    return found or Sample(seconds=0.0)  # it has not reported yet


def _is_active(view: View, flow: FlowView) -> bool:
    """Return whether both ends are to be active, and are as far as they say."""
    return view.stage is Stage.ACTIVE and all(
        not facts.absent
        and (not facts.node.managed or facts.node.state is TargetState.ACTIVE)
        and _state_of(facts) in ("", "active")
        for facts in flow.nodes
    )


def _state_of(facts: NodeFacts) -> str:
    """Return the state of a node; empty if it has none, or it is not known."""
    if facts.configuration is not None:
        return facts.configuration.state
    return (facts.observed.state if facts.observed is not None else None) or ""
