"""What is true of one run now: `Run`, its nodes, processes and orders.

Owns: the types that `take` changes and `advance` reads, and the words for how far a node is. All of
a run is here: nothing is kept in a coroutine, a timer or a callback. Pure.

    node     DOWN ─start▶ STARTED ─configure▶ CONFIGURED ─connect▶ CONNECTED ─activate▶ ACTIVE
                  ◀shutdown       ◀cleanup             ◀disconnect         ◀deactivate
    process  none ─spawn▶ STARTING ─nodes are there▶ RUNNING ─▶ STOPPING ─▶ EXITED ─swept▶ none
"""

from __future__ import annotations

import enum
from collections import deque
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING

import msgspec

from lifecycle.errors import ExitCode
from lifecycle.manifest.model import (
    After,
    Authority,
    Condition,
    DataLayerSource,
    OnFailure,
    Readiness,
    RunKind,
    Supervision,
    TargetState,
)
from lifecycle.plan.comparison import GivenParameters, PlanChange
from lifecycle.plan.model import Plan, PlannedNode, PlannedProcess
from lifecycle.supervisor.control.protocol import Failed, ProcessState, Question
from lifecycle.supervisor.run.events import Failure
from lifecycle.supervisor.run.options import Until, UpOptions
from lifecycle.verify.verdict import FindingKey, FlowReport, Verdict

if TYPE_CHECKING:
    from lifecycle.supervisor.core.messages import Exited

NEVER_S = float("inf")


class Level(enum.IntEnum):
    """How far a node is, or is to be."""

    DOWN = 0
    STARTED = 1
    CONFIGURED = 2
    CONNECTED = 3
    ACTIVE = 4


class Step(enum.Enum):
    """What is asked of one node; answered by one `Replied`."""

    START = "start"  # be there: its host is ready, it appears, its container has loaded it
    CONFIGURE = "configure"
    WIRE = "wire"  # the authority's connections and mappings
    CONNECT = "connect"
    ACTIVATE = "activate"
    DEACTIVATE = "deactivate"
    DISCONNECT = "disconnect"
    CLEANUP = "cleanup"
    SHUTDOWN = "shutdown"
    UNLOAD = "unload"


UP = {
    Level.STARTED: Step.START,
    Level.CONFIGURED: Step.CONFIGURE,
    Level.CONNECTED: Step.CONNECT,
    Level.ACTIVE: Step.ACTIVATE,
}
"""The step that reaches a level from the one below it."""

DOWNWARDS = {
    Level.ACTIVE: Step.DEACTIVATE,
    Level.CONNECTED: Step.DISCONNECT,
    Level.CONFIGURED: Step.CLEANUP,
    Level.STARTED: Step.SHUTDOWN,
}
"""The step that leaves a level."""

REACHES = {
    **{step: level for level, step in UP.items()},
    **{step: Level(level - 1) for level, step in DOWNWARDS.items()},
    Step.WIRE: Level.CONFIGURED,
    Step.UNLOAD: Level.DOWN,
}
"""Where a managed node is after a step."""

HOLDS = {
    Condition.STARTED: Level.STARTED,
    Condition.CONFIGURED: Level.CONFIGURED,
    Condition.CONNECTED: Level.CONNECTED,
    Condition.ACTIVE: Level.ACTIVE,
    Condition.HEALTHY: Level.ACTIVE,
}
"""The level that a condition of `after` stands for, in both nodes."""


def held_level(node: PlannedNode, condition: Condition | Readiness) -> Level:
    """Return the level whose step a condition of its `after` holds in a node."""
    if not node.managed:
        return Level.STARTED
    return Level.CONFIGURED if isinstance(condition, Readiness) else HOLDS[condition]


def limit_of(node: PlannedNode, step: Step) -> float:
    """Return the seconds that the manifest gives a node for a step."""
    limits = node.timeouts
    return {
        Step.START: limits.start_s,
        Step.CONFIGURE: limits.configure_s,
        Step.WIRE: limits.connect_s,
        Step.CONNECT: limits.connect_s,
        Step.ACTIVATE: limits.activate_s,
        Step.DEACTIVATE: limits.deactivate_s,
        Step.SHUTDOWN: limits.shutdown_s,
    }.get(step, limits.cleanup_s)


class Request(msgspec.Struct, kw_only=True):
    """The one request to a node that is not answered yet.

    Attributes:
        limit_s: that the manifest sets; `own_s` more for who keeps it itself and says why.
        waited_s: of the time since, without CPU: it does not count.
        said: it was said that it takes long.
    """

    number: int
    step: Step
    since_s: float
    limit_s: float
    own_s: float = 0.0
    waited_s: float = 0.0
    said: bool = False


