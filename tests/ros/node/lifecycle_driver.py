"""Drives managed nodes through their services, as `ros2 lifecycle` does; nodes spun beside."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import rclpy
from lifecycle_msgs.msg import Transition, TransitionEvent
from lifecycle_msgs.srv import ChangeState, GetAvailableStates, GetAvailableTransitions, GetState
from rclpy.executors import SingleThreadedExecutor, TimeoutException
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from std_srvs.srv import Trigger

Edge = tuple[int, str, int, str, int, str]

REPEAT_S = 2.0
"""An answer that did not come within so long was dropped.

rmw_fastrtps drops it if the server does not know the client's reader within 100 ms. Never so where
server and client are of one participant, as in all tests whose nodes run in this process.
"""

_TURNS = 100
"""Of the executor, in which a timer of 10 ms may be ready each time on a busy machine."""


class Driver:
    """One executor with everything in it, and clients of the nodes under test."""

    def __init__(self, context: rclpy.Context) -> None:
        self.executor = SingleThreadedExecutor(context=context)
        self.node = Node("driver", context=context, enable_rosout=False)
        self.executor.add_node(self.node)
        self._nodes: list[Node] = []
        self._clients: dict[str, Any] = {}
        self.events: dict[str, list[TransitionEvent]] = {}

    def add(self, node: Node) -> None:
        """Spin `node` and listen to its transition events."""
        self._nodes.append(node)
        self.executor.add_node(node)
        name = node.get_fully_qualified_name()
        self.events[name] = []
        self.node.create_subscription(
            TransitionEvent, f"{name}/transition_event", self.events[name].append, 10
        )
        self.spin_until(lambda: self.node.count_publishers(f"{name}/transition_event") == 1)

    def remove(self, node: Node) -> None:
        """Stop spinning `node` and destroy it."""
        name = node.get_fully_qualified_name()
        self._nodes.remove(node)
        self.executor.remove_node(node)
        self._forget(f"{name}/")
        for subscription in list(self.node.subscriptions):
            if subscription.topic == f"{name}/transition_event":
                self.node.destroy_subscription(subscription)
        node.destroy_node()

    def close(self) -> None:
        """Destroy everything."""
        for node in list(self._nodes):
            self.remove(node)
        self.executor.remove_node(self.node)
        self.node.destroy_node()
        self.executor.shutdown()

    def spin_until(self, holds: Callable[[], object], *, timeout_s: float = 30.0) -> None:
        """Spin until `holds()`."""
        ends = time.monotonic() + timeout_s
        while not holds():
            assert time.monotonic() < ends, f"not within {timeout_s} s"
            self.executor.spin_once(timeout_sec=0.02)

    def settle(self) -> None:
        """Handle everything that is already there.

        What nodes of this process have published is: they are of one participant, which hands a
        sample to its own readers before `publish` returns.
        """
        for _ in range(_TURNS):
            if not self._turn():
                return

    def _turn(self) -> bool:
        """Run what is ready, once each; return whether any of it came to an end."""
        ended = False
        while True:
            try:
                handler, _, _ = self.executor.wait_for_ready_callbacks(timeout_sec=0)
            except TimeoutException:
                return ended
            handler()
            if handler.exception() is not None:
                raise handler.exception()
            ended |= handler.done()  # a callback that awaits something is run in each turn

    def start(self, type_: Any, name: str, request: Any) -> Any:
        """Send a request and return its future."""
        return self._client(type_, name).call_async(request)

    def call(self, type_: Any, name: str, request: Any) -> Any:
        """Send a request that may arrive twice and wait for the answer."""
        sent = [self.start(type_, name, request)]

        def answered() -> bool:
            if time.monotonic() > since + REPEAT_S * len(sent):
                sent.append(self.start(type_, name, request))
            return any(each.done() for each in sent)

        since = time.monotonic()
        self.spin_until(answered)
        return next(each for each in sent if each.done()).result()

    def run(self, function: Callable[..., Any], *arguments: object) -> Any:
        """Run a coroutine function in the executor; returns its result once it has ended."""
        future = self.executor.create_task(function, *arguments)
        self.spin_until(future.done)
        return future.result()

    def change(self, node: str, *, id_: int = 0, label: str = "") -> bool:
        """Ask for a transition; rclpy's own nodes raise on an invalid one, which counts as no."""
        request = ChangeState.Request(transition=Transition(id=id_, label=label))
        future = self.start(ChangeState, f"{node}/change_state", request)
        try:
            self.spin_until(future.done)
        except rclpy_implementation.RCLError:
            # It would have ended the process here; the node itself is as it was.
            return False
        return bool(future.result().success)

    def set(self, node: str, label: str) -> bool:
        """Do what `ros2 lifecycle set NODE LABEL` does: look the label up, then ask by id."""
        found = [edge for edge in self.available(node) if edge[1] == label]
        assert len(found) == 1, f"{label} is not available: {self.available(node)}"
        if f"{node}/change_state" not in self._clients:
            # This request may not arrive twice. The node learns of our readers in order: its
            # answer to one made later proves that it knows the one for the answer to come.
            self._client(ChangeState, f"{node}/change_state")
            self._forget(f"{node}/get_state")
            self.state(node)
        return self.change(node, id_=found[0][0])

    def state(self, node: str) -> tuple[int, str]:
        """Return id and label."""
        answer = self.call(GetState, f"{node}/get_state", GetState.Request()).current_state
        return answer.id, answer.label

    def states(self, node: str) -> list[tuple[int, str]]:
        """Return every state that the node knows."""
        request = GetAvailableStates.Request()
        answer = self.call(GetAvailableStates, f"{node}/get_available_states", request)
        return [(each.id, each.label) for each in answer.available_states]

    def available(self, node: str) -> list[Edge]:
        """Return the available transitions."""
        return self._edges(f"{node}/get_available_transitions")

    def graph(self, node: str) -> list[Edge]:
        """Return the transition graph."""
        return self._edges(f"{node}/get_transition_graph")

    def configuration(self, node: str) -> str:
        """Return what ~/get_configuration answers."""
        answer = self.call(Trigger, f"{node}/get_configuration", Trigger.Request())
        assert answer.success
        return str(answer.message)

    def heard(self, node: str) -> list[tuple[int, str, str, str]]:
        """Return (transition id, its label, start, goal) of the events so far."""
        return [
            (e.transition.id, e.transition.label, e.start_state.label, e.goal_state.label)
            for e in self.events[node]
        ]

    def _client(self, type_: Any, name: str) -> Any:
        if name not in self._clients:
            self._clients[name] = self.node.create_client(type_, name)
            self.spin_until(self._clients[name].service_is_ready)
        return self._clients[name]

    def _forget(self, prefix: str) -> None:
        for key in [key for key in self._clients if key.startswith(prefix)]:
            self.node.destroy_client(self._clients.pop(key))

    def _edges(self, service: str) -> list[Edge]:
        answer = self.call(GetAvailableTransitions, service, GetAvailableTransitions.Request())
        return [
            (
                each.transition.id,
                each.transition.label,
                each.start_state.id,
                each.start_state.label,
                each.goal_state.id,
                each.goal_state.label,
            )
            for each in answer.available_transitions
        ]
