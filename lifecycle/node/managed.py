"""The managed half of a LifecycleNode: machine, gate, data layer, services put together."""

from __future__ import annotations

import functools
import traceback
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from rclpy.lifecycle import LifecycleState
from rclpy.node import Node
from rclpy.timer import Timer

from lifecycle.manifest.model import EndpointKind, Executor
from lifecycle.middleware.rcl.rclpy_nodes import interface_of
from lifecycle.node import configuration, services
from lifecycle.node.callbacks import (
    SUCCESS,
    CallbackOutcome,
    HealthCheck,
    Result,
    error_text,
)
from lifecycle.node.configuration import ConfigurationChanges, HostedState
from lifecycle.node.data_layer import DataLayer
from lifecycle.node.endpoint import Endpoint, Placement, interface_name, wire_name
from lifecycle.node.gate import NodeGate
from lifecycle.node.handlers import match
from lifecycle.node.machine import Machine, NodeState, RefusedError, Transition
from lifecycle.node.planned import declare_parameters
from lifecycle.node.services import Turns, acts_of, serve_interface
from lifecycle.plan.model import PlannedEndpoint, PlannedNode
from lifecycle.verify.observation import NodeConfiguration

if TYPE_CHECKING:
    from lifecycle.graph.reporter import GraphReporter
    from lifecycle.node.gate import Later


_UNSAID = ("undeclare_parameter", "set_descriptor")
"""They change the parameters of a node, and rclpy notifies nobody."""


class NodeInHost:
    """What a process knows of one of its nodes, whatever class it is of.

    Args:
        supervisor: name of the system whose gate holds it; empty for none.
        later: runs a function in the executor of the node, or beside it.
        collect: returns its configuration as it is now.

    Attributes:
        node: rclpy's.
        full_name: its name, fully qualified.
        spec: what it was planned to be.
        log: its logger.
        gate: holds back what it sends, receives and times, and counts what arrives.
        listeners: are called with it after every change of state, whatever caused it.
        configuration_changes: notifies of each change of its configuration.
        found: endpoints that its code made with rclpy's factories, by id of their object.
        is_destroyed: its own code has destroyed it, in a process that goes on.
    """

    def __init__(
        self,
        node: Node,
        spec: PlannedNode,
        supervisor: str,
        later: Later,
        collect: Callable[[], NodeConfiguration],
    ) -> None:
        self.node = node
        self.full_name = str(node.get_fully_qualified_name())
        self.spec = spec
        self._supervisor = supervisor
        # By its supervisor, through the gate; a node without one needs no permission.
        self._let_through = not supervisor
        self.gate = NodeGate(counts=spec.run.executor is not Executor.EVENTS)
        self.listeners: list[Callable[[Any], None]] = []
        self.log = node.get_logger()
        self.configuration_changes = ConfigurationChanges(later, collect, failed=self.log.error)
        node.add_post_set_parameters_callback(lambda _: self.configuration_changes.touch())
        for name in _UNSAID:
            self._touch_after(name)
        self.found: dict[int, Endpoint] = {}
        self.is_destroyed = False

    def _touch_after(self, name: str) -> None:
        """Have a method of the node followed by a look at its configuration."""
        method = getattr(self.node, name)

        @functools.wraps(method)
        def touching(*arguments: Any, **options: Any) -> Any:
            result = method(*arguments, **options)
            self.configuration_changes.touch()
            return result

        setattr(self.node, name, touching)

    def add(self, kind: EndpointKind, placement: Placement) -> Endpoint:
        """Note an endpoint that one of rclpy's factories returned."""
        entity = placement.entity
        planned = PlannedEndpoint(
            kind=kind,
            name="",
            resolved=wire_name(entity),
            type=interface_name(interface_of(entity)),
            qos=None,
            at=self.spec.at,
        )
        endpoint = self.found[id(entity)] = Endpoint(planned=planned, placement=placement)
        self.configuration_changes.touch()
        return endpoint

    def remove(self, entity: Any) -> Placement | None:
        """Forget what is being destroyed, and return where it was; None if it is not known."""
        self.gate.remove(entity)
        endpoint = self.found.pop(id(entity), None)
        if endpoint is None:
            return None
        self.configuration_changes.touch()
        return endpoint.placement

    def note_fault(self, endpoint: Endpoint, error: Exception | None) -> str:
        """Keep, and return, what the handler of an action raised at its last goal."""
        fault = "" if error is None else f"its handler raised {error_text(error)}"
        if fault != endpoint.fault:
            endpoint.fault = fault
            self.configuration_changes.touch()
        return fault


