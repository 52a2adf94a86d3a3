"""What a TRANSIENT_LOCAL publisher keeps to send again, and what not."""

from __future__ import annotations

import time
from typing import Any

import pytest
from msgspec.structs import replace
from rclpy.serialization import deserialize_message
from std_msgs.msg import String

from lifecycle.manifest.qos import Durability, History, QosProfile
from lifecycle.node.gate import Kept


class FakePublisher:
    """Takes what rclpy's takes."""

    def __init__(self) -> None:
        self.sent: list[str] = []

    def publish(self, msg: bytes) -> None:
        self.sent.append(deserialize_message(msg, String).data)


LATCHED = QosProfile(durability=Durability.TRANSIENT_LOCAL, history=History.KEEP_LAST, depth=2)


def kept(qos: QosProfile = LATCHED) -> Kept:
    found = Kept.of(qos)
    assert found is not None
    return found


def sent_again(keeps: Kept) -> list[str]:
    new: Any = FakePublisher()
    keeps.send_again(new)
    sent: list[str] = new.sent
    return sent


def say(keeps: Kept, *messages: object) -> None:
    for each in messages:
        keeps.add(each)


def test_the_last_messages_are_sent_again_until_they_are_forgotten() -> None:
    keeps = kept()
    say(keeps, *(String(data=each) for each in ("one", "two", "three")))
    assert sent_again(keeps) == ["two", "three"]
    keeps.forget()
    assert sent_again(keeps) == []


def test_a_message_is_kept_as_it_was_when_it_was_sent() -> None:
    keeps, message = kept(), String(data="then")
    say(keeps, message)
    message.data = "now"
    assert sent_again(keeps) == ["then"]


def test_what_has_outlived_its_lifespan_is_not_sent_again(monkeypatch: pytest.MonkeyPatch) -> None:
    now_ns = [1_000]
    monkeypatch.setattr(time, "monotonic_ns", lambda: now_ns[0])
    keeps = kept(replace(LATCHED, lifespan_ns=50))
    for each in ("dead", "alive"):
        say(keeps, String(data=each))
        now_ns[0] += 30
    assert sent_again(keeps) == ["alive"]


@pytest.mark.parametrize(
    "qos",
    [
        None,
        QosProfile(durability=Durability.VOLATILE, history=History.KEEP_LAST, depth=2),
        QosProfile(durability=Durability.TRANSIENT_LOCAL, history=History.KEEP_ALL),
    ],
)
def test_only_a_bounded_history_for_latecomers_is_kept(qos: QosProfile | None) -> None:
    assert Kept.of(qos) is None
