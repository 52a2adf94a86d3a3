"""One run of one system, from the first process to the last: the supervisor itself.

Owns: the order of the phases, what ends them, and that whatever happens everything is taken down
and one verdict remains. Each phase is a module of its own. Must not import rclpy.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
from collections.abc import (
    AsyncIterator,
    Collection,
    Coroutine,
    Iterable,
    Iterator,
)
from typing import TYPE_CHECKING, Any

import msgspec
from msgspec.structs import replace

from lifecycle.errors import ExitCode
from lifecycle.plan.model import Plan
from lifecycle.run_directory import RunDirectory, start_ticks
from lifecycle.supervisor.connections import discovery_server
from lifecycle.supervisor.connections.authority import authority_of
from lifecycle.supervisor.connections.networks import Networks
from lifecycle.supervisor.control.orders import ACTIVE, HELD, PAUSED, Order, Revisions
from lifecycle.supervisor.control.protocol import Answer, SystemStatus
from lifecycle.supervisor.control.ros_interface import RosInterface
from lifecycle.supervisor.control.server import ControlServer, SupervisorSnapshot
from lifecycle.supervisor.control.status import system_status
from lifecycle.supervisor.gate.activation_guard import ActivationGuard
from lifecycle.supervisor.gate.gate import Gate, VerificationError, closes
from lifecycle.supervisor.gate.hold import Holding
from lifecycle.supervisor.gate.sequence import GateSequence
from lifecycle.supervisor.gate.verification_loop import ChangeCounter, VerificationLoop
from lifecycle.supervisor.health import agreement
from lifecycle.supervisor.health.agreement import Agreement
from lifecycle.supervisor.health.answering import Answering
from lifecycle.supervisor.health.peer_supervisors import PeerSupervisors
from lifecycle.supervisor.health.process_monitor import (
    EndedProcesses,
    ProcessMonitor,
    Sightings,
)
from lifecycle.supervisor.nodes.adoption import adopt, ran_before
from lifecycle.supervisor.nodes.bring_up import BringUp
from lifecycle.supervisor.nodes.system import (
    NodeRun,
    System,
    follow_health,
    follow_remote,
)
from lifecycle.supervisor.policy.schedule import RestartSchedule
from lifecycle.supervisor.processes.orphans import reap_adopted
from lifecycle.supervisor.run.events import (
    Emitter,
    LogLine,
    Notice,
    Stopped,
    Stopping,
    SystemReached,
)
from lifecycle.supervisor.run.failure import StepFailedError, ended, with_failure
from lifecycle.supervisor.run.options import Until, UpOptions, UpResult
from lifecycle.supervisor.run.records import Records
from lifecycle.supervisor.run.shutdown import TakeDown
from lifecycle.supervisor.run.signals import ENDED_BY, Ending
from lifecycle.verify.judge import missing, not_ok
from lifecycle.verify.outcome import Outcome
from lifecycle.verify.rules.run import PROCESS_DIED
from lifecycle.verify.verdict import NOT_JUDGED, RunEnd, Stage, Verdict

if TYPE_CHECKING:
    from lifecycle.supervisor.nodes.observer_participant import ObserverParticipant
    from lifecycle.supervisor.processes.fork_server import ForkServer

_GLANCE_S = 1.0
"""How long `--until connected` looks for a verdict to report; it gates nothing."""


_NOTICE_S = 0.5
"""Another supervisor says that it ends before its nodes do, but by another topic than theirs."""

_STOPPING = "stopping"
_KEPT = (ACTIVE, PAUSED, "pausing")
"""Phases of a system that was verified and is what was asked for; in any other it is on its way."""


class _Stop(Exception):  # noqa: N818 - not an error: it was asked for
    """The run was asked to end.

    Attributes:
        reason: as text.
        exit_code: of a run that was cut short by it.
    """

    def __init__(self, reason: str, exit_code: ExitCode) -> None:
        super().__init__(reason)
        self.reason = reason
        self.exit_code = exit_code


class _RunEnd(msgspec.Struct, frozen=True, kw_only=True):
    """Result of a run, beside its reason: nothing to add, if it is as it was asked for."""

    exit_code: ExitCode = ExitCode.OK
    why: str = ""
    verdict: Verdict | None = None


class _Time:
    """The time of a bring-up.

    Args:
        timeout_s: seconds from now, > 0.

    Attributes:
        deadline: by the running loop's clock.
    """

    def __init__(self, timeout_s: float) -> None:
        self._loop = asyncio.get_running_loop()
        self._began = self._loop.time()
        self.deadline = self._began + timeout_s

    @property
    def left_s(self) -> float:
        """Seconds that are left; negative once it is over."""
        return self.deadline - self._loop.time()

    def shorten(self, left_s: float) -> None:
        """Have it over in so many seconds."""
        self.deadline = self._loop.time() + left_s

    def __str__(self) -> str:
        """Say that it is over."""
        return (
            f"the {round(self.deadline - self._began, 1):g} s of the bring-up are over (--timeout)"
        )


class Session:
    """A supervisor of one system.

    Args:
        system: the plan and the part of it that this supervisor is responsible for.
        options: what the person asked for.
        directory: acquired for this run.
        records: of this run.
        fork_server: forks the processes.
        observer_participant: sees the graph and reaches foreign nodes; made before any process.
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
        records: Records,
        fork_server: ForkServer,
        observer_participant: ObserverParticipant,
        networks: Networks,
        emit: Emitter,
        ending: Ending,
    ) -> None:
        self._system = system
        self._options = options
        self._directory = directory
        self._fork_server = fork_server
        self._observer_participant = observer_participant
        self._networks = networks
        self._emit = emit
        self._ending = ending
        self._furthest: str | None = None
        self._time: _Time | None = None  # of the bring-up, while it lasts
        self._held = False
        self._ends = ""
        self._reason = ""
        self._hurry = asyncio.Event()
        self._stop: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._changes = ChangeCounter(system, observer_participant.graph)
        self._authority = authority_of(system, emit, observer_participant)
        self._peer_supervisors = PeerSupervisors(system, observer_participant)
        self._agreement = Agreement(system, observer_participant, self._peer_supervisors)
        self._guard = ActivationGuard(system)
        self._answering = Answering(system, observer_participant)
        self._judge = VerificationLoop(
            system,
            observer_participant.graph,
            self._changes,
            emit,
            strict=options.strict,
            looker=self._authority,
            agreement=self._agreement,
            guard=self._guard,
            answering=self._answering,
        )
        self._gate = Gate(strict=options.strict, judging=self._judge)
        sightings = Sightings(system, observer_participant.graph, self._changes)
        self._ended = EndedProcesses(system, observer_participant)
        emit.listen(self._ended.on_event)
        emit.listen(self._judge.on_event)
        self._records = records
        self._process_monitor = ProcessMonitor(system)
        self._schedule = RestartSchedule(system, emit)
        self._bring_up = BringUp(
            system,
            spawner_of=lambda _: fork_server,
            services=observer_participant.driver,
            appears=sightings.appears,
            recorded=self._records.write,
            wirer=self._authority,
            gives=observer_participant.clients.give_parameters,
            loads=observer_participant.load,
            alone=self._alone,
        )
        self._gate_sequence = GateSequence(
            system,
            bring_up=self._bring_up,
            schedule=self._schedule,
            judge=self._judge,
            gate=self._gate,
            emit=emit,
            process_monitor=self._process_monitor,
            forget=self._forget,
            sightings=sightings,
            replanned=self._replanned,
            networks=networks,
            following=self._following,
            outrun=lambda: self._holding.outrun(),  # noqa: PLW0108 - it is made below
            spawner=fork_server,
            hurry=self._hurry,
            timeout_s=options.bring_up_s(len(system.processes)),
            clients=observer_participant.clients,
        )
        self._revisions = Revisions(system, options)
        self._holding = Holding(
            system,
            judge=self._judge,
            changes=self._changes,
            gate_sequence=self._gate_sequence,
            schedule=self._schedule,
            revisions=self._revisions,
            process_monitor=self._process_monitor,
            emit=emit,
            keep_going=options.keep_going,
            stop=self.stop,
        )

        self._ros_interface = RosInterface(
            self,
            system.plan,
            min(system.machines or ("",)),
            observer_participant,
            emit=emit,
            modes=() if system.remote else (each.name for each in system.plan.modes),
        )

    def status(self) -> SystemStatus:
        """Return what is known now."""
        return system_status(
            self._system,
            self._judge.latest,
            phase=self._gate_sequence.phase,
            supervisor=os.getpid(),
            elapsed_s=self._emit.elapsed_s,
            schedule=self._schedule,
            ends=self._reason,
        )

    def look(self) -> SupervisorSnapshot:
        """Return all that is known now."""
        return SupervisorSnapshot(
            plan=self._system.expected,
            status=self.status(),
            observation=self._judge.seen,
            verdict=self._judge.latest,
        )

    def stop(self, reason: str, exit_code: ExitCode) -> None:
        """Ask the run to end; once it ends, an interrupt asks it to hurry.

        Args:
            reason: as text.
            exit_code: of the run, if this cuts it short.
        """
        if self._stop.done() or self._gate_sequence.phase == _STOPPING:
            if exit_code is ExitCode.INTERRUPTED:
                self._hurry.set()
            return
        self._stop.set_exception(_Stop(reason, exit_code))

    async def order(self, order: Order) -> Answer:
        """Take an order from outside, if it fits what the system is doing; return its outcome."""
        return await self._holding.ordered(order)

    def differences(self, plan: Plan) -> tuple[str, ...]:
        """Say how `plan` differs from what runs, one line each; empty if it does not."""
        return self._revisions.differences(plan)

    async def run(self) -> UpResult:
        """Bring the system up, hold it, and take it down; never leaves anything running."""
        server = ControlServer(self._directory.socket_path, self)
        await server.open()
        self._peer_supervisors.open()
        self._agreement.open()
        self._emit.listen(lambda event: None if isinstance(event, LogLine) else server.changed())
        self._emit.listen(self._ros_interface.on_event)
        self._ros_interface.begin()
        result = UpResult(exit_code=ExitCode.INTERNAL, verdict=NOT_JUDGED)
        asking = asyncio.ensure_future(self._answering.follow())
        try:
            with self._signals():
                try:
                    result = await self._until_over()
                finally:
                    await ended(asking)
                    deaths = await self._take_down()
                if deaths:
                    result = _died_on_the_way_down(result, deaths)
                if self._hurry.is_set() and result.exit_code == ExitCode.OK:
                    result = _hurried(result)
        finally:
            self._judge.close()
            await self._changes.close()
            self._ros_interface.close()
            run = result.verdict.run
            self._emit(
                Stopped(
                    exit_code=result.exit_code,
                    elapsed_s=self._emit.elapsed_s,
                    reason="" if run is None else run.reason,
                )
            )
            await server.close(result.exit_code)
        return result

    async def leave(self) -> None:
        """Leave the exchange with other supervisors, after `run`; Fast DDS can hang in it."""
        self._observer_participant.prepare_to_leave()
        self._agreement.close()
        await self._peer_supervisors.close()

    async def _until_over(self) -> UpResult:
        """Run the phases; whatever ends them becomes an exit code and a verdict."""
        reason = stopping = "done"
        failed = how = ""
        end = _RunEnd()
        try:
            end = await self._unless_stopped(self._phases())
        except _Stop as stop:
            reason = stopping = stop.reason
            end = self._cut_short(stop.exit_code)
        except StepFailedError as failure:
            for each in failure.every:
                self._emit(each.event())
            reason, stopping, how = failure.reason, "rolling back", agreement.FAILED
            failed = "; ".join(each.message for each in failure.every)
            verdict = with_failure(self._judge.latest or NOT_JUDGED, failure)
            end = _RunEnd(exit_code=failure.exit_code, verdict=verdict)
        except VerificationError as error:
            stopping, end = "the verdict keeps the gate closed", _RunEnd(exit_code=error.exit_code)
            how = agreement.FAILED
            if error.again:
                stopping = "the system changed before every node was activated"
            elif self._gate_sequence.phase == "activating":
                stopping = "what became active is not what was verified"
            if self._time is not None and self._time.left_s <= 0:
                stopping = f"{stopping}, and {self._time}"
            reason = f"{stopping}; {not_ok(error.verdict) or error.verdict.verdict.value}"
        if end.why:
            reason = f"{reason}, but {end.why}" if reason == "done" else f"{reason}; {end.why}"
        for also in (self._schedule.summary(), self._judge.violations.passed()):
            reason = f"{reason}; {also}" if also else reason
        self._gate.close()
        self._gate_sequence.phase = _STOPPING
        self._ends, self._reason = f"{how}{stopping}", failed or reason
        self._emit(Stopping(reason=stopping))
        run = RunEnd(
            reason=reason,
            reached=self._furthest,
            exit_code=end.exit_code,
            trusted=self._gate_sequence.trusted,
        )
        verdict = self._system.liveliness.by_now(
            replace(end.verdict or self._judge.latest or NOT_JUDGED, run=run)
        )
        return UpResult(exit_code=end.exit_code, verdict=verdict, plan=self._system.first)

    def _cut_short(self, exit_code: ExitCode) -> _RunEnd:
        """Return the result of a run that is asked to end.

        It is a success only if the system was verified, is what was asked for, and nothing bound
        it to stay; an interrupt (Ctrl-C) never is, nor what a violation ends. What was violated
        meanwhile and is over is said, and no failure of who ends a run that was to last for ever.

        Args:
            exit_code: of a run that is cut short.
        """
        if not self._held:
            return _RunEnd(exit_code=exit_code, why=self._waits())
        end = self._outcome()
        if exit_code in (ExitCode.INTERRUPTED, ExitCode.VIOLATED):
            end = replace(end, exit_code=exit_code)
        if end.exit_code != ExitCode.OK:
            return end
        if self._options.stop_after_s is not None:
            why = f"it did not hold for the {self._options.stop_after_s:g} s of --stop-after"
            return _RunEnd(exit_code=exit_code, why=why)
        if self._options.until is Until.ACTIVE and self._gate_sequence.phase not in _KEPT:
            why = f"the system was {self._gate_sequence.phase}, not active"
            return _RunEnd(exit_code=exit_code, why=why)
        if meanwhile := self._judge.violations.counted:
            return replace(end, why=f"violated meanwhile, {meanwhile}")
        return end

    def _hosts_left(self) -> bool:
        """Whether nothing is violated but that other machines of the system were shut down."""
        latest = self._judge.latest
        return latest is not None and self._agreement.follows_from_shut_down(latest)

    def _outcome(self, meanwhile: str = "") -> _RunEnd:
        """Return the result of the run of a system that was held until now.

        That other machines of the system were shut down before is how a system of several hosts
        ends, and no failure of this one.

        Args:
            meanwhile: violations that are over and count, as text.
        """
        deaths = self._process_monitor.deaths()
        if deaths:
            failure = deaths[0].joined(deaths[1:])
            verdict = with_failure(self._judge.latest or NOT_JUDGED, failure)
            return _RunEnd(exit_code=failure.exit_code, why=failure.reason, verdict=verdict)
        latest = self._judge.latest
        end = _RunEnd()
        if self._options.until is Until.CONNECTED or latest is None:
            pass
        elif latest.verdict is Outcome.VIOLATED and not self._hosts_left():
            end = _RunEnd(exit_code=ExitCode.VIOLATED, why=f"violated; {not_ok(latest)}")
        elif meanwhile:
            end = _RunEnd(exit_code=ExitCode.VIOLATED, why=f"violated meanwhile, {meanwhile}")
        elif closes(latest, strict=self._options.strict) and not self._hosts_left():
            end = _RunEnd(exit_code=ExitCode.UNVERIFIABLE, why=f"unverifiable; {not_ok(latest)}")
        elif self._gate_sequence.phase == HELD:
            end = _RunEnd(exit_code=ExitCode.VIOLATED, why="held at the gate, and not active")
        return end

    def _waits(self) -> str:
        """Say what a run still waits for that is asked to end before its system is up."""
        latest = self._judge.latest
        verifies = self._gate_sequence.phase == "verifying" and latest is not None
        return self._bring_up.unfinished() or (missing(latest) if verifies and latest else "")

    async def _phases(self) -> _RunEnd:
        timeout_s = self._options.bring_up_s(len(self._system.processes))
        self._time = time = _Time(timeout_s)
        if self._options.adopt:
            await self._adopt()
        async with self._following():
            await self._gate_sequence.connect(timeout_s)
        self._judge.ahead = self._gate_sequence.active()
        self._furthest = "connected"
        self._emit(SystemReached(reached="connected", elapsed_s=self._emit.elapsed_s))
        if self._options.until is Until.CONNECTED:
            await self._process_monitor.during(self._judge.until_clear(Stage.CONNECTED, _GLANCE_S))
            return await self._hold(Stage.CONNECTED)
        while True:
            time.shorten(self._options.gate_s(time.left_s))
            try:
                permit = await self._gate_sequence.verify(time.left_s)
                self._furthest = "verified"
                if self._options.until is Until.VERIFIED:
                    break
                await self._gate_sequence.activate(permit, time.deadline)
                self._furthest = "active"
                break
            except StepFailedError as failure:
                await self._gate_sequence.recover(failure, timeout_s)
                self._time = time = _Time(timeout_s)
        self._time = None
        return await self._hold(
            Stage.CONNECTED if self._options.until is Until.VERIFIED else Stage.ACTIVE
        )

    async def _adopt(self) -> None:
        """Take what runs already as it is found, before anything is started.

        Raises:
            VerificationError: a node runs more than once.
            StepFailedError: of a process with several nodes only some run.
        """
        if findings := await adopt(self._system, self._observer_participant):
            raise VerificationError(self._judge.refuse(findings))
        self._replanned(self._system.adopted)

    def _forget(self, nodes: Collection[NodeRun], left: Collection[int]) -> None:
        for node in nodes:
            self._observer_participant.graph.drop_configuration(node.name)
        for pid in left:
            if start_ticks(pid) is None:
                self._ended.forget(pid, tuple(nodes))

    def _alone(self, node: NodeRun) -> None:
        processes = self._observer_participant.processes().get(node.name, {})
        if findings := ran_before(node, processes, self._fork_server.family()):
            raise VerificationError(self._judge.refuse(findings))

    @contextlib.asynccontextmanager
    async def _following(self) -> AsyncIterator[None]:
        """Keep looking at the nodes of others, and at ours that others may drive, too."""
        graph, changes = self._observer_participant.graph, self._changes
        followers = (
            asyncio.ensure_future(follow_remote(self._system, graph, changes)),
            asyncio.ensure_future(follow_health(self._system, graph, changes)),
            asyncio.ensure_future(self._guard.follow(graph, changes)),
        )
        try:
            yield
        finally:
            for each in followers:
                if each.done():
                    each.result()
            await ended(*followers)

    async def _hold(self, stage: Stage) -> _RunEnd:
        """Keep the system for as long as was asked; return the result of the run."""
        self._held = self._schedule.was_up = True
        hold_s = self._options.stop_after_s
        if hold_s is None and self._options.until is not Until.ACTIVE:
            hold_s = 0.0
        await self._holding.hold(stage, hold_s)
        await self._others_end()
        return self._outcome(self._judge.violations.counted)

    async def _others_end(self) -> None:
        """Wait a moment for machines that end with ours to say so, where only theirs is wrong."""
        others = {each.name for each in self._system.remote.values()}
        latest, deadline = self._judge.latest, asyncio.get_running_loop().time() + _NOTICE_S
        while latest is not None and latest.verdict is Outcome.VIOLATED:
            violated = [each for each in latest.findings if each.outcome is Outcome.VIOLATED]
            left_s = deadline - asyncio.get_running_loop().time()
            if left_s <= 0 or self._hosts_left():
                return
            if any(others.isdisjoint(each.nodes) for each in violated):
                return
            await self._changes.beyond(self._changes.count, left_s)

    async def _unless_stopped(self, phases: Coroutine[Any, Any, _RunEnd]) -> _RunEnd:
        running = asyncio.ensure_future(phases)
        try:
            died = self._fork_server.died
            waits: set[asyncio.Future[Any]] = {running, self._stop, died}
            await asyncio.wait(waits, return_when=asyncio.FIRST_COMPLETED)
            if self._stop.done():
                self._stop.result()
            if died.done():
                raise StepFailedError(
                    f"cannot go on: {died.result()}",
                    rule=PROCESS_DIED,
                    subject="fork server",
                )
            return running.result()
        finally:
            await ended(running)

    async def _take_down(self) -> list[StepFailedError]:
        """End everything, also what our processes left behind; return who died meanwhile."""
        self._gate_sequence.phase = _STOPPING
        self._schedule.close()
        self._agreement.leave(self._ends)
        self._observer_participant.prepare_to_leave()
        self._holding.close(f"cannot go on: {self._system.plan.system!r} is being taken down")
        await self._guard.close()
        await self._bring_up.close()
        if self._authority is not None:
            await self._authority.close()
        taking_down = TakeDown(self._system, self._emit, self._hurry)
        try:
            await taking_down.run()
        finally:
            # After the last message has left, and before what runs below us is ended.
            await self._networks.close(self._hurry)
            await discovery_server.end(self._system, self._hurry)
        if left := await self._fork_server.end_strays():
            pids = ", ".join(map(str, left))
            self._emit(Notice(message=f"ended processes that were left behind: {pids}"))
        self._system.logs.report_lost()
        if not self._stop.done():
            self._stop.cancel()
        elif not self._stop.cancelled():
            self._stop.exception()
        return taking_down.deaths

    @contextlib.contextmanager
    def _signals(self) -> Iterator[None]:
        loop = asyncio.get_running_loop()
        ends = self._ending.numbers
        for number in ends:
            loop.add_signal_handler(number, self._ended_by, number)
        loop.add_signal_handler(signal.SIGCHLD, lambda: reap_adopted(self._fork_server.waited_for))
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
        self._networks.replan(self._system.plan)
        self._peer_supervisors.renew()
        self._agreement.announce(self._system.first)


