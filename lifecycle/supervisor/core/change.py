"""Another mode, or another manifest, for what runs; and the way back from each.

Owns: what is noted in the state for it. Taking down, bringing up, the gate and failures are what
they are without it: a node whose manifest differs goes down, the plan is exchanged, it comes up.
Pure.
"""

from __future__ import annotations

from msgspec.structs import replace

from lifecycle.errors import ExitCode
from lifecycle.manifest.model import TargetState
from lifecycle.plan.change import change_between
from lifecycle.plan.model import Plan, PlannedNode, in_mode
from lifecycle.supervisor.core.advance import is_settled_down, waiting
from lifecycle.supervisor.core.state import (
    Attempt,
    Change,
    Level,
    Order,
    Run,
    Switch,
    install,
)
from lifecycle.supervisor.run.events import Event, ManifestApplied, ModeEntered, Notice

# Modes


def enter_mode(run: Run, mode: str, *, back: bool = False) -> list[Event]:
    """Have nodes be as a mode says: what it keeps inactive goes down first, without a gate."""
    active = frozenset(key for key, each in run.nodes.items() if each.is_gated)
    had = {key: each.planned.expected_parameters for key, each in run.nodes.items()}
    run.switch = Switch(mode=mode, before=run.mode, active=active, to_ask=set(), back=back)
    run.mode, run.plan = mode, in_mode(run.plan, mode)
    for key, node in run.nodes.items():
        node.planned = run.plan.node(key)
        if node.planned.expected_parameters != had[key] and node.level >= Level.STARTED:
            run.switch.to_ask.add(key)
    run.changed()
    return []


def leave_mode(run: Run, before: str, error: str, code: ExitCode) -> list[Event]:
    """Go back to the mode before: a node refuses a parameter, or the gate stays closed."""
    text = f"cannot enter mode {run.mode!r}: back to {before!r}"
    run.attempt = run.passage = None
    run.answer(code, error)
    events = [Notice(message=text), *enter_mode(run, before, back=True)]
    for node in run.nodes.values():
        if node.is_gated:
            node.refused = False  # it is let through again as soon as the gate allows it
    return events


def settle_mode(run: Run) -> list[Event]:
    """Enter the mode once all is inactive that it keeps so, and parameters are set."""
    switch = run.switch
    if switch is None or switch.to_ask or switch.asked or not is_settled_down(run):
        return []
    run.switch = None
    inactive = [each for each in run.plan.nodes if each.state is TargetState.INACTIVE]
    entered = ModeEntered(
        mode=switch.mode,
        before=switch.before,
        inactive=tuple(each.full_name for each in inactive if each.key in run.nodes),
    )
    more = {key for key, each in run.nodes.items() if each.is_gated} - switch.active
    if more and not (switch.back or run.paused):
        until_s = run.now_s + run.options.timeout_s
        run.attempt = Attempt(until_s=until_s, mode=switch.before)
    return [entered]


# Manifests


def apply(run: Run, order: Order) -> list[Event]:
    """Have the system run by another manifest; nothing is done where nothing differs."""
    plan = order.plan
    assert plan is not None
    then = run.mode if run.mode in [each.name for each in plan.modes] else ""
    then = then or next((each.name for each in plan.modes), "")
    change = change_between(run.first, plan, modes=(run.mode, then))
    if not change.differences:
        run.answer(ExitCode.OK)
        return []
    known = {each.key for each in plan.nodes}
    failed = {key for key, each in run.nodes.items() if each.due_s > run.now_s}
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
        until_s=run.now_s + (order.timeout_s or run.options.timeout_s),
        down=set(down),
        touched={*down, *change.added},
        to_give={
            key: each
            for key, each in change.parameters.items()
            if key not in down and run.nodes[key].level >= Level.STARTED
        },
    )
    run.passage = None
    run.changed()
    return [_said(run, "begun")]


def go_back(run: Run, reason: str, code: ExitCode) -> list[Event]:
    """Have the system run by the manifest before: what was done is undone."""
    change = run.change
    assert change is not None
    events = [_said(run, "rolling_back", reason)]
    change.back, change.reason, change.code = True, reason, code
    change.until_s = run.now_s + run.options.timeout_s
    run.attempt = run.passage = None
    if change.taken:
        change.taken = False
        change.down = {key for key in change.touched if key in run.nodes}
    change.touched |= change.down
    change.giving = set()
    change.to_give = {
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
        asks = run.attempt is not None or run.passage is not None
        return [] if asks else _finish(run, change)
    if change.to_give or change.giving or not _is_down(run, change):
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
    modes = [each.name for each in plan.modes]
    if change.back:
        run.mode, run.revision = change.mode, change.revision
    else:
        run.mode = run.mode if run.mode in modes else next(iter(modes), "")
        run.revisions += 1
        run.revision = run.revisions
    stays = {key: each.planned for key, each in run.nodes.items() if key not in change.down}
    run.first = plan
    for key in change.down:
        run.nodes.pop(key, None)
    install(run, _connected_as(in_mode(plan, run.mode), stays, before))
    for key in change.touched & run.nodes.keys():
        process = run.processes.get(run.nodes[key].process)
        if process is not None and process.state is None:
            process.by_hand, process.failed, process.away_s = True, False, None
    change.taken, change.down = True, set()
    run.changed()
    keys = change.active if change.back else None
    run.attempt = Attempt(until_s=change.until_s, activates=not run.paused, keys=keys)


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
    state = change.state or ("held" if waiting(run) else "paused" if run.paused else "active")
    text = (
        f"cannot apply {change.plan.manifest_path}: {change.reason}\n"
        f"{change.before.manifest_path} is in force again, revision {run.revision}: {state}"
    )
    events = [_said(run, "rolled_back", change.reason), Notice(message=text)]
    run.change = None
    run.answer(change.code, text)
    if change.ends:
        run.failures, run.fails_s = [*run.failures, *change.ends], run.now_s
    return events


def _said(run: Run, stage: str, reason: str = "") -> Event:
    change = run.change
    assert change is not None
    event = ManifestApplied(
        stage=stage, manifest=change.plan.manifest_path, revision=run.revision, reason=reason
    )
    if reason:
        return event
    names = {each.key: each.full_name for each in (*change.before.nodes, *change.plan.nodes)}

    def named(keys: object) -> tuple[str, ...]:
        return tuple(names[key] for key in keys)  # type: ignore[attr-defined]

    what = change.change
    return replace(
        event,
        added=named(what.added),
        removed=named(what.removed),
        restarted=named(what.restarted),
        parameters=named(what.parameters),
    )
