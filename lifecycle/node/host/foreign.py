"""Nodes of rclpy's own classes, and whatever a function returns, hosted as planned nodes.

Owns: `Adoption`, which gives the nodes that a class or function of the user's constructs the names,
parameters, remaps and participants of the plan; and `ForeignNode`, one such node: its report, what
holds it before the gate opens, and its transitions where its class is rclpy.lifecycle's.

A plain node is held by its executor, which is not run, and by its publishers: what it publishes is
dropped, as before any subscription is matched, but for the last messages of TRANSIENT_LOCAL, which
are sent once it is released. A node of rclpy.lifecycle runs from the start, since its services must
answer, and its plain publishers are held until it is activated through the gate.
"""

from __future__ import annotations

import collections
import contextlib
import inspect
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NoReturn, Protocol, cast

from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.event_handler import (
    EventHandler,
    QoSPublisherEventType,
    QoSSubscriptionEventType,
)
from rclpy.logging import LoggingSeverity
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from rclpy.serialization import serialize_message
from rclpy.time_source import TimeSource

from lifecycle.errors import BringUpError, LifecycleError
from lifecycle.manifest.model import EndpointKind
from lifecycle.measure.sample import Measured
from lifecycle.middleware.fastdds.nfe import create_subscription
from lifecycle.middleware.rcl.graph_changes import ServerWatch
from lifecycle.middleware.rcl.rclpy_nodes import (
    RCLError,
    RclpyStateMachine,
    Watching,
    is_rclpy_managed,
)
from lifecycle.network.nfe import UniqueRequirement
from lifecycle.node import configuration
from lifecycle.node.author import parameters
from lifecycle.node.author.managed import HostedState, Managed, Undeclared
from lifecycle.node.author.node import LifecycleNode
from lifecycle.node.author.spec import Construction, Mode, constructing, ros_arguments
from lifecycle.node.configuration import ConfigurationChanges
from lifecycle.node.connections.connections import Connection, Connections
from lifecycle.node.connections.data_layer import NodeDataLayer, serve_interface
from lifecycle.node.endpoints.mapping import MatchWatch
from lifecycle.node.lifecycle.gate import CountedSubscription, GatedPublisher, NodeGate
from lifecycle.node.lifecycle.machine import RefusedError
from lifecycle.node.lifecycle.steps import SUCCESS, CallbackOutcome, Result
from lifecycle.plan.model import PlannedEndpoint, PlannedNode
from lifecycle.verify.observation import NodeConfiguration

if TYPE_CHECKING:
    from rclpy.callback_groups import CallbackGroup


_STEADY = ("unconfigured", "inactive", "active", "finalized")
_MATCHED = {
    # Equal numbers of the two types compare equal.
    EndpointKind.PUBLISHER: QoSPublisherEventType.RCL_PUBLISHER_MATCHED,
    EndpointKind.SUBSCRIPTION: QoSSubscriptionEventType.RCL_SUBSCRIPTION_MATCHED,
}
_REACHED = {"configure": "inactive", "deactivate": "inactive", "cleanup": "unconfigured"}
_CONNECTED = ("inactive", "activating", "active", "deactivating")
"""Where a node of rclpy.lifecycle has its data layer, which it makes in on_configure."""


class Spinner(Protocol):
    """What runs the callbacks of nodes: NodeLoop, and NodeInProcess."""

    @property
    def watching(self) -> Watching:
        """Events that its own executor waits for, whether a node is spun or not."""

    def spin(self, node: Node) -> None:
        """Run a node's callbacks from now on."""

    def rest(self, node: Node) -> None:
        """Run no callback of a node that begins from now on."""

    def call_soon(self, task: Callable[..., Any], *arguments: object) -> None:
        """Run a function, sync or async, where callbacks of nodes run."""

    def call_beside(self, task: Callable[[], Any]) -> object:
        """Run a function, sync or async, where `watching` is watched; false after its end."""


