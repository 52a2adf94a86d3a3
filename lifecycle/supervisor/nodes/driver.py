"""Drives one managed node: over our control channel, or through its lifecycle services.

Owns: `NodeDriver`, of two kinds. Deadlines are the caller's: every call may be cancelled. The order
of operations is the core's. Must not import rclpy at run time.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Awaitable, Callable, Iterator, Mapping
from typing import TYPE_CHECKING

import msgspec

from lifecycle.errors import BringUpError, MiddlewareError
from lifecycle.node.host.control import Command, Operation
from lifecycle.plan.model import PlannedNode
from lifecycle.printable import one_line
from lifecycle.supervisor.core.state import Step, limit_of
from lifecycle.supervisor.processes.control_channel import ControlChannel
from lifecycle.verify.observation import NodeConfiguration

if TYPE_CHECKING:
    from lifecycle.middleware.services.clients import NodeClients


ACTIVE = "active"
INACTIVE = "inactive"
UNCONFIGURED = "unconfigured"
FINALIZED = "finalized"
"""lifecycle_msgs/State labels."""

_PRIMARY = (ACTIVE, INACTIVE, UNCONFIGURED, FINALIZED)

_PASSING_S = 0.1
"""Who drives a node that is in the middle of a transition is somebody else: it is asked again."""


Permit = Callable[[], Awaitable[None]]
"""The right to send one node its activate request, asked for where the bytes leave.

It returns once the request may leave, and nothing may be awaited after it; it raises ChangedError
where the gate has closed again."""


class NodeCondition(msgspec.Struct, frozen=True, kw_only=True):
    """State of a node after an operation.

    Attributes:
        state: lifecycle_msgs/State label.
        connected: the data layer is made.
        already: nothing was asked of it: it was there before.
    """

    state: str
    connected: bool = False
    already: bool = False


class ActiveError(BringUpError):
    """A node is active before it was verified, or each time that it was deactivated."""


class ChangedError(BringUpError):
    """A node was not activated: it is not any more as it was when it was verified."""


class ControlDriver:
    """Drives a node of our own host over the process's control channel."""

    def __init__(self, channel: ControlChannel, node: str) -> None:
        self._channel = channel
        self._node = node

    async def perform(self, operation: Operation, permit: Permit | None = None) -> NodeCondition:
        """Send the operation and wait for the reply.

        Raises:
            ChangedError: see there; what it is now is reported.
            BringUpError: the node refused or failed, or cannot be reached.
        """
        reply = await self._channel.request(Command(node=self._node, operation=operation), permit)
        if not reply.ok:
            reason = reply.error or f"the node is {reply.state or 'in an unknown state'}"
            kind = ChangedError if reply.changed else BringUpError
            raise kind(f"cannot {operation.value} {self._node!r}: {reason}")
        return NodeCondition(state=reply.state, connected=reply.connected)

    async def interface(self) -> NodeConfiguration | None:
        """Ask the host for the node's configuration, which says what it can be wired by."""
        return await self.wire(Command(node=self._node, operation=Operation.GET_CONFIGURATION))

    async def wire(self, step: Command) -> NodeConfiguration | None:
        """Send the step and wait for the reply.

        Raises:
            BringUpError: the node refused or failed, or cannot be reached.
        """
        reply = await self._channel.request(step)
        if not reply.ok:
            raise BringUpError(f"cannot {step}: {reply.error or 'the node gives no reason'}")
        return reply.configuration


_REACHED = {
    Operation.CONFIGURE: INACTIVE,
    Operation.ACTIVATE: ACTIVE,
    Operation.DEACTIVATE: INACTIVE,
    Operation.CLEANUP: UNCONFIGURED,
    Operation.SHUTDOWN: FINALIZED,
}
_BEGINS_IN = {
    Operation.CONFIGURE: (UNCONFIGURED,),
    Operation.ACTIVATE: (INACTIVE,),
    Operation.DEACTIVATE: (ACTIVE,),
    Operation.CLEANUP: (INACTIVE,),
    Operation.SHUTDOWN: (UNCONFIGURED, INACTIVE, ACTIVE),
}
_TRIES = 3
"""A node that somebody else moves meanwhile is asked so often."""

_REQUEST_S = 5.0
"""For one request to a node of which no plan says how long it may take."""

_NESTED = (Operation.CONNECT, Operation.DISCONNECT)
"""Only our own nodes have these; a foreign node makes its data layer inside configure."""