_MANAGED = {
    TargetState.UNCONFIGURED: (Level.DOWN, Level.STARTED),
    TargetState.INACTIVE: (Level.DOWN, Level.STARTED, Level.CONFIGURED, Level.CONNECTED),
    TargetState.ACTIVE: tuple(Level),
}
_PLAIN = (Level.DOWN, Level.STARTED, Level.ACTIVE)


class Node(msgspec.Struct, kw_only=True):
    """One node that this supervisor brings up.

    Attributes:
        base: how far it was found; it is not taken further down. DOWN for one that we start.
        wired: the authority has connected it as it is to be.
        stuck: a request to it was given up; a further one would wait behind it.
        silent: why it cannot be reached; empty while it can.
        hangs: why its process's watchdog is to end it, if it has one; empty while it does not hang.
        hangs_s: since when it does.
        shown: what others wait for of it, as far as the graph shows it.
        appeared: it has been in the graph, of one that is not in our host.
        renew: it is to go down once, whatever it is wanted to be.
        due_s: it is not started before.
        withheld: why a consequence keeps it inactive until a person lets it through the gate.
        refused: its gate stayed closed for an order; it is let through by the next one.
        let_through: it was sent its activate request, and may be active.
        guarded: how often it was deactivated because others activated it.
    """

    planned: PlannedNode
    level: Level = Level.DOWN
    base: Level = Level.DOWN
    request: Request | None = None
    wired: bool = False
    healthy: bool = False
    stuck: bool = False
    silent: str = ""
    hangs: str = ""
    hangs_s: float = NEVER_S
    shown: frozenset[Readiness] = frozenset()
    appeared: bool = False
    renew: bool = False
    due_s: float = 0.0
    withheld: str = ""
    refused: bool = False
    let_through: bool = False
    guarded: int = 0

    @property
    def key(self) -> str:
        """Its key in the manifest."""
        return self.planned.key

    @property
    def name(self) -> str:
        """Fully qualified node name."""
        return self.planned.full_name

    @property
    def process(self) -> str:
        """Name of its process; empty for one that this supervisor does not start."""
        return "" if self.planned.run.kind is RunKind.ATTACH else self.planned.process

    @property
    def levels(self) -> tuple[Level, ...]:
        """The levels that it has, in order: a plain node is neither configured nor connected."""
        if self.planned.managed:
            return _MANAGED[self.planned.state]
        return _PLAIN if self.is_gated else _PLAIN[:-1]

    @property
    def gate(self) -> Level:
        """The level at which it waits for the gate, or is left without one."""
        levels = self.levels
        return levels[-2] if levels[-1] is Level.ACTIVE else levels[-1]

    @property
    def is_gated(self) -> bool:
        """Whether the manifest has it active, by leave of the gate."""
        return self.planned.holds and self.planned.state is TargetState.ACTIVE

    @property
    def is_down(self) -> bool:
        """Whether nothing is left to undo; what others run and does not answer is left to them."""
        given_up = self.stuck and not self.process
        return self.request is None and (self.level <= self.base or given_up)

    @property
    def may_be_at(self) -> Level:
        """The highest level that it may have: a request that is not answered may be carried out."""
        asked = Level.DOWN if self.request is None else self.after(self.request.step)
        return max(self.level, asked)

    def after(self, step: Step) -> Level:
        """Return the level that it has after a step; a plain node has none between."""
        is_plain = step is Step.DEACTIVATE and not self.planned.managed
        return Level.STARTED if is_plain else REACHES[step]


Escalation = tuple[tuple[int, float], ...]
"""Steps to end a process: (signal number, 0 to close its channel; seconds until the next)."""


