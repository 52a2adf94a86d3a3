"""LifecycleNode: the class to derive from, as its author sees it; managed.py is behind it."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from rclpy.callback_groups import CallbackGroup
from rclpy.client import Client
from rclpy.clock import Clock
from rclpy.context import Context
from rclpy.lifecycle import LifecycleState, TransitionCallbackReturn
from rclpy.logging import LoggingSeverity
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from rclpy.service import Service
from rclpy.subscription import Subscription
from rclpy.task import Future
from rclpy.time_source import TimeSource
from rclpy.timer import Timer

from lifecycle.errors import LifecycleError
from lifecycle.manifest.model import EndpointKind
from lifecycle.manifest.qos import QosProfile
from lifecycle.middleware.rcl.conversions import from_rclpy
from lifecycle.network.connection_url import ConnectionUrl
from lifecycle.node.connections import Connection, connections_of
from lifecycle.node.endpoint import Placement, interface_name, resolve_name
from lifecycle.node.gate import (
    DeclaredPublisher,
    Gated,
    GatedPublisher,
    GatedSubscription,
    GatedTimer,
    NodeGate,
)
from lifecycle.node.handlers import ActionHandler
from lifecycle.node.machine import NodeState
from lifecycle.node.managed import Managed
from lifecycle.node.planned import (
    Construction,
    default_name,
    is_auto,
    plan_without_manifest,
)
from lifecycle.plan.model import PlannedEndpoint
from lifecycle.verify.observation import NodeConfiguration
from lifecycle.verify.outcome import ConnectionReport

if TYPE_CHECKING:
    from rclpy.action import ActionClient

    from lifecycle.graph.state import GraphEvent


__all__ = ["ERROR", "FAILURE", "SUCCESS", "LifecycleNode", "TransitionCallbackReturn"]

SUCCESS = TransitionCallbackReturn.SUCCESS
FAILURE = TransitionCallbackReturn.FAILURE
ERROR = TransitionCallbackReturn.ERROR

CallbackReturn = Any
"""What a callback may return: rclpy's TransitionCallbackReturn, or None for SUCCESS."""


def _any_signature(callback: Callable[..., CallbackReturn]) -> Callable[..., CallbackReturn]:
    """Type a callback so that who overrides it may leave `state` out, or write `async def`."""
    return callback


