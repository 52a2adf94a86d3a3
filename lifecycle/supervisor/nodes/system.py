"""The running system: its processes and nodes, and how far each has been brought up.

Owns: `System`, `NodeRun` and the waits on "this node has reached that condition"; and `RemoteNode`,
the same for a node that another supervisor brings up on another machine, as far as the graph and
its own report show. What is done with them is bring_up.py's, gate/hold.py's and run/shutdown.py's.
Must not import rclpy.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Collection, Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from msgspec.structs import replace

from lifecycle.errors import BringUpError
from lifecycle.manifest.model import Condition, RunKind, TargetState
from lifecycle.node.host.control import Event as HostEvent
from lifecycle.node.host.control import Operation
from lifecycle.plan.build import attached_to
from lifecycle.plan.model import Plan, PlannedNode, PlannedProcess, in_mode
from lifecycle.supervisor.control.protocol import Reach
from lifecycle.supervisor.gate.gate import Permit
from lifecycle.supervisor.health.liveliness import SilenceMonitor
from lifecycle.supervisor.nodes.driver import ACTIVE, INACTIVE, NodeCondition, NodeDriver
from lifecycle.supervisor.processes.fork_server_main import GRACE_S
from lifecycle.supervisor.processes.logs import LogDirectory
from lifecycle.supervisor.processes.process import ManagedProcess, own_run_delay_s
from lifecycle.supervisor.run.events import Emitter, NodeChanged, Notice, RequestSent
from lifecycle.verify.observation import HealthReport, NodeConfiguration, Observation
from lifecycle.verify.rules.health import health_of

if TYPE_CHECKING:
    from lifecycle.graph.graph import Graph
    from lifecycle.supervisor.gate.verification_loop import ChangeCounter

ASK_AGAIN_S = 0.2
"""A remote node is asked again so long after, because the event that it connected may be missed:
its announcer may not be matched yet."""


class RemoteNode:
    """One node that another supervisor brings up.

    Attributes:
        reached: every condition that holds as of the last look.
        awaited: the last one that others may wait for.
        changed: replaced and set when `reached` changes.
    """

    def __init__(self, planned: PlannedNode) -> None:
        self.planned = planned
        self.awaited = Condition.ACTIVE if planned.health is None else Condition.HEALTHY
        self.reached: frozenset[Condition] = frozenset()
        self.changed = asyncio.Event()

    @property
    def name(self) -> str:
        """Fully qualified node name."""
        return self.planned.full_name

    def has_reached(self, condition: Condition) -> bool:
        """Whether the condition holds; for a node that is not managed all follow its start."""
        return condition in self.reached

    def see(self, observation: Observation) -> None:
        """Take what was seen, and notify who waits."""
        reached = frozenset(_conditions(self.planned, observation))
        if reached != self.reached:
            self.reached = reached
            self.changed.set()
            self.changed = asyncio.Event()


async def follow_remote(system: System, observer: Graph, changes: ChangeCounter) -> None:
    """Look at every change, until the remote nodes that others wait for have reached everything."""
    nodes = system.awaited()
    # Ours report by themselves: only these have to be asked.
    plan = replace(system.plan, nodes=tuple(each.planned for each in nodes))
    while not all(each.has_reached(each.awaited) for each in nodes):
        count = changes.count
        observation = await observer.observe(plan)
        for each in nodes:
            each.see(observation)
        # One that was not there at all announces itself.
        there = any(each.reached for each in nodes)
        await changes.beyond(count, ASK_AGAIN_S if there else None)


async def follow_health(system: System, observer: Graph, changes: ChangeCounter) -> None:
    """Take from the graph the health that others wait for, where no host of ours reports all.

    It looks at every change, until it is cancelled; it returns at once if nobody waits so.
    """
    keys = {
        after.node
        for node in system.nodes.values()
        for after in node.planned.after
        if after.condition is Condition.HEALTHY
    }
    awaited = [each for key, each in system.nodes.items() if key in keys]
    awaited = [each for each in awaited if not each.reports_health]
    if not awaited:
        return
    plan = replace(system.plan, nodes=tuple(each.planned for each in awaited))
    while True:
        count = changes.count
        observation = await observer.observe(plan)
        own = {each.name: _own_health(each) for each in observation.configurations}
        published = {each.full_name: each.health for each in observation.nodes}
        for each in awaited:
            each.health = own.get(each.name), published.get(each.name)
            each.wake()
        await changes.beyond(count, ASK_AGAIN_S)


def _conditions(planned: PlannedNode, observation: Observation) -> Iterable[Condition]:
    name = planned.full_name
    observed = next((each for each in observation.nodes if each.full_name == name), None)
    if observed is None:
        return ()
    report = next((each for each in observation.configurations if each.name == name), None)
    up_to_active = (Condition.STARTED, Condition.CONFIGURED, Condition.CONNECTED, Condition.ACTIVE)
    said = health_of(planned, _own_health(report), observed.health)
    healthy = (Condition.HEALTHY,) if said.ok else ()
    if not planned.managed:
        return (*up_to_active, *healthy)
    state = observed.state or (report.state if report is not None else "")
    if state == ACTIVE:
        return (*up_to_active, *healthy)
    if state != INACTIVE:
        return (Condition.STARTED,)
    # A node that is not ours makes its data layer in configure, and has no such report.
    if report is None or report.connected:
        return (Condition.STARTED, Condition.CONFIGURED, Condition.CONNECTED)
    return (Condition.STARTED, Condition.CONFIGURED)


_ORDER = list(Reach)


_NOT_ANSWERED = HealthReport(ok=None, message="it has not answered since its state changed")


def _own_health(report: NodeConfiguration | None) -> HealthReport | None:
    """Return what a node says of itself; what it said while it was inactive is no answer."""
    return None if report is None or report.state == INACTIVE else report.health


_CONDITIONS = {
    Condition.STARTED: Reach.STARTED,
    Condition.CONFIGURED: Reach.CONFIGURED,
    Condition.CONNECTED: Reach.CONNECTED,
    Condition.ACTIVE: Reach.ACTIVE,
    Condition.HEALTHY: Reach.ACTIVE,
}

_REPORTING = {
    True: (Reach.CONFIGURED, Reach.CONNECTED, Reach.ACTIVE),
    False: (Reach.STARTED, Reach.ACTIVE),
}
"""How far a node has come that has something to report, by whether it is managed."""

_REFRESH_S = 1.0
"""A host answers from its executor within a millisecond; this long it is busy or hung."""


class NodeRun:
    """One node of the plan as it runs.

    Attributes:
        driver: None for a node that nothing holds.
        process: None for a node that this supervisor does not start.
        reach: how far it is brought up.
        doing: what it does or waits for at this moment, for messages; empty when nothing.
        undo: what has to be undone, oldest first.
        permit: the gate's, of the activate that is in `undo`; None for what needed none.
        stuck: an operation on it was given up: a polite request would wait behind it.
        connections: names of what the authority connected it to, oldest first.
        found: state in which it was adopted, `running` for one that is not managed; empty for one
            that is not adopted.
        reports_changes: its host reports unasked when its configuration changes.
        unload: has its container unload a component; None for what is not loaded into one.
        is_up: it was started and brought as far as its gate; cleared when it goes down.
        health: what it, and /diagnostics of it, was seen to say of it in the graph.
        withheld: why a consequence of a violation keeps it inactive, until a person lets it through
            the gate again; empty if none does.
    """

    def __init__(self, planned: PlannedNode, emit: Emitter) -> None:
        self.planned = planned
        self.reach = Reach.WAITING
        self.found = ""
        self.withheld = ""
        self.changed = asyncio.Event()
        self._emit = emit
        self._begin(None)

    def _begin(self, process: ManagedProcess | None) -> None:
        self.driver: NodeDriver | None = None
        self.process = process
        self.state = ""
        self.connected = False
        self.configuration: NodeConfiguration | None = None
        self.doing = ""
        self.undo: list[Operation] = []
        self.permit: Permit | None = None
        self.stuck = False
        self.connections: tuple[str, ...] = ()
        self.reports_changes = False
        self.unload: Callable[[], Awaitable[None]] | None = None
        self.is_up = False
        self.health: tuple[HealthReport | None, HealthReport | None] = (None, None)

    def renew(self, process: ManagedProcess | None) -> None:
        """Begin again, in a new process, after the node was taken down."""
        self._begin(process)
        self.advance(Reach.WAITING)

    @property
    def is_let_through(self) -> bool:
        """Whether it was asked to activate: waiting for its turn is not enough."""
        asked = self.permit is None or self.name in self.permit.sent
        return Operation.ACTIVATE in self.undo and asked

    @property
    def name(self) -> str:
        """Fully qualified node name."""
        return self.planned.full_name

    @property
    def is_to_be_active(self) -> bool:
        """Whether the gate is to activate it."""
        return self.planned.holds and self.planned.state is TargetState.ACTIVE

    @property
    def pid(self) -> int:
        """Its process; 0 if that was not started by this supervisor."""
        return 0 if self.process is None else self.process.pid

    @property
    def is_gone(self) -> bool:
        """Whether its process has ended, as far as that is noticed."""
        return self.process is not None and self.process.is_gone

    def run_delay_s(self) -> float:
        """Return the run delay of its process and ours, seconds: ready to run, but without CPU."""
        return own_run_delay_s() if self.process is None else self.process.run_delay_s()

    @property
    def reports_health(self) -> bool:
        """Whether its host reports all that the manifest asks of its health."""
        asked = self.planned.health
        ours = self.process is not None and self.process.channel is not None
        return asked is None or (ours and not asked.diagnostics)

    @property
    def _known_health(self) -> HealthReport:
        own, published = self.health
        if self.configuration is not None:
            own = self.configuration.health
        return health_of(self.planned, own, published)

    @property
    def is_healthy(self) -> bool:
        """Whether it is known to be as healthy as its manifest asks, in its present state."""
        return self._known_health.ok is True

    @property
    def unhealthy_reason(self) -> str:
        """What is wrong with it, for messages; empty if nothing, or it is not active."""
        said = self._known_health.message
        return f": {said}" if said and self.reach is Reach.ACTIVE else ""

    def has_reached(self, condition: Condition) -> bool:
        """Whether the condition holds; for a node that is not managed all follow its start."""
        if self.reach is Reach.STOPPED:
            return False
        if condition is Condition.HEALTHY and not self.is_healthy:
            return False
        if not self.planned.managed:
            return self.reach is not Reach.WAITING
        return _ORDER.index(self.reach) >= _ORDER.index(_CONDITIONS[condition])

    def advance(self, reach: Reach, condition: NodeCondition | None = None) -> None:
        """Note that the node reached `reach`, and notify its listeners and waiters."""
        self.reach = reach
        if condition is not None:
            self._take(condition.state, connected=condition.connected)
            self.learn(condition.configuration)
        self._tell()

    def learn(self, configuration: NodeConfiguration | None) -> None:
        """Take a configuration that was asked for; None is nothing to take.

        Of a node whose host reports, every configuration has been taken in the order of its channel
        by now (System.on_host_event): what a reply carried may be older than what came since.
        """
        if configuration is not None and not self.reports_changes:
            self.configuration = configuration

    def report(self, state: str, *, connected: bool) -> None:
        """Note a state that the node itself reported, asked by us or by others."""
        if (state, connected) != (self.state, self.connected):
            self._take(state, connected=connected)
            self._tell()

    async def perform(self, operation: Operation, permit: Permit | None = None) -> NodeCondition:
        """Send one operation to a managed node.

        Raises:
            BringUpError: the node refused, failed or cannot be reached.
            VerificationError: what changed since the permit's verdict does not allow it.
        """
        assert self.driver is not None
        if permit is not None:
            await permit.renewed()
        self._emit(RequestSent(node=self.name, operation=operation))
        return await self.driver.perform(operation, permit)

    def _take(self, state: str, *, connected: bool) -> None:
        self.state, self.connected = state, connected
        known = self.configuration
        if known is not None:
            # What it said of itself in another state is no answer; its host reports the new one.
            stale = known.health is not None and known.state != state
            health = _NOT_ANSWERED if stale else known.health
            self.configuration = replace(known, state=state, connected=connected, health=health)

    def _tell(self) -> None:
        self._emit(
            NodeChanged(
                node=self.name, reach=self.reach, state=self.state, connected=self.connected
            )
        )
        self.wake()

    def wake(self) -> None:
        """Have those look again that wait for it."""
        self.changed.set()
        self.changed = asyncio.Event()


class System:
    """Every node and process of one plan that this supervisor is responsible for.

    Args:
        processes: those of the plan that this supervisor is responsible for.
        variables: set in every process, below what the plan sets.
        logs: the directory of the processes' log files.

    Attributes:
        logs: likewise, with what could not be written there.
        machines: those whose nodes it brings up; None if that is all of them.
        remote: the plan's other nodes, which another supervisor brings up.
        adopts: takes nodes that others started as they are found, active ones too.
        adopted: the nodes that ran before it, by full name, with the process that each is in as
            people read it; empty where that is not known.
        touched: set whenever a node reported something of itself: time to judge again.
        mode: name of the one that it is in, or is on its way to; empty for a plan without modes.
        liveliness: which nodes are silent.
        present: names of the nodes that are in the graph; None before it was first looked at.
        first: the plan as it was made from the manifest in force, without what became of it since.
        revision: number of that manifest, 1 for the one that the run began with; one that is taken
            later has a number of its own, also if it is given back.
        server: the discovery server, where this supervisor runs one.
        expected: the plan as it must be seen now; where the data layer is negotiated while the
            system runs, it follows.
    """

    def __init__(
        self,
        plan: Plan,
        *,
        emit: Emitter,
        logs: Path,
        processes: Iterable[PlannedProcess],
        variables: tuple[tuple[str, str], ...] = (),
    ) -> None:
        self.first = plan
        self.revision = self._last_revision = 1
        self.plan = plan
        self.expected = plan
        self.mode = plan.modes[0].name if plan.modes else ""
        self.server: ManagedProcess | None = None
        self.emit = emit
        own = tuple(processes)
        self.logs = LogDirectory(logs, lambda text: emit(Notice(message=text)))
        self._variables = variables
        self.processes = {
            each.name: self.make_process(each)
            for each in own
            if each.run.kind is not RunKind.ATTACH
        }
        self.nodes = {
            key: NodeRun(plan.node(key), emit) for process in own for key in process.nodes
        }
        for process in self.processes.values():
            for key in process.planned.nodes:
                self.nodes[key].process = process
        self.remote = {
            node.key: RemoteNode(node) for node in plan.nodes if node.key not in self.nodes
        }
        self.machines = frozenset(each.machine for each in own) if self.remote else None
        self._by_name = {node.name: node for node in self.nodes.values()}
        self.adopts = False
        self.adopted: dict[str, str] = {}
        self.touched = asyncio.Event()
        self.present: frozenset[str] | None = None
        self.liveliness = SilenceMonitor(emit, self.touched.set, self._is_there)

    def _may_end(self, planned: PlannedProcess) -> bool:
        nodes = [self.plan.node(key) for key in planned.nodes]
        return bool(nodes) and all(each.may_end for each in nodes)

    def make_process(self, planned: PlannedProcess) -> ManagedProcess:
        """Return a process of this run, not yet started."""
        nodes = [self.plan.node(key) for key in planned.nodes]
        return ManagedProcess(
            planned,
            logs=self.logs,
            emit=self.emit,
            variables=self._variables,
            nodes={each.full_name: each.key for each in nodes},
            may_end=self._may_end(planned),
            carries=[
                each.full_name
                for each in self.plan.nodes
                if each.key in planned.nodes
                or (each.run.component and each.run.container in planned.nodes)
            ],
            # A host of ours deactivates its nodes and shuts them down.
            grace_s=GRACE_S
            + sum(
                each.timeouts.deactivate_s + each.timeouts.shutdown_s
                for each in nodes
                if planned.run.kind is RunKind.PYTHON
            ),
        )

    def over(self) -> dict[str, str]:
        """Return how the process ended of each node that has ended by itself as it may."""
        return {
            node.name: str(node.process.ended.result())
            for node in self.nodes.values()
            if node.process is not None and node.process.is_over
        }

    def _is_there(self, name: str) -> bool:
        """Whether a node has started, and is in the graph as far as that is known."""
        node = self._by_name.get(name)
        if node is not None and node.reach in (Reach.WAITING, Reach.STOPPED):
            return False
        return self.present is None or name in self.present

    def node_named(self, name: str) -> NodeRun | None:
        """Return the node with this fully qualified name."""
        return self._by_name.get(name)

    def adopt(self, running: Mapping[str, str]) -> None:
        """Leave nodes to who started them: none of them is started, nor ended.

        Args:
            running: by key, the process that each is in as people read it; of the processes that
                would have been started for them, all nodes.
        """
        self.adopts = True
        for key, where in running.items():
            node = self.nodes[key]
            self.adopted[node.name] = where
            if node.process is not None:
                self.processes.pop(node.process.name, None)
                node.process = None
        self.replan(attached_to(self.plan, running))

    def replan(self, plan: Plan) -> None:
        """Take a plan whose participants are connected otherwise; running nodes do not notice."""
        self.plan = self.expected = plan
        for key, node in self.nodes.items():
            node.planned = plan.node(key)

    def enter(self, mode: str) -> None:
        """Have nodes be as a mode of the plan says; running nodes do not notice."""
        self.mode = mode
        self.replan(in_mode(self.plan, mode))

    def mode_by(self, plan: Plan) -> str:
        """Return the mode that it would be in by another manifest: the same, if that has it."""
        names = [each.name for each in plan.modes]
        return self.mode if self.mode in names else next(iter(names), "")

    def take(
        self, plan: Plan, nodes: Collection[NodeRun], revision: int | None = None
    ) -> tuple[NodeRun, ...]:
        """Take another manifest's plan; what of it reaches processes may differ for `nodes` alone.

        Args:
            plan: of which all nodes are this supervisor's.
            nodes: those that were taken down, with all of their processes.
            revision: of one that was in force before; None for a new one.

        Returns:
            The nodes to bring up in their place.
        """
        adopted = {each.key for each in plan.nodes if each.full_name in self.adopted}
        if revision is None:
            revision = self._last_revision = self._last_revision + 1
        self.revision = revision
        ran, self.first = self.first, plan
        self.mode = self.mode_by(plan)
        down = {each.planned.key: each for each in nodes}
        stay = {key: each for key, each in self.nodes.items() if key not in down}
        taken = _connected_as(attached_to(in_mode(plan, self.mode), adopted), stay, ran)
        self.plan = self.expected = taken
        kept = {each.process.name: each.process for each in stay.values() if each.process}
        self.nodes, self.processes = {}, {}
        for process in taken.processes:
            managed = kept.get(process.name)
            if managed is None and process.run.kind is not RunKind.ATTACH:
                managed = self.make_process(process)
            elif managed is not None:
                # What it would be started with again: parameters may have been set since.
                managed.planned = process
                managed.may_end = self._may_end(process)
            if managed is not None:
                self.processes[process.name] = managed
            for key in process.nodes:
                if key in stay:
                    self.nodes[key] = stay[key]
                    stay[key].planned = self.plan.node(key)
                    continue
                node = self.nodes[key] = NodeRun(self.plan.node(key), self.emit)
                node.process = managed
                node.advance(Reach.WAITING)
        self._by_name = {node.name: node for node in self.nodes.values()}
        return tuple(each for key, each in self.nodes.items() if key not in stay)

    def renew(self, nodes: Iterable[NodeRun]) -> None:
        """Let nodes that were taken down, with all of their processes, be brought up again."""
        processes: dict[str, ManagedProcess] = {}
        for node in nodes:
            old = node.process
            if old is not None and old.name not in processes:
                processes[old.name] = self.make_process(old.planned)
                processes[old.name].is_restarted = True
            node.renew(None if old is None else processes[old.name])
        self.processes.update(processes)

    @property
    def living(self) -> tuple[ManagedProcess, ...]:
        """Every process that was started and has not ended, the discovery server included."""
        every = (*self.processes.values(), *(() if self.server is None else (self.server,)))
        return tuple(each for each in every if each.pid and not each.is_gone)

    def dead(self) -> frozenset[str]:
        """Return the names of the nodes whose process has ended.

        Discovery shows them until their lease runs out, 20 s by default.
        """
        return frozenset(
            node.name
            for node in self.nodes.values()
            if node.process is not None and node.process.is_gone
        )

    def on_host_event(self, event: HostEvent) -> None:
        """Take a host's event about one of its nodes, in the order in which it comes.

        Of a reply this is the configuration, if any, which may have changed; the rest is for who
        asked.
        """
        node = self._by_name.get(event.node)
        if node is None:
            return
        if event.configuration is not None:
            before = node.configuration
            node.configuration = event.configuration
            reports = event.kind == "configuration" or event.reports
            node.reports_changes = node.reports_changes or reports
            if before is not None and before.health != event.configuration.health:
                node.wake()
        if event.kind == "reply":
            if event.reports:
                self.touched.set()
            return
        if event.state:
            node.report(event.state, connected=event.connected)
        self.touched.set()

    async def reached(self, node: NodeRun, condition: Condition, step: str) -> None:
        """Wait until everything that holds `step` of `node` has reached `condition`.

        The wait has no deadline of its own: the nodes waited for have theirs, and so has the
        whole bring-up.
        """
        for after in node.planned.after:
            if after.condition is not condition:
                continue
            other = self.nodes.get(after.node) or self.remote[after.node]
            while not other.has_reached(condition):
                node.doing = f"waits to {step} until {other.name} is {condition.value}"
                if condition is Condition.HEALTHY and isinstance(other, NodeRun):
                    node.doing += other.unhealthy_reason
                await other.changed.wait()
        node.doing = ""

    def awaited(self) -> tuple[RemoteNode, ...]:
        """Return the nodes of others that ours wait for."""
        keys = {after.node for node in self.nodes.values() for after in node.planned.after}
        return tuple(node for key, node in self.remote.items() if key in keys)

    def dependents(self, key: str) -> tuple[NodeRun, ...]:
        """Return the nodes that depend on `key`: those that are taken down before it."""
        return tuple(
            node
            for node in self.nodes.values()
            if node.planned.run.container == key
            or any(after.node == key for after in node.planned.after)
        )

    async def refresh(self, observer: Graph, *, marks: bool = False) -> None:
        """Read the configuration of every reachable node and give it to the observer.

        One whose host reports every change by itself is not asked. A node that does not answer
        keeps its last one: that it is gone is for the graph and its process to say.

        Args:
            observer: see above.
            marks: ask those, too, of which a DSCP is declared: no event says that another was set.
        """
        nodes = [
            node
            for node in self.nodes.values()
            if node.driver is not None
            and node.reach in _REPORTING[node.planned.managed]
            and not node.stuck
            and node.name not in self.liveliness.silent
        ]
        await asyncio.gather(
            *(
                self._refresh(node)
                for node in nodes
                if not node.reports_changes
                or (marks and any(each.dscp is not None for each in node.planned.endpoints))
            )
        )
        for node in nodes:
            if node.configuration is not None:
                observer.state.put_configuration(node.configuration)

    @staticmethod
    async def _refresh(node: NodeRun) -> None:
        assert node.driver is not None
        try:
            fresh = await asyncio.wait_for(node.driver.configuration(), _REFRESH_S)
        except (BringUpError, asyncio.TimeoutError):
            return
        node.learn(fresh)


def _connected_as(plan: Plan, running: Mapping[str, NodeRun], before: Plan) -> Plan:
    """Return a plan with the connections that running nodes have: a restart may have moved them.

    Args:
        plan: of another manifest.
        running: nodes that stay, by key.
        before: the plan of the manifest by which they were started.
    """
    planned = {each.key: each for each in before.nodes}

    def connected(node: PlannedNode) -> PlannedNode:
        was, run = planned.get(node.key), running.get(node.key)
        if was is None or run is None:
            return node
        if (was.connections, was.participants) != (node.connections, node.participants):
            return node
        now = run.planned
        return replace(node, connections=now.connections, participants=now.participants)

    return replace(plan, nodes=tuple(map(connected, plan.nodes)))
