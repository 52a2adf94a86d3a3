"""The busy sign: two sides in two processes, and a kernel timer between them."""

from __future__ import annotations

import os
import select
import signal
import time
from collections.abc import Iterator

import pytest

from lifecycle.middleware.process import busy_timer
from lifecycle.middleware.process.busy_timer import BusySign, Overdue

LIMIT_S = 0.05
BOUND_S = 10.0


@pytest.fixture
def sides() -> Iterator[tuple[BusySign, BusySign]]:
    """The holder's side and the watcher's."""
    holder = BusySign.make(LIMIT_S)
    watcher = BusySign(*(os.dup(each) for each in holder.descriptors))
    yield holder, watcher
    holder.close()
    watcher.close()


def fires(watcher: BusySign, within_s: float = BOUND_S) -> bool:
    return bool(select.select([watcher], [], [], within_s)[0])


def until_overdue(watcher: BusySign) -> float:
    """Return when the watcher noticed; it only looks when the timer fires."""
    end = time.monotonic() + BOUND_S
    while time.monotonic() < end:
        if fires(watcher) and watcher.overdue():
            return time.monotonic()
    raise AssertionError("never overdue")


def test_the_limit_is_known_to_both_sides(sides: tuple[BusySign, BusySign]) -> None:
    holder, watcher = sides
    assert (holder.limit_s, watcher.limit_s) == (LIMIT_S, LIMIT_S)


def test_whoever_stays_busy_is_overdue_after_the_limit_and_not_before(
    sides: tuple[BusySign, BusySign],
) -> None:
    holder, watcher = sides
    began = time.monotonic()
    holder.begin()
    assert not watcher.overdue()
    assert until_overdue(watcher) - began >= LIMIT_S


def test_whoever_was_idle_never_wakes_the_watcher(sides: tuple[BusySign, BusySign]) -> None:
    _, watcher = sides
    assert not fires(watcher, 3 * LIMIT_S)


def test_many_short_callbacks_are_not_a_long_one(sides: tuple[BusySign, BusySign]) -> None:
    holder, watcher = sides
    end = time.monotonic() + 6 * LIMIT_S
    while time.monotonic() < end:
        holder.begin()
        assert holder.end() is None
        if fires(watcher, 0.001):
            assert not watcher.overdue()


def test_a_hang_is_noticed_that_begins_while_the_timer_of_an_earlier_callback_runs(
    sides: tuple[BusySign, BusySign],
) -> None:
    holder, watcher = sides
    holder.begin()
    holder.end()
    time.sleep(LIMIT_S / 2)
    began = time.monotonic()
    holder.begin()  # does not arm the timer again: the watcher does, when it fires
    assert until_overdue(watcher) - began >= LIMIT_S


def test_the_holder_learns_how_long_it_took_only_beyond_the_limit(
    sides: tuple[BusySign, BusySign],
) -> None:
    holder, watcher = sides
    holder.begin()
    until_overdue(watcher)
    busy_s = holder.end()
    assert busy_s is not None
    assert busy_s >= LIMIT_S
    assert not watcher.overdue()
    assert holder.end() is None


def test_a_stopped_process_does_not_keep_the_watcher_from_noticing(
    sides: tuple[BusySign, BusySign],
) -> None:
    holder, watcher = sides
    pid = os.fork()
    if pid == 0:
        holder.begin()
        os.kill(os.getpid(), signal.SIGSTOP)
        os._exit(0)
    try:
        assert until_overdue(watcher) > 0
    finally:
        os.kill(pid, signal.SIGKILL)
        os.waitpid(pid, 0)


class Turns:
    """Stands in for what the kernel counts of the holder's thread."""

    def __init__(self, *, ready: bool, ran: float, waited: float, at_s: float = 0.0) -> None:
        self.began = time.monotonic_ns()
        self.ready, self.ran, self.waited, self.at_s = ready, ran, waited, at_s

    def __call__(self, thread: int, now: int) -> busy_timer._Turns:
        passed = now - self.began
        counted = passed if passed >= self.at_s * 1e9 else 0
        return busy_timer._Turns(
            at_ns=now,
            ran_ns=1 + round(counted * self.ran),
            waited_ns=round(counted * self.waited),
            ready=self.ready,
        )


def busy(
    sides: tuple[BusySign, BusySign], monkeypatch: pytest.MonkeyPatch, turns: Turns, limits: float
) -> list[tuple[float, Overdue]]:
    """Be busy for so many limits; return after how many of them the watcher said what."""
    holder, watcher = sides
    monkeypatch.setattr(busy_timer, "_turns_of", turns)
    monkeypatch.setattr(holder, "_note_turns", lambda: None)
    began = turns.began = time.monotonic_ns()
    said = []

    def passed() -> float:
        return (time.monotonic_ns() - began) / 1e9 / LIMIT_S

    holder.begin()
    while passed() < limits:
        if fires(watcher, 0.01) and (why := watcher.overdue()):
            said.append((passed(), why))
            if why is Overdue.HANGS:
                break
    holder.end()
    return said


def test_time_without_a_processor_is_not_the_callbacks_own(
    sides: tuple[BusySign, BusySign], monkeypatch: pytest.MonkeyPatch
) -> None:
    turns = Turns(ready=True, ran=0.02, waited=0.98)
    assert busy(sides, monkeypatch, turns, 4) == []


def test_who_never_gets_a_processor_is_not_hung_and_is_unserved_after_a_while(
    sides: tuple[BusySign, BusySign], monkeypatch: pytest.MonkeyPatch
) -> None:
    # The kernel counts a wait when it is over: nothing is counted here.
    turns = Turns(ready=True, ran=0, waited=0)
    said = busy(sides, monkeypatch, turns, 8)
    assert {why for _, why in said} == {Overdue.UNSERVED}
    assert said[0][0] >= 5


@pytest.mark.parametrize(("ready", "ran"), [(False, 0.0), (True, 1.0)])
def test_who_sleeps_or_runs_beyond_the_limit_hangs(
    sides: tuple[BusySign, BusySign], monkeypatch: pytest.MonkeyPatch, ready: bool, ran: float
) -> None:
    turns = Turns(ready=ready, ran=ran, waited=0)
    ((passed, why),) = busy(sides, monkeypatch, turns, 100)
    assert why is Overdue.HANGS
    assert passed >= 1


def test_a_hang_on_an_overloaded_machine_is_noticed_later_by_what_it_ran(
    sides: tuple[BusySign, BusySign], monkeypatch: pytest.MonkeyPatch
) -> None:
    turns = Turns(ready=True, ran=0.5, waited=0.5)
    said = busy(sides, monkeypatch, turns, 100)
    assert said[-1][1] is Overdue.HANGS
    assert said[-1][0] >= 1.4
