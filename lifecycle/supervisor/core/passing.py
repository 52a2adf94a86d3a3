"""Nodes pass the gate: who asks, when it opens or stays closed, and what they became.

Owns: the `Passage` of a run, from the way to the gate to the verdict on what came of it; and which
nodes are started again before it because TCP did not let others discover them. Pure.
"""

from __future__ import annotations

from lifecycle.plan.restart import moving_nodes
from lifecycle.supervisor.control.protocol import ProcessState
from lifecycle.supervisor.core import advance, failure, gate
from lifecycle.supervisor.core.change import go_back, leave_mode
from lifecycle.supervisor.core.messages import Programmed
from lifecycle.supervisor.core.state import Level, Passage, Run
from lifecycle.supervisor.run.events import Event, Failure, GateOpened, Notice, SystemReached
from lifecycle.supervisor.run.options import Until
from lifecycle.verify.judge import not_ok, taken_on_trust
from lifecycle.verify.outcome import Outcome
from lifecycle.verify.rules import rule
from lifecycle.verify.rules.catalogue import NOT_PROGRAMMED, TRANSITION_FAILED, About
from lifecycle.verify.rules.nodes import MISSING_NODE
from lifecycle.verify.verdict import Verdict

CLOSED = "the verdict keeps the gate closed"


def settle(run: Run) -> list[Event]:
    """Take the passage as far as the state allows."""
    if run.failures:
        return []
    events = _arrive(run)
    if run.opening is not None:
        return [*events, *_go_on(run, run.opening)]
    _wait_again(run)
    return [*events, *(_open(run, run.passage) if run.passage is not None else [])]


def _arrive(run: Run) -> list[Event]:
    """Note that all who are on their way are at the gate; from now on its time counts."""
    passage = run.passage
    if passage is None or passage.at_gate:
        return []
    coming = run.held_s is None and run.is_backing_off
    if run.is_changing or coming or not advance.is_at_gate(run):
        is_late = run.is_past(passage.until_s)
        return failure.fail_late(run, "nothing was started") if is_late else []
    left_s = passage.until_s - run.now_s
    fresh_s = run.timeout_s if run.held_s is not None else run.options.gate_s(left_s)
    if run.change is None:
        passage.until_s = run.now_s + fresh_s
    _is_at_gate(run, passage)
    if passage.until is Until.CONNECTED:
        run.passage = None
    return [reached(run, "connected")]


def _is_at_gate(run: Run, passage: Passage) -> None:
    """Have the gate judged anew, by a look that begins now."""
    run.changed()
    passage.since_s, passage.mark = run.now_s, run.mark
    run.judged.found, run.judged.since_s = frozenset(), run.now_s


def _wait_again(run: Run) -> None:
    """Have those wait at the gate that policy started again, while nothing else is going on."""
    if run.asked is not None:
        return
    busy = run.switch is not None or run.change is not None or run.held_s is None
    if busy or not (advance.waiting(run) or run.again) or not advance.is_at_gate(run):
        run.passage = None
    elif run.passage is None:
        run.passage = Passage(until_s=run.now_s + run.timeout_s, asked=False, mark=0)
        if not gate.is_open(run):
            _is_at_gate(run, run.passage)


def _open(run: Run, passage: Passage) -> list[Event]:
    if passage.mark is None or run.judged.mark < passage.mark:
        return []
    if gate.is_open(run):
        if passage.until is Until.ACTIVE:
            _begin(run, passage)
        else:
            run.passage = None
        return [reached(run, "verified")]
    refuses = run.is_past(gate.refuses_at_s(run, passage.until_s))
    if not passage.asked:  # who policy started again goes on waiting
        return _say_closed(run, passage) if refuses and advance.waiting(run) else []
    if refuses:
        return _refused(run, again=False)
    # The verdict may allow it, and never be of a moment that lasts.
    if run.is_past(passage.until_s + gate.LEAST_S):
        return failure.fail_late(run, "it changes all the time")
    late = not gate.allows(run) and run.is_past(passage.since_s + gate.SAY_S)
    return _say_closed(run, passage) if late else []


def _say_closed(run: Run, passage: Passage) -> list[Event]:
    """Say once that the gate stays closed: of what is asked, for how long it may."""
    verdict = run.judged.verdict
    if passage.said or verdict is None:
        return []
    passage.said = True
    if not passage.asked:
        return [Notice(message=gate.refusal(verdict))]
    left_s = max(0.0, passage.until_s - run.now_s)
    return [Notice(message=f"waits up to {left_s:.0f} s more for its gate: {not_ok(verdict)}")]


