"""What a supervisor's commands do to the nodes of a process.

Owns: each Operation of control.py, and that each command is answered exactly once. They drive the
same state machines that the lifecycle services do.
"""

from __future__ import annotations

import traceback
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

from lifecycle.errors import LifecycleError
from lifecycle.node.connections.node_interface import NodeInterface
from lifecycle.node.host.control import Command, Event, Operation
from lifecycle.node.lifecycle.machine import Outcome

if TYPE_CHECKING:
    from lifecycle.node.author.node import LifecycleNode

_ANSWERED_WITHOUT_CONFIGURATION = frozenset(
    {Operation.ACTIVATE, Operation.DEACTIVATE, Operation.CLEANUP, Operation.SHUTDOWN}
)


class HostCommands:
    """Carries out the commands to the nodes of one process.

    Args:
        nodes: the managed ones by full name, as they are at any time.
        of_process: what the operations of the whole process do.
    """

    def __init__(
        self,
        nodes: Mapping[str, LifecycleNode],
        of_process: Mapping[Operation, Callable[[], object]],
    ) -> None:
        self._nodes = nodes
        self._of_process = of_process

    async def execute(self, command: Command) -> Event:
        """Carry out one command and return the answer to it, whatever happens."""
        try:
            return await self._carry_out(command)
        except LifecycleError as error:
            return self._reply(command, ok=False, error=str(error), describe=False)
        except Exception as error:  # noqa: BLE001 - each command is answered exactly once
            traceback.print_exc()
            line = f"{type(error).__name__}: {error}"
            return self._reply(command, ok=False, error=line, describe=False)

    async def _carry_out(self, command: Command) -> Event:
        node = self._nodes.get(command.node)
        if node is None:
            known = ", ".join(self._nodes) or "no managed node"
            raise LifecycleError(f"cannot find node {command.node!r}; this process hosts {known}")
        if command.operation is Operation.GET_CONFIGURATION:
            return self._reply(command, ok=True)
        if command.operation in self._of_process:
            self._of_process[command.operation]()
            return self._reply(command, ok=True)
        if command.operation in _NODE_INTERFACE:
            await _NODE_INTERFACE[command.operation](node.lifecycle.interface, command)
            return self._reply(command, ok=True)
        result = await node.lifecycle.change_for_supervisor(command.operation.value)
        return self._reply(command, ok=result.outcome is Outcome.SUCCESS, error=result.error)

    def _reply(
        self, command: Command, *, ok: bool, error: str = "", describe: bool = True
    ) -> Event:
        node = self._nodes.get(command.node)
        if node is None:
            return Event(kind="reply", node=command.node, id=command.id, ok=ok, error=error)
        state = node.lifecycle.state
        carries = describe and (
            command.operation not in _ANSWERED_WITHOUT_CONFIGURATION
            # Of its sockets nobody tells: what its callback did to them is read when it has ended.
            or (command.operation is Operation.ACTIVATE and node.lifecycle.is_marked)
        )
        return Event(
            kind="reply",
            node=command.node,
            id=command.id,
            ok=ok,
            state=state.seen.label,
            connected=state.connected,
            error=error,
            configuration=node.lifecycle.get_configuration() if carries else None,
        )


async def _connect_to(interface: NodeInterface, command: Command) -> None:
    interface.connect_to(command.connection, command.connections)


async def _map_to(interface: NodeInterface, command: Command) -> None:
    await interface.map_to(command.endpoint, command.connection)


async def _disconnect_from(interface: NodeInterface, command: Command) -> None:
    interface.disconnect(command.connection)


_NODE_INTERFACE = {
    Operation.CONNECT_TO: _connect_to,
    Operation.MAP_TO: _map_to,
    Operation.DISCONNECT_FROM: _disconnect_from,
}
