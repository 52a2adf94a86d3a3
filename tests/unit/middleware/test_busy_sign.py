"""What a watcher sees of a busy thread, and of where the threads of a process stand."""

from __future__ import annotations

import os
import sysconfig
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

import lifecycle
from lifecycle.middleware.process import busy_sign
from lifecycle.middleware.process.busy_sign import BusySign

LIMIT_S = 0.05
BOUND_S = 10.0


@pytest.fixture
def sides() -> Iterator[tuple[BusySign, BusySign]]:
    """The holder's side and the watcher's."""
    holder = BusySign.make(LIMIT_S)
    watcher = BusySign(os.dup(holder.descriptor))
    yield holder, watcher
    holder.close()
    watcher.close()


def until_overdue(watcher: BusySign) -> float:
    """Return when the watcher noticed; it only looks when it said that it would."""
    end = time.monotonic() + BOUND_S
    while time.monotonic() < end:
        hangs, again_s = watcher.look()
        if hangs:
            return time.monotonic()
        assert 0 < again_s <= LIMIT_S
        time.sleep(again_s)
    raise AssertionError("never overdue")


def test_whoever_stays_busy_is_overdue_after_the_limit_and_not_before(
    sides: tuple[BusySign, BusySign],
) -> None:
    holder, watcher = sides
    began = time.monotonic()
    holder.begin()
    assert watcher.look()[0] is False
    assert until_overdue(watcher) - began >= LIMIT_S
    assert watcher.look()[0] is False  # it is said once


def test_whoever_is_idle_is_looked_at_once_in_a_limit(sides: tuple[BusySign, BusySign]) -> None:
    holder, watcher = sides
    assert watcher.look() == (False, LIMIT_S)
    holder.begin()
    holder.end()
    assert watcher.look() == (False, LIMIT_S)


def test_many_short_callbacks_are_not_a_long_one(sides: tuple[BusySign, BusySign]) -> None:
    holder, watcher = sides
    end = time.monotonic() + 6 * LIMIT_S
    while time.monotonic() < end:
        holder.begin()
        assert holder.end() is None
        assert watcher.look()[0] is False


def test_a_hang_that_begins_just_after_a_look_is_noticed_at_its_limit(
    sides: tuple[BusySign, BusySign],
) -> None:
    holder, watcher = sides
    _, again_s = watcher.look()
    began = time.monotonic()
    holder.begin()
    time.sleep(began + again_s - time.monotonic())
    hangs, again_s = watcher.look()
    assert again_s < LIMIT_S
    assert hangs or until_overdue(watcher) - began >= LIMIT_S


def test_the_holder_learns_how_long_it_took_only_beyond_the_limit(
    sides: tuple[BusySign, BusySign],
) -> None:
    holder, watcher = sides
    holder.begin()
    until_overdue(watcher)
    busy_s = holder.end()
    assert busy_s is not None
    assert busy_s >= LIMIT_S
    assert watcher.look()[0] is False
    assert holder.end() is None


class Turns:
    """Stands in for what the kernel counts of the holder's thread."""

    def __init__(self, *, ready: bool, ran: float, waited: float) -> None:
        self.began = time.monotonic_ns()
        self.ready, self.ran, self.waited = ready, ran, waited

    def __call__(self, thread: int, now: int) -> busy_sign._Turns:
        passed = now - self.began
        return busy_sign._Turns(
            thread=thread,
            at_ns=now,
            ran_ns=1 + round(passed * self.ran),
            waited_ns=round(passed * self.waited),
            ready=self.ready,
        )


def busy(
    sides: tuple[BusySign, BusySign], monkeypatch: pytest.MonkeyPatch, turns: Turns, limits: float
) -> list[float]:
    """Be busy for so many limits; return after how many of them the watcher says that it hangs."""
    holder, watcher = sides
    monkeypatch.setattr(busy_sign, "_turns_of", turns)
    began = turns.began = time.monotonic_ns()
    said = []

    def passed() -> float:
        return (time.monotonic_ns() - began) / 1e9 / LIMIT_S

    watcher.look()
    holder.begin()
    while passed() < limits:
        hangs, again_s = watcher.look()
        if hangs:
            said.append(passed())
            break
        time.sleep(again_s)
    holder.end()
    return said


def test_time_without_a_processor_is_not_the_callbacks_own(
    sides: tuple[BusySign, BusySign], monkeypatch: pytest.MonkeyPatch
) -> None:
    turns = Turns(ready=True, ran=0.02, waited=0.98)
    assert busy(sides, monkeypatch, turns, 4) == []


