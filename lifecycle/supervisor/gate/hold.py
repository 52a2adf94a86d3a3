"""Holds a system that is up: judges it at every change, and carries out orders.

Owns: `Watch`, which judges again and again, and `Holding`: for how long, what ends it, how orders
(pause, resume, restart, mode, apply) are received and answered, and that what fails is restarted,
and what is violated has its consequence, when policy says so, by the same orders. What an order
does is sequence.py's, when to restart and what to do about a violation policy/'s. Must not import
rclpy.
"""

from __future__ import annotations

import asyncio
import enum
from collections.abc import Awaitable, Callable
from typing import Any

import msgspec

from lifecycle.errors import ExitCode, UsageError
from lifecycle.manifest.model import Consequence
from lifecycle.supervisor.control.orders import (
    ACTIVE,
    HELD,
    PAUSED,
    Mailbox,
    NotBegunError,
    Order,
    Pending,
    Revisions,
    RolledBackError,
    check_order,
    said,
)
from lifecycle.supervisor.control.protocol import Answer, ChangedNodes, ControlRequest
from lifecycle.supervisor.gate.gate import VerificationError
from lifecycle.supervisor.gate.sequence import GateSequence, OutrunError
from lifecycle.supervisor.gate.verification_loop import (
    ASK_AGAIN_AT_MOST_S,
    SETTLED_S,
    ChangeCounter,
    VerificationLoop,
)
from lifecycle.supervisor.health.process_monitor import ProcessMonitor
from lifecycle.supervisor.nodes.system import System
from lifecycle.supervisor.policy.consequences import Consequences, Due
from lifecycle.supervisor.policy.schedule import RestartSchedule
from lifecycle.supervisor.run.events import ConsequenceTaken, Emitter, Notice
from lifecycle.supervisor.run.failure import StepFailedError, ended, failure_of
from lifecycle.verify.judge import not_ok
from lifecycle.verify.verdict import Stage, Verdict


class Watch:
    """Judges a system again and again while it is held.

    Args:
        away: returns the names of the nodes that are to be started again by policy, or wait for a
            gate: they violate nothing by that.
        opens: whether a verdict opens a gate that is waited for; `run` returns then.
        consequences: what is done about violations; None while nothing is.
        counts: whether what is violated counts: something is active.

    Attributes:
        due: what is to be done about a violation; `run` returns then, too. None if nothing is.
    """

    def __init__(
        self,
        judge: VerificationLoop,
        changes: ChangeCounter,
        stage: Stage,
        away: Callable[[], frozenset[str]] = frozenset,
        *,
        opens: Callable[[Verdict], bool] = lambda _: False,
        consequences: Consequences | None = None,
        counts: bool = True,
    ) -> None:
        self._consequences = consequences
        self._away = away
        self._opens = opens
        self._judge = judge
        self._changes = changes
        self._stage = stage
        self._counts = counts
        self.due: Due | None = None

    async def run(self) -> None:
        """Judge at every change, until cancelled, a gate may open, or something is to be done."""
        while True:
            count = self._changes.count
            whole, again_s = await self._judge.settled(self._stage)
            if again_s is None and self._opens(whole):
                return
            verdict = self._judge.without_nodes_of(whole, self._away())
            waits_s = [again_s]
            if self._judge.asks_again(whole):
                waits_s.append(ASK_AGAIN_AT_MOST_S)
            if self._counts:
                waits_s.append(self._judge.violated(whole, self._away()))
            if self._consequences is not None:
                self.due, in_s = self._consequences.look(verdict.findings)
                waits_s.append(in_s)
            if self.due is not None:
                self._judge.violations.count(not_ok(verdict))
                return
            wait_s = min((each for each in waits_s if each is not None), default=None)
            if await self._changes.beyond(count, wait_s):
                await self._judge.quiet()


class _Next(enum.Enum):
    """What is to be done beside orders."""

    RESTART = "restart"
    LET_THROUGH = "let_through"


