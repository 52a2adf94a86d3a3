"""Turns of the executor that spins a node, and timers that run in every state.

Owns: how the parts of a node come to run in its executor. None of it passes the gate.
"""

from __future__ import annotations

from collections.abc import Callable, Coroutine
from typing import TYPE_CHECKING, Any

from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node
from rclpy.timer import Timer

if TYPE_CHECKING:
    from rclpy.callback_groups import CallbackGroup


class Turns:
    """What one node has done in its executor.

    Args:
        node: whose executor it is, once it has one.
        group: reentrant, of the timers.
    """

    def __init__(self, node: Node, group: CallbackGroup) -> None:
        self._node = node
        self._group = group
        self._clock = Clock(clock_type=ClockType.STEADY_TIME)
        self._closed = False

    def close(self) -> None:
        """Begin nothing any more: the node is being destroyed."""
        self._closed = True

    def call_soon(self, task: Callable[[], Coroutine[Any, Any, None] | None]) -> bool:
        """Run a function, sync or async, in the node's executor; returns whether there is one."""
        executor = self._node.executor
        if executor is None or self._closed:  # a node that nobody spins receives nothing
            return False
        executor.create_task(task)
        return True

    def call_after(self, delay_s: float, callback: Callable[[], None]) -> Callable[[], None]:
        """Call back once in the node's executor, in every state; returns what calls that off."""
        timers: list[Timer] = []

        def call_off() -> None:
            while timers:
                Node.destroy_timer(self._node, timers.pop())

        def once() -> None:
            call_off()
            callback()

        timers.append(self.timer(delay_s, once))
        return call_off

    def timer(self, period_s: float, callback: Callable[[], Any]) -> Timer:
        """Call back every `period_s` seconds, in every state, also while time is simulated."""
        return Node.create_timer(self._node, period_s, callback, self._group, clock=self._clock)

    def wake_at_deadline(self, deadline_s: float) -> Callable[[], None]:
        """Wake the executor in `deadline_s`, by a timer that is not gated."""
        timer = self.timer(deadline_s, _wake)
        return lambda: Node.destroy_timer(self._node, timer)

    def wake(self) -> None:
        """Make the executor look at its waiting tasks again."""
        if self._node.executor is not None:
            self._node.executor.wake()


def _wake() -> None:
    """Being called is the point: the executor has woken."""
