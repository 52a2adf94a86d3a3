"""A step of bring-up that failed, and the finding it becomes.

Owns: `StepFailedError`, the ids of the `run.*` rules and how a failure joins a verdict, so that
every run ends in one verdict that names what went wrong. Pure.
"""

from __future__ import annotations

import dataclasses

from lifecycle.errors import BringUpError, ExitCode
from lifecycle.supervisor.events import Failure
from lifecycle.supervisor.options import UpResult
from lifecycle.verify.rules import rule, run
from lifecycle.verify.verdict import Finding, Outcome, RunEnd, Verdict

PROCESS_DIED = run.PROCESS_DIED.id
START_FAILED = run.START_FAILED.id
TRANSITION_FAILED = run.TRANSITION_FAILED.id
DEADLINE = run.DEADLINE.id
NOT_PROGRAMMED = run.NOT_PROGRAMMED.id
NOT_WIRED = run.NOT_WIRED.id


class StepFailedError(BringUpError):
    """A step of bring-up failed.

    Attributes:
        rule: one of the ids above.
        subject: fully qualified node name, or the process where no node is to blame.
        log_tail: last lines of the process concerned, oldest first.
    """

    def __init__(
        self, message: str, *, rule: str, subject: str, log_tail: tuple[str, ...] = ()
    ) -> None:
        super().__init__(message)
        self.rule = rule
        self.subject = subject
        self.log_tail = log_tail

    @property
    def reason(self) -> str:
        """What failed, in words that stand alone: with the subject, if the message has it not."""
        named = self.subject in self.message
        return self.message if named else f"{self.subject}: {self.message}"

    def event(self) -> Failure:
        """Return the failure as listeners hear of it."""
        return Failure(
            rule=self.rule, subject=self.subject, message=self.message, log_tail=self.log_tail
        )


NOT_JUDGED = Verdict(verdict=Outcome.UNVERIFIABLE, blocking=True, findings=(), flows=())
"""The verdict of a system that never came as far as being judged."""


def finding_of(failure: StepFailedError) -> Finding:
    """Return the finding that a failure is."""
    return rule(failure.rule).finding(
        Outcome.VIOLATED,
        subject=failure.subject,
        expected="",
        observed="",
        message=failure.message,
        node=failure.subject if failure.subject.startswith("/") else "",
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
    """Return `verdict`, violated, with the failure as its first finding."""
    return dataclasses.replace(
        verdict,
        verdict=Outcome.VIOLATED,
        blocking=True,
        findings=(finding_of(failure), *verdict.findings),
    )
