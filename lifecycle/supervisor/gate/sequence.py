"""The gate sequence up to activation, and the orders by it: pause, resume, restart, mode, apply.

Owns: the one way from a connected to an active system: judge, permit, networks, activate, judge
again; the steps of each order, given by a person or by policy; and `undiscovered`, which reads from
a verdict which node was not discovered over TCP although it runs, and is to be started again on a
fresh port. What is active stays so only as long as the gate that let it through; nothing is
activated again before a new verdict opens it again. Must not import rclpy.

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
from collections.abc import AsyncIterator, Callable, Collection, Coroutine, Iterable, Mapping
from typing import TYPE_CHECKING, Any

from lifecycle.errors import BringUpError
from lifecycle.manifest.model import TargetState
from lifecycle.node.host.control import Operation
from lifecycle.plan.model import Plan, PlanError
from lifecycle.plan.restart import moving_nodes, restarted
from lifecycle.supervisor.control.orders import (
    ACTIVE,
    HELD,
    PAUSED,
    NotBegunError,
    Order,
    node_of,
)
from lifecycle.supervisor.control.protocol import ControlRequest, ProcessState, Reach
from lifecycle.supervisor.gate.applying import Applying
from lifecycle.supervisor.gate.gate import (
    Gate,
    Permit,
    VerificationError,
    behind_s,
    closes,
)
from lifecycle.supervisor.gate.verification_loop import VerificationLoop
from lifecycle.supervisor.nodes.bring_up import BringUp
from lifecycle.supervisor.nodes.system import NodeRun, System
from lifecycle.supervisor.policy.schedule import RestartSchedule
from lifecycle.supervisor.run.events import Emitter, GateOpened, ModeEntered, Notice, SystemReached
from lifecycle.supervisor.run.failure import StepFailedError, ended, failure_of, together
from lifecycle.supervisor.run.shutdown import TakeDown
from lifecycle.verify.judge import not_ok, taken_on_trust
from lifecycle.verify.outcome import Outcome
from lifecycle.verify.rules import rule
from lifecycle.verify.rules.catalogue import About
from lifecycle.verify.rules.nodes import MISSING_NODE
from lifecycle.verify.rules.run import START_FAILED, TRANSITION_FAILED
from lifecycle.verify.verdict import Stage, Verdict

if TYPE_CHECKING:
    from lifecycle.middleware.services.clients import NodeClients
    from lifecycle.supervisor.connections.networks import Networks
    from lifecycle.supervisor.health.process_monitor import ProcessMonitor, Sightings
    from lifecycle.supervisor.processes.fork_server import ForkServer

UNCHANGED_S = 5.0
"""Who is discovered at all over TCP is after 0.1–1.6 s, on a machine with both processors busy
after 1–4 s; findings that have not changed for so long do not change any more."""

SAY_S = 2.0
"""A gate that stays closed for so long says what it waits for, and until when."""

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


class OutrunError(Exception):
    """What was restarted by policy was still waiting for its gate when something else came first.

    It is connected, and stays at its gate.
    """


class GateSequence:
    """Carries out orders on one system.

    Args:
        schedule: what is started again by policy, and when.
        process_monitor: notices processes that end; those that end because we want it are noted.
        forget: drops what nodes reported before they were taken down, and has all others forget
            the participants of processes that theirs had left, by pid.
        sightings: who is in the graph.
        replanned: called with the names of nodes that the plan connects otherwise from now on.
        networks: programmed with the flows of the verdict that opens the gate.
        following: keeps looking at the nodes of others, and at ours that others may drive, for the
            length of its block.
        outrun: returns once something is to be done before a gate that stays closed.
        spawner: must be able to start processes before any is ended to be started again.
        timeout_s: for bringing up again what an order took down.
        clients: of running nodes' parameters.

    Attributes:
        phase: as people read it; see orders.py and SystemStatus.
        trusted: what the gate last took on trust; empty if nothing.
    """

    def __init__(
        self,
        system: System,
        *,
        bring_up: BringUp,
        schedule: RestartSchedule,
        judge: VerificationLoop,
        gate: Gate,
        emit: Emitter,
        process_monitor: ProcessMonitor,
        forget: Callable[[Collection[NodeRun], Collection[int]], None],
        sightings: Sightings,
        replanned: Callable[[Iterable[str]], None],
        networks: Networks,
        spawner: ForkServer,
        following: Callable[[], contextlib.AbstractAsyncContextManager[None]],
        outrun: Callable[[], Coroutine[Any, Any, None]],
        hurry: asyncio.Event,
        timeout_s: float,
        clients: NodeClients,
    ) -> None:
        self._spawner = spawner
        self._system = system
        self._bring_up = bring_up
        self._schedule = schedule
        self._judge = judge
        self._gate = gate
        self._emit = emit
        self._alive = process_monitor.during
        self._process_monitor = process_monitor
        self._forget = forget
        self._sightings = sightings
        self._replanned = replanned
        self._networks = networks
        self._following = following
        self._outrun = outrun
        self._hurry = hurry
        self._timeout_s = timeout_s
        self.phase = "connecting"
        self.trusted = ""
        self._applying = Applying(
            self,
            system=system,
            bring_up=bring_up,
            schedule=schedule,
            gate=gate,
            judge=judge,
            emit=emit,
            alive=self._alive,
            clients=clients,
            spawner=spawner,
            timeout_s=timeout_s,
        )

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
            StepFailedError: a step failed, or a network could not be programmed; the run is over,
                unless what failed is put down to be started again.
            RolledBackError: another manifest could not be applied.
        """
        before = self.phase
        try:
            await self._carry_out(order)
        except StepFailedError:
            self._cut_short(before)
            raise

    def _cut_short(self, before: str) -> None:
        """Leave a system whose order failed in a phase in which it is held, and takes orders.

        What the order would have activated waits at its gate until all is back, and then passes;
        a system that was paused stays so unless its gate had opened.

        Args:
            before: the phase before the order.
        """
        if self.phase in (ACTIVE, PAUSED, HELD):
            return
        if before == PAUSED and self.phase != "activating":
            self.phase = PAUSED
            return
        self.phase = HELD
        self._schedule.wait_at_gate(
            key
            for key, each in self._system.nodes.items()
            if each.is_to_be_active and not each.withheld and each.reach is not Reach.ACTIVE
        )

    async def _carry_out(self, order: Order) -> None:
        if order.ask is ControlRequest.PAUSE:
            await self._pause(order)
        elif order.ask is ControlRequest.RESUME:
            await self._through_the_gate()
        elif order.ask is ControlRequest.MODE:
            await self._switch(order.mode)
        elif order.ask is ControlRequest.APPLY:
            await self._applying.apply(order)
        elif order.keys:
            await self._restart_by_policy(order.keys)
        else:
            await self._restart(order)

    async def _pause(self, order: Order) -> None:
        self._gate.close()
        self.phase = "pausing"
        nodes = tuple(
            each
            for key, each in self._system.nodes.items()
            if each.planned.holds
            and each.reach is Reach.ACTIVE
            and key in (order.keys or self._system.nodes)
        )
        for each in nodes:
            each.withheld = order.reason
        try:
            await self._alive(self._bring_up.deactivate(nodes))
        finally:
            self._judge.ahead = self.active()
            if order.keys:
                self.phase = HELD
        if not order.keys:
            self.reached(PAUSED)

    async def _switch(self, mode: str) -> None:
        """Enter a mode: deactivate in reverse order, set parameters, activate through the gate.

        If a node refuses a value, or the gate stays closed, it goes back to the mode before.

        What goes down needs no gate, so that a mode with less can be entered whatever is violated.
        """
        before = self._system.mode
        try:
            await self._enter(mode)
        except (VerificationError, NotBegunError) as error:
            if isinstance(error, VerificationError) and self.phase not in (PAUSED, HELD):
                raise
            self._emit(Notice(message=f"cannot enter mode {mode!r}: back to {before!r}"))
            # As far as the gate allows; what it does not let through waits at it.
            with contextlib.suppress(VerificationError, NotBegunError):
                await self._enter(before)
            raise

    async def _enter(self, mode: str) -> None:
        phase, before = self.phase, self._system.mode
        nodes = tuple(self._system.nodes.values())
        wanted = {each for each in nodes if each.is_to_be_active}
        had = {each: each.planned.expected_parameters for each in nodes}
        self._gate.close()
        self.phase = "switching"
        self._system.enter(mode)
        changed = [each for each in nodes if each.planned.expected_parameters != had[each]]
        going = [
            each
            for each in nodes
            if each in wanted and not each.is_to_be_active and each.reach is Reach.ACTIVE
        ]
        try:
            await self._alive(self._bring_up.deactivate(going))
            await self._set_parameters(mode, changed)
        finally:
            self.phase = phase
            self._judge.ahead = self.active()
        self._emit(
            ModeEntered(
                mode=mode,
                before=before,
                inactive=tuple(
                    each.name for each in nodes if each.planned.state is TargetState.INACTIVE
                ),
                parameters=tuple(each.name for each in changed),
            )
        )
        self._system.touched.set()
        if phase == PAUSED:
            return
        if any(each not in wanted for each in self.inactive()):
            await self._through_the_gate()
        elif not self.inactive():
            self.reached(ACTIVE)

    async def _set_parameters(self, mode: str, nodes: Iterable[NodeRun]) -> None:
        """Set what a mode has of parameters; what does not run yet is started with it.

        Raises:
            NotBegunError: a node refuses a value, or does not answer.
        """
        running = [each for each in nodes if each.is_up and not each.is_gone]
        if not running:
            return
        try:
            await self._alive(self._bring_up.set_parameters(mode, running))
        except StepFailedError:
            raise
        except BringUpError as error:
            raise NotBegunError(f"cannot enter mode {mode!r}: {error.message}") from error

    async def _restart(self, order: Order) -> None:
        """Take one process or all down, and bring it up as far as the system was."""
        was_paused = self.phase == PAUSED
        nodes = tuple(self._system.nodes.values())
        if order.node:
            found = {
                each.planned.key for each in self.with_process_of(node_of(order, self._system))
            }
            found |= self._schedule.gone_with(found)
            nodes = tuple(each for each in nodes if each.planned.key in found)
        try:
            await self._spawner.ready()
        except BringUpError as error:
            raise NotBegunError(
                f"cannot restart {order.node or self._system.plan.system!r}: {error}; "
                "everything stays as it is"
            ) from error
        self._gate.close()
        self.phase = "restarting"
        self._schedule.by_hand([each.planned.key for each in nodes])
        async with self._watched():
            await self.take_down(nodes)
            await self.begin_again(nodes)
            # Who waits for one that is started again later follows it.
            await self.connect_unfinished(self._timeout_s)
        self._emit(SystemReached(reached="connected", elapsed_s=self._emit.elapsed_s))
        if was_paused:
            self.reached(PAUSED)
        else:
            await self._through_the_gate()

    async def connect(self, timeout_s: float) -> None:
        """Bring the system up as far as connected; who fails is started again as policy says.

        Args:
            timeout_s: seconds, counted anew whenever something is started again.

        Raises:
            StepFailedError: a step failed that nothing is to be started again after, or too often.
        """
        connecting = self._alive(self._bring_up.connect(timeout_s))
        while (failure := await failure_of(connecting)) is not None:
            await self.recover(failure, timeout_s)
            connecting = self._alive(self._bring_up.connect(timeout_s))

    async def recover(self, failure: StepFailedError, timeout_s: float) -> None:
        """Start again what failed before the system was up; return once it is where it was.

        Args:
            failure: of a step, or an unexpected end.
            timeout_s: seconds, for bringing it up each time.

        Raises:
            StepFailedError: `failure`, if nothing is to be started again after it; or one that ends
                the run since.
        """
        self._gate.close()
        phase = self.phase
        await self.put_down(failure)
        while self._schedule.down:
            another = await failure_of(self._bring_back(timeout_s))
            if another is not None:
                await self.put_down(another)
        self.phase = phase

    async def _bring_back(self, timeout_s: float) -> None:
        await self._alive(self._schedule.due())
        self.phase = "restarting"
        keys = self._schedule.begin()
        await self.begin_again(tuple(self._system.nodes[key] for key in keys))
        await self.connect_unfinished(timeout_s)

    async def put_down(self, failure: StepFailedError) -> None:
        """Take down what failed, and what goes down with it, to be started again later.

        Who was interrupted in a step by it has an unknown state: it begins anew, too.

        Raises:
            StepFailedError: `failure`, if nothing is to be started again after it; or that
                supervision gives up.
        """
        if not self._schedule.covers(failure):
            raise failure
        keys = self._schedule.take(failure)
        interrupted = self.interrupted() - keys
        self._schedule.again(interrupted)
        down = tuple(
            each for key, each in self._system.nodes.items() if key in keys or key in interrupted
        )
        async with self._watched():
            await self.take_down(down)
        for node in down:
            node.renew(node.process)
            if node.process is not None:
                node.process.back_off()
        self._judge.ahead = self.active()
        self._system.touched.set()
        self._schedule.announce(keys)
        if self.phase == HELD and not self.inactive():
            self.phase = ACTIVE

    def interrupted(self) -> frozenset[str]:
        """Return the keys of the nodes, with their processes, that were cut off in a step."""
        return interrupted_in(self._system.nodes)

    @contextlib.asynccontextmanager
    async def _watched(self) -> AsyncIterator[None]:
        """Judge what stays active also while others are taken down or brought up."""
        looking = asyncio.ensure_future(self._judge.keep_looking(self.active, self._away))
        try:
            yield
        finally:
            await ended(looking)

    async def _restart_by_policy(self, keys: tuple[str, ...]) -> None:
        """Bring what is down as far as the system is: through its gate, while the rest stays.

        Raises:
            OutrunError: something else is to be done before its gate opens.
        """
        before = self.phase
        goes_on = before in (ACTIVE, HELD)
        try:
            await self._spawner.ready()
        except BringUpError as error:
            raise self._not_started(keys, error.message) from error
        self._gate.close()
        self.phase = "restarting"
        try:
            async with self._watched():
                await self.begin_again(tuple(self._system.nodes[key] for key in keys))
                await self.connect_unfinished(self._timeout_s)
            self._emit(SystemReached(reached="connected", elapsed_s=self._emit.elapsed_s))
        except StepFailedError:
            self.phase = HELD if goes_on else before
            raise
        if goes_on:
            await self.let_through()
        else:
            self.phase = before
            self._schedule.returned(self._keys(self._schedule.returning))

    async def let_through(self) -> None:
        """Judge the system, and activate the nodes that were started again by policy.

        Raises:
            OutrunError: something else is to be done before their gate opens.
            VerificationError: their gate stays closed; they wait at it.
            StepFailedError: as for `activate`.
        """
        returning = self._schedule.returning
        names = returning - self._withheld()
        if not names:
            self.phase = HELD
            self._schedule.returned(self._keys(returning))
            return
        deadline = asyncio.get_running_loop().time() + self._timeout_s
        try:
            # Who is not let through now is later: orders are not kept waiting for it.
            judging = self.verify(self._timeout_s, waits=False)
            permit = await self._unless_outrun(judging, self._outrun())
            waiting = tuple(each for each in self.inactive() if each.name in names)
            await self.activate(permit, deadline, waiting)
        except VerificationError as error:
            if not error.again and self.phase == "activating":
                raise self._not_as_verified(names, error) from error
            if error.again and self.phase == "activating":
                await self.withdraw(permit)
            raise
        finally:
            if self.phase != ACTIVE:
                self.phase = HELD
        self._schedule.returned(self._keys(returning))

    def may_let_through(self, verdict: Verdict) -> bool:
        """Whether nodes wait that were started again by policy, and `verdict` opens their gate."""
        names = self._schedule.returning - self._withheld()
        if self.phase != HELD or not names or names & self._schedule.down:
            return False
        return not self._gate.closes(verdict)

    def _not_started(self, keys: Collection[str], why: str) -> StepFailedError:
        failures = [
            StepFailedError(
                f"cannot start {each.name!r} again: {why}",
                rule=START_FAILED,
                subject=each.name,
                process=each.planned.process,
            )
            for key, each in self._system.nodes.items()
            if key in keys
        ]
        return failures[0].joined(failures[1:])

    def _not_as_verified(self, names: Collection[str], error: VerificationError) -> StepFailedError:
        """Return the failure of nodes that became other than what was verified."""
        failures = [
            StepFailedError(
                f"cannot keep {each.name!r} active: what became active is not what was verified; "
                f"{not_ok(error.verdict)}",
                rule=TRANSITION_FAILED,
                subject=each.name,
                process=each.planned.process,
            )
            for each in self._system.nodes.values()
            if each.name in names
        ]
        return failures[0].joined(failures[1:])

    async def _unless_outrun(
        self, judging: Coroutine[Any, Any, Permit], outrun: Coroutine[Any, Any, None]
    ) -> Permit:
        running = asyncio.ensure_future(judging)
        first = asyncio.ensure_future(outrun)
        try:
            waits: set[asyncio.Future[Any]] = {running, first}
            await asyncio.wait(waits, return_when=asyncio.FIRST_COMPLETED)
            if not running.done():
                raise OutrunError
            return running.result()
        finally:
            await ended(running, first)

    def _keys(self, names: Collection[str]) -> tuple[str, ...]:
        return tuple(key for key, each in self._system.nodes.items() if each.name in names)

    async def connect_unfinished(self, timeout_s: float) -> None:
        """Bring every node that is not down, and waits for none that is, as far as its gate."""
        down = self._schedule.down
        held = {key for key, each in self._system.nodes.items() if each.name in down}
        while more := {
            key
            for key, each in self._system.nodes.items()
            if key not in held and any(after.node in held for after in each.planned.after)
        }:
            held |= more
        nodes = [
            each
            for key, each in self._system.nodes.items()
            if key not in held and not each.is_up and not _is_written_off(each)
        ]
        self.phase = "connecting"
        self._judge.ahead = self.active()
        await self._alive(self._bring_up.connect(timeout_s, nodes))

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
        saying = loop.call_later(SAY_S, self._say_waiting, timeout_s)
        try:
            await self._until_clear(deadline)
        finally:
            saying.cancel()

    def _say_waiting(self, timeout_s: float) -> None:
        verdict = self._judge.latest
        if verdict is not None and closes(verdict, strict=self._gate.strict):
            left_s = max(0.0, timeout_s - SAY_S)
            self._emit(
                Notice(message=f"waits up to {left_s:.0f} s more for its gate: {not_ok(verdict)}")
            )

    async def _until_clear(self, deadline: float) -> None:
        loop = asyncio.get_running_loop()
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
            await self._again(self.with_process_of(node), left_s)
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

    def with_process_of(self, node: NodeRun) -> tuple[NodeRun, ...]:
        """Return all that comes and goes with a node: a container's components with it."""
        if node.process is None:
            return (node,)
        found = [each for each in self._system.nodes.values() if each.process is node.process]
        loaded = {each.planned.key for each in found}
        components = (
            each for each in self._system.nodes.values() if each.planned.run.container in loaded
        )
        return (*found, *components)

    async def _again(self, nodes: tuple[NodeRun, ...], timeout_s: float) -> None:
        """Take nodes down with all of their processes, and bring them up as far as connected.

        Args:
            nodes: with all of their processes.
            timeout_s: seconds, for bringing them up.
        """
        await self.take_down(nodes)
        nodes = await self.begin_again(nodes)
        self.phase = "connecting"
        self._judge.ahead = self.active()
        await self._alive(self._bring_up.connect(timeout_s, nodes))

    async def take_down(self, nodes: tuple[NodeRun, ...]) -> None:
        """Take nodes down, in reverse order, with all of their processes."""
        self._process_monitor.dead |= {
            each.process.name for each in nodes if each.process is not None
        }
        for node in nodes:
            node.is_up = False  # what is missing of it from now on is no violation
            container = self._system.nodes.get(node.planned.run.container)
            if container is not None and container.process is not None:
                # Nobody answers for a component whose container is gone.
                node.stuck = node.stuck or container.process.is_gone
        # What writes to it may end as soon as nobody reads a process's output any more.
        known = self._spawner.belonging(_pids(nodes))
        await TakeDown(self._system, self._emit, self._hurry, nodes=nodes).run()
        await self.end_left(nodes, known)

    def nodes_of(self, failure: StepFailedError) -> tuple[NodeRun, ...]:
        """Return the nodes of the process that a failure is of."""
        every = self._system.nodes.values()
        return tuple(each for each in every if each.planned.process == failure.process)

    async def end_left(
        self, nodes: Collection[NodeRun], known: Collection[int] = frozenset()
    ) -> None:
        """End what processes left that have ended: nothing of it runs beside a successor.

        Args:
            nodes: of these processes.
            known: pids of what belonged to them before.
        """
        ended = _pids(each for each in nodes if each.is_gone)
        left = await self._spawner.end_left(ended, known) if ended else ()
        if left:
            names = ", ".join(map(repr, dict.fromkeys(ended.values())))
            pids = ", ".join(map(str, left))
            self._emit(Notice(message=f"ended what {names} left behind: {pids}"))
        self._forget(nodes, {*left, *known})

    async def begin_again(
        self,
        nodes: tuple[NodeRun, ...],
        plan: Plan | None = None,
        revision: int | None = None,
    ) -> tuple[NodeRun, ...]:
        """Make nodes that are down ready to be brought up; return those to bring up.

        Args:
            nodes: with all of their processes.
            plan: another manifest's, to be taken now; None to keep this one.
            revision: of that manifest, if it was in force before.

        Raises:
            StepFailedError: a process ended.
        """
        names = {each.process.name for each in nodes if each.process is not None}
        # A participant that was killed haunts the graph; who comes back would be taken for two.
        gone = [
            each.name for each in nodes if each.process is not None or each.planned.run.component
        ]
        if plan is not None:
            old = nodes
            nodes = self._system.take(plan, old, revision)
            self._replanned({each.name for each in (*old, *nodes)})
        else:
            self._replan(nodes)
            self._system.renew(nodes)
        self._process_monitor.dead -= names
        await self._alive(together(self._sightings.vanishes(name) for name in gone))
        return nodes

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

    async def verify(self, timeout_s: float, *, waits: bool = True) -> Permit:
        """Judge the system as it is until its gate opens; activate nothing.

        Args:
            timeout_s: seconds, for all of it.
            waits: what changes behind the open gate may heal for as long, too, and not only for
                AGAIN_S.

        Raises:
            StepFailedError: as for `until_clear`.
            VerificationError: the gate stays closed.
        """
        self._gate.close()
        self.phase = "verifying"
        self._judge.ahead = self.active()
        deadline = asyncio.get_running_loop().time() + timeout_s
        await self.until_clear(timeout_s)
        assert self._judge.latest is not None
        permit = self._gate.judge(self._judge.latest, deadline=deadline if waits else None)
        self._judge.violations.end()
        self.trusted = taken_on_trust(permit.verdict)
        self._emit(SystemReached(reached="verified", elapsed_s=self._emit.elapsed_s))
        return permit

    async def activate(
        self, permit: Permit, deadline: float, nodes: tuple[NodeRun, ...] | None = None
    ) -> None:
        """Program networks, activate what is not active, and judge what it has become.

        Args:
            permit: of `verify`.
            deadline: of all of it, by the running loop's clock, see `behind_s`.
            nodes: only these; None for all that are not active.

        Raises:
            StepFailedError: a step failed, or a network could not be programmed.
            VerificationError: what changed meanwhile closed the gate for all that were not sent
                their requests (`again`), or what became active is not what was verified.
        """
        # What comes again sends from other ports: their rules come before its first message.
        await self._alive(self.program_flows(permit, deadline))
        self.trusted = taken_on_trust(permit.verdict)
        self.phase = "activating"
        waiting = self.inactive() if nodes is None else nodes
        self._emit(
            GateOpened(
                outcome=permit.verdict.verdict.value,
                nodes=tuple(each.name for each in waiting),
                trusted=self.trusted,
            )
        )
        for each in waiting:
            each.withheld = ""
        async with self._following():
            await self._alive(self._bring_up.activate(permit, behind_s(deadline), waiting))
        await self.confirm(deadline)
        if not self.inactive():
            self.reached(ACTIVE)

    async def confirm(self, deadline: float) -> None:
        """Judge what a system has become that is as active as it is to be.

        Raises:
            StepFailedError: a process ended.
            VerificationError: it is not what was verified.
        """
        # Who waits at another gate, or was deactivated for a violation, is not to be active yet.
        whole = not self.inactive()
        self._judge.ahead = frozenset() if whole else self.active()
        stage = Stage.ACTIVE if whole else Stage.CONNECTED
        await self._alive(self._judge.until_clear(stage, behind_s(deadline)))
        # The same question as at the gate: what became active must be what was verified.
        assert self._judge.latest is not None
        self._gate.judge(self._judge.latest)

    async def _through_the_gate(self) -> None:
        """Judge the system as it is, and activate what is not active."""
        deadline = asyncio.get_running_loop().time() + self._timeout_s
        before = PAUSED if self.phase == PAUSED else HELD
        try:
            permit = await self._verify_with_who_comes_again()
        except VerificationError:
            # What is active was verified before; what is not stays inactive until asked again.
            self.phase = before
            raise
        try:
            await self.activate(permit, deadline)
        except VerificationError as error:
            if error.again:
                if self.phase == "activating":
                    await self.withdraw(permit)
                self.phase = before
            raise

    async def _verify_with_who_comes_again(self) -> Permit:
        """Judge until the gate opens, and start again meanwhile what is due: it may wait for it."""
        while True:
            with contextlib.suppress(OutrunError):
                return await self._unless_outrun(self.verify(self._timeout_s), self._schedule.due())
            self.phase = "restarting"
            keys = self._schedule.begin()
            async with self._watched():
                await self.begin_again(tuple(self._system.nodes[key] for key in keys))
                await self.connect_unfinished(self._timeout_s)

    async def withdraw(self, permit: Permit) -> None:
        """Deactivate again what was activated since the gate opened: the rest may not follow."""
        begun = tuple(each for each in self._system.nodes.values() if each.name in permit.sent)
        for each in self.inactive():
            if each not in begun:
                each.undo = [one for one in each.undo if one is not Operation.ACTIVATE]
        if begun:
            names = ", ".join(each.name for each in begun)
            self._emit(Notice(message=f"the gate closed again: {names} is deactivated"))
        await self._alive(self._bring_up.deactivate(begun))
        self._judge.ahead = self.active()

    async def program_flows(self, permit: Permit, deadline: float) -> None:
        """Program networks with the flows of the verdict that nodes are activated on."""
        programmed = None
        while permit.verdict.flows != programmed:
            programmed = permit.verdict.flows
            await self._networks.begin(permit.verdict, behind_s(deadline))
            # A network may take seconds: what changed meanwhile is judged before the gate opens.
            await permit.renewed()

    def inactive(self) -> tuple[NodeRun, ...]:
        """Return the nodes that wait for the gate."""
        return tuple(
            each
            for each in self._system.nodes.values()
            if each.is_to_be_active and each.is_up and each.reach is not Reach.ACTIVE
        )

    def _away(self) -> frozenset[str]:
        """Return the names of the nodes that are not active and not at their gate either."""
        return frozenset(each.name for each in self._system.nodes.values() if not each.is_up)

    def _withheld(self) -> frozenset[str]:
        return frozenset(each.name for each in self._system.nodes.values() if each.withheld)

    def active(self) -> frozenset[str]:
        """Return the names of the nodes that are active, let through or found so."""
        return frozenset(
            each.name
            for each in self._system.nodes.values()
            if each.planned.holds and each.reach is Reach.ACTIVE
        )

    def reached(self, phase: str) -> None:
        """Note that the system is active, or paused."""
        self.phase = phase
        self._emit(SystemReached(reached=phase, elapsed_s=self._emit.elapsed_s))
        self._schedule.returned([key for key, each in self._system.nodes.items() if each.is_up])