class Process(msgspec.Struct, kw_only=True):
    """One process that this supervisor starts.

    Attributes:
        state: None before it is started, and once nothing is left of it.
        end: how it ended; None while it has not.
        log: file with its output; empty before it was started.
        sweeping: what it left is being ended, and forgotten by the graph.
        how: it is supervised, as the manifest says.
        restarts: how often it was started again after a failure.
        starts: when it was started, by all that its start limit counts.
        in_a_row: its failures without a long run between them.
        failure: its last one.
        failed: it is started next because it failed.
        away_s: when it failed; None once it is as far again as it is to be.
        escalation: what is left of the steps to end it; None before it is asked to end.
        asked_until_s: then the next one is taken.
        sent: signals that it was sent.
        stays_down: it is not started again: it ended as it may, or the run goes on without it.
    """

    planned: PlannedProcess
    how: Supervision
    may_end: bool = False
    state: ProcessState | None = None
    pid: int = 0
    end: Exited | None = None
    log: str = ""
    sweeping: bool = False
    restarts: int = 0
    starts: list[float] = []
    in_a_row: int = 0
    failure: Failed | None = None
    failed: bool = False
    away_s: float | None = None
    escalation: Escalation | None = None
    asked_until_s: float = NEVER_S
    sent: list[int] = []
    stays_down: bool = False

    @property
    def name(self) -> str:
        """The planned name."""
        return self.planned.name

    def started(self, now_s: float) -> None:
        """Count a start: StartLimitBurst= applies to all kinds of them (systemd.unit(5))."""
        self.restarts += self.failed
        # Without a limit they are not counted, and must not pile up.
        kept = self.starts if self.how.start_limit_interval_sec else []
        self.starts, self.failed = [*kept, now_s], False

    def restarted_by_hand(self) -> None:
        """Note that a person starts it again: what failed before is forgotten."""
        self.starts, self.in_a_row, self.failed = [], 0, False
        self.away_s, self.stays_down = None, False

    @property
    def is_alive(self) -> bool:
        """Whether it was started and has not ended."""
        return self.state in (ProcessState.STARTING, ProcessState.RUNNING, ProcessState.STOPPING)

    @property
    def is_over(self) -> bool:
        """Whether it ended by itself as all of its nodes may: with exit status 0."""
        return self.may_end and self.end is not None and self.end.status == 0


class Order(Question, kw_only=True, frozen=True):
    """What a person, or a ROS client, has ordered.

    Attributes:
        plan: of the manifest that an order names, as it is now; None if it names none.
        id: by which it is answered, once.
    """

    plan: Plan | None = None
    id: int = 0


class Passage(msgspec.Struct, kw_only=True):
    """Nodes are to pass the gate: for a bring-up, an order, or as policy started them again.

    They come to the gate; it opens for those that wait at it once a verdict allows it; and they
    have passed once the next verdict finds them as they were verified.

    Attributes:
        until_s: when its time is over; it begins anew when all are at the gate.
        asked: for a bring-up or an order, which ends with it; policy's nodes go on waiting.
        until: CONNECTED: they are only to come to the gate, VERIFIED: it is only judged, ACTIVE: it
            lets them through.
        mode: to go back to where the gate stays closed; empty for a passage of another kind.
        mark: of the moment at which the nodes had come to the gate, at `since_s`; None before.
        tries: how often nodes were started again at it.
        said: it was said what the gate waits for.
        begun_s: when a verdict opened the gate; None before.
        waiting: keys of the nodes that it is for; `sent`: of those that were sent their requests.
        flows: that networks are to have; None until that is asked for.
        programming: number of the request to program networks with them; 0 if none is open.
        opened: networks have them, and nodes are asked as far as nothing changes.
        paused: the system was paused before.
    """

    until_s: float
    asked: bool = True
    until: Until = Until.ACTIVE
    mode: str = ""
    mark: int | None = None
    tries: int = 0
    since_s: float = NEVER_S
    said: bool = False
    begun_s: float | None = None
    waiting: tuple[str, ...] = ()
    sent: set[str] = msgspec.field(default_factory=set)
    flows: tuple[FlowReport, ...] | None = None
    programming: int = 0
    opened: bool = False
    paused: bool = False

    @property
    def at_gate(self) -> bool:
        """Whether its nodes have come as far."""
        return self.mark is not None

    @property
    def is_programmed(self) -> bool:
        """Whether networks have the flows."""
        return self.flows is not None and not self.programming


class Switch(msgspec.Struct, kw_only=True):
    """Another mode than `before` is being entered; `back`: as its gate or a node refused one."""

    before: str
    back: bool = False


