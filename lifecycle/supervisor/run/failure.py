"""A failed step of bring-up as a finding; how a run ended; tasks that end when they are to.

Owns: `StepFailedError`, how failures join a verdict, so that every run ends in one verdict that
names each cause once; `ended`, `within`; and `Worker`, a thread for what blocks.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Collection, Coroutine, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any, TypeVar

from msgspec.structs import replace

from lifecycle.errors import BringUpError, ExitCode
from lifecycle.middleware.process.control import no_room_for_threads
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

    What only follows from a process that ended is not said again: that its nodes are not there, and
    that others lack what they brought along.

    Args:
        verdict: the last one.
        failures: see above.
        gone: full names of the nodes that are not there any more, as their process has ended.
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


_ENDED = (PROCESS_DIED.id, GAVE_UP.id)


def _gone(system: System, failures: Iterable[Failure]) -> frozenset[str]:
    """Return the names of the nodes that are not there any more, as their process has ended."""
    processes = {each.process for each in failures if each.rule in _ENDED and each.process}
    return frozenset(node.name for name in processes for node in system.carried_by(name))


T = TypeVar("T")

_AGAIN_S = 5.0
"""Far longer than any task takes to notice that it was cancelled, also on a loaded machine."""

_TIMES = 6
"""A task that does not end then is left behind: nobody may wait for it for ever."""


async def ended(*tasks: asyncio.Future[Any]) -> None:
    """Cancel tasks and wait until each has ended, however it did, also if this is cancelled.

    They are cancelled again, bounded: asyncio.wait_for of Python 3.10 and 3.11 may take a
    cancellation for the end of its wait (python/cpython#86296).
    """
    cancelled: asyncio.CancelledError | None = None
    for _ in range(_TIMES):
        if not (left := [each for each in tasks if not each.done()]):
            break
        for each in left:
            each.cancel()
        try:
            await asyncio.wait(left, timeout=_AGAIN_S)
        except asyncio.CancelledError as error:
            cancelled = error
    await asyncio.gather(*(each for each in tasks if each.done()), return_exceptions=True)
    if cancelled is not None:
        raise cancelled


async def within(seconds: float, work: Coroutine[Any, Any, T]) -> T:
    """Carry something out in a task of its own, for so long; nothing of it runs on afterwards.

    asyncio.wait_for gives up what it waits for if it is cancelled a second time.

    Raises:
        asyncio.TimeoutError: it took longer.
    """
    task = asyncio.ensure_future(work)
    try:
        done, _ = await asyncio.wait((task,), timeout=seconds)
    finally:
        await ended(task)
    if not task.done() or (not done and task.cancelled()):
        raise asyncio.TimeoutError
    return task.result()


class Worker:
    """A thread for what blocks, one thing after the other.

    It is started at once: a system that has reached its limit of processes and threads must still
    be taken down (asyncio's own executor starts a thread when it is used, and one to end).

    Raises:
        MiddlewareError: no thread can be started.
    """

    def __init__(self, name: str) -> None:
        self._executor = ThreadPoolExecutor(1, thread_name_prefix=name)
        try:
            self._executor.submit(int)
        except RuntimeError as error:
            raise no_room_for_threads(1) from error

    async def run(self, work: Callable[..., T], *arguments: object) -> T:
        """Do `work` in the thread, and return what it returns."""
        loop = asyncio.get_running_loop()
        return await loop.run_in_executor(self._executor, work, *arguments)

    def close(self) -> None:
        """Finish what is under way, and end the thread."""
        self._executor.shutdown()
