"""What a subscription counts, compared with exact computation, and when it decides."""

from __future__ import annotations

import math
import random
from collections.abc import Iterable

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from lifecycle.measure.counter import WARM_UP_S, Counter
from lifecycle.measure.flows import Bound, Judgement, Kind, judge, ms, percentile, too_many
from lifecycle.measure.sample import (
    DELAY_S,
    ERROR,
    LAST_BUCKET,
    LONGEST_NS,
    SLOT_S,
    Delays,
    Measured,
    Sample,
    Slot,
    buckets_of,
    least_ns,
)

NS = 10**9
WALL = 1_700_000_000 * NS
"""When counting begins, on the publisher's clock; 0 on ours."""


def counted(arrivals: Iterable[tuple[float, float, int]], *, until_s: float) -> Sample:
    """Count messages: seconds of arrival since counting began, delay in ms, sequence number."""
    counter = Counter(0, WALL)
    for at_s, delay_ms, number in arrivals:
        now_ns = round((at_s + WARM_UP_S) * NS)
        source_ns = WALL + now_ns - round(delay_ms * 1e6)
        info = {
            "source_timestamp": source_ns,
            "received_timestamp": source_ns + round(delay_ms * 5e5),
            "publication_sequence_number": number,
        }
        counter.arrived(now_ns, WALL + now_ns, info)
    return counter.sample(round((until_s + WARM_UP_S) * NS))


def steady(
    hertz: float, seconds: float, *, delay_ms: float = 1.0, lost: frozenset[int] = frozenset()
) -> list[tuple[float, float, int]]:
    """Messages at a steady rate; those that are lost by their number."""
    return [
        ((number - 0.5) / hertz, delay_ms, number)
        for number in range(1, round(hertz * seconds) + 1)
        if number not in lost
    ]


@given(st.integers(0, LONGEST_NS))
def test_a_bucket_holds_the_delay_within_the_known_error(delay_ns: int) -> None:
    least = least_ns(buckets_of((delay_ns,))[0])
    assert least <= delay_ns <= least * (1 + ERROR)
    assert 0 <= buckets_of((delay_ns,))[0] <= LAST_BUCKET


@given(st.lists(st.integers(0, 10**11), min_size=1), st.sampled_from([0.5, 0.9, 0.98, 0.99]))
def test_a_quantile_is_the_exact_one_within_the_known_error(
    delays: list[int], quantile: float
) -> None:
    counts: dict[int, int] = {}
    for each in delays:
        counts[buckets_of((each,))[0]] = counts.get(buckets_of((each,))[0], 0) + 1
    rank = min(math.ceil(quantile * len(delays) - 1e-9), max(len(delays) - 1, 1))
    exact_ms = sorted(delays)[max(rank, 1) - 1] / 1e6
    found_ms = Delays.of((counts,)).quantile_ms(quantile)
    assert found_ms is not None
    assert found_ms <= exact_ms <= found_ms * (1 + ERROR) + 1e-12


def test_no_message_has_no_quantile_and_what_came_too_early_counts_as_no_delay() -> None:
    assert Delays().quantile_ms(0.99) is None
    assert Measured(active_s=1.0).of("/a") is None
    assert buckets_of((-5,))[0] == 0
    too_long = buckets_of((LONGEST_NS * 4,))[0]
    assert Delays.of(({too_long: 1},)) == Delays(buckets=((LAST_BUCKET, 1),))
    edges = (127, 128, 129, 191, 192)
    assert [least_ns(each) for each in edges] == [127, 128, 130, 254, 256]


def test_ranks_and_late_messages_are_counted_to_the_nanosecond() -> None:
    some = Delays(buckets=((1, 1), (2, 1), (3, 1), (5, 1)))
    assert [some.quantile_ms(each) for each in (0.1, 0.5, 0.51)] == [1e-6, 2e-6, 3e-6]
    assert Delays(buckets=((1, 1), (2, 1))).quantile_ms(0.99) == 1e-6
    assert [some.later_than(each) for each in (5e-6, 3e-6, 0.0)] == [0, 1, 4]