class Change(msgspec.Struct, kw_only=True):
    """Another manifest is being applied, or taken back.

    Attributes:
        before: the manifest that was in force; likewise revision and mode.
        active: keys of the nodes that were active, or had failed and were to be again.
        touched: keys of the nodes that were taken down, or are new.
        down: keys of the nodes that go down before the manifest is taken.
        given: what nodes were asked to take; who did not answer may have taken it.
        taken: the manifest is in force.
        back: the system goes back to the manifest before.
        again: what failed meanwhile, and is started again by its policy; empty if nothing.
    """

    plan: Plan
    change: PlanChange
    before: Plan
    revision: int
    mode: str
    active: frozenset[str]
    timeout_s: float
    until_s: float
    touched: set[str] = msgspec.field(default_factory=set)
    down: set[str] = msgspec.field(default_factory=set)
    given: dict[str, GivenParameters] = {}
    taken: bool = False
    back: bool = False
    reason: str = ""
    code: ExitCode = ExitCode.OK
    again: str = ""


class Judged(msgspec.Struct, kw_only=True):
    """What is known by verdicts; see gate.py.

    Attributes:
        verdict: the latest; None before the first.
        mark: of the moment that it is of.
        waits: something is awaited that may speak against it: it opens nothing.
        again_s: look again then, although nothing is known to have changed.
        seen_s: when it came.
        away: full names of the nodes that were not as far as they are to be when its look began.
        since_s: since when its findings are the same, `found`.
        violated: since when each violation lasts.
        counted: the first that lasted, as text; it is in the exit code.
        passed: what was violated, and whether it lasted.
        tried: those for which a mode was entered.
    """

    verdict: Verdict | None = None
    mark: int = -1
    waits: bool = False
    looking: bool = False
    again_s: float = NEVER_S
    seen_s: float = 0.0
    away: frozenset[str] = frozenset()
    since_s: float = 0.0
    found: frozenset[tuple[str, str]] = frozenset()
    violated: dict[FindingKey, float] = {}
    counted: str = ""
    passed: dict[str, bool] = {}
    tried: set[FindingKey] = msgspec.field(default_factory=set)


class Ending(msgspec.Struct, kw_only=True):
    """Why the run ends: in short, and as the report has it; `failed`: as nobody asked for.

    `deaths`: how many had died before, and the run went on without them.
    """

    code: ExitCode
    stopping: str
    reason: str
    failures: tuple[Failure, ...] = ()
    failed: bool = False
    deaths: int = 0

    @property
    def why(self) -> str:
        """What failed, as people read it; else the reason."""
        return "; ".join(each.message for each in self.failures) or self.reason


