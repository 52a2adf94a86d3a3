"""What is to be done now: `wanted` says how far a node is to be, `advance` what brings it there.

Level-triggered, as a kubelet: from the state alone, whatever happened before. Going down is the
same ladder as going up. A request that is made is noted in the state, so that it is made once.
Pure.
"""

from __future__ import annotations

from collections.abc import Iterator

from lifecycle.manifest.model import After, Condition, Readiness, Restart, RunKind
from lifecycle.plan.model import HeldBy
from lifecycle.supervisor.control.protocol import ControlRequest, ProcessState
from lifecycle.supervisor.core import gate, messages
from lifecycle.supervisor.core.state import (
    DOWNWARDS,
    HOLDS,
    NEVER_S,
    UP,
    Escalation,
    Level,
    Node,
    Process,
    Request,
    Run,
    Step,
    held_level,
    limit_of,
)
from lifecycle.supervisor.run.options import Until
from lifecycle.verify.verdict import Stage

SIGINT, SIGTERM, SIGKILL = 2, 15, 9

OWN_S = 0.5
"""Our hosts keep the limits of transitions themselves and know more: they speak first."""

_THEIRS = (Step.CONFIGURE, Step.CONNECT, Step.ACTIVATE, Step.DEACTIVATE)

GLANCE_S = 1.0
"""More for a run whose time is over, and whose last verdict is not of now or not ok: others may be
about to say that they end, too."""

HOST: Escalation = ((0, 2.0), (SIGINT, 2.0), (SIGTERM, 1.0), (SIGKILL, NEVER_S))
"""Destroying a participant may hang for good."""
STUCK: Escalation = ((0, 1.0), (SIGTERM, 0.5), (SIGKILL, NEVER_S))
"""For a host with a callback in progress: asked politely, it would first have to finish it."""
STARTING: Escalation = ((SIGTERM, 1.5), (SIGKILL, NEVER_S))
"""Not SIGINT: Python answers that with a traceback from the middle of an import."""
COMMAND: Escalation = HOST[1:]
"""rclpy and rclcpp end on SIGINT."""
AT_ONCE: Escalation = ((SIGKILL, NEVER_S),)


def wanted(run: Run, node: Node) -> Level:
    """Return how far a node is to be: every order, policy and fault is a field read here."""
    process = run.process_of(node)
    change = run.change
    if (
        run.ending is not None
        or node.renew
        or not run.is_past(node.due_s)
        or (process is not None and process.stays_down)
        or (change is not None and node.key in change.down)
    ):
        return Level.DOWN
    top = node.levels[-1]
    if top is Level.ACTIVE and is_kept_inactive(run, node):
        return node.gate
    return top


def is_kept_inactive(run: Run, node: Node) -> bool:
    """Return whether a node is not to be active although the manifest has it so."""
    if node.base is Level.ACTIVE and node.level is Level.ACTIVE:
        return run.paused or bool(node.withheld)  # it is adopted as it was found
    if run.options.until is not Until.ACTIVE:
        return True
    if not _is_let_go(run, node) and (run.paused or node.withheld or node.refused):
        return True
    if node.level is Level.ACTIVE:
        return not node.let_through
    needs = (
        run.nodes[after.node]
        for after in node.planned.after
        if held_level(node.planned, after.condition) is Level.ACTIVE and after.node in run.nodes
    )
    # One that is away comes again; one that is kept inactive does not.
    return any(
        each.levels[-1] is Level.ACTIVE
        and each.level is not Level.ACTIVE
        and is_kept_inactive(run, each)
        for each in needs
    )


def _is_let_go(run: Run, node: Node) -> bool:
    """Return whether an order is to let a node through that was kept inactive until now."""
    change = run.change
    stays = change is not None and change.back and node.key not in change.active
    return run.asked is not None and run.asked.until is Until.ACTIVE and not stays


def has_reached(run: Run, key: str, condition: Condition | Readiness) -> bool:
    """Return whether a node is as far as another waits for: a plain one has to be started."""
    node = run.nodes.get(key)
    if node is None:
        return condition in run.elsewhere.get(key, ())
    if isinstance(condition, Readiness):
        return condition in node.shown and node.level >= Level.STARTED
    process = run.process_of(node)
    if process is not None and process.is_over:
        return condition is not Condition.HEALTHY
    if condition is Condition.HEALTHY and not node.healthy:
        return False
    level = HOLDS[condition] if node.planned.managed else Level.STARTED
    return node.level >= level


