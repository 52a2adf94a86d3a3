"""What rclpy.lifecycle.LifecycleNode offers beside its callbacks, on our state machine.

Owns: `trigger_configure` and its like, managed entities, lifecycle publishers, and the attributes
by which rclpy's own tools reach its state machine, so that a class written for
rclpy.lifecycle.LifecycleNode works when it derives from ours.
"""

from __future__ import annotations

import threading
from collections.abc import Coroutine, Generator
from typing import Any

from rclpy.lifecycle import (
    LifecyclePublisher,
    LifecycleState,
    ManagedEntity,
    TransitionCallbackReturn,
)
from rclpy.node import Node

from lifecycle.errors import LifecycleError
from lifecycle.middleware import NodeExecutor, RCLError
from lifecycle.node.author.managed import Managed
from lifecycle.node.lifecycle.execution import Result
from lifecycle.node.lifecycle.machine import (
    AVAILABLE_STATES,
    TRANSITION_GRAPH,
    NodeState,
    RefusedError,
    Transition,
    TransitionRequest,
)

SERVICES = (
    "change_state",
    "get_state",
    "get_available_states",
    "get_available_transitions",
    "get_transition_graph",
)


class StateMachineView:
    """A node's state machine as rclpy's `node._state_machine` shows it.

    Attributes:
        initialized: always.
        service_change_state: its handle; None without a communication interface, as the others.
    """

    initialized = True

    def __init__(self, managed: Managed) -> None:
        self._managed = managed
        for name in SERVICES:
            service = managed.service(name)
            setattr(self, f"service_{name}", None if service is None else service.handle)

    @property
    def current_state(self) -> tuple[int, str]:
        """Id and label."""
        seen = self._managed.state.seen
        return seen.id, seen.label

    @property
    def available_states(self) -> list[tuple[int, str]]:
        """Id and label of every state."""
        return [(each.id, each.label) for each in AVAILABLE_STATES]

    @property
    def available_transitions(self) -> list[tuple[int, str, int, str, int, str]]:
        """Those of the state that the node is in: id, label, and both states of each."""
        return _edges(self._managed.available_transitions())

    @property
    def transition_graph(self) -> list[tuple[int, str, int, str, int, str]]:
        """All of them."""
        return _edges(TRANSITION_GRAPH)


def _edges(transitions: tuple[Transition, ...]) -> list[tuple[int, str, int, str, int, str]]:
    return [
        (each.id, each.label, each.start.id, each.start.label, each.goal.id, each.goal.label)
        for each in transitions
    ]


