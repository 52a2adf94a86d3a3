"""The control channel to one host process, seen from the supervisor.

Owns: requests and their replies, "ready"/"failed", and the place where an activate request leaves:
it demands a permit. Protocol: lifecycle/node/host/control.py. Must not import rclpy.
"""

from __future__ import annotations

import asyncio
import contextlib
import socket
from collections.abc import Callable
from typing import TYPE_CHECKING

from msgspec.structs import replace

from lifecycle.codec import from_json, to_json
from lifecycle.errors import BringUpError
from lifecycle.middleware.process.busy_sign import BusySign
from lifecycle.node.host.control import Command, Event, HostSpec, Operation

if TYPE_CHECKING:
    from lifecycle.supervisor.nodes.driver import Permit

_LONGEST_LINE = 1 << 24
"""Bytes; a node configuration with thousands of endpoints is one line."""

_CLOSE_S = 0.5
"""For a host to read what it was sent before."""


class ChannelClosedError(BringUpError):
    """The host closed its end: it is ending or has died."""


class HostFailedError(BringUpError):
    """The host cannot construct a node, and ends.

    Attributes:
        node: fully qualified name; empty if it could not host any.
    """

    def __init__(self, node: str, message: str) -> None:
        super().__init__(message)
        self.node = node


class ControlChannel:
    """Talks to one host process over a socket whose other end the host inherits.

    Args:
        spec: what it hosts.
        on_state: called with what it reports of its nodes unasked, and with each reply that has a
            configuration.
        on_hang: called with True when its executor is busy for too long, False when it came back.

    Attributes:
        sign: shows whether its executor is busy; None before `open` and once nobody watches it.
        failures: what kept its nodes from being constructed, each cause once, the first one first.
    """

    def __init__(
        self,
        spec: HostSpec,
        on_state: Callable[[Event], None],
        on_hang: Callable[[bool], None] = lambda _: None,
    ) -> None:
        self._spec = spec
        self._on_state = on_state
        self._on_hang = on_hang
        self.sign: BusySign | None = None
        self._looking: asyncio.TimerHandle | None = None
        self.failures: list[HostFailedError] = []
        self._next = 0
        self._replies: dict[int, asyncio.Future[Event]] = {}
        self._ready: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        # The host may end before a caller waits for "ready".
        self._ready.add_done_callback(lambda done: done.cancelled() or done.exception())
        self._writer: asyncio.StreamWriter | None = None
        self._task: asyncio.Task[None] | None = None

    async def open(self) -> socket.socket:
        """Make the pair, send the host its spec, and return the end that the host inherits.

        The caller closes the returned socket once the host was started.
        """
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_STREAM)
        ours.setblocking(False)
        line = to_json(self._spec) + b"\n"
        # Its nodes share its executor.
        self.sign = BusySign.make(max(node.timeouts.silent_s for node in self._spec.nodes))
        socket.send_fds(ours, [line[:1]], [self.sign.descriptor])
        self._look()
        reader, self._writer = await asyncio.open_connection(sock=ours, limit=_LONGEST_LINE)
        self._writer.write(line[1:])
        self._task = asyncio.get_running_loop().create_task(self._read(reader))
        return theirs

    async def ready(self) -> None:
        """Wait until every node of the process is constructed and its executor spins.

        Raises:
            HostFailedError: construction failed; with the host's reason.
            ChannelClosedError: the host ended without a reason.
        """
        await asyncio.shield(self._ready)

    async def request(self, command: Command, permit: Permit | None = None) -> Event:
        """Ask one node for one operation and wait for its reply; only ACTIVATE needs a permit.

        Raises:
            ChannelClosedError: the host ended before it replied.
            BringUpError: an activate request without a permit that holds.
            ChangedError: what changed since the verdict does not allow it.
        """
        node = command.node
        if command.operation is Operation.ACTIVATE:
            if permit is None:
                raise BringUpError(f"cannot activate {node!r} without a permit from the gate")
            await permit()
        if (number := self.send(command)) is None:
            raise ChannelClosedError(
                f"cannot reach {node!r}: its process closed the control channel"
            )
        reply: asyncio.Future[Event] = asyncio.get_running_loop().create_future()
        self._replies[number] = reply
        try:
            return await reply
        finally:
            self._replies.pop(number, None)

    def send(self, command: Command) -> int | None:
        """Send a command, and return the number of its reply; None to a host that has ended."""
        if self._writer is None or self._task is None or self._task.done():
            return None
        self._next += 1
        self._writer.write(to_json(replace(command, id=self._next)) + b"\n")
        return self._next

    async def drained(self, timeout_s: float) -> None:
        """Wait, bounded, for what a host that has ended wrote before."""
        if self._task is not None:
            await asyncio.wait({self._task}, timeout=timeout_s)

    async def _read(self, reader: asyncio.StreamReader) -> None:
        reason = "its process closed the control channel"
        try:
            while line := await reader.readline():
                self._dispatch(from_json(line, Event))
        except ConnectionError:
            pass
        except ValueError as error:
            reason = f"its process sent what is not an event: {error}"
        finally:
            # A process that was killed while it was busy would be said to hang.
            self._watch_no_more()
            self._fail(ChannelClosedError(f"cannot reach process {self._spec.process!r}: {reason}"))

    def _dispatch(self, event: Event) -> None:
        if event.kind == "reply":
            if event.configuration is not None:
                # Now, in its turn: who awaits the reply goes on after what comes next.
                self._on_state(event)
            reply = self._replies.get(event.id)
            if reply is not None and not reply.done():
                reply.set_result(event)
        elif event.kind == "ready":
            if not self._ready.done():
                self._ready.set_result(None)
        elif event.kind == "failed":
            failure = HostFailedError(event.node, event.error)
            self.failures.append(failure)
            if not self._ready.done():
                self._ready.set_exception(failure)
        elif event.kind == "beat":
            self._on_hang(False)
        elif event.kind in ("state", "configuration", "measured", "destroyed"):
            self._on_state(event)

    def _look(self) -> None:
        if self.sign is not None:
            hangs, again_s = self.sign.look()
            self._looking = asyncio.get_running_loop().call_later(again_s, self._look)
            if hangs:
                self._on_hang(True)

    def _watch_no_more(self) -> None:
        if self._looking is not None:
            self._looking.cancel()
        if self.sign is not None:
            self.sign.close()
            self.sign = None

    def _fail(self, error: ChannelClosedError) -> None:
        if not self._ready.done():
            self._ready.set_exception(error)
        for reply in self._replies.values():
            if not reply.done():
                reply.set_exception(error)

    async def close(self) -> None:
        """End it in order, which makes the host shut down."""
        self._watch_no_more()
        if self._writer is not None:
            writer, self._writer = self._writer, None
            writer.write(to_json(Command(node="", operation=Operation.END)) + b"\n")
            writer.close()
            closed = asyncio.ensure_future(writer.wait_closed())
            await asyncio.wait({closed}, timeout=_CLOSE_S)
            writer.transport.abort()
            # A host that was stopped, and has not read all it was sent, is ended by signals.
            await asyncio.gather(closed, return_exceptions=True)
        if self._task is not None:
            self._task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await self._task
            self._task = None
