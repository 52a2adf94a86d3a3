"""Nodes of rclpy's own classes: what their endpoints are, state machine, executor.

Owns: the state machine of rclpy.lifecycle's nodes, driven in this process: rclpy 7 swallows what
its callbacks raise, and an invalid request by service ends the process (rclpy/lifecycle/node.py).
Of rclpy it takes private names as Jazzy and Kilted have them, and refuses to drive a node that has
others.
"""

from __future__ import annotations

import contextlib
import functools
import inspect
import traceback
from collections.abc import Callable, Collection, Iterator
from typing import Any

from lifecycle_msgs.msg import Transition
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.exceptions import InvalidHandle
from rclpy.executors import SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation as _rclpy
from rclpy.lifecycle import LifecycleNodeMixin, TransitionCallbackReturn
from rclpy.node import Node
from rclpy.service import Service
from rclpy.subscription import Subscription
from rclpy.task import Task
from rclpy.timer import Timer
from rclpy.waitable import NumberOfEntities, Waitable

from lifecycle.manifest.model import EndpointKind
from lifecycle.middleware.versions import private

RCLError = _rclpy.RCLError

_ACTIONS = {
    ("rclpy.action.server", "ActionServer"): EndpointKind.ACTION_SERVER,
    ("rclpy.action.client", "ActionClient"): EndpointKind.ACTION_CLIENT,
}


def noted_action(node: Node, waitable: Any) -> EndpointKind | None:
    """Return which end of an action one of rclpy's constructors has just added; None for others.

    Its `action_name` is fully qualified then.
    """
    names = ((each.__module__, each.__name__) for each in type(waitable).__mro__)
    kind = next((_ACTIONS[each] for each in names if each in _ACTIONS), None)
    if kind is not None:
        waitable.action_name = _action_name(node, kind, waitable)
    return kind


def _action_name(node: Node, kind: EndpointKind, action: Any) -> str:
    """Return the fully qualified name of an action that was just made; rclpy 7 does not keep it."""
    from rclpy import action as graph  # imported by who made it: late, it takes 100 ms

    query = (
        graph.get_action_server_names_and_types_by_node
        if kind is EndpointKind.ACTION_SERVER
        else graph.get_action_client_names_and_types_by_node
    )
    class_ = interface_of(action)
    type_ = f"{class_.__module__.partition('.')[0]}/action/{class_.__name__}"
    found = query(node, node.get_name(), node.get_namespace())
    listed = [str(name) for name, types in found if type_ in types]
    known = {getattr(each, "action_name", "") for each in node.waitables}
    new = [name for name in listed if name not in known]
    return next(iter(new or listed), "")  # a second client of a name brings none


def follow_goals(server: Any, ended: Callable[[Exception | None], object]) -> None:
    """Call back at the end of each goal with what the handler of an action server raised, or None.

    Where rclpy keeps the handler otherwise than is known, nothing is called.
    """
    execute = getattr(server, "_execute_callback", None)
    if execute is None:
        return

    @functools.wraps(execute)
    async def call(goal: Any) -> Any:
        try:
            returned = execute(goal)
            returned = await returned if inspect.isawaitable(returned) else returned
        except Exception as error:
            ended(error)
            raise
        ended(None)
        return returned

    server.register_execute_callback(call)


def interface_of(entity: Any) -> type[Any]:
    """Return the message, service or action class of one of rclpy's endpoints."""
    for name in ("msg_type", "srv_type", "_action_type"):
        found = getattr(entity, name, None)
        if found is not None:
            return found  # type: ignore[no-any-return]
    raise TypeError(f"cannot tell the interface of {entity!r}")


_DONE_IN = {
    Transition.TRANSITION_CONFIGURE: ("inactive", "active"),
    Transition.TRANSITION_CLEANUP: ("unconfigured",),
    Transition.TRANSITION_ACTIVATE: ("active",),
    Transition.TRANSITION_DEACTIVATE: ("inactive",),
}
"""Labels of the states in which nothing is left to do of a transition."""
_CHANGE, _CALLBACKS = "_LifecycleNodeMixin__change_state", "_callbacks"
_MACHINE = "_state_machine"
_DRIVE = "drive a node of rclpy.lifecycle in this process"


