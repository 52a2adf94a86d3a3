"""`take`: one input changes the state, and something is said of it.

Owns: what each input means. Nothing is asked of anybody here; what is to be done follows from the
state (advance.py). An end is an end in every phase: what dies, what it leaves and what is late are
inputs that the same lines handle in bring-up, restart, apply and take-down. Pure.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from lifecycle.errors import ExitCode
from lifecycle.manifest.model import RunKind
from lifecycle.plan.model import PlanError
from lifecycle.plan.restart import restarted
from lifecycle.supervisor.control.protocol import ProcessState
from lifecycle.supervisor.core import (
    advance,
    failure,
    gate,
    messages,
    orders,
    passing,
)
from lifecycle.supervisor.core.change import (
    leave_mode,
    refused_parameters,
    settle_change,
    settle_mode,
)
from lifecycle.supervisor.core.state import (
    NEVER_S,
    UP,
    Level,
    Node,
    Process,
    Request,
    Run,
    Step,
)
from lifecycle.supervisor.run.events import Event, Failure, Notice, Restarted, VerdictChanged
from lifecycle.verify.rules.catalogue import NOT_WIRED, START_FAILED, TRANSITION_FAILED
from lifecycle.verify.rules.measured import PROBATION_S

_UPWARDS = (*UP.values(), Step.WIRE)
_PASSES = 3
"""An order that ends, the next that begins, and the gate that it asks: no more follow silently."""


def take(run: Run, now_s: float, given: messages.Input) -> list[Event]:
    """Apply one input to the state; return what is said of it.

    `now_s` is on the run's clock, which begins at 0 and only goes forward.
    """
    run.now_s, run.wake_s = max(run.now_s, now_s), NEVER_S
    events = _HANDLERS[type(given)](run, given)
    gate.see_violations(run)
    quiet = 0
    while quiet < _PASSES:  # what moved without a word is looked at once more
        more = _settle(run)
        quiet = 0 if more else quiet + 1
        events += more
    return events


def _settle(run: Run) -> list[Event]:
    """Take what follows from the state alone one step further."""
    events: list[Event] = []
    passage, was_held = run.passage, run.held_s is not None
    busy = any(each.request is not None for each in run.nodes.values())
    if run.ending is None and run.failures and (not busy or run.is_past(run.fails_s)):
        events += failure.end_failed(run)
    _give_up_steps(run)
    _begin_anew(run)
    for settle in (
        settle_mode,
        settle_change,
        passing.settle,
        passing.settle_first_contact,
        orders.settle_orders,
        orders.settle_consequences,
        failure.say_slow,
    ):
        if run.ending is None:
            events += settle(run)
    if passage is not None and run.passage is None and (was_held or gate.has_probation(run)):
        run.changed()  # a look that began on the way through the gate measures nothing
        run.probation = run.mark
        if run.decided_s is None:
            run.measures_s = run.now_s
    if run.ending is None:
        events += _hold(run)
    return [*events, *_returned(run)]


# Processes


def _spawned(run: Run, given: messages.Spawned) -> list[Event]:
    process = run.processes[given.process]
    process.log = given.log
    if not given.error:
        process.pid = given.pid or -1
        return []
    process.state = None
    if run.ending is not None:
        return []
    node = next(run.nodes_of(process.name))
    return failure.fail(run, failure.of_step(run, node, START_FAILED, given.error))


def _exited(run: Run, given: messages.Exited) -> list[Event]:
    process = run.processes[given.process]
    failures = failure.death(run, process, given)
    in_order = _ends_in_order(run, process, given)
    asked = process.escalation is not None
    expected = asked or run.ending is not None or advance.is_to_end(run, process)
    process.state, process.end = ProcessState.EXITED, given
    for node in run.nodes.values():
        if run.process_of(node) is process:
            _is_down(node)
    run.changed()
    if process.is_over and not asked:
        process.stays_down = True
        return []
    if not expected:
        return [event for each in failures for event in failure.fail(run, each, given)]
    is_forced = any(process.sent[1:]) and not run.hurry
    forced: list[Event] = [failure.forced(process)] if is_forced else []
    if in_order:
        return forced
    if run.ending is not None:
        run.deaths += failures
    return [*forced, *map(failure.goes_on, failures)]


def _ends_in_order(run: Run, process: Process, given: messages.Exited) -> bool:
    """Return whether a process that is to end, or was asked to, has not died instead."""
    hosted = process.planned.run.kind is RunKind.PYTHON
    if process.escalation is None:
        managed = [each for each in run.nodes_of(process.name) if each.planned.managed]
        return given.clean and (not hosted or all(each.level is Level.DOWN for each in managed))
    if given.signal:
        return given.signal in process.sent or given.clean
    return not (given.crash or (hosted and (given.status or 0) > 1))


def _is_down(node: Node) -> None:
    node.level = node.base = Level.DOWN
    node.request = None
    node.stuck = node.wired = node.healthy = node.let_through = node.appeared = False
    node.silent, node.hangs, node.hangs_s, node.guarded = "", "", NEVER_S, 0
    node.shown = frozenset()


def _swept(run: Run, given: messages.Swept) -> list[Event]:
    process = run.processes[given.process]
    process.state, process.pid, process.escalation, process.sent = None, 0, None, []
    process.sweeping = False
    run.changed()
    if run.ending is not None or run.change is not None:
        return []
    keys = [key for key, each in run.nodes.items() if run.process_of(each) is process]
    try:
        plan = restarted(run.plan, keys, first=run.first, reported=given.reported)
    except PlanError as error:
        found = Failure(rule=START_FAILED.id, subject=run.plan.system, message=error.message)
        return failure.fail(run, found)
    run.plan = plan
    for key, node in run.nodes.items():
        node.planned = plan.node(key)
    return []


def _silent(run: Run, given: messages.Silent) -> list[Event]:
    node = run.nodes.get(given.node)
    if node is None:
        return []
    node.silent = given.why if given.away else ""
    run.changed()
    node.hangs = given.why if given.hangs else ""
    node.hangs_s = min(node.hangs_s, run.now_s) if given.hangs else NEVER_S
    return []


# Nodes


def _replied(run: Run, given: messages.Replied) -> list[Event]:
    node = run.nodes.get(given.node)
    if node is None or node.request is None or node.request.number != given.number:
        return []  # it was given up
    error = given.error and given.error + failure.advice(run, node)
    step, node.request, was = node.request.step, None, node.level
    goal = advance.goal_of(run, node)
    run.changed()
    if given.changed:
        node.let_through = False
        if run.passage is not None:
            run.passage.sent.discard(node.key)
        return []
    node.level = given.level
    if error:
        return _step_failed(run, node, step, error, goal)
    if given.already and node.base is was and not node.process and not node.planned.run.component:
        node.base = node.level  # it was found so
    process = run.processes.get(node.process)
    if step is Step.START and process is not None:
        process.state = ProcessState.RUNNING
    elif step is Step.START:
        node.base = Level.DOWN if node.planned.run.component else node.level
    elif step is Step.WIRE:
        node.wired = True
    elif step is Step.DISCONNECT:
        node.wired = False
    if node.level is Level.DOWN:
        node.shown = frozenset()
    if step is Step.DEACTIVATE and node.level < Level.ACTIVE:
        node.let_through = False
    return []


def _step_failed(run: Run, node: Node, step: Step, error: str, goal: Level) -> list[Event]:
    is_up = step in _UPWARDS or (step is Step.DEACTIVATE and goal > Level.DOWN)
    if not is_up:
        node.level = node.after(step)  # the next step is tried all the same
    if not is_up or run.ending is not None:
        return [Notice(message=error)]
    rules = {Step.START: START_FAILED, Step.WIRE: NOT_WIRED}
    what = rules.get(step, TRANSITION_FAILED)
    return failure.fail(run, failure.of_step(run, node, what, error))


def _saw(run: Run, given: messages.Saw) -> list[Event]:
    events: list[Event] = []
    before = [(each.healthy, each.shown) for each in run.nodes.values()], run.elsewhere, run.left
    for key, node in run.nodes.items():
        node.healthy = given.health.get(key, node.healthy)
        node.shown = given.shown.get(key, node.shown)
        node.appeared = node.appeared or key in given.appeared
        idle = node.request is None and node.level in (Level.CONFIGURED, Level.CONNECTED)
        if given.levels.get(key) is Level.ACTIVE and idle and not node.let_through:
            run.changed()
            node.level, node.guarded = Level.ACTIVE, node.guarded + 1
            events.append(failure.activated(node))
    if given.undeclared is not None:
        run.undeclared = given.undeclared
    run.elsewhere = {**run.elsewhere, **given.elsewhere}
    run.left = run.left if given.left is None else given.left
    now = [(each.healthy, each.shown) for each in run.nodes.values()], run.elsewhere, run.left
    if now != before:
        run.changed()
    return events


# Everything else


def _tick(run: Run, given: messages.Tick) -> list[Event]:
    for key, waited_s in given.waited_s.items():
        node = run.nodes.get(key)
        if node is not None and node.request is not None:
            node.request.waited_s = max(node.request.waited_s, waited_s)
    events: list[Event] = []
    at_s = min(given.at_s, run.now_s)
    for node in [*run.nodes.values()]:  # at no other input: how long it waited is known at this one
        if node.request is not None and at_s >= advance.late_at_s(node.request):
            events += _late(run, node, node.request, given.where.get(node.key, ""))
    return events


def _refused(run: Run, given: messages.Refused) -> list[Event]:
    if run.ending is not None:
        return []
    run.judged.verdict = given.verdict
    said = VerdictChanged(stage=advance.stage_of(run), verdict=given.verdict)
    return [said, *failure.end_refused(run, given.verdict, passing.CLOSED)]


def _verified(run: Run, given: messages.Verified) -> list[Event]:
    verdict, stage = gate.take_verdict(run, given), advance.stage_of(run)
    if verdict is None:
        return []
    return [VerdictChanged(stage=stage, verdict=verdict)]


def _given(run: Run, given: messages.Given) -> list[Event]:
    run.changed()
    if given.node not in run.giving:
        return []
    run.giving.discard(given.node)
    switch = run.switch
    if given.error and switch is not None and not switch.back:
        text = f"cannot enter mode {run.mode!r}: {given.error}"
        return leave_mode(run, switch.before, text, ExitCode.BRING_UP_FAILED)
    if given.error and run.change is not None:
        return refused_parameters(run, given.node, given.error)
    return []


def _stop(run: Run, given: messages.Stop) -> list[Event]:
    if run.ending is None:
        return failure.stop(run, given.reason, given.code)
    run.hurry = run.hurry or given.code is ExitCode.INTERRUPTED
    return []


def _broken(run: Run, given: messages.Broken) -> list[Event]:
    if run.ending is None:
        run.fails_now(given.failure)
    return []


def _changed(run: Run, _: messages.Changed) -> list[Event]:
    run.changed()
    return []


_HANDLERS: dict[type, Callable[[Run, Any], list[Event]]] = {
    messages.Tick: _tick,
    messages.Spawned: _spawned,
    messages.Exited: _exited,
    messages.Swept: _swept,
    messages.Replied: _replied,
    messages.Saw: _saw,
    messages.Changed: _changed,
    messages.Verified: _verified,
    messages.Programmed: passing.programmed,
    messages.Given: _given,
    messages.Ordered: orders.ordered,
    messages.Stop: _stop,
    messages.Silent: _silent,
    messages.Refused: _refused,
    messages.Broken: _broken,
}


def _late(run: Run, node: Node, request: Request, where: str) -> list[Event]:
    goal = advance.goal_of(run, node)
    late = failure.too_late(run, node, request.limit_s, where)
    node.request, node.stuck = None, True
    run.changed()
    if run.ending is not None or goal is Level.DOWN or request.step is Step.UNLOAD:
        what = f"{request.step.value} {node.name!r} within {request.limit_s:g} s"
        return [Notice(message=f"cannot {what}; its process is ended all the same")]
    return failure.fail(run, late)


# What follows from the state alone


def _give_up_steps(run: Run) -> None:
    """Give up steps upwards of nodes that are to be down: their processes end."""
    for node in run.nodes.values():
        request = node.request
        if request is None or advance.wanted(run, node) is not Level.DOWN:
            continue
        ours = node.process or request.step is Step.START
        if run.hurry or (request.step in _UPWARDS and ours):
            node.request, node.stuck = None, True


def _begin_anew(run: Run) -> None:
    """Let nodes come up again that went down once, with all of their process."""
    renewed = [each for each in run.nodes.values() if each.renew]
    going = {each.key for each in renewed if not each.is_down or _has_process(run, each)}
    for node in renewed:
        group = [each for each in renewed if each is node or node.process == each.process != ""]
        needs = {after.node for each in group for after in each.planned.after}
        if going.isdisjoint({*needs, *(each.key for each in group)}):  # down first, up last
            node.renew = node.stuck = False


def _has_process(run: Run, node: Node) -> bool:
    process = run.processes.get(node.process)
    return process is not None and process.state is not None


def _hold(run: Run) -> list[Event]:
    """Hold the system once it is up, and end the run once it was held for as long as asked."""
    if run.held_s is None:
        if run.passage is None and not run.failures and run.furthest:
            run.held_s = run.measures_s = run.now_s
        return []
    said: list[Event] = []
    since_s = run.decided_s
    if since_s is None:
        if gate.is_measuring(run):
            return []
        if gate.has_probation(run) and gate.is_unsettled(run):
            # Its data are measured once it is whole again.
            since_s = run.measures_s + PROBATION_S
        else:
            since_s = run.decided_s = run.now_s
            said = _measured(run)
    hold_s = run.options.hold_s
    over_s = NEVER_S if hold_s is None else since_s + hold_s
    if not run.is_past(over_s) or run.order is not None or run.failures:
        return said
    waits = not (gate.is_latest(run) and gate.allows(run))
    if waits and not run.is_past(over_s + advance.GLANCE_S):
        return said
    return [*said, *failure.end_done(run)]


def _measured(run: Run) -> list[Event]:
    verdict = run.judged.verdict
    if verdict is None or not verdict.measured:
        return []
    flows = (each for each in verdict.measured if each.bounds)
    said = [Notice(message=f"measured: {each.describe()}") for each in flows]
    return [VerdictChanged(stage=advance.stage_of(run), verdict=verdict), *said]


def _returned(run: Run) -> list[Event]:
    """Say of processes that failed that they are as far again as they are to be."""
    events: list[Event] = []
    if run.ending is not None or run.opening is not None:
        return []
    for process in run.processes.values():
        members = [*run.nodes_of(process.name)]
        if process.away_s is not None and all(
            Level.DOWN < advance.wanted(run, each) <= each.level for each in members
        ):
            run.again = run.again or not any(each.is_gated for each in members)
            events.append(
                Restarted(
                    process=process.name,
                    nodes=tuple(each.name for each in members),
                    restarts=process.restarts,
                    took_s=run.now_s - process.away_s,
                )
            )
            process.away_s = None
    return events
