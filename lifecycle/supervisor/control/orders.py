"""Orders to a supervisor that holds a system: pause, resume, restart.

Owns: `Order`, which orders fit which phase, and the mailbox that hands them to the session one by
one. How they are carried out is sequence.py's. Must not import rclpy.
"""

from __future__ import annotations

import asyncio
import dataclasses
import enum

from lifecycle.errors import BringUpError, ExitCode, UsageError
from lifecycle.plan.model import Plan
from lifecycle.supervisor.nodes.system import NodeRun, System
from lifecycle.supervisor.processes.states import ProcessState

ACTIVE = "active"
PAUSED = "paused"
HELD = "held"
"""Phases in which orders are taken. HELD: some nodes wait at a gate that stayed closed."""


class OrderKind(enum.Enum):
    """What may be ordered."""

    PAUSE = "pause"
    RESUME = "resume"
    RESTART = "restart"


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Order:
    """One order.

    Attributes:
        node: for RESTART, manifest key or fully qualified name; empty for the whole system.
        plan: what the manifest that the order names comes to now; None if it names none.
        reload: for RESTART, `plan` is to run from now on.
    """

    kind: OrderKind
    node: str = ""
    plan: Plan | None = None
    reload: bool = False


class NotBegunError(BringUpError):
    """An order that could not be begun: the system is as it was."""


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Done:
    """What came of an order.

    Attributes:
        error: why it was not carried out; empty if it was.
    """

    exit_code: int = ExitCode.OK
    error: str = ""


_PHASES = {
    OrderKind.PAUSE: (ACTIVE, HELD),
    OrderKind.RESUME: (PAUSED, HELD),
    OrderKind.RESTART: (ACTIVE, PAUSED, HELD),
}
_HINTS = {
    OrderKind.PAUSE: "only an active system can be paused",
    OrderKind.RESUME: "only a paused system can be resumed",
    OrderKind.RESTART: "only a system that is active or paused can be restarted",
}


def check_order(order: Order, system: System, phase: str) -> None:
    """Make sure that an order can be carried out now.

    Raises:
        UsageError: it does not fit the phase, or names a node that cannot be restarted.
    """
    if phase not in _PHASES[order.kind]:
        raise UsageError(
            f"cannot {order.kind.value} {system.plan.system!r}: it is {phase}",
            hint=_HINTS[order.kind],
        )
    server = system.server
    if order.kind is OrderKind.RESTART and server and server.state is ProcessState.EXITED:
        raise UsageError(
            f"cannot restart {order.node or system.plan.system!r}: the discovery server has died, "
            "and without it nobody who comes again is found",
            hint="start the system again: lifecycle down, then lifecycle up",
        )
    if order.node:
        node_of(order, system)


def node_of(order: Order, system: System) -> NodeRun:
    """Return the node that an order names.

    Raises:
        UsageError: there is none, or it is not ours to restart.
    """
    for node in system.nodes.values():
        if order.node in (node.planned.key, node.name):
            if node.process is None:
                raise UsageError(f"cannot restart {node.name!r}: somebody else runs it")
            return node
    known = ", ".join(
        sorted(node.name for node in system.nodes.values() if node.process is not None)
    )
    raise UsageError(
        f"cannot restart {order.node!r}: this supervisor runs no such node; it runs: {known}"
    )


class Pending:
    """An order that waits to be carried out, or is."""

    def __init__(self, order: Order) -> None:
        self.order = order
        self.done: asyncio.Future[Done] = asyncio.get_running_loop().create_future()

    def finish(self, done: Done) -> None:
        """Tell who gave it; a second time is harmless."""
        if not self.done.done():
            self.done.set_result(done)


class Mailbox:
    """Orders in the order in which they came."""

    def __init__(self) -> None:
        self._queue: asyncio.Queue[Pending] = asyncio.Queue()
        self._open: set[Pending] = set()

    async def place(self, order: Order) -> Done:
        """Give an order and wait for what comes of it."""
        pending = Pending(order)
        self._open.add(pending)
        try:
            await self._queue.put(pending)
            return await asyncio.shield(pending.done)
        finally:
            self._open.discard(pending)

    async def next(self) -> Pending:
        """Wait for the next order."""
        return await self._queue.get()

    def close(self, reason: str) -> None:
        """Refuse what is still open."""
        for pending in tuple(self._open):
            pending.finish(Done(exit_code=ExitCode.BRING_UP_FAILED, error=reason))