class NodeInterfaceClient:
    """Wires a node through its node interface, in whichever process it is."""

    def __init__(self, services: NodeClients, node: str, timeout_s: float = _REQUEST_S) -> None:
        self._services = services
        self._node = node
        self._timeout_s = timeout_s

    async def interface(self) -> NodeConfiguration | None:
        """Ask `~/get_configuration`; None where the node has none.

        Raises:
            BringUpError: it has one, which does not answer or cannot be read.
        """
        with _failed_steps():
            return await self._services.get_configuration(self._node, timeout_s=self._timeout_s)

    async def wire(self, step: Command) -> NodeConfiguration | None:
        """Call the node interface's service, and read what came of it.

        Raises:
            BringUpError: the node refused or failed, or did not answer.
        """
        asked: tuple[str, str, str | tuple[str, ...]] = ("disconnect", step.connection, "")
        if step.operation is Operation.CONNECT_TO:
            asked = ("connect_to", step.connection, step.connections.urls)
        elif step.operation is Operation.MAP_TO:
            asked = ("map_to", step.endpoint, step.connection)
        with _failed_steps(f"cannot {step}: "):
            await self._services.wire(self._node, *asked, timeout_s=self._timeout_s)
        return await self.interface()


class ServiceDriver(NodeInterfaceClient):
    """Drives a managed node that we do not host, whatever state it is in already.

    A request that was refused or not answered is judged by the state that is read afterwards; where
    somebody else moved the node meanwhile, it is asked again.
    """

    def __init__(self, services: NodeClients, node: PlannedNode) -> None:
        super().__init__(services, node.full_name, node.timeouts.connect_s)
        self._planned = node

    async def start(self) -> NodeCondition:
        """Wait until the services answer."""
        with _failed_steps():
            return _standing(await self._settled(self._planned.timeouts.start_s))

    async def perform(self, operation: Operation, permit: Permit | None = None) -> NodeCondition:
        """Change the state unless the node is there already."""
        with _failed_steps():
            return await self._perform(operation, permit)

    async def _settled(self, limit_s: float) -> str:
        """Return its state; one in which somebody else's transition is under way passes."""
        while True:
            state = await self._services.get_state(self._node, timeout_s=limit_s)
            if state in _PRIMARY:
                return state
            await asyncio.sleep(_PASSING_S)

    async def _perform(self, operation: Operation, permit: Permit | None) -> NodeCondition:
        limit_s = limit_of(self._planned, Step(operation.value))
        state = await self._settled(limit_s)
        if operation in _NESTED:
            offered = await self._services.get_available_transitions(self._node, timeout_s=limit_s)
            asked = operation.value in offered
            if asked and not await self._ask(operation, limit_s, permit):
                raise BringUpError(f"cannot {operation.value} {self._node!r}: it refused")
            return _standing(state, already=not asked)
        wanted, reason, asked, accepted = _REACHED[operation], "it is", False, False
        for _ in range(_TRIES):
            if state == wanted and operation is Operation.ACTIVATE and permit is not None:
                await permit()
                # The gate may have had it deactivated meanwhile.
                state = await self._settled(limit_s)
            if state == wanted:
                return _standing(state, already=not asked)
            if operation is Operation.CONFIGURE and state == ACTIVE:
                raise ActiveError(
                    f"cannot configure {self._node!r}: it is active already, and nobody verified "
                    "it; have it adopted as it is with 'lifecycle up --adopt', or deactivate it "
                    f"first: ros2 lifecycle set {self._node} deactivate"
                )
            if state not in _BEGINS_IN[operation]:
                break  # rclpy's nodes end of a request that their state does not allow
            accepted = await self._ask(operation, limit_s, permit)
            before, state, asked = state, await self._settled(limit_s), True
            if state == wanted:
                return _standing(state)
            reason = "it refused and is"
            if accepted:
                reason = "it stayed" if state == before else "others moved it, and it is"
            elif state == before:
                break
            # Somebody has moved it meanwhile: it is looked at again.
        if operation is Operation.DEACTIVATE and state == ACTIVE and accepted:
            raise ActiveError(
                f"cannot deactivate {self._node!r}: it was activated again by its own code or "
                f"another client each of the {_TRIES} times"
            )
        raise BringUpError(f"cannot {operation.value} {self._node!r}: {reason} {state}")

    async def _ask(self, operation: Operation, limit_s: float, permit: Permit | None) -> bool:
        """Ask for a transition; return whether it was accepted and completed."""
        activates = operation is Operation.ACTIVATE
        if activates and permit is None:
            raise BringUpError(f"cannot activate {self._node!r} without a permit from the gate")
        return await self._services.change_state(
            self._node,
            operation.value,
            timeout_s=limit_s,
            before=permit if activates else None,
        )


NodeDriver = ControlDriver | ServiceDriver


def _standing(state: str, *, already: bool = False) -> NodeCondition:
    return NodeCondition(state=state, connected=state in {INACTIVE, ACTIVE}, already=already)


@contextlib.contextmanager
def _failed_steps(before: str = "") -> Iterator[None]:
    """Turn the middleware's errors into those of a failed step."""
    try:
        yield
    except MiddlewareError as error:
        raise BringUpError(f"{before}{error.message}", hint=error.hint) from error


_LONGEST_COMMAND = 100


def where_it_runs(processes: Mapping[int, str]) -> str:
    """Return a process as people read it; empty where none is known."""
    for pid, command in processes.items():
        text = one_line(command)
        cut = "" if len(text) <= _LONGEST_COMMAND else "…"
        return f"pid {pid}, {text[:_LONGEST_COMMAND]}{cut}"
    return ""
