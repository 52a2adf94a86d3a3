"""rclpy's factories, gated: what a node's own code makes sends and receives only while active.

Owns: which of rclpy's factories are overridden, and that what they make is known.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.callback_groups import CallbackGroup
from rclpy.client import Client
from rclpy.clock import Clock
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from rclpy.service import Service
from rclpy.subscription import Subscription
from rclpy.time_source import TimeSource
from rclpy.timer import Timer

from lifecycle.manifest.model import EndpointKind
from lifecycle.node.author.blocking import refuse_to_deadlock
from lifecycle.node.author.managed import Managed
from lifecycle.node.lifecycle.gate import Gate, GatedPublisher, GatedTimer


class GatedFactories(Node):  # type: ignore[misc]  # rclpy is not typed
    """Makes and destroys publishers, subscriptions, timers, clients and services as rclpy does."""

    lifecycle: Managed
    _gate: Gate | None = None
    """None until rclpy has made its own publishers: those are never held back."""

    def create_publisher(
        self, msg_type: Any, topic: str, qos_profile: QoSProfile | int, **options: Any
    ) -> Publisher:
        """As rclpy's; what is published while the node is not active is dropped."""
        publisher = super().create_publisher(msg_type, topic, qos_profile, **options)
        if self._gate is not None:
            self.lifecycle.undeclared.add(EndpointKind.PUBLISHER, publisher)
            self._gate.add(publisher, GatedPublisher(publisher, self.get_logger().warning))
        return publisher

    def create_subscription(
        self,
        msg_type: Any,
        topic: str,
        callback: Callable[..., Any],
        qos_profile: QoSProfile | int,
        **options: Any,
    ) -> Subscription:
        """As rclpy's; messages that arrive while the node is not active are dropped."""
        subscription = super().create_subscription(
            msg_type, topic, callback, qos_profile, **options
        )
        # /clock belongs to rclpy: simulated time must pass in every state.
        is_clock = isinstance(getattr(callback, "__self__", None), TimeSource)
        if self._gate is not None and not is_clock:
            self.lifecycle.undeclared.add(EndpointKind.SUBSCRIPTION, subscription)
            self._gate.add_subscription(subscription, self.lifecycle.call_soon)
        return subscription

    def create_timer(
        self,
        timer_period_sec: float,
        callback: Callable[..., Any] | None,
        callback_group: CallbackGroup | None = None,
        clock: Clock | None = None,
        autostart: bool = True,
    ) -> Timer:
        """As rclpy's; the timer runs only while the node is active, and then starts anew."""
        timer = super().create_timer(timer_period_sec, callback, callback_group, clock, autostart)
        # No callback is rclpy.Rate's: a thread that sleeps must wake up.
        if self._gate is not None and callback is not None:
            self._gate.add(timer, GatedTimer(timer, wanted=autostart))
        return timer

    def create_client(self, srv_type: Any, srv_name: str, **options: Any) -> Client:
        """As rclpy's, by default in a reentrant group: awaiting it in a callback is safe."""
        if options.get("callback_group") is None:
            options["callback_group"] = self.lifecycle.client_group
        client = super().create_client(srv_type, srv_name, **options)
        refuse_to_deadlock(client)
        self.lifecycle.undeclared.add(EndpointKind.SERVICE_CLIENT, client)
        return client

    def create_service(
        self, srv_type: Any, srv_name: str, callback: Callable[..., Any], **options: Any
    ) -> Service:
        """As rclpy's."""
        service = super().create_service(srv_type, srv_name, callback, **options)
        if self._gate is not None:
            self.lifecycle.undeclared.add(EndpointKind.SERVICE_SERVER, service)
        return service

    def destroy_publisher(self, publisher: Publisher) -> bool:
        """As rclpy's."""
        self._forget(publisher)
        return bool(super().destroy_publisher(publisher))

    def destroy_subscription(self, subscription: Subscription) -> bool:
        """As rclpy's."""
        self._forget(subscription)
        return bool(super().destroy_subscription(subscription))

    def destroy_client(self, client: Client) -> bool:
        """As rclpy's."""
        self._forget(client)
        return bool(super().destroy_client(client))

    def destroy_service(self, service: Service) -> bool:
        """As rclpy's."""
        self._forget(service)
        return bool(super().destroy_service(service))

    def destroy_timer(self, timer: Timer) -> bool:
        """As rclpy's."""
        self._forget(timer)
        return bool(super().destroy_timer(timer))

    def _forget(self, entity: object) -> None:
        if self._gate is not None:
            self._gate.remove(entity)
            self.lifecycle.undeclared.remove(entity)