class Holding:
    """The hold phase of one run.

    Args:
        system: what is held.
        judge: judges it at every change.
        changes: what it waits for.
        gate_sequence: carries out orders, and knows the phase.
        schedule: knows what is to be started again when.
        revisions: knows which manifest runs.
        process_monitor: notices processes that end.
        emit: where events go.
        keep_going: a process that ends is reported, and does not end the run.
        stop: ends the run, as `lifecycle down` does, with a reason and an exit code.
    """

    def __init__(
        self,
        system: System,
        *,
        judge: VerificationLoop,
        changes: ChangeCounter,
        gate_sequence: GateSequence,
        schedule: RestartSchedule,
        revisions: Revisions,
        process_monitor: ProcessMonitor,
        emit: Emitter,
        keep_going: bool,
        stop: Callable[[str, ExitCode], None],
    ) -> None:
        self._stop = stop
        self._consequences = Consequences(system, emit, lasting_s=SETTLED_S)
        self._system = system
        self._judge = judge
        self._changes = changes
        self._gate_sequence = gate_sequence
        self._schedule = schedule
        self._revisions = revisions
        self._process_monitor = process_monitor
        self._emit = emit
        self._keep_going = keep_going
        self._mailbox = Mailbox()
        self._before = ""  # phase of a system that is being restarted by policy
        self._under_way: Order | None = None  # given by a person

    async def hold(self, stage: Stage, hold_s: float | None) -> None:
        """Keep the system as it is, or as it is ordered.

        Args:
            stage: what it has reached; a violation counts only of what is active, see Violations.
            hold_s: seconds, ≥ 0; None for ever.

        Raises:
            StepFailedError: a process ended, or an order failed.
            VerificationError: an order could not be carried out behind the gate.
        """
        deadline = None if hold_s is None else asyncio.get_running_loop().time() + hold_s
        while True:
            opens = self._gate_sequence.may_let_through
            acts = self._gate_sequence.phase in (ACTIVE, HELD)
            counts = self._gate_sequence.phase == ACTIVE or bool(self._gate_sequence.active())
            if not acts:
                self._consequences.forget()
            if not counts:
                self._judge.violations.end()
            consequences = self._consequences if acts else None
            watch = Watch(
                self._judge,
                self._changes,
                stage,
                self._away,
                opens=opens,
                consequences=consequences,
                counts=counts,
            )
            watching = asyncio.ensure_future(watch.run())
            try:
                what = await self._until_ordered(deadline, watching)
            finally:
                await ended(watching)
            if what is None:
                if counts and not self._judge.is_current(self._judge.latest):
                    await self._judge.settled(stage)
                return
            if isinstance(what, Pending):
                await self._carry_out(what)
            elif isinstance(what, StepFailedError):
                await self._gate_sequence.put_down(what)
            elif what is _Next.LET_THROUGH and watch.due is not None:
                await self._take_consequence(watch.due)
            else:
                await self._by_policy(self._again if what is _Next.RESTART else self._let_through)
            stage = self._gate_sequence.stage

    async def ordered(self, order: Order) -> Answer:
        """Take an order from outside, if it fits what the system is doing; return its outcome.

        One that comes while another is carried out waits for that one's end, and fits then or not.
        """
        try:
            self._check(order, waits=self._under_way)
        except UsageError as error:
            return Answer(exit_code=error.exit_code, error=str(error))
        if order.dry_run and order.plan is not None:
            change = self._revisions.said(self._revisions.change(order.plan), order.plan)
            differs = ExitCode.VIOLATED if change.differences else ExitCode.OK
            return Answer(exit_code=differs, change=change)
        return await self._mailbox.place(order)

    def _away(self) -> frozenset[str]:
        """Return the names of the nodes that are to be started again, or wait for their gate."""
        waiting = (each.name for each in self._gate_sequence.inactive())
        return self._schedule.away.union(waiting)

    async def outrun(self) -> None:
        """Return once an order waits, or something else is to be started again."""
        waits = [
            asyncio.ensure_future(self._mailbox.arrives()),
            asyncio.ensure_future(self._schedule.due()),
        ]
        try:
            await asyncio.wait(waits, return_when=asyncio.FIRST_COMPLETED)
        finally:
            await ended(*waits)

    async def _take_consequence(self, due: Due) -> None:
        """Do about a violation what the manifest asks for, as a person would order it.

        Raises:
            StepFailedError: something failed that is not to be started again, or too often.
        """
        found = due.finding
        names = tuple(self._system.nodes[key].name for key in due.keys)
        self._emit(
            ConsequenceTaken(
                action=due.what.value,
                nodes=names,
                rule=found.rule,
                subject=found.subject,
                message=found.message,
            )
        )
        reason = f"on_violation: {due.what.value} ({found.rule} of {found.subject})"
        if due.what is Consequence.STOP:
            self._stop(reason, ExitCode.VIOLATED)
            await asyncio.get_running_loop().create_future()  # until it ends us
        order = Order(ask=ControlRequest.PAUSE, keys=due.keys, reason=f"{reason}; lifecycle resume")
        if due.what is Consequence.MODE:
            order = Order(ask=ControlRequest.MODE, mode=due.mode)
        await self._by_policy(lambda: self._carry_out_in_spite(order))

    async def _by_policy(self, work: Callable[[], Awaitable[None]]) -> None:
        """Do what no person ordered; who fails in it is put down, to be started again later.

        Raises:
            StepFailedError: something failed that is not to be started again, or too often.
        """
        failure = None
        self._before = self._gate_sequence.phase
        try:
            await work()
        except OutrunError:
            pass
        except (VerificationError, NotBegunError) as error:
            self._emit(Notice(message=str(error)))
        except StepFailedError as error:
            failure = error
        finally:
            self._before = ""
        if failure is not None:
            await self._gate_sequence.put_down(failure)

    async def _again(self) -> None:
        """Start again what is due."""
        keys = self._schedule.begin()
        await self._gate_sequence.carry_out(Order(ask=ControlRequest.RESTART, keys=keys))

    async def _let_through(self) -> None:
        """Let through its gate what waits there."""
        await self._gate_sequence.let_through()

    def _check(self, order: Order, *, waits: Order | None = None) -> None:
        # A restart by policy is nobody's order: what comes meanwhile is carried out after it.
        phase = self._before or self._gate_sequence.phase
        check_order(order, self._system, phase, waits=waits)
        self._revisions.check(order)

    def close(self, reason: str) -> None:
        """Answer every order that is still open, and those to come, with `reason`."""
        self._mailbox.close(reason)

    async def _carry_out(self, pending: Pending) -> None:
        """Carry an order out and report to its client; what ends the run is raised."""
        change = None
        try:
            # Another order may have come first.
            self._check(pending.order)
            self._under_way = pending.order
            if pending.order.ask is ControlRequest.APPLY:
                change = await self._apply(pending.order)
            else:
                await self._carry_out_in_spite(pending.order)
        except (UsageError, NotBegunError) as error:
            pending.finish(Answer(exit_code=error.exit_code, error=str(error)))
        except RolledBackError as error:
            pending.finish(Answer(exit_code=error.exit_code, error=str(error)))
            self._emit(Notice(message=str(error)))
            if error.ends is not None:
                raise error.ends from error
        except StepFailedError as error:
            pending.finish(Answer(exit_code=error.exit_code, error=str(error)))
            await self._gate_sequence.put_down(error)
        except VerificationError as error:
            pending.finish(Answer(exit_code=error.exit_code, error=str(error)))
            if self._gate_sequence.phase not in (ACTIVE, PAUSED, HELD):
                raise
            self._emit(Notice(message=str(error)))
        else:
            pending.finish(Answer(exit_code=ExitCode.OK, change=change))
        finally:
            self._under_way = None

    async def _apply(self, order: Order) -> ChangedNodes:
        """Have the system run by another manifest; return what that was for its nodes."""
        assert order.plan is not None
        running, change = self._system.first, self._revisions.change(order.plan)
        if change.differences:
            await self._carry_out_in_spite(msgspec.structs.replace(order, change=change))
        return said(change, running, order.plan, self._system.revision)

    async def _carry_out_in_spite(self, order: Order) -> None:
        """Carry an order out; a pause is not given up because something fails meanwhile."""
        while (failure := await failure_of(self._gate_sequence.carry_out(order))) is not None:
            if order.ask is not ControlRequest.PAUSE or not self._schedule.covers(failure):
                raise failure
            await self._gate_sequence.put_down(failure)

    async def _until_ordered(
        self, deadline: float | None, watching: asyncio.Task[None]
    ) -> Pending | StepFailedError | _Next | None:
        """Wait for an order, a failure that is not the end, or a restart; None at the deadline."""
        loop = asyncio.get_running_loop()
        while True:
            death = asyncio.ensure_future(self._process_monitor.next_death())
            order = asyncio.ensure_future(self._mailbox.arrives())
            due = asyncio.ensure_future(self._schedule.due())
            try:
                left = None if deadline is None else max(0.0, deadline - loop.time())
                waits: set[asyncio.Future[Any]] = {death, watching, order, due}
                await asyncio.wait(waits, timeout=left, return_when=asyncio.FIRST_COMPLETED)
                if watching.done():
                    watching.result()
                if not death.done():
                    if order.done():
                        return await self._mailbox.next()
                    if due.done():
                        return _Next.RESTART
                    return _Next.LET_THROUGH if watching.done() else None
                failure = death.result()
                if self._schedule.covers(failure):
                    return failure
                if not self._keep_going:
                    raise failure
                if failure.process:
                    self._schedule.write_off(failure.process)
                self._emit(failure.event(ends_run=False))
                await self._gate_sequence.end_left(self._gate_sequence.nodes_of(failure))
                self._judge.violations.count(failure.reason)
                self._system.touched.set()
            finally:
                await ended(death, order, due)