class LifecycleNode(Node):  # type: ignore[misc]  # rclpy is not typed
    """A ROS 2 managed node whose endpoints are declared, not scattered through its code.

    From outside it is exactly a managed node (`ros2 lifecycle`, launch_ros and nav2 drive it),
    with two more transitions inside *inactive*: `connect` makes the endpoints, `disconnect`
    removes them. Data flows only while the node is active.

    With a manifest that declares a publisher `chatter` and a subscription `echo`:

        class Talker(LifecycleNode):
            @on_timer(period_s=0.5)
            def tick(self):
                self.publisher("chatter").publish(Int32(data=1))

            @on_message("echo")
            def heard(self, message):
                self.get_logger().info(f"heard {message.data}")

    Without a manifest, it declares them itself, `self.declare_publisher("chatter", Int32)`, and
    drives itself up, `super().__init__("talker", lifecycle="auto")`.

    Its callbacks, `on_…`, take `(self, state)` or `(self)`, return SUCCESS, FAILURE, ERROR or None
    for SUCCESS, and may be `async def`:

        async def on_activate(self, state):
            answer = await self.client("calibrate").call_async(Trigger.Request())
            return SUCCESS if answer.success else FAILURE

    An exception is logged with its traceback and counts as ERROR. Every callback has a deadline
    (`timeouts:` in the manifest, 10 s by default): an `async def` one is interrupted where it
    awaits; a sync one cannot be, so it is judged when it returns, and a supervisor may end the
    process before that. An exception in a message, service or timer callback ends the process,
    as with any rclpy node; one in an action's handler ends its goal.

    A name that is not declared, or by several kinds, raises UnknownEndpointError, a KeyError too;
    the node interface (`connect_to` and its like) raises NotConfiguredError before configure.

    Args:
        node_name: base name; by default the class's name in snake_case. A manifest's name wins.
        lifecycle: "manual" waits for others to drive it; "auto" configures, connects and activates
            itself as soon as it is spun. Under a supervisor or `lifecycle run` theirs wins.
        namespace: as in rclpy; a manifest's wins.
        context: as in rclpy.
        enable_communication_interface: serve and announce its states; without, no other process
            can drive it or read its configuration.
        options: further keywords of rclpy.node.Node.

    Attributes:
        lifecycle: the managed half: `lifecycle.state`, `await lifecycle.change("configure")`,
            `lifecycle.get_configuration()`.
    """

    lifecycle: Managed
    _gate: NodeGate | None = None
    """None until rclpy has made its own publishers: those are never held back."""
    _construction: Construction | None = None
    """Set by the process that hosts it, before rclpy constructs it."""

    def __init__(
        self,
        node_name: str | None = None,
        *,
        lifecycle: str = "manual",
        namespace: str | None = None,
        context: Context | None = None,
        enable_communication_interface: bool = True,
        **options: Any,
    ) -> None:
        auto = is_auto(lifecycle)
        name = node_name or default_name(type(self))
        super().__init__(name, namespace=namespace, context=context, **options)
        by_host = self._construction
        spec = by_host.spec if by_host is not None else None
        if spec is None:
            name, namespace = self.get_name(), self.get_namespace()
            spec = plan_without_manifest(type(self), name=name, namespace=namespace)
        self.lifecycle = Managed(
            self,
            spec,
            auto,
            by_host.supervisor if by_host is not None else "",
            served=enable_communication_interface,
            health=None if type(self).health is LifecycleNode.health else self.health,
        )
        self._gate = self.lifecycle.gate
        if spec.log_level:
            self.get_logger().set_level(LoggingSeverity[spec.log_level.upper()])
        if by_host is None and auto:
            self.lifecycle.bring_up_when_spun()

    @property
    def is_active(self) -> bool:
        """Data may flow."""
        return self.lifecycle.state is NodeState.ACTIVE

    def publisher(self, name: str) -> DeclaredPublisher:
        """Return the declared publisher `name`, from on_configure on."""
        handle = self.lifecycle.data_layer.declared(EndpointKind.PUBLISHER, name).handle
        assert handle is not None
        return handle

    def client(self, name: str) -> Client:
        """Return the declared service client `name`, from on_connect on.

        In callbacks, `await self.client("reset").call_async(request)`: the blocking `call` waits
        for the executor that waits for it. Raises LifecycleError while the node is not connected.
        """
        return self.lifecycle.data_layer.entity(EndpointKind.SERVICE_CLIENT, name)

    def subscription(self, name: str) -> Subscription:
        """Return rclpy's object of the declared subscription `name`, from on_connect on.

        For `get_publisher_count()` and the like; it is another one after a handover. Raises as
        `client`.
        """
        return self.lifecycle.data_layer.entity(EndpointKind.SUBSCRIPTION, name)

    def service(self, name: str) -> Service:
        """Return rclpy's object of the declared service server `name`; as `subscription`."""
        return self.lifecycle.data_layer.entity(EndpointKind.SERVICE_SERVER, name)

    def action_client(self, name: str) -> ActionClient:
        """Return the declared action client `name`, from on_connect on; raises as `client`.

        In callbacks, `goal = await self.action_client("dock").send_goal_async(Dock.Goal())`, then
        `await goal.get_result_async()`; as with rclpy, a goal that no server is there for is lost.
        """
        return self.lifecycle.data_layer.entity(EndpointKind.ACTION_CLIENT, name)

    def sleep(self, seconds: float) -> Future:
        """Return what is done in `seconds` (> 0) of wall time: `await self.sleep(0.1)`.

        Whatever else the node has to do goes on meanwhile, requests to cancel a goal included.
        """
        future: Future = Future()
        self.lifecycle.turns.call_after(seconds, lambda: future.set_result(None))
        return future

    def destroy_node(self) -> None:
        """As rclpy's; participants of its own go with it."""
        self.lifecycle.close()
        super().destroy_node()

    # Callbacks of the author.

    @_any_signature
    def on_configure(self, state: LifecycleState) -> CallbackReturn:
        """Read parameters, take resources. Endpoints are declared but do not exist yet."""

    @_any_signature
    def on_connect(self, state: LifecycleState) -> CallbackReturn:
        """The data layer is made: endpoints exist, clients can be used, data does not flow."""

    @_any_signature
    def on_activate(self, state: LifecycleState) -> CallbackReturn:
        """Start working; data flows once this has succeeded."""

    @_any_signature
    def on_deactivate(self, state: LifecycleState) -> CallbackReturn:
        """Stop working; data has stopped flowing already."""

    @_any_signature
    def on_disconnect(self, state: LifecycleState) -> CallbackReturn:
        """The data layer is about to be removed."""

    @_any_signature
    def on_cleanup(self, state: LifecycleState) -> CallbackReturn:
        """Give back what on_configure took."""

    @_any_signature
    def on_shutdown(self, state: LifecycleState) -> CallbackReturn:
        """The last call, from any state; endpoints are removed after it."""

    @_any_signature
    def health(self) -> Any:
        """Return what is wrong, as text; None if all is well. May be `async def`.

        Asked once a second while the node is connected or active, and at once after each change of
        its state, if a class overrides it. An exception counts as unhealthy, no answer in time as
        not known. The manifest says with `health` what follows.
        """

    @_any_signature
    def on_error(self, state: LifecycleState) -> CallbackReturn:
        """A callback ended in ERROR: SUCCESS says the node is as new, FAILURE finalizes it."""

    # What it declares: in `__init__`, or later where the manifest says `endpoints: open`.

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
            msg_type: its class.
            qos: a number is a history depth.
            lossy: see `hint`.
            size_bytes: see `hint`.

        Raises:
            LifecycleError: declared already, or not allowed (any more).
        """
        self._declare(EndpointKind.PUBLISHER, name, msg_type, qos)
        if (lossy, size_bytes) != (None, None):
            self.hint(EndpointKind.PUBLISHER.spell(name), lossy=lossy, size_bytes=size_bytes)

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
        self._declare(EndpointKind.SUBSCRIPTION, name, msg_type, qos, callback=callback)
        if (lossy, size_bytes) != (None, None):
            self.hint(EndpointKind.SUBSCRIPTION.spell(name), lossy=lossy, size_bytes=size_bytes)

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
        """
        found = self.lifecycle.data_layer.find(endpoint)
        found.lossy = found.lossy if lossy is None else lossy
        found.size_bytes = found.size_bytes if size_bytes is None else size_bytes
        self.lifecycle.configuration_changes.touch()

    def set_options(self, endpoint: str, **options: Any) -> None:
        """Say how a declared endpoint is made, by further keywords of rclpy's factory of its kind.

        In `__init__` or on_configure; they hold each time that it is made: `callback_group`,
        `event_callbacks`, `raw`; of a service's server or client `introspection`, what it
        publishes of each call (ServiceIntrospectionState). What it cannot have is a TypeError at
        connect.

        Args:
            endpoint: `video`, or `publishers/video` where another kind has the name too.
            options: handed on as they are.

        Raises:
            LifecycleError: it exists already.
        """
        self.lifecycle.data_layer.set_options(endpoint, options)

    def _declare(
        self,
        kind: EndpointKind,
        name: str,
        interface: type[Any],
        qos: QosProfile | QoSProfile | int | None = None,
        *,
        callback: Callable[..., Any] | None = None,
    ) -> None:
        if isinstance(qos, int):
            qos = QosProfile(depth=qos)
        planned = PlannedEndpoint(
            kind=kind,
            name=name,
            resolved=resolve_name(self, kind, name),
            type=interface_name(interface),
            qos=from_rclpy(qos) if isinstance(qos, QoSProfile) else qos,
            at=self.lifecycle.spec.at,
        )
        self.lifecycle.data_layer.declare(planned, callback)

    # The node interface, in callbacks from on_configure to cleanup.

    def connect_to(self, *urls: str | ConnectionUrl, name: str = "") -> Connection:
        """Make a connection that endpoints can be mapped onto: a DDS participant of its own.

        Args:
            urls: its transports, `udpv4://10.77.0.1:7911?peer=10.77.0.2:7910`; at least one.
            name: letters, digits and underscores; empty makes one up.

        Returns:
            The connection; the present one if it has these URLs.

        Raises:
            ConnectError: not a URL, not a name, in use for other URLs, or the middleware refused.

        Example:
            >>> net = self.connect_to("udpv4://10.77.0.1:7911", name="net")
            >>> self.map_to("video", net)
        """
        return self.lifecycle.data_layer.connect_to(name, connections_of(urls))

    def map_to(self, endpoint: str, connection: Connection | str) -> Future:
        """Map a declared endpoint onto a connection, or hand it over from where it is.

        A handover makes before it breaks: an endpoint that has peers lives on both connections
        until the new one has as many, at most 4 s. What reaches a subscription both ways meanwhile
        is delivered twice, and a TRANSIENT_LOCAL publisher sends its last messages again.
        `self.publisher(name)` stays the same handle; ask for clients anew with `self.client(name)`.

        Args:
            endpoint: `video`, or `publishers/video` where another kind has the name too.
            connection: what `connect_to` returned, or its name; "" is the node's own participant.

        Returns:
            Done once the endpoint is on the new connection alone; await it or ignore it.

        Raises:
            UnknownConnectionError: no such connection.
            ConnectError: it cannot be made there; where it was it still is.
        """
        return self.lifecycle.data_layer.map_to(endpoint, connection)

    def disconnect(self, connection: Connection | str) -> None:
        """Unmake a connection; endpoints that are still mapped onto it are then mapped nowhere.

        Raises:
            UnknownConnectionError: no such connection.
            ConnectError: it is the node's own participant.
        """
        self.lifecycle.data_layer.disconnect(connection)

    def remap(self, endpoint: str, name: str) -> None:
        """Give a declared endpoint another topic or service name; "" gives back its own.

        Raises LifecycleError if it is not a name; the endpoint is as it was.
        """
        self.lifecycle.data_layer.remap(endpoint, name)

    @property
    def connections(self) -> tuple[ConnectionReport, ...]:
        """Every connection as it is now, the node's own participant (with the empty name) first."""
        return self.lifecycle.get_configuration().connections

    @property
    def mappings(self) -> tuple[tuple[str, str | None], ...]:
        """(`publishers/video`, name of its connection) of every declared endpoint.

        The name is empty for the node's own participant, None for what is mapped nowhere.
        """
        return tuple(
            (each.spelling, each.connection.name if each.connection is not None else None)
            for each in self.lifecycle.data_layer.endpoints.values()
        )

    def on_connection_event(self, callback: Callable[[GraphEvent], Any]) -> Callable[[], None]:
        """Call back, sync or async, when a connection or mapping is established or lost.

        `callback` gets what others are sent of this node on the graph topic.

        Returns:
            What ends it.
        """
        # Late: most nodes have no use for it.
        from lifecycle.graph.state import connection_events

        managed = self.lifecycle
        before = managed.configuration_changes.collect()

        def look(after: NodeConfiguration) -> None:
            nonlocal before
            for event in connection_events(before, after) if before is not None else ():
                if inspect.iscoroutinefunction(callback):
                    managed.turns.call_soon(functools.partial(callback, event))
                else:
                    callback(event)
            before = after

        return managed.configuration_changes.listen(look)

    # The factories of rclpy: what they make is gated.

    def create_publisher(
        self, msg_type: Any, topic: str, qos_profile: QoSProfile | int, **options: Any
    ) -> Publisher:
        """As rclpy's; what is published while the node is not active is dropped."""
        publisher = super().create_publisher(msg_type, topic, qos_profile, **options)
        if self._gate is not None:
            gated = GatedPublisher(publisher, self.lifecycle.log.warning)
            self._gated(publisher, gated, EndpointKind.PUBLISHER)
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
            gated = GatedSubscription(subscription, self._gate, self.lifecycle.turns.call_soon)
            self._gated(subscription, gated, EndpointKind.SUBSCRIPTION)
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
            self._gated(timer, GatedTimer(timer, wanted=autostart), None)
        return timer

    def create_client(self, srv_type: Any, srv_name: str, **options: Any) -> Client:
        """As rclpy's, by default in a reentrant group: awaiting it in a callback is safe."""
        if options.get("callback_group") is None:
            options["callback_group"] = self.lifecycle.turns.group
        client = super().create_client(srv_type, srv_name, **options)
        self._gated(client, None, EndpointKind.SERVICE_CLIENT)
        return client

    def create_service(
        self, srv_type: Any, srv_name: str, callback: Callable[..., Any], **options: Any
    ) -> Service:
        """As rclpy's."""
        service = super().create_service(srv_type, srv_name, callback, **options)
        if self._gate is not None:
            self._gated(service, None, EndpointKind.SERVICE_SERVER)
        return service

    def _gated(self, entity: Any, gated: Gated | None, kind: EndpointKind | None) -> None:
        """Put the gate in charge of what a factory made, and report it, until it is destroyed."""
        managed, destroy = self.lifecycle, entity.destroy

        def destroyed() -> None:
            managed.remove(entity)
            destroy()

        entity.destroy = destroyed
        if kind is not None:
            managed.add(kind, Placement(connection=managed.connections.own, entity=entity))
        if gated is not None:
            managed.gate.add(entity, gated)
