"""How a run ended: its exit code, and its last verdict with all that failed."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

from msgspec.structs import replace

from lifecycle.errors import ExitCode
from lifecycle.supervisor.core.failure import exit_code_of
from lifecycle.supervisor.run.failure import with_failures
from lifecycle.supervisor.run.options import UpResult
from lifecycle.verify.rules.run import GAVE_UP, PROCESS_DIED
from lifecycle.verify.verdict import RunEnd

if TYPE_CHECKING:
    from lifecycle.supervisor.nodes.system import System
    from lifecycle.supervisor.run.events import Failure
    from lifecycle.verify.verdict import Verdict

_ENDED = (PROCESS_DIED.id, GAVE_UP.id)


def result_of(system: System, latest: Verdict) -> UpResult:
    """Return the result of a run that is over.

    Args:
        system: what ran.
        latest: the verdict by which it began to end.
    """
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


def _gone(system: System, failures: Iterable[Failure]) -> frozenset[str]:
    """Return the names of the nodes that are not there any more, as their process has ended."""
    processes = {each.process for each in failures if each.rule in _ENDED and each.process}
    return frozenset(node.name for name in processes for node in system.carried_by(name))
