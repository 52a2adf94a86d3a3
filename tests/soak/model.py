"""What is done to the system in each round, and what must follow by its policies: pure.

Owns: `PROCESSES`, the system; `plan`, the rounds that a seed stands for; and `follows`, what must
come of a round, from what the manual says of the policies (docs/supervision.md) and nothing else.
"""

from __future__ import annotations

import dataclasses
import enum
import random
from collections.abc import Iterable

DECLARED_RATE = 1.0
WATCHDOG_S = 1.5
SILENT_S = 0.8
ENDED_6, ENDED_7, ENDED_4 = 6, 7, 4


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Process:
    """A process and its policies, as the manifest has them.

    Attributes:
        nodes: keys, which are the nodes' names, too.
        takes_down: keys of all nodes that go down and come again with it.
        orders: its nodes take orders (tests.soak.nodes).
        violation: what a parameter that differs has done: `deactivate`, `pause`, `stop`.
    """

    name: str
    nodes: tuple[str, ...]
    restart: str = "on-failure"
    takes_down: tuple[str, ...] = ()
    burst: int | None = None
    orders: bool = True
    violation: str = "report"


_ALL = ("base", "arm", "camera", "filter", "detector", "core", "fragile", "lone", "pool", "part")
SAFE_INACTIVE = ("arm", "camera")
"""Kept inactive in mode `safe`."""
UNMANAGED = ("pool",)

PROCESSES = (
    Process(name="base", nodes=("base",), takes_down=("base", "arm")),
    Process(name="arm", nodes=("arm",), takes_down=("arm",), violation="pause"),
    Process(name="camera", nodes=("camera",), takes_down=("camera",), violation="deactivate"),
    Process(
        name="vision",
        nodes=("filter", "detector"),
        restart="always",
        takes_down=("filter", "detector"),
    ),
    Process(name="core", nodes=("core",), takes_down=_ALL),
    Process(name="fragile", nodes=("fragile",), takes_down=("fragile",), burst=2),
    Process(name="lone", nodes=("lone",), restart="no", takes_down=("lone",), violation="stop"),
    Process(name="pool", nodes=("pool",), takes_down=("pool", "part"), orders=False),
)
NODES = _ALL


def process(name: str) -> Process:
    """Return the process of a name."""
    return next(each for each in PROCESSES if each.name == name)


class Kind(enum.Enum):
    """What is done to a process."""

    KILL = "kill"
    EXIT_9 = "exit9"
    EXIT_0 = "exit0"
    RAISE = "raise"
    STOP = "stop"
    SLEEP = "sleep"
    SPIN = "spin"
    LOCK = "lock"
    STOP_BRIEFLY = "stop_briefly"
    STUMBLE = "stumble"  # killed, and fails once in a step when it comes again
    ALTER = "alter"  # a parameter has another value than was declared
    STRAY = "stray"  # publishes what was not declared


DIES = frozenset({Kind.KILL, Kind.EXIT_9, Kind.EXIT_0, Kind.RAISE, Kind.STUMBLE})
HANGS = frozenset({Kind.STOP, Kind.SLEEP, Kind.SPIN, Kind.LOCK})
VIOLATES = frozenset({Kind.ALTER, Kind.STRAY})
_STEPS = ("construct", "configure", "connect", "activate")
_WAYS = ("raise", "exit9", "sleep")


class Condition(enum.Enum):
    """What is so while it is done."""

    NONE = "none"
    CUT = "cut"  # no UDP arrives
    LINK_DOWN = "link_down"  # the loopback is down: sending fails
    DISK_FULL = "disk_full"
    FROZEN = "frozen"  # the supervisor is stopped: its clock jumps when it goes on
    INTRUDER = "intruder"  # a node that was not declared: the gate must stay closed
    PAUSED = "paused"
    SAFE = "safe"  # mode
    STORM = "storm"  # several `lifecycle restart` at once
    SUPERVISOR_KILLED = "supervisor_killed"  # and started again
    APPLY = "apply"  # another manifest is applied; the faults come while that is done


NEEDS_ROOT = frozenset({Condition.CUT, Condition.LINK_DOWN, Condition.DISK_FULL})


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Manifest:
    """How the system's manifest differs from the one that a run begins with.

    Attributes:
        tint: value of a parameter of `TINTED`, which take it while they run; 0 is its default.
        issue: value of a variable in the environment of `ISSUED`, which are restarted for it.
        extra: there is one node more, `EXTRA`.
        bad: the step that a node more, `BAD`, fails in, and how; empty: it is not there.
    """

    tint: int = 0
    issue: int = 0
    extra: bool = False
    bad: str = ""

    def __str__(self) -> str:
        """How the list of a seed shows it."""
        more = f"{', extra' if self.extra else ''}{', bad ' if self.bad else ''}{self.bad}"
        return f"tint {self.tint}, issue {self.issue}{more}"


