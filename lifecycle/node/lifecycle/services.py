"""The five lifecycle_msgs services and `~/transition_event` of a managed node, and its own timers.

Owns: translation between messages and the state machine; and how parts of a node run in the
executor that spins it: turns, and timers that run in every state. None of it passes the gate.

Names, types and QoS are rcl_lifecycle's (rcl_lifecycle/src/com_interface.c). A request that the
state does not allow is answered with success=False; it never raises.
"""

from __future__ import annotations

from collections.abc import Callable, Coroutine, Iterable
from typing import TYPE_CHECKING, Any

from lifecycle_msgs import msg, srv
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node
from rclpy.timer import Timer

from lifecycle.node.lifecycle import machine
from lifecycle.node.lifecycle.machine import Machine, RefusedError
from lifecycle.node.lifecycle.steps import CallbackOutcome

if TYPE_CHECKING:
    from rclpy.callback_groups import CallbackGroup


_TRANSITION_EVENT_DEPTH = 10  # rmw_qos_profile_default


class LifecycleServices:
    """Serves one node's state machine to `ros2 lifecycle`, launch_ros, nav2 and all others."""

    def __init__(self, node: Node, state_machine: Machine, group: CallbackGroup) -> None:
        """Create the services and the event publisher on `node`.

        Args:
            node: the node to be seen as managed.
            state_machine: its state machine.
            group: must be reentrant, so that others can ask while a transition runs.
        """
        self._machine = state_machine
        self._warn = node.get_logger().warning
        # Not through our node's own create_publisher: this one must work in every state.
        self._events = Node.create_publisher(
            node, msg.TransitionEvent, "~/transition_event", _TRANSITION_EVENT_DEPTH
        )
        for type_, name, callback in (
            (srv.ChangeState, "change_state", self._change_state),
            (srv.GetState, "get_state", self._get_state),
            (srv.GetAvailableStates, "get_available_states", self._get_available_states),
            (
                srv.GetAvailableTransitions,
                "get_available_transitions",
                self._get_available_transitions,
            ),
            (srv.GetAvailableTransitions, "get_transition_graph", self._get_transition_graph),
        ):
            Node.create_service(node, type_, f"~/{name}", callback, callback_group=group)

    def publish(self, transition: machine.Transition) -> None:
        """Publish a transition event, with the fields that rcl_lifecycle fills in.

        rcl leaves `timestamp` and `transition` empty. Connect and disconnect fill in `transition`:
        start and goal are the same there, so nothing else distinguishes the two.
        """
        event = msg.TransitionEvent(
            start_state=_state(transition.start), goal_state=_state(transition.goal)
        )
        if transition.start == transition.goal:
            event.transition = msg.Transition(id=transition.id, label=transition.label)
        self._events.publish(event)

    async def _change_state(
        self, request: srv.ChangeState.Request, response: srv.ChangeState.Response
    ) -> srv.ChangeState.Response:
        asked = request.transition
        resolved = self._machine.resolve(asked.id, asked.label)
        response.success = False
        if resolved is None:
            name = repr(asked.label) if asked.label else f"number {asked.id}"
            allowed = ", ".join(each.value for each in self._machine.allowed()) or "nothing"
            self._warn(
                f"cannot take transition {name} in state {self._machine.state.value!r}; "
                f"allowed here: {allowed}"
            )
            return response
        try:
            result = await self._machine.change(resolved)
        except RefusedError as refused:
            self._warn(str(refused))
        else:
            response.success = result.outcome is CallbackOutcome.SUCCESS
        return response

    def _get_state(self, _: object, response: srv.GetState.Response) -> srv.GetState.Response:
        response.current_state = _state(self._machine.state.seen)
        return response

    def _get_available_states(
        self, _: object, response: srv.GetAvailableStates.Response
    ) -> srv.GetAvailableStates.Response:
        response.available_states = [_state(each) for each in machine.AVAILABLE_STATES]
        return response

    def _get_available_transitions(
        self, _: object, response: srv.GetAvailableTransitions.Response
    ) -> srv.GetAvailableTransitions.Response:
        response.available_transitions = _descriptions(self._machine.available_transitions())
        return response

    def _get_transition_graph(
        self, _: object, response: srv.GetAvailableTransitions.Response
    ) -> srv.GetAvailableTransitions.Response:
        response.available_transitions = _descriptions(machine.TRANSITION_GRAPH)
        return response


def _state(state: machine.State) -> msg.State:
    return msg.State(id=state.id, label=state.label)


def _descriptions(edges: Iterable[machine.Transition]) -> list[msg.TransitionDescription]:
    return [
        msg.TransitionDescription(
            transition=msg.Transition(id=edge.id, label=edge.label),
            start_state=_state(edge.start),
            goal_state=_state(edge.goal),
        )
        for edge in edges
    ]


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
        timers: list[Timer] = []

        def call_off() -> None:
            while timers:
                Node.destroy_timer(self._node, timers.pop())

        def once() -> None:
            call_off()
            callback()

        timers.append(self.timer(delay_s, once))
        return call_off

    def timer(self, period_s: float, callback: Callable[[], Any]) -> Timer:
        """Call back every `period_s` seconds, in every state, also while time is simulated."""
        return Node.create_timer(self._node, period_s, callback, self.group, clock=self._clock)

    def end(self, timer: Timer) -> None:
        """Have a timer call back no more."""
        Node.destroy_timer(self._node, timer)

    def wake(self) -> None:
        """Make the executor look at its waiting tasks again."""
        if self._node.executor is not None:
            self._node.executor.wake()