@given(
    st.lists(
        st.tuples(st.floats(0, 0.4), st.floats(0, 100), st.integers(1, 4)), min_size=1, max_size=200
    )
)
def test_what_is_counted_is_what_arrived(steps: list[tuple[float, float, int]]) -> None:
    at_s, number, arrivals = 0.0, 0, []
    for gap_s, delay_ms, numbers in steps:
        at_s, number = at_s + gap_s, number + numbers
        arrivals.append((at_s + 0.2, min(delay_ms, at_s * 1e3), number))
    end_s = at_s + 1.0
    sample = counted(arrivals, until_s=end_s)
    assert sample.messages == len(arrivals)
    assert sample.lost == number - steps[0][2] - (len(arrivals) - 1)
    assert sample.silent_s == pytest.approx(end_s - arrivals[-1][0], abs=1e-6)
    assert sample.seconds == pytest.approx(end_s, abs=1e-6)
    past = sample.last(seconds=1e9)
    assert past.seconds == math.floor((end_s + 1e-9) / SLOT_S) * SLOT_S
    assert past.messages == sum(each[0] < past.seconds for each in arrivals)
    assert past.lost == sample.lost
    assert len(sample.slots) < 100


def test_what_was_published_before_activation_or_arrives_just_after_it_does_not_count() -> None:
    kept = [(0.1, 500.0, 1), (-0.2, 1.0, 2)]
    sample = counted([*kept, (0.3, 1.0, 3)], until_s=1.0)
    assert (sample.messages, sample.lost) == (1, 0)


def test_a_publisher_that_is_started_again_has_lost_nothing() -> None:
    sample = counted([(0.1, 1, 41), (0.2, 1, 42), (0.3, 1, 1), (0.4, 1, 3)], until_s=1.0)
    assert (sample.messages, sample.lost) == (4, 1)
    assert counted([(0.1, 1, 5), (0.2, 1, 5)], until_s=1.0).lost == 0


def test_before_counting_begins_no_time_has_passed_and_a_slot_begins_with_its_first_moment() -> (
    None
):
    early = counted([], until_s=-0.2)
    assert (early.seconds, early.silent_s, early.slots) == (0.0, 0.0, ())
    assert counted([(0.0, 0.0, 1)], until_s=1.0).messages == 1
    sample = counted([(SLOT_S, 1.0, 1)], until_s=2 * SLOT_S)
    assert [each.messages for each in sample.slots] == [1, 0]


@pytest.mark.parametrize("number", [0, 2**63, 2**64 - 1])
def test_an_rmw_without_sequence_numbers_has_an_unknown_loss(number: int) -> None:
    assert counted([(0.1, 1, number)], until_s=1.0).lost is None


def test_an_rmw_that_does_not_say_when_it_received_a_message_has_no_delay_of_the_network() -> None:
    counter = Counter(0, WALL)
    names = ("source_timestamp", "received_timestamp", "publication_sequence_number")
    counter.arrived(NS, WALL + NS, dict(zip(names, (WALL + NS - 1000, 0, 1), strict=True)))
    sample = counter.sample(2 * NS)
    assert (sample.used.messages, sample.received.messages) == (1, 0)


def test_memory_is_bounded_however_long_it_counts() -> None:
    sample = counted(steady(0.2, 100_000), until_s=100_000)
    assert len(sample.slots) < 100
    assert sample.messages == 20_000
    past = sample.last(seconds=36_000)
    assert 36_000 <= past.seconds < 45_000
    assert past.rate_hz == pytest.approx(0.2, rel=0.001)


def verdict(bound: Bound, sample: Sample, publishes_s: float | None = None) -> bool | None:
    return judge(bound, sample, publishes_s=publishes_s).kept


DELAY = Bound(kind=Kind.DELAY, most=5.0)


def test_a_delay_is_judged_after_200_messages_or_5_s() -> None:
    assert verdict(DELAY, counted(steady(100, 1.5), until_s=1.5)) is None
    assert verdict(DELAY, counted(steady(100, 2), until_s=2)) is True
    assert verdict(DELAY, counted(steady(2, 4.5), until_s=4.5)) is None
    assert verdict(DELAY, counted(steady(2, 5), until_s=DELAY_S)) is True
    assert verdict(DELAY, counted([], until_s=60)) is None
    assert verdict(DELAY, counted(steady(100, 2.5, delay_ms=8), until_s=2.5)) is False
    for hertz, messages, seconds in ((100, 200, 2.0), (2, 10, DELAY_S)):
        sample = counted(steady(hertz, 20), until_s=20)
        for each in (sample.used, sample.received):
            assert (each.messages, each.seconds) == (messages, seconds)
    at_the_bound = Sample(seconds=5.0, used=Delays(seconds=DELAY_S, buckets=((64, 9),)))
    assert verdict(Bound(kind=Kind.DELAY, most=64e-6), at_the_bound) is True


