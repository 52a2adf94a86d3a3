"""Make and destroy the rclpy entity of a declared endpoint on a connection.

The factories of our own node are for what its author's code makes. What exists where is
data_layer.py's. Blocking calls of what is made here raise where they would wait for ever.
"""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from rclpy.client import Client
from rclpy.exceptions import InvalidHandle
from rclpy.node import Node
from rclpy.qos import qos_profile_system_default

from lifecycle.errors import LifecycleError
from lifecycle.manifest.model import EndpointKind
from lifecycle.manifest.qos import QosProfile
from lifecycle.middleware.fastdds.nfe import create_subscription
from lifecycle.middleware.rcl.conversions import to_rclpy
from lifecycle.node.actions import Goals, resolve_action_name
from lifecycle.node.callbacks import called
from lifecycle.node.endpoint import CLIENTS, Endpoint, wire_name
from lifecycle.node.gate import GatedSubscription

if TYPE_CHECKING:
    from lifecycle.node.connections import Connection
    from lifecycle.node.managed import Managed
    from lifecycle.plan.model import PlannedEndpoint


_DESTROY = {
    EndpointKind.PUBLISHER: "destroy_publisher",
    EndpointKind.SUBSCRIPTION: "destroy_subscription",
    EndpointKind.SERVICE_SERVER: "destroy_service",
    EndpointKind.SERVICE_CLIENT: "destroy_client",
}


def make_entity(managed: Managed, endpoint: Endpoint, connection: Connection) -> Any:
    """Return a new rclpy entity of an endpoint; raises LifecycleError, and nothing is left."""
    kind, introspection = endpoint.kind, endpoint.options.get("introspection")
    create = _topic_end if kind.is_topic else _served
    entity = create(managed, endpoint, connection, _name(managed, endpoint, connection))
    if introspection is not None:
        entity.configure_introspection(
            managed.node.get_clock(), qos_profile_system_default, introspection
        )
    made = wire_name(entity)
    if endpoint.given_name and made and made != endpoint.given_name:
        unmake(managed, kind, entity, connection)
        raise LifecycleError(
            f"cannot call {kind.noun} {endpoint.name!r} {endpoint.given_name!r}: a remapping "
            f"rule that the node was started with makes it {made!r}",
            hint="take the rule out of the manifest's `remap:`, or choose another name",
        )
    return entity


def unmake(managed: Managed, kind: EndpointKind, entity: Any, connection: Connection) -> None:
    """Destroy an entity that `make_entity` returned for an endpoint on a connection."""
    managed.gate.remove(entity)
    if connection.participant is not None:
        connection.participant.destroy_endpoint(entity)
    elif kind.is_action:
        entity.destroy()
    else:
        getattr(managed.node, _DESTROY[kind])(entity)


def expand(managed: Managed, endpoint: Endpoint, name: str) -> str:
    """Return a new name for an endpoint fully qualified; no remapping rule applies."""
    resolve = managed.node.resolve_service_name
    if endpoint.kind.is_topic:
        resolve = managed.node.resolve_topic_name
    try:
        return str(resolve(name, only_expand=True))
    except Exception as error:
        reason = str(error).splitlines()[0].partition(", at /")[0]  # rcl's source file
        raise LifecycleError(
            f"cannot call {endpoint.kind.noun} {endpoint.name!r} {name!r}: {reason}"
        ) from error


def _topic_end(managed: Managed, endpoint: Endpoint, connection: Connection, name: str) -> Any:
    qos, options = to_rclpy(endpoint.planned.qos or QosProfile()), endpoint.options
    create = factory(endpoint.planned, connection, managed.node)
    if endpoint.kind is EndpointKind.PUBLISHER:
        return create(endpoint.interface, name, qos, **options)
    entity = create(endpoint.interface, name, endpoint.handler, qos, **options)
    managed.gate.add(entity, GatedSubscription(entity, managed.gate, managed.turns.call_soon))
    return entity


def _served(managed: Managed, endpoint: Endpoint, connection: Connection, name: str) -> Any:
    """Make an end of a service or an action."""
    create = functools.partial(_served_on, managed, endpoint, name=name)
    # rcl applies rules to an action's hidden names itself; torn apart, it is not made.
    resolved = name
    if connection.participant is not None:
        entity = connection.participant.create(create, endpoint.kind.noun, name)
    else:
        if endpoint.kind.is_action:
            resolved = resolve_action_name(managed.node, name)
        entity = create(managed.node)
    if endpoint.kind.is_action:
        entity.action_name = resolved
    return entity


