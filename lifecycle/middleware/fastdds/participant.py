"""Hidden nodes, each on a DDS participant with nothing but what was requested; flow participants.

Owns: how such a node and its context are made, and which of them this process has; showing an
endpoint that was made there to the node that it serves, whose executor and callback groups run it.

Fast DDS opens sockets per participant, so a publisher becomes distinguishable on the network by
getting a participant; see *Unique Network Flows*, "Alternatives". A connection (`connect_to` of
*Topological Discovery and Communication Negotiation*) is one as well, made from connection URLs.
One costs about 2.5 MB, 7 threads, 6 sockets and 6–10 ms.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import typing
import weakref
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import rclpy
from rclpy.callback_groups import CallbackGroup
from rclpy.client import Client
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.impl.implementation_singleton import rclpy_implementation as _rclpy
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from rclpy.service import Service
from rclpy.subscription import Subscription
from rclpy.waitable import Waitable

from lifecycle.errors import MiddlewareError
from lifecycle.manifest.qos import QosProfile
from lifecycle.middleware.fastdds import nfe, sockets
from lifecycle.middleware.fastdds.factory import initialised, participant_settings
from lifecycle.middleware.fastdds.profiles import ParticipantSettings
from lifecycle.middleware.fastdds.sockets import widen_discovery_buffers
from lifecycle.middleware.rcl import abi
from lifecycle.middleware.rcl.conversions import to_rclpy
from lifecycle.middleware.rcl.graph_queries import prefix_of
from lifecycle.middleware.versions import installed, private
from lifecycle.network.nfe import NetworkFlowEndpoint

_QUIET: dict[str, Any] = {
    "enable_rosout": False,
    "start_parameter_services": False,
    "parameter_overrides": [Parameter("start_type_description_service", value=False)],
}
"""Arguments of a node that has nothing but parameter events."""

_hidden: weakref.WeakSet[Node] = weakref.WeakSet()


def quiet_node(
    name: str, namespace: str, domain_id: int, *, settings: ParticipantSettings | None = None
) -> tuple[rclpy.Context, Node]:
    """Return a new context and on it a node with nothing of its own but parameter events.

    Raises:
        MiddlewareError: rcl refused; nothing is left.
    """
    settings = settings or ParticipantSettings()
    static_name = settings.connections.static_name
    enclave = ("--ros-args", "--enclave", static_name) if static_name else ()
    context = rclpy.Context()
    node: Node | None = None
    try:
        initialised(settings, domain_id, context=context, args=enclave, initialize_logging=False)
        with participant_settings(context, settings):
            node = Node(name, namespace=namespace, context=context, **_QUIET)
    except Exception as error:
        if node is not None:
            node.destroy_node()
        context.try_shutdown()
        context.destroy()
        known = error if isinstance(error, MiddlewareError) else None
        raise MiddlewareError(
            f"cannot make a participant for {namespace.rstrip('/')}/{name} in domain {domain_id}: "
            + (known.message if known else " ".join(str(error).split())),
            hint=known.hint if known else _security_hint(),
        ) from error
    _hidden.add(node)
    return context, node


def bare_node(context: rclpy.Context) -> Any:
    """Return rclpy's handle of a hidden node without endpoints; the first makes a participant."""
    name = f"_lifecycle_names_{os.getpid()}_{next(_numbers)}"
    more = (QoSProfile(depth=1).get_c_qos_profile(),) if installed().node_takes_rosout else ()
    try:
        with context.handle:
            return _rclpy.Node(name, "", context.handle, None, False, False, *more)
    except TypeError:  # of another rclpy: with what a public node has
        return Node(name, context=context, use_global_arguments=False, **_QUIET).handle


_numbers = itertools.count()


def republish_names(nodes: Iterable[Node]) -> None:
    """Make the participants of `nodes`, one of each, publish their nodes and endpoints anew.

    After an outage rmw_dds_common keeps the name of a node whose participant was dropped, and found
    again, out of the graph until then. rmw_fastrtps publishes it whenever a node is made. It has no
    endpoints: when one ends, a discovery server of Fast DDS 2.14 drops for good what it has not
    relayed yet of that participant's others.
    """
    for node in nodes:
        bare_node(node.context).destroy_when_not_in_use()