TINTED = ("base", "camera")
ISSUED = ("filter", "detector")
EXTRA, BAD = "extra", "bad"


@dataclasses.dataclass(frozen=True, slots=True)
class Fault:
    """What is done to one process; `detail` is `step way` of a stumble."""

    kind: Kind
    target: str
    detail: str = ""

    def __str__(self) -> str:
        """How the list of a seed shows it."""
        detail = f" ({self.detail})" if self.detail else ""
        return f"{self.kind.value} {self.target}{detail}"


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Round:
    """One round.

    Attributes:
        spread_s: seconds between its faults.
        lasts_s: how long the condition lasts after the first fault.
        orders: what `lifecycle restart` is asked for in a storm; empty text: the whole system.
        ends: how the run is ended after it; empty: it goes on.
        manifest: what is applied.
        later_s: seconds from the beginning of that to the first fault.
    """

    number: int
    condition: Condition
    faults: tuple[Fault, ...]
    spread_s: float = 0.0
    lasts_s: float = 0.0
    orders: tuple[str, ...] = ()
    ends: str = ""
    manifest: Manifest | None = None
    later_s: float = 0.0

    def __str__(self) -> str:
        """How the list of a seed shows it."""
        done = ", ".join(str(each) for each in self.faults) or "nothing"
        storm = f" restart {', '.join(each or 'all' for each in self.orders)}"
        what = f"{self.condition.value}{storm if self.orders else ''}"
        what += f" {self.manifest}" if self.manifest else ""
        what += f", {self.later_s:.2f} s before" if self.manifest and self.faults else ""
        lasts = f" for {self.lasts_s:.1f} s" if self.lasts_s else ""
        apart = f", {self.spread_s:.2f} s apart" if self.spread_s and len(self.faults) > 1 else ""
        then = f"; then {self.ends}" if self.ends else ""
        return f"round {self.number}: [{what}{lasts}] {done}{apart}{then}"


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class State:
    """What rounds before left of one run.

    Attributes:
        starts: how often `fragile` was started as its limit counts; None: not known.
        manifest: that is in force.
    """

    starts: int | None = 1
    manifest: Manifest = Manifest()

    @property
    def nodes(self) -> tuple[str, ...]:
        """Keys of the nodes that there are."""
        return (*NODES, EXTRA) if self.manifest.extra else NODES


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Expectation:
    """What must come of a round.

    Attributes:
        exit_codes: the run ends with one of these; empty: it goes on.
        goes_on: what is left where it goes on all the same; None: it ends for sure.
        failed: processes of which a failure is reported.
        may_fail: processes of which one may be, or that they are silent.
        silent: processes whose nodes are reported as silent.
        violated: nodes, or processes, of which a violation is reported, with its rule.
        again: nodes that come again in a new process.
        may_again: nodes of which that is not known.
        heal: orders that bring the system back; each is given until it is carried out.
        consequence: the action that is reported; empty: none.
        outcomes: what may become of the manifest that is applied; empty: none is.
    """

    exit_codes: frozenset[int] = frozenset()
    goes_on: State | None = None
    failed: frozenset[str] = frozenset()
    may_fail: frozenset[str] = frozenset()
    silent: frozenset[str] = frozenset()
    violated: frozenset[tuple[str, str]] = frozenset()
    again: frozenset[str] = frozenset()
    may_again: frozenset[str] = frozenset()
    heal: tuple[tuple[str, ...], ...] = ()
    consequence: str = ""
    outcomes: frozenset[str] = frozenset()


