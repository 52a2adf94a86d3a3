"""Applies another manifest to a running system, through the gate, or goes back to the one before.

Owns: `Applying`: the order of what is done (parameters set, nodes taken down, the plan taken, nodes
brought up, the whole verified, activated), and the way back from each of these steps. What becomes
of which node is `plan.change_between`'s, whether the supervisor can take the manifest at all
control/orders.py's, and each step sequence.py's, as for an order that a person gives. What is not
touched stays active meanwhile. Must not import rclpy.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Collection, Coroutine, Mapping
from typing import TYPE_CHECKING, Any

import msgspec
from msgspec.structs import replace

from lifecycle.errors import BringUpError, MiddlewareError, UsageError
from lifecycle.manifest.model import Condition
from lifecycle.plan.change import GivenParameters, PlanChange
from lifecycle.plan.model import Plan
from lifecycle.supervisor.control.orders import (
    ACTIVE,
    HELD,
    PAUSED,
    NotBegunError,
    Order,
    RolledBackError,
    said,
)
from lifecycle.supervisor.control.protocol import Reach
from lifecycle.supervisor.gate.gate import Gate, Permit, VerificationError
from lifecycle.supervisor.gate.verification_loop import VerificationLoop
from lifecycle.supervisor.nodes.bring_up import BringUp
from lifecycle.supervisor.nodes.system import NodeRun, System
from lifecycle.supervisor.policy.schedule import RestartSchedule
from lifecycle.supervisor.run.events import Emitter, ManifestApplied, Notice, SystemReached
from lifecycle.supervisor.run.failure import StepFailedError, together
from lifecycle.verify.judge import not_ok
from lifecycle.verify.rules.run import PROCESS_DIED
from lifecycle.verify.verdict import Stage

if TYPE_CHECKING:
    from lifecycle.middleware.services.clients import NodeClients
    from lifecycle.supervisor.gate.sequence import GateSequence
    from lifecycle.supervisor.processes.fork_server import ForkServer

Alive = Callable[[Coroutine[Any, Any, object]], Coroutine[Any, Any, None]]
"""Runs a step; the unexpected end of any process ends it."""

_LEAST_S = 1.0


class _Before(msgspec.Struct, frozen=True, kw_only=True):
    """What a system was before another manifest was applied.

    Attributes:
        other: path of that manifest.
        active: keys of the nodes that were active, or had failed and were to be again.
    """

    other: str
    first: Plan
    revision: int
    mode: str
    phase: str
    active: frozenset[str]


class _Done(msgspec.Struct):
    """What was done of a change so far.

    Attributes:
        touched: keys of the nodes that were taken down, or are new.
        given: by key, parameters that a running node has taken.
        asked: likewise that it was asked to take; who did not answer may have taken them.
    """

    touched: set[str] = msgspec.field(default_factory=set)
    given: dict[str, GivenParameters] = msgspec.field(default_factory=dict)
    asked: dict[str, GivenParameters] = msgspec.field(default_factory=dict)


class Applying:
    """Applies manifests to one system.

    Args:
        sequence: takes down, brings up, verifies and activates; has the phase.
        clients: of running nodes' parameters.
        timeout_s: for becoming active by the other manifest, and for going back.
    """

    def __init__(
        self,
        sequence: GateSequence,
        *,
        system: System,
        bring_up: BringUp,
        schedule: RestartSchedule,
        gate: Gate,
        judge: VerificationLoop,
        emit: Emitter,
        alive: Alive,
        clients: NodeClients,
        spawner: ForkServer,
        timeout_s: float,
    ) -> None:
        self._sequence = sequence
        self._system = system
        self._bring_up = bring_up
        self._schedule = schedule
        self._gate = gate
        self._judge = judge
        self._emit = emit
        self._alive = alive
        self._clients = clients
        self._spawner = spawner
        self._timeout_s = timeout_s

    async def apply(self, order: Order) -> None:
        """Have the system run by another manifest, or by the one before as if nothing had been.

        Raises:
            NotBegunError: no process can be started now; the system is as it was.
            RolledBackError: it could not become active and verified by the other manifest.
        """
        plan, change, system = order.plan, order.change, self._system
        assert plan is not None
        assert change is not None
        failed = {
            key
            for key, each in system.nodes.items()
            if each.name in self._schedule.down or (each.process is not None and each.process.died)
        }
        change = _with_restarted(change, failed & {each.key for each in plan.nodes}, system)
        if change.ends_or_starts:
            try:
                await self._spawner.ready()
            except (BringUpError, UsageError) as error:
                raise NotBegunError(
                    f"cannot apply {plan.manifest_path}: {error}; everything stays as it is"
                ) from error
        there = self._sequence.active()
        active = frozenset(
            key
            for key, each in system.nodes.items()
            if each.name in there or (key in failed and not each.withheld)
        )
        before = _Before(
            other=plan.manifest_path,
            first=system.first,
            revision=system.revision,
            mode=system.mode,
            phase=self._sequence.phase,
            active=active,
        )
        done = _Done()
        timeout_s = order.timeout_s or self._timeout_s
        self._gate.close()
        self._sequence.phase = _APPLYING
        self._say("begun", plan, before, change)
        try:
            await self._go_on(plan, change, before, done, timeout_s)
        except (StepFailedError, VerificationError) as error:
            self._say("rolling_back", plan, before, reason=_every(error))
            state = await self._go_back(before, done, error)
            self._say("rolled_back", plan, before, reason=_every(error))
            raise RolledBackError(
                f"cannot apply {plan.manifest_path}: {_every(error)}\n{state}", error.exit_code
            ) from error
        self._say("applied", plan, before, change)

    async def _go_on(
        self, plan: Plan, change: PlanChange, before: _Before, done: _Done, timeout_s: float
    ) -> None:
        deadline = asyncio.get_running_loop().time() + timeout_s
        refused = await self._give(change.parameters, done)
        keys = {*change.removed, *change.restarted, *refused}
        done.touched.update(change.added)
        await self._take(plan, self._whole(keys), done)
        await self._alive(self._bring_up.deactivate(self._no_longer_active()))
        await self._sequence.connect_unfinished(_left_s(deadline))
        if done.touched:
            self._emit(SystemReached(reached="connected", elapsed_s=self._emit.elapsed_s))
        permit = await self._verify(deadline)
        if before.phase == PAUSED:
            self._sequence.reached(PAUSED)
        elif self._sequence.inactive():
            await self._activate(permit, deadline)
        else:
            # Nothing is to be activated; networks may get other rules for the flows that are there.
            await self._alive(self._sequence.program_flows(permit, deadline))
            await self._sequence.confirm(deadline)
            self._sequence.reached(ACTIVE)

    async def _verify(self, deadline: float) -> Permit:
        """Judge the system until its gate opens; not while its nodes are still being connected."""
        while True:
            await self._alive(self._judge.reconciled(Stage.CONNECTED, _left_s(deadline)))
            try:
                return await self._sequence.verify(_left_s(deadline))
            except VerificationError:
                # What was negotiated may have changed once more meanwhile.
                late = asyncio.get_running_loop().time() >= deadline
                if late or not self._judge.is_reconciling:
                    raise

    async def _activate(
        self, permit: Permit, deadline: float, nodes: tuple[NodeRun, ...] | None = None
    ) -> None:
        try:
            await self._sequence.activate(permit, deadline, nodes)
        except VerificationError as error:
            if error.again:
                await self._sequence.withdraw(permit)
            raise

    async def _go_back(
        self, before: _Before, done: _Done, error: StepFailedError | VerificationError
    ) -> str:
        """Have the system run by the manifest before; say what it is then.

        Raises:
            RolledBackError: it is not: the run ends.
        """
        self._gate.close()
        self._sequence.phase = _BACK
        try:
            how = await self._restore(before, done, self._of_others(error, done))
        except StepFailedError as failure:
            return await self._by_policy(before, error, failure)
        except VerificationError as closed:
            self._sequence.phase = self._phase_of(before)
            return self._in_force(before, f"but {_closed(closed, self._sequence.phase)}")
        return self._in_force(before, how)

    async def _by_policy(
        self,
        before: _Before,
        error: StepFailedError | VerificationError,
        failure: StepFailedError,
    ) -> str:
        """Leave to policy what fails while the system goes back; it ends the run, or is restarted.

        Raises:
            RolledBackError: it ends the run.
        """
        self._sequence.phase = HELD if before.phase in (ACTIVE, HELD) else before.phase
        try:
            unfinished = {key for key, each in self._system.nodes.items() if not each.is_up}
            await self._sequence.put_down(failure)
        except StepFailedError as ends:
            raise RolledBackError(
                f"cannot apply {before.other}: {_every(error)}\n"
                f"cannot go back to {before.first.manifest_path}: {_every(ends)}; the system is "
                "taken down",
                ends.exit_code,
                ends,
            ) from ends
        waiting = {
            key
            for key in unfinished
            if key in self._system.nodes and self._system.nodes[key].name not in self._schedule.down
        }
        self._schedule.again(waiting)
        # Nodes that are up again and wait at the gate are activated with those that restart.
        self._schedule.wait_at_gate(
            each.planned.key
            for each in self._sequence.inactive()
            if each.planned.key in before.active
        )
        return self._in_force(
            before, f"and what failed meanwhile is started again as its policy says: {failure}"
        )

    async def _restore(self, before: _Before, done: _Done, others: StepFailedError | None) -> str:
        """Undo what was done; bring up what is down, verify, and activate what was active."""
        system, sequence = self._system, self._sequence
        deadline = asyncio.get_running_loop().time() + self._timeout_s
        given = {
            key: replace(each, before=each.now, now=each.before)
            for key, each in done.asked.items()
            if key not in done.touched and not system.nodes[key].is_gone
        }
        back = _Done()
        try:
            await self._give(given, back)
        except StepFailedError as failure:
            others = others or failure
        keys = {*done.touched, *(given.keys() - back.given.keys()), *sequence.interrupted()}
        await self._take(before.first, self._whole(keys), back, before)
        if others is not None:
            raise others
        await self._alive(
            self._bring_up.deactivate(
                each
                for key, each in system.nodes.items()
                if each.planned.holds and each.reach is Reach.ACTIVE and key not in before.active
            )
        )
        await sequence.connect_unfinished(_left_s(deadline))
        permit = await self._verify(deadline)
        if before.phase == PAUSED:
            sequence.reached(PAUSED)
            return "paused and verified"
        waiting = self._waiting(before.active)
        if waiting:
            await self._activate(permit, deadline, waiting)
        else:
            await self._alive(sequence.program_flows(permit, deadline))
        if sequence.inactive():
            sequence.phase = HELD
            return "verified, and held as before: lifecycle resume"
        if not waiting:
            await sequence.confirm(deadline)
        sequence.reached(ACTIVE)
        return "active and verified"

    async def _take(
        self, plan: Plan, down: tuple[NodeRun, ...], done: _Done, before: _Before | None = None
    ) -> None:
        """Take nodes down and the plan in force; what is new or down is brought up later."""
        keys = {each.planned.key for each in down}
        self._schedule.by_hand(keys)
        done.touched |= keys
        await self._sequence.take_down(down)
        if before is not None:
            self._system.mode = before.mode
        await self._sequence.begin_again(down, plan, None if before is None else before.revision)
        self._judge.ahead = self._sequence.active()
        self._system.touched.set()

    async def _give(self, parameters: Mapping[str, GivenParameters], done: _Done) -> set[str]:
        """Set parameters of running nodes; return the keys of those that refuse them."""
        refused = set()

        async def give(key: str, values: GivenParameters) -> None:
            node = self._system.nodes[key]
            done.asked[key] = values
            try:
                await self._clients.set_parameters(node.name, values.now, values.types)
            except MiddlewareError as error:
                self._emit(Notice(message=f"{error.message}; it is started again"))
                refused.add(key)
            else:
                done.given[key] = values

        there = {
            key: each
            for key, each in parameters.items()
            if key in self._system.nodes and self._system.nodes[key].is_up
        }
        await self._alive(together(give(key, each) for key, each in there.items()))
        return refused

    def _whole(self, keys: Collection[str]) -> tuple[NodeRun, ...]:
        """Return nodes with all that comes and goes with them."""
        nodes = self._system.nodes
        found = {
            each.planned.key
            for key in keys
            if key in nodes
            for each in self._sequence.with_process_of(nodes[key])
        }
        return tuple(each for key, each in nodes.items() if key in found)

    def _no_longer_active(self) -> tuple[NodeRun, ...]:
        return tuple(
            each
            for each in self._system.nodes.values()
            if each.planned.holds and each.reach is Reach.ACTIVE and not each.is_to_be_active
        )

    def _waiting(self, keys: Collection[str]) -> tuple[NodeRun, ...]:
        """Return those of some inactive nodes that wait for none which stays inactive."""
        nodes = self._system.nodes
        found = {
            each.planned.key: each for each in self._sequence.inactive() if each.planned.key in keys
        }
        while stuck := [
            key
            for key, each in found.items()
            if any(
                after.condition is Condition.ACTIVE
                and after.node in nodes
                and after.node not in found
                and not nodes[after.node].has_reached(Condition.ACTIVE)
                for after in each.planned.after
            )
        ]:
            for key in stuck:
                del found[key]
        return tuple(found.values())

    def _of_others(
        self, error: StepFailedError | VerificationError, done: _Done
    ) -> StepFailedError | None:
        """Return what failed of nodes that were not touched; None if nothing did."""
        if not isinstance(error, StepFailedError):
            return None
        server = self._system.server
        found = []
        for each in error.every:
            process = self._system.processes.get(each.process)
            node = self._system.node_named(each.subject)
            if process is not None:
                is_other = process.is_gone and done.touched.isdisjoint(process.planned.nodes)
            elif server is not None and each.process == server.name:
                is_other = True
            else:
                is_other = each.rule is PROCESS_DIED and (
                    node is not None and node.planned.key not in done.touched
                )
            if is_other:
                found.append(each)
        return found[0].joined(found[1:]) if found else None

    def _phase_of(self, before: _Before) -> str:
        if before.phase == PAUSED:
            return PAUSED
        return HELD if self._sequence.inactive() else ACTIVE

    def _in_force(self, before: _Before, how: str) -> str:
        return f"{before.first.manifest_path} is in force again, revision {before.revision}, {how}"

    def _say(
        self,
        stage: str,
        plan: Plan,
        before: _Before,
        change: PlanChange | None = None,
        *,
        reason: str = "",
    ) -> None:
        revision = self._system.revision
        event = ManifestApplied(
            stage=stage, manifest=plan.manifest_path, revision=revision, reason=reason
        )
        if change is not None:
            words = said(change, before.first, plan, revision)
            event = replace(
                event,
                differences=words.differences,
                added=words.added,
                removed=words.removed,
                restarted=words.restarted,
                parameters=words.parameters,
            )
        self._emit(event)


_APPLYING = "applying"
_BACK = "rolling back"


def _with_restarted(change: PlanChange, keys: Collection[str], system: System) -> PlanChange:
    """Return a change in which nodes are started again that have failed and are down."""
    restarted = {*change.restarted, *keys}
    return replace(
        change,
        restarted=tuple(key for key in system.nodes if key in restarted),
        parameters={key: each for key, each in change.parameters.items() if key not in restarted},
    )


def _left_s(deadline: float) -> float:
    return max(_LEAST_S, deadline - asyncio.get_running_loop().time())


def _every(error: StepFailedError | VerificationError) -> str:
    if isinstance(error, VerificationError):
        return str(error)
    return "; ".join(str(each) for each in error.every)


def _closed(error: VerificationError, phase: str) -> str:
    how = f"its verdict is {error.verdict.verdict.value}: {not_ok(error.verdict)}"
    return f"{how}; it is {phase}" + (": lifecycle resume" if phase != ACTIVE else "")
