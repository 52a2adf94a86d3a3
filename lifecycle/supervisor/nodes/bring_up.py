"""Bring-up: start, configure, connect along the dependency DAG; after the gate, activate.

Owns: the order of steps and their deadlines. Each node walks by itself and waits only for what
its `after:` names, everything else runs in parallel. The first failure ends it all: no step begins
any more, and those in progress have a moment to fail for reasons of their own, so that one run
names them all. What is judged when is gate/verification_loop.py's; activating takes the gate's
permit. Must not import rclpy.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Awaitable, Callable, Collection, Coroutine, Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from msgspec.structs import replace

from lifecycle.errors import BringUpError, MiddlewareError
from lifecycle.manifest.model import Condition, RosArguments, RunKind, TargetState
from lifecycle.node.host.control import HostSpec, Operation
from lifecycle.plan.model import PlannedNode
from lifecycle.plan.parameters import DEFAULT, GIVEN
from lifecycle.supervisor.control.protocol import ProcessState, Reach
from lifecycle.supervisor.gate.activation_guard import BY_ITSELF, TO_DO, TRIES
from lifecycle.supervisor.gate.gate import Permit
from lifecycle.supervisor.nodes.driver import (
    ACTIVE,
    ActiveError,
    ChangedError,
    ControlDriver,
    NodeCondition,
    NodeDriver,
)
from lifecycle.supervisor.nodes.system import NodeRun, System
from lifecycle.supervisor.processes.control_channel import (
    ChannelClosedError,
    ControlChannel,
    HostFailedError,
)
from lifecycle.supervisor.processes.process import ManagedProcess, wait_under_load
from lifecycle.supervisor.run.events import Notice
from lifecycle.supervisor.run.failure import StepFailedError, ended, together, within
from lifecycle.verify.rules import Rule
from lifecycle.verify.rules.run import (
    DEADLINE,
    NOT_WIRED,
    PROCESS_DIED,
    START_FAILED,
    TRANSITION_FAILED,
)

if TYPE_CHECKING:
    from lifecycle.supervisor.connections.authority import ConnectionAuthority
    from lifecycle.supervisor.processes.fork_server import ForkServer

T = TypeVar("T")

_DEATH_S = 0.5
"""A closed channel usually means a dying process; its end says more than the channel did."""

_WORDS_S = 0.1
"""For what a process wrote to its channel just before it ended."""

_OWN_S = 0.5
"""Our nodes keep the same limits themselves and know more: let them speak first."""

ALSO_S = 0.5
"""For steps in progress to fail, too, once one has failed; processes that start side by side and
cannot import something fail within a tenth of a second of each other."""

_ING = {
    Operation.CONFIGURE: "configuring",
    Operation.CONNECT: "connecting",
    Operation.ACTIVATE: "activating",
    Operation.DEACTIVATE: "deactivating",
}


_TO_UNDO = (Operation.CONFIGURE, Operation.CONNECT)
"""What is left to undo of a node that was deactivated."""


class BringUp:
    """Brings one system up.

    Args:
        system: what to bring up.
        spawner_of: the spawner for a process.
        services: makes the driver of a managed node that is not ours.
        appears: waits until a node of this name is in the graph.
        alone: makes sure, as well as it can be known, that a node of ours which is driven by its
            services is the only one of its name, or raises VerificationError.
        recorded: called after each spawn, to keep the record of children true.
        gives: sets the parameters of a running node that its command line does not give it.
        loads: has the container of this full name load a node, and returns what unloads it.
        wirer: wires each node between its configure and its connect; None leaves it to the nodes.
    """

    def __init__(
        self,
        system: System,
        *,
        spawner_of: Callable[[ManagedProcess], ForkServer],
        services: Callable[[PlannedNode], NodeDriver],
        appears: Callable[[str], Awaitable[None]],
        recorded: Callable[[], None],
        wirer: ConnectionAuthority | None = None,
        gives: Callable[[PlannedNode], Awaitable[None]] | None = None,
        alone: Callable[[NodeRun], None] | None = None,
        loads: Callable[[PlannedNode, str], Awaitable[Callable[[], Awaitable[None]]]] | None = None,
    ) -> None:
        self._gives = gives
        self._alone = alone
        self._loads = loads
        self._system = system
        self._spawner_of = spawner_of
        self._services = services
        self._appears = appears
        self._recorded = recorded
        self._wirer = wirer
        self._starts: dict[str, asyncio.Task[None]] = {}
        self._appearing: list[asyncio.Task[None]] = []
        self._failures: list[StepFailedError] = []
        self._in_progress = 0
        self._step_over = asyncio.Event()

    async def connect(self, timeout_s: float, nodes: Iterable[NodeRun] | None = None) -> None:
        """Start, configure and connect every node, or some.

        Raises:
            StepFailedError: the steps that failed, or what was missing after `timeout_s`.
        """
        try:
            await within(timeout_s, self._connect_all(self._some(nodes)))
        except asyncio.TimeoutError:
            raise self._failure() or self._late(timeout_s) from None

    async def activate(
        self, permit: Permit, timeout_s: float, nodes: Iterable[NodeRun] | None = None
    ) -> None:
        """Activate every node that is held, or some, as `permit` allows.

        Raises:
            StepFailedError: as for `connect`.
            VerificationError: something changed after the verdict, and what it is now keeps the
                gate closed for all that were not asked yet.
        """
        held = [node for node in self._some(nodes) if node.is_to_be_active]
        try:
            await within(
                timeout_s, self._side_by_side(self._activate(node, permit) for node in held)
            )
        except asyncio.TimeoutError:
            if (failure := self._failure()) is not None:
                raise failure from None
            permit.expire()
            raise self._late(timeout_s) from None

    async def deactivate(self, nodes: Iterable[NodeRun] | None = None) -> None:
        """Deactivate every active node, those first that depend on others.

        Args:
            nodes: only these, which were asked to activate; None for all that are active.

        Raises:
            StepFailedError: those that failed.
        """
        active = tuple(
            node
            for node in self._some(nodes)
            if node.planned.holds and (nodes is not None or node.reach is Reach.ACTIVE)
        )
        await self._side_by_side(self._deactivate(node, active) for node in active)

    async def set_parameters(self, mode: str, nodes: Iterable[NodeRun]) -> None:
        """Set what a mode has of parameters, on nodes that run.

        Raises:
            BringUpError: a node refuses a value or does not answer; others may have theirs.
        """
        gives = self._gives
        if gives is None:
            return
        plans = [
            replace(
                node.planned,
                # All of them, also those that it has by default.
                expected_parameters=tuple(
                    replace(each, source=GIVEN) for each in node.planned.in_mode(mode)
                ),
            )
            for node in nodes
        ]
        try:
            await together(_awaiting(gives(each)) for each in plans)
        except MiddlewareError as error:
            raise BringUpError(error.message) from error

    def _some(self, nodes: Iterable[NodeRun] | None) -> tuple[NodeRun, ...]:
        return tuple(self._system.nodes.values() if nodes is None else nodes)

    def unfinished(self) -> str:
        """Say what every node is doing, or waits for, that is in a step; empty if none is."""
        busy = [node for node in self._system.nodes.values() if node.doing]
        return "; ".join(f"{node.name} {_is(node.doing)}" for node in busy)

    async def close(self) -> None:
        """Stop waiting for plain nodes that have not appeared."""
        for task in self._appearing:
            task.cancel()
        await asyncio.gather(*self._appearing, return_exceptions=True)

    async def _connect_all(self, nodes: Iterable[NodeRun]) -> None:
        nodes = tuple(nodes)
        try:
            await self._side_by_side(self._walk(node) for node in nodes)
        finally:
            # A process that is started again later is another one.
            starts, self._starts = tuple(self._starts.values()), {}
            for start in starts:
                start.cancel()
            await ended(*starts)

    async def _side_by_side(self, walks: Iterable[Coroutine[Any, Any, None]]) -> None:
        """Run all of them to their end, or until one fails; then none of them goes on.

        Raises:
            StepFailedError: the first that failed, with those that did so until all had stopped.
        """
        self._failures = []
        tasks = [asyncio.ensure_future(self._noting(each)) for each in walks]
        if not tasks:
            return
        try:
            done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_EXCEPTION)
            if any(each.exception() is not None for each in done if not each.cancelled()):
                await self._others_over()
        finally:
            await ended(*tasks)
        if (failure := self._failure()) is not None:
            raise failure
        for task in tasks:
            if not task.cancelled():
                task.result()

    async def _noting(self, walk: Coroutine[Any, Any, None]) -> None:
        try:
            await walk
        except StepFailedError as failure:
            self._failures.append(failure)
            raise

    async def _others_over(self) -> None:
        """Wait, bounded, until no step is in progress and no host reports failures any more."""
        loop = asyncio.get_running_loop()
        deadline = loop.time() + ALSO_S
        while (left_s := deadline - loop.time()) > 0:
            self._step_over.clear()
            ends: set[asyncio.Future[Any]] = {
                asyncio.ensure_future(asyncio.shield(each.ended))
                for each in self._system.processes.values()
                if each.channel is not None and each.channel.failures and not each.ended.done()
            }
            if not self._in_progress and not ends:
                return
            ends.add(asyncio.ensure_future(self._step_over.wait()))
            try:
                await asyncio.wait(ends, timeout=left_s, return_when=asyncio.FIRST_COMPLETED)
            finally:
                await ended(*ends)

    def _failure(self) -> StepFailedError | None:
        """Return the first failure with all others, also those that hosts reported since."""
        if not self._failures:
            return None
        first, *others = self._failures
        reported = [
            each
            for process in self._system.processes.values()
            for each in _not_hosted(process, self._system.nodes[process.planned.nodes[0]])
        ]
        return first.joined([*others, *reported])

    async def _may_begin(self) -> None:
        """Hold a step for good once another has failed: who waits for it will be cancelled."""
        if self._failures:
            await asyncio.get_running_loop().create_future()

    @contextlib.contextmanager
    def _progressing(self) -> Iterator[None]:
        self._in_progress += 1
        try:
            yield
        finally:
            self._in_progress -= 1
            self._step_over.set()

    async def _walk(self, node: NodeRun) -> None:
        """Bring a node as far as its gate, from where it is."""
        if not node.is_up:
            await self._walk_on(node)
            node.is_up = True

    async def _walk_on(self, node: NodeRun) -> None:
        await self._start(node)
        if node.planned.managed:
            await self._connect(node)
        elif node.process is not None and node.process.channel is not None:
            await self._step(
                node, node.process.channel.ready(), node.planned.timeouts.start_s, rule=START_FAILED
            )
            self._started(node)
        else:
            # A plain node reports nothing. Its dependents wait until it is in the graph; if it
            # never is, verification says so.
            node.doing = _APPEARING
            if self._is_to_be_given(node) and not node.planned.may_end:
                # What it is judged by must be there before it is.
                await self._appear_alone(node)
                await self._give(node)
            self._appearing.append(asyncio.ensure_future(self._appear(node)))

    async def _appear_alone(self, node: NodeRun) -> None:
        """Wait, bounded, for a node that its services are asked of: nobody else may get that."""
        limit_s = node.planned.timeouts.start_s
        await self._step(node, self._appears(node.name), limit_s, rule=START_FAILED)
        process = node.process
        if self._alone is not None and process is not None and not process.is_restarted:
            self._alone(node)

    async def _appear(self, node: NodeRun) -> None:
        process = node.process
        appears = asyncio.ensure_future(self._appears(node.name))
        waits: set[asyncio.Future[Any]] = {appears}
        if node.process is not None:
            waits.add(node.process.ended)
        try:
            await asyncio.wait(waits, return_when=asyncio.FIRST_COMPLETED)
        finally:
            await ended(appears)
        if appears.done() and not appears.cancelled():
            appears.result()
        # Who is started again meanwhile has another process, and is waited for anew.
        if node.process is process and (process is None or not process.died):
            self._started(node)

    async def _load(self, node: NodeRun) -> None:
        """Have its container load a component, once that runs."""
        name = node.planned.run.container
        container = self._system.nodes.get(name)
        while container is not None and not container.has_reached(Condition.STARTED):
            node.doing = f"waits to be loaded until {container.name} has started"
            await container.changed.wait()
        node.doing = "starting"
        if self._loads is None:
            return
        full_name = name if container is None else container.name
        try:
            node.unload = await self._loads(node.planned, full_name)
        except MiddlewareError as error:
            message = f"{error.message}; {error.hint}" if error.hint else error.message
            raise StepFailedError(message, rule=START_FAILED, subject=node.name) from error

    @staticmethod
    def _is_to_be_given(node: NodeRun) -> bool:
        """Whether its command line cannot give it all of its parameters, see `command_line`."""
        planned, process = node.planned, node.process
        empty = [each for each in planned.expected_parameters if each.value == ()]
        if planned.run.component and empty:
            return True
        if process is None or planned.run.kind is not RunKind.COMMAND:
            return False
        if planned.run.ros_args is RosArguments.NONE:
            return bool(planned.parameters or planned.parameter_files)
        if planned.mode_parameters or any(each.source != DEFAULT for each in empty):
            return True  # it may come again in another mode; rcl reads no empty array
        shared = len(process.planned.nodes) > 1
        return shared and planned.namespace != "/" and bool(planned.parameters)

    async def _give(self, node: NodeRun) -> None:
        """Set its parameters where no command line can; what it has not yet, it may have later."""
        if self._gives is None or not self._is_to_be_given(node):
            return
        try:
            await self._gives(node.planned)
        except MiddlewareError as error:
            # Judged by what it has then, which names the parameter.
            self._system.emit(Notice(message=error.message))
        self._system.touched.set()

    def _started(self, node: NodeRun, standing: NodeCondition | None = None) -> None:
        node.doing = ""
        self._note_found(node, "running" if standing is None else standing.state)
        node.advance(Reach.STARTED, standing)
        if node.process is not None:
            node.process.running()

    def _note_found(self, node: NodeRun, state: str) -> None:
        """Note, and say, how a node was found that others started and that is adopted."""
        others = node.process is None and not node.planned.run.component
        if not self._system.adopts or not others or node.found:
            return
        node.found = state
        where = self._system.adopted.get(node.name)
        message = f"{node.name!r} is adopted, found {state}" + (f": {where}" if where else "")
        self._system.emit(Notice(message=message))

    async def _connect(self, node: NodeRun) -> None:
        assert node.driver is not None
        if node.reach is Reach.WAITING:
            node.doing = "starting"
            limit_s = node.planned.timeouts.start_s
            standing = await self._step(node, node.driver.start(), limit_s, rule=START_FAILED)
            self._started(node, standing)
            if node.found and standing.state == ACTIVE:
                # It is verified as it is: nothing is asked of it, and no gate has to let it in.
                node.advance(Reach.ACTIVE, standing)
                return
            await self._give(node)
        if node.planned.state is TargetState.UNCONFIGURED:
            return
        if node.reach is Reach.STARTED:
            await self._system.reached(node, Condition.CONFIGURED, "configure")
            await self._operate(node, Operation.CONFIGURE, Reach.CONFIGURED)
            await self._give(node)
        await self._system.reached(node, Condition.CONNECTED, "connect")
        if self._wirer is not None:
            await self._wirer.ready(node)
            await self._may_begin()
            node.doing = "being wired"
            limit_s = node.planned.timeouts.connect_s
            await self._step(node, self._wirer.wire(node), limit_s, rule=NOT_WIRED)
        await self._operate(node, Operation.CONNECT, Reach.CONNECTED)

    async def _activate(self, node: NodeRun, permit: Permit) -> None:
        for condition in (Condition.ACTIVE, Condition.HEALTHY):
            await self._system.reached(node, condition, "activate")
        node.doing = "waits to activate until what changed is verified"
        # Here, too: how long it takes is not the node's to answer for.
        # A gate that was closed fails the step itself.
        with contextlib.suppress(BringUpError):
            await permit.renewed()
        await self._operate(node, Operation.ACTIVATE, Reach.ACTIVE, permit)

    async def _deactivate(self, node: NodeRun, others: Collection[NodeRun]) -> None:
        for dependent in self._system.dependents(node.planned.key):
            while dependent in others and Operation.ACTIVATE in dependent.undo:
                await dependent.changed.wait()
        await self._operate(node, Operation.DEACTIVATE, Reach.CONNECTED)
        node.undo = [each for each in node.undo if each in _TO_UNDO]
        node.stuck = False

    async def _operate(
        self, node: NodeRun, operation: Operation, reach: Reach, permit: Permit | None = None
    ) -> None:
        limit_s = {
            Operation.CONFIGURE: node.planned.timeouts.configure_s,
            Operation.CONNECT: node.planned.timeouts.connect_s,
            Operation.ACTIVATE: node.planned.timeouts.activate_s,
            Operation.DEACTIVATE: node.planned.timeouts.deactivate_s,
        }[operation]
        await self._may_begin()
        node.doing = _ING[operation]
        node.permit = permit
        # Noted before it is sent: a request without an answer may have been carried out.
        if operation is not Operation.DEACTIVATE:
            node.undo.append(operation)
        try:
            if operation is Operation.CONFIGURE:
                doing = self._configure(node)
            elif permit is not None:
                doing = self._activate_as_verified(node, permit)
            else:
                doing = node.perform(operation)
            standing = await self._step(node, doing, limit_s, rule=TRANSITION_FAILED)
        except StepFailedError:
            if permit is not None and node.name not in permit.sent:
                permit.expire()  # it was not the node that took so long
            raise
        node.doing = ""
        if standing.already and node.process is None and operation in _TO_UNDO:
            node.undo.remove(operation)
        node.advance(reach, standing)

    async def _configure(self, node: NodeRun) -> NodeCondition:
        """Configure a node; one that this run started and that is active is deactivated first.

        Nobody but its own code has had it activate, so nothing depends on that; one that others
        started may be at work.
        """
        for _ in range(TRIES):
            try:
                return await node.perform(Operation.CONFIGURE)
            except ActiveError:
                if node.planned.run.kind is RunKind.ATTACH:
                    raise
            self._system.emit(Notice(message=f"{node.name!r} {BY_ITSELF}: it is deactivated"))
            with contextlib.suppress(ActiveError):  # it may have been activated again: see above
                await node.perform(Operation.DEACTIVATE)
        raise BringUpError(
            f"cannot configure {node.name!r}: it was activated again each of the {TRIES} times "
            f"that it was deactivated; {TO_DO}"
        )

    async def _activate_as_verified(self, node: NodeRun, permit: Permit) -> NodeCondition:
        """Activate a node; one that has changed since it was verified is verified again."""
        while True:
            with contextlib.suppress(ChangedError):
                return await node.perform(Operation.ACTIVATE, permit)
            permit.unused(node.name)
            self._system.touched.set()
            await permit.renewed()

    async def _start(self, node: NodeRun) -> None:
        """Have the node's process started, or find a node that others start."""
        if node.driver is not None:
            return  # it went on from here before another's failure had it wait
        process = node.process
        if process is None:
            await self._hold_start(node)
            if node.planned.run.component:
                await self._load(node)
        else:
            if process.name not in self._starts:
                self._starts[process.name] = asyncio.ensure_future(self._start_process(process))
            await asyncio.shield(self._starts[process.name])
        node.doing = "starting"
        if process is not None and process.channel is not None:
            if node.planned.holds:
                node.driver = ControlDriver(process.channel, node.name)
        elif node.planned.managed:
            node.doing = _APPEARING
            await self._appear_alone(node)
            node.driver = self._services(node.planned)

    async def _start_process(self, process: ManagedProcess) -> None:
        nodes = [self._system.nodes[key] for key in process.planned.nodes]
        for node in nodes:
            await self._hold_start(node)
            node.doing = "starting"
        await self._may_begin()
        channel = None
        hung = self._system.liveliness.watch_over(process, [node.name for node in nodes])
        if process.planned.run.kind is RunKind.PYTHON:
            channel = ControlChannel(
                HostSpec(
                    system=self._system.plan.system,
                    process=process.name,
                    domain_id=self._system.plan.domain_id,
                    discovery_range=self._system.plan.discovery_range,
                    nodes=tuple(node.planned for node in nodes),
                    folders=manifest_folders(node.planned for node in nodes),
                    log=process.log.shown,
                ),
                self._system.on_host_event,
                hung,
            )
        try:
            await process.spawn(self._spawner_of(process), channel)
        except (BringUpError, OSError) as error:
            text = error.message if isinstance(error, BringUpError) else str(error)
            message = (
                text if text.startswith("cannot") else f"cannot start {process.name!r}: {text}"
            )
            raise StepFailedError(message, rule=START_FAILED, subject=nodes[0].name) from error
        self._recorded()

    async def _hold_start(self, node: NodeRun) -> None:
        """Wait for what holds a start; a node that is not managed has no later step to hold."""
        conditions = (Condition.STARTED,) if node.planned.managed else tuple(Condition)
        for condition in conditions:
            await self._system.reached(node, condition, "start")

    async def _step(self, node: NodeRun, doing: Awaitable[T], limit_s: float, *, rule: Rule) -> T:
        """Await one step within its limit, and say in whole sentences why it failed.

        The end of the node's process ends the step: nothing else would, for a node that is
        awaited in the graph.
        """
        with self._progressing():
            return await self._stepping(node, doing, limit_s, rule=rule)

    async def _stepping(
        self, node: NodeRun, doing: Awaitable[T], limit_s: float, *, rule: Rule
    ) -> T:
        step = asyncio.ensure_future(doing)
        waits: set[asyncio.Future[object]] = {step}  # type: ignore[arg-type]
        if node.process is not None:
            waits.add(node.process.ended)  # type: ignore[arg-type]
        try:
            own_s = _OWN_S if rule is TRANSITION_FAILED else 0.0
            await wait_under_load(waits, limit_s + own_s, node.run_delay_s)
            if node.process is not None and node.process.ended.done() and not step.done():
                # Its last output may still be on the way.
                await asyncio.wait({step}, timeout=_WORDS_S)
            if step.done():
                return step.result()
            if node.process is not None and node.process.ended.done():
                raise died(node.process, node)
            raise _too_late(node, limit_s)
        except StepFailedError:
            raise
        except BringUpError as error:
            if isinstance(error, HostFailedError):
                raise _start_failed(error, node.name, **_process_of(node)) from error
            if isinstance(error, ChannelClosedError):
                await self._death(node)
                if node.process is not None and node.process.ended.done():
                    raise died(node.process, node) from error
            raise StepFailedError(
                error.message
                if rule is not START_FAILED or error.message.startswith("cannot")
                else f"cannot start {node.name!r}: {error.message}",
                rule=rule,
                subject=node.name,
                **_process_of(node),
            ) from error
        finally:
            if not step.done():
                node.stuck = True
                step.cancel()
                await asyncio.gather(step, return_exceptions=True)

    async def _death(self, node: NodeRun) -> None:
        """Give a process whose channel closed the time to show how it ended."""
        process = node.process
        if process is not None and process.state is not ProcessState.EXITED:
            await asyncio.wait([asyncio.shield(process.ended)], timeout=_DEATH_S)

    def _late(self, timeout_s: float) -> StepFailedError:
        """The whole bring-up took too long: say what every unfinished node was doing."""
        missing = [node for node in self._system.nodes.values() if node.doing]
        for node in missing:
            node.stuck = node.stuck or node.doing in _ING.values()
        culprit = next((node for node in missing if not node.doing.startswith("waits")), None)
        return StepFailedError(
            f"cannot bring up {self._system.plan.system!r} within {timeout_s:.3g} s: "
            f"{self.unfinished()}{next(filter(None, map(_unnamed, missing)), '')}",
            rule=DEADLINE,
            subject=culprit.name if culprit else self._system.plan.system,
            **(_process_of(culprit) if culprit else {}),
        )


