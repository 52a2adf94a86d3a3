"""The gate: closed until active, nothing in the way while open."""

from __future__ import annotations

import time
import types
from collections.abc import Callable, Coroutine
from typing import Any

import pytest

from lifecycle.node.gate import GatedPublisher, GatedSubscription, GatedTimer, NodeGate

INFO = {"source_timestamp": 0, "received_timestamp": 0, "publication_sequence_number": 1}


class FakePublisher:
    topic = "/video"

    def __init__(self) -> None:
        self.sent: list[object] = []

    def publish(self, msg: object) -> None:
        self.sent.append(msg)


class FakeSubscription:
    def __init__(
        self, callback: Callable[..., object], *, durability: str = "VOLATILE", depth: int = 2
    ) -> None:
        self.callback = callback
        self.topic_name = "/video"
        self.qos_profile = types.SimpleNamespace(
            durability=types.SimpleNamespace(name=durability), depth=depth
        )


def at_once(task: Callable[[], Coroutine[Any, Any, None]]) -> None:
    """Run a task as an executor would, but now."""
    with pytest.raises(StopIteration):
        task().send(None)


class FakeTimer:
    def __init__(self) -> None:
        self.running = True

    def cancel(self) -> None:
        self.running = False

    def reset(self) -> None:
        self.running = True


def test_a_closed_publisher_drops_and_says_so_once_per_inactive_period() -> None:
    gate, publisher, warnings = NodeGate(), FakePublisher(), list[str]()
    gate.add(publisher, GatedPublisher(publisher, warnings.append))
    publisher.publish(1)
    publisher.publish(2)
    gate.open()
    publisher.publish(3)
    gate.close()
    publisher.publish(4)
    assert publisher.sent == [3]
    said = (
        "cannot publish on '/video': the node is not active, so the message is dropped, and so "
        "are those that follow until it is active"
    )
    assert warnings == [said, said]


def test_an_entity_made_while_active_is_open_at_once() -> None:
    gate, publisher = NodeGate(), FakePublisher()
    gate.open()
    gate.add(publisher, GatedPublisher(publisher, pytest.fail))
    publisher.publish(1)
    assert publisher.sent == [1]


def test_a_removed_entity_is_left_alone() -> None:
    gate, timer = NodeGate(), FakeTimer()
    gate.add(timer, GatedTimer(timer, wanted=True))
    gate.remove(timer)
    gate.open()
    assert not timer.running


def test_a_callback_with_message_info_is_replaced_by_one_that_takes_it_too() -> None:
    subscription = FakeSubscription(lambda message, info: None)
    GatedSubscription(subscription, NodeGate(), at_once).close()
    subscription.callback("message", INFO)
    with pytest.raises(TypeError):
        subscription.callback("message")


def test_what_arrives_while_open_is_counted_since_then() -> None:
    received: list[object] = []
    gate, subscription = NodeGate(), FakeSubscription(received.append)
    gate.add(subscription, GatedSubscription(subscription, gate, at_once))
    assert gate.measured() is None
    gate.open()
    later_ns = time.time_ns() + 10**9
    for number in (4, 7):
        info = {"received_timestamp": later_ns, "publication_sequence_number": number}
        subscription.callback(number, {**info, "source_timestamp": later_ns})
    measured = gate.measured()
    assert received == [4, 7]
    assert measured is not None
    assert measured.active_s >= 0
    assert [topic for topic, _ in measured.samples] == ["/video"]
    gate.close()
    assert gate.measured() is None


def test_kept_samples_wait_on_if_the_gate_closes_before_they_are_delivered() -> None:
    received: list[object] = []
    gate = NodeGate()
    subscription = FakeSubscription(received.append, durability="TRANSIENT_LOCAL")
    tasks: list[Callable[[], Coroutine[Any, Any, None]]] = []
    gate.add(subscription, GatedSubscription(subscription, gate, tasks.append))
    subscription.callback("map", INFO)
    gate.open()
    gate.close()
    at_once(tasks[0])
    assert received == []
    gate.open()
    at_once(tasks[1])
    assert received == ["map"]


def test_a_timer_that_the_user_cancelled_stays_cancelled() -> None:
    gate, timer = NodeGate(), FakeTimer()
    gate.add(timer, GatedTimer(timer, wanted=True))
    gate.open()
    timer.cancel()
    gate.close()
    gate.open()
    assert not timer.running


def test_a_timer_that_the_user_starts_while_closed_starts_when_open() -> None:
    gate, timer = NodeGate(), FakeTimer()
    gate.add(timer, GatedTimer(timer, wanted=False))
    gate.open()
    gate.close()
    timer.reset()
    assert not timer.running
    gate.open()
    assert timer.running
