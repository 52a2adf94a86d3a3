"""The control channel between a supervisor and its host processes: messages and the host's end.

One JSON object per line over an inherited AF_UNIX stream socket. It carries what the lifecycle
services and `~/get_configuration` carry, without waiting for discovery; both ways drive the same
state machine. End of file from the supervisor makes a host shut down; without an END before it the
supervisor was killed, and nodes are deactivated first. Imports no rclpy.
"""

from __future__ import annotations

import contextlib
import enum
import os
import socket
import sys
import threading
import traceback
from collections.abc import Iterator

import msgspec

from lifecycle import codec
from lifecycle.errors import LifecycleError
from lifecycle.manifest.model import DiscoveryRange
from lifecycle.measure.sample import Measured
from lifecycle.plan.model import ParticipantConnections, PlannedNode
from lifecycle.verify.observation import NodeConfiguration


class Operation(enum.Enum):
    """What a supervisor may ask of one node; each is answered by exactly one Reply."""

    CONFIGURE = "configure"
    CONNECT = "connect"
    ACTIVATE = "activate"
    DEACTIVATE = "deactivate"
    DISCONNECT = "disconnect"
    CLEANUP = "cleanup"
    SHUTDOWN = "shutdown"
    GET_CONFIGURATION = "get_configuration"
    # The node interface (*Topological Discovery and Communication Negotiation*).
    CONNECT_TO = "connect_to"  # connection, urls
    MAP_TO = "map_to"  # endpoint, connection
    DISCONNECT_FROM = "disconnect_from"  # connection
    # Of the whole process: a link is down, and retransmit soon what was not acknowledged; and
    # announce to the graph anew which nodes are here.
    SEND_AGAIN_SOON = "send_again_soon"
    REPUBLISH_NAMES = "republish_names"
    MEASURE = "measure"  # apart: report what is counted from now on
    # Not answered: the end of file that follows is orderly, not that of a killed supervisor.
    END = "end"


class HostSpec(msgspec.Struct, frozen=True, kw_only=True):
    """First line from the supervisor: what this process hosts.

    Attributes:
        folders: absolute, of the manifest and what it includes: modules are looked for there.
        log: file that it appends its output to once its supervisor was killed; empty for none.
        joins: the rest of its system runs already, and is asked to announce itself at once.
        measures: what is counted is reported: the plan has numbers to compare it with.
        apart: fully qualified topics whose publishers another supervisor has, on another clock.
    """

    system: str
    process: str
    domain_id: int
    discovery_range: DiscoveryRange
    nodes: tuple[PlannedNode, ...]
    folders: tuple[str, ...] = ()
    log: str = ""
    joins: bool = False
    measures: bool = False
    apart: tuple[str, ...] = ()


class Command(msgspec.Struct, frozen=True, kw_only=True):
    """Supervisor → host.

    Attributes:
        id: given as it is sent.
        node: fully qualified name.
        connection: name of a connection, for CONNECT_TO, MAP_TO and DISCONNECT_FROM.
        connections: what to connect to, for CONNECT_TO.
        endpoint: `publishers/video`, kind and declared name, for MAP_TO.
        apart: as HostSpec has it, for MEASURE.
    """

    id: int = 0
    node: str
    operation: Operation
    connection: str = ""
    connections: ParticipantConnections = ParticipantConnections()
    endpoint: str = ""
    apart: tuple[str, ...] = ()

    def __str__(self) -> str:
        """Return what it asks as text, as it follows "cannot"."""
        if self.operation is Operation.CONNECT_TO:
            urls = ", ".join(self.connections.urls) or "no URL"
            return f"connect {self.node!r} to {self.connection!r} ({urls})"
        if self.operation is Operation.MAP_TO:
            where = f"connection {self.connection!r}" if self.connection else "its own participant"
            return f"map {self.endpoint!r} of {self.node!r} to {where}"
        if self.operation is Operation.DISCONNECT_FROM:
            return f"disconnect {self.node!r} from {self.connection!r}"
        return f"{self.operation.value} {self.node!r}"


