"""Programs networks for a run once its flows are verified, and leaves nothing behind.

Owns: when programming happens in a run, and when the blocking `Programmer` is called: for the
latest flows only, again after a failure with growing pauses, in time before something expires, and
one last time to remove everything; the loop is never held up. Without `--program` nothing is made;
what a person applied goes with the system. The package that programs takes long to import
and most runs do not need it, so it loads on first use. Must not import rclpy.
"""

from __future__ import annotations

import asyncio
import functools
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lifecycle.errors import BringUpError, LifecycleError
from lifecycle.graph.loop import ended, set_within
from lifecycle.middleware.process.control import no_room_for_threads
from lifecycle.plan.model import Plan
from lifecycle.run_directory import LEDGER_NAME, RunDirectory
from lifecycle.supervisor.run.events import Emitter, Event, Notice, VerdictChanged
from lifecycle.supervisor.run.options import UpOptions
from lifecycle.verify.verdict import FlowReport, Verdict

if TYPE_CHECKING:
    from lifecycle.programming.programmer import Programmer, Removal

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


class Networks:
    """Networks of one run: the latest flows are programmed, in a thread; none without `programmer`.

    Raises:
        MiddlewareError: no thread can be started.
    """

    def __init__(
        self, system: str, directory: Path, emit: Emitter, programmer: Programmer | None = None
    ) -> None:
        self._system = system
        self._directory = directory
        self._emit = emit
        self._programmer = programmer
        self._flows: tuple[FlowReport, ...] = ()
        self._left_out: set[str] = set()  # what is left out, and why
        self._begun = False
        self._changed = asyncio.Event()
        self._following: asyncio.Task[None] | None = None
        self._one_at_a_time = asyncio.Lock()  # the programmer is of one thread
        # A thread that is started at once: in the end there may be no room for one.
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="networks")
        try:
            self._thread.submit(int)
        except RuntimeError as error:
            raise no_room_for_threads(1) from error
        if programmer is not None:
            emit.listen(self._hear)

    async def begin(self, verdict: Verdict, timeout_s: float | None = None) -> None:
        """Program what was verified, before the first message of what is to be activated leaves.

        Called for every gate that opens, a restart's and a resume's too. From now on every verdict
        is followed. Cancelled, it is over as soon as what is under way has been cut off.

        Raises:
            BringUpError: a network could not be programmed, or not in time (None: the patience with
                each request); what was made all the same is removed by `close`.
        """
        if self._programmer is None:
            return
        await self._stop()  # what follows verdicts may wait for servers far longer than this may
        self._flows = verdict.flows
        try:
            await self._program(self._programmer, timeout_s)
        except LifecycleError as error:
            raise BringUpError(f"cannot program networks for {self._system!r}: {error}") from error
        self._begun = True
        self._take(verdict)  # from now on renewed in time

    def replan(self, plan: Plan) -> None:
        """Take the plan that runs from now on; its flows are programmed once they are verified."""
        if self._programmer is not None:
            self._programmer.replan(plan)

    async def close(self, hurry: asyncio.Event) -> None:
        """Remove everything of the system from networks, bounded; failures become notices.

        Once `hurry` is set, no server is waited for any more.
        """
        self._begun = False
        removes: Removal | None = self._programmer
        try:
            await self._stop()
        finally:
            if removes is None and (self._directory / LEDGER_NAME).is_file():
                from lifecycle.programming.programmer import removal_of

                removes = removal_of(self._directory)
            if removes is not None:
                await self._remove(removes, hurry)

    async def _remove(self, removes: Removal, hurry: asyncio.Event) -> None:
        """Remove everything, in the thread and within CLOSE_S for all servers together."""
        is_late = hurry.is_set()
        within_s = _HURRIED_S if is_late else CLOSE_S
        loop = asyncio.get_running_loop()
        remove = functools.partial(removes.close, within_s=within_s)
        removing = loop.run_in_executor(self._thread, remove)
        if not is_late:
            hurried = asyncio.ensure_future(hurry.wait())
            either: set[asyncio.Future[Any]] = {removing, hurried}
            await asyncio.wait(either, return_when=asyncio.FIRST_COMPLETED)
            await ended(hurried)
            if not removing.done():
                removes.cancel()
        try:
            done = await removing
        except LifecycleError as error:
            self._report(f"{error}\n{_STILL_THERE}")
            return
        for each in done:
            if each.changes:
                self._report(each.render(done=True))

    def _hear(self, event: Event) -> None:
        if self._begun and isinstance(event, VerdictChanged):
            self._take(event.verdict)

    def _take(self, verdict: Verdict) -> None:
        """Take the flows as just verified; those that came before and were not done are skipped."""
        assert self._programmer is not None
        self._flows = verdict.flows
        self._changed.set()
        if self._following is None:
            self._following = asyncio.ensure_future(self._follow(self._programmer))

    def _report(self, text: str) -> None:
        self._emit(Notice(message=text))

    async def _stop(self) -> None:
        """Follow no verdict until the next."""
        following, self._following = self._following, None
        if following is not None:
            await ended(following)

    async def _follow(self, programmer: Programmer) -> None:
        pause_s: float | None = None
        again_s = _AGAIN_S[0]
        while True:
            await set_within(self._changed, pause_s)
            self._changed.clear()
            try:
                due_s = await self._program(programmer)
            except LifecycleError as error:
                self._report(str(error))
                pause_s = again_s = min(again_s * 2, _AGAIN_S[1])
            else:
                again_s = _AGAIN_S[0]
                pause_s = None if due_s is None else max(due_s, _SOON_S)

    async def _program(self, programmer: Programmer, within_s: float | None = None) -> float | None:
        """Program the latest flows and say what was done; return when it must be done again.

        Cancelled, what is under way in the thread is cut off and waited for.
        """
        loop = asyncio.get_running_loop()

        def say(text: str) -> None:
            # At once: a task that is cancelled meanwhile has changed the networks all the same.
            loop.call_soon_threadsafe(self._report, text)

        async with self._one_at_a_time:
            task = loop.run_in_executor(
                self._thread, _once, programmer, self._flows, within_s, say, self._left_out
            )
            try:
                return await asyncio.shield(task)
            except asyncio.CancelledError:
                programmer.cancel()
                await asyncio.gather(task, return_exceptions=True)
                programmer.resume()
                raise