def holds_up(run: Run, node: Node, target: Level) -> str:
    """Return what a step to this level waits for, `/a is active`; empty if nothing holds it."""
    for after in node.planned.after:
        step = held_level(node.planned, after.condition)
        if step <= target and not has_reached(run, after.node, after.condition):
            return _awaited(run, after)
    container = run.nodes.get(node.planned.run.container)
    if container is not None and container.level < Level.STARTED:
        return f"{container.name} is started"
    if target is Level.CONNECTED and run.wires and not node.wired:
        # What a negotiation asks of a node must not wait for a connection of another.
        early = (run.nodes[key] for key in run.early if key in run.nodes)
        late = (each for each in early if each.level < Level.CONFIGURED)
        return next((f"{each.name} is configured" for each in late if _comes(run, each)), "")
    return ""


def _comes(run: Run, node: Node) -> bool:
    """Return whether a node that is down is to be started again."""
    process = run.process_of(node)
    return process is None or not process.stays_down


def _awaited(run: Run, after: After) -> str:
    """Return what a node is to have reached, `/a is active`; what it shows also with the place."""
    other = run.plan.node(after.node)
    if isinstance(after.condition, Condition):
        return f"{other.full_name} is {after.condition}"
    held = other.held_by is HeldBy.EXECUTOR
    why = "; none of its callbacks runs before the gate opens" if held else ""
    return f"{other.full_name} {after.condition} ({after.at.spelled}{why})"


def goal_of(run: Run, node: Node) -> Level:
    """Return where a node goes from here: as wanted, and never below what it was found in.

    One that others activate again and again is left to the verdict, unless it is to be down.
    """
    least = node.base
    if run.ending is None and (run.paused or node.withheld):
        least = min(least, node.gate)  # it is adopted as it was found, and obeys orders
    goal = max(wanted(run, node), least)
    return max(goal, node.level) if goal and node.guarded > gate.GUARD_TRIES else goal


def is_walking(run: Run, node: Node) -> bool:
    """Return whether a node is on its way to its gate, or down, and will be there by itself."""
    goal = goal_of(run, node)
    if only_appears(node) and goal:  # it reports nothing: a verdict says whether it is there
        process = run.processes.get(node.process)
        return process is not None and not process.is_alive
    return min(goal, node.gate) > node.level or goal < node.may_be_at or node.renew


def only_appears(node: Node) -> bool:
    """Return whether all that is known of a node's start is that it is in the graph."""
    run = node.planned.run
    return run.kind is not RunKind.PYTHON and not (node.planned.managed or run.component)


def is_at_gate(run: Run) -> bool:
    """Return whether all nodes but those in backoff are where they can be without the gate."""
    return not any(
        is_walking(run, each) for each in run.nodes.values() if run.is_past(each.due_s)
    ) and not any(each.is_alive and is_to_end(run, each) for each in run.processes.values())


def waiting(run: Run) -> tuple[str, ...]:
    """Return the keys of the nodes that wait for the gate to open."""
    return tuple(
        key
        for key, each in run.nodes.items()
        if wanted(run, each) is Level.ACTIVE and each.level is each.gate
    )


def stage_of(run: Run) -> Stage:
    """Return what the system is judged as now."""
    passed = run.furthest == "active" or run.opening is not None
    return Stage.ACTIVE if passed and not run.paused and _is_whole(run) else Stage.CONNECTED


def advance(run: Run) -> list[messages.Effect]:
    """Return what is to be done now, and note it in the state."""
    found: list[messages.Effect] = [
        messages.Answer(order=number, code=code, error=error) for number, code, error in run.outbox
    ]
    run.outbox = []
    for process in run.processes.values():
        found += _process(run, process)
    for node in run.nodes.values():
        if (step := _next(run, node)) is not None:
            found.append(_ask(run, node, step))
    found += _parameters(run)
    found += _gate(run)
    for node in run.nodes.values():
        if node.request is not None:  # if it is late now, only a tick says so
            run.wakes_at(late_at_s(node.request))
    if run.wake_s < NEVER_S:
        found.append(messages.Wake(at_s=run.wake_s))
    return found


# Nodes


def _next(run: Run, node: Node) -> Step | None:
    if node.request is not None:
        return None
    goal = goal_of(run, node)
    if node.level > goal:
        return _step_down(run, node, goal)
    if node.level < goal and not run.failures and run.ending is None:
        return _step_up(run, node)
    return None


