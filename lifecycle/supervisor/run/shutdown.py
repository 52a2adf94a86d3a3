"""Taking a system down in reverse dependency order, bounded, whatever state it is in.

Owns: what is undone on each node, and that no process of the system is left. Used at the end of a
run and to roll back one that failed. Must not import rclpy.
"""

from __future__ import annotations

import asyncio
import functools
from collections.abc import Awaitable, Callable, Coroutine, Iterable
from typing import Any

from lifecycle.errors import BringUpError, MiddlewareError
from lifecycle.manifest.model import RunKind
from lifecycle.node.host.control import Command, Operation
from lifecycle.supervisor.control.protocol import ProcessState, Reach
from lifecycle.supervisor.nodes.bring_up import died
from lifecycle.supervisor.nodes.driver import ACTIVE, FINALIZED, INACTIVE
from lifecycle.supervisor.nodes.system import NodeRun, System
from lifecycle.supervisor.processes.control_channel import ChannelClosedError
from lifecycle.supervisor.processes.process import (
    COMMAND_ESCALATION,
    ESCALATION,
    STARTING_ESCALATION,
    STUCK_ESCALATION,
    ManagedProcess,
    wait_under_load,
)
from lifecycle.supervisor.run.events import Emitter, Notice, WiringChanged
from lifecycle.supervisor.run.failure import StepFailedError, ended

_DEATH_S = 0.5
"""A channel that a host closed by itself usually means that it dies."""

_WORDS_S = 0.1
"""For what a process wrote to its channel just before it ended."""

_DOING = {
    Operation.DEACTIVATE: "deactivating",
    Operation.DISCONNECT: "disconnecting",
    Operation.CLEANUP: "cleaning up",
    Operation.SHUTDOWN: "shutting down",
}
_UNDO = {
    Operation.ACTIVATE: Operation.DEACTIVATE,
    Operation.CONNECT: Operation.DISCONNECT,
    Operation.CONFIGURE: Operation.CLEANUP,
}


