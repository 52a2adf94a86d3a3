"""Clients of the lifecycle, parameter and container services and of our node interface.

Owns: the requests to nodes that we reach only through their services, and how an unanswered one is
understood: a change_state without a reply is not a failed transition, so the state is read again
(rcl_lifecycle, lifecycle_msgs/srv/*).
"""

from __future__ import annotations

import asyncio
import importlib
from collections.abc import Awaitable, Callable, Collection, Coroutine, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, TypeVar

from lifecycle_msgs.msg import Transition, TransitionEvent
from lifecycle_msgs.srv import ChangeState, GetAvailableTransitions, GetState
from rcl_interfaces.msg import ParameterDescriptor, ParameterEvent
from rcl_interfaces.msg import ParameterValue as ParameterValueMessage
from rcl_interfaces.srv import (
    DescribeParameters,
    GetParameters,
    ListParameters,
    SetParameters,
    SetParametersAtomically,
)
from rclpy.clock import Clock, ClockType
from rclpy.parameter import Parameter, parameter_value_to_python
from rclpy.qos import QoSProfile, ReliabilityPolicy, qos_profile_parameter_events
from rclpy.subscription import Subscription
from rclpy.timer import Timer
from std_srvs.srv import Trigger

from lifecycle.errors import MiddlewareError
from lifecycle.manifest.model import ParameterValue
from lifecycle.manifest.qos import QosProfile
from lifecycle.middleware.rcl.conversions import (
    PARAMETER_TYPES,
    import_interface,
    parameter_to_rclpy,
    parameter_value,
    to_rclpy,
    type_word,
)
from lifecycle.middleware.rcl.graph import GraphObserver
from lifecycle.middleware.services.service_calls import ServiceCalls, ServiceUnansweredError
from lifecycle.plan.model import PlannedNode
from lifecycle.plan.parameters import COMMAND, DEFAULT
from lifecycle.verify.observation import (
    ConfigurationError,
    NodeConfiguration,
    ParameterReport,
    decode_configuration,
)
from lifecycle.verify.tool_filter import is_of_supervisor

if TYPE_CHECKING:
    from lifecycle.export.captured import CapturedParameter

TIMEOUT_S = 5.0
"""For services that answer at once; a transition takes as long as the node's callback does."""

_Reply = TypeVar("_Reply")

_REREAD_S = 1.0
_EVENT_DEPTH = 10
_GOALS = {
    "configure": "inactive",
    "cleanup": "unconfigured",
    "activate": "active",
    "deactivate": "inactive",
    "shutdown": "finalized",
}
"""Transition label → label of the state it leads to (lifecycle_msgs/Transition)."""

_DIAGNOSTICS = QoSProfile(depth=100, reliability=ReliabilityPolicy.BEST_EFFORT)
"""Matches whoever publishes them, reliably or not; they come again each second."""

_PARAMETER_SERVICES = ("list_parameters", "describe_parameters", "get_parameters")


