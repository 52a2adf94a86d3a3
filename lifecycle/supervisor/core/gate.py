"""The gate: open while the verdict is of this very mark and allows it.

Owns: `is_open`, for how long a verdict that closes the gate is waited out, which violations last
and count, and for how long. A mark counts what may change a verdict, so a verdict of an earlier one
opens nothing: whatever changed is looked at first. Pure.
"""

from __future__ import annotations

from collections.abc import Collection

from msgspec.structs import replace

from lifecycle.errors import ExitCode
from lifecycle.supervisor.core.messages import Verified
from lifecycle.supervisor.core.state import NEVER_S, Judged, Level, Node, Run
from lifecycle.supervisor.run.options import Until
from lifecycle.verify.judge import apart_from_numbers, not_ok, with_findings, with_only
from lifecycle.verify.outcome import Outcome
from lifecycle.verify.rules import rule
from lifecycle.verify.rules.catalogue import Heals
from lifecycle.verify.rules.endpoints import UNATTRIBUTED_ENDPOINT
from lifecycle.verify.rules.measured import PROBATION_S
from lifecycle.verify.rules.nodes import UNDECLARED_NODE
from lifecycle.verify.rules.state import ACTIVATED_AT_CLOSED_GATE, MISSING_REPORT
from lifecycle.verify.verdict import Finding, FindingKey, Verdict

SETTLED_S = 0.5
"""A finding that time does not heal counts once it is unchanged for so long."""

UNVERIFIABLE_S = 3.5
"""What cannot be verified may be unseen yet; Fast DDS announces a late participant every 3 s."""

AGAIN_S = 5.0
"""For what changed behind an open gate to be judged clear, where nobody is kept waiting."""

LEAST_S = 2.0
"""For what comes behind an open gate, however late it opened."""

LASTS_S = 1.0
"""A violation that lasts for longer is in the exit code."""

SAY_S = 2.0
"""A gate that stays closed for so long says what it waits for, and until when."""

BY_ITSELF = "was activated by its own code or another client while the gate is closed"

ACTIVATES_ITSELF = (
    "leave its activation to the supervisor: remove trigger_activate or change_state from its "
    "code, and end the client that asks for it"
)

GUARD_TRIES = 5
"""A node that others activate again and again is not deactivated for ever."""

_MOST = 1000
"""A graph that churns for days has ever new findings: so many are remembered."""

_NAMED = 3


def closes(verdict: Verdict, *, strict: bool) -> bool:
    """Return whether a verdict keeps the gate closed; `strict` refuses what is unverifiable."""
    if verdict.verdict is Outcome.VIOLATED or verdict.blocking:
        return True
    return strict and verdict.verdict is Outcome.UNVERIFIABLE


def allows(run: Run) -> bool:
    """Return whether the latest verdict allows to activate, whatever changed since."""
    verdict = run.judged.verdict
    return verdict is not None and not closes(verdict, strict=run.options.strict)


def is_open(run: Run) -> bool:
    """Return whether an activate request may be sent now."""
    return is_latest(run) and not run.judged.waits and allows(run)


def exit_code(verdict: Verdict) -> ExitCode:
    """Return the exit code of a run or an order that this verdict ends."""
    violated = verdict.verdict is Outcome.VIOLATED
    return ExitCode.VIOLATED if violated else ExitCode.UNVERIFIABLE


def refusal(verdict: Verdict, *, again: bool = False) -> str:
    """Return why the gate stays closed, or closed again, in whole sentences."""
    named = "\n".join(f"  {each.rule}: {each.message}" for each in verdict.findings)
    what = "the verdict is"
    if again:
        what = "the system changed before every node was activated, and its verdict now is"
    return f"cannot activate: {what} {verdict.verdict.value}\n{named}"


def patience_s(verdict: Verdict) -> float:
    """Return for how long the findings of a verdict may stay unchanged; for ever if time heals."""
    violated = [rule(each.rule) for each in verdict.findings if each.outcome is Outcome.VIOLATED]
    if any(each.heals is not Heals.WITH_TIME for each in violated):
        return SETTLED_S
    if all(each.awaits is MISSING_REPORT for each in violated):
        stays = any(rule(each.rule).heals is Heals.NEVER for each in verdict.findings)
        return SETTLED_S if stays and not violated else UNVERIFIABLE_S
    return NEVER_S


def is_latest(run: Run) -> bool:
    """Return whether nothing has changed since the verdict."""
    return run.judged.mark == run.mark


def lasts_until(run: Run, at_s: float) -> bool:
    """Return whether what was found was so until then: what changed since may have mended it."""
    return run.judged.seen_s >= at_s or (is_latest(run) and run.is_past(at_s))


def refuses_at_s(run: Run, until_s: float) -> float:
    """Return when the gate has stayed closed for long enough; NEVER_S while it may open.

    `until_s`: when the time of who waits for the gate is over.
    """
    judged = run.judged
    if judged.verdict is None or allows(run):
        return NEVER_S
    if judged.waits:
        return until_s  # what speaks against it is being mended
    if any(each.guarded > GUARD_TRIES for each in run.nodes.values()):
        return run.now_s
    if run.is_backing_off:
        return until_s  # what comes again may mend it
    over_s = judged.since_s + patience_s(judged.verdict)
    lasts = is_latest(run) or judged.seen_s >= over_s
    return min(until_s, over_s) if lasts else until_s


