"""Programs networks for a run once its flows are verified, and leaves nothing behind.

Owns: when programming happens in a run: for the latest flows only, again after a failure with
growing pauses, in time before something expires, and one last time to remove everything. Without
`--program` nothing is made; what a person applied goes with the system. The package that programs
takes long to import and most runs do not need it, so it loads on first use. Must not import rclpy.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lifecycle.errors import BringUpError, LifecycleError
from lifecycle.graph.loop import ended, set_within
from lifecycle.plan.model import Plan
from lifecycle.run_directory import LEDGER_NAME, RunDirectory
from lifecycle.supervisor.run.events import Emitter, Event, Notice, VerdictChanged
from lifecycle.supervisor.run.options import UpOptions
from lifecycle.verify.verdict import FlowReport, Verdict

if TYPE_CHECKING:
    from lifecycle.programming.programmer import Programmer

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
    """Networks of one run: the latest flows are programmed; none without `programmer`."""

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
        if programmer is not None:
            emit.listen(self._hear)

    async def begin(self, verdict: Verdict, timeout_s: float | None = None) -> None:
        """Program what was verified, before the first message of what is to be activated leaves.

        Called for every gate that opens, a restart's and a resume's too. From now on every verdict
        is followed. Cancelled, it is over as soon as what is under way has been cut off.

        Raises:
            BringUpError: a network could not be programmed, or not in time (None bounds each
                request only); what was made all the same is removed by `close`.
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
        try:
            await self._stop()
        finally:
            if (self._directory / LEDGER_NAME).is_file():
                await self._remove(hurry)

    async def _remove(self, hurry: asyncio.Event) -> None:
        """Remove everything, within CLOSE_S for all servers together."""
        from lifecycle.programming.programmer import remove_programmed

        within_s = _HURRIED_S if hurry.is_set() else CLOSE_S
        removing = asyncio.ensure_future(remove_programmed(self._directory, within_s=within_s))
        waits: list[asyncio.Future[Any]] = [removing]
        if not hurry.is_set():
            waits.append(asyncio.ensure_future(hurry.wait()))
        try:
            await asyncio.wait(waits, return_when=asyncio.FIRST_COMPLETED)
            if not removing.done():
                self._report(f"ended before everything was removed; {_STILL_THERE}")
                return
            for each in removing.result():
                if each.changes:
                    self._report(each.render(done=True))
        except LifecycleError as error:
            self._report(f"{error}\n{_STILL_THERE}")
        finally:
            await ended(*waits)

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
        """Program the latest flows and say what was done; return when it must be done again."""
        until_s = None if within_s is None else time.monotonic() + within_s
        for each in await programmer.update(self._flows, hold=True, within_s=within_s):
            if each.pending or not self._left_out.issuperset(each.left_out):
                self._left_out.update(each.left_out)
                self._report(each.render(done=True))
        left_s = None if until_s is None else until_s - time.monotonic()
        return await programmer.renew(within_s=left_s)


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
    if options.program is None:
        return Networks(plan.system, path, emit)
    from lifecycle.programming.programmer import open_programmer, sweep_orphans

    programmer = open_programmer(
        plan,
        options.program,
        environment=environment,
        machine=options.machine,
        owned=True,
    )

    def report(text: str) -> None:
        emit(Notice(message=text))

    asyncio.run(sweep_orphans(path.parent, report, own=path.name, within_s=_SWEEP_S))
    return Networks(plan.system, path, emit, programmer)


def remove_programmed(directory: Path, within_s: float) -> None:
    """Remove everything that a run has in networks, also what a person applied, bounded.

    Raises:
        ProgrammingError: something could not be removed; it stays listed.
    """
    if (directory / LEDGER_NAME).is_file():
        from lifecycle.programming import programmer

        asyncio.run(programmer.remove_programmed(directory, within_s=within_s))