def test_who_never_gets_a_processor_is_not_hung(
    sides: tuple[BusySign, BusySign], monkeypatch: pytest.MonkeyPatch
) -> None:
    # The kernel counts a wait when it is over: nothing is counted here.
    turns = Turns(ready=True, ran=0, waited=0)
    assert busy(sides, monkeypatch, turns, 8) == []


@pytest.mark.parametrize(("ready", "ran"), [(False, 0.0), (True, 1.0)])
def test_who_sleeps_or_runs_beyond_the_limit_hangs(
    sides: tuple[BusySign, BusySign], monkeypatch: pytest.MonkeyPatch, ready: bool, ran: float
) -> None:
    turns = Turns(ready=ready, ran=ran, waited=0)
    (passed,) = busy(sides, monkeypatch, turns, 100)
    assert passed >= 1


def test_a_hang_on_an_overloaded_machine_is_noticed_later_by_what_it_ran(
    sides: tuple[BusySign, BusySign], monkeypatch: pytest.MonkeyPatch
) -> None:
    turns = Turns(ready=True, ran=0.5, waited=0.5)
    (passed,) = busy(sides, monkeypatch, turns, 100)
    assert passed >= 1.4


OURS = str(Path(lifecycle.__file__).parent)
STDLIB = sysconfig.get_path("stdlib")


def thread(*frames: tuple[str, int, str]) -> str:
    lines = [f'  File "{file}", line {line} in {name}' for file, line, name in frames]
    return "\n".join(["Thread 0x00007f649a02a4c0 (most recent call first):", *lines, ""])


EXECUTOR = (f"{OURS}/middleware/rcl/rclpy_nodes.py", 347, "_run_timer")
HOST = (f"{OURS}/node/host/host.py", 250, "serve")


def test_the_callback_and_what_it_called_last_are_shown() -> None:
    frames = [("/robot/deep.py", 9 - depth, f"f{depth}") for depth in range(5)]
    found = busy_sign.brief(thread((f"{STDLIB}/socket.py", 1, "recv"), *frames, EXECUTOR, HOST))
    assert found == "f4 (/robot/deep.py:5) > f1 (/robot/deep.py:8) > f0 (/robot/deep.py:9)"


def test_what_a_host_was_forked_from_is_no_callback() -> None:
    command = ("/venv/lib/python3.11/site-packages/click/core.py", 911, "invoke")
    ours = (f"{OURS}/cli/__init__.py", 201, "program")
    assert busy_sign.brief(thread(EXECUTOR, HOST, command, ours)) == ""


def test_a_thread_of_the_users_is_no_callback() -> None:
    worker = thread(("/robot/camera.py", 5, "grab"), (f"{STDLIB}/threading.py", 982, "run"))
    callback = thread(
        ("/robot/camera.py", 20, "show"),
        ("/opt/ros/jazzy/lib/python3.12/site-packages/rclpy/task.py", 239, "__call__"),
        (f"{STDLIB}/concurrent/futures/thread.py", 58, "run"),
    )
    assert busy_sign.brief(f"{worker}\n{callback}") == "show (/robot/camera.py:20)"


def test_an_installed_package_of_the_users_is_shown() -> None:
    file = f"{STDLIB}/site-packages/robot/node.py"
    assert busy_sign.brief(thread((file, 3, "tick"), EXECUTOR, HOST)) == f"tick ({file}:3)"


def test_nothing_is_shown_of_nothing() -> None:
    assert busy_sign.brief("") == ""


def test_another_process_shows_where_it_stands_and_what_it_does() -> None:
    sign = BusySign.make(0.1)
    child = os.fork()
    if not child:
        try:
            sign.show_stacks()
            busy_sign.show_stacks_here()
            sign.begin(what="of the service /reset")
            time.sleep(30)
        finally:
            os._exit(0)
    try:
        deadline = time.monotonic() + 10
        while not sign.what and time.monotonic() < deadline:
            time.sleep(0.01)
        assert "test_busy_sign.py" in sign.where(child)
        assert sign.where(child).count("test_another_process") == 1  # each time what is now
        assert sign.what == "of the service /reset"
    finally:
        os.kill(child, 9)
        os.waitpid(child, 0)
        sign.close()


def test_who_does_not_answer_is_sent_nothing() -> None:
    sign = BusySign.make(0.1)
    try:
        assert sign.where(os.getpid()) == ""
    finally:
        sign.close()