def follows(state: State, done: Round) -> tuple[Expectation, State]:
    """Return what must come of a round, and what it leaves for those after it."""
    if done.condition is Condition.SUPERVISOR_KILLED:
        return Expectation(may_again=frozenset(state.nodes)), State()
    failed: set[str] = set()
    again: set[str] = set()
    silent: set[str] = set()
    codes: set[int] = set()
    may_end: set[int] = set()
    starts = state.starts
    # Who goes down with another may be down before it fails itself.
    covered = {
        each.target
        for each in done.faults
        for other in done.faults
        if other.target != each.target
        and other.kind in DIES | HANGS
        and set(process(each.target).nodes) <= set(process(other.target).takes_down)
    }
    for fault in done.faults:
        own = process(fault.target)
        if fault.kind in HANGS or fault.kind is Kind.STOP_BRIEFLY:
            silent.add(own.name)
        if fault.kind not in DIES | HANGS:
            continue
        failed.add(own.name)
        if own.restart == "no" or (own.restart == "on-failure" and fault.kind is Kind.EXIT_0):
            (may_end if own.name in covered else codes).add(ENDED_6)
            continue
        again |= set(state.nodes if own.takes_down is _ALL else own.takes_down)
        for limited in (each for each in PROCESSES if each.burst is not None):
            if own is not limited:
                # Every start counts, and only an own failure has it given up.
                if starts is not None and set(limited.nodes) <= set(own.takes_down):
                    by_hand = not {"", *own.nodes}.isdisjoint(done.orders)
                    starts = None if by_hand else starts + 1
                continue
            assert starts is not None
            assert limited.burst is not None
            fails = 1 + (fault.kind is Kind.STUMBLE)
            # Another's failure may cut off the start that was to fail; it begins anew then.
            others = (each.kind for each in done.faults if each is not fault)
            cut_off = starts < limited.burst and not (DIES | HANGS).isdisjoint(others)
            if starts + fails > limited.burst:
                (may_end if cut_off else codes).add(ENDED_7)
            starts += fails
    found = [each for each in done.faults if each.kind in VIOLATES]
    violated = {
        (
            each.target,
            "param.value-differs" if each.kind is Kind.ALTER else "graph.undeclared-publisher",
        )
        for each in found
    }
    heal, consequence = _consequence(done, found)
    if consequence == "stop":
        codes.add(ENDED_4)
    if done.condition is Condition.PAUSED:
        heal = (("resume",),)
    if done.condition is Condition.SAFE:
        heal = (("mode", "normal"),)
    may = frozenset[str]()
    outcomes = frozenset[str]()
    if done.manifest is not None:
        outcomes, may = _applied(state.manifest, done)
    if done.condition is Condition.STORM:
        may = frozenset(_restarted(done.orders, state))
        if "fragile" in may:
            starts = None
    expected = Expectation(
        exit_codes=frozenset(codes | may_end),
        goes_on=State(starts=starts, manifest=state.manifest) if may_end and not codes else None,
        failed=frozenset(failed) - covered,
        may_fail=frozenset(covered),
        silent=frozenset(silent) - covered,
        violated=frozenset(violated),
        again=frozenset(again) - may,
        may_again=may,
        heal=heal,
        consequence=consequence,
        outcomes=outcomes,
    )
    if expected.exit_codes:
        return expected, State()
    # What is in force where more than one outcome is allowed the system itself says.
    taken = done.manifest is not None and outcomes == {"applied"}
    manifest = done.manifest if taken and done.manifest is not None else state.manifest
    return expected, State(starts=starts, manifest=manifest)


def _applied(before: Manifest, done: Round) -> tuple[frozenset[str], frozenset[str]]:
    """Return what may become of a manifest, and the nodes that it may restart."""
    assert done.manifest is not None
    touched = set(ISSUED) if done.manifest.issue != before.issue else set()
    touched |= {EXTRA} if done.manifest.extra != before.extra else set()
    touched |= {BAD} if done.manifest.bad else set()
    if done.manifest.bad:
        outcomes = {"rolled_back"}
    elif done.manifest == before:
        outcomes = {"unchanged"}
    else:
        outcomes = {"applied", "rolled_back"} if done.faults else {"applied"}
    return frozenset(outcomes), frozenset(touched)


def _consequence(done: Round, found: list[Fault]) -> tuple[tuple[tuple[str, ...], ...], str]:
    for fault in found:
        if fault.kind is Kind.STRAY:
            return (("mode", "normal"),), "mode"
        action = process(fault.target).violation
        return ((("resume",),) if action in ("pause", "deactivate") else ()), action
    return (), ""


def _restarted(orders: Iterable[str], state: State) -> set[str]:
    found: set[str] = set()
    for order in orders:
        own = next((each for each in PROCESSES if order in each.nodes), None)
        with_it = () if own is None else own.nodes
        found |= {*(with_it or state.nodes), *(("part",) if order == "pool" else ())}
    return found


def plan(seed: int, rounds: int) -> tuple[Round, ...]:
    """Return the rounds that a seed stands for; the first of many are those of few."""
    state, found = State(), []
    for number in range(1, rounds + 1):
        chosen = _round(random.Random(f"{seed} {number}"), number, state)
        _, state = follows(state, chosen)
        state = State() if chosen.ends else state
        found.append(chosen)
    return tuple(found)