def _pids(nodes: Iterable[NodeRun]) -> dict[int, str]:
    """Return the names of the processes of nodes by pid."""
    processes = [each.process for each in nodes if each.process is not None]
    return {each.pid: each.name for each in processes if each.pid}


def interrupted_in(nodes: Mapping[str, NodeRun]) -> frozenset[str]:
    """Return the keys of the nodes, with their processes, that were cut off in a step.

    A component that was cut off may be loaded: only its container's end unloads it for certain.

    Args:
        nodes: by key, all that this supervisor brings up.
    """
    processes = set()
    for each in nodes.values():
        of = nodes.get(each.planned.run.container, each) if each.planned.run.component else each
        if (
            of.process is not None
            and not of.process.is_gone
            and (each.stuck or (each.reach is Reach.WAITING and _is_in_step(each)))
        ):
            processes.add(of.process)
    keys = {key for key, each in nodes.items() if each.process in processes}
    components = (
        key
        for key, each in nodes.items()
        if each.planned.run.component and each.planned.run.container in keys
    )
    return frozenset((*keys, *components))


def _is_in_step(node: NodeRun) -> bool:
    """Whether a node that is not up was doing something itself, and did not wait for another."""
    return not node.is_up and bool(node.doing) and not node.doing.startswith("waits")


def _is_written_off(node: NodeRun) -> bool:
    return node.process is not None and node.process.state is ProcessState.EXITED
