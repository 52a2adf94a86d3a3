"""Make and destroy the rclpy entity of a declared endpoint on a connection.

Owns: which factory makes which kind, with which QoS, callback group and gate. It keeps nothing:
what exists where is data_layer.py's.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from rclpy.exceptions import InvalidHandle
from rclpy.node import Node
from rclpy.qos import qos_profile_system_default

from lifecycle import dataclasses
from lifecycle.errors import LifecycleError
from lifecycle.manifest import EndpointKind, QosProfile
from lifecycle.middleware import create_publisher, create_subscription, to_rclpy
from lifecycle.node.actions import ActionWords, Goals, resolve_action_name
from lifecycle.node.lifecycle.execution import positional_count
from lifecycle.plan import PlannedEndpoint

if TYPE_CHECKING:
    from rclpy.callback_groups import CallbackGroup
    from rclpy.service_introspection import ServiceIntrospectionState

    from lifecycle.node.connections.connections import Connection
    from lifecycle.node.lifecycle.gate import Later, NodeGate

CLIENTS = frozenset({EndpointKind.SERVICE_CLIENT, EndpointKind.ACTION_CLIENT})
_ACTIONS = frozenset({EndpointKind.ACTION_SERVER, EndpointKind.ACTION_CLIENT})


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class EndpointOptions:
    """What only code can say of how an endpoint is made; as in rclpy's factories.

    Attributes:
        callback_group: of its callback and its events; None for the node's own choice.
        event_callbacks: rclpy's PublisherEventCallbacks or SubscriptionEventCallbacks.
        raw: a subscription's handler is given serialized bytes.
        content_filter: expression of a subscription, and the values of its parameters.
        introspection: of a service server or client (REP-2012).
    """

    callback_group: CallbackGroup | None = None
    event_callbacks: Any = None
    raw: bool = False
    content_filter: tuple[str, tuple[str, ...]] | None = None
    introspection: ServiceIntrospectionState | None = None

    def refuse_unfit(self, kind: EndpointKind) -> None:
        """Raise LifecycleError for what endpoints of a kind cannot have."""
        given = {
            "raw": self.raw,
            "content_filter": self.content_filter is not None,
            "event_callbacks": self.event_callbacks is not None,
            "introspection": self.introspection is not None,
        }
        for name, is_given in given.items():
            if is_given and kind not in _FITTING[name]:
                fitting = ", ".join(f"{each.noun}s" for each in _FITTING[name])
                raise LifecycleError(f"cannot set {name} of a {kind.noun}; only of {fitting}")


_FITTING = {
    "raw": (EndpointKind.SUBSCRIPTION,),
    "content_filter": (EndpointKind.SUBSCRIPTION,),
    "event_callbacks": (EndpointKind.PUBLISHER, EndpointKind.SUBSCRIPTION),
    "introspection": (EndpointKind.SERVICE_SERVER, EndpointKind.SERVICE_CLIENT),
}
NO_OPTIONS = EndpointOptions()


class Maker:
    """Makes and destroys the entities of one node.

    Args:
        node: whose endpoints they are, and whose executor runs their callbacks.
        gate: holds subscriptions back; publishers are held back by their handles.
        client_group: reentrant, so that an answer can arrive while a callback awaits it.
        later: runs a coroutine function in the node's executor.
    """

    def __init__(
        self,
        node: Node,
        *,
        gate: NodeGate,
        client_group: CallbackGroup,
        later: Later,
    ) -> None:
        self._node = node
        self._gate = gate
        self._client_group = client_group
        self._later = later
        self._goals: dict[int, Goals] = {}  # by id of the action server

    def make(
        self,
        endpoint: PlannedEndpoint,
        interface: type[Any],
        connection: Connection,
        *,
        handler: Callable[..., Any] | None,
        name: str = "",
        options: EndpointOptions = NO_OPTIONS,
    ) -> Any:
        """Return a new rclpy entity for `endpoint` on `connection`.

        Args:
            endpoint: as declared.
            interface: its message, service or action class.
            connection: that carries it.
            handler: takes messages, requests or goals; None where the kind has no handler.
            name: fully qualified name instead of the declared one.
            options: what code says of it.

        Raises:
            LifecycleError: the RMW refused, with its reason; nothing is left.
        """
        makes: dict[EndpointKind, Callable[..., Any]] = {
            EndpointKind.PUBLISHER: self._publisher,
            EndpointKind.SUBSCRIPTION: self._subscription,
            EndpointKind.SERVICE_SERVER: self._service,
            EndpointKind.SERVICE_CLIENT: self._client,
            EndpointKind.ACTION_SERVER: self._action_server,
            EndpointKind.ACTION_CLIENT: self._action_client,
        }
        make = makes[endpoint.kind]
        entity = make(endpoint, interface, connection, handler, name=name, options=options)
        if connection.participant is not None:
            # The hidden node is not spun: its events are handled where the node's own are.
            for event in getattr(entity, "event_handlers", ()):
                self._node.add_waitable(event)
        if options.introspection is not None:
            entity.configure_introspection(
                self._node.get_clock(), qos_profile_system_default, options.introspection
            )
        made = wire_name(entity)
        if name and made and made != name:
            self.unmake(endpoint, entity, connection)
            raise LifecycleError(
                f"cannot call {endpoint.kind.noun} {endpoint.name!r} {name!r}: a remapping rule "
                f"that the node was started with makes it {made!r}",
                hint="take the rule out of the manifest's `remap:`, or choose another name",
            )
        return entity

    def unmake(self, endpoint: PlannedEndpoint, entity: Any, connection: Connection) -> None:
        """Destroy an entity that `make` returned for `endpoint` on `connection`."""
        participant = connection.participant
        goals = self._goals.pop(id(entity), None)
        if goals is not None:
            goals.interrupt("it was taken off where it was mapped")
            self._gate.remove(entity)
        if participant is not None:
            self._gate.remove(entity)
            for event in getattr(entity, "event_handlers", ()):
                self._node.remove_waitable(event)
            participant.destroy_endpoint(entity)
        elif endpoint.kind in _ACTIONS:
            entity.destroy()
        elif endpoint.kind is EndpointKind.PUBLISHER:
            self._node.destroy_publisher(entity)
        elif endpoint.kind is EndpointKind.SUBSCRIPTION:
            self._node.destroy_subscription(entity)
        elif endpoint.kind is EndpointKind.SERVICE_SERVER:
            self._node.destroy_service(entity)
        else:
            self._node.destroy_client(entity)

    def resolve(self, endpoint: PlannedEndpoint) -> str:
        """Return the fully qualified name of an endpoint after namespace and remapping rules.

        The hidden nodes of other participants resolve nothing: remaps belong to our node.

        Raises:
            LifecycleError: rules tear an action apart.
        """
        if endpoint.kind.is_topic:
            return str(self._node.resolve_topic_name(endpoint.name))
        if endpoint.kind in _ACTIONS:
            return resolve_action_name(self._node, endpoint.name)
        return str(self._node.resolve_service_name(endpoint.name))

    def expand(self, endpoint: PlannedEndpoint, name: str) -> str:
        """Return a new name for an endpoint fully qualified; no remapping rule applies.

        Raises:
            LifecycleError: it cannot be a name.
        """
        resolve = self._node.resolve_service_name
        if endpoint.kind.is_topic:
            resolve = self._node.resolve_topic_name
        try:
            return str(resolve(name, only_expand=True))
        except Exception as error:
            reason = str(error).splitlines()[0].partition(", at /")[0]  # rcl's source file
            raise LifecycleError(
                f"cannot call {endpoint.kind.noun} {endpoint.name!r} {name!r}: {reason}"
            ) from error

    def _publisher(
        self,
        endpoint: PlannedEndpoint,
        interface: type[Any],
        connection: Connection,
        handler: Callable[..., Any] | None,  # noqa: ARG002 - it has none
        *,
        name: str,
        options: EndpointOptions,
    ) -> Any:
        qos = endpoint.qos or QosProfile()
        if connection.participant is not None:
            topic = name or self.resolve(endpoint)
            return connection.participant.create_publisher(
                interface,
                topic,
                qos,
                callback_group=options.callback_group,
                event_callbacks=options.event_callbacks,
            )
        entity = create_publisher(
            self._node,
            interface,
            name or endpoint.name,
            qos,
            unique=endpoint.unique,
            callback_group=options.callback_group,
            event_callbacks=options.event_callbacks,
        )
        self._gate.release(entity)  # the handle is the gate
        return entity

    def _subscription(
        self,
        endpoint: PlannedEndpoint,
        interface: type[Any],
        connection: Connection,
        handler: Callable[..., Any] | None,
        *,
        name: str,
        options: EndpointOptions,
    ) -> Any:
        assert handler is not None
        qos = endpoint.qos or QosProfile()
        further: dict[str, Any] = {
            "unique": endpoint.unique,
            "callback_group": options.callback_group,
            "event_callbacks": options.event_callbacks,
            "raw": options.raw,
            "content_filter": options.content_filter,
        }
        if connection.participant is not None:
            entity = connection.participant.create_subscription(
                interface, name or self.resolve(endpoint), handler, qos, **further
            )
        else:
            entity = create_subscription(
                self._node,
                interface,
                name or endpoint.name,
                handler,
                qos,
                **further,
            )
        self._gate.add_subscription(entity, self._later)
        return entity

    def _service(
        self,
        endpoint: PlannedEndpoint,
        interface: type[Any],
        connection: Connection,
        handler: Callable[..., Any] | None,
        *,
        name: str,
        options: EndpointOptions,
    ) -> Any:
        assert handler is not None
        if connection.participant is not None:
            entity = connection.participant.create_service(
                interface,
                name or self.resolve(endpoint),
                _answering(handler),
                callback_group=options.callback_group,
                **_qos(endpoint),
            )
        else:
            entity = self._node.create_service(
                interface,
                name or endpoint.name,
                _answering(handler),
                callback_group=options.callback_group,
                **_qos_profile(endpoint),
            )
        self._survive_late_answers(entity, endpoint)
        return entity

    def _client(
        self,
        endpoint: PlannedEndpoint,
        interface: type[Any],
        connection: Connection,
        handler: Callable[..., Any] | None,  # noqa: ARG002 - it has none
        *,
        name: str,
        options: EndpointOptions,
    ) -> Any:
        group = options.callback_group or self._client_group
        if connection.participant is None:
            return self._node.create_client(
                interface, name or endpoint.name, callback_group=group, **_qos_profile(endpoint)
            )
        from lifecycle.node.author.node import refuse_to_deadlock

        client = connection.participant.create_client(
            interface,
            name or self.resolve(endpoint),
            callback_group=group,
            **_qos(endpoint),
        )
        refuse_to_deadlock(client)
        return client

    def _action_server(
        self,
        endpoint: PlannedEndpoint,
        interface: type[Any],
        connection: Connection,
        handler: Callable[..., Any] | None,
        *,
        name: str,
        options: EndpointOptions,
    ) -> Any:
        from lifecycle.middleware import GoalServer  # late: numpy, 100 ms

        assert handler is not None
        logger = self._node.get_logger()
        words = ActionWords(
            action=endpoint.name,
            node=self._node.get_fully_qualified_name(),
            error=logger.error,
            warn=logger.warning,
        )
        goals = Goals(handler, interface, words, is_open=lambda: self._gate.is_open)

        server = goals.server = self._action(
            endpoint,
            connection,
            name,
            lambda node, called: GoalServer(
                node,
                interface,
                called,
                goals.execute,
                accept=goals.accept,
                group=options.callback_group or self._node.default_callback_group,
            ),
        )
        self._goals[id(server)] = goals
        self._gate.add_worker(server, goals)
        return server

    def _action_client(
        self,
        endpoint: PlannedEndpoint,
        interface: type[Any],
        connection: Connection,
        handler: Callable[..., Any] | None,  # noqa: ARG002 - it has none
        *,
        name: str,
        options: EndpointOptions,
    ) -> Any:
        from lifecycle.middleware import GoalClient
        from lifecycle.node.author.node import refuse_to_block

        return self._action(
            endpoint,
            connection,
            name,
            lambda node, called: GoalClient(
                node,
                interface,
                called,
                group=options.callback_group or self._client_group,
                refuse_to_block=refuse_to_block,
            ),
        )

    def _action(
        self,
        endpoint: PlannedEndpoint,
        connection: Connection,
        name: str,
        make: Callable[[Node, str], Any],
    ) -> Any:
        """Make an action server or client where it belongs, and have it know its name."""
        participant = connection.participant
        if participant is None:
            # rcl applies rules to the hidden names itself; torn apart, the action is not made.
            resolved = resolve_action_name(self._node, name or endpoint.name)
            action = make(self._node, name or endpoint.name)
        else:
            resolved = name or self.resolve(endpoint)
            noun = endpoint.kind.noun
            action = participant.create_action(lambda node: make(node, resolved), noun, resolved)
        action.action_name = resolved
        return action

    def _survive_late_answers(self, service: Any, endpoint: PlannedEndpoint) -> None:
        """Let an answer after its server was destroyed be lost, not end the process."""
        send = service.send_response
        warn = self._node.get_logger().warning

        @functools.wraps(send)
        def send_response(response: Any, header: Any) -> None:
            try:
                send(response, header)
            except InvalidHandle:
                warn(
                    f"cannot send the answer of service server {endpoint.name!r}: it was "
                    "disconnected while its handler worked on it"
                )

        service.send_response = send_response


def wire_name(entity: Any) -> str:
    """Return an entity's name on the wire, as rcl resolved it; empty if it is unknown."""
    for attribute in ("topic_name", "service_name", "action_name"):
        name = getattr(entity, attribute, None)
        if name is not None:
            return str(name)
    return ""


def _qos(endpoint: PlannedEndpoint) -> dict[str, Any]:
    """Return the keyword for a declared QoS; nothing keeps the default for services."""
    return {} if endpoint.qos is None else {"qos": endpoint.qos}


def _qos_profile(endpoint: PlannedEndpoint) -> dict[str, Any]:
    """Return `_qos` as rclpy wants it."""
    return {} if endpoint.qos is None else {"qos_profile": to_rclpy(endpoint.qos)}


def _answering(handler: Callable[..., Any]) -> Callable[[Any, Any], Any]:
    """Let a service handler return None once it has filled in the response."""

    async def answer(request: Any, response: Any) -> Any:
        returned = handler(*(request, response)[: positional_count(handler, 2)])
        if hasattr(returned, "__await__"):
            returned = await returned
        return response if returned is None else returned

    return answer
