"""What is done about violations that last: `on_violation` of the manifest. Pure."""

from __future__ import annotations

from collections.abc import Iterable

from lifecycle.errors import ExitCode
from lifecycle.manifest.model import BY_DEFAULT, Consequence, OnViolation, Reaction, Restart
from lifecycle.plan.model import Plan
from lifecycle.supervisor.core import gate
from lifecycle.supervisor.core.change import enter_mode
from lifecycle.supervisor.core.failure import stop
from lifecycle.supervisor.core.state import Level, Run
from lifecycle.supervisor.run.events import ConsequenceTaken, Event
from lifecycle.supervisor.run.options import Until
from lifecycle.verify.judge import not_ok
from lifecycle.verify.outcome import Outcome
from lifecycle.verify.rules import rule
from lifecycle.verify.rules.catalogue import About
from lifecycle.verify.verdict import Finding, FindingKey

_ORDER = tuple(Consequence)


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
    return max(found, key=lambda one: _ORDER.index(one.what), default=None)


def settle_consequences(run: Run) -> list[Event]:
    """Do about violations that last what the manifest asks for, as a person would order it."""
    verdict = run.judged.verdict
    busy = run.order or run.asked or run.switch or run.change or run.opening or run.failures
    if run.held_s is None or run.ending is not None or run.paused or verdict is None:
        run.judged.asked = {}
        return []
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
    run.judged.asked = {key: run.judged.asked.get(key, run.now_s) for key in asked}
    since_s = run.judged.asked
    lasting = [
        due for key, due in asked.items() if gate.lasts_until(run, since_s[key] + gate.SETTLED_S)
    ]
    if not lasting:
        return []
    worst = max(lasting, key=lambda due: _ORDER.index(due[0]))
    keys = {key for each in lasting if each[0] is worst[0] for key in each[2]}
    if worst[0] is Consequence.MODE:
        run.judged.tried |= {key for key, due in asked.items() if due[3] == worst[3]}
    run.judged.counted = run.judged.counted or not_ok(verdict)
    run.judged.asked = {}
    return _take(run, worst[0], worst[1], tuple(key for key in run.nodes if key in keys), worst[3])


def _take(
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
        return [said, *stop(run, reason, ExitCode.VIOLATED)]
    if what is Consequence.MODE:
        return [said, *enter_mode(run, mode)]
    if what is Consequence.PAUSE:
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
        keys = tuple(each.key for each in gated if each.level is Level.ACTIVE)
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
