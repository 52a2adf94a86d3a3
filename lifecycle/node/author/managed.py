"""The managed half of a LifecycleNode (`node.lifecycle`): controller, gate, data layer, services.

Owns: putting controller, gate, data layer, parameters, timers and services of one node together;
its reporter to the ROS graph, whose publisher must work in every state, so that it does not pass
the gate; and the endpoints that code makes with rclpy's own factories, which are on no
interface, so that the node configuration can report them. It is reached as `node.lifecycle`, so
that authors have every other attribute name to themselves.
"""

from __future__ import annotations

import traceback
from collections.abc import Callable, Collection
from typing import TYPE_CHECKING, Any

import msgspec
from rclpy.exceptions import InvalidHandle
from rclpy.lifecycle import LifecycleState
from rclpy.node import Node
from rclpy.task import Future
from rclpy.timer import Timer

from lifecycle.errors import LifecycleError
from lifecycle.manifest.model import EndpointKind, Health
from lifecycle.measure.sample import Measured
from lifecycle.node import configuration
from lifecycle.node.author import parameters
from lifecycle.node.author.declaring import DeclaredInCode
from lifecycle.node.author.handlers import alternatives
from lifecycle.node.author.spec import Mode
from lifecycle.node.configuration import ConfigurationChanges
from lifecycle.node.connections.connection_status import (
    ConnectionEvents,
)
from lifecycle.node.connections.data_layer import NodeDataLayer, serve_interface
from lifecycle.node.endpoints.mapping import wire_name
from lifecycle.node.lifecycle.gate import NodeGate
from lifecycle.node.lifecycle.health import HealthCheck
from lifecycle.node.lifecycle.machine import (
    Machine,
    NodeState,
    RefusedError,
    StateChange,
    TransitionRequest,
)
from lifecycle.node.lifecycle.services import LifecycleServices, Turns
from lifecycle.node.lifecycle.steps import SUCCESS, CallbackOutcome, Result
from lifecycle.plan.model import PlannedNode
from lifecycle.verify.observation import NodeConfiguration

if TYPE_CHECKING:
    from lifecycle.graph.reporter import GraphReporter


class Undeclared:
    """The endpoints that the code of one node made by itself.

    Args:
        changed: called when one is made or destroyed.
    """

    def __init__(self, changed: Callable[[], None]) -> None:
        self._changed = changed
        self._made: dict[int, tuple[EndpointKind, Any]] = {}

    def add(self, kind: EndpointKind, entity: Any) -> None:
        """Note one that rclpy's factory returned; those of the data layer are sorted out later."""
        self._made[id(entity)] = (kind, entity)
        self._changed()

    def remove(self, entity: Any) -> None:
        """Forget one that is being destroyed."""
        if self._made.pop(id(entity), None) is not None:
            self._changed()

    def beside(self, declared: Collection[Any]) -> tuple[tuple[EndpointKind, Any], ...]:
        """Return (kind, rclpy object) of those that belong to no declared endpoint."""
        known = {id(each) for each in declared}
        found = []
        for key, (kind, entity) in tuple(self._made.items()):
            if key in known:
                continue
            try:
                wire_name(entity)
            except InvalidHandle:
                del self._made[key]  # destroyed behind its node's back
                continue
            found.append((kind, entity))
        return tuple(found)


_WITHOUT_DATA_LAYER = (NodeState.INACTIVE_DISCONNECTED, NodeState.UNCONFIGURED, NodeState.FINALIZED)
"""A node that enters one of these is not the one that was verified any more."""


class HostedState(msgspec.Struct, frozen=True, kw_only=True):
    """The state of a hosted node.

    Attributes:
        label: lifecycle_msgs/State label; empty for a node that is not managed.
        connected: its data layer is made.
        steady: no transition is running.
    """

    label: str
    connected: bool
    steady: bool


BRING_UP = (TransitionRequest.CONFIGURE, TransitionRequest.CONNECT, TransitionRequest.ACTIVATE)


