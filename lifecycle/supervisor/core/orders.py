"""Orders: which fit what the system is doing, what each is in the state, and when it is done.

One is carried out at a time; one that comes meanwhile waits for its end. Each is answered once.
What the manifest has done about violations that last (`on_violation`) is as if a person ordered it.
Pure.
"""

from __future__ import annotations

from collections.abc import Iterable

from lifecycle.errors import ExitCode, did_you_mean
from lifecycle.manifest.model import BY_DEFAULT, Consequence, OnViolation, Reaction, Restart
from lifecycle.plan.model import Plan
from lifecycle.supervisor.control.protocol import ControlRequest
from lifecycle.supervisor.core import advance, failure, gate
from lifecycle.supervisor.core.change import apply, enter_mode
from lifecycle.supervisor.core.messages import Ordered
from lifecycle.supervisor.core.passing import reached
from lifecycle.supervisor.core.state import Level, Node, Order, Passage, Run
from lifecycle.supervisor.run.events import ConsequenceTaken, Event
from lifecycle.supervisor.run.options import Until
from lifecycle.verify.judge import not_ok
from lifecycle.verify.outcome import Outcome
from lifecycle.verify.rules import rule
from lifecycle.verify.rules.catalogue import About
from lifecycle.verify.verdict import Finding, FindingKey

SAID = {
    ControlRequest.MODE: "switch the mode of",
    ControlRequest.APPLY: "apply another manifest to",
}

_UP = ("active", "paused", "held")
_ONLY_UP = "only a system that is active or paused can"
FITS = {
    ControlRequest.PAUSE: (("active", "held"), "only an active system can be paused"),
    ControlRequest.RESUME: (("paused", "held"), "only a paused system can be resumed"),
    ControlRequest.RESTART: (_UP, f"{_ONLY_UP} be restarted"),
    ControlRequest.MODE: (_UP, f"{_ONLY_UP} enter another mode"),
    ControlRequest.APPLY: (_UP, f"{_ONLY_UP} take another manifest"),
}
"""In which phases an order can begin, and what is said in any other."""


def refusal(run: Run, order: Order) -> str:
    """Return why an order cannot be carried out now; empty if it can."""
    phases, hint = FITS[order.ask]
    # What policy does meanwhile is nobody's order.
    phase = advance.phase_of(run) if run.held_s is None else advance.rests_as(run)
    if phase not in phases:
        return f"{_cannot(order, run.plan.system)}: it is {phase}; {hint}"
    return _unfit(run, order)


def _cannot(order: Order, what: str) -> str:
    return f"cannot {SAID.get(order.ask, order.ask.value)} {what!r}"


def _unfit(run: Run, order: Order) -> str:
    """Say why an order can be carried out in no phase; empty if it can."""
    if order.node and named(run, order.node) is None:
        return _not_restarted(run, order.node)
    return _not_entered(run, order.mode) if order.ask is ControlRequest.MODE else ""


def _not_restarted(run: Run, name: str) -> str:
    known = run.nodes.get(name) or run.node_named(name)
    if known is not None:
        return f"cannot restart {known.name!r}: it is attached, no process of this supervisor"
    ours = sorted(each.name for each in run.nodes.values() if run.process_of(each) is not None)
    return f"cannot restart {name!r}: this supervisor runs no such node; it runs: {', '.join(ours)}"


def _not_entered(run: Run, mode: str) -> str:
    system, modes = run.plan.system, [each.name for each in run.plan.modes]
    if mode not in modes:
        known = f"the modes {', '.join(modes)}" if modes else "no modes"
        hint = did_you_mean(mode, modes) if modes else "declare them under 'modes:'"
        text = f"cannot enter mode {mode!r} of {system!r}: it has {known}"
        return f"{text}; {hint}" if hint else text
    if run.elsewhere:
        return (
            f"cannot switch the mode of {system!r}: nodes on other machines run in it, too; modes "
            "are switched where one supervisor runs all nodes"
        )
    return ""


def named(run: Run, name: str) -> Node | None:
    """Return the node that an order names, if it is ours to restart."""
    node = run.nodes.get(name) or run.node_named(name)
    ours = node is not None and (node.planned.run.component or run.process_of(node) is not None)
    return node if ours else None