class TakeDown:
    """Takes one system down.

    Args:
        hurry: once set, nothing is asked politely any more and processes are killed at once.
        nodes: take only these down, and the processes that hold no others; None for all.

    Attributes:
        deaths: of processes that ended meanwhile although nobody had asked them to, or that were
            asked to and died; each was reported at once.
    """

    def __init__(
        self,
        system: System,
        emit: Emitter,
        hurry: asyncio.Event,
        *,
        nodes: Iterable[NodeRun] | None = None,
    ) -> None:
        self._system = system
        self._emit = emit
        self._hurry = hurry
        self.deaths: list[StepFailedError] = []
        self._lived: set[ManagedProcess] = set()
        self._dead: set[ManagedProcess] = set()
        self._polite: dict[str, asyncio.Event] = {key: asyncio.Event() for key in system.nodes}
        self._nodes = system.nodes
        if nodes is not None:
            self._nodes = {each.planned.key: each for each in nodes}
            for key in system.nodes.keys() - self._nodes.keys():
                self._polite[key].set()  # what stays is not waited for

    async def run(self) -> None:
        """Take everything down; afterwards none of the processes runs."""
        processes = [
            each
            for each in self._system.processes.values()
            if all(key in self._nodes for key in each.planned.nodes)
        ]
        for process in processes:
            if process.pid and not process.ended.done():
                self._lived.add(process)
                process.ended.add_done_callback(functools.partial(self._ended, process))
        await asyncio.gather(
            *(self._node(key, node) for key, node in self._nodes.items()),
            *map(self._process, processes),
        )
        await asyncio.sleep(0)  # what ended just now is reported

    def _ended(self, process: ManagedProcess, _: object) -> None:
        unasked = not (process.asked_to_end or process.is_over)
        if process.crashed or (unasked and not process.ended.result().is_clean):
            self._dies(process)

    def _dies(self, process: ManagedProcess) -> None:
        if process not in self._dead:
            self._dead.add(process)
            keys = process.planned.nodes
            failure = died(process, self._system.nodes[keys[0]] if len(keys) == 1 else None)
            self.deaths.append(failure)
            for each in failure.every:
                self._emit(each.event(ends_run=False))

    async def _look_at_end(self, process: ManagedProcess) -> None:
        """Report a host that has ended unasked, although with status 0, in the middle.

        One that others asked to end, by SIGTERM say, shuts its nodes down before it ends.
        """
        if process not in self._lived or process.channel is None:
            return
        if process.asked_to_end or not process.ended.done():
            return
        await asyncio.sleep(_WORDS_S)
        nodes = [self._system.nodes[key] for key in process.planned.nodes]
        managed = [each for each in nodes if each.driver is not None and each.planned.managed]
        if not process.is_over and any(each.state != FINALIZED for each in managed):
            self._dies(process)

    async def _node(self, key: str, node: NodeRun) -> None:
        """Undo what was done to one node once all its dependents are down."""
        try:
            node.doing = "being taken down"
            for dependent in self._system.dependents(key):
                await self._polite[dependent.planned.key].wait()
            await self._undo(node)
            await self._unload(node)
            if not node.planned.managed and node.process is not None:
                # All there is to undo is the process itself.
                await self._end(node.process)
        finally:
            self._polite[key].set()
            node.doing = ""

    async def _unload(self, node: NodeRun) -> None:
        """Have its container unload a component; one that ends now takes it along."""
        if node.unload is None:
            return
        container = node.planned.run.container
        ends = container in self._nodes and self._nodes[container].process is not None
        if not ends and not self._hurry.is_set():
            what, limit_s = f"unload {node.name!r}", node.planned.timeouts.cleanup_s
            await self._bounded(node, _unload(node.unload), what, limit_s)
        node.unload = None
        node.advance(Reach.STOPPED)

    async def _process(self, process: ManagedProcess) -> None:
        for key in process.planned.nodes:
            await self._polite[key].wait()
        await self._look_at_end(process)
        await self._end(process)
        for key in process.planned.nodes:
            node = self._system.nodes[key]
            if node.reach not in (Reach.WAITING, Reach.STOPPED):
                node.advance(Reach.STOPPED)

    async def _undo(self, node: NodeRun) -> None:
        if self._system.liveliness.is_out_of_reach(node.name):
            node.stuck = True
        operations = [_UNDO[each] for each in reversed(node.undo)]
        if node.found == ACTIVE:
            operations = []  # it is left active
        # A node that others started is theirs to end.
        if node.process is not None and node.reach is not Reach.WAITING:
            operations.append(Operation.SHUTDOWN)
        for operation in operations:
            if operation is Operation.DISCONNECT:
                await self._unwire(node)
            if self._hurry.is_set() or node.stuck or node.is_gone or node.driver is None:
                return
            if _applies(operation, node):
                # Also after one that failed: a node that refuses to clean up may still shut down.
                await self._ask(node, operation)

    async def _unwire(self, node: NodeRun) -> None:
        """Unmake what the authority connected the node to, the last connection first."""
        for name in reversed(node.connections):
            if self._hurry.is_set() or node.stuck or node.is_gone or node.driver is None:
                return
            step = Command(node=node.name, operation=Operation.DISCONNECT_FROM, connection=name)
            limit_s = node.planned.timeouts.cleanup_s
            if await self._bounded(node, node.driver.wire(step), f"{step}", limit_s):
                self._emit(WiringChanged(node=node.name, operation=step.operation, connection=name))
        node.connections = ()

    async def _ask(self, node: NodeRun, operation: Operation) -> None:
        limits = node.planned.timeouts
        limit_s = {
            Operation.DEACTIVATE: limits.deactivate_s,
            Operation.DISCONNECT: limits.cleanup_s,
            Operation.CLEANUP: limits.cleanup_s,
            Operation.SHUTDOWN: limits.shutdown_s,
        }[operation]

        async def perform() -> None:
            node.doing = _DOING[operation]
            condition = await node.perform(operation)
            node.report(condition.state, connected=condition.connected)

        await self._bounded(node, perform(), f"{operation.value} {node.name!r}", limit_s)

    async def _bounded(
        self, node: NodeRun, doing: Coroutine[Any, Any, object], what: str, limit_s: float
    ) -> bool:
        """Await one request within its limit; whether it was carried out."""
        request = asyncio.ensure_future(doing)
        hurry = asyncio.ensure_future(self._hurry.wait())
        waits: set[asyncio.Future[Any]] = {request, hurry}
        end = set() if node.process is None else {node.process.ended}
        try:
            await wait_under_load(waits | end, limit_s, node.run_delay_s)
            if not request.done() and node.is_gone:
                return False
            if not request.done():
                node.stuck = True
                if not self._hurry.is_set():
                    self._emit(
                        Notice(
                            message=f"cannot {what} within {limit_s:g} s; its process is ended "
                            "all the same"
                        )
                    )
                return False
            request.result()
        except BringUpError as error:
            if end and isinstance(error, ChannelClosedError):
                await asyncio.wait(end, timeout=_DEATH_S)
            if not node.is_gone:
                self._emit(Notice(message=error.message))
            return False
        else:
            return True
        finally:
            await ended(request, hurry)

    async def _end(self, process: ManagedProcess) -> None:
        escalation = ESCALATION
        if process.state is ProcessState.STARTING:
            escalation = STARTING_ESCALATION
        elif process.planned.run.kind is RunKind.COMMAND:
            escalation = COMMAND_ESCALATION
        elif any(self._system.nodes[key].stuck for key in process.planned.nodes):
            escalation = STUCK_ESCALATION
        needed = await process.end(escalation, self._hurry)
        if needed and not self._hurry.is_set():
            self._emit(Notice(message=f"process {process.name!r} had to be ended with {needed}"))


async def _unload(unload: Callable[[], Awaitable[None]]) -> None:
    try:
        await unload()
    except MiddlewareError as error:
        raise BringUpError(error.message) from error


def _applies(operation: Operation, node: NodeRun) -> bool:
    """Whether there is something to undo in the state that the node is in; it may have failed."""
    return {
        Operation.DEACTIVATE: node.state == ACTIVE,
        Operation.DISCONNECT: node.state == INACTIVE and node.connected,
        Operation.CLEANUP: node.state == INACTIVE,
        Operation.SHUTDOWN: node.state != FINALIZED,
    }[operation]
