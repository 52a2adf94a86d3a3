"""Graph changes without polling: rcl's guard condition, and whether a client's server is matched.

Owns: a thread that sleeps on rcl's graph guard condition, which rclpy does not expose, and on one
guard condition of its own by which it is stopped: a change wakes it within a millisecond; and the
one guard of each participant, which exists only while it is followed. Where the installed rcl is
not one whose layouts are known, the thread compares what rclpy shows four times a second instead.

What may be taken for a match of a client: rmw_fastrtps counts its server only while its request
writer has matched as many readers as its response reader has matched writers, at least one, and the
graph knows as many servers by either (rmw_service_server_is_available.cpp); an action's server is
that for all three services, and a publisher of feedback (rcl_action_server_is_available).
"""

from __future__ import annotations

import atexit
import contextlib
import ctypes
import logging
import threading
import time
import typing
import weakref
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, TypeAlias

from rclpy.client import Client
from rclpy.context import Context
from rclpy.exceptions import InvalidHandle
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.utilities import get_rmw_implementation_identifier

from lifecycle.errors import MiddlewareError
from lifecycle.middleware.rcl import abi
from lifecycle.middleware.rcl.graph_queries import fingerprint

if TYPE_CHECKING:
    from rclpy.action import ActionClient

    AnyClient: TypeAlias = Client | ActionClient


_logger = logging.getLogger(__name__)
_FOR_EVER = -1
_AGAIN_NS = tuple(round(each * 1e9) for each in (0.001, 0.003, 0.01, 0.03, 0.1, 0.3, 1.0, 3.0))
"""Pauses after a change, while a callback says that what it waits for may follow: discovery shows
an endpoint a moment before it is matched, and no event reports the match."""
_STOP = 1
_GUARDS = 2
_COMPARE_S = 0.25


class GraphGuard:
    """Calls `on_change` in its own thread whenever discovery changes the graph that `node` sees.

    Changes that happen while `on_change` runs are folded into one further call: level-triggered.
    A participant has one such condition, and waking by it resets it: two guards on it take
    the changes from each other. Where several may follow one, use `on_graph_change`.

    Args:
        node: its context must outlive the guard; call `stop` before destroying either.
        on_change: quick; an exception it raises is logged and ends nothing. While it returns True
            it is called a few times more after a change, ever later, for 4.4 s in all.
    """

    def __init__(self, node: Node, on_change: Callable[[], bool | None]) -> None:
        self._on_change = on_change
        self._source = _GuardCondition(node) if abi.is_known() else _Comparison(node)
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
        self._source.stop()
        self._thread.join()
        self._source.free()

    def _run(self) -> None:
        pauses: Iterator[int] = iter(())
        with self._source.held():
            try:
                while (changed := self._source.wait(next(pauses, _FOR_EVER))) is not None:
                    if changed:
                        pauses = iter(_AGAIN_NS)
                    if not self._notify():
                        pauses = iter(())
            except MiddlewareError as error:
                _logger.exception("the graph is no longer watched")
                self.failure = error
                self._notify()

    def _notify(self) -> bool:
        try:
            return bool(self._on_change())
        except Exception:
            _logger.exception("cannot handle a graph change")
            return False


class _GuardCondition:
    """Waits on rcl's graph guard condition, and on one of its own by which it is stopped."""

    def __init__(self, node: Node) -> None:
        self._rcl = abi.load()
        self._node = node
        with node.context.handle:
            self._stop_guard = rclpy_implementation.GuardCondition(node.context.handle)
        self._graph = 0
        self._stopping = False
        self._wait_set = self._rcl.zero_wait_set()
        self._check(
            self._rcl.wait_set_init(
                ctypes.byref(self._wait_set),
                *(0, _GUARDS, 0, 0, 0, 0),
                node.context.handle.pointer,
                self._rcl.default_allocator,
            )
        )

    @contextlib.contextmanager
    def held(self) -> Iterator[None]:
        """Keep rclpy from freeing what the C code of `wait` points at."""
        with self._node.context.handle, self._node.handle, self._stop_guard:
            self._graph = self._rcl.graph_guard(self._node.handle.pointer)
            yield

    def wait(self, pause_ns: int) -> bool | None:
        """Block until the graph changed (True), a pause is over (False) or `stop` came (None)."""
        wait_set = ctypes.byref(self._wait_set)
        while True:
            self._check(self._rcl.wait_set_clear(wait_set))
            self._check(self._rcl.wait_set_add_guard(wait_set, self._graph, None))
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

    def stop(self) -> None:
        """Have `wait` return None, now and later."""
        self._stopping = True
        with self._stop_guard:
            self._stop_guard.trigger_guard_condition()

    def free(self) -> None:
        """Free the wait set; nothing waits any more."""
        self._rcl.wait_set_fini(ctypes.byref(self._wait_set))
        self._stop_guard.destroy_when_not_in_use()

    def _check(self, result: int) -> None:
        if result != abi.RCL_RET_OK:
            raise MiddlewareError(f"cannot wait for graph changes: {self._rcl.take_error()}")


