"""The `declare_…` methods of a LifecycleNode: endpoints declared in code, and hints on them.

Owns: their signatures, and the file and line that a declaration is known by. What becomes of one is
up to declaring.py.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from rclpy.node import Node
from rclpy.qos import QoSProfile

from lifecycle.errors import LifecycleError
from lifecycle.manifest.model import EndpointKind
from lifecycle.manifest.qos import QosProfile
from lifecycle.node.actions import resolve_action_name
from lifecycle.node.author import declaring
from lifecycle.node.author.handlers import ActionHandler
from lifecycle.node.author.managed import Managed
from lifecycle.node.author.spec import calling_position
from lifecycle.node.endpoints.mapping import EndpointOptions
from lifecycle.plan.model import PlannedEndpoint

if TYPE_CHECKING:
    from rclpy.callback_groups import CallbackGroup
    from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
    from rclpy.service_introspection import ServiceIntrospectionState


class Declarations(Node):  # type: ignore[misc]  # rclpy is not typed
    """Declares endpoints: in `__init__`, or later where the manifest says `endpoints: open`."""

    lifecycle: Managed

    def declare_publisher(
        self,
        name: str,
        msg_type: type[Any],
        qos: QosProfile | QoSProfile | int = 10,
        *,
        lossy: bool | None = None,
        size_bytes: int | None = None,
    ) -> None:
        """Declare a publisher; `self.publisher(name)` is its handle from on_configure on.

        Args:
            name: relative, absolute or private.
            msg_type: message class.
            qos: a number is a history depth.
            lossy: hint for negotiation: the data bear an unreliable transport.
            size_bytes: hint for negotiation: the largest serialized message, > 0.

        Raises:
            LifecycleError: declared already, or not allowed (any more).
        """
        profile = declaring.profile(qos)
        hints = (lossy, size_bytes)
        self._declare(EndpointKind.PUBLISHER, name, msg_type, profile, hints=hints)

    def declare_subscription(
        self,
        name: str,
        msg_type: type[Any],
        qos: QosProfile | QoSProfile | int = 10,
        *,
        callback: Callable[..., Any] | None = None,
        lossy: bool | None = None,
        size_bytes: int | None = None,
    ) -> None:
        """Declare a subscription; a method decorated with `@on_message(name)` receives it.

        One that is declared after configure needs its `callback` given here. Otherwise as
        `declare_publisher`.
        """
        profile = declaring.profile(qos)
        hints = (lossy, size_bytes)
        self._declare(
            EndpointKind.SUBSCRIPTION, name, msg_type, profile, callback=callback, hints=hints
        )

    def declare_service(
        self, name: str, srv_type: type[Any], *, callback: Callable[..., Any] | None = None
    ) -> None:
        """Declare a service server; a method decorated with `@on_service(name)` answers.

        One that is declared after configure needs its `callback` given here.
        """
        self._declare(EndpointKind.SERVICE_SERVER, name, srv_type, callback=callback)

    def declare_client(self, name: str, srv_type: type[Any]) -> None:
        """Declare a service client; `self.client(name)` from on_connect on."""
        self._declare(EndpointKind.SERVICE_CLIENT, name, srv_type)

    def declare_action(
        self,
        name: str,
        action_type: type[Any],
        *,
        callback: Callable[..., Any] | None = None,
        accept: Callable[..., Any] | None = None,
    ) -> None:
        """Declare an action server; a method decorated with `@on_action(name)` executes goals.

        One that is declared after configure needs its `callback` given here, and with it `accept`,
        which decides on goals as a method decorated with `@on_goal(name)` does.

        Raises:
            LifecycleError: as declare_publisher, or `accept` is given without `callback`.
        """
        if accept is not None and callback is None:
            raise LifecycleError(
                f"cannot decide on goals of action server {name!r} by accept= alone",
                hint=f"give callback= too, or decorate a method with @on_goal({name!r})",
            )
        if callback is not None:
            callback = ActionHandler(execute=callback, accept=accept)
        self._declare(EndpointKind.ACTION_SERVER, name, action_type, callback=callback)

    def declare_action_client(self, name: str, action_type: type[Any]) -> None:
        """Declare an action client; `self.action_client(name)` from on_connect on."""
        self._declare(EndpointKind.ACTION_CLIENT, name, action_type)

    def hint(
        self, endpoint: str, *, lossy: bool | None = None, size_bytes: int | None = None
    ) -> None:
        """Give negotiation a hint on a declared endpoint; the manifest's `flows:` win.

        Args:
            endpoint: `video`, or `publishers/video` where another kind has the name too.
            lossy: the data bear an unreliable transport.
            size_bytes: the largest serialized message, > 0.

        Raises:
            UnknownEndpointError: nothing, or more than one thing, is declared so.
        """
        self.lifecycle.declared.hint(endpoint, lossy=lossy, size_bytes=size_bytes)

    def set_options(
        self,
        endpoint: str,
        *,
        callback_group: CallbackGroup | None = None,
        event_callbacks: PublisherEventCallbacks | SubscriptionEventCallbacks | None = None,
        raw: bool = False,
        introspection: ServiceIntrospectionState | None = None,
    ) -> None:
        """Say how a declared endpoint is made, as the arguments of rclpy's factories do.

        In `__init__` or on_configure; it holds each time that the endpoint is made.

        Args:
            endpoint: `video`, or `publishers/video` where another kind has the name too.
            callback_group: of its callback and its events.
            event_callbacks: of a publisher or subscription: deadline, liveliness, incompatible QoS,
                matched, …
            raw: a subscription's handler is given serialized bytes instead of a message.
            introspection: of a service server or client: what it publishes of each call.

        Raises:
            UnknownEndpointError: nothing, or more than one thing, is declared so.
            LifecycleError: its kind cannot have one of them, or it exists already.
        """
        self.lifecycle.declared.set_options(
            endpoint,
            EndpointOptions(
                callback_group=callback_group,
                event_callbacks=event_callbacks,
                raw=raw,
                introspection=introspection,
            ),
        )

    def _declare(
        self,
        kind: EndpointKind,
        name: str,
        interface: type[Any],
        qos: QosProfile | None = None,
        *,
        callback: Callable[..., Any] | None = None,
        hints: tuple[bool | None, int | None] = (None, None),
    ) -> None:
        resolve: Callable[[str], str]
        if kind.is_action:
            resolve = functools.partial(resolve_action_name, self)
        else:
            resolve = self.resolve_topic_name if kind.is_topic else self.resolve_service_name
        endpoint = PlannedEndpoint(
            kind=kind,
            name=name,
            resolved=resolve(name),
            type=declaring.interface_name(interface),
            qos=qos,
            at=calling_position(depth=2),
        )
        self.lifecycle.declared.declare(endpoint, callback=callback, hints=hints)
