"""The busy sign: two sides in two processes, and a kernel timer between them."""

from __future__ import annotations

import os
import select
import signal
import time
from collections.abc import Iterator

import pytest

from lifecycle.middleware.busy_sign import BusySign

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
