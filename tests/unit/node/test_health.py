"""When a node's health method is asked, and what becomes of its answers; without ROS."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest

from lifecycle.manifest.model import Health
from lifecycle.node import callbacks
from lifecycle.node.callbacks import HealthCheck
from lifecycle.node.machine import NodeState
from lifecycle.verify.observation import HealthReport

OK = HealthReport(ok=True)


class Bench:
    """A health check whose executor and clock are the test's."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, check: Callable[[], Any]) -> None:
        self.now_s = 0.0
        self.tasks: list[Callable[[], Any]] = []
        self.ticks: list[Callable[[], None]] = []
        self.changes: list[HealthReport | None] = []
        self.traces: list[str] = []
        monkeypatch.setattr(callbacks.time, "monotonic", lambda: self.now_s)
        touch = lambda: self.changes.append(self.check.report)  # noqa: E731
        managed: Any = SimpleNamespace(
            turns=self,
            spec=SimpleNamespace(health=Health(check=True, interval_s=2.0, timeout_s=3.0)),
            configuration_changes=SimpleNamespace(touch=touch),
            log=SimpleNamespace(error=self.traces.append),
        )
        self.check = HealthCheck(managed, check)

    # What it asks of its turns.

    def call_every(self, period_s: float, callback: Callable[[], None]) -> Callable[[], None]:
        assert period_s == 2.0
        self.ticks.append(callback)
        return lambda: self.ticks.remove(callback)

    def call_soon(self, task: Callable[[], Any]) -> bool:
        self.tasks.append(task)
        return True

    def tick(self, seconds: float = 2.0) -> None:
        self.now_s += seconds
        for each in tuple(self.ticks):
            each()


def test_it_is_asked_while_connected_at_each_change_of_state_and_at_intervals(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    answers: list[Any] = [None, None, "no scan", "no scan", True, False, ""]
    bench = Bench(monkeypatch, lambda: answers.pop(0))
    bench.check.follow(NodeState.INACTIVE_DISCONNECTED)
    bench.check.follow(NodeState.CONNECTING)
    assert (bench.check.report, bench.ticks) == (None, [])
    bench.check.follow(NodeState.INACTIVE_CONNECTED)
    bench.check.follow(NodeState.ACTIVATING_CONNECTED)
    bench.check.follow(NodeState.ACTIVE)
    for _ in range(5):
        bench.tick()
    no_scan = HealthReport(ok=False, message="no scan")
    wrong = HealthReport(ok=False, message="it is not")
    assert bench.changes == [OK, OK, no_scan, OK, wrong, OK]  # said anew in another state
    bench.check.follow(NodeState.INACTIVE_DISCONNECTED)
    assert (bench.check.report, bench.ticks, answers) == (None, [], [])


def test_what_it_raises_is_unhealthy_and_its_traceback_is_logged_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    bench = Bench(monkeypatch, lambda: 1 / 0)
    bench.check.follow(NodeState.INACTIVE_CONNECTED)
    bench.tick()
    said = "it raised ZeroDivisionError: division by zero"
    assert bench.changes == [HealthReport(ok=False, message=said)]
    assert len(bench.traces) == 1


def test_an_async_one_is_not_known_once_it_is_late_until_it_returns(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async def check() -> str:
        return "too hot"

    bench = Bench(monkeypatch, check)
    bench.check.follow(NodeState.INACTIVE_CONNECTED)
    bench.tick()
    asked = HealthReport(ok=None, message="it has not answered since its state changed")
    assert bench.changes == [asked]
    bench.tick()
    late = HealthReport(ok=None, message="it has not answered within 3 s")
    assert bench.changes == [asked, late]
    (task,) = bench.tasks  # it is not asked again while it is
    asyncio.run(task())
    hot = HealthReport(ok=False, message="too hot")
    assert bench.changes == [asked, late, hot]
    # What it says of a state that is over counts no more, nor what it had said of it.
    bench.tasks.clear()
    bench.tick()
    bench.check.follow(NodeState.ACTIVE)
    assert bench.check.report == asked
    old, new = bench.tasks
    asyncio.run(old())
    assert bench.changes == [asked, late, hot, asked]
    asyncio.run(new())
    assert bench.check.report == hot