def ordered(run: Run, given: Ordered) -> list[Event]:
    """Take an order: it is refused at once, carried out, or waits for the one under way."""
    code, why = refused_at_once(run, given.order)
    if why:
        run.outbox.append((given.order.id, code, why))
    else:
        run.orders.append(given.order)
    return []


def refused_at_once(run: Run, order: Order) -> tuple[ExitCode, str]:
    """Return why an order is not even kept until its turn comes; an empty text if it is."""
    if run.ending is not None:
        text = f"cannot go on: {run.plan.system!r} is being taken down"
        return ExitCode.BRING_UP_FAILED, text
    if run.order is not None and run.order.ask is ControlRequest.APPLY:
        return ExitCode.USAGE, (
            f"{_cannot(order, run.plan.system)}: it is {advance.phase_of(run)}, another manifest "
            "is being applied to it; ask again once 'lifecycle apply' has ended; 'lifecycle down' "
            "is taken at once"
        )
    return ExitCode.USAGE, refusal(run, order) if run.held_s is None else _unfit(run, order)


def settle_orders(run: Run) -> list[Event]:
    """Be done with the order that is carried out, and begin the next."""
    events: list[Event] = []
    if run.pauses and _is_free(run):
        run.pauses = False
        events.append(reached(run, "paused"))
    if run.order is not None and _is_free(run):
        run.answer(ExitCode.OK)
    while run.order is None and run.orders and _is_free(run):
        order = run.orders.popleft()
        if why := refusal(run, order):
            run.outbox.append((order.id, ExitCode.USAGE, why))
            continue
        run.order = order
        events += _begin(run, order)
    return events


def _is_free(run: Run) -> bool:
    """Return whether nothing is under way that the end of an order, or the next, waits for."""
    busy = run.switch or run.change or run.asked or run.failures
    return not busy and advance.is_settled_down(run)


def _begin(run: Run, order: Order) -> list[Event]:
    """Note an order in the state, by which it is carried out."""
    run.passage = None
    run.changed()
    if order.ask is ControlRequest.APPLY:
        return apply(run, order)
    if order.ask is ControlRequest.PAUSE:
        run.paused = run.pauses = True
    elif order.ask is ControlRequest.MODE:
        enter_mode(run, order.mode)
    else:
        if order.ask is ControlRequest.RESTART:
            _restart(run, order)
            run.pauses = run.paused
        opens = order.ask is ControlRequest.RESUME or not run.paused
        until_s = run.now_s + run.timeout_s
        until = Until.ACTIVE if opens else Until.CONNECTED
        run.passage = Passage(until_s=until_s, until=until)
    return []


def restarted(run: Run, order: Order) -> set[str]:
    """Return the keys of the nodes that an order restarts: of all that comes and goes with one."""
    if not order.node:
        return set(run.nodes)
    node = named(run, order.node)
    keys = set() if node is None else set(run.whole({node.key}))
    return keys | _gone_with(run, keys)


def _restart(run: Run, order: Order) -> None:
    keys = restarted(run, order)
    names = {run.nodes[key].process for key in keys}
    run.deaths = [each for each in run.deaths if each.process not in names]
    for key in keys:
        each = run.nodes[key]
        each.due_s = 0.0
        each.renew = True
        process = run.processes.get(each.process)
        if process is not None:
            process.restarted_by_hand()


def _gone_with(run: Run, keys: set[str]) -> set[str]:
    """Return the keys of the nodes that wait in the same backoff, and for no failure of theirs."""
    names = {run.nodes[key].process for key in keys}
    found = set[str]()
    for name in names:
        process = run.processes.get(name)
        if process is not None and process.failed:
            found.update(run.group(name))
    others = {each.name for each in run.processes.values() if each.failed} - names
    return {key for key in found if run.nodes[key].process not in others}


# What the manifest orders by `on_violation`

_BY_STRENGTH = tuple(Consequence)


def reaction_of(plan: Plan, finding: Finding) -> Reaction:
    """Return what is to be done about a violation: its nodes' word counts before the system's."""
    names = finding.nodes or (finding.subject,)
    nodes = (each.on_violation for each in plan.nodes if each.full_name in names)
    found = _strongest(finding, nodes) or _strongest(finding, (plan.on_violation,))
    return found or Reaction(rule=BY_DEFAULT, what=Consequence.REPORT)