class NodeClients:
    """Asks and drives nodes through their services. `destroy` it before the observer.

    Nodes are fully qualified names; deadlines are seconds, > 0. Every request raises
    ServiceUnansweredError where nothing offers the service or the answer does not come in time, and
    MiddlewareError with the reason where the node refuses.
    """

    def __init__(self, observer: GraphObserver) -> None:
        self._observer = observer
        self._calls = ServiceCalls(observer)
        self._subscriptions: dict[tuple[str, bool], Subscription] = {}  # by topic, and raw
        self._diagnostics_timer: Timer | None = None

    async def get_state(self, node: str, *, timeout_s: float = TIMEOUT_S) -> str:
        """Return the label of a managed node's state (lifecycle_msgs/State)."""
        response = await self._calls.call(f"{node}/get_state", GetState, timeout_s)
        return str(response.current_state.label)

    async def get_available_transitions(
        self, node: str, *, timeout_s: float = TIMEOUT_S
    ) -> tuple[str, ...]:
        """Return the labels of the transitions that may be asked for now."""
        service = f"{node}/get_available_transitions"
        response = await self._calls.call(service, GetAvailableTransitions, timeout_s)
        return tuple(each.transition.label for each in response.available_transitions)

    async def change_state(
        self,
        node: str,
        transition: str,
        *,
        timeout_s: float,
        before: Callable[[], Awaitable[None]] | None = None,
    ) -> bool:
        """Ask for one transition, wait until it is over, and return whether it succeeded.

        While the reply is missing, the state is read now and then: one that has reached the
        transition's goal counts as the reply.

        Args:
            node: whose state.
            transition: label, "configure", "activate", …
            timeout_s: for service, callback and reply together.
            before: awaited when the request is about to leave; what it raises keeps it back.
        """
        service = f"{node}/change_state"

        async def ask() -> bool:
            wanted = Transition(label=transition)
            reply = await self._calls.call(
                service, ChangeState, timeout_s, repeat=False, before=before, transition=wanted
            )
            return bool(reply.success)

        async def reached() -> bool | None:
            try:
                state = await self.get_state(node, timeout_s=_REREAD_S)
            except ServiceUnansweredError:
                return None
            return True if state == _GOALS.get(transition) else None

        return await _reply(ask(), reached)

    async def get_configuration(
        self, node: str, *, timeout_s: float = TIMEOUT_S, expected: bool = False
    ) -> NodeConfiguration | None:
        """Read the node configuration interface; None where discovery shows none on the node.

        One that is `expected` is waited for if discovery does not show it yet.
        """
        service = f"{node}/get_configuration"
        if not expected and not self._observer.offers(node, service):
            return None
        response = await self._calls.call(service, Trigger, timeout_s)
        what = f"read the configuration of {node!r}"
        _check(what, response.success, response.message)
        try:
            return decode_configuration(response.message, node)
        except ConfigurationError as error:
            hint = "the node may run another version of lifecycle"
            raise MiddlewareError(f"cannot {what}: {error}", hint=hint) from error

    async def load_component(
        self, node: PlannedNode, container: str, *, timeout_s: float = TIMEOUT_S
    ) -> Callable[[], Awaitable[None]]:
        """Have a component container load a node (composition_interfaces/srv/LoadNode).

        While the reply is missing, what the container has counts as one. Returns what has it unload
        the node again; raises as this does.
        """
        what = f"load {node.run.component!r} into {container!r}"
        try:
            services = importlib.import_module("composition_interfaces.srv")
        except ImportError as error:
            raise MiddlewareError(
                f"cannot {what}: composition_interfaces is not installed",
                hint="install it, or start the node as a command",
            ) from error
        at = f"{container}/_container"

        async def loaded() -> dict[int, str] | None:
            """Return what the container has, full names by number; None if it does not answer."""
            try:
                there = await self._calls.call(f"{at}/list_nodes", services.ListNodes, _REREAD_S)
            except ServiceUnansweredError:
                return None
            return dict(zip(there.unique_ids, there.full_node_names, strict=True))

        async def ask(service: str, type_: type[Any], what: str, **fields: Any) -> Any:
            response = await self._calls.call(
                f"{at}/{service}", type_, timeout_s, repeat=False, **fields
            )
            _check(what, response.success, response.error_message)
            return response

        async def load() -> int:
            package, _, plugin = node.run.component.partition("/")
            given = node.run.extra_arguments.items()
            extra = (Parameter(name, value=value) for name, value in given)
            response = await ask(
                "load_node",
                services.LoadNode,
                what,
                package_name=package,
                plugin_name=plugin,
                node_name=node.name,
                node_namespace=node.namespace,
                remap_rules=[f"{source}:={target}" for source, target in node.remap],
                parameters=_messages(_given_values(node).values()),
                extra_arguments=_messages(extra),
            )
            return int(response.unique_id)

        async def is_loaded() -> int | None:
            there = await loaded() or {}
            named = (number for number, name in there.items() if name == node.full_name)
            return max(named, default=None)

        number = await _reply(load(), is_loaded)

        async def is_unloaded() -> bool | None:
            there = await loaded()
            return None if there is None or number in there else True

        async def unload() -> None:
            what = f"unload {node.full_name!r} from {container!r}"
            asking = ask("unload_node", services.UnloadNode, what, unique_id=number)
            await _reply(asking, is_unloaded)

        return unload

    async def get_parameters(
        self, node: str, *, timeout_s: float = TIMEOUT_S
    ) -> tuple[CapturedParameter, ...]:
        """Read every parameter that a node declares, with types, values and descriptions."""
        from lifecycle.export.captured import CapturedParameter

        found = await self._read_parameters(node, None, timeout_s=timeout_s)
        return tuple(
            CapturedParameter(
                name=of.name,
                type=type_,
                value=value,
                description=of.description,
                read_only=of.read_only,
            )
            for of, type_, value in found
        )

    async def report_parameters(
        self, node: str, names: Collection[str] | None, *, timeout_s: float = TIMEOUT_S
    ) -> tuple[ParameterReport, ...]:
        """Read those parameters of a node that are named and that it has; None reads all."""
        found = await self._read_parameters(node, names, timeout_s=timeout_s)
        return tuple(
            ParameterReport.of(of.name, type_ or type_word(of.type), value, read_only=of.read_only)
            for of, type_, value in found
        )

    async def _read_parameters(
        self, node: str, names: Collection[str] | None, *, timeout_s: float
    ) -> list[tuple[ParameterDescriptor, str, ParameterValue | None]]:
        """Read descriptor, our name of the type, and value of parameters of a node, sorted by name.

        One that is declared and not set has an empty type and no value.

        Args:
            node: fully qualified name.
            names: those that it has of these; None for all.
            timeout_s: for each request.
        """

        async def ask(service: str, type_: type[Any], **fields: Any) -> Any:
            return await self._calls.call(f"{node}/{service}", type_, timeout_s, **fields)

        async def get(asked: list[str]) -> list[Any]:
            return list((await ask("get_parameters", GetParameters, names=asked)).values)

        has = set((await ask("list_parameters", ListParameters)).result.names)
        wanted = sorted(has if names is None else has.intersection(names))
        if not wanted:
            return []
        described, values = await asyncio.gather(
            ask("describe_parameters", DescribeParameters, names=wanted), get(wanted)
        )
        if len(values) != len(wanted):
            # One that is declared and not set makes rclpy and rclcpp answer with none at all.
            alone = await asyncio.gather(*(get([name]) for name in wanted))
            values = [each[0] if each else ParameterValueMessage() for each in alone]
        found = {each.name: each for each in described.descriptors}
        return [
            (
                found.get(name, ParameterDescriptor(name=name)),
                type_word(value.type),
                parameter_value(parameter_value_to_python(value))
                if type_word(value.type)
                else None,
            )
            for name, value in zip(wanted, values, strict=True)
        ]

    async def give_parameters(self, planned: PlannedNode) -> None:
        """Set the parameters that a running node has with other values than its plan gives it."""
        node = planned.full_name
        if not any(each.value is not None for each in planned.expected_parameters):
            return
        has = {each.name: each for each in await self.report_parameters(node, None)}
        values = _given_values(planned, {name: each.type for name, each in has.items()})
        wanted = {
            name: each for name, each in values.items() if name in has and _differs(has[name], each)
        }
        if not wanted:
            return
        given = _messages(wanted.values())
        response = await self._calls.call(
            f"{node}/set_parameters", SetParameters, TIMEOUT_S, parameters=given
        )
        for name, result in zip(wanted, response.results, strict=False):
            _check(f"set parameter {name!r} of {node!r}", result.successful, result.reason)

    async def set_parameters(
        self, node: str, values: Mapping[str, Any], types: Mapping[str, str]
    ) -> None:
        """Set parameters of a running node, all or none (rcl_interfaces, SetParametersAtomically).

        Args:
            node: whose they are.
            values: by parameter.
            types: by parameter, "int", "double_array".
        """
        given = _messages(
            Parameter(name, PARAMETER_TYPES[types[name]], values[name]) for name in values
        )
        response = await self._calls.call(
            f"{node}/set_parameters_atomically",
            SetParametersAtomically,
            TIMEOUT_S,
            parameters=given,
        )
        what = f"set {', '.join(map(repr, values))} of {node!r} while it runs"
        _check(what, response.result.successful, response.result.reason)

    def serves_parameters(self, node: str) -> bool | None:
        """Return whether a node has parameter services; None while discovery may not show them yet.

        Client libraries make them before the type description service.
        """
        offered = self._observer.services_of(node)
        if {f"{node}/{each}" for each in _PARAMETER_SERVICES} <= offered:
            return True
        return False if f"{node}/get_type_description" in offered else None

    async def answers(
        self, node: str, *, managed: bool, timeout_s: float, repeat: bool = False
    ) -> bool | None:
        """Return whether a node answers one small request; None where it serves nothing to ask.

        A `managed` one is asked for its state, another for no parameter. Unless `repeat`, a reply
        that is lost is none.
        """
        type_ = GetState if managed else GetParameters
        service = f"{node}/get_{'state' if managed else 'parameters'}"
        if not self._observer.offers(node, service):
            return None
        try:
            await self._calls.call(service, type_, timeout_s, repeat=repeat)
        except ServiceUnansweredError as error:
            return False if error.found else None
        return True

    async def wire(
        self,
        node: str,
        operation: str,
        name: str,
        value: str | Sequence[str] = "",
        *,
        timeout_s: float,
    ) -> None:
        """Call a service of a node's interface that changes how its endpoints are connected.

        Args:
            node: that is wired.
            operation: "connect_to" makes a connection, "map_to" carries an endpoint by one,
                "disconnect" removes one.
            name: of the connection, or of the endpoint, `publishers/video`.
            value: URLs of connect_to, at least one; connection of map_to, "" is the node's own.
            timeout_s: for the answer.
        """
        is_text = isinstance(value, str)
        type_ = PARAMETER_TYPES["string" if is_text else "string_array"]
        given = _messages([Parameter(name, type_, value if is_text else list(value))])
        # Each of them makes the same state again when it arrives twice.
        response = await self._calls.call(
            f"{node}/{operation}", SetParameters, timeout_s, parameters=given
        )
        what = f"{operation} {name!r} of {node!r}"
        if len(response.results) != 1:
            raise MiddlewareError(
                f"cannot {what}: it answered with {len(response.results)} results instead of one"
            )
        _check(what, response.results[0].successful, response.results[0].reason)

    # What nodes publish; callbacks are called in the executor thread. To ask again for the same
    # topic changes nothing.

    def on_transition(self, node: str, callback: Callable[[], None]) -> None:
        """Have `callback` called after each transition of a node, until `forget`."""
        topic = f"{node}/transition_event"
        self._subscribe(TransitionEvent, topic, lambda _: callback(), _EVENT_DEPTH)

    def on_parameters(self, callback: Callable[[str, frozenset[str]], None]) -> None:
        """Have `callback` called with a node and the names of its parameters that changed."""

        def arrived(event: ParameterEvent) -> None:
            changed = (*event.new_parameters, *event.changed_parameters, *event.deleted_parameters)
            callback(event.node, frozenset(each.name for each in changed))

        self._subscribe(ParameterEvent, "/parameter_events", arrived, qos_profile_parameter_events)

    def on_diagnostics(self, callback: Callable[[Sequence[tuple[str, int, str]]], None]) -> None:
        """Have `callback` called with name, level and message of each entry on /diagnostics.

        It is called each second without any, so that it sees which are old.
        """
        if self._diagnostics_timer is not None:
            return
        from diagnostic_msgs.msg import DiagnosticArray  # few systems have use for it

        def arrived(message: Any) -> None:
            # What supervisors say of nodes is made of what nodes say.
            said = (each for each in message.status if not is_of_supervisor(each.hardware_id))
            callback([(each.name, each.level[0], each.message) for each in said])

        self._subscribe(DiagnosticArray, "/diagnostics", arrived, _DIAGNOSTICS)
        node, group = self._observer.node, self._calls.group
        self._diagnostics_timer = node.create_timer(
            1.0, lambda: callback(()), group, clock=Clock(clock_type=ClockType.STEADY_TIME)
        )

    def on_messages(
        self,
        topic: str,
        type_: str,
        qos: QosProfile,
        callback: Callable[[bytes, Mapping[str, int]], None],
    ) -> None:
        """Have `callback` called with each message of a topic, serialized, and its message info."""
        self._subscribe(import_interface(type_), topic, callback, to_rclpy(qos), raw=True)

    def no_messages(self, topic: str) -> None:
        """Have `on_messages` of a topic call back no more."""
        self._unsubscribe(topic, raw=True)

    def forget(self, node: str) -> None:
        """Drop the clients and the subscription of a node that left the graph."""
        self._calls.forget(f"{node}/")
        self._unsubscribe(f"{node}/transition_event")

    def destroy(self) -> None:
        """Stop the executor thread and drop every client; again is harmless."""
        self._calls.destroy()
        if self._diagnostics_timer is not None:
            self._observer.node.destroy_timer(self._diagnostics_timer)
            self._diagnostics_timer = None
        for topic, raw in tuple(self._subscriptions):
            self._unsubscribe(topic, raw=raw)

    def _subscribe(
        self,
        type_: type[Any],
        topic: str,
        callback: Callable[..., None],
        qos: QoSProfile | int,
        *,
        raw: bool = False,
    ) -> None:
        if (topic, raw) not in self._subscriptions:
            self._subscriptions[topic, raw] = self._observer.node.create_subscription(
                type_, topic, callback, qos, callback_group=self._calls.group, raw=raw
            )

    def _unsubscribe(self, topic: str, *, raw: bool = False) -> None:
        if (topic, raw) in self._subscriptions:
            self._observer.node.destroy_subscription(self._subscriptions.pop((topic, raw)))


