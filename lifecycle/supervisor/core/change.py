"""Another mode, or another manifest, for what runs; and the way back from each.

Owns: what is noted in the state for it. Taking down, bringing up, the gate and failures are what
they are without it: a node whose manifest differs goes down, the plan is exchanged, it comes up.
Pure.
"""

from __future__ import annotations

from msgspec.structs import asdict, replace

from lifecycle.errors import ExitCode
from lifecycle.manifest.model import TargetState
from lifecycle.plan.comparison import PlanChange, change_between, difference_lines
from lifecycle.plan.model import Plan, PlannedNode, in_mode
from lifecycle.supervisor.control.protocol import ChangedNodes
from lifecycle.supervisor.core import gate
from lifecycle.supervisor.core.advance import is_settled_down, phase_of, rests_as
from lifecycle.supervisor.core.state import (
    Change,
    Level,
    Order,
    Passage,
    Process,
    Run,
    Switch,
    install,
)
from lifecycle.supervisor.run.events import (
    Event,
    ManifestApplied,
    ModeEntered,
    Notice,
    SystemReached,
)
from lifecycle.supervisor.run.options import Until
from lifecycle.verify.judge import not_ok

# Modes


def enter_mode(run: Run, mode: str, *, back: bool = False) -> None:
    """Have nodes be as a mode says: what it keeps inactive goes down first, without a gate."""
    run.switch, run.to_give = Switch(before=run.mode, back=back), {}
    run.mode, run.plan = mode, in_mode(run.plan, mode)
    for key, node in run.nodes.items():
        was, node.planned = node.planned, run.plan.node(key)
        if _differs(node.planned, was) and node.level >= Level.STARTED:
            run.to_give[key] = None
    run.changed()


def leave_mode(run: Run, before: str, error: str, code: ExitCode) -> list[Event]:
    """Go back to the mode before: a node refuses a parameter, or the gate stays closed."""
    text = f"cannot enter mode {run.mode!r}: back to {before!r}"
    run.passage = None
    said: list[Event] = [Notice(message=text)]
    if run.order is not None:
        run.undone = code, error
    else:
        said.append(Notice(message=error))
    enter_mode(run, before, back=True)
    return said


def settle_mode(run: Run) -> list[Event]:
    """Enter the mode once all is inactive that it keeps so, and parameters are set."""
    switch = run.switch
    if switch is None or run.to_give or run.giving or not is_settled_down(run):
        return []
    run.switch, before = None, in_mode(run.plan, switch.before)
    nodes = [(each, before.node(key)) for key, each in run.nodes.items()]
    inactive = [each for each in run.plan.nodes if each.state is TargetState.INACTIVE]
    entered = ModeEntered(
        mode=run.mode,
        before=switch.before,
        inactive=tuple(each.full_name for each in inactive if each.key in run.nodes),
        parameters=tuple(each.name for each, was in nodes if _differs(each.planned, was)),
    )
    more = any(each.is_gated and was.state is not TargetState.ACTIVE for each, was in nodes)
    if run.paused:
        return [entered]
    if not more:
        is_whole = phase_of(run) in ("measuring", "active")
        return [entered, *([SystemReached(reached="active", elapsed_s=run.now_s)] * is_whole)]
    until_s = run.now_s + run.timeout_s
    run.passage = Passage(until_s=until_s, mode="" if switch.back else switch.before)
    return [entered]


def _differs(node: PlannedNode, was: PlannedNode) -> bool:
    return node.expected_parameters != was.expected_parameters


# Manifests


def apply(run: Run, order: Order) -> list[Event]:
    """Have the system run by another manifest; nothing is done where nothing differs."""
    plan = order.plan
    assert plan is not None
    change = change_to(run, plan)
    if not change.differences:
        return []
    known = {each.key for each in plan.nodes}
    failed = {
        key
        for key, each in run.nodes.items()
        if not run.is_past(each.due_s) or _has_failed(run.process_of(each))
    }
    again = {*change.removed, *change.restarted, *(failed & known)}
    down = run.whole(again)
    run.change = Change(
        plan=plan,
        change=change,
        before=run.first,
        revision=run.revision,
        mode=run.mode,
        active=frozenset(
            key
            for key, each in run.nodes.items()
            if each.level is Level.ACTIVE or (key in failed and not each.withheld)
        ),
        timeout_s=order.timeout_s or run.timeout_s,
        until_s=run.now_s + (order.timeout_s or run.timeout_s),
        down=set(down),
        touched={*down, *change.added},
    )
    run.to_give = {
        key: each
        for key, each in change.parameters.items()
        if key not in down and run.nodes[key].level >= Level.STARTED
    }
    return [_said(run, "begun")]


def _has_failed(process: Process | None) -> bool:
    return process is not None and process.stays_down and not process.is_over


def go_back(run: Run, reason: str, code: ExitCode) -> list[Event]:
    """Have the system run by the manifest before: what was done is undone."""
    change = run.change
    assert change is not None
    events = [_said(run, "rolling_back", reason)]
    change.back, change.reason, change.code = True, reason, code
    change.until_s = run.now_s + run.timeout_s
    run.passage = None
    if change.taken:
        change.taken = False
        change.down = {key for key in change.touched if key in run.nodes}
    change.touched |= change.down
    run.to_give = {
        key: replace(each, before=each.now, now=each.before)
        for key, each in change.given.items()
        if key not in change.down and key in run.nodes
    }
    for key, node in run.nodes.items():
        if key not in change.active:
            node.let_through = False
    run.changed()
    return events


