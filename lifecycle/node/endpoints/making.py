"""Make and destroy the rclpy entity of a declared endpoint on a connection.

Owns: which factory makes which kind, with which QoS, callback group and gate. It keeps nothing but
the goals of action servers: what exists where is data_layer.py's.
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
from lifecycle.node.author.blocking import refuse_to_block, refuse_to_deadlock
from lifecycle.node.endpoints.endpoint import CLIENTS, Endpoint, wire_name
from lifecycle.node.lifecycle.steps import positional_count
from lifecycle.plan.model import PlannedEndpoint

if TYPE_CHECKING:
    from lifecycle.node.connections.connections import Connection
    from lifecycle.node.lifecycle.gate import NodeGate
    from lifecycle.node.lifecycle.services import Turns


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

    def make(self, endpoint: Endpoint, connection: Connection) -> Any:
        """Return a new rclpy entity of an endpoint on a connection.

        Raises:
            LifecycleError: the RMW refused, with its reason; nothing is left.
        """
        makes: dict[EndpointKind, Callable[[Endpoint, Connection, str], Any]] = {
            EndpointKind.PUBLISHER: self._publisher,
            EndpointKind.SUBSCRIPTION: self._subscription,
            EndpointKind.SERVICE_SERVER: self._service,
            EndpointKind.SERVICE_CLIENT: self._client,
            EndpointKind.ACTION_SERVER: self._action_server,
            EndpointKind.ACTION_CLIENT: self._action_client,
        }
        kind, introspection = endpoint.kind, endpoint.options.introspection
        entity = makes[kind](endpoint, connection, self._name(endpoint, connection))
        if connection.participant is not None:
            # The hidden node is not spun: its events are handled where the node's own are.
            for event in getattr(entity, "event_handlers", ()):
                self._node.add_waitable(event)
        if introspection is not None:
            entity.configure_introspection(
                self._node.get_clock(), qos_profile_system_default, introspection
            )
        made = wire_name(entity)
        if endpoint.given_name and made and made != endpoint.given_name:
            self.unmake(endpoint.planned, entity, connection)
            raise LifecycleError(
                f"cannot call {kind.noun} {endpoint.name!r} {endpoint.given_name!r}: a remapping "
                f"rule that the node was started with makes it {made!r}",
                hint="take the rule out of the manifest's `remap:`, or choose another name",
            )
        return entity

    def unmake(self, planned: PlannedEndpoint, entity: Any, connection: Connection) -> None:
        """Destroy an entity that `make` returned for an endpoint on a connection."""
        goals = self._goals.pop(id(entity), None)
        if goals is not None:
            goals.interrupt("it was taken off where it was mapped")
            self._gate.remove(entity)
        if connection.participant is not None:
            self._gate.remove(entity)
            for event in getattr(entity, "event_handlers", ()):
                self._node.remove_waitable(event)
            connection.participant.destroy_endpoint(entity)
            return
        destroys: dict[EndpointKind, Callable[[Any], object]] = {
            EndpointKind.PUBLISHER: self._node.destroy_publisher,
            EndpointKind.SUBSCRIPTION: self._node.destroy_subscription,
            EndpointKind.SERVICE_SERVER: self._node.destroy_service,
            EndpointKind.SERVICE_CLIENT: self._node.destroy_client,
        }
        if planned.kind.is_action:
            entity.destroy()
        else:
            destroys[planned.kind](entity)

    def expand(self, planned: PlannedEndpoint, name: str) -> str:
        """Return a new name for an endpoint fully qualified; no remapping rule applies.

        Raises:
            LifecycleError: it cannot be a name.
        """
        resolve = self._node.resolve_service_name
        if planned.kind.is_topic:
            resolve = self._node.resolve_topic_name
        try:
            return str(resolve(name, only_expand=True))
        except Exception as error:
            reason = str(error).splitlines()[0].partition(", at /")[0]  # rcl's source file
            raise LifecycleError(
                f"cannot call {planned.kind.noun} {planned.name!r} {name!r}: {reason}"
            ) from error

    def _publisher(self, endpoint: Endpoint, connection: Connection, name: str) -> Any:
        qos = endpoint.planned.qos or QosProfile()
        options = {
            "callback_group": endpoint.options.callback_group,
            "event_callbacks": endpoint.options.event_callbacks,
        }
        if connection.participant is not None:
            return connection.participant.create_publisher(endpoint.interface, name, qos, **options)
        entity = create_publisher(
            self._node, endpoint.interface, name, qos, unique=endpoint.planned.unique, **options
        )
        self._gate.release(entity)  # the handle is the gate
        return entity

    def _subscription(self, endpoint: Endpoint, connection: Connection, name: str) -> Any:
        options = endpoint.options
        make: Callable[..., Any] = functools.partial(create_subscription, self._node)
        if connection.participant is not None:
            make = connection.participant.create_subscription
        entity = make(
            endpoint.interface,
            name,
            endpoint.handler,
            endpoint.planned.qos or QosProfile(),
            unique=endpoint.planned.unique,
            callback_group=options.callback_group,
            event_callbacks=options.event_callbacks,
            raw=options.raw,
            content_filter=options.content_filter,
        )
        self._gate.add_subscription(entity, self._turns.call_soon)
        return entity

    def _service(self, endpoint: Endpoint, connection: Connection, name: str) -> Any:
        assert endpoint.handler is not None
        options = {**self._group(endpoint), **_qos(endpoint)}
        handler = _answering(endpoint.handler)
        service = self._made(
            endpoint,
            connection,
            lambda node: node.create_service(endpoint.interface, name, handler, **options),
        )
        self._survive_late_answers(service, endpoint.name)
        return service

    def _client(self, endpoint: Endpoint, connection: Connection, name: str) -> Any:
        options = {**self._group(endpoint), **_qos(endpoint)}
        client = self._made(
            endpoint,
            connection,
            lambda node: node.create_client(endpoint.interface, name, **options),
        )
        if connection.participant is not None:  # the node's own factory has done it
            refuse_to_deadlock(client)
        return client

    def _action_server(self, endpoint: Endpoint, connection: Connection, name: str) -> Any:
        from lifecycle.middleware.services.actions import GoalServer  # late: numpy, 100 ms

        assert endpoint.handler is not None
        goals = Goals(
            self._node,
            endpoint.name,
            endpoint.interface,
            endpoint.handler,
            is_open=lambda: self._gate.is_open,
        )
        group = self._group(endpoint)["callback_group"]

        def make(node: Node) -> Any:
            return GoalServer(
                node, endpoint.interface, name, goals.execute, accept=goals.accept, group=group
            )

        server = goals.server = self._action(endpoint, connection, name, make)
        self._goals[id(server)] = goals
        self._gate.add_worker(server, goals)
        return server

    def _action_client(self, endpoint: Endpoint, connection: Connection, name: str) -> Any:
        from lifecycle.middleware.services.actions import GoalClient

        group = self._group(endpoint)["callback_group"]

        def make(node: Node) -> Any:
            return GoalClient(
                node, endpoint.interface, name, group=group, refuse_to_block=refuse_to_block
            )

        return self._action(endpoint, connection, name, make)

    def _action(
        self, endpoint: Endpoint, connection: Connection, name: str, make: Callable[[Node], Any]
    ) -> Any:
        """Make an action server or client where it belongs, and have it know its name."""
        # rcl applies rules to the hidden names itself; torn apart, the action is not made.
        resolved = name if connection.participant else resolve_action_name(self._node, name)
        action = self._made(endpoint, connection, make)
        action.action_name = resolved
        return action

    def _made(self, endpoint: Endpoint, connection: Connection, make: Callable[[Node], Any]) -> Any:
        """Have an end of a service or action made where it belongs."""
        if connection.participant is None:
            return make(self._node)
        name = self._name(endpoint, connection)
        return connection.participant.create(make, endpoint.kind.noun, name)

    def _group(self, endpoint: Endpoint) -> dict[str, Any]:
        """Return the keyword for a callback group: clients' answers arrive while callbacks run."""
        own = self._turns.group
        if endpoint.kind not in CLIENTS:
            own = self._node.default_callback_group
        return {"callback_group": endpoint.options.callback_group or own}

    def _name(self, endpoint: Endpoint, connection: Connection) -> str:
        """Return what an endpoint is called where it is made.

        The hidden nodes of other participants resolve nothing: remaps belong to our node.
        """
        if endpoint.given_name or connection.participant is None:
            return endpoint.given_name or endpoint.name
        if endpoint.kind.is_topic:
            return str(self._node.resolve_topic_name(endpoint.name))
        if endpoint.kind.is_action:
            return resolve_action_name(self._node, endpoint.name)
        return str(self._node.resolve_service_name(endpoint.name))

    def _survive_late_answers(self, service: Any, name: str) -> None:
        """Let an answer after its server was destroyed be lost, not end the process."""
        send = service.send_response
        warn = self._node.get_logger().warning

        @functools.wraps(send)
        def send_response(response: Any, header: Any) -> None:
            try:
                send(response, header)
            except InvalidHandle:
                warn(
                    f"cannot send the answer of service server {name!r}: it was "
                    "disconnected while its handler worked on it"
                )

        service.send_response = send_response


def _qos(endpoint: Endpoint) -> dict[str, Any]:
    """Return the keyword for a declared QoS; nothing keeps the default for services."""
    if endpoint.planned.qos is None:
        return {}
    return {"qos_profile": to_rclpy(endpoint.planned.qos)}


def _answering(handler: Callable[..., Any]) -> Callable[[Any, Any], Any]:
    """Let a service handler return None once it has filled in the response."""

    async def answer(request: Any, response: Any) -> Any:
        returned = handler(*(request, response)[: positional_count(handler, 2)])
        if hasattr(returned, "__await__"):
            returned = await returned
        return response if returned is None else returned

    return answer