class RclpyStateMachine:
    """The state machine of one node of rclpy.lifecycle, driven by its own methods.

    It is guarded from the moment that rclpy has made the node: its class's constructor may ask for
    transitions, too. Where a supervisor drives the node, the node's own code gets SUCCESS for what
    is reached already, and FAILURE where the gate is closed. By its services, and from its
    supervisor, the same request is an error.

    Args:
        node: whose class derives from LifecycleNodeMixin, of which the constructor may still run.
        is_driven: a supervisor drives it.
        may_activate: whether an activate request may be carried out now.
        changed: is called when the state is another one: read `label`.

    Raises:
        MiddlewareError: rclpy keeps its state machine otherwise than is known.
    """

    def __init__(
        self,
        node: LifecycleNodeMixin,
        *,
        is_driven: bool,
        may_activate: Callable[[], bool],
        changed: Callable[[], None],
    ) -> None:
        self._node = node
        self._is_driven = is_driven
        self._may_activate = may_activate
        self._changed = changed
        self._change = private(node, _CHANGE, _DRIVE)
        self._is_complete = False
        self._is_asked = False  # by its supervisor or a client
        self._has_said = False
        # Both its service and its trigger_ methods come by here.
        setattr(node, _CHANGE, self._request)

    def complete(self) -> None:
        """Guard what the constructor of its class has made by now; again is harmless."""
        if self._is_complete:
            return
        self._is_complete = True
        private(self._node, _MACHINE, _DRIVE)
        callbacks = private(self._node, _CALLBACKS, _DRIVE)  # registered once, by its constructor
        for state, callback in tuple(callbacks.items()):
            callbacks[state] = self._reporting(callback)
        service = getattr(self._node, "_service_change_state", None)
        if service is not None:
            service.callback = self._serving(service.callback)

    @property
    def label(self) -> str:
        """Of the state, as lifecycle_msgs/State has it."""
        machine = getattr(self._node, _MACHINE, None)  # None: its constructor runs
        return "unconfigured" if machine is None else str(machine.current_state[1])

    def destroy(self) -> None:
        """Let go of the node, after it was destroyed: rclpy keeps its participant for this else."""
        private(self._node, _MACHINE, _DRIVE).destroy_when_not_in_use()

    def change(self, transition: str) -> Any:
        """Run configure, activate, deactivate, cleanup or shutdown; return what its callback did.

        Raises:
            RCLError: not possible in this state, or not now.
        """
        with self._asked():
            return getattr(self._node, f"trigger_{transition}")()

    @contextlib.contextmanager
    def _asked(self) -> Iterator[None]:
        self._is_asked = True
        try:
            yield
        finally:
            self._is_asked = False

    def _request(self, transition_id: int) -> Any:
        self.complete()
        # What its callbacks ask for is its own code's.
        is_asked, self._is_asked = self._is_asked, False
        is_own = not is_asked and self._is_driven
        if is_own and self.label in _DONE_IN.get(transition_id, ()):
            return TransitionCallbackReturn.SUCCESS
        if transition_id == Transition.TRANSITION_ACTIVATE and not self._may_activate():
            if not is_own:
                raise RCLError("the gate of its supervisor is closed")
            if not self._has_said:
                self._has_said = True
                self._node.get_logger().error(
                    "its own code asks to activate it while the gate of its supervisor is closed: "
                    "it activates once the gate lets it through"
                )
            return TransitionCallbackReturn.FAILURE
        try:
            return self._change(transition_id)
        finally:
            self._changed()

    def _reporting(self, callback: Callable[[Any], Any]) -> Callable[[Any], Any]:
        name = getattr(callback, "__name__", "a callback")

        @functools.wraps(callback)
        def call(previous: Any) -> Any:
            self._changed()
            try:
                returned = callback(previous)
            except Exception:
                self._node.get_logger().error(traceback.format_exc())
                raise
            if isinstance(returned, TransitionCallbackReturn):
                return returned
            self._node.get_logger().error(
                f"cannot use {returned!r}, returned by {name}; return a TransitionCallbackReturn"
            )
            return TransitionCallbackReturn.ERROR

        return call

    def _serving(self, callback: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
        @functools.wraps(callback)
        def answer(request: Any, response: Any) -> Any:
            try:
                with self._asked():
                    return callback(request, response)
            except RCLError as error:
                reason = str(error).splitlines()[0].partition(", at /")[0]
                asked = request.transition.label or f"number {request.transition.id}"
                self._node.get_logger().error(
                    f"cannot take transition {asked} in state {self.label!r}: {reason}"
                )
                response.success = False
                return response

        return answer


def is_rclpy_managed(node: object) -> bool:
    """Whether an object, or a class, is of rclpy.lifecycle."""
    return issubclass(node if isinstance(node, type) else type(node), LifecycleNodeMixin)


class Watching:
    """What an executor of ours waits for beside nodes: add it as if it were one.

    Events and services of nodes whose own executor does not run, or is another one.
    """

    def __init__(self) -> None:
        self.executor: Any = None
        self.timers: list[Any] = []
        self.subscriptions: list[Any] = []
        self.guards: list[Any] = []
        self.clients: list[Any] = []
        self.services: list[Any] = []
        self.waitables: list[Any] = []
        self._beside: dict[Waitable, _Beside] = {}

    def take_services(self, node: Node, services: Collection[Any]) -> None:
        """Serve what a node offers, whoever spins the node; destroy them before it.

        Where rclpy does not list them as is known, whoever spins the node serves them.
        """
        listed = getattr(node, "_services", [])  # what Node.destroy_service removes them from
        for each in services:
            if each in listed:
                listed.remove(each)
                self.services.append(each)
        self._wake()

    def drop_services(self, services: Collection[Any]) -> None:
        """Destroy what was taken; again is harmless."""
        for each in services:
            if each in self.services:
                self.services.remove(each)
                each.destroy()
        self._wake()

    def add_waitable(self, waitable: Any) -> None:
        """Wait for it from now on."""
        self.waitables.append(waitable)
        self._wake()

    def remove_waitable(self, waitable: Any) -> None:
        """Wait for it no more; again is harmless."""
        with contextlib.suppress(ValueError):
            self.waitables.remove(waitable)
        self._wake()

    def take_waitable(self, waitable: Waitable, run: Callable[..., object]) -> None:
        """Wait for what a node lists that an EventsExecutor runs; call it by `run` in there.

        Again is harmless.
        """
        if waitable not in self._beside:
            self._beside[waitable] = beside = _Beside(waitable, run)
            self.add_waitable(beside)

    def give_back(self, waitable: Waitable) -> None:
        """Leave a waitable to who runs its node, or forget it if it is destroyed; again too."""
        if (beside := self._beside.pop(waitable, None)) is not None:
            beside.end()
            self.remove_waitable(beside)

    def _wake(self) -> None:
        if self.executor is not None:
            self.executor.wake()


class _Beside(Waitable):  # type: ignore[misc]  # rclpy is not typed
    """A waitable, waited for beside the EventsExecutor, which finds nothing to wait for in it.

    If something arrives between the removal of a waitable and the next turn of that executor, it
    calls Python without the interpreter's lock: SIGSEGV (ros2/rclpy#1644). Removing one later or
    destroying it later does not help; not having it there does.
    """

    def __init__(self, waitable: Waitable, run: Callable[..., object]) -> None:
        super().__init__(ReentrantCallbackGroup())
        self._waitable, self._run = waitable, run
        self._is_ended = False
        self._count, self._add = waitable.get_num_entities, waitable.add_to_wait_set
        waitable.get_num_entities, waitable.add_to_wait_set = NumberOfEntities, lambda _: None

    def end(self) -> None:
        self._is_ended = True
        del self._waitable.get_num_entities, self._waitable.add_to_wait_set

    def __enter__(self) -> None:
        self._waitable.__enter__()

    def __exit__(self, *raised: object) -> None:
        self._waitable.__exit__(*raised)

    def get_num_entities(self) -> NumberOfEntities:
        return self._count()

    def add_to_wait_set(self, wait_set: Any) -> None:
        self._add(wait_set)

    def is_ready(self, wait_set: Any) -> bool:
        return bool(self._waitable.is_ready(wait_set))

    def take_data(self) -> Any:
        return self._waitable.take_data()

    async def execute(self, taken_data: Any) -> None:
        self._run(self._execute, taken_data)

    async def _execute(self, taken_data: Any) -> None:
        if not self._is_ended:
            await self._waitable.execute(taken_data)


class NodeExecutor(SingleThreadedExecutor):  # type: ignore[misc]  # rclpy is not typed
    """Says which callback is next: its user runs it, and knows when one begins and ends."""

    def next_callback(self) -> tuple[Task, Any]:
        """Wait for a callback, or the next part of one, and return it and what it is of, or None.

        Raises:
            ShutdownException: the executor was shut down.
            ExternalShutdownException: the context was.
        """
        while True:
            try:
                task, entity, _ = self.wait_for_ready_callbacks()
            except InvalidHandle:  # destroyed in another thread meanwhile
                continue
            return task, entity


def run(task: Task) -> None:
    """Run a callback; raises what it raises."""
    task()
    if (error := task.exception()) is not None:
        raise error


def described(entity: Any) -> str:
    """Return what a callback is of, in words; empty for a task."""
    try:
        if isinstance(entity, Subscription):
            return f"of the subscription of {entity.topic_name}"
        if isinstance(entity, Service):
            return f"of the service {entity.service_name}"
        if isinstance(entity, Timer):
            return f"of a timer of {entity.timer_period_ns / 1e9:g} s"
    except InvalidHandle:
        pass  # a callback before it has destroyed it
    return ""
