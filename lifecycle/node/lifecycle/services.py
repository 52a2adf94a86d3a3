"""The five lifecycle_msgs services and `~/transition_event` of a managed node, and its own timers.

None of it passes the gate: services, and `Turns`, work in every state.

Names, types and QoS are rcl_lifecycle's (rcl_lifecycle/src/com_interface.c). A request that the
state does not allow is answered with success=False; it never raises.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Coroutine, Iterable
from typing import TYPE_CHECKING, Any

from lifecycle_msgs import msg, srv
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node

from lifecycle.node.lifecycle import machine
from lifecycle.node.lifecycle.machine import Machine, RefusedError
from lifecycle.node.lifecycle.steps import CallbackOutcome

if TYPE_CHECKING:
    from rclpy.callback_groups import CallbackGroup


_TRANSITION_EVENT_DEPTH = 10  # rmw_qos_profile_default


def serve(
    node: Node, state_machine: Machine, group: CallbackGroup
) -> Callable[[machine.Transition], None]:
    """Serve a node's state machine; returns what publishes a transition event.

    Args:
        node: the node to be seen as managed.
        state_machine: its state machine.
        group: must be reentrant, so that others can ask while a transition runs.
    """
    # Not through our node's own create_publisher: this one must work in every state.
    events = Node.create_publisher(
        node, msg.TransitionEvent, "~/transition_event", _TRANSITION_EVENT_DEPTH
    )
    answers: tuple[tuple[Any, str, Callable[[Any, Any], Any]], ...] = (
        (srv.ChangeState, "change_state", functools.partial(_change_state, node, state_machine)),
        (
            srv.GetState,
            "get_state",
            lambda *_: srv.GetState.Response(current_state=_state(state_machine.state.seen)),
        ),
        (
            srv.GetAvailableStates,
            "get_available_states",
            lambda *_: srv.GetAvailableStates.Response(
                available_states=[_state(each) for each in machine.AVAILABLE_STATES]
            ),
        ),
        (
            srv.GetAvailableTransitions,
            "get_available_transitions",
            lambda *_: _described(state_machine.available_transitions()),
        ),
        (
            srv.GetAvailableTransitions,
            "get_transition_graph",
            lambda *_: _described(machine.TRANSITION_GRAPH),
        ),
    )
    for type_, name, answer in answers:
        Node.create_service(node, type_, f"~/{name}", answer, callback_group=group)

    def publish(transition: machine.Transition) -> None:
        # As rcl fills it in. Of connect and disconnect start and goal are the same: only
        # `transition`, which rcl leaves empty, distinguishes the two.
        event = msg.TransitionEvent(
            start_state=_state(transition.start), goal_state=_state(transition.goal)
        )
        if transition.start == transition.goal:
            event.transition = msg.Transition(id=transition.id, label=transition.label)
        events.publish(event)

    return publish


async def _change_state(
    node: Node,
    state_machine: Machine,
    request: srv.ChangeState.Request,
    response: srv.ChangeState.Response,
) -> srv.ChangeState.Response:
    asked = request.transition
    resolved = state_machine.resolve(asked.id, asked.label)
    response.success = False
    if resolved is None:
        name = repr(asked.label) if asked.label else f"number {asked.id}"
        allowed = ", ".join(each.value for each in state_machine.allowed()) or "nothing"
        node.get_logger().warning(
            f"cannot take transition {name} in state {state_machine.state.value!r}; "
            f"allowed here: {allowed}"
        )
        return response
    try:
        result = await state_machine.change(resolved)
    except RefusedError as refused:
        node.get_logger().warning(str(refused))
    else:
        response.success = result.outcome is CallbackOutcome.SUCCESS
    return response


def _state(state: machine.State) -> msg.State:
    return msg.State(id=state.id, label=state.label)


def _described(edges: Iterable[machine.Transition]) -> srv.GetAvailableTransitions.Response:
    described = [
        msg.TransitionDescription(
            transition=msg.Transition(id=edge.id, label=edge.label),
            start_state=_state(edge.start),
            goal_state=_state(edge.goal),
        )
        for edge in edges
    ]
    return srv.GetAvailableTransitions.Response(available_transitions=described)


class Turns:
    """What one node has done in its executor.

    Args:
        node: whose executor it is, once it has one.

    Attributes:
        group: reentrant, of the timers, the node's services and its clients: others may ask, and
            answers arrive, while a callback runs.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self.group = ReentrantCallbackGroup()
        self._clock = Clock(clock_type=ClockType.STEADY_TIME)
        self._closed = False

    def close(self) -> None:
        """Begin nothing any more: the node is being destroyed."""
        self._closed = True

    def call_soon(self, task: Callable[[], Coroutine[Any, Any, None] | None]) -> bool:
        """Run a function, sync or async, in the node's executor; returns whether there is one."""
        executor = self._node.executor
        if executor is None or self._closed:  # a node that is not spun receives nothing
            return False
        executor.create_task(task)
        return True

    def call_after(self, delay_s: float, callback: Callable[[], None]) -> Callable[[], None]:
        """Call back once in the node's executor, in every state; returns what calls that off."""

        def once() -> None:
            call_off()
            callback()

        call_off = self.call_every(delay_s, once)
        return call_off

    def call_every(self, period_s: float, callback: Callable[[], Any]) -> Callable[[], None]:
        """Call back every `period_s` seconds of wall time, in every state; returns what ends it."""
        timers = [Node.create_timer(self._node, period_s, callback, self.group, clock=self._clock)]

        def end() -> None:
            while timers:
                Node.destroy_timer(self._node, timers.pop())

        return end

    def wake(self) -> None:
        """Make the executor look at its waiting tasks again."""
        if self._node.executor is not None:
            self._node.executor.wake()
