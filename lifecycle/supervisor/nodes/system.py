"""What is known of the processes and nodes of one supervisor, beside what the core decides by.

Owns: `System` and `NodeRun`: processes with their channels and logs, drivers, what nodes report of
themselves. How far a node is, and what it is to be, is the core's (`core.state.Run`): here it is
only read. Must not import rclpy.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Awaitable, Callable, Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from msgspec.structs import replace

from lifecycle.errors import BringUpError
from lifecycle.manifest.model import Condition, RosArguments, RunKind
from lifecycle.measure.sample import Measured
from lifecycle.node.host.control import Command, Operation
from lifecycle.node.host.control import Event as HostEvent
from lifecycle.plan.build import attached_to, started_by_others
from lifecycle.plan.model import Plan, PlannedNode, PlannedProcess
from lifecycle.plan.parameters import DEFAULT
from lifecycle.supervisor.control.protocol import Reach
from lifecycle.supervisor.core import failure
from lifecycle.supervisor.core.state import Level, Node, Run, new_run
from lifecycle.supervisor.nodes.driver import (
    ACTIVE,
    INACTIVE,
    ControlDriver,
    NodeDriver,
)
from lifecycle.supervisor.nodes.liveliness import SilenceMonitor
from lifecycle.supervisor.processes.fork_server_main import GRACE_S
from lifecycle.supervisor.processes.logs import LogDirectory
from lifecycle.supervisor.processes.process import ManagedProcess, run_delay_s
from lifecycle.supervisor.run.events import Emitter, NodeChanged, Notice
from lifecycle.supervisor.run.options import UpOptions
from lifecycle.verify.observation import HealthReport, NodeConfiguration
from lifecycle.verify.rules.state import health_of

if TYPE_CHECKING:
    from lifecycle.graph.graph import Graph

_NOT_ANSWERED = HealthReport(ok=None, message="it has not answered since its state changed")

_REFRESH_S = 1.0
"""A host answers from its executor within a millisecond; this long it is busy or hung."""


class NodeRun:
    """One node of this supervisor as it runs.

    Attributes:
        core: what is decided by of it: how far it is, its request.
        driver: None for a node that nothing holds, or that is not there.
        state: lifecycle_msgs/State label; empty for a node that is not managed.
        connected: its data layer is made.
        configuration: what it reports of itself; None before it does.
        unload: has its container unload a component; None for what is not loaded into one.
        wiring: the step of wiring that it is asked for just now; empty when none.
        health: what it, and /diagnostics of it, was seen to say of it in the graph.
        is_destroyed: its own code has destroyed it, in a process that runs on.
    """

    def __init__(self, system: System, core: Node) -> None:
        self.core = core
        self._system = system
        self._said = NodeChanged(node=core.name, reach=Reach.WAITING)
        self.begin()

    def begin(self) -> None:
        """Know nothing of it: it is started anew, or its process has ended."""
        self.driver: NodeDriver | None = None
        self.state = ""
        self.connected = False
        self.configuration: NodeConfiguration | None = None
        self.unload: Callable[[], Awaitable[None]] | None = None
        self.wiring = ""
        self.health: tuple[HealthReport | None, HealthReport | None] = (None, None)
        self.is_destroyed = False

    @property
    def planned(self) -> PlannedNode:
        """As the plan has it now."""
        return self.core.planned

    @property
    def name(self) -> str:
        """Fully qualified node name."""
        return self.core.name

    @property
    def process(self) -> ManagedProcess | None:
        """Its process; None before it is started, and for one that this supervisor does not."""
        return self._system.processes.get(self.core.process)

    @property
    def is_hosted(self) -> bool:
        """Whether it is in a host of ours."""
        return bool(self.core.process) and self.planned.run.kind is RunKind.PYTHON

    @property
    def is_gone(self) -> bool:
        """Whether its process has ended."""
        process = self._system.run.processes.get(self.core.process)
        return process is not None and process.end is not None

    @property
    def reach(self) -> Reach:
        """How far it is brought up, as people and clients read it."""
        run, level = self._system.run, self.core.level
        if level is not Level.DOWN:
            return Reach[level.name]
        process = run.process_of(self.core)
        stays = run.ending is not None or (process is not None and process.stays_down)
        was_up = self._said.reach is not Reach.WAITING
        return Reach.STOPPED if stays and was_up else Reach.WAITING

    @property
    def doing(self) -> str:
        """What it does or waits for at this moment, for messages; empty when nothing."""
        what = failure.doing(self._system.run, self.core)
        if what.endswith(f"is {Condition.HEALTHY.value}"):
            keys = (each.node for each in self.planned.after if each.condition is Condition.HEALTHY)
            others = (self._system.nodes[key] for key in keys if key in self._system.nodes)
            what += next((each.unhealthy_reason for each in others if each.unhealthy_reason), "")
        return f"asked to {self.wiring}" if self.wiring else what

    def run_delay_s(self) -> float:
        """Return how long we, and its process, were ready to run without a CPU."""
        return run_delay_s() + (0.0 if self.process is None else self.process.run_delay_s())

    def where(self) -> str:
        """Return where it is in a step that takes long, for messages; empty if not known."""
        if self.wiring:
            return f"its step {self.wiring}"
        return "" if self.process is None else self.process.where()

    @property
    def is_to_be_given(self) -> bool:
        """Whether its command line cannot give it all of its parameters, see `command_line`."""
        planned, process = self.planned, self.process
        empty = [each for each in planned.expected_parameters if each.value == ()]
        if planned.run.component and empty:
            return True
        if process is None or planned.run.kind is not RunKind.COMMAND:
            return False
        if planned.run.ros_args is RosArguments.NONE:
            return bool(planned.parameters or planned.parameter_files)
        if planned.mode_parameters or any(each.source != DEFAULT for each in empty):
            return True  # it may come again in another mode; rcl reads no empty array
        shared = len(process.planned.nodes) > 1
        return shared and planned.namespace != "/" and bool(planned.parameters)

    @property
    def reports_health(self) -> bool:
        """Whether its host reports all that the manifest asks of its health."""
        asked = self.planned.health
        return asked is None or (self.is_hosted and not asked.diagnostics)

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
        return f": {said}" if said and self.core.level is Level.ACTIVE else ""

    def learn(self, configuration: NodeConfiguration | None) -> None:
        """Take a configuration that was asked for; a host of ours reports its own, in order."""
        if configuration is not None and not self.is_hosted:
            self.configuration = configuration

    def report(self, state: str, *, connected: bool) -> None:
        """Note a state that the node itself reported, asked by us or by others."""
        if (state, connected) == (self.state, self.connected):
            return
        self.state, self.connected = state, connected
        known = self.configuration
        if known is not None:
            # What it said of itself in another state is no answer; its host reports the new one.
            stale = known.health is not None and known.state != state
            health = _NOT_ANSWERED if stale else known.health
            measured = known.measured
            if self.is_hosted and known.state != state:
                measured = Measured(active_s=0.0)  # what was counted before is over
            self.configuration = replace(
                known, state=state, connected=connected, health=health, measured=measured
            )
        self.say()

    def say(self) -> None:
        """Say how far it is, where that is new."""
        now = NodeChanged(
            node=self.name, reach=self.reach, state=self.state, connected=self.connected
        )
        if now != self._said:
            self._said = now
            self._system.emit(now)


class System:
    """Every node and process of one plan that this supervisor is responsible for.

    Args:
        processes: those of the plan that this supervisor is responsible for.
        options: what the person asked for.
        variables: set in every process, below what the plan sets.
        logs: the directory of the processes' log files.

    Attributes:
        run: what is decided by; changed by the supervisor's loop alone.
        nodes: by key.
        processes: by name, those that were started; the last one of each name.
        remote: the plan's other nodes, which another supervisor brings up, by key.
        machines: those whose nodes it brings up; None if that is all of them.
        logs: likewise, with what could not be written there.
        adopted: the nodes that ran before it, by full name, with the process that each is in as
            people read it, empty where that is not known; None if none is to be adopted.
        touch: called whenever something may be other than it was judged: time to judge again.
        on_health: likewise with a node that may be as healthy as others wait for.
        liveliness: which nodes are silent.
        present: names of the nodes that are in the graph; None before it was first looked at.
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
        options: UpOptions,
        variables: tuple[tuple[str, str], ...] = (),
    ) -> None:
        own = tuple(processes)
        self._own = frozenset(each.name for each in own)
        self.run: Run = new_run(plan, options, own=self._own)
        self.expected = plan
        self.server: ManagedProcess | None = None
        self.emit = emit
        self.logs = LogDirectory(logs, lambda text: emit(Notice(message=text)))
        self._variables = variables
        self.processes: dict[str, ManagedProcess] = {}
        self.nodes: dict[str, NodeRun] = {}
        self.remote = {key: plan.node(key) for key in self.run.elsewhere}
        self.machines = frozenset(each.machine for each in own) if self.remote else None
        self._by_name: dict[str, NodeRun] = {}
        self.adopted: dict[str, str] | None = None
        self.touch: Callable[[], None] = lambda: None
        self.on_health: Callable[[NodeRun], None] = lambda _: None
        self.present: frozenset[str] | None = None
        self.liveliness = SilenceMonitor(emit, self._is_there)
        self.follow()

    @property
    def plan(self) -> Plan:
        """As it must be now: in its mode, with the ports of what was started again."""
        return self.run.plan

    @property
    def first(self) -> Plan:
        """As it was made from the manifest in force, without what became of it since."""
        return self.run.first

    def follow(self) -> None:
        """Have nodes and processes be those of the run, as another manifest has others."""
        run = self.run
        if run.nodes.keys() == self.nodes.keys() and all(
            self.nodes[key].core is core for key, core in run.nodes.items()
        ):
            return
        known = self.nodes
        self.nodes = {
            key: known[key] if key in known and known[key].core is core else NodeRun(self, core)
            for key, core in run.nodes.items()
        }
        self._by_name = {node.name: node for node in self.nodes.values()}
        self.processes = {
            name: each for name, each in self.processes.items() if name in run.processes
        }

    def adopt(self, running: Mapping[str, str]) -> None:
        """Attach to the nodes that run already, before anything is begun; to no other from now on.

        Args:
            running: where each node of the graph runs, by full name.

        Raises:
            UsageError: of a process with several nodes only some run.
        """
        self.adopted = {name: where for name, where in running.items() if name in self._by_name}
        if not self.adopted:
            self.emit(Notice(message="nothing is adopted: no node of the manifest runs yet"))
        self.expected = plan = started_by_others(self.plan, self.adopted)
        self.run = new_run(plan, self.run.options, own=self._own)
        self.follow()

    def attached(self, plan: Plan) -> Plan:
        """Return a plan that attaches to the nodes that were adopted, as ours does."""
        adopted = self.adopted or ()
        return attached_to(plan, {each.key for each in plan.nodes if each.full_name in adopted})

    def make_process(self, planned: PlannedProcess) -> ManagedProcess:
        """Return a process of this run, not yet started."""
        nodes = [self.plan.node(key) for key in planned.nodes]
        return ManagedProcess(
            planned,
            logs=self.logs,
            emit=self.emit,
            variables=self._variables,
            # A host of ours deactivates its nodes and shuts them down.
            grace_s=GRACE_S
            + sum(
                each.timeouts.deactivate_s + each.timeouts.shutdown_s
                for each in nodes
                if planned.run.kind is RunKind.PYTHON
            ),
        )

    def have_hosts(
        self,
        operation: Operation,
        apart: Callable[[ManagedProcess], tuple[str, ...]] = lambda _: (),
    ) -> None:
        """Have our hosts do something with all of their process; nothing waits for it."""
        for each in self.processes.values():
            if each.channel is not None and not each.ended.done():
                node = self.nodes[each.planned.nodes[0]].name
                each.channel.send(Command(node=node, operation=operation, apart=apart(each)))

    def carried_by(self, process: str) -> tuple[NodeRun, ...]:
        """Return the nodes that are gone with a process, loaded components included."""
        carrier = self.run.processes.get(process)
        nodes = self.nodes.values() if carrier is not None else ()
        return tuple(node for node in nodes if self.run.process_of(node.core) is carrier)

    def node_named(self, name: str) -> NodeRun | None:
        """Return the node with this fully qualified name."""
        return self._by_name.get(name)

    def over(self) -> dict[str, str]:
        """Return how the process ended of each node that has ended by itself as it may."""
        found = {}
        for node in self.nodes.values():
            process = self.run.processes.get(node.core.process)
            if process is not None and process.is_over and process.end is not None:
                found[node.name] = process.end.text
        return found

    def _is_there(self, name: str) -> bool:
        """Whether a node has started, and is in the graph as far as that is known."""
        node = self._by_name.get(name)
        if node is not None and node.core.level is Level.DOWN:
            return False
        return self.present is None or name in self.present

    def is_adopted(self, node: NodeRun) -> bool:
        """Whether a node that others started is taken as it is found, also where it is active."""
        others = not node.core.process and not node.planned.run.component
        return others and self.adopted is not None

    @property
    def living(self) -> tuple[ManagedProcess, ...]:
        """Every process that was started and has not ended, the discovery server included."""
        every = (*self.processes.values(), *(() if self.server is None else (self.server,)))
        return tuple(each for each in every if each.pid and not each.ended.done())

    def on_host_event(self, event: HostEvent) -> None:
        """Take a host's event about one of its nodes, in the order in which it comes.

        Of a reply this is the configuration, if any, which may have changed; the rest is for who
        asked.
        """
        node = self._by_name.get(event.node)
        if node is None:
            return
        if event.kind == "measured":
            if node.configuration is not None:  # the next look has it
                node.configuration = replace(node.configuration, measured=event.measured)
            return
        if event.kind == "destroyed":
            node.is_destroyed = True
        if event.configuration is not None:
            node.configuration = event.configuration
        if event.kind != "reply" and event.state:
            node.report(event.state, connected=event.connected)
        self.on_health(node)
        if event.kind != "reply":
            self.touch()

    async def refresh(self, observer: Graph, *, marks: bool = False) -> None:
        """Give the observer what every reachable node reports of itself.

        A host reports every change by itself; one that has not begun to is asked, and does not
        hold up a look for long. A node that does not answer keeps its last configuration: that it
        is gone is for the graph and its process to say. With `marks` those are asked, too, of
        which a DSCP is declared: no event says that another was set.
        """
        nodes = [
            node
            for node in self.nodes.values()
            if node.driver is not None
            and node.core.level >= (Level.CONFIGURED if node.planned.managed else Level.STARTED)
            and not node.core.stuck
            and node.name not in self.liveliness.silent
        ]

        async def ask(driver: ControlDriver) -> None:
            with contextlib.suppress(BringUpError, asyncio.TimeoutError):
                await asyncio.wait_for(driver.interface(), _REFRESH_S)

        def is_asked(node: NodeRun) -> bool:
            has_dscp = any(each.dscp is not None for each in node.planned.endpoints)
            return node.configuration is None or (marks and has_dscp)

        drivers = (each.driver for each in nodes if is_asked(each))
        await asyncio.gather(*(ask(each) for each in drivers if isinstance(each, ControlDriver)))
        for node in nodes:
            if node.configuration is not None:
                observer.state.put_configuration(node.configuration)


def level_of(node: NodeRun) -> Level:
    """Return how far a node is by what it said of itself; where it said nothing, what is noted."""
    if not node.planned.managed or not node.state:
        return node.core.level
    return reached(node.state, connected=node.connected)


def reached(state: str, *, connected: bool) -> Level:
    """Return how far a managed node is in a state, by its lifecycle_msgs/State label."""
    if state == INACTIVE:
        return Level.CONNECTED if connected else Level.CONFIGURED
    return Level.ACTIVE if state == ACTIVE else Level.STARTED