def _once(
    programmer: Programmer,
    flows: Sequence[FlowReport],
    within_s: float | None,
    say: Callable[[str], None],
    reported: set[str],
) -> float | None:
    """Program flows, in a thread; return the seconds until something expires.

    What was done is reported, and what is left out unless it is among `reported`.
    """
    until_s = None if within_s is None else time.monotonic() + within_s
    for each in programmer.update(flows, hold=True, within_s=within_s):
        if each.pending or not reported.issuperset(each.left_out):
            reported.update(each.left_out)
            say(each.render(done=True))
    return programmer.renew(within_s=None if until_s is None else until_s - time.monotonic())


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
    from lifecycle.programming.programmer import open_programmer, sweep_orphans

    programmer = open_programmer(
        plan,
        options.program,
        environment=environment,
        machine=options.machine,
        owned=True,
        treatment=options.treatment,
    )

    def report(text: str) -> None:
        emit(Notice(message=text))

    sweep_orphans(path.parent, report, own=path.name, within_s=_SWEEP_S)
    return Networks(plan.system, path, emit, programmer)


def remove_programmed(directory: Path, within_s: float) -> None:
    """Remove everything that a run has in networks, also what a person applied, bounded.

    Raises:
        ProgrammingError: something could not be removed; it stays listed.
    """
    if (directory / LEDGER_NAME).is_file():
        from lifecycle.programming.programmer import removal_of

        removal_of(directory).close(within_s=within_s)