class Managed(NodeInHost):
    """The managed half of one LifecycleNode.

    Attributes:
        auto: it brings itself up, unless its host says otherwise.
        turns: has things done in its executor.
        data_layer: its endpoints.
        connections: its participants.
    """

    def __init__(
        self,
        node: Node,
        spec: PlannedNode,
        auto: bool,
        supervisor: str = "",
        *,
        served: bool = True,
        health: Callable[[], Any] | None = None,
    ) -> None:
        self.turns = Turns(node)
        super().__init__(node, spec, supervisor, self.turns.call_soon, self.get_configuration)
        self.auto = auto
        self._method_timers: list[Timer] = []
        self._reporter: GraphReporter | None = None
        self._health = None if health is None else HealthCheck(self, health)
        self.data_layer = DataLayer(self)
        self.connections = self.data_layer.connections
        self._machine = Machine(self, spec.timeouts)
        self._publish: Callable[[Transition], None] = lambda _: None
        if served:
            self._publish = services.serve(node, self._machine, self.turns.group)
            configuration.serve(node, self.get_configuration, self.turns.group)
            serve_interface(node, acts_of(self.data_layer), self.turns.group)
        if spec.events or spec.membership:
            self._join()

    @property
    def state(self) -> NodeState:
        """The state; `state.seen` is what other tools see."""
        return self._machine.state

    @property
    def reported(self) -> HostedState:
        """The state, as it is reported to a supervisor."""
        state = self.state
        return HostedState(label=state.seen.label, connected=state.connected, steady=state.steady)

    async def change(self, request: str) -> Result:
        """Run a transition from inside the executor: `await node.lifecycle.change("connect")`.

        Raises:
            RefusedError: not allowed in this state, another transition is running, or the gate of
                the node's supervisor is closed.
            LifecycleError: no such transition.
        """
        return await self._machine.change(request)

    async def change_for_supervisor(self, request: str) -> Result:
        """Run a transition that the supervisor asked for; its activate is the gate's permit.

        A node that it lets through may be deactivated and activated again by any client, until the
        supervisor deactivates it or its data layer goes, which is what was verified. A node that
        another client has deactivated already is where the supervisor wants it. Raises as `change`.
        """
        if self._supervisor and request == "deactivate":
            self._let_through = False
            if self.state is NodeState.INACTIVE_CONNECTED:
                return SUCCESS
        if request != "activate":
            return await self._machine.change(request)
        if self._supervisor and self.state is not NodeState.ACTIVE:
            self._let_through = False  # an earlier permit does not outlast one that fails
        result = await self._machine.change(request, permitted=True)
        if result.outcome is CallbackOutcome.SUCCESS:
            self._let_through = True
        return result

    async def bring_up(self) -> Result:
        """Configure, connect and activate; stops at the first that does not succeed."""
        result = SUCCESS
        for request in ("configure", "connect", "activate"):
            result = await self._machine.change(request)
            if result.outcome is not CallbackOutcome.SUCCESS:
                break
        return result

    def bring_up_when_spun(self) -> None:
        """Bring the node up on the first turn of whatever executor spins it."""

        async def once() -> None:
            end()
            await self.bring_up()

        end = self.turns.call_every(0.0, once)

    def close(self) -> None:
        """Leave the graph: the node is being destroyed."""
        self.turns.close()
        self.data_layer.remove()
        if self._reporter is not None:
            self._reporter.left()
            self._reporter = None

    async def shut_down(self, reason: str) -> Result:
        """Bring the node to finalized from any state; a running async callback is cancelled."""
        return await self._machine.shut_down(reason)

    def get_configuration(self) -> NodeConfiguration:
        """Return this node's identity and its endpoints as they are."""
        # Whatever the policy: what a node says of itself is known before discovery shows it.
        return configuration.collect(
            self,
            endpoints=(*self.data_layer.endpoints.values(), *self.found.values()),
            health=None if self._health is None else self._health.report,
        )

    # What the rows of the machine's table run, beside methods of gate and data layer.

    def prepare(self) -> None:
        """Declare parameters and endpoints, and make the timers of `@on_timer` methods."""
        handlers, timed = match(self.node, self.data_layer.unhandled, name=self.full_name)
        declare_parameters(self.node, self.spec)
        self.data_layer.prepare(handlers)
        for method, period_s in timed:
            self._method_timers.append(self.node.create_timer(period_s, method))

    def unprepare(self) -> None:
        """Undo `prepare`; parameters stay declared."""
        while self._method_timers:
            self.node.destroy_timer(self._method_timers.pop())
        self.data_layer.unprepare()

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

    def take_down(self) -> None:
        """Remove and undo everything; what of it fails is logged, for the node has to end."""
        for step in (self.gate.close, self.data_layer.remove, self.unprepare):
            try:
                step()
            except Exception:  # noqa: BLE001, PERF203 - a fault of ours
                self.node.get_logger().error(traceback.format_exc())

    def changed(self, state: NodeState, event: Transition | None) -> None:
        """Notify others of the new state, and other tools of the edge, if they see one."""
        if self._supervisor and state.steady and not state.connected:
            self._let_through = False  # without its data layer it is not what was verified
        if event is not None:
            self._publish(event)
        if self._reporter is not None:
            self._reporter.report(state=state.seen.label, connected=state.connected)
        if self._health is not None:
            self._health.follow(state)
        for listener in self.listeners:
            listener(self)

    # What the machine needs for the author's callbacks.

    def callback(self, name: str) -> Callable[..., Any]:
        """Return the author's `on_…` method."""
        method: Callable[..., Any] = getattr(self.node, name)
        return method

    def callback_argument(self, state: NodeState) -> LifecycleState:
        """Return what rclpy's callbacks are given: the state before the transition."""
        return LifecycleState(label=state.seen.label, state_id=state.seen.id)

    def report(self, result: Result) -> None:
        """Log why a step did not succeed, with the traceback where there is one."""
        if result.trace:
            self.log.error(result.trace)
        self.log.error(result.error)

    # Inside.

    def _join(self) -> None:
        # Late: most nodes report to their supervisor only.
        from lifecycle.graph.reporter import GraphReporter

        self._reporter = GraphReporter(self.node)
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
