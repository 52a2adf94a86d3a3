"""A step of bring-up that failed, and the finding it becomes.

Owns: `StepFailedError`, the ids of the `run.*` rules and how failures join a verdict, so that
every run ends in one verdict that names each cause once. Pure.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable

from lifecycle.errors import BringUpError, ExitCode
from lifecycle.supervisor.run.events import Failure
from lifecycle.supervisor.run.options import UpResult
from lifecycle.verify.rules import rule, run
from lifecycle.verify.verdict import NOT_JUDGED, Finding, Outcome, RunEnd, Verdict

PROCESS_DIED = run.PROCESS_DIED.id
START_FAILED = run.START_FAILED.id
TRANSITION_FAILED = run.TRANSITION_FAILED.id
DEADLINE = run.DEADLINE.id
NOT_PROGRAMMED = run.NOT_PROGRAMMED.id
NOT_WIRED = run.NOT_WIRED.id


class StepFailedError(BringUpError):
    """A step of bring-up failed, or a process ended that nobody asked to end.

    Attributes:
        rule: one of the ids above.
        subject: fully qualified node name, or the process where no node is to blame.
        process: name of the process concerned; empty if there is none of ours.
        log: the file with all that its process wrote; empty if there is none.
        others: what else had failed by then for causes of its own, each named once.
    """

    def __init__(
        self, message: str, *, rule: str, subject: str, process: str = "", log: str = ""
    ) -> None:
        super().__init__(message)
        self.rule = rule
        self.subject = subject
        self.process = process
        self.log = log
        self.others: tuple[StepFailedError, ...] = ()

    @property
    def every(self) -> tuple[StepFailedError, ...]:
        """This one and the others."""
        return (self, *self.others)

    @property
    def reason(self) -> str:
        """What failed, in one line that names each cause; the findings say the rest."""
        return f"failed: {', '.join(f'{each.subject} ({each.rule})' for each in self.every)}"

    def joined(self, others: Iterable[StepFailedError]) -> StepFailedError:
        """Return this one with more that failed, but for what it names already."""
        for each in others:
            named = {(one.rule, one.subject) for one in self.every}
            processes = {one.process for one in self.every if one.process}
            # A process that says why it cannot go on, and then ends, has failed once.
            again = each.rule == PROCESS_DIED and each.process in processes
            if (each.rule, each.subject) not in named and not again:
                self.others = (*self.others, each)
        return self

    def event(self, *, ends_run: bool = True) -> Failure:
        """Return the failure as listeners get it."""
        return Failure(
            rule=self.rule,
            subject=self.subject,
            message=self.message,
            process=self.process,
            log=self.log,
            ends_run=ends_run,
        )


def finding_of(failure: StepFailedError) -> Finding:
    """Return the finding that a failure is."""
    kind = rule(failure.rule)
    return kind.finding(
        Outcome.VIOLATED,
        subject=failure.subject,
        expected="",
        observed="",
        message=failure.message,
        node=run.node_of(failure.subject),
        hint=f"{kind.fix}: {failure.log}" if failure.log and kind.names_log else "",
    )


def ended_early(reason: str, exit_code: ExitCode) -> UpResult:
    """Return the result of a run that ended before there was anything to judge."""
    verdict = never_connected(NOT_JUDGED, reason, exit_code)
    return UpResult(exit_code=exit_code, verdict=verdict)


def never_connected(verdict: Verdict, reason: str, exit_code: ExitCode) -> Verdict:
    """Return `verdict` as the last one of a run that ended before its system was connected."""
    run = RunEnd(reason=reason, reached=None, exit_code=exit_code)
    return dataclasses.replace(verdict, run=run)


def with_failure(verdict: Verdict, failure: StepFailedError) -> Verdict:
    """Return `verdict`, violated, with all that failed as its first findings, each once."""
    findings = tuple(finding_of(each) for each in failure.every)
    named = {(each.rule, each.subject) for each in findings}
    rest = (each for each in verdict.findings if (each.rule, each.subject) not in named)
    return dataclasses.replace(
        verdict, verdict=Outcome.VIOLATED, blocking=True, findings=(*findings, *rest)
    )
