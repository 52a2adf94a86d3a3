"""What a TRANSIENT_LOCAL publisher keeps to take along, and what not."""

from __future__ import annotations

import time

import pytest
from rclpy.serialization import deserialize_message
from std_msgs.msg import Header, String

from lifecycle.manifest.qos import Durability, History, QosProfile
from lifecycle.node.endpoints.publisher import Kept


class FakePublisher:
    """Takes what rclpy's takes."""

    msg_type = String

    def __init__(self) -> None:
        self.sent: list[str] = []

    def publish(self, msg: object) -> None:
        if not isinstance(msg, bytes):
            raise TypeError(f"Expected {self.msg_type}, got {type(msg)}")
        self.sent.append(deserialize_message(msg, String).data)


LATCHED = QosProfile(durability=Durability.TRANSIENT_LOCAL, history=History.KEEP_LAST, depth=2)


def kept(qos: QosProfile = LATCHED) -> Kept:
    found = Kept.of(qos)
    assert found is not None
    return found


def test_the_last_messages_are_given_once_to_each_publisher_that_has_not_had_them() -> None:
    keeps, old, new = kept(), FakePublisher(), FakePublisher()
    for each in ("one", "two", "three"):
        keeps.publish(String(data=each), (old,))
    keeps.catch_up((new,))
    keeps.publish(String(data="four"), (old,))
    keeps.catch_up((old, new))
    keeps.catch_up((old, new))
    assert old.sent == ["one", "two", "three", "four"]
    assert new.sent == ["two", "three", "four"]


def test_a_message_is_kept_as_it_was_when_it_was_sent() -> None:
    keeps, message, new = kept(), String(data="then"), FakePublisher()
    keeps.publish(message, (FakePublisher(),))
    message.data = "now"
    keeps.catch_up((new,))
    assert new.sent == ["then"]


def test_what_was_forgotten_is_not_given() -> None:
    keeps, new = kept(), FakePublisher()
    keeps.publish(String(data="old"), (FakePublisher(),))
    keeps.forget()
    keeps.catch_up((new,))
    assert new.sent == []


def test_what_has_outlived_its_lifespan_is_not_given(monkeypatch: pytest.MonkeyPatch) -> None:
    now_ns = [1_000]
    monkeypatch.setattr(time, "monotonic_ns", lambda: now_ns[0])
    qos = QosProfile(
        durability=Durability.TRANSIENT_LOCAL, history=History.KEEP_LAST, depth=2, lifespan_ns=50
    )
    keeps, new = kept(qos), FakePublisher()
    keeps.publish(String(data="dead"), (FakePublisher(),))
    now_ns[0] += 30
    keeps.publish(String(data="alive"), (FakePublisher(),))
    now_ns[0] += 30
    keeps.catch_up((new,))
    assert new.sent == ["alive"]


def test_a_message_of_another_type_is_refused_and_not_kept() -> None:
    keeps, new = kept(), FakePublisher()
    with pytest.raises(TypeError, match="Expected"):
        keeps.publish(Header(), (FakePublisher(),))
    keeps.catch_up((new,))
    assert new.sent == []


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
