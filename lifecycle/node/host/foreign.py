"""One hosted node of rclpy's own classes: its report, what holds it, and its transitions.

A plain node is held by its executor, which is not run, and by its publishers: what it publishes is
dropped, as before any subscription is matched, but for the last messages of TRANSIENT_LOCAL, which
are sent once it is released. A node of rclpy.lifecycle runs from the start, since its services must
answer, and its plain publishers are held until it is activated through the gate.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

from msgspec.structs import replace
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.event_handler import QoSPublisherEventType, QoSSubscriptionEventType
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from rclpy.time_source import TimeSource

from lifecycle.errors import LifecycleError
from lifecycle.manifest.model import EndpointKind
from lifecycle.middleware.rcl.graph_queries import watch_server
from lifecycle.middleware.rcl.rclpy_nodes import (
    RCLError,
    RclpyStateMachine,
    follow_goals,
    is_rclpy_managed,
)
from lifecycle.network.nfe import UniqueRequirement
from lifecycle.node import configuration
from lifecycle.node.callbacks import SUCCESS, CallbackOutcome, Result
from lifecycle.node.configuration import HostedState
from lifecycle.node.connections import Connection, Connections
from lifecycle.node.endpoint import CLIENTS, Endpoint, Placement, factory, watch_matches
from lifecycle.node.gate import GatedSubscription, HeldPublisher
from lifecycle.node.machine import RefusedError
from lifecycle.node.managed import NodeInHost
from lifecycle.node.services import serve_interface
from lifecycle.plan.model import PlannedEndpoint, PlannedNode
from lifecycle.verify.observation import NodeConfiguration

if TYPE_CHECKING:
    from lifecycle.node.data_layer import DataLayer
    from lifecycle.node.host.loop import NodeLoop


_STEADY = ("unconfigured", "inactive", "active", "finalized")
_MATCHED = {
    # Equal numbers of the two types compare equal.
    EndpointKind.PUBLISHER: QoSPublisherEventType.RCL_PUBLISHER_MATCHED,
    EndpointKind.SUBSCRIPTION: QoSSubscriptionEventType.RCL_SUBSCRIPTION_MATCHED,
}
_OPTIONS = ("callback_group", "event_callbacks", "publisher_class", "raw")
"""Of rclpy's factories, which those of other participants take, too."""
_REACHED = {"configure": "inactive", "deactivate": "inactive", "cleanup": "unconfigured"}
_CONNECTED = ("inactive", "activating", "active", "deactivating")
"""Where a node of rclpy.lifecycle has its data layer, which it makes in on_configure."""