def _begin(run: Run, passage: Passage) -> None:
    passage.begun_s, passage.waiting, passage.paused = run.now_s, advance.waiting(run), run.paused
    if not passage.asked:
        passage.until_s = run.now_s + gate.AGAIN_S


def programmed(run: Run, given: Programmed) -> list[Event]:
    """Take it that networks are programmed: the gate opens for those that wait at it."""
    passage = run.passage
    if passage is None or passage.programming != given.number:
        return []  # that passage was given up
    passage.programming = 0
    if given.error:
        found = Failure(rule=NOT_PROGRAMMED.id, subject=run.plan.system, message=given.error)
        return failure.fail(run, found)
    return []


def _go_on(run: Run, passage: Passage) -> list[Event]:
    verdict = run.judged.verdict
    assert verdict is not None
    assert passage.begun_s is not None
    nodes = [run.nodes[key] for key in passage.waiting]
    behind = [each for each in nodes if advance.wanted(run, each) is Level.ACTIVE]
    done = passage.is_programmed and all(each.level is Level.ACTIVE for each in behind)
    if gate.is_open(run) and passage.is_programmed:
        if not passage.sent and verdict.flows != passage.flows:
            passage.flows = None  # other flows are verified than were programmed
            return []
        events = [] if passage.opened else _let_through(run, passage, verdict)
        return [*events, *(_passed(run) if done else [])]
    until_s = max(passage.until_s, passage.begun_s + gate.LEAST_S)
    if run.is_past(gate.refuses_at_s(run, until_s)):
        became = done and bool(passage.sent)
        stays = became and (run.change is None or run.change.back)
        return _became_another(run) if stays else _refused(run, again=not became)
    if run.is_past(max(passage.until_s, passage.begun_s + run.timeout_s)):
        return failure.fail_late(run, "its gate was not passed")
    return []


def _let_through(run: Run, passage: Passage, verdict: Verdict) -> list[Event]:
    passage.opened = True
    run.trusted = taken_on_trust(verdict)
    if passage.asked:
        run.paused = False
    for key in passage.waiting:
        run.nodes[key].withheld, run.nodes[key].refused = "", False
    names = tuple(run.nodes[key].name for key in passage.waiting)
    if not names and (run.change is not None or not passage.asked):
        return []
    return [GateOpened(outcome=verdict.verdict.value, nodes=names, trusted=run.trusted)]


def _passed(run: Run) -> list[Event]:
    run.passage, run.again = None, False
    for node in run.nodes.values():
        if node.level is Level.ACTIVE:
            node.guarded = 0
    gated = [each for each in run.nodes.values() if each.is_gated]
    whole = all(each.level is Level.ACTIVE for each in gated)
    return [reached(run, "active")] if whole else []


def reached(run: Run, what: str) -> Event:
    """Note, and say, how far the system has come."""
    order = ("", "connected", "verified", "active")
    if what in order and order.index(what) > order.index(run.furthest):
        run.furthest = what
    return SystemReached(reached=what, elapsed_s=run.now_s)


def _withdraw(run: Run, passage: Passage) -> list[Event]:
    begun = [run.nodes[key] for key in passage.sent]
    for node in begun:
        node.let_through = False
    run.paused = run.paused or passage.paused
    run.passage, run.again = None, False
    names = ", ".join(sorted(each.name for each in begun))
    return [Notice(message=f"the gate closed again: {names} is deactivated")] if begun else []


def _refused(run: Run, *, again: bool) -> list[Event]:
    """The gate stays closed, or closed again, for who asked."""
    verdict, passage = run.judged.verdict, run.passage
    assert verdict is not None
    assert passage is not None
    text, code = gate.refusal(verdict, again=again), gate.exit_code(verdict)
    keys = advance.waiting(run)
    if run.held_s is None:
        stopping = CLOSED
        if again:
            stopping = "the system changed before every node was activated"
        if run.is_past(passage.until_s):
            over = f"the {round(passage.until_s, 1):g} s of the bring-up are over (--timeout)"
            stopping = f"{stopping}, and {over}"
        return failure.end_refused(run, verdict, stopping)
    sent = tuple(passage.sent)
    said = _withdraw(run, passage)
    change = run.change
    if change is not None and not change.back:
        return [*said, *go_back(run, text, code)]
    said.append(Notice(message=text))
    if not passage.asked:
        return said
    if passage.mode:
        return [*said, *leave_mode(run, passage.mode, text, code)]
    for key in (*keys, *sent):
        # With what is started again by its policy these pass, too.
        run.nodes[key].refused = change is None or not change.again
    if change is None:
        run.answer(code, text)
    return said


