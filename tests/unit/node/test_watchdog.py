"""What counts as hanging: callbacks do, transitions do not."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import pytest

from lifecycle.node.host.loop import Watchdog
from lifecycle.node.machine import NodeState


class Sign:
    """A busy sign that remembers."""

    def __init__(self) -> None:
        self.busy = False
        self.overlong: float | None = None

    def begin(self, what: str = "") -> None:
        self.busy = True

    def end(self) -> float | None:
        was, self.busy = self.busy, False
        return self.overlong if was else None


@dataclasses.dataclass
class Managed:
    full_name: str
    state: NodeState = NodeState.UNCONFIGURED
    listeners: list[Callable[[Any], None]] = dataclasses.field(default_factory=list)

    @property
    def reported(self) -> NodeState:
        return self.state


class Node:
    def __init__(self, name: str) -> None:
        self.lifecycle = Managed(name)

    def become(self, state: NodeState) -> None:
        self.lifecycle.state = state
        for listener in self.lifecycle.listeners:
            listener(self.lifecycle)


@pytest.fixture
def sign() -> Sign:
    return Sign()


@pytest.fixture
def overlong() -> list[float]:
    return []


@pytest.fixture
def dog(sign: Sign, overlong: list[float]) -> Watchdog:
    return Watchdog(sign, overlong.append)  # type: ignore[arg-type]


def added(dog: Watchdog, name: str) -> Node:
    node = Node(name)
    node.lifecycle.listeners.append(dog.follow)
    return node


def test_of_two_transitions_both_must_end(dog: Watchdog, sign: Sign) -> None:
    one, other = added(dog, "/one"), added(dog, "/other")
    dog.begin(None)
    one.become(NodeState.CONFIGURING)
    other.become(NodeState.CONFIGURING)
    one.become(NodeState.INACTIVE_DISCONNECTED)
    assert not sign.busy
    other.become(NodeState.INACTIVE_DISCONNECTED)
    assert sign.busy


def test_a_callback_that_came_back_late_is_told(
    dog: Watchdog, sign: Sign, overlong: list[float]
) -> None:
    sign.overlong = 1.5
    dog.begin(None)
    dog.end()
    assert overlong == [1.5]
