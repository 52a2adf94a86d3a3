"""An extra DDS participant for one network flow or connection: its DSCP, ports and shared memory.

Fast DDS opens sockets per participant, so a publisher becomes distinguishable on the network by
getting a participant; see *Unique Network Flows*, "Alternatives". A connection (`connect_to` of
*Topological Discovery and Communication Negotiation*) is one as well, made from connection URLs.
One costs about 2.5 MB, 7 threads, 6 sockets and 6–10 ms.
"""

from __future__ import annotations

import typing
from collections.abc import Callable
from typing import Any

import rclpy
from rclpy.callback_groups import CallbackGroup
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from rclpy.subscription import Subscription

from lifecycle.errors import MiddlewareError
from lifecycle.manifest.qos import QosProfile
from lifecycle.middleware.fastdds import nfe, sockets
from lifecycle.middleware.fastdds.profiles import ParticipantSettings, check_endpoint
from lifecycle.middleware.rcl import abi, hidden_node
from lifecycle.middleware.rcl.conversions import to_rclpy
from lifecycle.middleware.rcl.graph_queries import prefix_of
from lifecycle.middleware.rcl.hidden_node import quiet_node
from lifecycle.network.nfe import NetworkFlowEndpoint


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
        asked = (dscp, *(url.dscp for url in self.settings.urls))
        self._dscp = next((each for each in asked if each is not None), None)
        self._served = served
        self._moved: list[hidden_node.MovedEndpoint] = []
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
        self._check_static(type_, topic, writer=True)
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
        self._check_static(type_, topic, writer=False)
        if callback_group is None and self._served is not None:
            callback_group = self._served.default_callback_group
        subscription = nfe.create_subscription(
            self.node, type_, topic, callback, qos, callback_group=callback_group, **options
        )
        self._receive(subscription)
        return subscription

    def create(
        self, make: Callable[[Node], hidden_node.MovedEndpoint], what: str, name: str
    ) -> Any:
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

    def destroy_endpoint(self, entity: Publisher | hidden_node.MovedEndpoint) -> None:
        """Destroy an endpoint that was made here; again is harmless."""
        if isinstance(entity, Publisher):
            if self._served is not None and entity in self.node.publishers:
                for event in entity.event_handlers:
                    self._served.remove_waitable(event)
            self.node.destroy_publisher(entity)
            return
        hidden_node.dismiss(entity, self._served or self.node)
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

    def _receive(self, entity: hidden_node.MovedEndpoint) -> None:
        if self._served is not None:
            hidden_node.move(entity, self.node, self._served)
            self._moved.append(entity)

    def _check_static(self, type_: type[Any], topic: str, *, writer: bool) -> None:
        """Refuse an endpoint that the table of static discovery does not have, if there is one."""
        if not self.settings.static_endpoints:
            return
        package, kind = type_.__module__.split(".")[:2]
        check_endpoint(
            self.settings.static_endpoints,
            writer=writer,
            profile=self.node.resolve_topic_name(topic),
            type_name=f"{package}::{kind}::dds_::{type_.__name__}_",
        )

    def __enter__(self) -> FlowParticipant:
        return self

    def __exit__(self, *_: object) -> None:
        self.destroy()
