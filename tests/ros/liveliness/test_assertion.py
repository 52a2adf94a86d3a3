"""How the liveliness of a process is asserted."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from rclpy.node import Node
from rclpy.publisher import Publisher

from lifecycle.middleware.discovery.liveliness import AlivePublisher, AliveSubscription

pytestmark = pytest.mark.ros


def test_liveliness_is_asserted_without_rclpy_s_call_which_keeps_the_gil(
    make_node: Callable[..., Node],
    spin_until: Callable[..., Any],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Fast DDS hung in an assertion while peers left, and all of a supervisor with it."""
    kept: list[Publisher] = []
    monkeypatch.setattr(Publisher, "assert_liveliness", kept.append)
    heard: list[bool | str] = []
    here, there = make_node("here"), make_node("there")
    subscription = AliveSubscription(
        there,
        "/alive",
        on_liveliness=heard.append,
        on_left=lambda: heard.append("left"),
        on_notice=lambda _: None,
    )
    publisher = AlivePublisher(here, "/alive")
    spin_until(lambda: heard == [True], here, there)
    publisher.destroy()
    spin_until(lambda: heard == [True, "left"], here, there)
    subscription.destroy()
    assert kept == []
