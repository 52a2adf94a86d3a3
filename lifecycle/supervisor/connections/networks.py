"""Programs networks for a run once its flows are verified, and leaves nothing behind.

Owns: when programming happens in a run, and when the blocking `Programmer` is called: for the
latest flows only, again after a failure with growing pauses, in time before something expires, and
one last time to remove everything; the loop is never held up. Without `--program` nothing is made;
what a person applied goes with the system. The package that programs takes long to import
and most runs do not need it, so it loads on first use. Must not import rclpy.
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
import time
from collections.abc import Callable, Coroutine, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from lifecycle.errors import LifecycleError
from lifecycle.graph import set_within
from lifecycle.plan import Plan
from lifecycle.run_directory import LEDGER_NAME, RunDirectory
from lifecycle.supervisor.run.events import Emitter, Event, Notice, VerdictChanged
from lifecycle.supervisor.run.failure import StepFailedError, Worker, ended
from lifecycle.supervisor.run.options import UpOptions
from lifecycle.verify import NOT_PROGRAMMED, FlowReport, Verdict

if TYPE_CHECKING:
    from lifecycle.programming import Programmer, Removal, TargetOptions

_T = TypeVar("_T")

_AGAIN_S = (2.0, 60.0)
"""First and longest pause after a failure."""

_SOON_S = 1.0
"""Nothing is renewed more often than so."""

CLOSE_S = 10.0
"""For servers to delete in the end what was made; as much as one request may take by default."""

_HURRIED_S = 1.0
"""The same for who was asked to hurry before: a server that is well answers in less."""

_STILL_THERE = "what is left is listed, and removed by the next 'lifecycle down' or 'flows remove'"

_SWEEP_S = 10.0
"""For servers to remove what dead runs left; what is not removed then stays listed."""


class Keeper:
    """Programs the latest flows, in a thread.

    Args:
        programmer: see Programmer.
        report: takes what was done and what failed, as text for people; called from the loop.
        worker: the thread.
    """

    def __init__(
        self, programmer: Programmer, report: Callable[[str], None], worker: Worker
    ) -> None:
        self._worker = worker
        self._programmer = programmer
        self._report = report
        self._flows: tuple[FlowReport, ...] | None = None
        self._changed = asyncio.Event()
        self._task: asyncio.Task[None] | None = None
        self._one_at_a_time = asyncio.Lock()  # the programmer is of one thread

    async def begin(self, flows: Sequence[FlowReport], within_s: float | None = None) -> None:
        """Program these flows, and be done when this returns; again whenever a gate opens.

        Cancelled, it is over as soon as what is under way has been cut off.

        Args:
            flows: verified.
            within_s: for all that servers are asked.

        Raises:
            LifecycleError: it failed; what was made all the same is removed by `close`.
        """
        await self._stop()  # what follows verdicts may wait for servers far longer than this may
        self._flows = tuple(flows)
        await self._program(within_s)
        self.take(flows)  # from now on renewed in time

    def replan(self, plan: Plan) -> None:
        """Program by this plan from the next time on."""
        self._programmer.replan(plan)

    def take(self, flows: Sequence[FlowReport]) -> None:
        """Take the flows as just verified; flows that came before and were not done are skipped."""
        self._flows = tuple(flows)
        self._changed.set()
        if self._task is None:
            self._task = asyncio.ensure_future(self._run())

    async def close(self, hurry: asyncio.Event | None = None) -> None:
        """Stop, and remove from networks everything that is ours; failures become notices.

        Args:
            hurry: once set, no server is waited for any more.
        """
        try:
            await self._stop()
        finally:
            await remove(self._programmer, self._report, hurry, self._worker)

    async def _stop(self) -> None:
        """Follow no verdicts until `take`."""
        task, self._task = self._task, None
        if task is not None:
            await ended(task)

    async def _run(self) -> None:
        pause_s: float | None = None
        again_s = _AGAIN_S[0]
        while True:
            await set_within(self._changed, pause_s)
            self._changed.clear()
            failed = True
            due_s = None
            with self._telling():
                due_s = await self._program()
                failed = False
            again_s = min(again_s * 2, _AGAIN_S[1]) if failed else _AGAIN_S[0]
            pause_s = again_s if failed else due_s if due_s is None else max(due_s, _SOON_S)

    async def _program(self, within_s: float | None = None) -> float | None:
        """Program the latest flows and say what was done; return when it must be done again."""
        loop = asyncio.get_running_loop()

        def say(text: str) -> None:
            # At once: a task that is cancelled meanwhile has changed the networks all the same.
            loop.call_soon_threadsafe(self._report, text)

        async with self._one_at_a_time:
            return await self._whole(self._worker.run(self._once, within_s, say))

    def _once(self, within_s: float | None, say: Callable[[str], None]) -> float | None:
        assert self._flows is not None
        until_s = None if within_s is None else time.monotonic() + within_s
        done = self._programmer.update(self._flows, hold=True, within_s=within_s)
        for each in done:
            if each.pending:
                say(each.render(done=True))
        left_s = None if until_s is None else until_s - time.monotonic()
        return self._programmer.renew(within_s=left_s)

    async def _whole(self, work: Coroutine[Any, Any, _T]) -> _T:
        """Wait for work in a thread to its end; cancelled, have it end at once."""
        task = asyncio.ensure_future(work)
        try:
            return await asyncio.shield(task)
        except asyncio.CancelledError:
            self._programmer.cancel()
            await asyncio.gather(task, return_exceptions=True)
            self._programmer.resume()
            raise

    @contextlib.contextmanager
    def _telling(self) -> Iterator[None]:
        try:
            yield
        except LifecycleError as error:
            self._report(str(error))


async def remove(
    removes: Programmer | Removal,
    report: Callable[[str], None],
    hurry: asyncio.Event | None,
    worker: Worker,
) -> None:
    """Remove everything of one run, in a thread and within CLOSE_S for all servers together.

    Args:
        removes: see there.
        report: takes what was done or failed, as text for people.
        hurry: once set, no server is waited for any more.
        worker: the thread.
    """
    hurry = hurry or asyncio.Event()
    is_late = hurry.is_set()
    within_s = _HURRIED_S if is_late else CLOSE_S
    removing = asyncio.ensure_future(
        worker.run(functools.partial(removes.close, within_s=within_s))
    )
    if not is_late:
        hurried = asyncio.ensure_future(hurry.wait())
        await asyncio.wait({removing, hurried}, return_when=asyncio.FIRST_COMPLETED)
        await ended(hurried)
        if not removing.done():
            removes.cancel()
    try:
        done = await removing
    except LifecycleError as error:
        report(f"{error}\n{_STILL_THERE}")
        return
    for each in done:
        if each.changes:
            report(each.render(done=True))


class Networks:
    """Networks of one run.

    Args:
        system: its name, which failures are about.
        directory: of the run.
        emit: where notices go, and where verdicts come from.
        programmer: None programs nothing.
    """

    def __init__(
        self, system: str, directory: Path, emit: Emitter, programmer: Programmer | None = None
    ) -> None:
        self._system = system
        self._directory = directory
        self._emit = emit
        self._keeper: Keeper | None = None
        self._begun = False
        # Made here: in the end it may be too late to start a thread.
        self._worker = Worker("networks")
        if programmer is not None:
            self._keeper = Keeper(programmer, self._report, self._worker)
            emit.listen(self._hear)

    async def begin(self, verdict: Verdict, timeout_s: float | None = None) -> None:
        """Program what was verified, before the first message of what is to be activated leaves.

        Called for every gate that opens, a restart's and a resume's too. From now on every verdict
        is followed.

        Args:
            verdict: has the flows.
            timeout_s: what is left for it; None for the patience with each request.

        Raises:
            StepFailedError: a network could not be programmed, or not in time.
        """
        if self._keeper is None:
            return
        try:
            await self._keeper.begin(verdict.flows, timeout_s)
        except LifecycleError as error:
            raise StepFailedError(
                f"cannot program networks for {self._system!r}: {error}",
                rule=NOT_PROGRAMMED,
                subject=self._system,
            ) from error
        self._begun = True

    def replan(self, plan: Plan) -> None:
        """Take the plan that runs from now on; its flows are programmed once they are verified."""
        if self._keeper is not None:
            self._keeper.replan(plan)

    async def close(self, hurry: asyncio.Event | None = None) -> None:
        """Remove everything of the system from networks, bounded; failures become notices.

        Args:
            hurry: once set, no server is waited for any more.
        """
        self._begun = False
        if self._keeper is not None:
            await self._keeper.close(hurry)
        elif (self._directory / LEDGER_NAME).is_file():
            from lifecycle.programming import Removal

            await remove(Removal(self._directory), self._report, hurry, self._worker)

    def _hear(self, event: Event) -> None:
        if self._begun and self._keeper is not None and isinstance(event, VerdictChanged):
            self._keeper.take(event.verdict.flows)

    def _report(self, text: str) -> None:
        self._emit(Notice(message=text))


def token_variables(program: Iterable[TargetOptions]) -> frozenset[str]:
    """Return the environment variables that hold tokens, which no node has any use for.

    Args:
        program: what a run programs.

    Raises:
        SettingsError: a settings file cannot be used.
    """
    return frozenset().union(*(each.token_variables() for each in program))


def open_networks(
    plan: Plan,
    options: UpOptions,
    directory: RunDirectory,
    emit: Emitter,
    *,
    environment: Mapping[str, str],
) -> Networks:
    """Return the networks of a run; where it programs any, free them of dead runs first.

    Raises:
        UsageError: the options of a network cannot be used.
        KeyboardInterrupt: while a server was asked to remove what is left of a dead run.
    """
    path = directory.path
    if not options.program:
        return Networks(plan.system, path, emit)
    from lifecycle.programming import open_programmer, sweep_orphans

    programmer = open_programmer(
        plan,
        options.program,
        environment=environment,
        machine=options.machine,
        owned=True,
        treatment=options.treatment,
    )
    swept = sweep_orphans(path.parent, own=path.name, within_s=_SWEEP_S)
    for each in swept.removed:
        if each.changes:
            emit(Notice(message=f"left by a killed supervisor: {each.render(done=True)}"))
    for error in swept.errors:
        emit(Notice(message=str(error)))
    return Networks(plan.system, path, emit, programmer)


def remove_programmed(directory: Path, within_s: float | None = None) -> tuple[str, ...]:
    """Remove everything that a run has in networks, also what a person applied; say what was done.

    Args:
        directory: of the run.
        within_s: for all that servers are asked; None for the patience with each request.

    Raises:
        ProgrammingError: something could not be removed; it stays listed.
    """
    if not (directory / LEDGER_NAME).is_file():
        return ()
    from lifecycle.programming import remove_run

    done = remove_run(directory, within_s=within_s)
    return tuple(each.render(done=True) for each in done if each.changes)
