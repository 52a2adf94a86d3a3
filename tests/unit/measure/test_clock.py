"""The clocks of two hosts: what exchanges prove of them, and delays counted across them."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lifecycle.measure.clock import JUDGED_S, SAME_CLOCK, ClockComparison, ClockOffset
from lifecycle.measure.counter import WARM_UP_S, Counter
from lifecycle.measure.flows import CLOCKS_S, Bound, Judgement, Kind, judge
from lifecycle.measure.sample import (
    Sample,
)

NS = 10**9
START = 1_700_000_000 * NS
HOUR = 3600 * NS


class Hosts:
    """Two hosts and the way between them; times are of our clock.

    Args:
        ahead_ns: of the other's clock at START.
        drift: by so much it goes faster.
    """

    def __init__(self, ahead_ns: int = 0, drift: float = 0.0) -> None:
        self.ahead_ns, self.drift = ahead_ns, drift
        self.comparison = ClockComparison()

    def offset_ns(self, now_ns: int) -> int:
        return self.ahead_ns + round((now_ns - START) * self.drift)

    def exchange(self, now_ns: int, there_ns: int, waits_ns: int, back_ns: int) -> int:
        """Exchange a message and, after a while, its answer; return when that is here."""
        got, sent = now_ns + there_ns, now_ns + there_ns + waits_ns
        here = sent + back_ns
        theirs = got + self.offset_ns(got), sent + self.offset_ns(sent)
        self.comparison.add(now_ns, *theirs, here)
        return here

    def known(self, now_ns: int) -> ClockOffset:
        found = self.comparison.offset(now_ns)
        assert found is not None
        return found


WAYS = st.tuples(st.integers(0, NS), st.integers(0, 2 * NS), st.integers(0, NS))


@given(
    st.integers(-HOUR, HOUR),
    st.floats(-99e-6, 99e-6),
    st.lists(WAYS, min_size=1, max_size=40),
    st.integers(0, 100 * NS),
)
def test_the_true_offset_is_within_the_uncertainty_however_asymmetric_the_ways_are(
    ahead_ns: int, drift: float, ways: list[tuple[int, int, int]], later_ns: int
) -> None:
    hosts, now_ns = Hosts(ahead_ns, drift), START
    for way in ways:
        now_ns = hosts.exchange(now_ns, *way)
        found = hosts.known(now_ns)
        assert abs(hosts.offset_ns(now_ns) / 1e6 - found.offset_ms) <= found.uncertainty_ms
    now_ns += later_ns
    found = hosts.known(now_ns)
    for at_ns in (now_ns, now_ns - round(JUDGED_S * NS)):
        assert abs(hosts.offset_ns(at_ns) / 1e6 - found.offset_ms) <= found.uncertainty_ms


def test_the_uncertainty_is_half_of_the_shortest_round_trip_and_what_clocks_may_drift() -> None:
    hosts = Hosts(500_000_000)
    for second, slow_ns in enumerate((40_000_000, 0, 3_000_000, 40_000_000)):
        now_ns = hosts.exchange(START + second * NS, 100_000 + slow_ns, 0, 100_000 + slow_ns)
    found = hosts.known(now_ns)
    assert found.offset_ms == pytest.approx(500, abs=0.001)
    assert 0.1 < found.uncertainty_ms < 0.1 + 100e-6 * (2100 + 1000 * JUDGED_S)
    later = hosts.known(now_ns + 20 * NS)  # delays of some seconds before are judged, too
    assert later.uncertainty_ms - found.uncertainty_ms == pytest.approx(
        100e-6 * (20_000 - 1000 * JUDGED_S), rel=0.1
    )
    near = Hosts(500_000_000)
    at_once = near.known(near.exchange(START, 0, 0, 0))
    assert at_once == ClockOffset(offset_ms=500.0, uncertainty_ms=0.1 * JUDGED_S + 2.5e-6)


def test_nothing_is_known_before_an_exchange() -> None:
    assert ClockComparison().offset(START) is None


def test_what_was_proven_before_messages_queue_holds_on_but_for_what_clocks_may_drift() -> None:
    hosts = Hosts(500_000_000)
    hosts.exchange(START, 100_000, 0, 100_000)
    for second in range(1, 61):  # a link that is congested in one direction
        now_ns = hosts.exchange(START + second * NS, 300_000_000, 0, 100_000)
    found = hosts.known(now_ns)
    assert found.uncertainty_ms < 0.1 + 100e-6 * (60_000 + 1000 * JUDGED_S) + 0.1
    assert abs(found.offset_ms - 500) <= found.uncertainty_ms


@pytest.mark.parametrize("step_ns", [500_000_000, -500_000_000, HOUR, -HOUR])
def test_a_clock_that_is_set_makes_what_was_known_of_it_void_until_old_delays_are_gone(
    step_ns: int,
) -> None:
    hosts = Hosts(7_000_000)
    for second in range(5):
        now_ns = hosts.exchange(START + second * NS, 200_000, 0, 200_000)
    hosts.ahead_ns += step_ns
    now_ns = hosts.exchange(now_ns + NS, 200_000, 0, 200_000)
    assert hosts.comparison.offset(now_ns) is None
    for second in range(7):
        assert hosts.comparison.offset(now_ns) is None, second
        now_ns = hosts.exchange(now_ns + NS, 200_000, 0, 200_000)
    assert hosts.known(now_ns).offset_ms == pytest.approx(7 + step_ns / 1e6, abs=0.5)


class Slewed(Hosts):
    """One is slewed from the 20th to the 120th second."""

    def offset_ns(self, now_ns: int) -> int:
        return self.ahead_ns + round(min(max(now_ns - START - 20 * NS, 0), 100 * NS) * self.drift)


@pytest.mark.parametrize("slew", [500e-6, -500e-6])
@pytest.mark.parametrize("way_ns", [10_000, 200_000])
@pytest.mark.parametrize("waits_ns", [0, 900_000_000])
def test_a_clock_that_is_slewed_is_known_all_the_time_only_less_well(
    slew: float, way_ns: int, waits_ns: int
) -> None:
    hosts = Slewed(7_000_000, slew)
    for second in range(200):
        now_ns = hosts.exchange(START + second * NS, way_ns, waits_ns, way_ns)
        found = hosts.known(now_ns)
        # It may take some seconds to contradict what was known.
        unnoticed_ms = 1.5 if 20 <= second < 25 else 0
        for at_ns in (now_ns, now_ns - round(JUDGED_S * NS)):
            error_ms = abs(hosts.offset_ns(at_ns) / 1e6 - found.offset_ms)
            assert error_ms <= found.uncertainty_ms + unnoticed_ms, second
        assert found.uncertainty_ms < 6
    assert found.uncertainty_ms < 1.5


@pytest.mark.parametrize("here_ns", [-NS, 10])
def test_an_exchange_during_which_a_clock_was_set_shows_that_and_nothing_else(here_ns: int) -> None:
    hosts = Hosts()
    now_ns = hosts.exchange(START, 200_000, 0, 200_000)
    hosts.comparison.add(now_ns, now_ns, now_ns + NS, now_ns + here_ns)
    assert hosts.comparison.offset(now_ns) is None
    later_ns = hosts.exchange(now_ns + 8 * NS, 200_000, 0, 200_000)
    assert hosts.known(later_ns).offset_ms == pytest.approx(0, abs=0.5)


def test_of_several_clocks_holds_what_holds_for_each() -> None:
    far = ClockOffset(offset_ms=1.0, uncertainty_ms=0.25)
    assert ClockOffset.any_of([far]) == far
    assert ClockOffset.any_of([SAME_CLOCK]) == SAME_CLOCK
    both = ClockOffset.any_of([SAME_CLOCK, far])
    assert (both.offset_ms, both.uncertainty_ms) == (0.625, 0.625)


def counted(
    arrivals: Iterable[tuple[float, float]], *, ahead_ns: int, until_s: float, network: float = 0.5
) -> Sample:
    """Count messages of another host: seconds of arrival, and delay in ms, a share on the way."""
    counter = Counter(0, START, is_apart=True)
    for number, (at_s, delay_ms) in enumerate(arrivals, 1):
        now_ns = round((at_s + WARM_UP_S) * NS)
        sent_ns = START + now_ns - round(delay_ms * 1e6)
        info = {
            "source_timestamp": sent_ns + ahead_ns,
            "received_timestamp": sent_ns + round(delay_ms * network * 1e6),
            "publication_sequence_number": number,
        }
        counter.arrived(now_ns, START + now_ns, info)
        if number % 25 == 0:
            counter.count()
    return counter.sample(round((until_s + WARM_UP_S) * NS))


def steady(delay_ms: float, seconds: float = 5.0) -> list[tuple[float, float]]:
    return [((number + 0.5) / 50, delay_ms) for number in range(round(seconds * 50))]


FAR = st.integers(-(10**6) * HOUR, 10**6 * HOUR)


@given(FAR, st.lists(st.floats(0.01, 60), min_size=1, max_size=12))
def test_delays_across_clocks_are_exact_within_the_known_error(
    ahead_ns: int, delays_ms: list[float]
) -> None:
    arrivals = [
        (at_s, delay_ms)
        for (at_s, _), delay_ms in zip(steady(0), itertools.cycle(delays_ms), strict=False)
    ]
    sample = counted(arrivals, ahead_ns=ahead_ns, until_s=5, network=1.0)
    assert sample.messages == len(arrivals)
    exact_ms = sorted(each for _, each in arrivals[-sample.used.messages :])
    for quantile in (0.5, 0.9, 0.99):
        found_ms = sample.used.quantile_ms(quantile)
        assert found_ms is not None
        rank = math.ceil(quantile * len(exact_ms) - 1e-9)
        # A double has milliseconds of centuries to a part of a microsecond.
        assert found_ms + ahead_ns / 1e6 == pytest.approx(exact_ms[rank - 1], abs=0.011)


def test_what_was_received_before_counting_began_does_not_count_by_another_clock() -> None:
    for received_ns, messages in ((START + NS // 4, 0), (START + NS, 1), (0, 1)):
        counter = Counter(0, START, is_apart=True)
        names = ("source_timestamp", "received_timestamp", "publication_sequence_number")
        counter.arrived(NS, START + NS, dict(zip(names, (7, received_ns, 1), strict=True)))
        assert counter.sample(NS).messages == messages


@pytest.mark.parametrize("ahead_ns", [500_000_000, -500_000_000, 10**5 * HOUR, -(10**5) * HOUR])
def test_rate_and_loss_do_not_depend_on_the_other_clock(ahead_ns: int) -> None:
    sample = counted(steady(3.0), ahead_ns=ahead_ns, until_s=5)
    assert (sample.messages, sample.lost) == (250, 0)
    found_ms = sample.received.quantile_ms(0.99)
    assert found_ms is not None
    assert found_ms + ahead_ns / 1e6 == pytest.approx(1.5, abs=0.011)


def test_what_arrives_after_our_own_clock_was_set_back_is_counted() -> None:
    counter = Counter(0, START, is_apart=True)
    for number in range(1, 4):
        now_ns = number * NS
        wall_ns = START + now_ns - HOUR
        info = dict.fromkeys(("source_timestamp", "received_timestamp"), wall_ns)
        counter.arrived(now_ns, wall_ns, {**info, "publication_sequence_number": number})
    assert counter.sample(4 * NS).messages == 3


def test_delays_all_over_take_constant_memory_and_long_ones_count_as_long() -> None:
    arrivals = [(number / 10_000, 0.2 * number) for number in range(10_000)]
    sample = counted(arrivals, ahead_ns=0, until_s=1.1)
    assert (sample.messages, sample.used.messages) == (10_000, 5_000)
    assert len(sample.used.buckets) == 4096


BOUND = Bound(kind=Kind.DELAY, most=5.0)


def judged(delay_ms: float, uncertainty_ms: float, seconds: float = CLOCKS_S) -> Judgement:
    clock = ClockOffset(offset_ms=512, uncertainty_ms=uncertainty_ms)
    sample = counted(steady(delay_ms, seconds), ahead_ns=512_000_000, until_s=seconds)
    return judge(BOUND, sample, clock=clock)


@pytest.mark.parametrize(
    ("delay_ms", "uncertainty_ms", "kept"),
    [
        (1.0, 0.2, True),
        (4.9, 0.2, None),
        (5.1, 0.2, None),
        (5.3, 0.2, False),
        (1.0, 6.0, None),  # even if no delay is less than 0 ms
        (50.0, 6.0, False),  # however the clocks are, that is too late
    ],
)
def test_a_delay_is_decided_only_where_the_clocks_do_not_matter(
    delay_ms: float, uncertainty_ms: float, kept: bool | None
) -> None:
    found = judged(delay_ms, uncertainty_ms)
    assert found.kept is kept
    assert found.needs_clocks is (kept is None)
    assert found.decides_in_s is None


def test_better_exchanges_are_waited_for_within_the_probation() -> None:
    found = judged(4.9, 0.2, 5.5)
    assert (found.kept, found.needs_clocks) == (None, True)
    assert found.decides_in_s == pytest.approx(CLOCKS_S - 5.5)
    sample = counted(steady(1.0, 5.5), ahead_ns=0, until_s=5.5)
    unknown = judge(BOUND, sample, clock=None)
    assert (unknown.kept, unknown.needs_clocks, unknown.observed) == (None, True, "")
    assert judged(1.0, 0.25).observed == "delay p99 1 ms ± 0.26 ms"
