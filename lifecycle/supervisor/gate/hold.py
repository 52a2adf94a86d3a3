"""Holds a system that is up: judges it at every change, and carries out orders.

Owns: `Watch`, which judges again and again, and `Holding`: for how long, what ends it, and how
orders (pause, resume, restart) are received and answered. What an order does is sequence.py's. Must
not import rclpy.
"""

from __future__ import annotations

import asyncio
import dataclasses
from collections.abc import Awaitable, Callable
from typing import Any

from lifecycle.errors import UsageError
from lifecycle.supervisor.control.orders import (
    HELD,
    PAUSED,
    Done,
    Mailbox,
    NotBegunError,
    Order,
    Pending,
    Revisions,
    check_order,
)
from lifecycle.supervisor.gate.gate import VerificationError
from lifecycle.supervisor.gate.sequence import GateSequence
from lifecycle.supervisor.gate.verification_loop import SETTLED_S, ChangeCounter, VerificationLoop
from lifecycle.supervisor.health.process_monitor import ProcessMonitor
from lifecycle.supervisor.nodes.system import System
from lifecycle.supervisor.run.events import Emitter, Notice
from lifecycle.supervisor.run.failure import StepFailedError, ended
from lifecycle.verify import Outcome, Stage, not_ok


class Watch:
    """Judges a system again and again while it is held.

    Attributes:
        violated: what was seen violated for longer than a passing moment; empty if nothing was.
    """

    def __init__(self, judge: VerificationLoop, changes: ChangeCounter, stage: Stage) -> None:
        self._judge = judge
        self._changes = changes
        self._stage = stage
        self.violated = ""

    async def run(self) -> None:
        """Judge at every change, until cancelled."""
        while True:
            count = self._changes.count
            verdict, again_s = await self._judge.settled(self._stage)
            bad = verdict.verdict is Outcome.VIOLATED and not self.violated
            wait_s = SETTLED_S if again_s is None and bad else again_s
            if await self._changes.beyond(count, wait_s):
                await self._judge.quiet()
            elif again_s is None:
                self.violated = not_ok(verdict) or verdict.verdict.value  # no change: it lasts


class Holding:
    """The hold phase of one run.

    Args:
        system: what is held.
        judge: judges it at every change.
        changes: what it waits for.
        gate_sequence: carries out orders, and knows the phase.
        revisions: knows which manifest runs.
        process_monitor: notices processes that end.
        emit: where events go.
        note_segments: called when processes may be new.
        keep_going: a process that ends is reported, and does not end the run.
    """

    def __init__(
        self,
        system: System,
        *,
        judge: VerificationLoop,
        changes: ChangeCounter,
        gate_sequence: GateSequence,
        revisions: Revisions,
        process_monitor: ProcessMonitor,
        emit: Emitter,
        note_segments: Callable[[], Awaitable[None]],
        keep_going: bool,
    ) -> None:
        self._system = system
        self._judge = judge
        self._changes = changes
        self._gate_sequence = gate_sequence
        self._revisions = revisions
        self._process_monitor = process_monitor
        self._emit = emit
        self._note_segments = note_segments
        self._keep_going = keep_going
        self._mailbox = Mailbox()
        self._violated = ""

    async def hold(self, stage: Stage, hold_s: float | None) -> str:
        """Keep the system as it is, or as it is ordered; return what was violated, else nothing.

        Args:
            stage: what it has reached; a violation counts only of an active system, and only if it
                lasted for longer than a passing moment.
            hold_s: seconds, ≥ 0; None for ever.

        Raises:
            StepFailedError: a process ended, or an order failed.
            VerificationError: an order could not be carried out behind the gate.
        """
        await self._note_segments()
        deadline = None if hold_s is None else asyncio.get_running_loop().time() + hold_s
        while True:
            watch = Watch(self._judge, self._changes, stage)
            watching = asyncio.ensure_future(watch.run())
            try:
                pending = await self._until_ordered(deadline, watching)
            finally:
                await ended(watching)
            if stage is Stage.ACTIVE:
                self._violated = self._violated or watch.violated
            if pending is None:
                return self._violated
            await self._carry_out(pending)
            stage = self._gate_sequence.stage

    async def ordered(self, order: Order) -> Done:
        """Take an order from outside, if it fits what the system is doing; return its outcome."""
        try:
            self._check(order)
        except UsageError as error:
            return Done(exit_code=error.exit_code, error=str(error))
        return await self._mailbox.place(order)

    def _check(self, order: Order) -> None:
        check_order(order, self._system, self._gate_sequence.phase)
        self._revisions.check(order)

    def close(self, reason: str) -> None:
        """Answer every order that is still open, and those to come, with `reason`."""
        self._mailbox.close(reason)

    async def _carry_out(self, pending: Pending) -> None:
        """Carry an order out and report to its client; what ends the run is raised."""
        try:
            # Another order may have come first.
            self._check(pending.order)
            if self._revisions.takes(pending.order):
                assert pending.order.plan is not None
                for line in self._revisions.differences(pending.order.plan):
                    self._emit(Notice(message=f"takes the changed manifest: {line}"))
            else:
                pending.order = dataclasses.replace(pending.order, plan=None, reload=False)
            await self._gate_sequence.carry_out(pending.order)
            await self._note_segments()
        except (UsageError, NotBegunError) as error:
            pending.finish(Done(exit_code=error.exit_code, error=str(error)))
        except (VerificationError, StepFailedError) as error:
            pending.finish(Done(exit_code=error.exit_code, error=str(error)))
            held = self._gate_sequence.phase in (PAUSED, HELD)
            if not held or not isinstance(error, VerificationError):
                raise
            self._emit(Notice(message=str(error)))
        else:
            pending.finish(Done())

    async def _until_ordered(
        self, deadline: float | None, watching: asyncio.Task[None]
    ) -> Pending | None:
        """Wait for an order; None once the time is over."""
        loop = asyncio.get_running_loop()
        while True:
            death = asyncio.ensure_future(self._process_monitor.next_death())
            order = asyncio.ensure_future(self._mailbox.next())
            try:
                left = None if deadline is None else max(0.0, deadline - loop.time())
                waits: set[asyncio.Future[Any]] = {death, watching, order}
                await asyncio.wait(waits, timeout=left, return_when=asyncio.FIRST_COMPLETED)
                if watching.done():
                    watching.result()
                if not death.done():
                    return order.result() if order.done() else None
                failure = death.result()
                if not self._keep_going:
                    raise failure
                self._emit(failure.event(ends_run=False))
                self._violated = self._violated or failure.reason
                self._system.touched.set()
            finally:
                await ended(death, order)