class Run(msgspec.Struct, kw_only=True):
    """One run of one system: all that its supervisor decides by.

    Attributes:
        plan: as it must be now: in its mode, with the ports of what was started again.
        first: as it was made from the manifest in force.
        undeclared: nodes that the graph showed, and no manifest declares, when one was last missed.
        elsewhere: conditions that nodes of other supervisors have reached, by key.
        left: full names of nodes whose supervisor was shut down, and said so.
        early: keys of the nodes that are configured before any node is wired.
        again: plain nodes have come again: they wait at no gate, and what they brought along is
            verified, and programmed, like that of those who do.
        mark: counts what may change a verdict.
        requests: counts what nodes were asked.
        to_give: parameters of running nodes that are set first, None for all of its mode; `giving`:
            keys of the nodes that have to answer.
        undone: how the order under way is answered once what it did is undone.
        furthest: "connected", "verified" or "active", as far as it came; empty before.
        held_s: since when it is held; None before it was up.
        decided_s: since when what is declared of its data is decided, as far as it can be before
            long; None before.
        measures_s: since when its data are measured, anew after each pause until they are decided.
        probation: the mark from which on looks measure.
        pauses: it is to be said that it is paused, once nothing is active.
        failures: that end the run, as soon as what is in a step has failed, too, or not.
        fails_s: then it ends all the same.
        deaths: of processes that died while they were taken down, or that the run went on without.
        outbox: answers to orders that have not been sent.
        wake_s: the next moment that something was asked about since the last input, see `is_past`.
    """

    options: UpOptions
    plan: Plan
    first: Plan
    nodes: dict[str, Node]
    processes: dict[str, Process]
    undeclared: frozenset[str] = frozenset()
    elsewhere: dict[str, frozenset[Condition | Readiness]] = {}
    left: frozenset[str] = frozenset()
    early: frozenset[str] = frozenset()
    revision: int = 1
    revisions: int = 1
    mode: str = ""
    now_s: float = 0.0
    again: bool = False
    mark: int = 0
    requests: int = 0
    judged: Judged = msgspec.field(default_factory=Judged)
    to_give: dict[str, GivenParameters | None] = {}
    giving: set[str] = msgspec.field(default_factory=set)
    undone: tuple[ExitCode, str] | None = None
    furthest: str = ""
    held_s: float | None = None
    decided_s: float | None = None
    measures_s: float = 0.0
    probation: int = 0
    paused: bool = False
    pauses: bool = False
    passage: Passage | None = None
    orders: deque[Order] = msgspec.field(default_factory=deque)
    order: Order | None = None
    switch: Switch | None = None
    change: Change | None = None
    failures: list[Failure] = []
    fails_s: float = NEVER_S
    ending: Ending | None = None
    deaths: list[Failure] = []
    hurry: bool = False
    outbox: list[tuple[int, ExitCode, str]] = []
    wake_s: float = NEVER_S
    trusted: str = ""

    @property
    def timeout_s(self) -> float:
        """Seconds for a bring-up, and for each order."""
        return self.options.bring_up_s(len(self.processes))

    @property
    def wires(self) -> bool:
        """Whether an authority connects nodes between their configure and their connect."""
        return self.plan.data_layer.authority is Authority.SUPERVISOR

    @property
    def is_over(self) -> bool:
        """Whether it has ended and nothing of it runs."""
        return (
            self.ending is not None
            and all(each.state is None for each in self.processes.values())
            and all(
                each.level <= each.base or each.stuck or each.silent or self.hurry
                for each in self.nodes.values()
            )
        )

    @property
    def is_backing_off(self) -> bool:
        """Whether a node is to be started again later."""
        return not all(self.is_past(each.due_s) for each in self.nodes.values())

    @property
    def away(self) -> frozenset[str]:
        """Full names of the nodes that are not as far as their manifest has them."""
        return frozenset(
            each.name
            for each in self.nodes.values()
            if each.level < each.levels[-1] or each.renew or not self.is_past(each.due_s)
        )

    @property
    def ahead(self) -> frozenset[str]:
        """Full names of the nodes that may be active before the gate opens for others."""
        return frozenset(
            each.name
            for each in self.nodes.values()
            if each.let_through or each.level is Level.ACTIVE
        )

    @property
    def asked(self) -> Passage | None:
        """The passage that a bring-up or an order asks for; None if none does."""
        return self.passage if self.passage is not None and self.passage.asked else None

    @property
    def opening(self) -> Passage | None:
        """The passage for which a verdict has opened the gate; None if it has for none."""
        passage = self.passage
        return None if passage is None or passage.begun_s is None else passage

    def shut_gate(self) -> None:
        """Have who asked for the gate begin at it anew; who did not waits again by itself."""
        self.passage = passage = self.asked
        if passage is not None:
            passage.begun_s, passage.waiting, passage.sent = None, (), set()
            passage.flows, passage.programming, passage.opened = None, 0, False

    @property
    def is_changing(self) -> bool:
        """Whether a manifest or mode is being changed to, or back to, and is not in force yet."""
        return self.switch is not None or (self.change is not None and not self.change.taken)

    @property
    def is_watched(self) -> bool:
        """Whether it was up and is active, at least in part: then all that changes is looked at."""
        active = any(each.level is Level.ACTIVE for each in self.nodes.values())
        gated = any(each.is_gated for each in self.nodes.values())
        return self.held_s is not None and (active or not gated)

    def is_past(self, at_s: float) -> bool:
        """Return whether a moment is over; one that is still to come wakes the run.

        What is decided by time is decided by this: so it is decided again as soon as it may differ.
        """
        if self.now_s >= at_s:
            return True
        self.wakes_at(at_s)
        return False

    def wakes_at(self, at_s: float) -> None:
        """Have a tick come then, or at once if that is over; before that anything else may."""
        self.wake_s = min(self.wake_s, max(at_s, self.now_s))

    def mode_by(self, plan: Plan) -> str:
        """Return the mode that it would be in by another manifest: the same, if that has it."""
        names = [each.name for each in plan.modes]
        return self.mode if self.mode in names else next(iter(names), "")

    def node_named(self, name: str) -> Node | None:
        """Return the node with this fully qualified name; None if it is not ours."""
        return next((each for each in self.nodes.values() if each.name == name), None)

    def nodes_of(self, process: str) -> Iterator[Node]:
        """Yield the nodes in a process."""
        return (each for each in self.nodes.values() if each.process == process)

    def process_of(self, node: Node) -> Process | None:
        """Return the process that a node is in: a component's is its container's."""
        container = self.nodes.get(node.planned.run.container)
        name = node.process if container is None else container.process
        return self.processes.get(name)

    def dependents(self, key: str) -> Iterator[Node]:
        """Yield the nodes that depend on one: those that go down before it."""
        return (
            each
            for each in self.nodes.values()
            if each.planned.run.container == key
            or any(after.node == key for after in each.planned.after)
        )

    def answer(self, code: ExitCode, error: str = "") -> None:
        """Answer the order that is carried out, and be done with it."""
        if self.order is not None:
            code, error = self.undone or (code, error)
            self.outbox.append((self.order.id, code, error))
        self.order, self.undone = None, None

    def fails_now(self, *failures: Failure) -> None:
        """End at once for what failed, whatever is to be kept going."""
        self.failures, self.fails_s = [*self.failures, *failures], self.now_s

    def whole(self, keys: Iterable[str], *, dependents: bool = False) -> tuple[str, ...]:
        """Return the keys with those of all that comes and goes with these nodes, in plan order.

        A component goes with its container, a node with all others of its process, and `dependents`
        with the nodes that they depend on.
        """
        found, more = set[str](), set(keys)
        while more != found:
            found, processes = set(more), {self.nodes[key].process for key in more} - {""}
            for key, node in self.nodes.items():
                depends = dependents and any(after.node in found for after in node.planned.after)
                if depends or node.process in processes or node.planned.run.container in found:
                    more.add(key)
        return tuple(key for key in self.nodes if key in found)

    def group(self, process: str) -> tuple[str, ...]:
        """Return the keys of the nodes that go down and come again with a process that failed."""
        members = [*self.nodes_of(process)]
        how = {each.planned.supervision.on_failure for each in members}
        if OnFailure.ALL in how:
            return tuple(self.nodes)
        keys = (each.key for each in members)
        return self.whole(keys, dependents=OnFailure.DEPENDENTS in how)

    def changed(self) -> None:
        """Note that something may be other than the last verdict saw it."""
        self.mark += 1