class RclpyLifecycle(Node, ManagedEntity):  # type: ignore[misc]  # rclpy is not typed
    """Transitions by call, managed entities and lifecycle publishers, as rclpy's have them."""

    lifecycle: Managed
    _managed_entities: dict[int, ManagedEntity]
    _state_machine: StateMachineView

    def _take_rclpy_names(self) -> None:
        self._state_machine = StateMachineView(self.lifecycle)
        for name in SERVICES:
            service = self.lifecycle.service(name)
            if service is not None:
                setattr(self, f"_service_{name}", service)

    def trigger_configure(self) -> TransitionCallbackReturn:
        """Configure now, and return what the callback returned.

        An `async def` callback is waited for; inside the node's executor that is an ERROR: await
        `self.lifecycle.change("configure")` there.

        Raises:
            RCLError: not possible in this state.
        """
        return self._trigger(TransitionRequest.CONFIGURE)

    def trigger_cleanup(self) -> TransitionCallbackReturn:
        """Clean up now; as `trigger_configure`."""
        return self._trigger(TransitionRequest.CLEANUP)

    def trigger_shutdown(self) -> TransitionCallbackReturn:
        """Shut down now; as `trigger_configure`."""
        return self._trigger(TransitionRequest.SHUTDOWN)

    def trigger_activate(self) -> TransitionCallbackReturn:
        """Connect if need be, and activate now; as `trigger_configure`."""
        return self._trigger(TransitionRequest.ACTIVATE)

    def trigger_deactivate(self) -> TransitionCallbackReturn:
        """Deactivate now; as `trigger_configure`."""
        return self._trigger(TransitionRequest.DEACTIVATE)

    def add_managed_entity(self, entity: ManagedEntity) -> None:
        """Have the default `on_…` callbacks call those of `entity`, too.

        A class that overrides one of them calls `super().on_…(state)` for that.

        Raises:
            TypeError: not an rclpy.lifecycle.ManagedEntity.
        """
        if not isinstance(entity, ManagedEntity):
            raise TypeError(f"cannot manage {entity!r}; derive it from ManagedEntity")
        self._managed_entities[id(entity)] = entity

    def create_lifecycle_publisher(self, *arguments: Any, **options: Any) -> LifecyclePublisher:
        """As rclpy's: a publisher that the default on_activate enables and on_deactivate disables.

        Raises:
            TypeError: `publisher_class` is given.
        """
        if "publisher_class" in options:
            raise TypeError("cannot choose the publisher_class of a lifecycle publisher")
        publisher = self.create_publisher(*arguments, **options, publisher_class=LifecyclePublisher)
        self._managed_entities[id(publisher)] = publisher
        return publisher

    def destroy_lifecycle_publisher(self, publisher: LifecyclePublisher) -> bool:
        """As rclpy's."""
        self._managed_entities.pop(id(publisher), None)
        return bool(self.destroy_publisher(publisher))

    def _call_managed(self, name: str, state: LifecycleState) -> TransitionCallbackReturn:
        """Call `on_…` of every managed entity, up to the first that does not succeed."""
        for entity in tuple(self._managed_entities.values()):
            returned = getattr(entity, name)(state)
            if not isinstance(returned, TransitionCallbackReturn):
                raise TypeError(
                    f"cannot use {returned!r}, returned by {name} of the managed entity {entity!r};"
                    " return a TransitionCallbackReturn"
                )
            if returned is not TransitionCallbackReturn.SUCCESS:
                return returned
        return TransitionCallbackReturn.SUCCESS

    def _trigger(self, request: TransitionRequest) -> TransitionCallbackReturn:
        if request is TransitionRequest.SHUTDOWN and not self._may_shut_down():
            raise RCLError(f"cannot shut down in state {self.lifecycle.state.value!r}")
        try:
            result = self._finish(self.lifecycle.change(request))
        except RefusedError as refused:
            raise RCLError(str(refused)) from refused
        return TransitionCallbackReturn.__members__[result.outcome.name]

    def _may_shut_down(self) -> bool:
        state = self.lifecycle.state
        return state.steady and state is not NodeState.FINALIZED

    def _finish(self, transition: Coroutine[Any, Any, Result]) -> Result:
        """Run a transition to its end: at once where no callback awaits anything."""
        from lifecycle.node.author.node import in_executor

        try:
            transition.send(None)
        except StopIteration as stop:
            result: Result = stop.value
            return result
        if in_executor():
            try:
                transition.throw(
                    LifecycleError(
                        "cannot wait for an `async def` callback inside the executor that runs it",
                        hint="await self.lifecycle.change(…) instead of calling trigger_…()",
                    )
                )
            except StopIteration as stop:
                ended: Result = stop.value
                return ended
        return self._wait_for(transition)

    def _wait_for(self, transition: Coroutine[Any, Any, Result]) -> Result:
        async def rest() -> Result:
            return await _Rest(transition)

        executor = self.executor
        if executor is not None:
            task = executor.create_task(rest)
            over = threading.Event()
            task.add_done_callback(lambda _: over.set())
            over.wait()
        else:
            executor = NodeExecutor(context=self.context)
            executor.add_node(self)
            task = executor.create_task(rest)
            while not task.done():
                executor.next_callback()()
            node: Any = self
            node.executor = None
            executor.shutdown()
        found: Result = task.result()
        return found


class _Rest:
    """What is left of a coroutine that has been begun."""

    def __init__(self, coroutine: Coroutine[Any, Any, Result]) -> None:
        self._coroutine = coroutine

    def __await__(self) -> Generator[Any, Any, Result]:
        return (yield from self._coroutine.__await__())