def _strongest(finding: Finding, said: Iterable[OnViolation]) -> Reaction | None:
    found: list[Reaction] = []
    for each in said:
        for name in (finding.rule, rule(finding.rule).family, BY_DEFAULT):
            if own := [one for one in each if one.rule == name]:
                found += own
                break
    return max(found, key=lambda one: _BY_STRENGTH.index(one.what), default=None)


def settle_consequences(run: Run) -> list[Event]:
    """Do about violations that last what the manifest asks for, as a person would order it."""
    verdict = run.judged.verdict
    if run.held_s is None or run.paused or verdict is None:
        return []
    busy = run.order or run.opening or not _is_free(run)
    if busy or run.options.until is not Until.ACTIVE:
        return []
    verdict = gate.of_those_there(run, gate.without(run, verdict, run.away | run.judged.away))
    run.judged.tried &= {each.key for each in verdict.findings}
    coming = _coming_elsewhere(run, verdict.findings)
    asked: dict[FindingKey, tuple[Consequence, Finding, tuple[str, ...], str]] = {}
    for each in verdict.findings:
        due = _asked(run, each)
        if each.outcome is Outcome.VIOLATED and due and coming.isdisjoint(each.nodes):
            asked[each.key] = due
    since_s = run.judged.violated
    lasting = [
        due
        for key, due in asked.items()
        if key in since_s and gate.lasts_until(run, since_s[key] + gate.SETTLED_S)
    ]
    if not lasting:
        return []
    worst = max(lasting, key=lambda due: _BY_STRENGTH.index(due[0]))
    keys = {key for each in lasting if each[0] is worst[0] for key in each[2]}
    if worst[0] is Consequence.MODE:
        run.judged.tried |= {key for key, due in asked.items() if due[3] == worst[3]}
    run.judged.counted = run.judged.counted or not_ok(verdict)
    return _order(run, worst[0], worst[1], tuple(key for key in run.nodes if key in keys), worst[3])


def _order(
    run: Run, what: Consequence, found: Finding, keys: tuple[str, ...], mode: str
) -> list[Event]:
    said = ConsequenceTaken(
        action=what.value,
        nodes=tuple(run.nodes[key].name for key in keys),
        rule=found.rule,
        subject=found.subject,
        message=found.message,
    )
    reason = f"on_violation: {what.value} ({found.rule} of {found.subject})"
    run.changed()
    if what is Consequence.STOP:
        return [said, *failure.stop(run, reason, ExitCode.VIOLATED)]
    if what is Consequence.MODE:
        enter_mode(run, mode)
    elif what is Consequence.PAUSE:
        run.paused = run.pauses = True
        keys = tuple(key for key, each in run.nodes.items() if each.is_gated)
    for key in keys:
        run.nodes[key].withheld = f"{reason}; lifecycle resume"
    return [said]


def _asked(run: Run, finding: Finding) -> tuple[Consequence, Finding, tuple[str, ...], str] | None:
    """Return what would still have an effect."""
    reaction = reaction_of(run.plan, finding)
    what = reaction.what
    if what is Consequence.REPORT and run.options.strict and rule(finding.rule).measured:
        what = Consequence.PAUSE  # a strict gate would not have opened, had it been known
    names = set(finding.nodes or (finding.subject,))
    own = [each for each in run.nodes.values() if each.name in names]
    concerned = any(each.full_name in names for each in run.plan.nodes)
    if what is Consequence.REPORT or (concerned and not own):
        return None  # its own supervisor has the same manifest
    if what is Consequence.MODE:
        if run.mode == reaction.mode or finding.key in run.judged.tried:
            return None
        return what, finding, (), reaction.mode
    if what is Consequence.DEACTIVATE:
        gated = [each for each in own if each.is_gated]
        active = (each for each in gated if each.level is Level.ACTIVE and not each.withheld)
        keys = tuple(each.key for each in active)
        if gated:
            return (what, finding, keys, "") if keys else None
        what = Consequence.PAUSE
    return what, finding, (), ""


def _coming_elsewhere(run: Run, findings: Iterable[Finding]) -> frozenset[str]:
    """Return the names of nodes that are away and that another supervisor starts again."""
    restarted = {
        each.full_name
        for each in run.plan.nodes
        if each.supervision.restart is not Restart.NO and each.key not in run.nodes
    }
    return frozenset(
        each.node
        for each in findings
        if each.node in restarted and rule(each.rule).about is About.PRESENCE
    )
