"""What a run does to networks: programs them once flows are verified, and leaves nothing behind.

Owns: when programming happens in a run. Without `--program` nothing is made; what somebody applied
by hand goes with the system. The package that programs takes long to import and most runs do not
need it, so it loads on first use. Must not import rclpy.
"""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from lifecycle.errors import LifecycleError
from lifecycle.plan.model import Plan
from lifecycle.supervisor.events import Emitter, Event, Notice, VerdictChanged
from lifecycle.supervisor.failure import NOT_PROGRAMMED, StepFailedError
from lifecycle.supervisor.options import UpOptions
from lifecycle.supervisor.rundir import LEDGER_NAME, RunDirectory
from lifecycle.verify.verdict import Verdict

if TYPE_CHECKING:
    from lifecycle.supervisor.programming.keeper import Keeper, Programs


class Networks:
    """Networks of one run.

    Args:
        system: its name, which failures are about.
        directory: of the run.
        emit: where notices go, and where verdicts are heard.
        programmer: None programs nothing.
    """

    def __init__(
        self, system: str, directory: Path, emit: Emitter, programmer: Programs | None = None
    ) -> None:
        self._system = system
        self._directory = directory
        self._emit = emit
        self._keeper: Keeper | None = None
        self._begun = False
        if programmer is not None:
            from lifecycle.supervisor.programming.keeper import Keeper

            self._keeper = Keeper(programmer, self._tell)
            emit.listen(self._hear)

    async def begin(self, verdict: Verdict) -> None:
        """Program what was verified, before the first message of an active system leaves.

        From now on every verdict is followed.

        Raises:
            StepFailedError: a network could not be programmed.
        """
        if self._keeper is None:
            return
        try:
            await self._keeper.begin(verdict.flows)
        except LifecycleError as error:
            raise StepFailedError(
                f"cannot program networks for {self._system!r}: {error}",
                rule=NOT_PROGRAMMED,
                subject=self._system,
            ) from error
        self._begun = True

    async def close(self) -> None:
        """Remove everything of the system from networks; failures are told."""
        self._begun = False
        if self._keeper is not None:
            await self._keeper.close()
        elif (self._directory / LEDGER_NAME).is_file():
            try:
                for text in await asyncio.to_thread(remove_programmed, self._directory):
                    self._tell(text)
            except LifecycleError as error:
                self._tell(str(error))

    def _hear(self, event: Event) -> None:
        if self._begun and self._keeper is not None and isinstance(event, VerdictChanged):
            self._keeper.take(event.verdict.flows)

    def _tell(self, text: str) -> None:
        self._emit(Notice(message=text))


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
    """
    path = directory.path
    if not options.program:
        return Networks(plan.system, path, emit)
    from lifecycle.supervisor.programming import open_programmer, sweep_orphans

    programmer = open_programmer(
        plan,
        options.program,
        environment=environment,
        machine=options.machine,
        owned=True,
        treatment=options.treatment,
    )
    swept = sweep_orphans(path.parent, own=path.name)
    for each in swept.removed:
        if each.changes:
            emit(Notice(message=f"left by a killed supervisor: {each.render(done=True)}"))
    for error in swept.errors:
        emit(Notice(message=str(error)))
    return Networks(plan.system, path, emit, programmer)


def remove_programmed(directory: Path) -> tuple[str, ...]:
    """Remove everything that a run has in networks, whoever applied it; say what was done.

    Raises:
        ProgrammingError: something could not be removed; it stays listed.
    """
    if not (directory / LEDGER_NAME).is_file():
        return ()
    from lifecycle.supervisor.programming import remove_run

    return tuple(each.render(done=True) for each in remove_run(directory) if each.changes)