_ENDS_WELL = (ExitCode.OK, ExitCode.VIOLATED, ExitCode.UNVERIFIABLE)


def _died_on_the_way_down(result: UpResult, deaths: list[StepFailedError]) -> UpResult:
    """Return the result of a run some of whose processes died while it was taken down.

    It fails by that as by any other death; one that was interrupted, or had failed before, keeps
    the exit code of what came first.
    """
    failure = deaths[0].joined(deaths[1:])
    code = failure.exit_code if result.exit_code in _ENDS_WELL else result.exit_code
    verdict = with_failure(result.verdict, failure)
    assert verdict.run is not None
    reason = f"{verdict.run.reason}, but {failure.reason} while it was taken down"
    run = replace(verdict.run, reason=reason, exit_code=code)
    return replace(result, exit_code=code, verdict=replace(verdict, run=run))


def _hurried(result: UpResult) -> UpResult:
    """Return the result of a run that was interrupted while it was taken down: not cleanly."""
    run = result.verdict.run
    assert run is not None
    reason = f"{run.reason}; interrupted while it was taken down"
    run = replace(run, reason=reason, exit_code=ExitCode.INTERRUPTED)
    verdict = replace(result.verdict, run=run)
    return replace(result, exit_code=ExitCode.INTERRUPTED, verdict=verdict)