class SharedMatch:
    """A matched event that a node's own code handles, and its host needs.

    rmw counts the changes for one handler: two in different executors take them from each other.

    Args:
        node: whose it is.
        event: its own handler.
        group: that the host's executor runs it in.
        watching: has it from now on.
        changed: called for each event.
        forward: has the node's callback called with the status.
    """

    def __init__(
        self,
        node: Node,
        event: EventHandler,
        group: CallbackGroup,
        watching: Watching,
        *,
        changed: Callable[[], None],
        forward: Callable[[Callable[[Any], Any], Any], None],
    ) -> None:
        self._node = node
        self._event = event
        self._watching = watching
        callback = event.callback

        def handle(status: Any) -> None:
            changed()
            forward(callback, status)

        node.remove_waitable(event)
        event.callback = handle
        event.callback_group = group
        watching.add_waitable(event)

    def stop(self) -> None:
        """Wait for it no more: its endpoint is about to be destroyed, by its node."""
        self._watching.remove_waitable(self._event)
        self._node.add_waitable(self._event)


class HeldPublisher(GatedPublisher):
    """A publisher of a node that does not know of the gate.

    What TRANSIENT_LOCAL would keep for late subscriptions is kept, and sent once the gate opens:
    such a node may publish once, in its constructor.
    """

    def __init__(self, publisher: Publisher, warn: Callable[[str], None]) -> None:
        super().__init__(publisher, warn)
        qos = publisher.qos_profile
        self._keeps = qos.durability.name == "TRANSIENT_LOCAL"
        depth = None if qos.history.name == "KEEP_ALL" else qos.depth or 1
        self._kept: collections.deque[Any] = collections.deque(maxlen=depth)

    def open(self) -> None:
        """Publish as rclpy does, first what was kept."""
        super().open()
        while self._kept:
            self._publisher.publish(self._kept.popleft())

    def _drop(self, msg: object) -> None:
        if self._keeps:
            # As it is now: its author may change it later.
            self._kept.append(msg if isinstance(msg, bytes) else serialize_message(msg))
        elif not self._warned:
            self._warned = True
            self._warn(
                f"the gate is closed: what is published on {self._publisher.topic!r} is dropped "
                "until the system is verified"
            )


