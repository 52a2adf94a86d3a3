"""Following the graph of a participant, however many want to.

Owns: the one guard of each participant, which is there only while somebody follows it.
"""

from __future__ import annotations

import atexit
import threading
import weakref
from collections.abc import Callable

from rclpy.context import Context
from rclpy.node import Node

from lifecycle.middleware.rcl.graph_guard import GraphGuard


def on_graph_change(node: Node, callback: Callable[[], bool | None]) -> Callable[[], None]:
    """Have `callback` called after each change of the graph that `node` sees.

    It costs a thread that sleeps, one for all who follow the same participant.

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
    """All who follow the graph of one participant."""

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
                self._changed()  # what came in between was told to nobody

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