def test_a_delay_is_judged_by_its_quantile_and_heals() -> None:
    slow = [(at_s, 8.0 if number % 30 == 0 else 1.0, number) for at_s, _, number in steady(100, 2)]
    assert verdict(DELAY, counted(slow, until_s=2)) is False
    assert verdict(Bound(kind=Kind.DELAY, most=5.0, quantile=0.9), counted(slow, until_s=2)) is True
    later = [(at_s + 2, delay, number + 200) for at_s, delay, number in steady(100, 2)]
    assert verdict(DELAY, counted([*slow, *later], until_s=4)) is True
    one = [(at_s, 90.0 if number == 7 else 1.0, number) for at_s, _, number in steady(15, 5)]
    assert verdict(DELAY, counted(one, until_s=5)) is True  # one message is no quantile


@pytest.mark.parametrize(
    ("late", "kept"),
    [(1, True), (2, None), (too_many(75, 0.01) - 1, None), (too_many(75, 0.01), False)],
)
def test_a_few_late_messages_of_not_many_decide_nothing(late: int, kept: bool | None) -> None:
    delays = ((at_s, number, 9 < number < 10 + late) for at_s, _, number in steady(15, 5))
    some = [(at_s, 8.0 if is_late else 1.0, number) for at_s, number, is_late in delays]
    found = judge(DELAY, counted(some, until_s=5))
    assert (found.kept, found.needs_clocks, found.decides_in_s) == (kept, False, None)


@pytest.mark.parametrize(("late", "kept"), [(1, True), (2, None), (3, False), (200, False)])
def test_200_messages_are_few_for_a_quantile_that_one_in_a_thousand_may_exceed(
    late: int, kept: bool | None
) -> None:
    bound = Bound(kind=Kind.DELAY, most=5.0, quantile=0.999)
    delays = ((at_s, number, 100 < number <= 100 + late) for at_s, _, number in steady(100, 3))
    some = [(at_s, 8.0 if is_late else 1.0, number) for at_s, number, is_late in delays]
    assert verdict(bound, counted(some, until_s=3)) is kept


@given(st.integers(1, 3000), st.sampled_from([0.5, 0.1, 0.05, 0.02, 0.01, 0.001]))
def test_too_many_late_messages_are_in_about_1_percent_of_samples(
    messages: int, share: float
) -> None:
    number = too_many(messages, share)
    logs = (
        math.lgamma(messages + 1)
        - math.lgamma(each + 1)
        - math.lgamma(messages - each + 1)
        + each * math.log(share)
        + (messages - each) * math.log1p(-share)
        for each in range(number, messages + 1)
    )
    chance = sum(map(math.exp, logs))
    assert chance < 0.0125 or number == messages
    assert number > messages * share
    assert [too_many(*each) for each in ((1, 0.1), (200, 0.01), (100, 0.5))] == [1, 7, 63]


def test_reception_is_judged_for_the_network() -> None:
    sample = counted(steady(100, 2.5, delay_ms=8), until_s=2.5)
    assert verdict(Bound(kind=Kind.NETWORK_DELAY, most=5.0, quantile=0.98), sample) is True


RATE = Bound(kind=Kind.RATE, least=15.0, slack=0.05)


def test_a_rate_is_judged_after_2_s_and_20_periods() -> None:
    assert verdict(RATE, counted(steady(15, 1.5), until_s=1.5)) is None
    assert verdict(RATE, counted(steady(15, 2), until_s=2)) is True
    assert verdict(RATE, counted(steady(13, 2), until_s=2)) is False
    assert verdict(RATE, counted([], until_s=2)) is False
    slow = Bound(kind=Kind.RATE, least=1.0, slack=0.05)
    assert verdict(slow, counted(steady(1, 19), until_s=19)) is None
    assert verdict(slow, counted(steady(1, 20), until_s=20)) is True
    # Where a slot begins makes a difference of one message.
    exactly = Bound(kind=Kind.RATE, least=15.0, most=15.0)
    slots = (Slot(seconds=2.0, messages=each) for each in (28, 29, 31, 32))
    samples = (Sample(seconds=2.0, messages=30, slots=(each,)) for each in slots)
    assert [verdict(exactly, each) for each in samples] == [False, True, True, False]


def test_a_rate_may_have_an_upper_bound() -> None:
    between = Bound(kind=Kind.RATE, least=10.0, most=20.0)
    assert verdict(between, counted(steady(25, 2), until_s=2)) is False
    assert verdict(between, counted(steady(15, 2), until_s=2)) is True
    assert verdict(Bound(kind=Kind.RATE, most=20.0), counted([], until_s=2)) is True


