"""A failed step of bring-up as a finding, and how a run ended.

Owns: `StepFailedError`, and how failures join a verdict, so that every run ends in one verdict that
names each cause once.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable
from typing import TYPE_CHECKING

from msgspec.structs import replace

from lifecycle.errors import BringUpError, ExitCode
from lifecycle.supervisor.core.failure import exit_code_of
from lifecycle.supervisor.run.events import Failure
from lifecycle.supervisor.run.options import UpResult
from lifecycle.verify.outcome import Outcome
from lifecycle.verify.rules import rule
from lifecycle.verify.rules.catalogue import GAVE_UP, PROCESS_DIED, node_of
from lifecycle.verify.verdict import NOT_JUDGED, Finding, RunEnd, Verdict

if TYPE_CHECKING:
    from lifecycle.supervisor.nodes.system import System


class StepFailedError(BringUpError):
    """A step of bring-up failed that is no request to a node; `failure` is all of it."""

    def __init__(self, failure: Failure) -> None:
        super().__init__(failure.message)
        self.failure = failure


def finding_of(failure: Failure) -> Finding:
    """Return the finding that a failure is."""
    found = rule(failure.rule)
    return found.finding(
        outcome=Outcome.VIOLATED,
        subject=failure.subject,
        expected="",
        observed="",
        message=failure.message,
        node=node_of(failure.subject),
        hint=f"{found.fix}: {failure.log}" if failure.log and found.names_log else "",
    )


def ended_early(reason: str, exit_code: ExitCode, *failures: Failure) -> UpResult:
    """Return the result of a run that ended before there was anything to judge."""
    verdict = with_failures(NOT_JUDGED, failures) if failures else NOT_JUDGED
    run = RunEnd(reason=reason, reached=None, exit_code=exit_code)
    return UpResult(exit_code=exit_code, verdict=replace(verdict, run=run))


def with_failures(
    verdict: Verdict, failures: Iterable[Failure], gone: Collection[str] = ()
) -> Verdict:
    """Return `verdict`, violated, with all that failed as its first findings, each once.

    What only follows from a process that ended is not said again: that its nodes (full names in
    `gone`) are not there, and that others lack what they brought along.
    """
    findings = tuple({(each.rule, each.subject): finding_of(each) for each in failures}.values())
    named = {(each.rule, each.subject) for each in findings}
    rest = (
        each
        for each in verdict.findings
        if (each.rule, each.subject) not in named
        and (rule(each.rule).about is None or set(gone).isdisjoint((each.subject, *each.nodes)))
    )
    return replace(verdict, verdict=Outcome.VIOLATED, blocking=True, findings=(*findings, *rest))


def result_of(system: System, latest: Verdict) -> UpResult:
    """Return the result of a run that is over; `latest` is the verdict by which it began to end."""
    run = system.run
    ending = run.ending
    assert ending is not None
    code, reason = exit_code_of(run), ending.reason
    failures = [*ending.failures, *run.deaths]
    verdict = with_failures(latest, failures, _gone(system, failures)) if failures else latest
    if later := run.deaths[ending.deaths :]:
        died = ", ".join(f"{each.subject} ({each.rule})" for each in later)
        reason = f"{reason}, but failed: {died} while it was taken down"
    if run.hurry and ending.code is ExitCode.OK and code is ExitCode.INTERRUPTED:
        reason = f"{reason}; interrupted while it was taken down"
    end = RunEnd(reason=reason, reached=run.furthest or None, exit_code=code, trusted=run.trusted)
    return UpResult(exit_code=code, verdict=replace(verdict, run=end), plan=run.first)


_ENDED = (PROCESS_DIED.id, GAVE_UP.id)


def _gone(system: System, failures: Iterable[Failure]) -> frozenset[str]:
    """Return the names of the nodes that are not there any more, as their process has ended."""
    processes = {each.process for each in failures if each.rule in _ENDED and each.process}
    return frozenset(node.name for name in processes for node in system.carried_by(name))