def _step_up(run: Run, node: Node) -> Step | None:
    target = next(each for each in node.levels if each > node.level)
    if node.stuck or (node.silent and target is not Level.STARTED):
        return None
    process = run.processes.get(node.process)
    if process is not None and (not process.pid or process.escalation is not None):
        return None
    if holds_up(run, node, target):
        return None
    if target is Level.ACTIVE:
        passage = run.passage
        passes = passage is not None and passage.opened and node.key in passage.waiting
        if not passes or run.is_changing or not gate.is_open(run):
            return None
    if target is Level.CONNECTED and run.wires and not node.wired:
        return Step.WIRE
    return UP[target]


def _step_down(run: Run, node: Node, goal: Level) -> Step | None:
    process = run.processes.get(node.process)
    # One that stays, and is silent, is asked all the same: its limit decides.
    asked = can_be_asked(run, node) if goal is Level.DOWN else not node.stuck
    if not asked or _waits_for_dependents(run, node, wanted(run, node)):
        return None
    if process is not None and process.escalation is not None:
        return None
    if node.level is not Level.STARTED:
        return DOWNWARDS[node.level]
    if node.planned.run.component:
        return None if _goes_with_container(run, node) else Step.UNLOAD
    return Step.SHUTDOWN if node.process and node.planned.holds else None


def can_be_asked(run: Run, node: Node) -> bool:
    """Return whether a node is asked politely on its way down."""
    return not (node.stuck or node.silent or run.hurry)


def _waits_for_dependents(run: Run, node: Node, goal: Level) -> bool:
    """Return whether another goes down first: what stays is not waited for."""
    return not run.hurry and any(
        goal_of(run, each) < each.may_be_at
        and each.may_be_at > max(goal, each.base)
        and (can_be_asked(run, each) or not each.planned.holds)
        and not (each.level is Level.STARTED and _goes_with_container(run, each))
        for each in run.dependents(node.key)
    )


def _goes_with_container(run: Run, node: Node) -> bool:
    """Return whether a node is a component whose container's process ends, too."""
    container = run.nodes.get(node.planned.run.container)
    if container is None or not container.process:
        return False
    return wanted(run, container) is Level.DOWN


def _ask(run: Run, node: Node, step: Step) -> messages.Ask:
    appears = step is Step.START and only_appears(node) and not node.planned.holds
    theirs = step in _THEIRS or (step is Step.START and node.planned.run.component)
    run.requests += 1
    node.request = Request(
        number=run.requests,
        step=step,
        since_s=run.now_s,
        limit_s=NEVER_S if appears else limit_of(node.planned, step),
        own_s=OWN_S if theirs else 0.0,
    )
    if step is Step.ACTIVATE and run.passage is not None:
        run.passage.sent.add(node.key)
        node.let_through = True
    return messages.Ask(node=node.key, step=step, number=run.requests)


def late_at_s(request: Request) -> float:
    """Return when a request is late: its process's time without a processor does not count."""
    waited_s = min(request.waited_s, 9 * request.limit_s)
    return request.since_s + request.limit_s + request.own_s + waited_s


# Processes


def is_to_end(run: Run, process: Process) -> bool:
    """Return whether all nodes of a process are to be down."""
    return not any(wanted(run, each) for each in run.nodes_of(process.name))


def _process(run: Run, process: Process) -> Iterator[messages.Effect]:
    if process.state is ProcessState.EXITED:
        if not process.sweeping:
            process.sweeping = True
            yield messages.Sweep(process=process.name)
    elif process.state is None:
        if _may_be_spawned(run, process):
            process.state, process.end = ProcessState.STARTING, None
            process.started(run.now_s)
            yield messages.Spawn(process=process.name)
    elif SIGKILL not in process.sent and run.is_past(_barks_at_s(run, process)):
        process.sent = [*process.sent, SIGKILL]
        yield messages.Signal(process=process.name, number=SIGKILL)
    elif process.pid and is_to_end(run, process):
        yield from _end(run, process)


def _may_be_spawned(run: Run, process: Process) -> bool:
    members = [*run.nodes_of(process.name)]
    held = any(holds_up(run, each, Level.STARTED) for each in members)
    return not (run.failures or is_to_end(run, process) or held)