class ForeignNode(NodeInHost):
    """One hosted node of which the class is not ours; it offers the host what `Managed` does.

    Args:
        node: constructed by rclpy so far; its class's constructor may have more to do.
        loop: runs its callbacks.

    Attributes:
        connections: its participants.
    """

    def __init__(self, node: Node, spec: PlannedNode, *, supervisor: str, loop: NodeLoop) -> None:
        super().__init__(node, spec, supervisor, loop.call_beside, self.get_configuration)
        self._loop = loop
        self._watching = loop.watching
        self._group = ReentrantCallbackGroup()
        self._unspun: dict[Callable[[Any], Any], Any] = {}
        self.connections = Connections(node, spec.participants)
        self._is_spun = False
        self._is_constructed = False
        self._machine: RclpyStateMachine | None = None
        if spec.managed and is_rclpy_managed(node):
            self._machine = RclpyStateMachine(
                node,
                is_driven=bool(supervisor),
                may_activate=self.may_activate,
                changed=self.state_changed,
            )
        if self._let_through:
            self.gate.open()
        self._services = self._serve()

    def _serve(self) -> tuple[Any, ...]:
        """Offer what others know our nodes by; the host answers, also while the node is held."""
        before = set(self.node.services)
        configuration.serve(self.node, self.get_configuration, self._group)
        # With it a node is known to be one of ours.
        serve_interface(self.node, {"map_to": lambda _: self.data_layer}, self._group)
        services = tuple(each for each in self.node.services if each not in before)
        self._watching.take_services(self.node, services)
        return services

    @property
    def reported(self) -> HostedState:
        """Its state; a plain node has none, nor one whose constructor runs, or is destroyed."""
        if self._machine is None or not self._is_constructed or self.is_destroyed:
            return HostedState(label="", connected=True, steady=True)
        label = self._machine.label
        return HostedState(label=label, connected=label in _CONNECTED, steady=label in _STEADY)

    # What its class makes.

    def made(self, kind: EndpointKind, entity: Any, connection: Connection | None = None) -> None:
        """Note an endpoint, hold it if it publishes, and watch who is matched with it."""
        callback = getattr(entity, "callback", None) if kind is EndpointKind.SUBSCRIPTION else None
        if isinstance(getattr(callback, "__self__", None), TimeSource):
            return  # /clock belongs to rclpy
        if kind is EndpointKind.PUBLISHER:
            self.gate.add(entity, HeldPublisher(entity, self.log.warning))
        elif kind is EndpointKind.SUBSCRIPTION:
            self.gate.add(entity, GatedSubscription(entity, self.gate))
        unwatch: Callable[[], None] | None = None
        if kind.is_topic:
            unwatch = self._watch_matches(kind, entity)
        elif kind in CLIENTS:
            unwatch = watch_server(self.node, entity, self.configuration_changes.touch)
        placement = Placement(
            connection=connection or self.connections.own, entity=entity, unwatch=unwatch
        )
        endpoint = self.add(kind, placement)
        if kind is EndpointKind.ACTION_SERVER:
            follow_goals(entity, functools.partial(self.note_fault, endpoint))

    def _watch_matches(self, kind: EndpointKind, entity: Any) -> Callable[[], None]:
        """Watch in the host's executor, for the node's own need not run; returns what ends that."""
        watching: Any = self._watching
        touch = self.configuration_changes.touch
        event = next((e for e in entity.event_handlers if e.event_type == _MATCHED[kind]), None)
        if event is None:
            return watch_matches(watching, entity, self._group, touch)
        # rmw counts the changes for one handler: two would take them from each other.
        callback = event.callback

        def handle(status: Any) -> None:
            touch()
            self._forward(callback, status)

        def stop() -> None:
            watching.remove_waitable(event)
            self.node.add_waitable(event)

        self.node.remove_waitable(event)
        event.callback, event.callback_group = handle, self._group
        watching.add_waitable(event)
        return stop

    def _forward(self, callback: Callable[[Any], Any], status: Any) -> None:
        """Have a callback of its own called; while it is not spun, the last time once it is."""
        if self._is_spun:
            self._loop.call_soon(callback, status)
        else:
            self._unspun[callback] = status

    def _spin(self) -> None:
        self._is_spun = True
        self._loop.spin(self.node)
        for callback, status in self._unspun.items():
            self._loop.call_soon(callback, status)
        self._unspun.clear()

    def make(self, kind: EndpointKind, given: Mapping[str, Any]) -> Any:
        """Make a planned endpoint with a flow of its own; None for what rclpy is to make."""
        planned = self._planned(kind, given.get("topic"))
        if planned is None or given.get("qos_overriding_options") is not None:
            return None
        publishes = kind is EndpointKind.PUBLISHER
        connection = self.connections.planned(planned.participant)
        if connection.participant is None and publishes:
            return None  # no RMW makes one unique on a participant that others use
        qos = given["qos_profile"]
        profile = QoSProfile(depth=qos) if isinstance(qos, int) else qos
        called = (profile,) if publishes else (given["callback"], profile)
        options = {name: given[name] for name in _OPTIONS if name in given}
        topic = given["topic"] if connection.participant is None else planned.resolved
        create = factory(planned, connection, self.node)
        entity = create(given["msg_type"], topic, *called, **options)
        self.made(kind, entity, connection)
        return entity

    def _planned(self, kind: EndpointKind, topic: object) -> PlannedEndpoint | None:
        """Return what is planned of an endpoint, if it is more than rclpy does."""
        wanted = [
            each
            for each in self.spec.endpoints
            if each.kind is kind
            and (each.participant or each.unique is not UniqueRequirement.NOT_REQUIRED)
        ]
        if not wanted or not isinstance(topic, str):
            return None
        resolved = self.node.resolve_topic_name(topic)
        return next((each for each in wanted if each.resolved == resolved), None)

    def removed(self, entity: Any) -> None:
        """Forget an endpoint that is about to be destroyed."""
        placement = self.remove(entity)
        if placement is None:
            return
        if placement.unwatch is not None:
            placement.unwatch()
        if isinstance(entity, Publisher) and placement.connection.participant is not None:
            placement.connection.participant.destroy_endpoint(entity)

    def constructed(self) -> None:
        """Its class's constructor has returned: hold it, or have it spun."""
        self._is_constructed = True
        if self._machine is not None:
            self._machine.complete()
        if self._machine is not None or self._let_through:
            self._spin()

    # What its host asks of it.

    def get_configuration(self) -> NodeConfiguration:
        """Return its identity and its endpoints as they are."""
        declared = {(each.kind, each.resolved): each for each in self.spec.endpoints}
        endpoints: list[Endpoint] = []
        for each in tuple(self.found.values()):
            planned = declared.pop((each.kind, each.planned.resolved), None)
            if planned is not None:
                each.planned = replace(
                    each.planned,
                    name=planned.name,
                    unique=planned.unique,
                    enforce_dscp=planned.enforce_dscp,
                )
            endpoints.append(each)
        endpoints += [Endpoint(planned=each) for each in declared.values()]
        return configuration.collect(self, endpoints)

    @property
    def data_layer(self) -> DataLayer:
        """What maps the endpoints of our nodes; raises LifecycleError, for it makes them itself."""
        raise LifecycleError(
            f"cannot move the endpoints of {self.full_name}: its class is not a "
            "lifecycle.LifecycleNode, and makes them itself",
            hint="subclass lifecycle.LifecycleNode, or write data_layer.authority: nodes",
        )

    def close(self) -> None:
        """Take its further participants away: it is being destroyed."""
        for each in tuple(self.found.values()):
            if each.placement is not None and each.placement.unwatch is not None:
                each.placement.unwatch()
        self.found.clear()  # rclpy is about to destroy them
        self._watching.drop_services(self._services)
        self.connections.close_all()

    def destroyed(self) -> None:
        """The node was destroyed, in a process that goes on."""
        if self._machine is not None:
            self._machine.destroy()

    async def change_for_supervisor(self, operation: str) -> Result:
        """Do what the supervisor asked for; its activate is the gate's permit.

        Raises:
            RefusedError: not possible in its state.
        """
        if operation == "activate":
            return self._activate_for_supervisor()
        try:
            return self._transition(operation)
        finally:
            if operation == "deactivate":
                self._hold()

    def _activate_for_supervisor(self) -> Result:
        """Activate it, let through by the gate; what does not succeed leaves the gate closed."""
        if self.reported.label == "active" and self._let_through and self._machine is not None:
            return self._transition("activate")  # refused, and it stays as it is
        result: Result | None = None
        self._release()  # its on_activate may publish
        limit_s = self.spec.timeouts.activate_s
        began_s = time.monotonic()
        try:
            result = self._transition("activate")
            took_s = time.monotonic() - began_s
            if result.outcome is CallbackOutcome.SUCCESS and took_s >= limit_s:
                why = (
                    f"cannot accept {self.full_name}: on_activate blocked for {took_s:.1f} s, its "
                    f"deadline is {limit_s:g} s"
                )
                result = Result(outcome=CallbackOutcome.ERROR, error=why)
                self.log.error(why)
                self._transition("deactivate")  # nobody waits for it any more
            return result
        finally:
            if result is None or result.outcome is not CallbackOutcome.SUCCESS:
                self._hold()

    async def bring_up(self) -> Result:
        """Configure and activate without a supervisor; stops at what does not succeed."""
        result = SUCCESS
        for operation in ("configure", "activate"):
            result = self._transition(operation)
            if result.outcome is not CallbackOutcome.SUCCESS:
                break
        return result

    async def shut_down(self, reason: str) -> Result:  # noqa: ARG002 - as Managed's
        """Bring it to finalized, where it has states."""
        if self._machine is None or not self.reported.steady:
            return SUCCESS
        return SUCCESS if self._machine.label == "finalized" else self._transition("shutdown")

    # What its state machine asks and notifies.

    def may_activate(self) -> bool:
        """Whether its supervisor has let it through."""
        return self._let_through

    def state_changed(self) -> None:
        """Notify the listeners; what leaves the data layer behind is not what was verified."""
        if self._supervisor and self.reported.label in ("unconfigured", "finalized"):
            self._let_through = False
            self.gate.close()
        for listener in self.listeners:
            listener(self)

    def _release(self) -> None:
        self._let_through = True
        self.gate.open()
        if self._machine is None:
            self._spin()

    def _hold(self) -> None:
        self._let_through = False
        self.gate.close()
        if self._machine is None:
            self._is_spun = False
            self._loop.rest(self.node)

    def _transition(self, operation: str) -> Result:
        """Run one of its transitions; what its class knows nothing of succeeds at once."""
        if self._machine is None or operation in ("connect", "disconnect"):
            return SUCCESS
        before = self._machine.label
        if before == _REACHED.get(operation):
            return SUCCESS  # its own code, or another client, was faster
        try:
            returned = self._machine.change(operation)
        except RCLError as error:
            raise RefusedError(f"cannot {operation} in state {before!r}") from error
        outcome = CallbackOutcome[returned.name]
        if outcome is CallbackOutcome.SUCCESS:
            return SUCCESS
        why = f"{self.full_name}: on_{operation} returned {returned.name}"
        self.log.error(why)
        return Result(outcome=outcome, error=why)