@contextlib.contextmanager
def made_participant(context: rclpy.Context, settings: ParticipantSettings) -> Iterator[None]:
    """Make the participant of a context with these settings; construct its first node in the block.

    Settings have no effect where it has a participant already. Raises as `participant_settings`.
    """
    with participant_settings(context, settings):
        first = bare_node(context)
    try:
        widen_discovery_buffers(context.get_domain_id())
        yield
    finally:
        first.destroy_when_not_in_use()


def _security_hint() -> str:
    """Return where to look if ROS 2 security is on: rcl's reason may be `error not set`."""
    if os.environ.get("ROS_SECURITY_ENABLE") != "true":
        return ""
    return (
        "ROS_SECURITY_ENABLE is set: look at ROS_SECURITY_KEYSTORE and the enclave, and whether "
        "the installed RMW has security at all (docs/security.md), or unset it"
    )


def hidden_nodes() -> tuple[Node, ...]:
    """Return the hidden nodes of this process, each on a participant of its own."""
    return tuple(node for node in _hidden if node.context.ok())


MovedEndpoint: typing.TypeAlias = Subscription | Service | Client | Waitable
"""A Waitable is an action server or client; importing their classes takes 100 ms."""

_KINDS = {Subscription: "subscription", Service: "service", Client: "client"}
"""What rclpy's methods and lists of a node are called after."""


def _move(entity: MovedEndpoint, maker: Node, host: Node) -> None:
    """Have `host`'s executor run the callbacks of an endpoint that `maker` has just made.

    Its callback group must be one of `host`'s.
    """
    if isinstance(entity, Waitable):
        maker.remove_waitable(entity)
        private(entity, "_node", "carry an action by a connection")
        entity._node = host  # noqa: SLF001 - whose executor works on goals, and which removes it
        host.add_waitable(entity)
        return
    name, why = f"_{_KINDS[type(entity)]}s", "carry an endpoint by a connection"
    private(maker, name, why).remove(entity)
    private(host, name, why).append(entity)
    for handler in entity.event_handlers if isinstance(entity, Subscription) else ():
        maker.remove_waitable(handler)
        host.add_waitable(handler)
    if host.executor is not None:
        host.executor.wake()