async def _awaiting(awaitable: Awaitable[None]) -> None:
    await awaitable


def manifest_folders(nodes: Iterable[PlannedNode]) -> tuple[str, ...]:
    """Return the absolute folders of the manifests that declare some nodes."""
    folders = (str(Path(node.at.file).absolute().parent) for node in nodes if node.at.file)
    return tuple(dict.fromkeys(folders))


def died(process: ManagedProcess, node: NodeRun | None = None) -> StepFailedError:
    """The failure that an unexpected end of `process` is: what it said that it fails of, if it did.

    That can be known before any step on its nodes has begun, while others are still being started.
    """
    reasons = _not_hosted(process, node)
    if reasons:
        return reasons[0].joined(reasons[1:])
    names = process.planned.nodes
    doing = f" while {node.doing}" if node is not None and node.doing else ""
    subject = node.name if node is not None else process.name
    what = f"process {process.name!r}" if node is None else repr(node.name)
    holds = "" if node is None or (len(names) == 1) else f" with its process {process.name!r}"
    words = f": {process.last_words}" if process.last_words else ""
    failure = StepFailedError(
        f"cannot keep {what} running{holds}: pid {process.pid} died{doing}: "
        f"{process.ended.result()}{_not_run(process)}{words}",
        rule=PROCESS_DIED,
        subject=subject,
        process=process.name,
        log=process.log.shown,
    )
    failure.gone = process.carries
    return failure