class ForeignNode:
    """One hosted node of which the class is not ours; it offers the host what `Managed` does.

    Args:
        node: constructed by rclpy so far; its class's constructor may have more to do.
        spec: what it was planned to be.
        supervisor: name of the system whose gate holds it; empty for none.
        spinner: runs its callbacks.

    Attributes:
        configuration_changes: notifies of each change of its configuration.
    """

    def __init__(
        self,
        node: Node,
        spec: PlannedNode,
        *,
        supervisor: str,
        spinner: Spinner,
    ) -> None:
        self._node = node
        self._spec = spec
        self._supervisor = supervisor
        self._spinner = spinner
        self._watching = spinner.watching
        self._group = ReentrantCallbackGroup()
        self._gate = NodeGate()
        self._watches: dict[int, MatchWatch | SharedMatch | ServerWatch] = {}
        self._unspun: dict[Callable[[Any], Any], Any] = {}
        self._connections = Connections(node)
        self._apart: dict[int, Connection] = {}  # by id of what is not on the node's participant
        self._listeners: list[Callable[[Any], None]] = []
        self._let_through = not supervisor
        self._is_spun = False
        self._is_ours = False
        self._is_constructed = False
        self._machine: RclpyStateMachine | None = None
        if spec.managed and is_rclpy_managed(node):
            self._machine = RclpyStateMachine(node, self)
        self.configuration_changes = ConfigurationChanges(
            spinner.call_beside, self.get_configuration, failed=node.get_logger().error
        )
        self._made = Undeclared(self.configuration_changes.touch)
        node.add_post_set_parameters_callback(lambda _: self.configuration_changes.touch())
        if self._let_through:
            self._gate.open()
        self._services = self._serve()

    def _serve(self) -> tuple[Any, ...]:
        """Offer what others know our nodes by; the host answers, also while the node is held."""
        before = set(self._node.services)
        self._is_ours = True
        configuration.serve(self._node, self.get_configuration, self._group)
        # With it a node is known to be one of ours.
        serve_interface(self._node, cast("NodeDataLayer", self), self._group, "map_to")
        self._is_ours = False
        services = tuple(each for each in self._node.services if each not in before)
        self._watching.take_services(self._node, services)
        return services

    @property
    def full_name(self) -> str:
        """Fully qualified node name."""
        return str(self._node.get_fully_qualified_name())

    @property
    def spec(self) -> PlannedNode:
        """What it was planned to be."""
        return self._spec

    @property
    def reported(self) -> HostedState:
        """Its state; a plain node has none, nor has one whose constructor still runs."""
        if self._machine is None or not self._is_constructed:
            return HostedState(label="", connected=True, steady=True)
        label = self._machine.label
        return HostedState(label=label, connected=label in _CONNECTED, steady=label in _STEADY)

    def add_listener(self, listener: Callable[[Any], None]) -> None:
        """Call `listener(self)` after every change of state, whatever caused it."""
        self._listeners.append(listener)

    # What its class makes.

    def made(self, kind: EndpointKind, entity: Any) -> None:
        """Note an endpoint, hold it if it publishes, and watch who is matched with it."""
        if self._is_ours:
            return
        callback = getattr(entity, "callback", None) if kind is EndpointKind.SUBSCRIPTION else None
        if isinstance(getattr(callback, "__self__", None), TimeSource):
            return  # /clock belongs to rclpy
        if kind is EndpointKind.PUBLISHER:
            self._gate.add(entity, HeldPublisher(entity, self._node.get_logger().warning))
        elif kind is EndpointKind.SUBSCRIPTION:
            self._gate.add(entity, CountedSubscription(entity))
        touch = self.configuration_changes.touch
        if kind.is_topic:
            # In the host's executor: the node's own need not run.
            self._watches[id(entity)] = self._match_watch(kind, entity)
        elif kind in (EndpointKind.SERVICE_CLIENT, EndpointKind.ACTION_CLIENT):
            self._watches[id(entity)] = ServerWatch(self._node, entity, touch)
        self._made.add(kind, entity)

    def _match_watch(self, kind: EndpointKind, entity: Any) -> MatchWatch | SharedMatch:
        touch = self.configuration_changes.touch
        for event in entity.event_handlers:
            if event.event_type == _MATCHED[kind]:
                return SharedMatch(
                    self._node,
                    event,
                    self._group,
                    self._watching,
                    changed=touch,
                    forward=self._forward,
                )
        sink: Any = self._watching
        return MatchWatch(sink, entity, self._group, lambda _: touch())

    def _forward(self, callback: Callable[[Any], Any], status: Any) -> None:
        """Have a callback of its own called; while it is not spun, the last time once it is."""
        if self._is_spun:
            self._spinner.call_soon(callback, status)
        else:
            self._unspun[callback] = status

    def _spin(self) -> None:
        self._is_spun = True
        self._spinner.spin(self._node)
        for callback, status in self._unspun.items():
            self._spinner.call_soon(callback, status)
        self._unspun.clear()

    def make(self, kind: EndpointKind, given: Mapping[str, Any]) -> Any:
        """Make a planned endpoint with a flow of its own, as its factory was asked for it.

        Returns:
            None for what rclpy is to make.

        Raises:
            LifecycleError: its participant or its flow cannot be made.
        """
        planned = self._planned(kind, given.get("topic"))
        if planned is None or given.get("qos_overriding_options") is not None:
            return None
        carrier = next(
            (each for each in self._spec.participants if each.name == planned.participant), None
        )
        qos = given["qos_profile"]
        options: dict[str, Any] = {
            "callback_group": given.get("callback_group"),
            "event_callbacks": given.get("event_callbacks"),
        }
        if kind is EndpointKind.SUBSCRIPTION:
            options |= {"unique": planned.unique, "raw": given.get("raw", False)}
        elif "publisher_class" in given:
            options["publisher_class"] = given["publisher_class"]
        profile = QoSProfile(depth=qos) if isinstance(qos, int) else qos
        called: tuple[Any, ...] = (profile,)
        if kind is EndpointKind.SUBSCRIPTION:
            called = (given["callback"], profile)
        if carrier is None:
            if kind is EndpointKind.PUBLISHER:
                return None  # no RMW makes one unique on a participant that others use
            make: Callable[..., Any] = create_subscription
            return make(self._node, given["msg_type"], given["topic"], *called, **options)
        connection = self._connections.carrier(carrier)
        assert connection.participant is not None
        make = connection.participant.create_publisher
        if kind is EndpointKind.SUBSCRIPTION:
            make = connection.participant.create_subscription
        entity = make(given["msg_type"], planned.resolved, *called, **options)
        self._apart[id(entity)] = connection
        for event in entity.event_handlers:
            self._node.add_waitable(event)
        return entity

    def _planned(self, kind: EndpointKind, topic: object) -> PlannedEndpoint | None:
        """Return what is planned of an endpoint, if it is more than rclpy does."""
        wanted = [
            each
            for each in self._spec.endpoints
            if each.kind is kind
            and (each.participant or each.unique is not UniqueRequirement.NOT_REQUIRED)
        ]
        if not wanted or not isinstance(topic, str):
            return None
        resolved = self._node.resolve_topic_name(topic)
        return next((each for each in wanted if each.resolved == resolved), None)

    def removed(self, entity: Any) -> None:
        """Forget an endpoint that is about to be destroyed."""
        connection = self._apart.pop(id(entity), None)
        if connection is not None and connection.participant is not None:
            for event in entity.event_handlers:
                self._node.remove_waitable(event)
            if isinstance(entity, Publisher):
                connection.participant.destroy_endpoint(entity)
        watch = self._watches.pop(id(entity), None)
        if watch is not None:
            watch.stop()
        self._gate.remove(entity)
        self._made.remove(entity)

    def constructed(self) -> None:
        """Its class's constructor has returned: hold it, or have it spun."""
        if self._spec.log_level:
            self._node.get_logger().set_level(LoggingSeverity[self._spec.log_level.upper()])
        self._is_constructed = True
        if self._machine is not None:
            self._machine.complete()
        if self._machine is not None or self._let_through:
            self._spin()

    # What its host asks of it.

    def get_configuration(self) -> NodeConfiguration:
        """Return its identity and its endpoints as they are."""
        reported, own = self.reported, self._connections.own
        endpoints, connections = configuration.foreign_reports(
            self._node,
            self._spec,
            self._connections,
            (
                (kind, entity, self._apart.get(id(entity), own))
                for kind, entity in self._made.beside(())
            ),
        )
        return configuration.collect(
            self._node,
            reported.label,
            connected=reported.connected,
            endpoints=endpoints,
            connections=connections,
            measured=self._gate.measured(),
        )

    def measured(self) -> Measured | None:
        """Return what has arrived since it was let through; None while it is held. Any thread."""
        return self._gate.measured()

    @property
    def is_marked(self) -> bool:
        """Whether the plan says what DSCP any of its endpoints sends with."""
        return any(each.dscp is not None for each in self._spec.endpoints)

    @property
    def marks(self) -> tuple[int | None, ...]:
        """DSCP on the sender sockets of its participants, as it is now."""
        return self._connections.marks

    def close(self) -> None:
        """Take its further participants away: it is being destroyed."""
        for watch in self._watches.values():
            watch.stop()
        self._watches.clear()
        self._watching.drop_services(self._services)
        self._connections.close_all()

    def destroyed(self) -> None:
        """The node was destroyed, in a process that goes on."""
        if self._machine is not None:
            self._machine.destroy()

    @property
    def interface(self) -> Any:
        """Raise: it has no node interface; see `map_to`."""
        self.map_to("", "")

    def map_to(self, endpoint: str, connection: str) -> NoReturn:
        """Raise: its own code makes its endpoints.

        Raises:
            LifecycleError: always.
        """
        del endpoint, connection
        raise LifecycleError(
            f"cannot move the endpoints of {self.full_name}: its class is not a "
            "lifecycle.LifecycleNode, and makes them itself",
            hint="subclass lifecycle.LifecycleNode, or write data_layer.authority: nodes",
        )

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
        succeeded = False
        self._release()  # its on_activate may publish
        limit_s = self._spec.timeouts.activate_s
        began_s = time.monotonic()
        try:
            result = self._transition("activate")
            took_s = time.monotonic() - began_s
            if result.outcome is CallbackOutcome.SUCCESS and took_s >= limit_s:
                # Nobody waits for it any more.
                self._transition("deactivate")
                why = (
                    f"cannot accept {self.full_name}: on_activate blocked for {took_s:.1f} s, its "
                    f"deadline is {limit_s:g} s"
                )
                self.complain(why)
                return Result(outcome=CallbackOutcome.ERROR, error=why)
            succeeded = result.outcome is CallbackOutcome.SUCCESS
            return result
        finally:
            if not succeeded:
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

    # What its state machine asks and notifies (middleware's MachineOwner).

    def is_driven(self) -> bool:
        """Whether a supervisor drives it."""
        return bool(self._supervisor)

    def may_activate(self) -> bool:
        """Whether its supervisor has let it through."""
        return self._let_through

    def state_changed(self) -> None:
        """Notify the listeners; what leaves the data layer behind is not what was verified."""
        if self._supervisor and self.reported.label in ("unconfigured", "finalized"):
            self._let_through = False
            self._gate.close()
        for listener in self._listeners:
            listener(self)

    def complain(self, text: str) -> None:
        """Log it."""
        self._node.get_logger().error(text)

    def _release(self) -> None:
        self._let_through = True
        self._gate.open()
        if self._machine is None:
            self._spin()

    def _hold(self) -> None:
        self._let_through = False
        self._gate.close()
        if self._machine is None:
            self._is_spun = False
            self._spinner.rest(self._node)

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
        self.complain(why)
        return Result(outcome=outcome, error=why)


