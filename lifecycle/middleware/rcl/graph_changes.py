"""Graph changes without polling: rcl's guard condition, and whether a client's server is matched.

Owns: the thread of each participant that sleeps on rcl's graph guard condition, which rclpy does
not expose, while anybody follows the graph.

rmw_fastrtps counts a client's server only while both its ends are matched, and as many as the graph
knows of (rmw_service_server_is_available.cpp, rcl_action_server_is_available).
"""

from __future__ import annotations

import atexit
import functools
import logging
import threading
import typing
import weakref
from collections.abc import Callable
from typing import TYPE_CHECKING, TypeAlias

from rclpy.client import Client
from rclpy.context import Context
from rclpy.exceptions import InvalidHandle
from rclpy.guard_condition import GuardCondition
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.utilities import get_rmw_implementation_identifier

from lifecycle.errors import MiddlewareError
from lifecycle.middleware.rcl import abi

if TYPE_CHECKING:
    from rclpy.action import ActionClient

    AnyClient: TypeAlias = Client | ActionClient

Callback = Callable[[], object]

_logger = logging.getLogger(__name__)
_SOON_S, _AGAIN_S = 0.002, 0.2
"""Pauses, ever longer, while a callback says that what it waits for may follow a change: discovery
shows an endpoint a moment before it is matched, and no event reports the match."""
_UNKNOWN_S = 0.5
"""An rcl whose layouts are not known gives no event: the graph may have changed after so long."""
_GONE = (InvalidHandle, ValueError, rclpy_implementation.RCLError)
"""What rclpy raises of what was destroyed meanwhile, and where a name cannot be had."""


@typing.final
class GraphGuard:
    """Calls back when discovery changes the graph that a participant sees; get it by `of`.

    Changes during callbacks are folded into one further call.

    Attributes:
        failure: why the thread gave up; None while it works.
    """

    def __init__(self) -> None:
        self.failure: MiddlewareError | None = None
        self._lock = threading.Lock()
        self._callbacks: dict[object, tuple[Node, Callback]] = {}
        self._node: Node | None = None  # through which it watches
        self._end: Callable[[], None] = lambda: None

    @classmethod
    def of(cls, node: Node) -> GraphGuard:
        """Return that of a node's participant: two would take the changes from each other."""
        with _lock:
            guard = _guards.get(node.context)
            if guard is None:
                guard = _guards[node.context] = cls()
                node.context.on_shutdown(guard.close)
        return guard

    def follow(self, node: Node, callback: Callback) -> Callable[[], None]:
        """Have `callback` called in the thread after each change.

        Args:
            node: of the participant; take the callback away before it is destroyed.
            callback: quick; an exception it raises is logged and ends nothing. While it returns
                True it is called again without a change, at last each 0.2 s.

        Returns:
            A function that takes the callback away again; not to be called by a callback.

        Raises:
            MiddlewareError: rcl's graph guard condition could not be waited on.
        """
        key = object()
        with self._lock:
            if self._node is None:
                self._start(node)
            self._callbacks = {**self._callbacks, key: (node, callback)}
        return lambda: self._remove(key)

    def close(self) -> None:
        """Let go of the participant: its context is shut down, or the program ends."""
        with self._lock:
            self._callbacks = {}
            self._stop()

    def _remove(self, key: object) -> None:
        with self._lock:
            self._callbacks = {other: it for other, it in self._callbacks.items() if other != key}
            nodes = [node for node, _ in self._callbacks.values()]
            if self._node in (None, *nodes):
                return
            self._stop()
            if nodes:
                self._start(nodes[0])
                self.notify()  # changes in between were not reported

    def _start(self, node: Node) -> None:
        stopped, wake = threading.Event(), None
        watch = functools.partial(self._look_often, stopped)
        if not abi.refusal():
            wake = GuardCondition(None, None, context=node.context)
            guards = abi.GuardWait(node.context.handle.pointer, 2)
            watch = functools.partial(self._wait, node, guards, wake, stopped)
        thread = threading.Thread(target=watch, name="graph-guard", daemon=True)
        thread.start()

        def end() -> None:
            stopped.set()
            if wake is not None:
                wake.trigger()
            thread.join()

        self._node, self._end, self.failure = node, end, None

    def _stop(self) -> None:
        if self._node is not None:
            self._node = None
            self._end()

    def _look_often(self, stopped: threading.Event) -> None:
        while not stopped.wait(_UNKNOWN_S):
            self.notify()

    def _wait(
        self, node: Node, guards: abi.GuardWait, wake: GuardCondition, stopped: threading.Event
    ) -> None:
        """Notify after each change, and while a callback returns True after ever longer pauses."""
        graph = abi.load().call["rcl_node_get_graph_guard_condition"](node.handle.pointer)
        pause_s: float | None = None
        try:
            # Meanwhile rclpy frees nothing of what is waited for.
            with node.context.handle, node.handle, wake.handle:
                while True:
                    changed = guards.wait((graph, wake.handle.pointer), pause_s)
                    if stopped.is_set():
                        return
                    if not self.notify():
                        pause_s = None
                    elif changed or pause_s is None:
                        pause_s = _SOON_S
                    else:
                        pause_s = min(2 * pause_s, _AGAIN_S)
        except MiddlewareError as error:
            _logger.exception("the graph is no longer watched")
            self.failure = error
            self.notify()
        finally:
            guards.close()
            wake.destroy()

    def notify(self) -> bool:
        """Call all back, in this thread; return whether any is to be called again."""
        wanted = [_call(callback) for _, callback in self._callbacks.values()]
        return any(wanted)


