"""Several followers of the graph of one participant."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Iterator

import pytest
import rclpy
from rclpy.node import Node
from std_msgs.msg import String

from lifecycle.middleware.rcl.graph_queries import GraphGuard

BOUND_S = 30.0


@pytest.fixture
def nodes(context: rclpy.Context) -> Iterator[tuple[Node, Node]]:
    """Two nodes on one participant."""
    made = tuple(Node(name, context=context, enable_rosout=False) for name in ("one", "two"))
    yield made
    for node in made:
        node.destroy_node()


class Counted:
    """A callback that can be waited for."""

    def __init__(self) -> None:
        self.calls = 0
        self._called = threading.Condition()

    def __call__(self) -> None:
        with self._called:
            self.calls += 1
            self._called.notify_all()

    def until(self, holds: Callable[[int], bool]) -> bool:
        with self._called:
            return self._called.wait_for(lambda: holds(self.calls), BOUND_S)


@contextlib.contextmanager
def followed(node: Node, callback: Counted) -> Iterator[Callable[[], None]]:
    stop = GraphGuard.of(node).follow(node, callback)
    yield stop
    stop()


def guards() -> int:
    return sum(each.name == "graph-guard" for each in threading.enumerate())


def test_who_stays_goes_on_hearing_when_the_first_one_leaves(nodes: tuple[Node, Node]) -> None:
    one, two = nodes
    first, second = Counted(), Counted()
    with followed(one, first) as stop, followed(two, second):
        stop()
        one.destroy_node()  # it is not held back by the thread that still follows
        calls = first.calls
        two.create_publisher(String, "/topic", 1)
        before = second.calls
        two.create_publisher(String, "/another", 1)
        assert second.until(lambda now: now > before)
        assert first.calls == calls


def test_nobody_follows_a_participant_any_more_once_its_context_is_shut_down(
    context: rclpy.Context, nodes: tuple[Node, Node]
) -> None:
    before = guards()
    with followed(nodes[0], Counted()):
        assert guards() == before + 1
        context.try_shutdown()
        assert guards() == before
