"""Timers of nodes that go on when the machine's clock is set back.

Owns: `NodeTimers`, which clock the timers of a node go by for which its code names none. rclpy has
them go by the node's clock, the wall clock unless time is simulated: where that is set back by an
hour none of them calls for an hour, and nothing says so. Here it is one that only goes forward, as
of rclcpp's wall timers, unless time is simulated.
"""

from __future__ import annotations

import weakref
from collections.abc import Sequence

from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.impl.implementation_singleton import rclpy_implementation as _rclpy
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.timer import Timer

_SIMULATED = "use_sim_time"


class NodeTimers:
    """Follows whether the time of a node is simulated, which may change while it runs."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._timers: weakref.WeakSet[Timer] = weakref.WeakSet()
        node.add_post_set_parameters_callback(self._parameters_set)

    @property
    def clock(self) -> Clock:
        """What a timer goes by now that is to go by none in particular."""
        own = self._node.get_clock()
        return own if own.ros_time_is_active else self._steady

    def add(self, timer: Timer) -> None:
        """Have a timer, made with `clock`, go by whatever that is later."""
        self._timers.add(timer)

    def _parameters_set(self, parameters: Sequence[Parameter]) -> None:
        if not any(each.name == _SIMULATED for each in parameters):
            return
        clock = self.clock
        for timer in set(self._timers).intersection(self._node.timers):
            if timer.clock is not clock:
                _move(timer, clock)
        if self._node.executor is not None:
            self._node.executor.wake()


def _move(timer: Timer, clock: Clock) -> None:
    """Have a timer begin its period anew by another clock; a cancelled one stays cancelled."""
    old, context = timer.handle, timer._context  # noqa: SLF001 - rclpy has no other way to it
    with clock.handle, context.handle:
        new = _rclpy.Timer(
            clock.handle, context.handle, timer.timer_period_ns, not timer.is_canceled()
        )
    timer._Timer__timer, timer._clock = new, clock  # noqa: SLF001
    # Who waits for it notices that, and looks anew.
    old.destroy_when_not_in_use()