@typing.final
class FlowParticipant:
    """One participant, one hidden node in its own context, and the endpoints that were given to it.

    `destroy` it (or use it in a `with`); it does not end with the node it serves.

    Args:
        name: base name of the hidden node; by ROS custom it starts with an underscore.
        namespace: absolute.
        domain_id: 0–232.
        dscp: 0–63, set on its sender sockets before any user data can leave them; None takes
            that of its URLs, if they have any.
        served: the node whose executor runs the callbacks of what is made here, gated by its
            callback groups; None leaves them to the executor of `node`.
        **settings: of the participant, see ParticipantSettings.

    Attributes:
        node: the hidden node.

    Raises:
        ConnectionUrlError: a URL that is none.
        MiddlewareError: the participant could not be made, a port or address of its URLs is not to
            be had, or `dscp` not applied, or the settings go against a profile of the user's;
            nothing is left.
    """

    def __init__(
        self,
        name: str,
        namespace: str,
        domain_id: int,
        *,
        dscp: int | None = None,
        served: Node | None = None,
        **settings: Any,
    ) -> None:
        self.name = name
        self.settings = ParticipantSettings(**settings)
        self._dscp = dscp
        self._served = served
        self._moved: list[MovedEndpoint] = []
        self._nfes: tuple[NetworkFlowEndpoint, ...] = ()
        # Without ROS arguments: endpoint names come here resolved.
        self._context: rclpy.Context | None
        self._context, self.node = quiet_node(name, namespace, domain_id, settings=self.settings)
        try:
            # Every publisher of a participant lists the same sender sockets; rclpy's parameter
            # event publisher lists them before there is any publisher of the user's. By the same
            # one its GUID prefix is known.
            probe = next(iter(self.node.publishers))
            if self._dscp is not None or not abi.refusal():
                self._nfes = nfe.senders_of(self.node)
            # No socket of Fast DDS 2.14 opens later (see `sockets`).
            if self._dscp is not None:
                sockets.set_dscp(self._nfes, self._dscp)
            prefix_of(self.node)
            # It would share the sockets that are to be unique.
            self.node.destroy_publisher(probe)
        except BaseException:
            self.destroy()
            raise

    def create_publisher(
        self, type_: type[Any], topic: str, qos: QosProfile | QoSProfile, **options: Any
    ) -> Publisher:
        """Create a publisher on this participant; `topic` should be fully qualified.

        Its events are handled where the node served is spun; without `event_callbacks` none are set
        up. Options are those of rclpy's `create_publisher`.
        """
        if not options.get("event_callbacks"):
            options["event_callbacks"] = PublisherEventCallbacks(use_default_callbacks=False)
        publisher = self.node.create_publisher(type_, topic, to_rclpy(qos), **options)
        if self._served is not None:
            for event in publisher.event_handlers:
                self._served.add_waitable(event)
        return publisher

    def create_subscription(
        self,
        type_: type[Any],
        topic: str,
        callback: Callable[..., Any],
        qos: QosProfile | QoSProfile,
        *,
        callback_group: CallbackGroup | None = None,
        **options: Any,
    ) -> Subscription:
        """Create a subscription on this participant; arguments as `nfe.create_subscription`."""
        if callback_group is None and self._served is not None:
            callback_group = self._served.default_callback_group
        subscription = nfe.create_subscription(
            self.node, type_, topic, callback, qos, callback_group=callback_group, **options
        )
        self._receive(subscription)
        return subscription

    def create(self, make: Callable[[Node], MovedEndpoint], what: str, name: str) -> Any:
        """Create an end of a service or action on this participant.

        Args:
            make: makes it on a node; its callback group is one of the node served.
            what: kind of endpoint, for messages.
            name: fully qualified, for messages.

        Raises:
            MiddlewareError: the participant's endpoints are discovered statically.
        """
        if self.settings.connections.static_participants:
            raise MiddlewareError(
                f"cannot make {what} {name!r} on {self.name!r}: its endpoints are discovered "
                "statically, which services and actions are not",
                hint="map it to the node's own participant",
            )
        entity = make(self.node)
        self._receive(entity)
        return entity

    def destroy_endpoint(self, entity: Publisher | MovedEndpoint) -> None:
        """Destroy an endpoint that was made here; again is harmless."""
        if isinstance(entity, Publisher):
            if self._served is not None and entity in self.node.publishers:
                for event in entity.event_handlers:
                    self._served.remove_waitable(event)
            self.node.destroy_publisher(entity)
            return
        if isinstance(entity, Waitable):
            entity.destroy()
        else:
            owner = self._served or self.node
            getattr(owner, f"destroy_{_KINDS[type(entity)]}")(entity)
        if entity in self._moved:
            self._moved.remove(entity)

    def read_dscp(self) -> int:
        """Return the DSCP (0–63) the kernel puts on what this participant sends.

        Of sockets that differ it is one that the participant was not to be marked with. Raises
        MiddlewareError if it has no socket.
        """
        found = sockets.get_dscps(self._nfes)
        return min(found - {self._dscp}, default=min(found))

    def destroy(self) -> None:
        """Destroy its endpoints, the hidden node and the participant; again is harmless."""
        self._nfes = ()  # its ports may belong to another process from now on
        for entity in tuple(self._moved):
            self.destroy_endpoint(entity)
        self.node.destroy_node()
        if self._context is not None:
            self._context.try_shutdown()
            self._context.destroy()
            self._context = None

    def _receive(self, entity: MovedEndpoint) -> None:
        if self._served is not None:
            _move(entity, self.node, self._served)
            self._moved.append(entity)

    def __enter__(self) -> FlowParticipant:
        return self

    def __exit__(self, *_: object) -> None:
        self.destroy()
