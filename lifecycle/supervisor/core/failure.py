"""What fails, and what follows: a restart, the way back from a change, or the end of the run.

Owns: `fail`, which every failure of a node or process goes through in every phase, the sentences
for people, and how a run ends: `end` and the exit code. Pure.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

from msgspec.structs import replace

from lifecycle.errors import ExitCode
from lifecycle.manifest.model import Restart, RosArguments, RunKind, Supervision
from lifecycle.supervisor.control.protocol import ControlRequest, Failed, ProcessState
from lifecycle.supervisor.core import gate
from lifecycle.supervisor.core.advance import holds_up, late_at_s, phase_of, wanted
from lifecycle.supervisor.core.change import go_back, undone
from lifecycle.supervisor.core.messages import Exited
from lifecycle.supervisor.core.state import (
    NEVER_S,
    UP,
    Change,
    Ending,
    Level,
    Node,
    Process,
    Run,
    Step,
)
from lifecycle.supervisor.run.events import (
    Event,
    Failure,
    GaveUp,
    Notice,
    RestartScheduled,
    Stopping,
)
from lifecycle.supervisor.run.options import Until
from lifecycle.verify.judge import missing, not_ok
from lifecycle.verify.outcome import Outcome
from lifecycle.verify.rules import Rule, rule
from lifecycle.verify.rules.catalogue import DEADLINE, GAVE_UP, PROCESS_DIED, START_FAILED
from lifecycle.verify.verdict import Verdict

ALSO_S = 0.5
"""For steps in progress to fail, too, once one has failed: one run names all causes."""

_ING = {
    Step.START: "starting",
    Step.CONFIGURE: "configuring",
    Step.WIRE: "being wired",
    Step.CONNECT: "connecting",
    Step.ACTIVATE: "activating",
    Step.DEACTIVATE: "deactivating",
}


APPEARING = "waiting to appear in the graph"
_UNMANAGED = "waiting for its lifecycle services"


def doing(run: Run, node: Node) -> str:
    """Return what a node does, or waits for, as in messages; empty when nothing."""
    if node.request is not None:
        hosted = node.planned.run.kind is RunKind.PYTHON or node.planned.run.component
        if node.request.step is Step.START and not hosted:
            services = _UNMANAGED if node.planned.managed else "waiting for its parameter services"
            return services if node.appeared else APPEARING
        return _ING.get(node.request.step, "being taken down")
    process = run.processes.get(node.process)
    if process is not None and process.state is ProcessState.STARTING:
        return _ING[Step.START]
    higher = [each for each in node.levels if each > node.level]
    if not higher or wanted(run, node) <= node.level:
        return ""
    if higher[0] is Level.ACTIVE and (run.passage is None or not run.passage.opened):
        return ""  # it waits for the gate as all others do
    held = holds_up(run, node, higher[0])
    return f"waits to {UP[higher[0]].value} until {held}" if held else ""


def unfinished(run: Run) -> str:
    """Say what every node is doing, or waits for, that is in a step; empty if none is."""
    found = ((each.name, doing(run, each)) for each in run.nodes.values())
    return "; ".join(
        f"{name} {'' if text.startswith('waits') else 'is still '}{text}"
        for name, text in found
        if text
    )


def death(run: Run, process: Process, given: Exited) -> list[Failure]:
    """Return the failures that an unexpected end is: what it said that it fails of, if it did."""
    members = [*run.nodes_of(process.name)]
    node = members[0] if len(members) == 1 else None
    name = process.name if node is None else node.name
    if given.reports:
        return [
            _failure(START_FAILED, subject or name, _start_failed(subject or name, text), process)
            for subject, text in given.reports
        ]
    while_ = doing(run, node) if node is not None else ""
    what = f"process {name!r}" if node is None else repr(name)
    while_ = f" while {while_}" if while_ else ""
    barks = process.escalation is None and bool(process.sent)  # it was sent nothing else
    hangs = next((each.hangs for each in members if each.hangs and barks), "")
    after_s = process.how.watchdog_sec
    why = f": its watchdog ended it after {after_s:g} s, because {hangs}" if hangs else ""
    words = f": {given.words}" if given.words else ""
    end = f"{given.text}{_not_run(process, given)}"
    text = f"cannot keep {what} running: pid {process.pid} died{while_}: {end}{words}{why}"
    if node is not None and "--ros-args" in given.words:
        text += f"; if it takes no ROS arguments, write 'ros_args: none' at nodes.{node.key}.run"
    return [_failure(PROCESS_DIED, name, text, process)]


def _not_run(process: Process, given: Exited) -> str:
    """Name the program of a command where its status says, as of a shell, that it cannot be run."""
    why = {126: "may not be run", 127: "is not there"}.get(given.status or 0)
    argv = process.planned.argv
    if why is None or process.planned.run.kind is not RunKind.COMMAND or not argv:
        return ""
    return f", as of a program that {why}: {argv[0]!r}"


def forced(process: Process) -> Event:
    """Return what is said of a process that did not end when it was asked to."""
    name = _SIGNALS.get(process.sent[-1], str(process.sent[-1]))
    return Notice(message=f"process {process.name!r} had to be ended with {name}")


_SIGNALS = {2: "SIGINT", 9: "SIGKILL", 15: "SIGTERM"}


def activated(node: Node) -> Event:
    """Return what is said of a node that the gate has not let through, and that is active."""
    is_guarded = node.guarded <= gate.GUARD_TRIES
    what = "it is deactivated" if is_guarded else gate.ACTIVATES_ITSELF
    return Notice(message=f"{node.name!r} {gate.BY_ITSELF}: {what}")


def _start_failed(name: str, text: str) -> str:
    return text if text.startswith("cannot") else f"cannot start {name!r}: {text}"


def of_step(run: Run, node: Node, what: Rule, message: str) -> Failure:
    """Return the failure of a step of one node: a component's is its container's."""
    process = run.process_of(node)
    text = _start_failed(node.name, message) if what is START_FAILED else message
    return _failure(what, node.name, text, process)


def too_late(run: Run, node: Node, limit_s: float, where: str = "") -> Failure:
    """Return the failure of a node whose step takes longer than it may."""
    what = doing(run, node)
    at = f", in {where}" if where else ""
    text = f"cannot bring up {node.name!r}: it was still {what} after {limit_s:g} s{at}"
    text += advice(run, node)
    return _failure(DEADLINE, node.name, text, run.process_of(node))


def say_slow(run: Run) -> list[Event]:
    """Say once of a node that is to be found in the graph what is waited for, and how long yet."""
    said: list[Event] = []
    for node in run.nodes.values():
        request = node.request
        if request is None or request.said or request.step is not Step.START:
            continue
        what = doing(run, node)
        if what in (APPEARING, _UNMANAGED) and run.is_past(request.since_s + gate.SAY_S):
            request.said = True
            left_s = late_at_s(request) - run.now_s
            limit = f", for up to {left_s:.0f} s more" if left_s < NEVER_S else ""
            text = f"{node.name!r} is still {what}{limit}"
            said.append(Notice(message=text + advice(run, node)))
    return said


def advice(run: Run, node: Node) -> str:
    """Say what key of the manifest may mend that a node is not found; empty where none may."""
    if doing(run, node) == _UNMANAGED:
        return f"; if it is a plain node, write 'managed: false' at nodes.{node.key}"
    process, planned = run.processes.get(node.process), node.planned
    if process is None or planned.run.kind is not RunKind.COMMAND:
        return ""
    named = any(each.endswith(f"__node:={planned.name}") for each in process.planned.argv)
    if named or doing(run, node) != APPEARING:
        return ""
    namespace = node.name.rpartition("/")[0]
    others = sorted(each for each in run.undeclared if each.rpartition("/")[0] == namespace)
    if others:
        shown = " and ".join(map(repr, others[:_NAMED]))
        name = others[0].rpartition("/")[2] if len(others) == 1 else "…"
        which = "this one" if len(others) == 1 else "one of them"
        mend = f"the graph shows {shown}, not declared: if it is {which}, write 'name: {name}'"
    elif planned.run.ros_args is RosArguments.NONE:
        mend = "it gets no ROS arguments: write the name that its code gives it as 'name'"
    else:
        mend = f"if its code calls it otherwise, write 'name: {planned.name}'"
    return f"; {mend} at nodes.{planned.key}"


_NAMED = 3
"""Undeclared nodes that are named as what a missing one may be."""


def _failure(what: Rule, subject: str, message: str, process: Process | None) -> Failure:
    name = "" if process is None else process.name
    log = "" if process is None else process.log
    return Failure(rule=what.id, subject=subject, message=message, process=name, log=log)


# What follows


def fail(run: Run, failure: Failure, end: Exited | None = None) -> list[Event]:
    """Take one failure of a run that is not ending; `end`: of its process, if that has ended."""
    process = run.processes.get(failure.process)
    run.changed()
    change = run.change
    if change is not None and not change.back:
        events = go_back(run, failure.message, ExitCode.BRING_UP_FAILED)
        if _is_of_change(run, change, failure, end):
            return events
        return [*events, *fail(run, failure, end)]  # what fails of others counts as ever
    if process is not None and process.failed:
        return []  # it is to be started again for another failure already
    status = None if end is None else end.status
    if process is not None and is_restarted(process.how, status):
        _cut_short(run, failure)
        return _back_off(run, process, failure, end)
    died = end is not None or failure.rule == PROCESS_DIED.id
    if run.options.keep_going and run.held_s is not None and died:
        if process is not None:
            process.stays_down = True
        run.deaths.append(failure)
        return [goes_on(failure)]
    if not run.failures:
        run.fails_s = run.now_s + ALSO_S
    # One that says why it cannot go on, and ends, has failed once.
    ends = failure.rule == PROCESS_DIED.id and failure.process != ""
    known = {each.process if ends else (each.rule, each.subject) for each in run.failures}
    if (failure.process if ends else (failure.rule, failure.subject)) not in known:
        run.failures.append(failure)
    return []


def _is_of_change(run: Run, change: Change, failure: Failure, end: Exited | None) -> bool:
    """Return whether the way back mends a failure: of what it takes down, or of what still runs."""
    node = run.node_named(failure.subject)
    keys = {each.key for each in run.nodes_of(failure.process)} if failure.process else set()
    keys |= set() if node is None else {node.key}
    died = end is not None or failure.rule == PROCESS_DIED.id
    if died and keys.isdisjoint(change.touched | change.down):
        return False
    change.down |= keys
    change.touched |= keys
    return True


def goes_on(failure: Failure) -> Failure:
    """Return a failure as one that does not end the run."""
    return replace(failure, ends_run=False)


def _cut_short(run: Run, failure: Failure) -> None:
    """Answer the order that a failure cuts short; a pause goes on. All wait for the gate again."""
    run.shut_gate()
    if run.change is not None:
        run.change.again = failure.message
    elif run.order is not None and run.order.ask is not ControlRequest.PAUSE:
        run.passage, run.switch, run.to_give = None, None, {}
        run.answer(ExitCode.BRING_UP_FAILED, failure.message)


def _back_off(run: Run, process: Process, failure: Failure, end: Exited | None) -> list[Event]:
    """Have a process, and what goes down with it, started again later; or give it up."""
    process.failure = remembered = _remembered(run, failure, end)
    was_up = run.held_s is not None
    due_s = again_at_s(process, run.now_s, was_up=was_up)
    events: list[Event] = [goes_on(failure)]
    if due_s is None:
        events.append(GaveUp(process=process.name, restarts=process.restarts))
        run.fails_now(_given_up(process, failure, was_up=was_up))
        return events
    keys = run.group(process.name)
    for key in keys:
        node = run.nodes[key]
        node.renew, node.due_s = True, max(node.due_s, due_s)
    process.failed = True
    process.away_s = run.now_s if process.away_s is None else process.away_s
    if run.passage is not None:
        run.passage.mark, run.passage.until_s = None, due_s + run.timeout_s
    events.append(
        RestartScheduled(
            process=process.name,
            nodes=tuple(run.nodes[key].name for key in keys),
            reason=failure.message,
            stderr=remembered.stderr,
            restarts=process.restarts,
            in_s=due_s - run.now_s,
        )
    )
    return events


def again_at_s(process: Process, now_s: float, *, was_up: bool) -> float | None:
    """Return when a process that fails now is to be started again; None to give up.

    What the keys mean is systemd.service(5)'s. Until its system `was_up` no start is forgotten: a
    process that fails late each time must not hold a bring-up for ever.
    """
    interval_s = process.how.start_limit_interval_sec
    if interval_s and process.starts and now_s - process.starts[-1] >= interval_s:
        process.in_a_row = 0
    process.in_a_row += 1
    again_s = now_s + delay_s(process.how, process.in_a_row)
    if interval_s:
        if was_up:
            process.starts = [each for each in process.starts if each > again_s - interval_s]
        if len(process.starts) >= process.how.start_limit_burst:
            return None
    return again_s


def is_restarted(how: Supervision, exit_status: int | None) -> bool:
    """Return whether a process is started again after such an end; None: not an exit by itself."""
    if how.restart is Restart.ON_FAILURE:
        return exit_status != 0
    return how.restart is Restart.ALWAYS


def delay_s(how: Supervision, in_a_row: int) -> float:
    """Return the seconds between a failure, the `in_a_row`th, and the next start."""
    longest = how.restart_max_delay_sec
    if longest is None or not how.restart_steps or not how.restart_sec:
        return how.restart_sec
    if in_a_row > how.restart_steps:
        return longest
    exponent = (in_a_row - 1) / how.restart_steps
    return how.restart_sec * math.pow(longest / how.restart_sec, exponent)


def _remembered(run: Run, failure: Failure, end: Exited | None) -> Failed:
    return Failed(
        rule=failure.rule,
        subject=failure.subject,
        message=failure.message,
        exit_status=None if end is None else end.status,
        signal="" if end is None or not end.signal else end.text.removeprefix("killed by "),
        stderr="" if end is None else end.stderr,
        elapsed_s=run.now_s,
    )


def _given_up(process: Process, failure: Failure, *, was_up: bool) -> Failure:
    how = process.how
    burst = how.start_limit_burst
    within = f"within {how.start_limit_interval_sec:g} s" if was_up else "during bring-up"
    text = (
        f"cannot keep {process.name!r} running: it was started {burst} time{'s' * (burst != 1)} "
        f"{within} (start_limit_burst, start_limit_interval_sec) and failed again: "
        f"{failure.message}"
    )
    return replace(failure, rule=GAVE_UP.id, message=text, process=process.name)


# The end


def end(run: Run, ending: Ending) -> list[Event]:
    """End the run: from now on everything is to be down. Whatever is open is answered."""
    if run.ending is not None:
        return []
    restarts = [(each.name, each.restarts) for each in run.processes.values()]
    said = [f"{name!r} {n} time{'s' * (n != 1)}" for name, n in restarts if n]
    summary = f"restarted: {', '.join(said)}" if said else ""
    reasons = (ending.reason, summary, gate.passed(run.judged))
    run.ending, failures = ending, ending.failures
    ending.reason, ending.deaths = "; ".join(filter(None, reasons)), len(run.deaths)
    change, run.undone = run.change, None
    run.passage = run.switch = run.change = None
    text = f"cannot go on: {run.plan.system!r} is being taken down"
    answer = "; ".join(each.message for each in failures) or text
    if change is not None and change.back and failures:
        answer = undone(run, change)
    run.answer(ExitCode.BRING_UP_FAILED, answer)
    run.outbox += [(each.id, ExitCode.BRING_UP_FAILED, text) for each in run.orders]
    run.orders.clear()
    return [*failures, Stopping(reason=ending.stopping)]


def end_failed(run: Run) -> list[Event]:
    """End the run for what failed."""
    gave_up = any(each.rule == GAVE_UP.id for each in run.failures)
    code = ExitCode.SUPERVISION_GAVE_UP if gave_up else ExitCode.BRING_UP_FAILED
    ending = Ending(
        code=code,
        stopping="rolling back",
        reason=_named(run.failures),
        failures=tuple(run.failures),
        failed=True,
    )
    return end(run, ending)


def end_refused(run: Run, verdict: Verdict, stopping: str) -> list[Event]:
    """End the run because the gate stays closed."""
    reason = f"{stopping}; {not_ok(verdict) or verdict.verdict.value}"
    ending = Ending(code=gate.exit_code(verdict), stopping=stopping, reason=reason, failed=True)
    return end(run, ending)


def end_done(run: Run) -> list[Event]:
    """End a run that was held for as long as was asked."""
    code, why = _outcome(run, run.judged.counted)
    if code is ExitCode.OK and run.decided_s is None and gate.has_probation(run):
        code, why = ExitCode.UNVERIFIABLE, "its data were not measured"
    reason = f"done, but {why}" if why else "done"
    return end(run, Ending(code=code, stopping="done", reason=reason))


def stop(run: Run, reason: str, code: ExitCode) -> list[Event]:
    """End a run that is asked to end.

    It is a success only if the system was verified, is what was asked for, and nothing bound it to
    stay; an interrupt (Ctrl-C) never is, nor what a violation ends.
    """
    if run.held_s is None:
        latest, phase = run.judged.verdict, phase_of(run)
        why = unfinished(run) or (missing(latest) if latest and phase == "verifying" else "")
    else:
        is_kept = phase_of(run) in ("measuring", "active", "paused", "pausing")
        asked = code
        # What is seen of nodes that an order has on their way is no verdict on the system.
        is_changing = not is_kept and (run.order or run.change or run.switch) and not run.deaths
        code, why = (ExitCode.OK, "") if is_changing else _outcome(run, "")
        if asked in (ExitCode.INTERRUPTED, ExitCode.VIOLATED):
            code = asked
        elif code is not ExitCode.OK:
            pass  # it was no success before it was asked to end
        elif run.options.hold_s is not None:
            code, why = asked, f"it did not hold for the {run.options.hold_s:g} s of --stop-after"
        elif not is_kept:
            code, why = asked, f"the system was {phase_of(run)}, not active"
        elif run.judged.counted:
            why = f"violated meanwhile, {run.judged.counted}"
    said = f"{reason}; {why}" if why else reason
    return end(run, Ending(code=code, stopping=reason, reason=said))


def _outcome(run: Run, meanwhile: str) -> tuple[ExitCode, str]:
    """Return the exit code of a system that was held until now, and why it is no success."""
    verdict = run.judged.verdict
    if run.deaths:
        return ExitCode.BRING_UP_FAILED, _named(run.deaths)
    if run.options.until is Until.CONNECTED or verdict is None:
        return ExitCode.OK, ""
    left = _follows_from_shut_down(run, verdict)
    withheld = any(each.withheld for each in run.nodes.values())
    held = (withheld or phase_of(run) == "held") and run.options.until is Until.ACTIVE
    closed = gate.closes(verdict, strict=run.options.strict) and not left
    down = ", ".join(each.name for each in run.processes.values() if each.failed)
    violated = closed and verdict.verdict is Outcome.VIOLATED
    found = (
        (violated, ExitCode.VIOLATED, f"violated; {not_ok(verdict)}"),
        (meanwhile, ExitCode.VIOLATED, f"violated meanwhile, {meanwhile}"),
        (closed, ExitCode.UNVERIFIABLE, f"unverifiable; {not_ok(verdict)}"),
        (held, ExitCode.VIOLATED, "held at the gate, and not active"),
        (down, ExitCode.VIOLATED, f"down, and to be started again: {down}"),
    )
    return next(((code, why) for holds, code, why in found if holds), (ExitCode.OK, ""))


def _named(failures: Iterable[Failure]) -> str:
    return f"failed: {', '.join(f'{each.subject} ({each.rule})' for each in failures)}"


def _follows_from_shut_down(run: Run, verdict: Verdict) -> bool:
    """Return whether nothing is violated but the absence of hosts that were shut down properly."""
    violated = [each for each in verdict.findings if each.outcome is Outcome.VIOLATED]
    return bool(violated) and all(
        rule(each.rule).about is not None and not run.left.isdisjoint(each.nodes)
        for each in violated
    )


def exit_code_of(run: Run) -> ExitCode:
    """Return the exit code of a run that is over: a death on the way down counts, too."""
    assert run.ending is not None
    code = run.ending.code
    well = (ExitCode.OK, ExitCode.VIOLATED, ExitCode.UNVERIFIABLE)
    if run.deaths and code in well:
        return ExitCode.BRING_UP_FAILED
    return ExitCode.INTERRUPTED if run.hurry and code is ExitCode.OK else code


def fail_late(run: Run, why: str) -> list[Event]:
    """Fail a bring-up, or an order, that takes too long: say what nodes were doing, or why."""
    busy = (
        each
        for each in run.nodes.values()
        if each.request is not None and wanted(run, each) is not Level.DOWN
    )
    culprit, change = next(busy, None), run.change
    subject = run.plan.system if culprit is None else culprit.name
    timeout_s = run.timeout_s if change is None or change.back else change.timeout_s
    why = unfinished(run) or why
    text = f"cannot bring up {run.plan.system!r} within {timeout_s:.3g} s: {why}"
    text += next(filter(None, (advice(run, each) for each in run.nodes.values())), "")
    process = None if culprit is None else run.process_of(culprit)
    run.shut_gate()
    events = fail(run, _failure(DEADLINE, subject, text, process))
    if run.failures:
        run.fails_s = run.now_s  # all that is missing is named
    elif run.passage is not None:  # what is started again may be due later
        run.passage.until_s = max(run.passage.until_s, run.now_s + run.timeout_s)
    return events
