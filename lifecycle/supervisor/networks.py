"""What a run does to networks: programs them once flows are verified, and leaves nothing behind.

Owns: when programming happens in a run. Without `--program` nothing is made; what somebody applied
by hand goes with the system. The package that programs takes long to import and most runs do not
need it, so it loads on first use. Must not import rclpy.
"""

from __future__ import annotations

import asyncio
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from lifecycle.errors import LifecycleError
from lifecycle.plan.model import Plan
from lifecycle.supervisor.events import Emitter, Event, Notice, VerdictChanged
from lifecycle.supervisor.failure import NOT_PROGRAMMED, StepFailedError
from lifecycle.supervisor.options import UpOptions
from lifecycle.supervisor.rundir import LEDGER_NAME, RunDirectory
from lifecycle.supervisor.together import Worker
from lifecycle.verify.verdict import Verdict

if TYPE_CHECKING:
    from lifecycle.supervisor.programming import TargetOptions
    from lifecycle.supervisor.programming.keeper import Keeper, Programs


_SWEEP_S = 10.0
"""For servers to remove what dead runs left; what is not removed then stays listed."""


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
        # Made here: in the end it may be too late to start a thread.
        self._worker = Worker("networks")
        if programmer is not None:
            from lifecycle.supervisor.programming.keeper import Keeper

            self._keeper = Keeper(programmer, self._tell, self._worker)
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

    async def close(self, hurry: asyncio.Event | None = None) -> None:
        """Remove everything of the system from networks, bounded; failures become notices.

        Args:
            hurry: once set, no server is waited for any more.
        """
        self._begun = False
        if self._keeper is not None:
            await self._keeper.close(hurry)
        elif (self._directory / LEDGER_NAME).is_file():
            from lifecycle.supervisor.programming.keeper import remove
            from lifecycle.supervisor.programming.orphans import Removal

            await remove(Removal(self._directory), self._tell, hurry, self._worker)

    def _hear(self, event: Event) -> None:
        if self._begun and self._keeper is not None and isinstance(event, VerdictChanged):
            self._keeper.take(event.verdict.flows)

    def _tell(self, text: str) -> None:
        self._emit(Notice(message=text))


def token_variables(program: Iterable[TargetOptions]) -> frozenset[str]:
    """Return the environment variables that hold tokens, which no node has any use for.

    Args:
        program: what a run programs.

    Raises:
        SettingsError: a settings file cannot be used.
    """
    paths = {each.settings for each in program if each.settings}
    if not paths:
        return frozenset()
    from lifecycle.supervisor.programming.settings import load_settings

    found = [load_settings(each) for each in paths]
    tokens = [each.token for file in found for each in (file.nef, file.camara) if each is not None]
    return frozenset(each.env for each in tokens if each is not None and each.env)


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
    from lifecycle.supervisor.programming import open_programmer, sweep_orphans

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
    """Remove everything that a run has in networks, whoever applied it; say what was done.

    Args:
        directory: of the run.
        within_s: for all that servers are asked; None for the patience with each request.

    Raises:
        ProgrammingError: something could not be removed; it stays listed.
    """
    if not (directory / LEDGER_NAME).is_file():
        return ()
    from lifecycle.supervisor.programming import remove_run

    done = remove_run(directory, within_s=within_s)
    return tuple(each.render(done=True) for each in done if each.changes)