def take_verdict(run: Run, given: Verified) -> Verdict | None:
    """Take the verdict of a look; return it if it is another than the one before."""
    judged = run.judged
    guarded = tuple(_guarded(each) for each in run.nodes.values() if is_foreign_activation(each))
    verdict = with_findings(given.verdict, guarded, run.plan.policy)
    at_gate = run.asked is not None and run.asked.at_gate
    if run.held_s is not None and (run.asked or run.change) and not at_gate:
        verdict = without(run, verdict, run.away)  # they are away because it was ordered
    judged.looking = False
    judged.mark, judged.waits = given.mark, given.waits
    judged.away = given.away
    judged.seen_s = run.now_s
    judged.again_s = run.now_s + given.again_s
    found = frozenset((each.rule, each.subject) for each in verdict.findings)
    if found != judged.found or judged.verdict is None:
        judged.found, judged.since_s = found, run.now_s
    before, judged.verdict = judged.verdict, verdict
    is_same = before is not None and apart_from_numbers(verdict) == apart_from_numbers(before)
    return None if is_same else verdict


def is_foreign_activation(node: Node) -> bool:
    """Return whether a node is active that the gate has not let through."""
    found = node.level is Level.ACTIVE and node.base < Level.ACTIVE
    return found and node.guarded > 0 and not node.let_through


def _guarded(node: Node) -> Finding:
    given_up = node.guarded > GUARD_TRIES
    what = "it is being deactivated"
    if given_up:
        what = f"it was deactivated {GUARD_TRIES} times; {ACTIVATES_ITSELF}"
    return ACTIVATED_AT_CLOSED_GATE.on(
        node.planned,
        outcome=Outcome.VIOLATED,
        expected="inactive",
        observed="activated by its own code or another client",
        message=f"cannot accept node {node.name}: it {BY_ITSELF}; {what}",
    )


# Violations


def without(run: Run, verdict: Verdict, names: Collection[str]) -> Verdict:
    """Return a verdict without what is found of these nodes, by their full names."""
    findings = tuple(
        each
        for each in verdict.findings
        if not any(name in names for name in (*each.nodes, each.subject))
    )
    return with_only(verdict, findings, run.plan.policy) if names else verdict


def of_those_there(run: Run, verdict: Verdict) -> Verdict:
    """Return a verdict without endpoints that may be of who comes up: its name is known last."""
    known = tuple(each for each in verdict.findings if each.rule != UNATTRIBUTED_ENDPOINT.id)
    if known == verdict.findings:
        return verdict
    comes = any(
        process.is_alive and any(each.level < each.gate for each in run.nodes_of(process.name))
        for process in run.processes.values()
    )
    return with_only(verdict, known, run.plan.policy) if comes else verdict


def see_violations(run: Run) -> None:
    """Note what is violated of the nodes that are to be as planned, and what of it counts."""
    judged = run.judged
    if judged.verdict is None:
        return
    if not run.is_watched:
        judged.violated = {}
        return
    is_ordered = run.asked is not None or run.change is not None
    names = run.away | run.left | judged.away
    verdict = of_those_there(run, without(run, judged.verdict, names))
    found = {each.key: each for each in verdict.findings if each.outcome is Outcome.VIOLATED}
    if is_ordered:  # what an order brings about is judged at its gate; a stranger it does not bring
        found = {key: each for key, each in found.items() if _is_strangers(run, each)}
    judged.violated = {key: judged.violated.get(key, run.now_s) for key in found}
    lasting = [key for key, at_s in judged.violated.items() if lasts_until(run, at_s + LASTS_S)]
    if lasting:
        findings = tuple(found[key] for key in lasting)
        judged.counted = judged.counted or not_ok(replace(verdict, findings=findings))
    for key in found:
        passes = key[0] != UNATTRIBUTED_ENDPOINT.id  # endpoints are known before whose they are
        if key in lasting or (passes and len(judged.passed) < _MOST):
            name = _named(key)
            judged.passed[name] = judged.passed.get(name, False) or key in lasting


def _is_strangers(run: Run, finding: Finding) -> bool:
    """Return whether it is of a node that no manifest has, neither that in force nor another."""
    change = run.change
    plans = (run.plan, *(() if change is None else (change.before, change.plan)))
    known = {each.full_name for plan in plans for each in plan.nodes}
    return finding.rule == UNDECLARED_NODE.id and known.isdisjoint(finding.nodes)


def has_probation(run: Run) -> bool:
    """Return whether the manifest declares numbers of data that are to flow."""
    return run.options.until is Until.ACTIVE and bool(run.plan.bounds)


def is_unsettled(run: Run) -> bool:
    """Return whether data cannot be measured now: it is paused, or some of it is on its way."""
    away = any(each.away_s is not None for each in run.processes.values())
    return bool(away or run.paused or run.passage or run.order or run.switch)


def is_measuring(run: Run) -> bool:
    """Return whether a declared number of a system that is held is decided before long.

    That is its probation: PROBATION_S from when it was brought up or resumed, at most. Nothing is
    decided while it is not settled.
    """
    if run.held_s is None or run.decided_s is not None or not has_probation(run):
        return False
    until_s = run.measures_s + PROBATION_S
    if run.is_past(until_s):
        return False
    if is_unsettled(run):
        return True
    verdict, judged = run.judged.verdict, run.judged
    left_s = until_s - run.now_s
    return verdict is None or judged.mark < run.probation or verdict.is_measuring(left_s)


def passed(judged: Judged) -> str:
    """Say what was violated and did not count; empty if nothing was."""
    found = [text for text, lasted in judged.passed.items() if not lasted]
    if not found:
        return ""
    more = f" and {len(found) - _NAMED} more" if len(found) > _NAMED else ""
    named = f"{', '.join(found[:_NAMED])}{more}"
    return f"violated for no longer than {LASTS_S:g} s, and not counted: {named}"


def _named(key: FindingKey) -> str:
    return f"{key[1]} ({key[0]})"
