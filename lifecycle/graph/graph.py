"""The ROS graph on real DDS: the three layers of the graph interface put together.

Fed by node statuses, by the configurations that nodes serve or that are put there, and by
discovery. It sleeps until one of them has something new.
"""

from __future__ import annotations

import asyncio
import os
import threading
import typing
from collections.abc import Callable

from rclpy.node import Node

from lifecycle.graph.events import GraphEvents
from lifecycle.graph.loop import GraphLoop
from lifecycle.graph.observer import Observer
from lifecycle.graph.reporter import receive
from lifecycle.graph.state import GraphState
from lifecycle.middleware.rcl.graph import GraphObserver
from lifecycle.middleware.services.clients import NodeClients
from lifecycle.plan.model import ParticipantConnections, Plan
from lifecycle.verify.judge import verify
from lifecycle.verify.observation import Observation
from lifecycle.verify.verdict import Stage, Verdict


@typing.final
class Graph(Observer):
    """A ROS graph as it is now, and what happens in it.

    Use `open` in a program that has no node, `on` in one that has, `in_loop` in one that judges the
    graph in an asyncio loop. `close` it, or use it in a `with`. Callbacks come in a thread of the
    graph's own, or in that loop, one after another; they must be quick.

    Attributes:
        events: layer 2.
    """

    def __init__(
        self,
        discovery: GraphObserver,
        *,
        in_loop: bool = False,
        messages: bool = True,
        unplanned: bool = False,
    ) -> None:
        """Put the layers together; with a thread of its own the graph also follows every node."""
        super().__init__(
            discovery,
            NodeClients(discovery),
            GraphLoop(own_thread=not in_loop),
            unplanned=unplanned,
        )
        self.events = GraphEvents(self.state)
        self._stop_receiving: Callable[[], None] | None = None
        if messages:
            self._stop_receiving = receive(discovery.node, self.state.put_status)
        self._closed = False

    @classmethod
    def open(
        cls, domain_id: int | None = None, *, connections: ParticipantConnections | None = None
    ) -> Graph:
        """Follow the graph of a domain with a participant of its own.

        Args:
            domain_id: 0–232; None: ROS_DOMAIN_ID, else 0.
            connections: how the participant is connected; None leaves it to the RMW.

        Raises:
            MiddlewareError: no participant could be made.
        """
        if domain_id is None:
            domain_id = int(os.environ.get("ROS_DOMAIN_ID") or 0)
        return cls(GraphObserver(domain_id, connections))

    @classmethod
    def on(cls, node: Node) -> Graph:
        """Follow the graph with a node that an executor spins; close this before it is destroyed.

        Raises:
            MiddlewareError: rcl's graph guard condition could not be waited on.
        """
        return cls(GraphObserver.on(node))

    @classmethod
    def in_loop(
        cls,
        domain_id: int,
        connections: ParticipantConnections | None = None,
        *,
        messages: bool = False,
        unplanned: bool = False,
    ) -> Graph:
        """Look at the graph of a domain with a participant of its own, as a supervisor does.

        Make it before starting what is to be observed. All runs in the asyncio loop in which the
        graph is first used; nodes are asked when `observe` is called, and then only.

        Args:
            domain_id: 0–232.
            connections: how the participant is connected; None leaves it to the RMW.
            messages: receive what nodes say of themselves; a change is worth another look.
            unplanned: also ask nodes that are not planned, as far as they have our node interface.

        Raises:
            MiddlewareError: no participant could be made.
        """
        discovery = GraphObserver(domain_id, connections)
        return cls(discovery, in_loop=True, messages=messages, unplanned=unplanned)

    # -- judging

    def observation(self, plan: Plan) -> Observation:
        """Return what there is of `plan` now and what there is besides, for `lifecycle.verify`.

        It takes up to a second, and just after the graph was made up to 3.5 s. Not to be called in
        a callback, nor with `in_loop`: there, `observe`.
        """
        if not self._loop.has_thread:
            raise TypeError("cannot wait for an observation in its own loop; await observe(plan)")
        return asyncio.run_coroutine_threadsafe(self.observe(plan), self._loop.bind()).result()

    def verdict(self, plan: Plan, *, stage: Stage = Stage.ACTIVE) -> Verdict:
        """Return whether what runs now is what `plan` says, by the rules of `lifecycle verify`."""
        return verify(plan, self.observation(plan), stage=stage)

    # -- following

    def wait_for(self, holds: Callable[[GraphState], object], *, timeout_s: float) -> bool:
        """Wait until something holds of the state; False if it did not within `timeout_s`.

        It is looked at after each change. Not to be called in a callback.
        """
        found = threading.Event()

        def look(*_: object) -> None:
            if not found.is_set() and holds(self.state):
                found.set()

        remove = self.state.on_change(look)
        try:
            self._loop.post(look)
            return found.wait(timeout_s)
        finally:
            remove()

    def close(self) -> None:
        """Leave the graph; again is harmless. Nothing is called back after it."""
        if self._closed:
            return
        self._closed = True
        self.state.close()
        self._loop.close()
        super().close()
        if self._stop_receiving is not None:
            self._stop_receiving()
        self.clients.destroy()
        self.discovery.destroy()

    def __enter__(self) -> Graph:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