Hosted = Managed | ForeignNode
"""What a host knows of one of its nodes."""

Carrying = Callable[[PlannedNode], contextlib.AbstractContextManager[Any]]


class Adoption:
    """Makes nodes of the user's classes and functions, each as one planned node.

    Args:
        carrying: yields the context that a planned node is to be constructed on.
        spinner: runs the callbacks of nodes that are not ours.
        supervisor: name of the system whose gate holds the nodes; empty for none.
        use_global_arguments: nodes take remaps from the process's own --ros-args.

    Attributes:
        made: rclpy node by key of the plan, with its ForeignNode unless it is one of ours.
    """

    def __init__(
        self,
        carrying: Carrying,
        spinner: Spinner,
        *,
        supervisor: str = "",
        mode: Mode | None = Mode.MANUAL,
        use_global_arguments: bool = False,
    ) -> None:
        self._carrying = carrying
        self._spinner = spinner
        self._supervisor = supervisor
        self._mode = mode
        self._use_global_arguments = use_global_arguments
        self._waiting: list[PlannedNode] = []
        self._current: PlannedNode | None = None
        self._taken: PlannedNode | None = None
        self._foreign: dict[int, ForeignNode] = {}
        self.made: dict[str, tuple[Node, ForeignNode | None]] = {}

    def make(
        self, planned: PlannedNode, group: Sequence[PlannedNode], what: Callable[..., Any]
    ) -> tuple[tuple[str, Any, Hosted], ...]:
        """Construct a planned node, and those of its group that the same call makes.

        Args:
            planned: the node that is to be made.
            group: all that `what` may make, `planned` among them.
            what: the class or function.

        Returns:
            Key of the plan, rclpy node and what stands for it, of what was made.

        Raises:
            LifecycleError: something else was made. What the class or function raises passes.
        """
        before = set(self.made)
        self._waiting = [each for each in group if each.key not in self.made]
        self._current = planned
        try:
            with constructing(self):
                returned = what(**keywords(planned, what))
        finally:
            self._waiting, self._current = [], None
        self._check(planned, what, returned)
        made: list[tuple[str, Any, Hosted]] = []
        for key, (node, foreign) in tuple(self.made.items()):
            if key in before:
                continue
            if foreign is not None:
                foreign.constructed()
            made.append((key, node, foreign or cast("LifecycleNode", node).lifecycle))
        return tuple(made)

    def _check(self, planned: PlannedNode, what: Callable[..., Any], returned: object) -> None:
        reference = planned.run.python
        nodes = [each for each in _each(returned) if isinstance(each, Node)]
        if planned.key not in self.made:
            names = ", ".join(each.get_fully_qualified_name() for each in nodes) or repr(returned)
            raise BringUpError(
                f"cannot use {reference!r}: it made {names}, and no node for {planned.full_name}",
                hint="return the node, or a list of nodes; the host spins them",
            )
        known = {id(node) for node, _ in self.made.values()}
        for each in nodes:
            if id(each) not in known:
                name = each.get_fully_qualified_name()
                raise BringUpError(
                    f"cannot host {name}, which {reference!r} returns: no node is declared for it "
                    f"beside {planned.full_name}",
                    hint=f"add a node of that name with the same `run:` and `process: "
                    f"{planned.process}`",
                )
        if not isinstance(what, type) and not nodes:
            raise BringUpError(
                f"cannot use {reference!r}: it returns {returned!r} and must return its nodes",
                hint="it must neither spin nor destroy them: the host does",
            )

    # What constructors ask: LifecycleNode's by author/spec.py, all others by middleware's hooks.

    def take(self, name: str, namespace: str | None) -> Construction | None:
        """Return the construction of a LifecycleNode that is about to be made."""
        planned = self._take(name, namespace)
        if planned is None:
            return None
        self._taken = planned
        return Construction(
            spec=planned,
            mode=self._mode,
            use_global_arguments=self._use_global_arguments,
            # Of a plain node no states are driven.
            supervisor=self._supervisor if planned.managed else "",
        )

    @contextlib.contextmanager
    def constructing(
        self, node: Node, name: str, options: dict[str, Any]
    ) -> Iterator[tuple[str, dict[str, Any]]]:
        """Have rclpy construct a node as planned; one that is not planned is not touched."""
        ours = isinstance(node, LifecycleNode)
        planned = self._taken if ours else self._take(name, options.get("namespace"))
        self._taken = None
        if planned is None:
            yield name, options
            return
        refuse_unmanaged(planned, type(node))
        if not ours:
            name, options = planned.name, self._options(planned, options)
            parameters.give_empty_arrays(node, planned)
        with self._carrying(planned) as context:
            yield name, {**options, "context": context}
        foreign = None
        if not (ours and planned.managed):
            foreign = ForeignNode(node, planned, supervisor=self._supervisor, spinner=self._spinner)
            self._foreign[id(node)] = foreign
        self.made[planned.key] = (node, foreign)

    def make_endpoint(self, node: Node, kind: EndpointKind, arguments: Mapping[str, Any]) -> Any:
        """Make an endpoint that is planned otherwise than rclpy would make it; else None."""
        foreign = self._foreign.get(id(node))
        return None if foreign is None else foreign.make(kind, arguments)

    def node_removed(self, node: Node) -> None:
        """A node is about to be destroyed."""
        foreign = self._foreign.pop(id(node), None)
        if foreign is not None:
            foreign.close()

    def endpoint_made(self, node: Node, kind: EndpointKind, entity: Any) -> None:
        """An endpoint of a node exists now."""
        foreign = self._foreign.get(id(node))
        if foreign is not None:
            foreign.made(kind, entity)

    def endpoint_removed(self, node: Node, entity: Any) -> None:
        """An endpoint of a node is about to be destroyed."""
        foreign = self._foreign.get(id(node))
        if foreign is not None:
            foreign.removed(entity)

    def _take(self, name: str, namespace: str | None) -> PlannedNode | None:
        """Choose whose construction this is: by name among the group, else the one asked for."""
        full = f"/{(namespace or '').strip('/')}/{name}".replace("//", "/")
        chosen = (
            next((each for each in self._waiting if each.full_name == full), None)
            or next((each for each in self._waiting if each.name == name), None)
            or next((each for each in self._waiting if each is self._current), None)
        )
        if chosen is not None:
            self._waiting.remove(chosen)
        return chosen

    def _options(self, planned: PlannedNode, options: dict[str, Any]) -> dict[str, Any]:
        given = options.get("parameter_overrides") or ()
        return {
            **options,
            "namespace": planned.namespace,
            "cli_args": [*ros_arguments(planned), *(options.get("cli_args") or ())],
            "parameter_overrides": [*given, *parameters.overrides(planned)],
            "use_global_arguments": self._use_global_arguments,
        }


