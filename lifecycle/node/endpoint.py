"""One endpoint of a node: what it is, how its rclpy entity is made, where it is, its handover.

The factories of our own node are for what its author's code makes. What exists where is
data_layer.py's.

rclpy's matched events are handled in a group of the framework's: an author's callback that awaits
something must not delay the event of a peer that appeared or left.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any

import msgspec
from rclpy.event_handler import (
    EventHandler,
    QoSPublisherEventType,
    QoSSubscriptionEventType,
    UnsupportedEventTypeError,
)
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import qos_profile_system_default
from rclpy.task import Future

from lifecycle.errors import LifecycleError
from lifecycle.manifest.model import EndpointKind
from lifecycle.manifest.qos import QosProfile
from lifecycle.middleware.fastdds.nfe import create_subscription
from lifecycle.middleware.rcl.conversions import to_rclpy
from lifecycle.node.callbacks import Goals, called, resolve_action_name
from lifecycle.node.connections import Connection
from lifecycle.node.gate import GatedSubscription
from lifecycle.node.handlers import Key, alternatives
from lifecycle.plan.model import PlannedEndpoint

if TYPE_CHECKING:
    from rclpy.callback_groups import CallbackGroup
    from rclpy.subscription import Subscription

    from lifecycle.node.gate import DeclaredPublisher
    from lifecycle.node.managed import Managed


CLIENTS = frozenset({EndpointKind.SERVICE_CLIENT, EndpointKind.ACTION_CLIENT})


class UnknownEndpointError(LifecycleError, KeyError):
    """Code asked for an endpoint by a name that no interface declares."""


def find_endpoint(spelling: str, declared: Iterable[Key], *, node: str) -> Key:
    """Return the endpoint that `publishers/video` means, or `video` if one kind of `node` has it.

    Raises:
        UnknownEndpointError: it means none, or more than one.
    """
    by_spelling = {kind.spell(name): (kind, name) for kind, name in declared}
    if spelling in by_spelling:
        return by_spelling[spelling]
    named = [each for each, (_, name) in by_spelling.items() if name == spelling]
    if len(named) == 1:
        return by_spelling[named[0]]
    if named:
        raise UnknownEndpointError(
            f"cannot tell which {spelling!r} of {node} is meant",
            hint=f"write {' or '.join(map(repr, named))}",
        )
    hint = "endpoints are declared at configure; ask from on_configure on"
    if by_spelling:
        hint = alternatives(spelling, by_spelling)
    raise UnknownEndpointError(f"cannot find endpoint {spelling!r} of {node}", hint=hint)


def wire_name(entity: Any) -> str:
    """Return an entity's name on the wire, as rcl resolved it; empty if it is unknown."""
    for attribute in ("topic_name", "service_name", "action_name"):
        name = getattr(entity, attribute, None)
        if name is not None:
            return str(name)
    return ""


def count_peers(entity: Publisher | Subscription) -> int:
    """Return how many remote endpoints are matched with a publisher or subscription."""
    if isinstance(entity, Publisher):
        return int(entity.get_subscription_count())
    return int(entity.get_publisher_count())


def watch_matches(
    node: Node,
    entity: Publisher | Subscription,
    group: CallbackGroup,
    changed: Callable[[], None],
) -> Callable[[], None]:
    """Call `changed` each time that peers of an endpoint were matched or unmatched.

    The executor of `node` calls; the endpoint may be on another participant. Returns what ends
    it, before the endpoint is destroyed.
    """
    event = QoSSubscriptionEventType.RCL_SUBSCRIPTION_MATCHED
    if isinstance(entity, Publisher):
        event = QoSPublisherEventType.RCL_PUBLISHER_MATCHED
    try:
        handler = EventHandler(
            callback_group=group,
            callback=lambda _: changed(),
            event_type=event,
            parent_impl=entity.handle,
        )
    except UnsupportedEventTypeError:
        return lambda: None  # an RMW without the event: counts are then read on request
    node.add_waitable(handler)

    def stop() -> None:
        node.remove_waitable(handler)
        handler.destroy()

    return stop


class Placement(msgspec.Struct, frozen=True, kw_only=True, eq=False):
    """The rclpy object of an endpoint on one connection.

    Attributes:
        unwatch: ends that its peers or its server are watched; None where they are not.
    """

    connection: Connection
    entity: Any
    unwatch: Callable[[], None] | None = None