class Event(msgspec.Struct, frozen=True, kw_only=True):
    """Host → supervisor; exactly one of the groups below is set.

    Attributes:
        kind: "ready" (all nodes constructed, executor spinning), "failed" (construction failed;
            `error` says why, the process exits),
            "state" (a node's state changed), "reply", "beat" (the executor has returned from a
            callback that took too long), "configuration" (it changed: endpoints, connections,
            mappings or matches), "measured" (every half second, of an active node), "destroyed" (by
            its own code, in a process that goes on).
        id: the Command's id, for "reply".
        ok: the operation succeeded, for "reply".
        state: lifecycle_msgs/State label after it; empty of a plain node.
        connected: the data layer is made.
        error: the reason, with the exception's last line; the traceback is in the log.
        configuration: for "configuration", and replies that carry it (all but ACTIVATE,
            DEACTIVATE, CLEANUP and SHUTDOWN).
        changed: of a reply to ACTIVATE: nothing was done, for the node is not as it was reported.
        measured: for "measured".
    """

    kind: str
    node: str = ""
    id: int = 0
    ok: bool = True
    state: str = ""
    connected: bool = False
    error: str = ""
    configuration: NodeConfiguration | None = None
    changed: bool = False
    measured: Measured | None = None


_AT_ONCE_BYTES = 1 << 16

_LAST_S = 1.0
"""For a supervisor to read what is still to be sent when a host ends."""

_NEWEST = frozenset({"state", "configuration", "beat", "measured"})
"""Events of which only the latest of a node is worth sending to who does not read."""

_MANY = 16
"""So many events wait for a supervisor that does not read."""


class HostChannel:
    """JSON lines both ways; written from any thread, read from one.

    Who writes never waits: what a supervisor that was stopped, or is slow, has no room for is kept
    in order until it reads on, and of what is reported unasked only the newest.

    Attributes:
        descriptors: of the busy sign, beside the first byte (SCM_RIGHTS, unix(7)); none if the
            host's executor is not watched.
    """

    def __init__(self, control: socket.socket) -> None:
        control.setblocking(True)
        self._control = control
        try:
            first, found, _, _ = socket.recv_fds(control, 1, 1)
        except ConnectionError:  # as at end of file
            first, found = b"", []
        self._received = bytearray(first)
        self.descriptors = tuple(found)
        for descriptor in found:
            os.set_inheritable(descriptor, False)
        self._changed = threading.Condition()
        self._kept: dict[tuple[object, ...], bytes] = {}  # by what it is of, in order
        self._number = 0
        self._sends = False
        threading.Thread(target=self._send, name="reports", daemon=True).start()

    def fileno(self) -> int:
        """Return the descriptor that is readable when `receive` is worth a call."""
        return self._control.fileno()

    def read(self) -> bytes | None:
        """Wait for the next line and return it, or None at end of file."""
        while (line := next(self.lines(), None)) is None:
            if not self.receive():
                return None
        return line

    def receive(self) -> bool:
        """Wait for more and keep it for `lines`; False at end of file."""
        try:
            data = self._control.recv(_AT_ONCE_BYTES)
        except OSError:  # a supervisor that was killed resets the connection
            return False
        self._received += data
        return bool(data)

    def lines(self) -> Iterator[bytes]:
        """Yield the whole lines that have been received."""
        while b"\n" in self._received:
            line, _, self._received = self._received.partition(b"\n")
            yield bytes(line)

    def write(self, event: Event) -> None:
        """Send one event; that a supervisor has gone is noticed by the reader."""
        line = codec.to_json(event) + b"\n"
        with self._changed:
            self._number += 1
            key: tuple[object, ...] = (self._number,)
            if event.kind in _NEWEST and len(self._kept) >= _MANY:
                key = (event.kind, event.node)
                self._kept.pop(key, None)  # the newer one takes a place behind all others
            self._kept[key] = line
            self._changed.notify_all()

    def drain(self) -> None:
        """Wait until all was sent, as long as a supervisor that runs may take."""
        with self._changed:
            self._changed.wait_for(lambda: not (self._sends or self._kept), _LAST_S)

    def _send(self) -> None:
        """Send what is kept, as soon as there is room for it."""
        while True:
            with self._changed:
                self._sends = False
                self._changed.notify_all()
                self._changed.wait_for(lambda: self._kept)
                line = self._kept.pop(next(iter(self._kept)))
                self._sends = True
            with contextlib.suppress(OSError):
                self._control.sendall(line)


def report_failure(channel: HostChannel, node: str, error: Exception) -> None:
    """Notify the supervisor why a node cannot be hosted, and leave the traceback in the log."""
    reason = str(error)
    if not isinstance(error, LifecycleError):
        reason = f"{type(error).__name__}: {error}"
        traceback.print_exception(error)
        sys.stderr.flush()
    channel.write(Event(kind="failed", node=node, ok=False, error=reason))