def _barks_at_s(run: Run, process: Process) -> float:
    """Return when the watchdog of a process ends it; NEVER_S while none of its nodes hangs."""
    how = process.how
    if not how.watchdog_sec or how.restart is Restart.NO:
        return NEVER_S
    members = run.nodes_of(process.name)
    return min((each.hangs_s for each in members), default=NEVER_S) + how.watchdog_sec


def _end(run: Run, process: Process) -> Iterator[messages.Signal]:
    """End a process once nothing is left to undo in it, by ever stronger means."""
    members = [*run.nodes_of(process.name)]
    if process.escalation is None:
        asked = [each for each in members if each.planned.holds and can_be_asked(run, each)]
        busy = any(each.level or each.request is not None for each in asked)
        if busy or any(_waits_for_dependents(run, each, Level.DOWN) for each in members):
            return
        process.escalation = _escalation(run, process, members)
    elif run.hurry and SIGKILL not in process.sent:
        process.escalation = AT_ONCE
    elif not run.is_past(process.asked_until_s):
        return
    process.state = ProcessState.STOPPING
    (number, wait_s), *later = process.escalation
    process.escalation, process.asked_until_s = tuple(later), run.now_s + wait_s
    run.wakes_at(process.asked_until_s)
    process.sent = [*process.sent, number]
    yield messages.Signal(process=process.name, number=number)


def _escalation(run: Run, process: Process, members: list[Node]) -> Escalation:
    if run.hurry:
        return AT_ONCE
    if process.state is ProcessState.STARTING:
        return STARTING
    if process.planned.run.kind is RunKind.COMMAND:
        return COMMAND
    return STUCK if any(each.stuck or each.silent for each in members) else HOST


# The gate, networks, parameters


def _parameters(run: Run) -> Iterator[messages.Give]:
    if run.ending is not None or (run.switch is not None and not is_settled_down(run)):
        return
    later = {key: each for key, each in run.to_give.items() if key in run.giving}
    for key, values in run.to_give.items():
        if key not in later:  # it has still to answer what it was asked before
            run.giving.add(key)
            if run.change is not None and values is not None:
                run.change.given[key] = values
            yield messages.Give(node=key, values=values)
    run.to_give = later


def is_settled_down(run: Run) -> bool:
    """Return whether nothing has still to be deactivated."""
    return not any(
        goal_of(run, each) < each.may_be_at for each in run.nodes.values() if not each.stuck
    )


def _gate(run: Run) -> Iterator[messages.Effect]:
    if run.ending is not None:
        return
    judged, passage, verdict = run.judged, run.opening, run.judged.verdict
    if passage is not None and passage.flows is None and verdict is not None and gate.is_open(run):
        run.requests += 1
        passage.programming, passage.flows = run.requests, verdict.flows
        yield messages.Program(verdict=verdict, number=run.requests)
    # A loop that looks while its nodes are on their way would look at each step of each.
    due = not gate.is_latest(run) or run.is_past(judged.again_s)
    if due and not judged.looking and (run.is_watched or is_at_gate(run)):
        judged.looking, judged.again_s = True, NEVER_S
        yield messages.Look(mark=run.mark)


def phase_of(run: Run) -> str:
    """Return what the run is doing, as `lifecycle status` shows it."""
    pausing = run.order is not None and run.order.ask is ControlRequest.PAUSE
    coming = not is_at_gate(run)
    up = run.held_s is not None
    found = (
        (run.ending is not None, "stopping"),
        (run.change is not None and run.change.back, "rolling back"),
        (run.change is not None, "applying"),
        (run.switch is not None, "switching"),
        (run.opening is not None, "activating"),
        (pausing, "pausing"),
        (coming, "restarting" if up else "connecting"),
        (run.asked is not None, "verifying"),
        (run.paused, "paused"),
        (_is_whole(run) and gate.is_measuring(run), "measuring"),
        (_is_whole(run), "active"),
    )
    return next((name for holds, name in found if holds), "held")


def rests_as(run: Run) -> str:
    """Return what a system that was up is, whatever its policy starts again meanwhile."""
    if run.paused:
        return "paused"
    kept = any(each.withheld or each.refused for each in run.nodes.values())
    return "held" if kept or waiting(run) else "active"


def _is_whole(run: Run) -> bool:
    gated = [each for each in run.nodes.values() if each.is_gated and wanted(run, each)]
    return all(each.level is Level.ACTIVE for each in gated)