def test_a_slow_maximum_is_decided_within_7_s() -> None:
    slow = Bound(kind=Kind.RATE, most=0.5)
    assert verdict(slow, counted(steady(0.25, 6.5), until_s=6.5)) is None
    assert judge(slow, counted([], until_s=4)).decides_in_s == 3
    assert verdict(slow, counted(steady(0.25, 7), until_s=7)) is True
    assert verdict(slow, counted([], until_s=7)) is True
    # A run waits for 10 s at most.
    assert judge(slow, Sample(seconds=0.0), publishes_s=0.0).decides_in_s == 8
    assert verdict(slow, counted([], until_s=7), publishes_s=7.5) is None
    assert verdict(slow, counted([], until_s=7), publishes_s=8) is True
    # Too many for the whole time are too many before it is over, but for a burst at its begin.
    assert verdict(slow, counted(steady(1, 6), until_s=6)) is False
    assert verdict(slow, counted(steady(10, 2), until_s=2)) is False
    assert verdict(slow, counted(steady(10, 1.5), until_s=1.5)) is None
    assert verdict(slow, counted(steady(10, 0.5), until_s=40)) is True
    # What 7 s do not show, 20 periods do.
    assert verdict(slow, counted(steady(0.6, 8), until_s=7)) is True
    found = judge(slow, counted(steady(0.6, 40), until_s=40))
    assert (found.kept, found.observed, found.allowed) == (False, "0.6 Hz", "> 0.5 Hz")
    # A minimum beside it takes its time, and may be kept while the maximum is not.
    both = Bound(kind=Kind.RATE, least=0.5, most=1.0)
    assert verdict(both, counted(steady(0.7, 20), until_s=20)) is None
    assert verdict(both, counted(steady(2, 10.5), until_s=10.5)) is False


@given(st.sampled_from([0.05, 0.1, 0.5, 1.0, 3.0]), st.randoms(use_true_random=False))
def test_a_maximum_raises_no_alarm_at_its_very_rate_with_messages_that_are_late(
    most: float, chance: random.Random
) -> None:
    late = [(number + chance.uniform(0, 0.4)) / most for number in range(round(100 * most))]
    for until_s in (7, 37, 100):
        arrived = [(at_s, 1.0, number) for number, at_s in enumerate(late, 1) if at_s < until_s]
        sample = counted(arrived, until_s=until_s)
        assert verdict(Bound(kind=Kind.RATE, most=most), sample) is not False


def test_a_publisher_that_was_activated_just_now_has_no_rate_yet_and_is_not_silent() -> None:
    sample = counted(steady(15, 2), until_s=60)
    assert verdict(RATE, sample) is False
    assert verdict(RATE, sample, publishes_s=1.0) is None
    assert verdict(RATE, sample, publishes_s=3.0) is False
    silence = Bound(kind=Kind.SILENCE, most=2.0)
    assert verdict(silence, sample) is False
    assert verdict(silence, sample, publishes_s=1.0) is True
    assert verdict(silence, counted([], until_s=1.0)) is None
    assert verdict(silence, counted([], until_s=3.0)) is False
    assert verdict(silence, Sample(seconds=9.0, messages=1, silent_s=2.0)) is True
    assert judge(silence, sample, publishes_s=0.5).observed == "silent for 0.0 s"


LOSS = Bound(kind=Kind.LOSS, most=0.01)


def test_a_loss_is_judged_after_ten_losses_or_as_many_messages_as_would_have_them() -> None:
    assert verdict(LOSS, counted(steady(100, 9), until_s=9)) is None
    assert verdict(LOSS, counted(steady(100, 10), until_s=10)) is True
    many = frozenset(range(10, 300, 10))
    assert verdict(LOSS, counted(steady(100, 3, lost=many), until_s=3)) is False
    later = steady(100, 15, lost=many)
    assert verdict(LOSS, counted(later, until_s=15)) is True


@given(st.integers(0, 60))
def test_a_loss_is_violated_where_chance_does_not_explain_it(number: int) -> None:
    dropped = frozenset(range(20, 20 + 15 * number, 15))
    sample = counted(steady(100, 10, lost=dropped), until_s=10)
    found = judge(LOSS, sample)
    kept = True if number <= 10 else (None if number < too_many(1000, 0.01) else False)
    assert (found.kept, found.share) == (kept, pytest.approx(number / 10))
    sign = ">" if kept is False else "≤"
    assert (found.observed, found.allowed) == (f"{number} of 1000 lost", f"{sign} 0.01")
    assert (found.decides_in_s is None) == (kept is not None)


@pytest.mark.parametrize(("of_1000", "kept"), [(11, None), (14, False), (9, True)])
def test_a_longer_past_decides_what_chance_may_explain(of_1000: int, kept: bool | None) -> None:
    recent = tuple(Slot(seconds=1, messages=987, lost=13) for _ in range(1))
    older = tuple(Slot(seconds=1, messages=1000 - of_1000, lost=of_1000) for _ in range(31))
    found = judge(LOSS, Sample(seconds=32, slots=recent + older))
    assert found.kept is kept