def new_run(plan: Plan, options: UpOptions, *, own: frozenset[str] | None = None) -> Run:
    """Return a run that begins now; `own`: names of the processes it starts, None for all."""
    run = Run(options=options, plan=plan, first=plan, nodes={}, processes={})
    run.mode = run.mode_by(plan)
    install(run, plan, own=own)
    run.elsewhere = {each.key: frozenset() for each in plan.nodes if each.key not in run.nodes}
    run.passage = Passage(until_s=run.timeout_s, until=options.until)
    return run


def install(run: Run, plan: Plan, *, own: frozenset[str] | None = None) -> None:
    """Give a run the nodes and processes of a plan; those that it has keep what is true of them."""
    nodes, processes = run.nodes, run.processes
    run.plan, run.nodes, run.processes = plan, {}, {}
    for planned in plan.processes:
        if own is not None and planned.name not in own:
            continue
        members = [plan.node(key) for key in planned.nodes]
        if planned.run.kind is not RunKind.ATTACH:
            supervision = members[0].supervision if members else Supervision()
            process = processes.get(planned.name) or Process(planned=planned, how=supervision)
            process.planned, process.how = planned, supervision
            process.may_end = bool(members) and all(each.may_end for each in members)
            run.processes[planned.name] = process
        for each in members:
            node = run.nodes[each.key] = nodes.get(each.key) or Node(planned=each)
            node.planned = each
    run.early = _configured_before_any_connect(run)


_BEYOND = (Condition.CONNECTED, Condition.ACTIVE, Condition.HEALTHY)
"""What needs the data layer."""


def _configured_before_any_connect(run: Run) -> frozenset[str]:
    """Return the keys of the managed nodes that no `after:` holds behind a connect.

    None where nothing is negotiated: what a negotiation waits for must not wait for a connection.

    A managed node's start waits for `started` alone and its configure for `configured`, and for
    what others show, which they may have once they are connected; but the start of a plain node
    waits for any condition, and a node that depends on it waits with it.
    """
    if run.plan.data_layer.source is not DataLayerSource.DYNAMIC:
        return frozenset()
    planned = {key: node.planned for key, node in run.nodes.items()}
    held: set[str] = set()

    def is_held(node: PlannedNode, after: After) -> bool:
        if held_level(node, after.condition) > Level.CONFIGURED:
            return False
        connects = after.node not in planned or planned[after.node].managed
        beyond = after.condition in _BEYOND or isinstance(after.condition, Readiness)
        return after.node in held or (connects and beyond)

    while more := {
        key
        for key, node in planned.items()
        if key not in held and any(is_held(node, after) for after in node.after)
    }:
        held |= more
    return frozenset(key for key, node in planned.items() if node.managed and key not in held)
