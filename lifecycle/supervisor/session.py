"""One run of one system, from the first process to the last: the supervisor itself.

Owns: the order of the phases, what ends them, and that whatever happens everything is taken down
and one verdict remains. Each phase is a module of its own. Must not import rclpy.
"""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import os
import signal
from collections.abc import AsyncIterator, Coroutine, Iterable, Iterator
from typing import Any

from lifecycle.errors import ExitCode
from lifecycle.supervisor import discovery_server
from lifecycle.supervisor.bring_up import BringUp
from lifecycle.supervisor.elsewhere import Elsewhere
from lifecycle.supervisor.ending import ENDED_BY, Ending
from lifecycle.supervisor.events import (
    Emitter,
    GateOpened,
    LogLine,
    Notice,
    Stopped,
    Stopping,
    SystemReached,
)
from lifecycle.supervisor.eyes import Eyes
from lifecycle.supervisor.failure import NOT_JUDGED, StepFailedError, with_failure
from lifecycle.supervisor.gate import Gate, VerificationError
from lifecycle.supervisor.holding import Holding
from lifecycle.supervisor.judge import Changes, Judge
from lifecycle.supervisor.neighbours import Neighbours
from lifecycle.supervisor.networks import Networks
from lifecycle.supervisor.options import Until, UpOptions, UpResult
from lifecycle.supervisor.orphans import end_descendants, reap_adopted
from lifecycle.supervisor.records import Records
from lifecycle.supervisor.regulate import Regulator
from lifecycle.supervisor.rundir import RunDirectory
from lifecycle.supervisor.server import ControlServer, Look
from lifecycle.supervisor.shutdown import TakeDown
from lifecycle.supervisor.sightings import Sightings
from lifecycle.supervisor.status import SystemStatus, system_status
from lifecycle.supervisor.system import System
from lifecycle.supervisor.together import ended
from lifecycle.supervisor.vigil import Vigil
from lifecycle.supervisor.wiring import authority_of
from lifecycle.supervisor.zygote import Zygote
from lifecycle.verify.missing import missing, not_ok
from lifecycle.verify.verdict import Outcome, RunEnd, Stage, Verdict

_GLANCE_S = 1.0
"""How long `--until connected` looks for a verdict to report; it gates nothing."""


class _Stop(Exception):  # noqa: N818 - not an error: somebody asked
    """Somebody asked the run to end."""

    def __init__(self, reason: str, exit_code: ExitCode) -> None:
        super().__init__(reason)
        self.reason = reason
        self.exit_code = exit_code