def refused_parameters(run: Run, key: str, error: str) -> list[Event]:
    """Have a node started again that refuses parameters while it runs."""
    change = run.change
    assert change is not None
    keys = run.whole({key})
    change.down.update(keys)
    change.touched.update(keys)
    return [Notice(message=f"{error}; it is started again")]


def settle_change(run: Run) -> list[Event]:
    """Take the manifest once nothing runs any more that differs; be done once all is verified."""
    change = run.change
    if change is None:
        return []
    if change.taken:
        return [] if run.passage is not None else _finish(run, change)
    if run.to_give or run.giving or not _is_down(run, change):
        return []
    _take(run, change)
    return []


def _is_down(run: Run, change: Change) -> bool:
    nodes = [run.nodes[key] for key in change.down if key in run.nodes]
    names = {each.process for each in nodes if each.process}
    processes = [run.processes[name] for name in names]
    return all(each.is_down for each in nodes) and all(each.state is None for each in processes)


def _take(run: Run, change: Change) -> None:
    """Exchange the plan; what stays is connected as it is."""
    plan, before = (change.before, change.plan) if change.back else (change.plan, change.before)
    if change.back:
        run.mode, run.revision = change.mode, change.revision
    else:
        run.mode = run.mode_by(plan)
        run.revisions += 1
        run.revision = run.revisions
    stays = {key: each.planned for key, each in run.nodes.items() if key not in change.down}
    run.first = plan
    gone = {key: run.nodes.pop(key) for key in change.down & run.nodes.keys()}
    install(run, _connected_as(in_mode(plan, run.mode), stays, before))
    for key in gone.keys() & run.nodes.keys():  # who was kept inactive waits for a person still
        run.nodes[key].withheld, run.nodes[key].refused = gone[key].withheld, gone[key].refused
    for key in change.touched & run.nodes.keys():
        process = run.processes.get(run.nodes[key].process)
        if process is not None and process.state is None:
            process.restarted_by_hand()
    change.taken, change.down = True, set()
    run.changed()
    until = Until.VERIFIED if run.paused else Until.ACTIVE
    run.passage = Passage(until_s=change.until_s, until=until)


def _connected_as(plan: Plan, stays: dict[str, PlannedNode], before: Plan) -> Plan:
    """Return a plan with the connections that running nodes have: a restart may have moved them."""
    were = {each.key: each for each in before.nodes}

    def connected(node: PlannedNode) -> PlannedNode:
        was, now = were.get(node.key), stays.get(node.key)
        if was is None or now is None:
            return node
        if (was.connections, was.participants) != (node.connections, node.participants):
            return node
        return replace(node, connections=now.connections, participants=now.participants)

    return replace(plan, nodes=tuple(map(connected, plan.nodes)))


def _finish(run: Run, change: Change) -> list[Event]:
    if not change.back:
        events: list[Event] = [_said(run, "applied")]
        run.change = None
        run.answer(ExitCode.OK)
        return events
    text = undone(run, change)
    events = [_said(run, "rolled_back", change.reason), Notice(message=text)]
    run.change = None
    run.answer(change.code, text)
    return events


def undone(run: Run, change: Change) -> str:
    """Say what became of a manifest that could not be applied, and what the system is now."""
    before = change.before.manifest_path
    text = f"cannot apply {change.plan.manifest_path}: {change.reason}\n"
    if run.failures:
        why = "; ".join(each.message for each in run.failures)
        return f"{text}cannot go back to {before}: {why}; the system is taken down"
    now = rests_as(run)
    how = f"{now} and verified"
    if change.again:
        how = f"and what failed meanwhile is started again as its policy says: {change.again}"
    elif (verdict := run.judged.verdict) is not None and not gate.allows(run):
        resume = "" if now == "active" else ": lifecycle resume"
        found = f"its verdict is {verdict.verdict.value}: {not_ok(verdict)}"
        how = f"but {found}; it is {now}{resume}"
    elif now == "held":
        how = "verified, and held as before: lifecycle resume"
    return f"{text}{before} is in force again, revision {run.revision}, {how}"


def change_to(run: Run, plan: Plan) -> PlanChange:
    """Return what another manifest is for what runs; it stays in its mode, if that has it."""
    return change_between(run.first, plan, modes=(run.mode, run.mode_by(plan)))


def changed_nodes(change: PlanChange, running: Plan, plan: Plan, revision: int) -> ChangedNodes:
    """Return a change from `running` to `plan` by the full names of nodes."""
    return ChangedNodes(
        differences=difference_lines(change.differences),
        added=tuple(plan.node(key).full_name for key in change.added),
        removed=tuple(running.node(key).full_name for key in change.removed),
        restarted=tuple(plan.node(key).full_name for key in change.restarted),
        parameters=tuple(plan.node(key).full_name for key in change.parameters),
        revision=revision,
    )


def _said(run: Run, stage: str, reason: str = "") -> Event:
    change = run.change
    assert change is not None
    what = ChangedNodes(revision=run.revision)
    if not reason:
        what = changed_nodes(change.change, change.before, change.plan, run.revision)
    return ManifestApplied(
        stage=stage, manifest=change.plan.manifest_path, reason=reason, **asdict(what)
    )