def refuse_unmanaged(planned: PlannedNode, node_class: type) -> None:
    """Raise unless a class can be what the plan says.

    Raises:
        LifecycleError: it is to be managed, and knows nothing of that.
    """
    known = issubclass(node_class, LifecycleNode) or is_rclpy_managed(node_class)
    if planned.managed and not known:
        raise LifecycleError(
            f"cannot manage {planned.full_name}: {planned.run.python!r} makes a plain node, a "
            f"{node_class.__name__}",
            hint="say `managed: false`, or subclass lifecycle.LifecycleNode",
        )


def keywords(planned: PlannedNode, what: Callable[..., Any]) -> dict[str, Any]:
    """Return what a class or function is called with; one that needs a `node_name` gets it."""
    keywords = {
        name: list(value) if isinstance(value, tuple) else value
        for name, value in planned.run.arguments
    }
    if _needs(what, "node_name"):
        keywords.setdefault("node_name", planned.name)
    return keywords


def _needs(what: Callable[..., Any], name: str) -> bool:
    """Return whether what is called so has a parameter of this name without a default."""
    wanted = inspect.signature(what).parameters.get(name)
    named = (inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY)
    return wanted is not None and wanted.default is wanted.empty and wanted.kind in named


def _each(returned: object) -> Iterable[object]:
    if isinstance(returned, (list, tuple, set, frozenset)):
        return returned
    return (returned,)
