"""The three layers of the graph interface put together on real DDS.

Owns: `Graph`, for programs that want to follow a ROS graph without putting anything together. What
it tells comes from graph messages, from the configurations that nodes serve, and from discovery for
nodes that do neither; it sleeps until one of them has something to say.
"""

from __future__ import annotations

import functools
import os
import threading
import typing
from collections.abc import Callable

from rclpy.node import Node

from lifecycle.graph.asking import Asker
from lifecycle.graph.dds import DdsTransport
from lifecycle.graph.discovery import Discovery
from lifecycle.graph.events import SILENT_AFTER_S, GraphEvents
from lifecycle.graph.model import EventKind, GraphEvent
from lifecycle.graph.scheduler import Remove, ThreadScheduler
from lifecycle.graph.state import GraphState
from lifecycle.graph.transport import GraphTransport
from lifecycle.middleware import GraphObserver, on_graph_change
from lifecycle.middleware.rcl.spinning import Spinner
from lifecycle.plan.model import ParticipantConnections
from lifecycle.verify.observation import NodeConfiguration


@typing.final
class Graph:
    """A ROS graph as it is now, and what happens in it.

    Use `open` in a program that has no node, `on` in one that has. Callbacks come in a thread of
    the graph's own, one after another; they must be quick. `close` it, or use it in a `with`.

    Attributes:
        transport: layer 1, for who wants to send.
        events: layer 2.
        state: layer 3.
    """

    def __init__(
        self,
        node: Node,
        watch: Callable[[Callable[[], None]], Remove],
        *,
        transport: GraphTransport | None = None,
        silent_after_s: float = SILENT_AFTER_S,
    ) -> None:
        """Put the layers together on `node`; `watch` calls back after each change of the graph."""
        self.scheduler = ThreadScheduler()
        self.transport = transport or DdsTransport(node)
        self._asker = Asker(node, self.scheduler)
        self.events = GraphEvents(self.transport, self.scheduler, silent_after_s=silent_after_s)
        self.state = GraphState(self.events, self._fetch)
        self._discovery = Discovery(node, self.events, self._asker, self.state.reread)
        self._owned: tuple[Callable[[], None], ...] = ()
        self._closed = False
        self._forget = self.events.on(EventKind.LEFT, self._left)
        self._unwatch = watch(lambda: self.scheduler.post(self._changed))
        self.scheduler.post(self._discovery.look)

    @classmethod
    def open(
        cls,
        domain_id: int | None = None,
        *,
        connections: ParticipantConnections | None = None,
        silent_after_s: float = SILENT_AFTER_S,
    ) -> Graph:
        """Follow the graph of a domain with a participant of its own.

        Args:
            domain_id: 0–232; None: ROS_DOMAIN_ID, else 0.
            connections: how the participant is connected; None leaves it to the RMW.
            silent_after_s: see `GraphEvents`.

        Raises:
            MiddlewareError: no participant could be made.
        """
        if domain_id is None:
            domain_id = int(os.environ.get("ROS_DOMAIN_ID") or 0)
        observer = GraphObserver(domain_id, connections)
        spinner = Spinner(observer.node, thread="graph-node")
        graph = cls(observer.node, observer.on_change, silent_after_s=silent_after_s)
        graph._owned = (spinner.stop, observer.destroy)
        return graph

    @classmethod
    def on(cls, node: Node, *, silent_after_s: float = SILENT_AFTER_S) -> Graph:
        """Follow the graph with a node that is there and that an executor spins.

        Nothing is spun here: what the graph has to say comes while the node's executor runs. Close
        it before the node is destroyed.

        Args:
            node: any rclpy node, a LifecycleNode for instance.
            silent_after_s: see `GraphEvents`.

        Raises:
            MiddlewareError: rcl's graph guard condition could not be waited on.
        """
        return cls(node, functools.partial(on_graph_change, node), silent_after_s=silent_after_s)

    def wait_for(self, holds: Callable[[GraphState], object], *, timeout_s: float) -> bool:
        """Wait until something holds of the state; False if it did not within `timeout_s`.

        It is looked at after each change, never in between. Not to be called in a callback.
        """
        found = threading.Event()

        def look(*_: object) -> None:
            if not found.is_set() and holds(self.state):
                found.set()

        remove = self.state.on_change(look)
        try:
            self.scheduler.post(look)
            return found.wait(timeout_s)
        finally:
            remove()

    def close(self) -> None:
        """Leave the graph; again is harmless. Nothing is called back after it."""
        if self._closed:
            return
        self._closed = True
        self._unwatch()
        self._forget()
        self.state.close()
        self.events.close()
        self.scheduler.close()
        self._discovery.close()
        self._asker.close()
        self.transport.close()
        for release in self._owned:
            release()

    def __enter__(self) -> Graph:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _fetch(self, node: str, done: Callable[[NodeConfiguration | None], None]) -> None:
        self._discovery.fetch(node, done)

    def _changed(self) -> None:
        self._discovery.changed()
        self.state.retry()

    def _left(self, event: GraphEvent) -> None:
        self._asker.forget(event.node)