def _call(callback: Callback) -> bool:
    try:
        return callback() is True
    except Exception:
        _logger.exception("cannot handle a graph change")
        return False


_lock = threading.Lock()
_guards: weakref.WeakKeyDictionary[Context, GraphGuard] = weakref.WeakKeyDictionary()


@atexit.register
def _let_go() -> None:
    """Leave no thread in rcl when the interpreter ends: it would keep the participant alive."""
    for guard in tuple(_guards.values()):
        guard.close()


_COUNTING_BOTH_WAYS = ("rmw_fastrtps_cpp", "rmw_fastrtps_dynamic_cpp")
"""Others answer from the graph alone, or were not looked at."""


def is_server_matched(client: AnyClient) -> bool | None:
    """Return whether a server is matched with a client both ways; None if the RMW cannot say."""
    return _is_ready(client) if get_rmw_implementation_identifier() in _COUNTING_BOTH_WAYS else None


@typing.final
class ServerWatch:
    """Calls back when the server of a client was matched, or is no longer.

    No event reports that, but each match follows a change of the graph.

    Args:
        node: of the client.
        client: to watch; `stop` before it is destroyed.
        changed: called in a thread of the graph, also by the constructor if a server is matched
            already; quick.
    """

    def __init__(self, node: Node, client: AnyClient, changed: Callable[[], None]) -> None:
        self._node = node
        self._client = client
        self._changed = changed
        self._lock = threading.Lock()
        self._matched = False
        self._stop: Callable[[], None] | None = GraphGuard.of(node).follow(node, self._look)
        self._look()

    def stop(self) -> None:
        """End it; again is harmless."""
        if self._stop is not None:
            self._stop()
            self._stop = None

    def _look(self) -> bool:
        """Look; return whether a match may follow what is in the graph already."""
        try:
            with self._lock:
                matched = _is_ready(self._client)
                has_changed = matched != self._matched
                self._matched = matched
            if has_changed:
                self._changed()
            if isinstance(self._client, Client):
                service = self._client.service_name
            else:
                service = f"{self._client.action_name}/_action/send_goal"
            return not matched and bool(self._node.count_services(service))
        except _GONE:
            return False  # it was destroyed meanwhile


def _is_ready(client: AnyClient) -> bool:
    if isinstance(client, Client):
        return bool(client.service_is_ready())
    return bool(client.server_is_ready())