async def _reply(
    reply: Coroutine[Any, Any, _Reply], look: Callable[[], Awaitable[_Reply | None]]
) -> _Reply:
    """Wait for a reply that the server may have dropped; what `look` finds counts as one."""
    pending = asyncio.ensure_future(reply)
    try:
        while not pending.done():
            await asyncio.wait((pending,), timeout=_REREAD_S)
            if not pending.done() and (found := await look()) is not None:
                # A reply that is under way arrives before one would look again.
                await asyncio.wait((pending,), timeout=_REREAD_S)
                return pending.result() if pending.done() else found
        return pending.result()
    except ServiceUnansweredError as error:
        found = await look() if error.found else None
        if found is None:
            raise
        return found
    finally:
        pending.cancel()


def _check(what: str, accepted: bool, reason: str) -> None:
    if not accepted:
        raise MiddlewareError(f"cannot {what}: it says {reason!r}")


def _messages(parameters: Iterable[Parameter]) -> list[Any]:
    return [each.to_parameter_msg() for each in parameters]


def _given_values(planned: PlannedNode, has: Mapping[str, str] | None = None) -> dict[str, Any]:
    """Return what a plan gives a node's parameters, by name, but by its command line.

    Empty arrays are among them, too: rcl reads none from a command line. One whose type is declared
    nowhere is given by the type that the node `has` for it, and not at all where that is unknown.
    """
    given = {}
    for each in planned.expected_parameters:
        word = (has or {}).get(each.name, "") if each.type == "array" else each.type
        is_known = word in PARAMETER_TYPES and (each.type != "array" or word.endswith("_array"))
        is_given = each.value is not None and each.source != DEFAULT
        if is_known and is_given and (each.source != COMMAND or each.value == ()):
            given[each.name] = Parameter(
                each.name, PARAMETER_TYPES[word], parameter_to_rclpy(each.raw, word)
            )
    return given


def _differs(has: ParameterReport, given: Parameter) -> bool:
    """Whether a node has another value than it is given; what is not a number equals itself."""
    type_, value = type_word(given.type_.value), parameter_value(given.value)
    return has != ParameterReport.of(has.name, type_, value, read_only=has.read_only)
