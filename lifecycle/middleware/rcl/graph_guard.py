"""Waiting for graph changes without polling.

Owns: a thread that sleeps on rcl's graph guard condition, which rclpy does not expose, and on one
guard condition of its own by which it is stopped. A change wakes it within a millisecond.
"""

from __future__ import annotations

import ctypes
import logging
import threading
from collections.abc import Callable, Iterator

from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node

from lifecycle.errors import MiddlewareError
from lifecycle.middleware.rcl import abi

_logger = logging.getLogger(__name__)
_FOR_EVER = -1
_AGAIN_NS = tuple(round(each * 1e9) for each in (0.001, 0.003, 0.01, 0.03, 0.1, 0.3, 1.0, 3.0))
"""Pauses after a change, while somebody says that what he waits for may follow it: discovery tells
of an endpoint a moment before it is matched (measured: 0.4 ms), and nothing tells of the match."""
_STOP = 1
_GUARDS = 2


class GraphGuard:
    """Calls `on_change` in its own thread whenever discovery changes the graph that `node` sees.

    Changes that come while `on_change` runs are folded into one further call: level-triggered.
    A participant has one such condition, and who is woken by it resets it: two guards on it take
    the changes from each other. Where several may follow one, use `graph_changes`.

    Args:
        node: its context must outlive the guard; call `stop` before destroying either.
        on_change: quick; an exception it raises is logged and ends nothing. While it returns True
            it is called a few times more after a change, ever later, for 4.4 s in all.
    """

    def __init__(self, node: Node, on_change: Callable[[], bool | None]) -> None:
        self._rcl = abi.load()
        self._node = node
        self._on_change = on_change
        with node.context.handle:
            self._stop_guard = rclpy_implementation.GuardCondition(node.context.handle)
        self._wait_set = self._rcl.zero_wait_set()
        self._check(
            self._rcl.wait_set_init(
                ctypes.byref(self._wait_set),
                *(0, _GUARDS, 0, 0, 0, 0),
                node.context.handle.pointer,
                self._rcl.default_allocator,
            )
        )
        self._stopping = False
        self.failure: MiddlewareError | None = None
        """Why the thread gave up; None while it works."""
        self._thread = threading.Thread(target=self._run, name="graph-guard", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """End the thread and free the wait set; again is harmless, from `on_change` an error."""
        if self._stopping:
            return
        self._stopping = True
        with self._stop_guard:
            self._stop_guard.trigger_guard_condition()
        self._thread.join()
        self._rcl.wait_set_fini(ctypes.byref(self._wait_set))
        self._stop_guard.destroy_when_not_in_use()

    def _run(self) -> None:
        # Holding the handles keeps rclpy from freeing what the C code below points at.
        with self._node.context.handle, self._node.handle, self._stop_guard:
            graph = self._rcl.graph_guard(self._node.handle.pointer)
            pauses: Iterator[int] = iter(())
            try:
                while (changed := self._wait(graph, next(pauses, _FOR_EVER))) is not None:
                    if changed:
                        pauses = iter(_AGAIN_NS)
                    if not self._notify():
                        pauses = iter(())
            except MiddlewareError as error:
                _logger.exception("the graph is no longer watched")
                self.failure = error
                self._notify()

    def _wait(self, graph: int, pause_ns: int) -> bool | None:
        """Block until the graph changed (True), a pause is over (False) or `stop` came (None)."""
        wait_set = ctypes.byref(self._wait_set)
        while True:
            self._check(self._rcl.wait_set_clear(wait_set))
            self._check(self._rcl.wait_set_add_guard(wait_set, graph, None))
            self._check(self._rcl.wait_set_add_guard(wait_set, self._stop_guard.pointer, None))
            result = self._rcl.wait(wait_set, pause_ns)
            if self._stopping or self._wait_set.guard_conditions[_STOP]:
                return None
            if result == abi.RCL_RET_OK:
                return True
            if result != abi.RCL_RET_TIMEOUT:
                self._check(result)
            elif pause_ns != _FOR_EVER:
                return False

    def _notify(self) -> bool:
        try:
            return bool(self._on_change())
        except Exception:
            _logger.exception("cannot handle a graph change")
            return False

    def _check(self, result: int) -> None:
        if result != abi.RCL_RET_OK:
            raise MiddlewareError(f"cannot wait for graph changes: {self._rcl.take_error()}")
