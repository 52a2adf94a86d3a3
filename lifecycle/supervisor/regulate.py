"""Pausing, resuming and restarting a system that is up, always through the gate.

Owns: the steps of each order. What is active stays so only as long as the gate that let it through;
nothing is activated again before a new verdict opens the gate again. Must not import rclpy.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine, Iterable
from typing import Any

from lifecycle.plan import PlanError, restarted
from lifecycle.supervisor.bring_up import BringUp
from lifecycle.supervisor.events import Emitter, GateOpened, Reach, SystemReached
from lifecycle.supervisor.failure import START_FAILED, StepFailedError
from lifecycle.supervisor.gate import Gate, VerificationError
from lifecycle.supervisor.judge import Judge
from lifecycle.supervisor.orders import ACTIVE, HELD, PAUSED, Order, OrderKind, node_of
from lifecycle.supervisor.shutdown import TakeDown
from lifecycle.supervisor.system import NodeRun, System
from lifecycle.supervisor.together import together
from lifecycle.verify.verdict import Stage

Alive = Callable[[Coroutine[Any, Any, object]], Coroutine[Any, Any, None]]
"""Runs a step; the unexpected end of any process ends it."""


class Regulator:
    """Carries out orders on one system.

    Args:
        alive: see above.
        leaves: told the names of processes that end because we want it, and `comes_back` once
            they are started anew.
        forget: drops what a node reported before it was restarted.
        vanishes: waits, bounded, until the graph shows no node of this name.
        replanned: told the names of nodes that the plan connects otherwise from now on.
        timeout_s: for bringing up again what an order took down.

    Attributes:
        phase: as people read it; see orders.py and SystemStatus.
    """

    def __init__(
        self,
        system: System,
        *,
        bring_up: BringUp,
        judge: Judge,
        gate: Gate,
        emit: Emitter,
        alive: Alive,
        leaves: Callable[[Iterable[str]], None],
        comes_back: Callable[[Iterable[str]], None],
        forget: Callable[[str], None],
        vanishes: Callable[[str], Coroutine[Any, Any, None]],
        replanned: Callable[[Iterable[str]], None],
        hurry: asyncio.Event,
        timeout_s: float,
    ) -> None:
        self._system = system
        self._bring_up = bring_up
        self._judge = judge
        self._gate = gate
        self._emit = emit
        self._alive = alive
        self._leaves = leaves
        self._comes_back = comes_back
        self._forget = forget
        self._vanishes = vanishes
        self._replanned = replanned
        self._hurry = hurry
        self._timeout_s = timeout_s
        self.phase = "connecting"

    @property
    def stage(self) -> Stage:
        """What a held system is judged as."""
        return Stage.ACTIVE if self.phase == ACTIVE else Stage.CONNECTED

    async def carry_out(self, order: Order) -> None:
        """Carry out one order that fits the phase.

        Raises:
            VerificationError: the gate stays closed. In phase PAUSED or HELD the system stays as
                it is and can be asked again; in any other the run is over.
            StepFailedError: a step failed; the run is over.
        """
        if order.kind is OrderKind.PAUSE:
            await self._pause()
        elif order.kind is OrderKind.RESUME:
            await self._through_the_gate()
        else:
            await self._restart(order)

    async def _pause(self) -> None:
        self._gate.close()
        self.phase = "pausing"
        await self._alive(self._bring_up.deactivate())
        self._judge.ahead = frozenset()
        self._reached(PAUSED)

    async def _restart(self, order: Order) -> None:
        """Take one process or all down, and bring it up as far as the system was."""
        was_paused = self.phase == PAUSED
        nodes = tuple(self._system.nodes.values())
        if order.node:
            process = node_of(order, self._system).process
            nodes = tuple(each for each in nodes if each.process is process)
        names = {each.process.name for each in nodes if each.process is not None}
        self._gate.close()
        self.phase = "restarting"
        self._leaves(names)
        await TakeDown(self._system, self._emit, self._hurry, nodes=nodes).run()
        self._replan(nodes)
        self._system.renew(nodes)
        for node in nodes:
            self._forget(node.name)
        self._comes_back(names)
        # A participant that was killed haunts the graph; who comes back would be taken for two.
        gone = [each.name for each in nodes if each.process is not None]
        await self._alive(together(self._vanishes(name) for name in gone))
        self.phase = "connecting"
        self._judge.ahead = self._active()
        await self._alive(self._bring_up.connect(self._timeout_s, nodes))
        self._emit(SystemReached(reached="connected", elapsed_s=self._emit.elapsed_s))
        if was_paused:
            self._reached(PAUSED)
        else:
            await self._through_the_gate()

    def _replan(self, nodes: Iterable[NodeRun]) -> None:
        """Connect nodes that come again so that those who stay find them."""
        system = self._system
        heard = {
            each.name: {report.name: report.urls for report in each.connections}
            for each in self._judge.seen.configurations
            if system.node_named(each.name) is None
        }
        keys = {each.planned.key for each in nodes}
        try:
            plan = restarted(system.plan, keys, first=system.first, heard=heard)
        except PlanError as error:
            raise StepFailedError(
                error.message, rule=START_FAILED, subject=system.plan.system
            ) from error
        system.replan(plan)
        self._replanned(each.name for each in nodes)

    async def _through_the_gate(self) -> None:
        """Judge the system as it stands, and activate what is not active."""
        loop = asyncio.get_running_loop()
        deadline = loop.time() + self._timeout_s
        before = PAUSED if self.phase == PAUSED else HELD
        self._gate.close()
        self.phase = "verifying"
        self._judge.ahead = self._active()
        await self._alive(self._judge.until_clear(Stage.CONNECTED, self._timeout_s))
        assert self._judge.latest is not None
        try:
            permit = self._gate.judge(self._judge.latest)
        except VerificationError:
            # What is active was verified before; what is not stays inactive until asked again.
            self.phase = before
            raise
        self._emit(SystemReached(reached="verified", elapsed_s=self._emit.elapsed_s))
        waiting = tuple(
            each
            for each in self._system.nodes.values()
            if each.planned.managed and each.reach is not Reach.ACTIVE
        )
        self.phase = "activating"
        self._emit(
            GateOpened(
                outcome=permit.verdict.verdict.value, nodes=tuple(each.name for each in waiting)
            )
        )
        await self._alive(self._bring_up.activate(permit, deadline - loop.time(), waiting))
        self._judge.ahead = frozenset()
        await self._alive(self._judge.until_clear(Stage.ACTIVE, deadline - loop.time()))
        # The same question as at the gate: what became active must be what was verified.
        self._gate.judge(self._judge.latest)
        self._reached(ACTIVE)

    def _active(self) -> frozenset[str]:
        return frozenset(
            each.name
            for each in self._system.nodes.values()
            if each.planned.managed and each.reach is Reach.ACTIVE
        )

    def _reached(self, phase: str) -> None:
        self.phase = phase
        self._emit(SystemReached(reached=phase, elapsed_s=self._emit.elapsed_s))