def _round(dice: random.Random, number: int, state: State) -> Round:
    conditions = [Condition.NONE] * 8 + [each for each in Condition if each is not Condition.NONE]
    conditions += [Condition.APPLY, Condition.APPLY]
    condition = dice.choice(conditions)
    targets = [each.name for each in PROCESSES]
    ends = dice.random() < 0.08
    if state.starts is None:
        targets.remove("fragile")
    if condition in (Condition.STORM, Condition.PAUSED, Condition.SAFE, Condition.FROZEN):
        targets = [each for each in targets if each not in ("fragile", "lone")]
    if condition is Condition.APPLY:
        return _apply(dice, number, state, ends=ends)
    if condition is Condition.NONE and dice.random() < 0.25:
        kind = dice.choice(sorted(VIOLATES, key=str))
        able = [each for each in targets if process(each).violation != "report"]
        if kind is Kind.STRAY:
            able = [each for each in targets if process(each).orders]
        faults = [Fault(kind, dice.choice(able))]
        beside = [each for each in targets if each not in (faults[0].target, "core", "fragile")]
        beside = [each for each in beside if process(each).restart != "no" and each != "base"]
        if process(faults[0].target).violation != "stop" and dice.random() < 0.4:
            faults.append(Fault(Kind.KILL, dice.choice(beside)))
        return Round(number=number, condition=condition, faults=tuple(faults))
    chosen = dice.sample(targets, dice.choice((1, 1, 1, 2, 2, 3)))
    if "core" in chosen:  # it takes all down with it: how they failed is not known
        chosen = [each for each in chosen if each not in ("fragile", "lone")]
    if "lone" in chosen and dice.random() < 0.6:  # each such round ends the run
        chosen.remove("lone")
        chosen = chosen or ["base"]
    return Round(
        number=number,
        condition=condition,
        faults=tuple(_fault(dice, each, condition) for each in chosen),
        spread_s=dice.choice((0.0, 0.0, 0.02, 0.15, 0.4, 1.0)),
        lasts_s=round(dice.uniform(0.5, 3.0), 1) if condition is not Condition.NONE else 0.0,
        orders=_orders(dice) if condition is Condition.STORM else (),
        ends=dice.choice(_ENDS) if ends else "",
    )


_ENDS = ("down", "term", "interrupt")
_FAILS = tuple(f"{step} {way}" for step in _STEPS for way in ("raise", "exit9", "stray"))


def _apply(dice: random.Random, number: int, state: State, *, ends: bool) -> Round:
    """Return a round in which one or two things of the manifest change, or what is added fails."""
    new = dataclasses.asdict(state.manifest)
    for each in dice.sample(("tint", "issue", "extra"), dice.choice((1, 1, 2, 3))):
        new[each] = not new[each] if each == "extra" else new[each] + dice.choice((1, -1))
    if dice.random() < 0.4:
        new["bad"] = dice.choice(_FAILS)
    faults: tuple[Fault, ...] = ()
    if dice.random() < 0.5:
        able = [each.name for each in PROCESSES if each.restart != "no" and each.burst is None]
        faults = (Fault(dice.choice((Kind.KILL, Kind.KILL, Kind.STOP)), dice.choice(able)),)
    return Round(
        number=number,
        condition=Condition.APPLY,
        faults=faults,
        later_s=dice.choice((0.0, 0.02, 0.1, 0.3, 0.6, 1.0)),
        manifest=Manifest(**new),
        ends=dice.choice(_ENDS) if ends else "",
    )


def _orders(dice: random.Random) -> tuple[str, ...]:
    able = [each.nodes[0] for each in PROCESSES if each.name not in ("fragile", "lone")]
    return tuple(dice.sample(able, dice.randint(2, 4))) + (("",) if dice.random() < 0.3 else ())


def _fault(dice: random.Random, target: str, condition: Condition) -> Fault:
    own = process(target)
    kinds = [Kind.KILL] * 3 + [Kind.STOP, Kind.STOP_BRIEFLY]
    if own.orders:
        kinds += [Kind.EXIT_9, Kind.RAISE, Kind.SLEEP, Kind.SPIN, Kind.LOCK]
        kinds += [Kind.EXIT_0] * (own.restart == "always" or dice.random() < 0.15)
    calm = condition not in (Condition.STORM, Condition.PAUSED, Condition.SAFE)
    if own.orders and own.restart != "no" and calm:
        kinds += [Kind.STUMBLE] * 3
    if own.restart == "no":
        kinds = [each for each in kinds if each not in HANGS]
    if condition in (Condition.STORM, Condition.FROZEN):
        kinds = [each for each in kinds if each in DIES and each is not Kind.EXIT_0]
    kind = dice.choice(kinds)
    detail = f"{dice.choice(_STEPS)} {dice.choice(_WAYS)}" if kind is Kind.STUMBLE else ""
    return Fault(kind, target, detail)
