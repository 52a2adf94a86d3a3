"""A world at random for the reducer, and what holds in it at every moment.

Owns: `Core`, the reducer's modules under any package name, so that mutants of them can be loaded
beside the real ones; `World`, which carries effects out in random order, late, in vain or not at
all, and breaks things meanwhile; and the promises, one method each. Nothing of the reducer's own
reading is used to check it: what nodes are is the world's, orders and verdicts are what was given.
"""

from __future__ import annotations

import importlib
import random
from typing import Any, NamedTuple

from msgspec.structs import replace

from lifecycle.errors import ExitCode
from lifecycle.manifest.model import (
    BY_DEFAULT,
    Condition,
    Consequence,
    EndpointKind,
    Mode,
    OnFailure,
    Quantity,
    Reaction,
    Readiness,
    ReadyBy,
    Restart,
    RunKind,
    Supervision,
    TargetState,
)
from lifecycle.measure.flows import FlowMeasurement, Kind, MeasuredBound
from lifecycle.plan.model import Plan, PlannedNode
from lifecycle.supervisor.control.protocol import ControlRequest
from lifecycle.supervisor.run.options import Until, UpOptions
from lifecycle.verify.outcome import Outcome
from lifecycle.verify.verdict import Verdict
from tests.builders import HERE, plan_of, planned_endpoint, planned_node
from tests.unit.supervisor.fakes import verdict

STEPS = 6_000
"""No story takes more."""

READY = Readiness(by=ReadyBy.PUBLISHES, name="scan")
"""What a node shows some time after it was started."""


class Show(NamedTuple):
    """A node is about to show it."""

    node: str


class Core:
    """The modules of a reducer, under `package`."""

    def __init__(self, package: str = "lifecycle.supervisor.core") -> None:
        def module(name: str) -> Any:
            return importlib.import_module(f"{package}.{name}")

        self.state, self.messages = module("state"), module("messages")
        self.advance, self.gate, self.failure = module("advance"), module("gate"), module("failure")
        self.take = module("reduce").take


def measured(outcome: str, r: random.Random) -> FlowMeasurement:
    """What is measured of a flow of which one number is declared."""
    left_s = r.choice([None, 0.5, 30.0]) if outcome == "measuring" else None
    bound = MeasuredBound(
        name="rate_hz", kind=Kind.RATE, outcome=outcome, text="9.0 Hz", decides_in_s=left_s
    )
    return FlowMeasurement(
        topic="/data",
        publisher="/n0",
        subscription="/n1",
        messages=r.randint(0, 99),
        lost=0,
        rate_hz=9.0,
        bounds=(bound,),
    )


def random_plan(r: random.Random) -> Plan:
    """A system of up to six nodes in processes of their own or together, with an order."""
    nodes: list[PlannedNode] = []
    for index in range(r.randint(1, 6)):
        after = {
            f"n{other}": r.choice([*Condition][:4]) for other in range(index) if r.random() < 0.4
        }
        hosts = [each for each in nodes if each.run.kind is RunKind.PYTHON and each.managed]
        shared = hosts and r.random() < 0.2
        process = r.choice(hosts).process if shared else f"n{index}"
        how = next((each.supervision for each in nodes if each.process == process), None)
        supervision = how or Supervision(
            restart=r.choice([Restart.NO, *2 * [Restart.ON_FAILURE], *3 * [Restart.ALWAYS]]),
            restart_sec=0.5,
            start_limit_burst=r.choice([2, 5, 50]),
            start_limit_interval_sec=r.choice([0, 10.0, 300.0]),
            on_failure=r.choice([*OnFailure]),
        )
        kind, managed = r.choice(_KINDS) if process == f"n{index}" else (RunKind.PYTHON, True)
        node = planned_node(
            f"n{index}",
            after={k: v for k, v in after.items() if managed or v is not Condition.ACTIVE},
            process=process,
            supervision=supervision,
            kind=kind,
            managed=managed,
        )
        hosts = [each for each in nodes if not each.run.container]
        if kind is RunKind.ATTACH and hosts and r.random() < 0.5:
            loaded = {"component": "p/C", "container": r.choice(hosts).key}
            node = replace(node, run=replace(node.run, **loaded))
        nodes.append(node)
    if r.random() < 0.4:
        rate = (Quantity(name="rate_hz", value=9, at=HERE),)
        published = planned_endpoint(EndpointKind.PUBLISHER, "data", quantities=rate)
        nodes[-1] = replace(nodes[-1], endpoints=(published,))
    # Nodes of one process cannot wait for each other to start.
    plan = plan_of(*map(_startable(nodes), nodes))
    what = r.choice([*Consequence][:4])
    if what is not Consequence.MODE:
        reaction = Reaction(rule=BY_DEFAULT, what=what)
        plan = replace(plan, on_violation=(reaction,))
    modes = (
        Mode(name="all", at=HERE),
        Mode(name="some", inactive=tuple(each.key for each in nodes if r.random() < 0.4), at=HERE),
    )
    return replace(plan, modes=modes) if r.random() < 0.5 else plan