class Endpoint(msgspec.Struct, kw_only=True, eq=False):
    """One endpoint and where it is now.

    Attributes:
        planned: as it is declared; without a name if only the code that made it knows of it.
        callback: its handler, where code gave one with the declaration.
        interface: the message, service or action class, once it is imported.
        handler: takes messages, requests or goals; None where the kind has no handler.
        handle: what authors publish by; None for other kinds.
        placement: where it is; None while it is mapped nowhere.
        handover: it is on two connections now; None usually.
        is_late: it was declared after configure, and goes with cleanup.
        error: why it could not be made as asked; empty if it was.
        fault: what its handler raised at the last goal of an action; empty if it returned.
        given_name: fully qualified, given by `remap`; empty for the name that was declared.
        lossy, size_bytes: the author's hints for negotiation; None without one.
        options: how it is made, as far as code says it by `set_options`.
    """

    planned: PlannedEndpoint
    callback: Callable[..., Any] | None = None
    interface: Any = None
    handler: Callable[..., Any] | None = None
    handle: DeclaredPublisher | None = None
    placement: Placement | None = None
    handover: Handover | None = None
    is_late: bool = False
    error: str = ""
    fault: str = ""
    given_name: str = ""
    lossy: bool | None = None
    size_bytes: int | None = None
    options: dict[str, Any] = {}

    @property
    def kind(self) -> EndpointKind:
        """What it is: a publisher, a subscription."""
        return self.planned.kind

    @property
    def name(self) -> str:
        """As declared."""
        return self.planned.name

    @property
    def key(self) -> Key:
        """Kind and declared name."""
        return self.kind, self.name

    @property
    def spelling(self) -> str:
        """`publishers/video`."""
        return self.kind.spell(self.name)

    @property
    def wire_name(self) -> str:
        """Fully qualified name as it is now, or will be once it is mapped."""
        made = "" if self.placement is None else wire_name(self.placement.entity)
        return made or self.given_name or self.planned.resolved

    @property
    def entity(self) -> Any:
        """The rclpy object; None while it is mapped nowhere."""
        return None if self.placement is None else self.placement.entity

    @property
    def connection(self) -> Connection | None:
        """Where it is mapped; None while it is nowhere."""
        return None if self.placement is None else self.placement.connection


def interface_name(interface: type[Any]) -> str:
    """Return `package/msg/Type` of a generated class; raises LifecycleError for another."""
    package, _, rest = interface.__module__.partition(".")
    kind = rest.partition(".")[0]
    if kind not in {"msg", "srv", "action"}:
        raise LifecycleError(
            f"cannot declare an endpoint of type {interface!r}; "
            "give a message, service or action class such as std_msgs.msg.String"
        )
    return f"{package}/{kind}/{interface.__name__}"


class Handover(msgspec.Struct, frozen=True, kw_only=True, eq=False):
    """The time in which an endpoint is on two connections: make before break.

    Meanwhile a publisher publishes by the old one, and a subscription receives by both.

    Attributes:
        old: where it is until then; None if it was nowhere.
        peers: how many the new one has to match.
        done: the old one is destroyed.
    """

    old: Placement | None
    peers: int
    done: Future = msgspec.field(default_factory=Future)


_DESTROY = {
    EndpointKind.PUBLISHER: "destroy_publisher",
    EndpointKind.SUBSCRIPTION: "destroy_subscription",
    EndpointKind.SERVICE_SERVER: "destroy_service",
    EndpointKind.SERVICE_CLIENT: "destroy_client",
}


def make_entity(managed: Managed, endpoint: Endpoint, connection: Connection) -> Any:
    """Return a new rclpy entity of an endpoint; raises LifecycleError, and nothing is left."""
    create = _topic_end if endpoint.kind.is_topic else _served
    entity = create(managed, endpoint, connection, _name(managed, endpoint, connection))
    if introspection := endpoint.options.get("introspection"):
        clock = managed.node.get_clock()
        entity.configure_introspection(clock, qos_profile_system_default, introspection)
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
        from rclpy.action import ActionClient

        from lifecycle.middleware.services.actions import GoalServer

        if kind is EndpointKind.ACTION_CLIENT:
            return ActionClient(node, interface, name, callback_group=group)
        goals = Goals(managed, endpoint)
        goals.server = GoalServer(
            node, interface, name, goals.execute, accept=goals.accept, group=group
        )
        managed.gate.add(goals.server, goals)
        return goals.server
    options = {**endpoint.options, "callback_group": group}
    options.pop("introspection", None)  # is set once it is made
    if endpoint.planned.qos is not None:
        options["qos_profile"] = to_rclpy(endpoint.planned.qos)
    if kind is EndpointKind.SERVICE_CLIENT:
        return Node.create_client(node, interface, name, **options)
    assert endpoint.handler is not None
    return Node.create_service(node, interface, name, _answering(endpoint.handler), **options)


def _name(managed: Managed, endpoint: Endpoint, connection: Connection) -> str:
    """Return what an endpoint is called where it is made: hidden nodes resolve nothing."""
    if endpoint.given_name or connection.participant is None:
        return endpoint.given_name or endpoint.name
    return resolve_name(managed.node, endpoint.kind, endpoint.name)


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
