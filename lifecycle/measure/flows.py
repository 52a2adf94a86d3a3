"""Declared numbers of flows: whether each is kept once a sample can decide, and how it is shown.

A delay needs 200 messages or 5 s, a loss 10 / bound messages, a rate 2 s and 20 periods, a maximum
alone 7 s at most. Until then nothing is said of it, as a canary analysis says nothing before its
first interval is over. Where few messages decide, more of them must be late or lost than chance
explains. Loads no plan and no rule: `lifecycle status` shows what was measured. Pure.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Iterable
from typing import Annotated

import msgspec

from lifecycle.codec import Count, says
from lifecycle.measure.clock import SAME_CLOCK, ClockOffset
from lifecycle.measure.sample import DELAY_MESSAGES, DELAY_S, LINEAR_NS, Delays, Sample, Slot
from lifecycle.printable import count

RATE_S = 2.0
RATE_PERIODS = 20
MAXIMUM_S = 7.0
"""That data arrive rarely is seen after so long, within the probation of a system."""

LOSS_EVENTS = 10
"""A share is known once so many losses would have been seen at the bound."""

LATE_MESSAGES = 2
"""A quantile of a sample is one of the flow once so many may be late, 2 of 200 for p99."""

CLOCKS_S = 8.0
"""A delay that the clocks of two hosts do not let decide is waited for so long: within the
probation of a system."""

_ONE_PERCENT = 2.326
"""So many standard deviations above the mean are 1 % of a normal distribution."""

REPORTED_S = 1.0
"""The reports of two nodes are of moments that are less than this apart."""


class Kind(enum.Enum):
    """What is measured."""

    DELAY = "delay"  # from publication to the start of the callback
    NETWORK_DELAY = "network delay"  # from publication to reception by the RMW
    RATE = "rate"
    LOSS = "loss"
    SILENCE = "silence"


class Bound(msgspec.Struct, frozen=True, kw_only=True):
    """A declared number.

    Attributes:
        kind: what it bounds.
        least: lower bound, of a rate: hertz; None without.
        most: upper bound, of a delay milliseconds, of a rate hertz, of a loss a share, of a silence
            seconds; None without.
        slack: share of `least` that may be missing.
        quantile: of a delay.
    """

    kind: Kind
    least: float | None = None
    most: float | None = None
    slack: float = 0.0
    quantile: float = 0.99


class Judgement(msgspec.Struct, frozen=True, kw_only=True):
    """What a sample says of a bound.

    Attributes:
        kept: None while the sample cannot decide.
        observed: `delay p99 0.6 ms`; empty while nothing is known.
        allowed: `≤ 5 ms`.
        share: what was observed, divided by the bound; None while nothing is known.
        decides_in_s: about how long it takes yet until a sample can decide, 0 while nothing shows
            that it takes long; None if it can, or where that is not known.
        needs_clocks: the sample is large enough to decide, but too little is known of the clocks of
            the two hosts.
    """

    kept: bool | None
    observed: str
    allowed: str
    share: float | None = None
    decides_in_s: float | None = None
    needs_clocks: bool = False


def judge(
    bound: Bound,
    sample: Sample,
    *,
    publishes_s: float | None = None,
    clock: ClockOffset | None = SAME_CLOCK,
) -> Judgement:
    """Judge a bound by what a subscription has counted.

    `publishes_s` is for how long its publisher has been let publish, seconds, and `clock` that of
    its publisher's host; each is None if it is not known.
    """
    if bound.kind is Kind.DELAY:
        return _delay(bound, sample, sample.used, clock)
    if bound.kind is Kind.NETWORK_DELAY:
        return _delay(bound, sample, sample.received, clock)
    if bound.kind is Kind.RATE:
        return _rate(bound, sample, publishes_s)
    if bound.kind is Kind.LOSS:
        return _loss(bound, sample)
    return _silence(bound, sample, publishes_s)


def _delay(bound: Bound, sample: Sample, delays: Delays, clock: ClockOffset | None) -> Judgement:
    assert bound.most is not None
    found, kept, observed = delays.quantile_ms(bound.quantile), None, ""
    share: float | None = None
    is_enough = found is not None and (
        delays.messages >= DELAY_MESSAGES or delays.seconds >= DELAY_S
    )
    if found is not None and clock is not None:
        delay_ms, unsure_ms = max(0.0, found + clock.offset_ms), clock.uncertainty_ms
        observed = f"{bound.kind.value} {percentile(bound.quantile)} {ms(delay_ms)}"
        share = delay_ms / bound.most
        if clock.uncertainty_ms:
            unsure_ms += LINEAR_NS / 1e6  # the bucket from which it was read is as large
            observed += f" ± {ms(unsure_ms)}"
        is_late = delay_ms - unsure_ms > bound.most
        if is_late and delays.messages < max(DELAY_MESSAGES, LATE_MESSAGES / (1 - bound.quantile)):
            late = delays.later_than(bound.most + unsure_ms - clock.offset_ms)
            is_enough = is_enough and late >= too_many(delays.messages, 1 - bound.quantile)
        if is_enough and is_late:
            kept = False
        elif is_enough and delay_ms + unsure_ms <= bound.most:
            kept = True
    needs_clocks = is_enough and kept is None
    decides_in_s: float | None = None
    if needs_clocks and sample.seconds < CLOCKS_S:
        decides_in_s = CLOCKS_S - sample.seconds
    elif not is_enough and delays.seconds < DELAY_S:
        decides_in_s = DELAY_S - delays.seconds
    elif not sample.messages:
        decides_in_s = 0.0
    return Judgement(
        kept=kept,
        observed=observed,
        allowed=_limit("≤", ">", kept, ms(bound.most)),
        share=share,
        decides_in_s=decides_in_s,
        needs_clocks=needs_clocks,
    )


def too_many(messages: int, share: float) -> int:
    """Return how many late or lost messages are no chance any more, where a share of all may be.

    Were each one with that probability, so many would be in 1 % of samples at most: the normal
    approximation of the binomial distribution, and 2 more because that is skewed. That all of the
    messages are is never chance.
    """
    expected = messages * share
    spread = math.sqrt(expected * (1 - share))
    return min(messages, int(expected + _ONE_PERCENT * spread + 2))


def _rate(bound: Bound, sample: Sample, publishes_s: float | None) -> Judgement:
    least, most = bound.least, bound.most
    if least is not None:
        limit, needed_s = least, max(RATE_S, RATE_PERIODS / least)
    else:
        assert most is not None
        limit, needed_s = most, min(max(RATE_S, RATE_PERIODS / most), MAXIMUM_S)
    seen = sample.last(seconds=needed_s)
    left_s = max(needed_s - seen.seconds, REPORTED_S)
    decided = seen.seconds >= needed_s
    # It may have begun within the time that is seen, which is a little longer than what is needed.
    published_s = REPORTED_S + (needed_s if least is None else seen.seconds)
    if publishes_s is not None and publishes_s < published_s:
        left_s, decided = max(left_s, needed_s + REPORTED_S - publishes_s), False
    # Where a slot begins and ends makes a difference of one message.
    low = least is not None and seen.messages + 1 < least * (1 - bound.slack) * seen.seconds
    high = None if most is None else _exceeding(most, sample)
    if high is not None:
        decided, seen = True, high
    if most is not None and (high is not None or least is None):
        limit = most
        allowed = _limit("≤", ">", high is None, f"{most:g} Hz")
    else:
        slack = f" - {bound.slack:.0%}" if bound.slack else ""
        allowed = _limit("≥", "<", not low, f"{least:g} Hz{slack}")
    return Judgement(
        kept=not (low or high is not None) if decided else None,
        observed=f"{seen.rate_hz:.1f} Hz" if seen.seconds else "",
        allowed=allowed,
        share=seen.rate_hz / limit if seen.seconds else None,
        decides_in_s=None if decided else left_s,
    )


def _exceeding(most: float, sample: Sample) -> Slot | None:
    """Return a recent past with more messages than a rate allows, whatever else arrives in it."""
    periods_s = max(RATE_S, RATE_PERIODS / most)
    # Of fewer than 20 periods one message more may be late, and be in it.
    for needed_s, spare in ((periods_s, 1), (min(periods_s, MAXIMUM_S), 2)):
        seen = sample.last(seconds=needed_s)
        if seen.seconds >= RATE_S and seen.messages - spare > most * max(seen.seconds, needed_s):
            return seen
    return None


def _loss(bound: Bound, sample: Sample) -> Judgement:
    assert bound.most is not None
    needed = LOSS_EVENTS / bound.most
    seen, kept = sample.last(published=needed), _loses_less(bound.most, needed, sample)
    # More were lost than allowed, but no more than by chance: a longer past decides.
    while kept is None and seen.published >= needed:
        needed *= 2
        seen, kept = sample.last(published=needed), _loses_less(bound.most, needed, sample)
    # How often it is published shows once it has been for a while.
    flows = Slot.of(each for each in sample.slots if each.messages)
    left_s = (needed - seen.published) / flows.rate_hz if flows.seconds >= RATE_S else 0.0
    return Judgement(
        kept=kept,
        observed=lost(seen.lost, seen.published) if seen.published else "",
        allowed=_limit("≤", ">", kept, f"{bound.most:.6g}"),
        share=seen.lost / seen.published / bound.most if seen.published else None,
        decides_in_s=left_s if kept is None else None,
    )


def _loses_less(share: float, needed: float, sample: Sample) -> bool | None:
    """Return whether no more than a share was lost of so many messages; None if it is open."""
    seen = sample.last(published=needed)
    if seen.lost >= too_many(math.ceil(max(seen.published, needed)), share):
        return False  # whatever else arrives
    return True if seen.published >= needed and seen.lost <= share * seen.published else None


def _silence(bound: Bound, sample: Sample, publishes_s: float | None) -> Judgement:
    assert bound.most is not None
    silent_s = sample.silent_s
    if publishes_s is not None:
        silent_s = min(silent_s, max(0.0, publishes_s - REPORTED_S))
    kept = False if silent_s > bound.most else (True if sample.messages else None)
    return Judgement(
        kept=kept,
        observed=f"silent for {silent_s:.1f} s",
        allowed=_limit("≤", ">", kept, f"{bound.most:g} s"),
        share=silent_s / bound.most,
        decides_in_s=bound.most - silent_s if kept is None else None,
    )


def _limit(keeps: str, breaks: str, kept: bool | None, text: str) -> str:
    return f"{breaks if kept is False else keeps} {text}"


def percentile(quantile: float) -> str:
    """Return `p99` for 0.99, `p99.9` for 0.999."""
    return f"p{quantile * 100:g}"


def ms(value: float) -> str:
    """Return milliseconds as people read them, `0.61 ms`."""
    return f"{value:.3g} ms" if value < 1000 else f"{value:.0f} ms"


def lost(number: int, published: int) -> str:
    """Return `0 of 74 lost`."""
    return f"{number} of {published} lost"


def apart(clock: ClockOffset) -> str:
    """Return how far two clocks are apart, `512 ms ± 3.1 ms`."""
    return f"{ms(abs(clock.offset_ms))} ± {ms(clock.uncertainty_ms)}"


Pair = tuple[str, str, str]
"""Of a flow its topic, and the full names of the nodes that publish and subscribe."""


NUMBERS = ("messages", "lost", "rate_hz", "p50_ms", "p99_ms")


class MeasuredBound(msgspec.Struct, frozen=True, kw_only=True):
    """A number that the manifest declares of a flow, and what was measured of it.

    Attributes:
        name: the manifest's key, `max_delay_ms`.
        kind: what it bounds.
        outcome: "measuring" while what has arrived cannot decide it; "unverifiable" where that is
            because too little is known of the clocks of two hosts.
        text: `delay p99 0.6 ms ≤ 5 ms`.
        share: what was measured, divided by the bound; None while nothing is known.
        decides_in_s: about how long it takes yet to decide; None if it is decided, or where that is
            not known.
    """

    name: str
    kind: Kind
    outcome: Annotated[str, says(enum=["measuring", "ok", "violated", "unverifiable"])]
    text: str
    share: float | None = None
    decides_in_s: float | None = None

    @property
    def badness(self) -> float:
        """How many times worse than the bound it is; of a rate that is too low, too."""
        if self.share is None:
            return 0.0
        return max(self.share, 1 / self.share) if self.share > 0 else float("inf")


class FlowMeasurement(msgspec.Struct, frozen=True, kw_only=True):
    """What has arrived of one publisher → subscription pair, at the subscription.

    Attributes:
        publisher: fully qualified node name.
        subscription: fully qualified node name.
        messages: how many arrived in the last 5 s or a little more.
        lost: how many of those published meanwhile did not, by publication sequence numbers; None
            where they do not show it.
        rate_hz: messages per second of that time.
        p50_ms: delay from publication to the start of the callback, milliseconds, of the last 200
            messages or 5 s; None without a message, or between hosts whose clocks are not compared.
        p99_ms: likewise.
        clock: how far the clock of the publisher's host is ahead of the subscription's, which those
            are corrected by; None on one host, or where it is not known.
        bounds: what the manifest declares of it.
    """

    topic: str
    publisher: str
    subscription: str
    messages: Count
    lost: Count | None
    rate_hz: float
    p50_ms: float | None = None
    p99_ms: float | None = None
    clock: ClockOffset | None = None
    bounds: tuple[MeasuredBound, ...] = ()

    @property
    def pair(self) -> Pair:
        """Topic, publisher and subscription."""
        return self.topic, self.publisher, self.subscription

    @property
    def name(self) -> str:
        """Which flow it is: `/video /camera → /viewer`."""
        return f"{self.topic} {self.publisher} → {self.subscription}"

    def numbers(self) -> dict[str, str]:
        """Return what was counted as text, by the names of NUMBERS; empty where it is not known."""
        known = (
            *(self.messages, self.lost, f"{self.rate_hz:.3f}"),
            *(None if each is None else f"{each:.3f}" for each in (self.p50_ms, self.p99_ms)),
        )
        texts = ("" if each is None else str(each) for each in known)
        return dict(zip(NUMBERS, texts, strict=True))

    @property
    def outcome(self) -> str:
        """Worst of its bounds: "violated", "unverifiable", "measuring", "ok"; empty without any."""
        found = {each.outcome for each in self.bounds}
        return next((each for each in _WORST_FIRST if each in found), "")

    @property
    def violated(self) -> tuple[MeasuredBound, ...]:
        """The bounds that are not kept, the worst first."""
        found = (each for each in self.bounds if each.outcome == "violated")
        return tuple(sorted(found, key=lambda each: -each.badness))

    def describe(self) -> str:
        """Return it in one line: `/video /camera → /viewer: delay p99 0.6 ms ≤ 5 ms, 15.0 Hz`."""
        said = [each.text for each in self.bounds]
        names = {each.name for each in self.bounds}
        if "rate_hz" not in names:
            said.append(f"{self.rate_hz:.1f} Hz")
        if names.isdisjoint(("loss", "five_qi")) and self.lost is not None:
            said.append(f"{self.lost} of {self.messages + self.lost} lost")
        if self.clock is not None:
            said.append(f"clocks {apart(self.clock)} apart")
        return f"{self.name}: {', '.join(said)}"


_WORST_FIRST = ("violated", "unverifiable", "measuring", "ok")
_SAID = ("ok", "violated", "unverifiable", "measuring")
_NAMED = 3


def measured_summary(measured: Iterable[FlowMeasurement]) -> str:
    """Return in one line what came of declared numbers; empty where none is measured.

    `measured: 3 flows ok, 1 violated: /video /camera → /viewer: delay p99 7.2 ms > 5 ms`, the worst
    first.
    """
    flows = [each for each in measured if each.bounds]
    found = [(sum(each.outcome == one for each in flows), one) for one in _SAID]
    (number, outcome), *others = [each for each in found if each[0]] or [(0, "")]
    if not number:
        return ""
    numbers = [f"{count(number, 'flow')} {outcome}", *(f"{each} {one}" for each, one in others)]
    violated = [each for each in flows if each.violated]
    violated.sort(key=lambda each: -each.violated[0].badness)
    named = [f"{each.name}: {', '.join(one.text for one in each.violated)}" for each in violated]
    more = [f"and {len(named) - _NAMED} more"] if len(named) > _NAMED else []
    worst = "; ".join((*named[:_NAMED], *more))
    return f"measured: {', '.join(numbers)}" + (f": {worst}" if worst else "")
