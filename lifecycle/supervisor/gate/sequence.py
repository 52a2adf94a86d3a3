"""The gate sequence up to activation, and the orders that go through it: pause, resume, restart.

Owns: the one way from a connected to an active system: judge, permit, networks, activate, judge
again; the steps of each order; and `undiscovered`, which reads from a verdict which node was not
discovered over TCP although it runs, and is to be started again on a fresh port. What is active
stays so only as long as the gate that let it through; nothing is activated again before a new
verdict opens it again. Must not import rclpy.

Fast DDS 2.14 sometimes never uses a TCP connection that it has dialled: if the answer to its first
message arrives before the port inside the connection was noted, which happens when the dialling
thread loses its processor in between, the answer is ignored (BIND_CONNECTION_RESPONSE in
RTCPMessageManager::processRTCPMessage). Then nothing is sent that way for as long as both
participants live, and the dialled one takes no other connection from the same port. A participant
on another port is discovered by all from the beginning.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections import Counter
from collections.abc import Callable, Collection, Coroutine, Iterable, Mapping
from typing import Any

from lifecycle.errors import BringUpError
from lifecycle.node import Operation
from lifecycle.plan import Plan, PlanError, moving_nodes, restarted
from lifecycle.supervisor.control.orders import (
    ACTIVE,
    HELD,
    PAUSED,
    NotBegunError,
    Order,
    OrderKind,
    node_of,
)
from lifecycle.supervisor.control.protocol import ProcessState, Reach
from lifecycle.supervisor.gate.gate import Gate, Permit, VerificationError, behind_s, closes
from lifecycle.supervisor.gate.verification_loop import VerificationLoop
from lifecycle.supervisor.nodes.bring_up import BringUp
from lifecycle.supervisor.nodes.system import NodeRun, System
from lifecycle.supervisor.processes.process import Spawner
from lifecycle.supervisor.run.events import Emitter, GateOpened, Notice, SystemReached
from lifecycle.supervisor.run.failure import StepFailedError, together
from lifecycle.supervisor.run.shutdown import TakeDown
from lifecycle.verify import (
    MISSING_NODE,
    START_FAILED,
    About,
    Outcome,
    Stage,
    Verdict,
    not_ok,
    rule,
    taken_on_trust,
)

UNCHANGED_S = 5.0
"""Who is discovered at all over TCP is after 0.1–1.6 s, on a machine with both processors busy
after 1–4 s; findings that have not changed for so long do not change any more."""

TRIES = 3
"""So many nodes are started again before a gate at most: each takes 1–5 s of the bring-up."""


def undiscovered(
    verdict: Verdict, restartable: Collection[str], tries: Mapping[str, int]
) -> str | None:
    """Return the full name of the node to start again; None where that would mend nothing.

    Of two ends that do not match either may be the undiscovered one: it is who lacks most,
    then who was started again least often, then the last by name.

    Args:
        verdict: that keeps the gate closed.
        restartable: full names of nodes that get fresh ports when they are started again, and whose
            process is ours and holds no active node.
        tries: how often each was started again before.
    """
    violated = [each for each in verdict.findings if each.outcome is Outcome.VIOLATED]
    if not all(rule(each.rule).if_undiscovered for each in violated):
        return None
    missing = [each for each in violated if each.rule == MISSING_NODE.id]
    # Who is not there yet, or not so far, keeps others waiting that nothing is wrong with.
    coming = (each for each in violated if rule(each.rule).about is About.PROGRESS)
    awaited = {each.node for each in (*missing, *coming)}
    unmatched = (each for each in violated if rule(each.rule).about is About.MATCH)
    pairs = (each.ends for each in unmatched if awaited.isdisjoint(each.ends))
    lacks = Counter(
        name
        for names in (*pairs, *((each.node,) for each in missing))
        for name in names
        if name in restartable
    )
    return max(lacks, key=lambda name: (lacks[name], -tries.get(name, 0), name), default=None)


Alive = Callable[[Coroutine[Any, Any, object]], Coroutine[Any, Any, None]]
"""Runs a step; the unexpected end of any process ends it."""


class GateSequence:
    """Carries out orders on one system.

    Args:
        alive: see above.
        leaves: called with the names of processes that end because we want it, and `comes_back`
            once they are started again.
        forget: drops what a node reported before it was restarted.
        vanishes: waits, bounded, until the graph shows no node of this name.
        replanned: called with the names of nodes that the plan connects otherwise from now on.
        program: programs networks with the flows of a verdict within seconds, done when it returns.
        following: keeps looking at the nodes of others, and at ours that others may drive, for the
            length of its block.
        spawner: must be able to start processes before any is ended to be started again.
        timeout_s: for bringing up again what an order took down.

    Attributes:
        phase: as people read it; see orders.py and SystemStatus.
        trusted: what the gate last took on trust; empty if nothing.
    """

    def __init__(
        self,
        system: System,
        *,
        bring_up: BringUp,
        judge: VerificationLoop,
        gate: Gate,
        emit: Emitter,
        alive: Alive,
        leaves: Callable[[Iterable[str]], None],
        comes_back: Callable[[Iterable[str]], None],
        forget: Callable[[str], None],
        vanishes: Callable[[str], Coroutine[Any, Any, None]],
        replanned: Callable[[Iterable[str]], None],
        program: Callable[[Verdict, float], Coroutine[Any, Any, None]],
        spawner: Spawner,
        following: Callable[[], contextlib.AbstractAsyncContextManager[None]],
        hurry: asyncio.Event,
        timeout_s: float,
    ) -> None:
        self._spawner = spawner
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
        self._program = program
        self._following = following
        self._hurry = hurry
        self._timeout_s = timeout_s
        self.phase = "connecting"
        self.trusted = ""

    @property
    def stage(self) -> Stage:
        """What a held system is judged as."""
        return Stage.ACTIVE if self.phase == ACTIVE else Stage.CONNECTED

    async def carry_out(self, order: Order) -> None:
        """Carry out one order that fits the phase.

        Raises:
            NotBegunError: no process can be started now; the system is as it was.
            VerificationError: the gate stays closed, or closed again before every node was sent its
                request, and what had become active is inactive again. In phase PAUSED or HELD the
                system stays as it is and can be asked again; in any other the run is over.
            StepFailedError: a step failed, or a network could not be programmed; the run is over.
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
            nodes = self._with_process_of(node_of(order, self._system))
        try:
            await self._spawner.ready()
        except BringUpError as error:
            raise NotBegunError(
                f"cannot restart {order.node or self._system.plan.system!r}: {error.message}; "
                "everything stays as it is"
            ) from error
        self._gate.close()
        self.phase = "restarting"
        await self._again(nodes, self._timeout_s, order.plan if order.reload else None)
        self._emit(SystemReached(reached="connected", elapsed_s=self._emit.elapsed_s))
        if was_paused:
            self._reached(PAUSED)
        else:
            await self._through_the_gate()

    async def until_clear(self, timeout_s: float) -> None:
        """Judge a connected system until its gate may open, or stays closed; activate nothing.

        Nodes that were not discovered over TCP are started again on fresh ports, a few times.

        Args:
            timeout_s: seconds, for all of it.

        Raises:
            StepFailedError: a step of starting again failed.
        """
        loop = asyncio.get_running_loop()
        deadline = loop.time() + timeout_s
        tries: dict[str, int] = {}
        phase = self.phase
        while True:
            restartable = self._restartable() if sum(tries.values()) < TRIES else frozenset()
            unchanged_s = UNCHANGED_S if restartable else None
            left_s = deadline - loop.time()
            await self._alive(
                self._judge.until_clear(Stage.CONNECTED, left_s, unchanged_s=unchanged_s)
            )
            verdict = self._judge.latest
            assert verdict is not None
            if not restartable or not closes(verdict, strict=self._gate.strict):
                return
            name = undiscovered(verdict, restartable, tries)
            left_s = deadline - loop.time()
            if name is None and left_s > 0:
                # What keeps the gate closed may still heal by itself.
                await self._alive(self._judge.until_clear(Stage.CONNECTED, left_s))
            if name is None or left_s <= UNCHANGED_S:
                return
            tries[name] = tries.get(name, 0) + 1
            self._emit(
                Notice(
                    message=f"{name!r} is started again on a fresh port: not discovered over TCP "
                    f"for {UNCHANGED_S:g} s ({not_ok(verdict)}); "
                    f"try {sum(tries.values())} of {TRIES}"
                )
            )
            node = self._system.node_named(name)
            assert node is not None
            await self._again(self._with_process_of(node), left_s)
            self.phase = phase

    def _restartable(self) -> frozenset[str]:
        """Return the names of nodes that could be started again on fresh ports before the gate."""
        moving = moving_nodes(self._system.plan)
        active = {
            each.process for each in self._system.nodes.values() if each.reach is Reach.ACTIVE
        }
        return frozenset(
            each.name
            for key, each in self._system.nodes.items()
            if key in moving
            and each.process is not None
            and each.process.state is ProcessState.RUNNING
            and each.process not in active
        )

    def _with_process_of(self, node: NodeRun) -> tuple[NodeRun, ...]:
        return tuple(each for each in self._system.nodes.values() if each.process is node.process)

    async def _again(
        self, nodes: tuple[NodeRun, ...], timeout_s: float, plan: Plan | None = None
    ) -> None:
        """Take nodes down with all of their processes, and bring them up as far as connected.

        Args:
            nodes: with all of their processes.
            timeout_s: seconds, for bringing them up.
            plan: another manifest's, to be taken meanwhile; None to keep this one.
        """
        names = {each.process.name for each in nodes if each.process is not None}
        self._leaves(names)
        await TakeDown(self._system, self._emit, self._hurry, nodes=nodes).run()
        # A participant that was killed haunts the graph; who comes back would be taken for two.
        gone = [each.name for each in nodes if each.process is not None]
        for node in nodes:
            self._forget(node.name)
        if plan is not None:
            nodes = self._reload(plan, nodes)
        else:
            self._replan(nodes)
            self._system.renew(nodes)
        self._comes_back(names)
        await self._alive(together(self._vanishes(name) for name in gone))
        self.phase = "connecting"
        self._judge.ahead = self._active()
        await self._alive(self._bring_up.connect(timeout_s, nodes))

    def _reload(self, plan: Plan, nodes: tuple[NodeRun, ...]) -> tuple[NodeRun, ...]:
        """Take another manifest's plan for nodes that are down; return those to bring up."""
        names = {each.name for each in nodes}
        fresh = self._system.reload(plan, plan.processes, nodes)
        self._replanned(names | {each.name for each in fresh})
        return fresh

    def _replan(self, nodes: Iterable[NodeRun]) -> None:
        """Connect nodes that come again so that those who stay find them."""
        system = self._system
        reported = {
            each.name: {report.name: report.urls for report in each.connections}
            for each in self._judge.seen.configurations
            if system.node_named(each.name) is None
        }
        keys = {each.planned.key for each in nodes}
        try:
            plan = restarted(system.plan, keys, first=system.first, reported=reported)
        except PlanError as error:
            raise StepFailedError(
                error.message, rule=START_FAILED, subject=system.plan.system
            ) from error
        system.replan(plan)
        self._replanned(each.name for each in nodes)

    async def verify(self, timeout_s: float) -> Permit:
        """Judge the system as it is until its gate opens; activate nothing.

        Args:
            timeout_s: seconds, for all of it.

        Raises:
            StepFailedError: as for `until_clear`.
            VerificationError: the gate stays closed.
        """
        self._gate.close()
        self.phase = "verifying"
        self._judge.ahead = self._active()
        await self.until_clear(timeout_s)
        assert self._judge.latest is not None
        permit = self._gate.judge(self._judge.latest)
        self.trusted = taken_on_trust(permit.verdict)
        self._emit(SystemReached(reached="verified", elapsed_s=self._emit.elapsed_s))
        return permit

    async def activate(self, permit: Permit, deadline: float) -> None:
        """Program networks, activate what is not active, and judge what it has become.

        Args:
            permit: of `verify`.
            deadline: of all of it, by the running loop's clock, see `behind_s`.

        Raises:
            StepFailedError: a step failed, or a network could not be programmed.
            VerificationError: what changed meanwhile closed the gate for all that were not sent
                their requests (`again`), or what became active is not what was verified.
        """
        # What comes again sends from other ports: their rules come before its first message.
        await self._alive(self._program_flows(permit, deadline))
        self.trusted = taken_on_trust(permit.verdict)
        self.phase = "activating"
        waiting = self._inactive()
        self._emit(
            GateOpened(
                outcome=permit.verdict.verdict.value,
                nodes=tuple(each.name for each in waiting),
                trusted=self.trusted,
            )
        )
        async with self._following():
            await self._alive(self._bring_up.activate(permit, behind_s(deadline), waiting))
        self._judge.ahead = frozenset()
        await self._alive(self._judge.until_clear(Stage.ACTIVE, behind_s(deadline)))
        # The same question as at the gate: what became active must be what was verified.
        assert self._judge.latest is not None
        self._gate.judge(self._judge.latest)
        self._reached(ACTIVE)

    async def _through_the_gate(self) -> None:
        """Judge the system as it is, and activate what is not active."""
        deadline = asyncio.get_running_loop().time() + self._timeout_s
        before = PAUSED if self.phase == PAUSED else HELD
        try:
            permit = await self.verify(self._timeout_s)
        except VerificationError:
            # What is active was verified before; what is not stays inactive until asked again.
            self.phase = before
            raise
        try:
            await self.activate(permit, deadline)
        except VerificationError as error:
            if error.again:
                if self.phase == "activating":
                    await self._withdraw(permit)
                self.phase = before
            raise

    async def _withdraw(self, permit: Permit) -> None:
        """Deactivate again what was activated since the gate opened: the rest may not follow."""
        begun = tuple(each for each in self._system.nodes.values() if each.name in permit.sent)
        for each in self._inactive():
            if each not in begun:
                each.undo = [one for one in each.undo if one is not Operation.ACTIVATE]
        if begun:
            names = ", ".join(each.name for each in begun)
            self._emit(Notice(message=f"the gate closed again: {names} is deactivated"))
        await self._alive(self._bring_up.deactivate(begun))
        self._judge.ahead = self._active()

    async def _program_flows(self, permit: Permit, deadline: float) -> None:
        """Program networks with the flows of the verdict that nodes are activated on."""
        programmed = None
        while permit.verdict.flows != programmed:
            programmed = permit.verdict.flows
            await self._program(permit.verdict, behind_s(deadline))
            # A network may take seconds: what changed meanwhile is judged before the gate opens.
            await permit.renewed()

    def _inactive(self) -> tuple[NodeRun, ...]:
        return tuple(
            each
            for each in self._system.nodes.values()
            if each.is_to_be_active and each.reach is not Reach.ACTIVE
        )

    def _active(self) -> frozenset[str]:
        return frozenset(
            each.name
            for each in self._system.nodes.values()
            if each.planned.holds and each.reach is Reach.ACTIVE
        )

    def _reached(self, phase: str) -> None:
        self.phase = phase
        self._emit(SystemReached(reached=phase, elapsed_s=self._emit.elapsed_s))