def _became_another(run: Run) -> list[Event]:
    verdict, passage = run.judged.verdict, run.passage
    assert verdict is not None
    assert passage is not None
    if run.change is not None:
        run.passage = None
        return [Notice(message=gate.refusal(verdict))]
    if passage.asked:
        run.answer(gate.exit_code(verdict), gate.refusal(verdict))
        return failure.end_refused(run, verdict, "what became active is not what was verified")
    run.passage = None
    events: list[Event] = []
    for key in sorted(passage.sent):
        node = run.nodes[key]
        text = (
            f"cannot keep {node.name!r} active: what became active is not what was verified; "
            f"{not_ok(verdict)}"
        )
        events += failure.fail(run, failure.of_step(run, node, TRANSITION_FAILED, text))
    return events


# First contact over TCP
#
# Fast DDS 2.14 sometimes never uses a TCP connection that it has dialled: if the answer to its
# first message arrives before the port inside the connection was noted, the answer is ignored
# (BIND_CONNECTION_RESPONSE in RTCPMessageManager::processRTCPMessage). Then nothing is sent that
# way for as long as both participants live. A participant on another port is discovered by all.

UNCHANGED_S = 5.0
"""Who is discovered at all over TCP is after 0.1–1.6 s, on a machine with both processors busy
after 1–4 s; findings that have not changed for so long do not change any more."""

TRIES = 3
"""So often nodes are started again before a gate: each time takes 1–5 s of the bring-up."""


def settle_first_contact(run: Run) -> list[Event]:
    """Have nodes started again on fresh ports that others do not discover although they run."""
    passage, judged = run.asked, run.judged
    if passage is None or not passage.at_gate or run.opening is not None or run.failures:
        return []
    is_late = passage.until_s - run.now_s <= UNCHANGED_S or passage.tries >= TRIES
    lasts = gate.lasts_until(run, judged.since_s + UNCHANGED_S)
    if judged.verdict is None or is_late or not lasts:
        return []
    lacking, moving = undiscovered(judged.verdict), moving_nodes(run.plan)
    found = {
        node.process: node.name
        for key, node in run.nodes.items()
        if key in moving and node.name in lacking and _may_be_restarted(run, node.process)
    }
    if not found:
        return []
    passage.tries += 1
    judged.since_s = run.now_s
    for process in found:
        for each in run.nodes_of(process):
            each.renew = True
    names = " and ".join(map(repr, found.values()))
    text = (
        f"{names} {'is' if len(found) == 1 else 'are'} started again on a fresh port: not "
        f"discovered over TCP for {UNCHANGED_S:g} s ({not_ok(judged.verdict)}); "
        f"try {passage.tries} of {TRIES}"
    )
    return [Notice(message=text)]


def _may_be_restarted(run: Run, name: str) -> bool:
    process = run.processes.get(name)
    active = any(each.level is Level.ACTIVE for each in run.nodes_of(name))
    return process is not None and process.state is ProcessState.RUNNING and not active


def undiscovered(verdict: Verdict) -> frozenset[str]:
    """Return the names of the nodes that may be undiscovered; of none if that would mend nothing.

    Of two ends that do not match either may be.
    """
    violated = [each for each in verdict.findings if each.outcome is Outcome.VIOLATED]
    if not all(rule(each.rule).if_undiscovered for each in violated):
        return frozenset()
    missing = {each.node for each in violated if each.rule == MISSING_NODE.id}
    # Who is not there yet, or not so far, keeps others waiting that nothing is wrong with.
    coming = {each.node for each in violated if rule(each.rule).about is About.PROGRESS}
    unmatched = (each.ends for each in violated if rule(each.rule).about is About.MATCH)
    pairs = (each for each in unmatched if (missing | coming).isdisjoint(each))
    return frozenset(missing.union(*pairs))