class Session:
    """A supervisor of one system.

    Args:
        system: the plan and the part of it that this supervisor is responsible for.
        options: what the person asked for.
        directory: acquired for this run.
        zygote: forks the processes.
        eyes: see the graph; made before any process.
        networks: programmed while the system is active.
        emit: where events go.
        ending: knows of signals that came before.
    """

    def __init__(
        self,
        system: System,
        options: UpOptions,
        *,
        directory: RunDirectory,
        zygote: Zygote,
        eyes: Eyes,
        networks: Networks,
        emit: Emitter,
        ending: Ending,
    ) -> None:
        self._system = system
        self._options = options
        self._directory = directory
        self._zygote = zygote
        self._eyes = eyes
        self._networks = networks
        self._emit = emit
        self._ending = ending
        self._furthest: str | None = None
        self._violated = ""
        self._hurry = asyncio.Event()
        self._stop: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._gate = Gate(strict=options.strict)
        self._changes = Changes(system, eyes)
        self._authority = authority_of(system, emit, eyes)
        self._judge = Judge(
            system,
            eyes,
            self._changes,
            emit,
            strict=options.strict,
            looker=self._authority,
        )
        sightings = Sightings(system.plan, eyes, self._changes)
        self._records = Records(directory, system, zygote.pid)
        self._vigil = Vigil(system)
        self._bring_up = BringUp(
            system,
            spawner_of=lambda _: zygote,
            services=eyes.driver,
            appears=sightings.appears,
            recorded=self._records.write,
            wirer=self._authority,
        )
        self._elsewhere = Elsewhere(system.plan, system.awaited(), eyes, self._changes)
        self._neighbours = Neighbours(system, eyes)
        self._regulator = Regulator(
            system,
            bring_up=self._bring_up,
            judge=self._judge,
            gate=self._gate,
            emit=emit,
            alive=self._vigil.during,
            leaves=self._vigil.dead.update,
            comes_back=self._vigil.dead.difference_update,
            forget=eyes.drop_configuration,
            vanishes=sightings.vanishes,
            replanned=self._replanned,
            hurry=self._hurry,
            timeout_s=options.timeout_s,
        )
        self._holding = Holding(
            system,
            judge=self._judge,
            changes=self._changes,
            regulator=self._regulator,
            vigil=self._vigil,
            emit=emit,
            note_segments=self._records.note_segments,
            keep_going=options.keep_going,
        )

    @property
    def segments(self) -> frozenset[str]:
        """Shared memory files that our processes were seen to use."""
        return self._records.segments

    def status(self) -> SystemStatus:
        """Return what is known now."""
        return system_status(
            self._system,
            self._judge.latest,
            phase=self._regulator.phase,
            supervisor=os.getpid(),
            elapsed_s=self._emit.elapsed_s,
        )

    def look(self) -> Look:
        """Return all that is known now."""
        return Look(
            plan=self._system.expected,
            status=self.status(),
            observation=self._judge.seen,
            verdict=self._judge.latest,
        )

    def stop(self, reason: str, exit_code: ExitCode) -> None:
        """Ask the run to end; a second time, ask it to hurry."""
        if self._stop.done():
            if exit_code is ExitCode.INTERRUPTED:
                self._hurry.set()
            return
        self._stop.set_exception(_Stop(reason, exit_code))

    async def run(self) -> UpResult:
        """Bring the system up, hold it, and take it down; never leaves anything running."""
        server = ControlServer(
            self._directory.socket_path,
            self.status,
            lambda: self.stop("lifecycle down", ExitCode.OK),
            look=self.look,
            order=self._holding.ordered,
        )
        await server.open()
        self._neighbours.open()
        self._emit.listen(lambda event: None if isinstance(event, LogLine) else server.changed())
        result = UpResult(exit_code=ExitCode.INTERNAL, verdict=NOT_JUDGED)
        try:
            with self._signals():
                try:
                    result = await self._until_over()
                finally:
                    await self._take_down()
        finally:
            self._eyes.prepare_to_leave()
            await self._neighbours.close()
            await self._changes.close()
            self._emit(Stopped(exit_code=result.exit_code, elapsed_s=self._emit.elapsed_s))
            await server.close(result.exit_code)
        return result

    async def _until_over(self) -> UpResult:
        """Run the phases; whatever ends them becomes an exit code and a verdict."""
        reason = stopping = "done"
        verdict: Verdict | None = None
        try:
            exit_code = await self._unless_stopped(self._phases())
            if self._violated:
                reason = f"done, and violated; {self._violated}"
        except _Stop as stop:
            reason = stopping = stop.reason
            exit_code = stop.exit_code
            if waits := self._waits():
                reason = f"{reason}; {waits}"
        except StepFailedError as failure:
            self._emit(failure.event())
            reason, stopping, exit_code = failure.reason, "rolling back", failure.exit_code
            verdict = with_failure(self._judge.latest or _empty(), failure)
        except VerificationError as error:
            stopping, exit_code = "the verdict keeps the gate closed", error.exit_code
            if self._regulator.phase == "activating":
                stopping = "what became active is not what was verified"
            reason = f"{stopping}; {not_ok(error.verdict) or error.verdict.verdict.value}"
        self._gate.close()
        self._regulator.phase = "stopping"
        self._emit(Stopping(reason=stopping))
        run = RunEnd(reason=reason, reached=self._furthest, exit_code=exit_code)
        verdict = dataclasses.replace(verdict or self._judge.latest or NOT_JUDGED, run=run)
        return UpResult(exit_code=exit_code, verdict=verdict)

    def _waits(self) -> str:
        """Say what a run still waits for that is asked to end before its system is up."""
        latest = self._judge.latest
        verifies = self._regulator.phase == "verifying" and latest is not None
        return self._bring_up.unfinished() or (missing(latest) if verifies and latest else "")

    async def _phases(self) -> ExitCode:
        loop = asyncio.get_running_loop()
        deadline = loop.time() + self._options.timeout_s
        async with self._following():
            await self._vigil.during(self._bring_up.connect(self._options.timeout_s))
        self._reached("connected")
        if self._options.until is Until.CONNECTED:
            await self._vigil.during(self._judge.until_clear(Stage.CONNECTED, _GLANCE_S))
            return await self._hold(Stage.CONNECTED)
        self._regulator.phase = "verifying"
        await self._vigil.during(self._judge.until_clear(Stage.CONNECTED, deadline - loop.time()))
        verdict = self._judge.latest
        assert verdict is not None
        permit = self._gate.judge(verdict)
        self._reached("verified")
        if self._options.until is Until.VERIFIED:
            return await self._hold(Stage.CONNECTED)
        self._regulator.phase = "activating"
        managed = tuple(each.name for each in self._system.nodes.values() if each.planned.managed)
        self._emit(GateOpened(outcome=verdict.verdict.value, nodes=managed))
        await self._vigil.during(self._networks.begin(verdict))
        async with self._following():
            await self._vigil.during(self._bring_up.activate(permit, deadline - loop.time()))
        await self._vigil.during(self._judge.until_clear(Stage.ACTIVE, deadline - loop.time()))
        # The same question as at the gate: what became active must be what was verified.
        self._gate.judge(self._judge.latest or verdict)
        self._regulator.phase = "active"
        self._reached("active")
        return await self._hold(Stage.ACTIVE)

    @contextlib.asynccontextmanager
    async def _following(self) -> AsyncIterator[None]:
        """Keep looking at the nodes of others that ours wait for."""
        following = asyncio.ensure_future(self._elsewhere.follow())
        try:
            yield
        finally:
            if following.done():
                following.result()
            await ended(following)

    async def _hold(self, stage: Stage) -> ExitCode:
        """Keep the system for as long as was asked; return what the run comes to."""
        hold_s = self._options.stop_after_s
        if hold_s is None and self._options.until is not Until.ACTIVE:
            hold_s = 0.0
        meanwhile = await self._holding.hold(stage, hold_s)
        if self._options.until is Until.CONNECTED:
            return ExitCode.OK
        verdict = self._judge.latest
        if verdict is not None and verdict.verdict is Outcome.VIOLATED:
            self._violated = not_ok(verdict)
        elif meanwhile:
            self._violated = f"meanwhile, {meanwhile}"
        else:
            return ExitCode.OK
        return ExitCode.VIOLATED

    async def _unless_stopped(self, phases: Coroutine[Any, Any, ExitCode]) -> ExitCode:
        running = asyncio.ensure_future(phases)
        try:
            waits: set[asyncio.Future[Any]] = {running, self._stop}
            await asyncio.wait(waits, return_when=asyncio.FIRST_COMPLETED)
            if self._stop.done():
                self._stop.result()
            return running.result()
        finally:
            await ended(running)

    async def _take_down(self) -> None:
        """End everything, also what our processes left behind."""
        self._regulator.phase = "stopping"
        self._eyes.prepare_to_leave()
        self._holding.close(f"cannot go on: {self._system.plan.system!r} is being taken down")
        await self._bring_up.close()
        await self._records.note_segments()
        if self._authority is not None:
            await self._authority.close()
        try:
            await TakeDown(self._system, self._emit, self._hurry).run()
        finally:
            # After the last message has left, and before what runs below us is ended.
            await self._networks.close()
            await discovery_server.end(self._system, self._hurry)
        loop = asyncio.get_running_loop()
        left = await loop.run_in_executor(None, end_descendants, (self._zygote.pid,))
        if left:
            self._emit(Notice(message=f"ended processes that were left behind: {_listed(left)}"))
        if not self._stop.done():
            self._stop.cancel()
        elif not self._stop.cancelled():
            self._stop.exception()

    @contextlib.contextmanager
    def _signals(self) -> Iterator[None]:
        loop = asyncio.get_running_loop()
        ends = self._ending.numbers
        for number in ends:
            loop.add_signal_handler(number, self._ended_by, number)
        loop.add_signal_handler(signal.SIGCHLD, lambda: reap_adopted((self._zygote.pid,)))
        if self._ending.number is not None:
            self._ended_by(self._ending.number)
        try:
            yield
        finally:
            for number in (*ends, signal.SIGCHLD):
                loop.remove_signal_handler(number)
            self._ending.resume()

    def _ended_by(self, number: int) -> None:
        self.stop(*ENDED_BY[number])

    def _replanned(self, nodes: Iterable[str]) -> None:
        if self._authority is not None:
            self._authority.replan(self._system.plan, frozenset(nodes))

    def _reached(self, reached: str) -> None:
        self._furthest = reached
        self._emit(SystemReached(reached=reached, elapsed_s=self._emit.elapsed_s))


def _empty() -> Verdict:
    return Verdict(verdict=Outcome.OK, blocking=False, findings=(), flows=())


def _listed(pids: tuple[int, ...]) -> str:
    return ", ".join(str(pid) for pid in pids)
