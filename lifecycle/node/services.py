"""The services of a node and its own timers; none of it passes the gate.

Those of lifecycle_msgs and `~/transition_event` have rcl_lifecycle's names, types and QoS
(rcl_lifecycle/src/com_interface.c). A request that the state does not allow is answered with
success=False; it never raises.

A request of the node interface (connect_to, map_to, disconnect, remap) is a list of names and
values, the answer says of each whether it succeeded and why not:

    ros2 service call /camera/connect_to rcl_interfaces/srv/SetParameters \
        "{parameters: [{name: net, value: {type: 4, string_value: 'udpv4://10.77.0.1:7911'}}]}"
"""

from __future__ import annotations

import functools
import traceback
from collections.abc import Callable, Coroutine, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from lifecycle_msgs import msg, srv
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue, SetParametersResult
from rcl_interfaces.srv import SetParameters
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node

from lifecycle.errors import LifecycleError
from lifecycle.node import machine
from lifecycle.node.callbacks import CallbackOutcome
from lifecycle.node.connections import connections_of
from lifecycle.node.machine import Machine, RefusedError

if TYPE_CHECKING:
    from rclpy.callback_groups import CallbackGroup

    from lifecycle.node.data_layer import DataLayer


_TRANSITION_EVENT_DEPTH = 10  # rmw_qos_profile_default


def serve(
    node: Node, state_machine: Machine, group: CallbackGroup
) -> Callable[[machine.Transition], None]:
    """Serve a node's state machine; returns what publishes a transition event.

    The group must be reentrant, so that others can ask while a transition runs.
    """
    # Not through our node's own create_publisher: this one must work in every state.
    events = Node.create_publisher(
        node, msg.TransitionEvent, "~/transition_event", _TRANSITION_EVENT_DEPTH
    )
    states = [_state(each) for each in machine.AVAILABLE_STATES]
    edges = srv.GetAvailableTransitions
    answers: dict[str, tuple[Any, Callable[[Any, Any], Any]]] = {
        "change_state": (
            srv.ChangeState,
            functools.partial(_change_state, node, state_machine),
        ),
        "get_state": (
            srv.GetState,
            lambda *_: srv.GetState.Response(current_state=_state(state_machine.state.seen)),
        ),
        "get_available_states": (
            srv.GetAvailableStates,
            lambda *_: srv.GetAvailableStates.Response(available_states=states),
        ),
        "get_available_transitions": (
            edges,
            lambda *_: _described(state_machine.available_transitions()),
        ),
        "get_transition_graph": (edges, lambda *_: _described(machine.TRANSITION_GRAPH)),
    }
    for name, (type_, answer) in answers.items():
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
        node.get_logger().warning(
            f"cannot take transition {name} in state {state_machine.state.value!r}; "
            f"allowed here: {state_machine.allowed()}"
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
    """What one node has done in its executor, once it has one.

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


Acts = Mapping[str, Callable[[Parameter], Any]]
"""By name of the service: does one of the things that a request asks for; may return a future."""


def acts_of(data_layer: DataLayer) -> Acts:
    """Return what the services of one of our nodes do."""

    def connect_to(asked: Parameter) -> None:
        data_layer.connect_to(asked.name, connections_of(_texts(asked)))

    return {
        "connect_to": connect_to,
        "map_to": lambda asked: data_layer.map_to(asked.name, "".join(_texts(asked))),
        "disconnect": lambda asked: data_layer.disconnect(asked.name),
        "remap": lambda asked: data_layer.remap(asked.name, "".join(_texts(asked))),
    }


def serve_interface(node: Node, acts: Acts, group: CallbackGroup) -> None:
    """Serve a node's interface; the group must be reentrant, as a handover lasts."""
    log = node.get_logger().error
    for name, act in acts.items():
        Node.create_service(
            node, SetParameters, f"~/{name}", _serving(act, log), callback_group=group
        )


def _serving(
    act: Callable[[Parameter], Any], log: Callable[[str], object]
) -> Callable[[Any, Any], Any]:
    """Return what answers a request for several things at once."""

    def begin(asked: Parameter) -> tuple[SetParametersResult, Any]:
        try:
            return SetParametersResult(successful=True), act(asked)
        except LifecycleError as error:
            return SetParametersResult(successful=False, reason=str(error)), None
        except Exception as error:  # noqa: BLE001 - asking must not end the node
            log(traceback.format_exc())
            reason = f"cannot do this: {error!r}"
            return SetParametersResult(successful=False, reason=reason), None

    async def serve(
        request: SetParameters.Request, response: SetParameters.Response
    ) -> SetParameters.Response:
        # All are begun before any is waited for: handovers then last as long as one.
        for result, lasting in [begin(each) for each in request.parameters]:
            if lasting is not None:
                await lasting
            response.results.append(result)
        return response

    return serve


def _texts(parameter: Parameter) -> Sequence[str]:
    value: ParameterValue = parameter.value
    if value.type == ParameterType.PARAMETER_STRING:
        return (str(value.string_value),)
    if value.type == ParameterType.PARAMETER_STRING_ARRAY:
        return tuple(value.string_array_value)
    raise LifecycleError(
        f"cannot use the value given for {parameter.name!r}: it is no string, and no strings",
        hint="write {type: 4, string_value: '…'} or {type: 9, string_array_value: ['…']}",
    )