def with_readiness(plan: Plan, r: random.Random) -> Plan:
    """The same system, in which nodes wait for what others show."""

    def waits(node: PlannedNode) -> PlannedNode:
        ready = (replace(each, condition=READY) for each in node.after)
        return replace(
            node, after=tuple(r.choice(each) for each in zip(node.after, ready, strict=True))
        )

    return replace(plan, nodes=tuple(map(waits, plan.nodes)))


_KINDS = (
    *4 * [(RunKind.PYTHON, True)],
    (RunKind.PYTHON, False),
    (RunKind.COMMAND, True),
    (RunKind.COMMAND, False),
    (RunKind.ATTACH, True),
)
"""How a node is started, and whether it is managed."""


def _startable(nodes: list[PlannedNode]) -> Any:
    def startable(node: PlannedNode) -> PlannedNode:
        after = tuple(each for each in node.after if each.condition is not Condition.STARTED)
        return replace(node, after=after) if len(nodes) > 1 else node

    return startable


class World:
    """One story. `run_story` raises AssertionError, whose text begins with the broken promise."""

    def __init__(self, core: Core, seed: int) -> None:
        self.core, self.r = core, random.Random(seed)
        r = self.r
        self.plan = random_plan(r)
        if seed % 5 == 0:
            self.plan = with_readiness(self.plan, random.Random(seed))
        self.level_of: dict[str, int] = {each.key: 0 for each in self.plan.nodes}
        self.alive: dict[str, bool] = {}
        self.unswept: set[str] = set()
        self.let: set[str] = set()
        self.shown: set[str] = set()
        self.pending: list[Any] = []
        self.now_s = 0.0
        self.wake_s = float("inf")
        self.intruder_s: float | None = None
        self.data = "ok"  # what is measured of data, while they flow
        self.wrong = ""  # full name of a node that has other parameters than declared
        self.mark = 0  # what changed until now
        self.looks: dict[int, int] = {}  # and until looks began, by the mark that they have
        self.judged_mark = -1  # and until the look began that the last verdict is of
        self.seen_s: float | None = None  # since when an active system is seen to be violated
        self.lasted = False
        self.orders: dict[int, Any] = {}
        self.answers: dict[int, int] = {}
        self.calm = False
        self.faults = r.randint(0, 10)
        self.broke_s = 0.0
        self.stubborn = {each.name for each in self.plan.processes if r.random() < 0.2}
        until = r.choice([*6 * [Until.ACTIVE], Until.CONNECTED])
        if until is Until.CONNECTED and r.random() < 0.5:
            until = Until.VERIFIED
        options = UpOptions(
            until=until,
            stop_after_s=r.choice([None, 5.0]),
            timeout_s=30.0,
            keep_going=r.random() < 0.2,
            strict=r.random() < 0.2,
        )
        self.run = core.state.new_run(self.plan, options)
        self.give(core.messages.Tick())

    # The loop

    def give(self, what: Any) -> None:
        self.mark += type(what).__name__ in ("Exited", "Replied", "Saw", "Changed")
        self.mark += type(what).__name__ == "Silent" and what.node in self.run.nodes
        self.events = self.core.take(self.run, self.now_s, what)
        effects = self.core.advance.advance(self.run)
        self.wake_s = float("inf")
        for each in effects:
            self.check(each)
            kind = type(each).__name__
            if kind == "Wake":
                self.wake_s = each.at_s
            elif kind == "Answer":
                self.answers[each.order] = self.answers.get(each.order, 0) + 1
                assert self.answers[each.order] == 1, "answers: an order was answered twice"
            else:
                if kind == "Look":
                    self.looks[each.mark] = self.mark
                if kind == "Ask" and each.step.value == "activate":
                    self.let.add(each.node)
                self.pending.append(each)

    def run_story(self) -> Any:
        """Tell it to its end; return the run."""
        calm_since = None
        for _ in range(STEPS):
            if self.run.is_over:
                self.check_end()
                return self.run
            if self.faults and self.r.random() < 0.15:
                self.faults -= 1
                self.break_something()
            elif self.pending:
                self.carry_out(self.pending.pop(self.r.randrange(len(self.pending))))
            elif self.wake_s < float("inf") and not self.lasts_on(calm_since):
                self.check_idle()
                self.pass_time(self.wake_s)
            elif self.faults:
                self.faults -= 1
                self.break_something()
            elif self.run.ending is not None:
                raise AssertionError(f"ends: nothing is to be done, and the run is not over {self}")
            elif calm_since is None:
                calm_since = self.now_s
                self.settle_down()
            else:
                self.check_up()
                self.stop()
        raise AssertionError(f"ends: the story never ends {self}")

    def lasts_on(self, calm_since: float | None) -> bool:
        """Whether only the end of what is broken can change anything: a hang may last for ever."""
        wakes_late = self.wake_s - self.now_s >= 3600
        is_broken = calm_since is None and not self.faults and self.run.ending is None
        return wakes_late or (is_broken and self.now_s - self.broke_s > 600)

    def pass_time(self, to_s: float) -> None:
        self.now_s = to_s
        if self.judged_mark == self.mark:  # else what changed may have mended it
            self.see_how_long()
        self.give(self.core.messages.Tick())

    def see_how_long(self) -> None:
        over = self.run.ending is not None or self.seen_s is None
        self.lasted = self.lasted or (not over and self.now_s - self.seen_s > 1.0)

    def __str__(self) -> str:
        return f"in phase {self.core.advance.phase_of(self.run)}: {self.run.nodes} {self.pending}"

    # What effects do

    def carry_out(self, effect: Any) -> None:
        messages, r = self.core.messages, self.r
        kind = type(effect).__name__
        if r.random() < 0.1:
            self.now_s += r.choice([0.01, 0.3, 1.0])
        if kind == "Spawn" and not self.calm and r.random() < 0.02:
            self.give(messages.Spawned(process=effect.process, error="no memory"))
        elif kind == "Spawn":
            self.alive[effect.process] = True
            self.give(messages.Spawned(process=effect.process, pid=7))
        elif kind == "Signal":
            resists = effect.process in self.stubborn and effect.number != 9
            if self.alive.get(effect.process) and not resists:
                self.exit(effect.process, status=0 if effect.number in (0, 2) else None)
        elif kind == "Sweep":
            self.unswept.discard(effect.process)
            self.give(messages.Swept(process=effect.process))
        elif kind == "Ask":
            self.answer_step(effect)
        elif kind == "Look":
            self.judged_mark = self.looks[effect.mark]
            self.give(messages.Verified(mark=effect.mark, verdict=self.judge()))
        elif kind == "Show":
            if self.level_of[effect.node] and effect.node not in self.shown:
                self.shown.add(effect.node)
                self.give(messages.Saw(shown={effect.node: frozenset({READY})}))
        elif kind == "Program":
            self.give(messages.Programmed(number=effect.number))
        elif kind == "Give":
            error = "refused" if not self.calm and r.random() < 0.2 else ""
            self.give(messages.Given(node=effect.node, error=error))

    def answer_step(self, effect: Any) -> None:
        node = self.run.nodes.get(effect.node)
        if node is None or (node.process and not self.alive.get(node.process)):
            return
        if node.request is None or node.request.number != effect.number:
            if not self.r.random() < 0.5:  # what was given up is answered late, or never
                level = self.core.state.Level.STARTED
                self.mark -= 1  # and changes nothing
                self.give(
                    self.core.messages.Replied(node=node.key, number=effect.number, level=level)
                )
            return
        appears = node.planned.run.kind is RunKind.COMMAND and not node.planned.managed
        if not self.calm and self.r.random() < 0.04 and not appears:
            way = self.r.choice(["die", "fail", "hang"])
            if way == "die" and node.process:
                self.exit(node.process, status=None)
            elif way == "fail":
                level = self.core.state.Level(self.level_of[effect.node])
                self.give(
                    self.core.messages.Replied(
                        node=effect.node, number=effect.number, level=level, error="it failed"
                    )
                )
            return
        level = self.core.state.REACHES[effect.step]
        if effect.step.value == "deactivate" and not node.planned.managed:
            level = self.core.state.Level.STARTED  # it has no state between
        self.level_of[effect.node] = int(level)
        if effect.step.value == "deactivate":
            self.let.discard(effect.node)
        if effect.step.value == "start" and effect.node in self.run.plan.awaited:
            self.pending.append(Show(effect.node))
        if not level:
            self.shown.discard(effect.node)
        self.give(self.core.messages.Replied(node=effect.node, number=effect.number, level=level))

    def exit(self, process: str, *, status: int | None) -> None:
        self.alive[process] = False
        self.unswept.add(process)
        for each in self.run.nodes.values():
            if process in (each.process, self.container_of(each)):
                self.level_of[each.key] = 0
                self.let.discard(each.key)
                self.shown.discard(each.key)
        sent = self.run.processes[process].sent
        number = 0 if status is not None else sent[-1] if sent and sent[-1] else 11
        self.give(
            self.core.messages.Exited(
                process=process,
                status=status,
                signal=number,
                text="gone",
                clean=number in (2, 15) or status == 0,
            )
        )

    def container_of(self, node: Any) -> str:
        """The process of what a component is loaded into; empty for any other node."""
        container = self.run.nodes.get(node.planned.run.container)
        return "" if container is None else container.process

    def process_of(self, node: Any) -> Any:
        return self.run.processes.get(node.process or self.container_of(node))

    def judge(self) -> Verdict:
        found = []
        if self.intruder_s is not None:
            found.append(("graph.undeclared-node", "/intruder"))
        if self.wrong:
            found.append(("param.value-differs", self.wrong))
        for each in self.run.plan.nodes:
            gate = 3 if each.managed else 1
            if self.level_of.get(each.key, 0) < gate:
                found.append(("graph.missing-node", each.full_name))
        held = self.run.held_s is not None and any(each >= 4 for each in self.level_of.values())
        wrong = held and self.intruder_s is not None
        self.seen_s = (self.now_s if self.seen_s is None else self.seen_s) if wrong else None
        self.see_how_long()
        run = self.run
        flows = run.held_s is not None and run.passage is None and bool(run.plan.bounds)
        if not flows or self.core.advance.stage_of(run).value != "active":
            return verdict(*found)
        if self.data == "violated":
            found.append(("flow.rate", run.plan.nodes[-1].full_name))
        return replace(verdict(*found), measured=(measured(self.data, self.r),))

    # What breaks, and who orders what

    def break_something(self) -> None:
        r, messages = self.r, self.core.messages
        self.broke_s = self.now_s
        what = r.choice([*2 * ["die"], *3 * ["order"], *_FAULTS])
        living = [name for name, lives in self.alive.items() if lives]
        if what == "die" and living:
            self.exit(r.choice(living), status=r.choice([None, 0, 1]))
        elif what == "intrude" and self.intruder_s is None:
            self.intruder_s = self.now_s
            self.give(messages.Changed())
        elif what == "retreat" and self.intruder_s is not None:
            self.intruder_s = None
            self.give(messages.Changed())
        elif what == "linger" and self.intruder_s is None:
            self.intruder_s = self.now_s
            self.see(1.5)
            self.intruder_s = None
            self.give(messages.Changed())
        elif what == "data":
            self.data = r.choice(["ok", "measuring", "violated"])
            self.see(0.7)
        elif what == "differ":
            self.wrong = "" if self.wrong else r.choice(self.plan.nodes).full_name
            self.see(0.7)
        elif what == "hang":
            key = r.choice([*self.run.nodes, "n0"])
            self.give(messages.Silent(node=key, why=r.choice(["", "it hangs"]), hangs=True))
        elif what == "order":
            self.order()
        elif what == "activate":
            key = r.choice([*self.plan.nodes]).key
            node = self.run.nodes.get(key)
            if node is None:
                return
            held = self.level_of[key] in (2, 3) and node.planned.managed
            if held and node.request is None and not node.let_through:
                self.level_of[key] = 4
                self.give(messages.Saw(levels={key: self.core.state.Level.ACTIVE}))
        else:
            self.pass_time(self.now_s + r.choice([0.2, 1.5, 6.0]))
            if r.random() < 0.05:
                self.stop()

    def see(self, for_s: float) -> None:
        """Have something that changed looked at, and seen for so long."""
        self.give(self.core.messages.Changed())
        for each in [each for each in self.pending if type(each).__name__ == "Look"]:
            self.pending.remove(each)
            self.carry_out(each)
        self.pass_time(self.now_s + for_s)

    def order(self) -> None:
        ask = self.r.choice([each for each in ControlRequest if each.value in _ORDERS])
        order = self.core.state.Order(
            id=len(self.orders),
            ask=ask,
            node=self.r.choice(["", *self.run.nodes]) if ask is ControlRequest.RESTART else "",
            mode=self.r.choice(["all", "some"]) if ask is ControlRequest.MODE else "",
            plan=self.other_plan() if ask is ControlRequest.APPLY else None,
        )
        self.orders[order.id] = order
        self.give(self.core.messages.Ordered(order=order))

    def other_plan(self) -> Plan:
        """Another manifest: nodes are left out, added, or have another program."""
        r = self.r
        gone = {each.key for each in self.plan.nodes if r.random() < 0.15}
        nodes = [
            replace(
                each,
                after=tuple(one for one in each.after if one.node not in gone),
                run=replace(each.run, python=r.choice(["m:C", "m:D"])),
            )
            for each in self.plan.nodes
            if each.key not in gone
        ]
        if r.random() < 0.3:
            nodes.append(planned_node("extra"))
        for each in nodes:
            self.level_of.setdefault(each.key, 0)
        modes = tuple(
            replace(each, inactive=tuple(k for k in each.inactive if k not in gone))
            for each in self.plan.modes
        )
        return replace(plan_of(*nodes), modes=modes)

    def settle_down(self) -> None:
        """From now on nothing breaks, and what is wrong is over."""
        self.calm = True
        self.intruder_s, self.wrong, self.data = None, "", "ok"
        for key in self.run.nodes:
            self.give(self.core.messages.Silent(node=key))
        self.give(self.core.messages.Changed())

    def stop(self) -> None:
        messages = self.core.messages
        self.give(messages.Stop(reason="lifecycle down", code=ExitCode.BRING_UP_FAILED))

    # Promises

    def check(self, effect: Any) -> None:
        kind, run = type(effect).__name__, self.run
        if kind == "Ask" and effect.step.value == "activate":
            self.check_activation(effect)
        elif kind == "Spawn":
            assert not self.alive.get(effect.process), "processes: spawned while it lives"
            assert effect.process not in self.unswept, "processes: spawned beside what is left"
            assert run.ending is None, "processes: spawned while the run ends"
            for each in run.nodes_of(effect.process):
                self.check_shown(each, managed=False)
        if kind == "Ask" and effect.step.value == "configure":
            self.check_shown(run.nodes[effect.node], managed=True)
        if kind == "Ask" and run.ending is not None:
            up = effect.step.value in ("start", "configure", "connect", "wire", "activate")
            assert not up, f"withheld: {effect.step.value} while the run ends"
        if kind == "Ask" and effect.step.value in ("deactivate", "disconnect", "cleanup"):
            self.check_order_down(effect)

    def check_activation(self, effect: Any) -> None:
        run, node = self.run, self.run.nodes[effect.node]
        assert self.mark == self.judged_mark, "gate: activated on an older verdict"
        held = run.judged.verdict
        assert held is not None, "gate: activated without a verdict"
        assert held.verdict is not Outcome.VIOLATED, "gate: activated on a violated verdict"
        assert not run.paused, "withheld: activated while paused"
        assert not node.withheld, "withheld: activated while withheld"
        mode = next((each for each in run.plan.modes if each.name == run.mode), None)
        outside = mode is not None and effect.node in mode.inactive
        assert not outside, "withheld: activated outside of the mode"
        for after in node.planned.after:
            other = run.nodes.get(after.node)
            least = 4 if other is None or other.planned.managed else 1
            active = self.level_of.get(after.node, 0) >= least
            assert after.condition is not Condition.ACTIVE or active, "order: activated too early"

    def check_shown(self, node: Any, *, managed: bool) -> None:
        """What waits for what others show, begins once they do: a plain node with its start."""
        awaited = {each.node for each in node.planned.after if each.condition == READY}
        missing = awaited & self.run.nodes.keys() - self.shown
        assert node.planned.managed is not managed or not missing, "order: begun too early"

    def check_order_down(self, effect: Any) -> None:
        if self.run.ending is None:
            return
        for other in self.run.nodes.values():
            depends = any(each.node == effect.node for each in other.planned.after)
            rest = 1 if other.planned.run.component else other.base
            given_up = other.stuck or other.silent or self.run.hurry
            lives = other.level > rest and not given_up
            assert not (depends and lives), "order: taken down before a dependent"

    def check_idle(self) -> None:
        """While nothing is asked of anybody, only what the gate let through is active."""
        if any(each.request is not None for each in self.run.nodes.values()):
            return  # one of them may be what another waits for
        for node in self.run.nodes.values():
            foreign = self.level_of[node.key] == 4 and node.key not in self.let
            silent = node.stuck or node.silent or node.guarded > 5
            assert silent or not foreign or self.run.ending, "withheld: what others activated is"

    def check_up(self) -> None:
        """After faults stop: all that is wanted is up. A pause, or what was refused, stays."""
        for node in self.run.nodes.values():
            if self.is_gone(node) or self.waits_for_gone(node):
                continue
            level = self.level_of[node.key]
            kept = self.run.paused or node.withheld or node.refused or self.needs_kept(node)
            kept = kept or any(map(self.is_gone, self.run.nodes.values()))  # which is violated
            kept = (
                kept
                or self.run.options.until is not Until.ACTIVE
                or node.planned.state is TargetState.INACTIVE
            )
            gate = 3 if node.planned.managed else 1
            least = gate if kept or not node.planned.holds else 4
            assert level >= least, f"up: {node.key} stays at {level} {self}"
            foreign = level == 4 and node.key not in self.let
            assert not foreign or node.guarded > 5, "withheld: what others activated stays active"
            down = self.run.paused or node.withheld or node.planned.state is TargetState.INACTIVE
            assert level < 4 or not down or node.guarded > 5, (
                f"withheld: {node.key} stays active {self}"
            )
        probation = self.core.advance.phase_of(self.run) == "measuring"
        assert not probation or self.now_s <= self.run.measures_s + 10, "ends: measures for ever"
        assert not self.run.orders, "answers: an order waits for ever"
        assert self.run.order is None, f"answers: an order is never done {self}"

    def is_gone(self, node: Any) -> bool:
        """Whether the run goes on without it."""
        process = self.process_of(node)
        return process is not None and process.stays_down

    def waits_for_gone(self, node: Any) -> bool:
        """Whether it waits for one that stays down, directly or through others."""
        nodes = self.run.nodes
        names = [*(each.node for each in node.planned.after), node.planned.run.container]
        needs = [nodes[each] for each in names if each in nodes]
        return any(
            (self.is_gone(each) and not self.level_of[each.key]) or self.waits_for_gone(each)
            for each in needs
        )

    def needs_kept(self, node: Any) -> bool:
        """Whether it waits for one that is not to be active."""
        nodes = self.run.nodes
        needs = [nodes[each.node] for each in node.planned.after if each.node in nodes]
        active = (Condition.ACTIVE, Condition.HEALTHY)
        held = {each.node for each in node.planned.after if each.condition in active}
        return any(
            each.key in held
            and (
                each.withheld
                or each.refused
                or each.planned.state is not TargetState.ACTIVE
                or self.needs_kept(each)
            )
            for each in needs
        )

    def check_end(self) -> None:
        living = [name for name, lives in self.alive.items() if lives]
        assert not living, f"processes: {living} outlive the run"
        assert not self.unswept, f"processes: {self.unswept} left something"
        missing = self.orders.keys() - self.answers.keys()
        assert not missing, f"answers: orders {missing} were never answered"
        code = self.core.failure.exit_code_of(self.run)
        judged = self.run.options.until is not Until.CONNECTED
        done = judged and self.run.ending.stopping == "done"
        assert not (self.lasted and done and code is ExitCode.OK), (
            "violations: one that lasted is not in the exit code"
        )


_FAULTS = (
    *("intrude", "retreat", "data", "differ", "hang", "wait"),
    *3 * ("linger",),  # what these show is rare
    *3 * ("activate",),
)
_ORDERS = ("pause", "resume", "restart", "mode", "apply")
