"""Make and destroy the rclpy entity of a declared endpoint on a connection.

Owns: which factory makes which kind, with which QoS, callback group and gate. It keeps nothing:
what exists where is mapper.py's.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from rclpy.exceptions import InvalidHandle
from rclpy.node import Node
from rclpy.qos import qos_profile_system_default

from lifecycle.errors import LifecycleError
from lifecycle.manifest.model import EndpointKind
from lifecycle.manifest.qos import QosProfile
from lifecycle.middleware.fastdds.nfe import create_publisher, create_subscription
from lifecycle.middleware.rcl.qos import to_rclpy
from lifecycle.node.actions import Goals, resolve_action_name
from lifecycle.node.endpoints.mapping import Mapping, wire_name
from lifecycle.node.lifecycle.steps import positional_count
from lifecycle.plan.model import PlannedEndpoint

if TYPE_CHECKING:
    from lifecycle.node.connections.connections import Connection
    from lifecycle.node.lifecycle.gate import NodeGate
    from lifecycle.node.lifecycle.services import Turns

CLIENTS = frozenset({EndpointKind.SERVICE_CLIENT, EndpointKind.ACTION_CLIENT})


class Maker:
    """Makes and destroys the entities of one node.

    Args:
        node: whose endpoints they are, and whose executor runs their callbacks.
        gate: holds subscriptions back; publishers are held back by their handles.
        turns: of the node's executor.
    """

    def __init__(self, node: Node, gate: NodeGate, turns: Turns) -> None:
        self._node = node
        self._gate = gate
        self._turns = turns
        self._goals: dict[int, Goals] = {}  # by id of the action server

    def make(self, mapping: Mapping, connection: Connection) -> Any:
        """Return a new rclpy entity of an endpoint on a connection.

        Raises:
            LifecycleError: the RMW refused, with its reason; nothing is left.
        """
        endpoint, introspection = mapping.endpoint, mapping.options.introspection
        makes: dict[EndpointKind, Callable[[Mapping, Connection], Any]] = {
            EndpointKind.PUBLISHER: self._publisher,
            EndpointKind.SUBSCRIPTION: self._subscription,
            EndpointKind.SERVICE_SERVER: self._service,
            EndpointKind.SERVICE_CLIENT: self._client,
            EndpointKind.ACTION_SERVER: self._action_server,
            EndpointKind.ACTION_CLIENT: self._action_client,
        }
        entity = makes[endpoint.kind](mapping, connection)
        if connection.participant is not None:
            # The hidden node is not spun: its events are handled where the node's own are.
            for event in getattr(entity, "event_handlers", ()):
                self._node.add_waitable(event)
        if introspection is not None:
            entity.configure_introspection(
                self._node.get_clock(), qos_profile_system_default, introspection
            )
        made = wire_name(entity)
        if mapping.name and made and made != mapping.name:
            self.unmake(endpoint, entity, connection)
            raise LifecycleError(
                f"cannot call {endpoint.kind.noun} {endpoint.name!r} {mapping.name!r}: a remapping "
                f"rule that the node was started with makes it {made!r}",
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
        elif endpoint.kind.is_action:
            entity.destroy()
        elif endpoint.kind is EndpointKind.PUBLISHER:
            self._node.destroy_publisher(entity)
        elif endpoint.kind is EndpointKind.SUBSCRIPTION:
            self._node.destroy_subscription(entity)
        elif endpoint.kind is EndpointKind.SERVICE_SERVER:
            self._node.destroy_service(entity)
        else:
            self._node.destroy_client(entity)

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

    def _publisher(self, mapping: Mapping, connection: Connection) -> Any:
        endpoint = mapping.endpoint
        name, qos = self._name(mapping, connection), endpoint.qos or QosProfile()
        options = {
            "callback_group": mapping.options.callback_group,
            "event_callbacks": mapping.options.event_callbacks,
        }
        if connection.participant is not None:
            return connection.participant.create_publisher(mapping.interface, name, qos, **options)
        entity = create_publisher(
            self._node, mapping.interface, name, qos, unique=endpoint.unique, **options
        )
        self._gate.release(entity)  # the handle is the gate
        return entity

    def _subscription(self, mapping: Mapping, connection: Connection) -> Any:
        endpoint, options = mapping.endpoint, mapping.options
        make: Callable[..., Any] = functools.partial(create_subscription, self._node)
        if connection.participant is not None:
            make = connection.participant.create_subscription
        entity = make(
            mapping.interface,
            self._name(mapping, connection),
            mapping.handler,
            endpoint.qos or QosProfile(),
            unique=endpoint.unique,
            callback_group=options.callback_group,
            event_callbacks=options.event_callbacks,
            raw=options.raw,
        )
        self._gate.add_subscription(entity, self._turns.call_soon)
        return entity

    def _service(self, mapping: Mapping, connection: Connection) -> Any:
        assert mapping.handler is not None
        handler = _answering(mapping.handler)
        group = mapping.options.callback_group or self._node.default_callback_group
        name, qos = self._name(mapping, connection), _qos(mapping)

        def make(node: Node) -> Any:
            return node.create_service(
                mapping.interface, name, handler, callback_group=group, **qos
            )

        entity = self._made(mapping, connection, name, make)
        self._survive_late_answers(entity, mapping.endpoint)
        return entity

    def _client(self, mapping: Mapping, connection: Connection) -> Any:
        from lifecycle.node.author.node import refuse_to_deadlock

        group = mapping.options.callback_group or self._turns.group
        name, qos = self._name(mapping, connection), _qos(mapping)

        def make(node: Node) -> Any:
            return node.create_client(mapping.interface, name, callback_group=group, **qos)

        client = self._made(mapping, connection, name, make)
        if connection.participant is not None:  # the node's own factory has done it
            refuse_to_deadlock(client)
        return client

    def _made(
        self, mapping: Mapping, connection: Connection, name: str, make: Callable[[Node], Any]
    ) -> Any:
        """Have an end of a service or action made where it belongs."""
        if connection.participant is None:
            return make(self._node)
        return connection.participant.create(make, mapping.endpoint.kind.noun, name)

    def _action_server(self, mapping: Mapping, connection: Connection) -> Any:
        from lifecycle.middleware.services.actions import GoalServer  # late: numpy, 100 ms

        assert mapping.handler is not None
        goals = Goals(
            self._node,
            mapping.endpoint.name,
            mapping.interface,
            mapping.handler,
            is_open=lambda: self._gate.is_open,
        )

        def make(node: Node, name: str) -> Any:
            return GoalServer(
                node,
                mapping.interface,
                name,
                goals.execute,
                accept=goals.accept,
                group=mapping.options.callback_group or self._node.default_callback_group,
            )

        server = goals.server = self._action(mapping, connection, make)
        self._goals[id(server)] = goals
        self._gate.add_worker(server, goals)
        return server

    def _action_client(self, mapping: Mapping, connection: Connection) -> Any:
        from lifecycle.middleware.services.actions import GoalClient
        from lifecycle.node.author.node import refuse_to_block

        def make(node: Node, name: str) -> Any:
            return GoalClient(
                node,
                mapping.interface,
                name,
                group=mapping.options.callback_group or self._turns.group,
                refuse_to_block=refuse_to_block,
            )

        return self._action(mapping, connection, make)

    def _action(
        self, mapping: Mapping, connection: Connection, make: Callable[[Node, str], Any]
    ) -> Any:
        """Make an action server or client where it belongs, and have it know its name."""
        name = self._name(mapping, connection)
        # rcl applies rules to the hidden names itself; torn apart, the action is not made.
        resolved = name if connection.participant else resolve_action_name(self._node, name)
        action = self._made(mapping, connection, name, lambda node: make(node, name))
        action.action_name = resolved
        return action

    def _name(self, mapping: Mapping, connection: Connection) -> str:
        """Return what an endpoint is called where it is made.

        The hidden nodes of other participants resolve nothing: remaps belong to our node.
        """
        endpoint = mapping.endpoint
        if mapping.name or connection.participant is None:
            return mapping.name or endpoint.name
        if endpoint.kind.is_topic:
            return str(self._node.resolve_topic_name(endpoint.name))
        if endpoint.kind.is_action:
            return resolve_action_name(self._node, endpoint.name)
        return str(self._node.resolve_service_name(endpoint.name))

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


def _qos(mapping: Mapping) -> dict[str, Any]:
    """Return the keyword for a declared QoS; nothing keeps the default for services."""
    if mapping.endpoint.qos is None:
        return {}
    return {"qos_profile": to_rclpy(mapping.endpoint.qos)}


def _answering(handler: Callable[..., Any]) -> Callable[[Any, Any], Any]:
    """Let a service handler return None once it has filled in the response."""

    async def answer(request: Any, response: Any) -> Any:
        returned = handler(*(request, response)[: positional_count(handler, 2)])
        if hasattr(returned, "__await__"):
            returned = await returned
        return response if returned is None else returned

    return answer