class Managed:
    """The managed half of one node.

    Attributes:
        mode: what drives the transitions.
        gate: holds back what the node was made to send, receive and time.
        data_layer: its endpoints.
        declared: what its manifest and its code say of them.
        connection_events: what becomes of its connections and mappings.
        configuration_changes: notifies of each change of its configuration.
        undeclared: endpoints that its code made with rclpy's factories.
        client_group: reentrant, of its clients.
        call_soon: runs a function, sync or async, in its executor; returns whether there is one.
    """

    def __init__(
        self,
        node: Node,
        spec: PlannedNode,
        mode: Mode,
        gate: NodeGate,
        supervisor: str = "",
        *,
        served: bool = True,
        health: Callable[[], Any] | None = None,
    ) -> None:
        self._node = node
        self._supervisor = supervisor
        # By its supervisor, through the gate; a node without one needs no permission.
        self._let_through = not supervisor
        self.mode = mode
        self.gate = gate
        self._turns = Turns(node)
        self.client_group = self._turns.group
        self.call_soon = self._turns.call_soon
        self._listeners: list[Callable[[Managed], None]] = []
        self._method_timers: list[Timer] = []
        self._reporter: GraphReporter | None = None
        self.connection_events = ConnectionEvents(self.call_soon)
        self.configuration_changes = ConfigurationChanges(
            self.call_soon, self.get_configuration, failed=node.get_logger().error
        )
        self._health = HealthCheck(
            health,
            self._turns,
            spec.health or Health(),
            changed=self.configuration_changes.touch,
            failed=node.get_logger().error,
        )
        node.add_post_set_parameters_callback(lambda _: self.configuration_changes.touch())
        self.undeclared = Undeclared(self.configuration_changes.touch)
        self.data_layer = NodeDataLayer(
            node,
            gate,
            self._turns,
            state=lambda: self.state,
            changed=self.configuration_changes.touch,
            notify=self.connection_events.notify,
        )
        self.declared = DeclaredInCode(node, spec, self.data_layer, lambda: self.state)
        self._machine = Machine(self, spec.timeouts)
        self._services: LifecycleServices | None = None
        if served:
            self._services = LifecycleServices(
                node,
                state_machine=self._machine,
                change=self._change_by_service,
                refuse=node.get_logger().warning,
                group=self._turns.group,
            )
            configuration.serve(node, self.get_configuration, self._turns.group)
            serve_interface(node, self.data_layer, self._turns.group)
        if spec.events or spec.membership:
            self._join()

    @property
    def full_name(self) -> str:
        """Fully qualified node name."""
        return str(self._node.get_fully_qualified_name())

    @property
    def spec(self) -> PlannedNode:
        """What the node was planned to be, with the endpoints that its code declares."""
        return self.declared.spec

    @property
    def state(self) -> NodeState:
        """The state, nested ones distinguished; `state.seen` is what other tools see."""
        return self._machine.state

    @property
    def interface(self) -> NodeDataLayer:
        """What a supervisor may ask of its data layer."""
        return self.data_layer

    @property
    def reported(self) -> HostedState:
        """The state, as it is reported to a supervisor."""
        state = self.state
        return HostedState(label=state.seen.label, connected=state.connected, steady=state.steady)

    def add_listener(self, listener: Callable[[Managed], None]) -> None:
        """Call `listener(self)` after every change of state, whatever caused it."""
        self._listeners.append(listener)

    async def change(self, request: TransitionRequest | str) -> Result:
        """Run a transition from inside the executor: `await node.lifecycle.change("connect")`.

        Raises:
            RefusedError: not allowed in this state, another transition is running, or the gate of
                the node's supervisor is closed.
            LifecycleError: no such transition.
        """
        return await self._machine.change(_known(request))

    async def change_for_supervisor(self, request: TransitionRequest | str) -> Result:
        """Run a transition that the supervisor asked for; its activate is the gate's permit.

        A node that it lets through may be deactivated and activated again by any client, until the
        supervisor deactivates it or its data layer goes, which is what was verified. A node that
        another client has deactivated already is where the supervisor wants it.

        Raises:
            RefusedError: as for `change`.
            LifecycleError: likewise.
        """
        known = _known(request)
        if self._supervisor and known is TransitionRequest.DEACTIVATE:
            self._let_through = False
            if self.state is NodeState.INACTIVE_CONNECTED:
                return SUCCESS
        if known is not TransitionRequest.ACTIVATE:
            return await self._machine.change(known)
        if self._supervisor and self.state is not NodeState.ACTIVE:
            self._let_through = False  # an earlier permit does not outlast one that fails
        result = await self._machine.change(known, permitted=True)
        if result.outcome is CallbackOutcome.SUCCESS:
            self._let_through = True
        return result

    async def bring_up(self) -> Result:
        """Configure, connect and activate; stops at the first that does not succeed."""
        result = SUCCESS
        for request in BRING_UP:
            result = await self._machine.change(request)
            if result.outcome is not CallbackOutcome.SUCCESS:
                break
        return result

    def bring_up_when_spun(self) -> None:
        """Bring the node up on the first turn of whatever executor spins it."""

        async def once() -> None:
            Node.destroy_timer(self._node, timer)
            await self.bring_up()

        timer = self._turns.timer(0.0, once)

    def sleep(self, seconds: float) -> Future:
        """Return what is done in `seconds`, in every state."""
        future: Future = Future()
        self._turns.call_after(seconds, lambda: future.set_result(None))
        return future

    def close(self) -> None:
        """Leave the graph and take the data layer away: the node is being destroyed."""
        self._turns.close()
        self.data_layer.remove()
        if self._reporter is not None:
            self._reporter.left()
            self._reporter = None

    async def shut_down(self, reason: str) -> Result:
        """Bring the node to finalized from any state; a running async callback is cancelled."""
        return await self._machine.shut_down(reason)

    @property
    def is_marked(self) -> bool:
        """Whether the plan says what DSCP any of its endpoints sends with."""
        return any(each.dscp is not None for each in self.spec.endpoints)

    @property
    def marks(self) -> tuple[int | None, ...]:
        """DSCP on the sender sockets of its participants, as it is now."""
        return self.data_layer.connections.marks

    def get_configuration(self) -> NodeConfiguration:
        """Return this node's identity and its endpoints as they are."""
        # Whatever the policy: what a node says of itself is known before discovery shows it.
        undeclared = self.undeclared.beside(self.data_layer.entities)
        return configuration.collect(
            self._node,
            self.state.seen.label,
            connected=self.state.connected,
            endpoints=configuration.endpoint_reports(self._node, self.data_layer, undeclared),
            connections=configuration.connection_reports(self.spec, self.data_layer),
            health=self._health.report,
            measured=self.gate.measured(),
        )

    def measured(self) -> Measured | None:
        """Return what has arrived since it was activated; None while it is not. Any thread."""
        return self.gate.measured()

    # What the rows of the machine's table run.

    def may_activate(self) -> bool:
        """Return True.

        Raises:
            RefusedError: the gate of its supervisor is closed.
        """
        if self._machine.is_permitted or self._let_through:
            return True
        raise RefusedError(
            f"cannot activate {self.full_name}: the gate of its supervisor is closed",
            hint=f"it is activated once {self._supervisor!r} is verified; a paused system: "
            f"lifecycle resume {self._supervisor}",
        )

    def prepare(self) -> None:
        """Declare parameters and endpoints, and make the timers of `@on_timer` methods."""
        matched = self.declared.match()
        parameters.declare(self._node, self.spec)
        self.declared.enact(matched)
        for timer in matched.timers:
            method = getattr(self._node, timer.method)
            self._method_timers.append(self._node.create_timer(timer.period_s, method))

    def unprepare(self) -> None:
        """Undo `prepare`; parameters stay declared."""
        while self._method_timers:
            self._node.destroy_timer(self._method_timers.pop())
        self.data_layer.undeclare()

    def make_data_layer(self) -> None:
        """Make every endpoint or none."""
        self.data_layer.make(self.spec)

    def undo_data_layer(self) -> None:
        """Undo `make_data_layer`, if it has made them."""
        if self.data_layer.is_made:
            self.data_layer.remove()

    def remove_data_layer(self) -> None:
        """Remove every endpoint."""
        self.data_layer.remove()

    def open_gate(self) -> None:
        """Let data flow."""
        self.gate.open()

    def close_gate(self) -> None:
        """Stop data; goals end."""
        self.gate.close()

    def take_down(self) -> None:
        """Remove and undo everything; what of it fails is logged, for the node has to end."""
        for step in (self.close_gate, self.remove_data_layer, self.unprepare):
            try:
                step()
            except Exception:  # noqa: BLE001, PERF203 - a fault of ours
                self._node.get_logger().error(traceback.format_exc())

    # What the machine needs for the author's callbacks.

    def callback(self, name: str) -> Callable[..., Any]:
        """Return the author's `on_…` method."""
        method: Callable[..., Any] = getattr(self._node, name)
        return method

    def callback_argument(self, state: NodeState) -> LifecycleState:
        """Return what rclpy's callbacks are given: the state before the transition."""
        return LifecycleState(label=state.seen.label, state_id=state.seen.id)

    def wake_at_deadline(self, deadline_s: float) -> Callable[[], None]:
        """Wake the executor in `deadline_s`; returns what calls that off."""
        return self._turns.wake_at_deadline(deadline_s)

    def wake(self) -> None:
        """Make the executor look at its waiting tasks again."""
        self._turns.wake()

    def report(self, result: Result) -> None:
        """Log why a step did not succeed, with the traceback where there is one."""
        logger = self._node.get_logger()
        if result.trace:
            logger.error(result.trace)
        logger.error(result.error)

    # Inside.

    def _join(self) -> None:
        # Late: most nodes report to their supervisor only.
        from lifecycle.graph.reporter import GraphReporter

        self._reporter = GraphReporter(self._node)
        self._reporter.report(state=self.state.seen.label, connected=self.state.connected)
        self.configuration_changes.listen(self._report_configuration)
        now = self.configuration_changes.collect()
        if now is not None:
            self._report_configuration(now)

    def _report_configuration(self, now: NodeConfiguration) -> None:
        if self._reporter is None:
            return
        if self.spec.events:
            self._reporter.report_configuration(now)
        else:
            self._reporter.report(checksum=now.checksum)

    async def _change_by_service(self, request: TransitionRequest) -> bool:
        try:
            result = await self._machine.change(request)
        except RefusedError as refused:
            self._node.get_logger().warning(str(refused))
            return False
        return result.outcome is CallbackOutcome.SUCCESS

    def changed(self, change: StateChange) -> None:
        """Notify others of a change of the state."""
        if self._supervisor and change.goal in _WITHOUT_DATA_LAYER:
            self._let_through = False
        if change.event is not None and self._services is not None:
            self._services.publish(change.event)
        if self._reporter is not None:
            self._reporter.report(state=change.goal.seen.label, connected=change.goal.connected)
        self._health.follow(change.goal)
        for listener in self._listeners:
            listener(self)


def _known(request: TransitionRequest | str) -> TransitionRequest:
    try:
        return TransitionRequest(request)
    except ValueError as error:
        hint = alternatives(str(request), [each.value for each in TransitionRequest])
        raise LifecycleError(f"cannot take transition {request!r}", hint=hint) from error