def _not_run(process: ManagedProcess) -> str:
    """Name the program of a command where its status says, as of a shell, that it cannot be run."""
    why = {126: "may not be run", 127: "is not there"}.get(process.ended.result().status or 0)
    if why is None or process.planned.run.kind is not RunKind.COMMAND or not process.planned.argv:
        return ""
    return f", as of a program that {why}: {process.planned.argv[0]!r}"


def _not_hosted(process: ManagedProcess, node: NodeRun | None) -> list[StepFailedError]:
    """Return why a process cannot host its nodes, as far as it has said so.

    Args:
        process: one that we started.
        node: the subject where the process names none.
    """
    name = process.name if node is None else node.name
    log = str(process.log.path)
    failures = () if process.channel is None else process.channel.failures
    return [_start_failed(each, name, process=process.name, log=log) for each in failures]


def _start_failed(error: HostFailedError, name: str, **process: str) -> StepFailedError:
    """The failure of a process to host one of its nodes, by default `name`."""
    name = error.node or name
    message = error.message
    return StepFailedError(
        message if message.startswith("cannot") else f"cannot start {name!r}: {message}",
        rule=START_FAILED,
        subject=name,
        **process,
    )


def _too_late(node: NodeRun, limit_s: float) -> StepFailedError:
    where = "" if node.process is None else node.process.where()
    return StepFailedError(
        f"cannot bring up {node.name!r}: it was still {node.doing} after {limit_s:g} s"
        f"{where and f', in {where}'}{_unnamed(node)}",
        rule=DEADLINE,
        subject=node.name,
        **_process_of(node),
    )


_APPEARING = "waiting to appear in the graph"


def _unnamed(node: NodeRun) -> str:
    """Say how a node is named that a command may call otherwise; empty where that is not it."""
    process, planned = node.process, node.planned
    if process is None or process.planned.run.kind is not RunKind.COMMAND:
        return ""
    named = any(each.endswith(f"__node:={planned.name}") for each in process.planned.argv)
    if named or node.doing != _APPEARING:
        return ""
    return f"; if its code calls it otherwise, write 'name: {planned.name}' at nodes.{planned.key}"


def _is(doing: str) -> str:
    return doing if doing.startswith("waits") else f"is still {doing}"


def _process_of(node: NodeRun) -> dict[str, str]:
    """Return what a failure reports of the process of its node."""
    process = node.process
    return {} if process is None else {"process": process.name, "log": process.log.shown}