def test_half_of_the_loss_that_is_allowed_raises_no_alarm_and_twice_of_it_is_found() -> None:
    chance = random.Random(36)

    def slots(share: float) -> tuple[Slot, ...]:
        lost = [sum(chance.random() < share for _ in range(50)) for _ in range(100)]
        return tuple(Slot(seconds=1, messages=50 - each, lost=each) for each in lost)

    def share_of(kept: bool | None, share: float) -> float:
        found = [judge(LOSS, Sample(seconds=100, slots=slots(share))).kept for _ in range(500)]
        return found.count(kept) / len(found)

    assert share_of(False, 0.005) == 0
    assert share_of(False, 0.02) > 0.9


@pytest.mark.parametrize(
    ("bound", "expected"),
    [
        (DELAY, Judgement(kept=True, observed="delay p99 0.999 ms", allowed="≤ 5 ms")),
        (RATE, Judgement(kept=True, observed="15.0 Hz", allowed="≥ 15 Hz - 5%")),
        (LOSS, Judgement(kept=None, observed="0 of 74 lost", allowed="≤ 0.01")),
    ],
)
def test_a_judgement_has_numbers(bound: Bound, expected: Judgement) -> None:
    found = judge(bound, counted(steady(15, 5)[1:], until_s=5))
    assert replace(found, decides_in_s=None, share=None) == expected


@pytest.mark.parametrize(
    ("bound", "share", "allowed"),
    [
        (Bound(kind=Kind.DELAY, most=4), 0.25, "≤ 4 ms"),
        (Bound(kind=Kind.DELAY, most=0.5), 2, "> 0.5 ms"),
        (Bound(kind=Kind.RATE, least=30, slack=0.05), 0.5, "< 30 Hz - 5%"),
        (Bound(kind=Kind.RATE, least=5, most=10), 1.5, "> 10 Hz"),
        (Bound(kind=Kind.RATE, least=10, most=20), 1.5, "≥ 10 Hz"),
        (Bound(kind=Kind.RATE, most=20), 0.75, "≤ 20 Hz"),
        (Bound(kind=Kind.LOSS, most=0.2), 0, "≤ 0.2"),
        (Bound(kind=Kind.SILENCE, most=1), 0.03, "≤ 1 s"),
        (Bound(kind=Kind.SILENCE, most=0.01), 3.3, "> 0.01 s"),
    ],
)
def test_a_judgement_has_what_share_of_the_bound_was_measured(
    bound: Bound, share: float, allowed: str
) -> None:
    found = judge(bound, counted(steady(15, 5), until_s=5))
    assert found.share == pytest.approx(share, rel=0.05, abs=0.01)
    assert (found.allowed, found.decides_in_s) == (allowed, None)
    nothing = judge(bound, Sample(seconds=0.0))
    assert nothing.share in (None, 0.0)
    assert nothing.observed in ("", "silent for 0.0 s")


@pytest.mark.parametrize(
    ("bound", "hertz", "seconds", "publishes_s", "left_s"),
    [
        (DELAY, 2, 4.5, None, 0.5),
        (RATE, 15, 1.5, None, 1.0),
        (Bound(kind=Kind.RATE, least=1.0), 1, 5, None, 15.0),
        (RATE, 15, 60, 1.0, 2.0),
        (LOSS, 100, 5, None, 5.0),
        (LOSS, 0.1, 1, None, 0.0),
        (LOSS, 4, 5, None, 245.0),
        (LOSS, 100, 0, None, 0.0),
        (DELAY, 100, 0, None, 5.0),
        (Bound(kind=Kind.SILENCE, most=2.5), 0.1, 1, None, 1.5),
    ],
)
def test_what_is_not_decided_yet_says_how_long_that_takes(
    bound: Bound, hertz: float, seconds: float, publishes_s: float | None, left_s: float | None
) -> None:
    found = judge(bound, counted(steady(hertz, seconds), until_s=seconds), publishes_s=publishes_s)
    assert (found.kept, found.decides_in_s) == (None, left_s)


def test_quantiles_and_milliseconds_are_written_as_people_read_them() -> None:
    assert [percentile(each) for each in (0.5, 0.99, 0.999)] == ["p50", "p99", "p99.9"]
    shown = [ms(each) for each in (0.6123, 58.24, 999.0, 1000.0, 1234.5)]
    assert shown == ["0.612 ms", "58.2 ms", "999 ms", "1000 ms", "1234 ms"]