def _served_on(managed: Managed, endpoint: Endpoint, node: Node, *, name: str) -> Any:
    kind, interface = endpoint.kind, endpoint.interface
    # Answers of clients arrive while callbacks run.
    own = managed.turns.group if kind in CLIENTS else managed.node.default_callback_group
    group = endpoint.options.get("callback_group") or own
    if kind.is_action:
        # Late: numpy, 100 ms.
        from lifecycle.middleware.services.actions import GoalClient, GoalServer

        if kind is EndpointKind.ACTION_CLIENT:
            return GoalClient(node, interface, name, group=group, refuse_to_block=refuse_to_block)
        goals = Goals(managed, endpoint)
        goals.server = GoalServer(
            node, interface, name, goals.execute, accept=goals.accept, group=group
        )
        managed.gate.add_worker(goals.server, goals.end)
        return goals.server
    options: dict[str, Any] = {"callback_group": group}
    if endpoint.planned.qos is not None:
        options["qos_profile"] = to_rclpy(endpoint.planned.qos)
    if kind is EndpointKind.SERVICE_CLIENT:
        client = Node.create_client(node, interface, name, **options)
        refuse_to_deadlock(client)
        return client
    assert endpoint.handler is not None
    service = Node.create_service(node, interface, name, _answering(endpoint.handler), **options)
    _survive_late_answers(managed, service, endpoint.name)
    return service


def _name(managed: Managed, endpoint: Endpoint, connection: Connection) -> str:
    """Return what an endpoint is called where it is made: hidden nodes resolve nothing."""
    if endpoint.given_name or connection.participant is None:
        return endpoint.given_name or endpoint.name
    return resolve_name(managed.node, endpoint.kind, endpoint.name)


def _survive_late_answers(managed: Managed, service: Any, name: str) -> None:
    """Let an answer after its server was destroyed be lost, not end the process."""
    send = service.send_response
    warn = managed.log.warning

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


def factory(planned: PlannedEndpoint, connection: Connection, node: Node) -> Callable[..., Any]:
    """Return what makes a publisher or subscription with a planned flow on a connection."""
    where = connection.participant
    if planned.kind is EndpointKind.PUBLISHER:
        if where is None:
            return functools.partial(Node.create_publisher, node)
        return where.create_publisher  # where it is alone, it is unique
    if where is None:
        return functools.partial(create_subscription, node, unique=planned.unique)
    return functools.partial(where.create_subscription, unique=planned.unique)


def resolve_name(node: Node, kind: EndpointKind, name: str) -> str:
    """Return the fully qualified name of an endpoint of `node`, after its remapping rules."""
    if kind.is_action:
        return resolve_action_name(node, name)
    resolve = node.resolve_topic_name if kind.is_topic else node.resolve_service_name
    return str(resolve(name))


def _answering(handler: Callable[..., Any]) -> Callable[[Any, Any], Any]:
    """Let a service handler return None once it has filled in the response."""

    async def answer(request: Any, response: Any) -> Any:
        returned = await called(handler, request, response)
        return response if returned is None else returned

    return answer


_SPINNING = {
    ("rclpy.executors", "spin_once"),
    ("rclpy.executors", "spin_once_until_future_complete"),
    ("lifecycle.node.host.loop", "turn"),
    ("lifecycle.node.host.loop", "_spin"),
}
"""Where a single-threaded executor calls back: rclpy's, and those of our own processes."""


class DeadlockError(LifecycleError):
    """A blocking call was made in the thread that would have to bring its answer."""


def refuse_to_deadlock(client: Client) -> None:
    """Make `client.call` raise DeadlockError inside the executor; elsewhere it is rclpy's own."""
    blocking = client.call

    @functools.wraps(blocking)
    def call(*arguments: Any, **options: Any) -> Any:
        refuse_to_block(f"service {client.srv_name!r}", "client.call_async(request)")
        return blocking(*arguments, **options)

    client.call = call


def refuse_to_block(what: str, instead: str) -> None:
    """Raise DeadlockError inside the executor, where waiting for `what` would never end."""
    # A multi-threaded executor runs callbacks in other threads than the one that spins.
    frame = inspect.currentframe()
    while frame is not None:
        if (frame.f_globals.get("__name__"), frame.f_code.co_name) in _SPINNING:
            raise DeadlockError(
                f"cannot wait for {what} in a callback: the answer comes by the executor that "
                "waits for this callback",
                hint=f"write `async def` and `await {instead}`",
            )
        frame = frame.f_back