class _Comparison:
    """Reads the graph four times a second: all that is left with an rcl that is not known."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._stopped = threading.Event()
        self._last: object = None

    @contextlib.contextmanager
    def held(self) -> Iterator[None]:
        """Hold nothing: rclpy does that in each of its functions."""
        yield

    def wait(self, pause_ns: int) -> bool | None:
        """As that of `_GuardCondition`."""
        until_s = None if pause_ns == _FOR_EVER else time.monotonic() + pause_ns / 1e9
        while True:
            left_s = _COMPARE_S if until_s is None else until_s - time.monotonic()
            if self._stopped.wait(max(0.0, min(_COMPARE_S, left_s))):
                return None
            try:
                found = fingerprint(self._node)
            except InvalidHandle:
                return None  # it is being destroyed
            changed, self._last = found != self._last, found
            if changed:
                return True
            if until_s is not None and time.monotonic() >= until_s:
                return False

    def stop(self) -> None:
        """Have `wait` return None, now and later."""
        self._stopped.set()

    def free(self) -> None:
        """Nothing is kept."""


def on_graph_change(node: Node, callback: Callable[[], bool | None]) -> Callable[[], None]:
    """Have `callback` called after each change of the graph that `node` sees.

    It costs a thread that sleeps, one for all that follow the same participant.

    Args:
        node: take the callback away before it is destroyed.
        callback: called in that thread, as `GraphGuard` calls its `on_change`.

    Returns:
        A function that takes the callback away again; not to be called by a callback. One that
        is being called meanwhile may return later.

    Raises:
        MiddlewareError: rcl's graph guard condition could not be waited on.
    """
    with _lock:
        followers = _followers.get(node.context)
        if followers is None:
            followers = _followers[node.context] = _Followers()
            node.context.on_shutdown(followers.close)
    return followers.add(node, callback)


class _Followers:
    """All that follow the graph of one participant."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._callbacks: dict[object, tuple[Node, Callable[[], bool | None]]] = {}
        self._guard: GraphGuard | None = None
        self._node: Node | None = None  # the guard's

    def add(self, node: Node, callback: Callable[[], bool | None]) -> Callable[[], None]:
        key = object()
        with self._lock:
            if self._guard is None:
                self._guard, self._node = GraphGuard(node, self._changed), node
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
            if self._guard is None or self._node in nodes:
                return
            self._stop()
            if nodes:
                self._guard, self._node = GraphGuard(nodes[0], self._changed), nodes[0]
                self._changed()  # changes in between were not reported

    def _stop(self) -> None:
        if self._guard is not None:
            self._guard.stop()
            self._guard = self._node = None

    def _changed(self) -> bool:
        wanted = [callback() for _, callback in self._callbacks.values()]
        return any(wanted)


_lock = threading.Lock()
_followers: weakref.WeakKeyDictionary[Context, _Followers] = weakref.WeakKeyDictionary()


@atexit.register
def _let_go() -> None:
    """Leave no thread in rcl when the interpreter ends: it would keep the participant alive."""
    for followers in tuple(_followers.values()):
        followers.close()


_COUNTING_BOTH_WAYS = ("rmw_fastrtps_cpp", "rmw_fastrtps_dynamic_cpp")
"""Others answer from the graph alone, or were not looked at."""


def is_server_matched(client: AnyClient) -> bool | None:
    """Return whether a server is matched with a client both ways; None if the RMW cannot say."""
    return _is_ready(client) if get_rmw_implementation_identifier() in _COUNTING_BOTH_WAYS else None


@typing.final
class ServerWatch:
    """Calls back when the server of a client was matched, or is no longer.

    No event reports that, but each match follows a change of the graph within a moment: it is
    looked at then, for some seconds if need be, and not in between.

    Args:
        node: of the client.
        client: to watch; `stop` before it is destroyed.
        changed: called in a thread of the graph, also by the constructor if a server is matched
            already. It must be quick, and ask again by itself.
    """

    def __init__(self, node: Node, client: AnyClient, changed: Callable[[], None]) -> None:
        self._node = node
        self._client = client
        self._changed = changed
        self._lock = threading.Lock()
        self._matched = False
        self._stop: Callable[[], None] | None = on_graph_change(node, self._look)
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
            return not matched and self._is_offered()
        except (InvalidHandle, rclpy_implementation.RCLError):
            return False  # it was destroyed meanwhile

    def _is_offered(self) -> bool:
        if isinstance(self._client, Client):
            return bool(self._node.count_services(self._client.service_name))
        return bool(self._node.count_services(f"{self._client.action_name}/_action/send_goal"))


def _is_ready(client: AnyClient) -> bool:
    if isinstance(client, Client):
        return bool(client.service_is_ready())
    return bool(client.server_is_ready())
