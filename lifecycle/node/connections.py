"""The connections of one node: extra participants that its endpoints can be mapped onto.

`connect_to` of *Topological Discovery and Communication Negotiation*.
"""

from __future__ import annotations

import contextlib
import functools
import re
from collections.abc import Collection, Iterable
from typing import TYPE_CHECKING

import msgspec

from lifecycle.errors import LifecycleError, MiddlewareError, nearest
from lifecycle.middleware.fastdds.nfe import senders_of
from lifecycle.middleware.fastdds.participant import FlowParticipant
from lifecycle.network.connection_url import ConnectionUrl
from lifecycle.plan.model import ParticipantConnections, PlannedParticipant

if TYPE_CHECKING:
    from rclpy.node import Node


_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*")
_LONGEST_NODE_NAME = 255  # rmw/validate_node_name.h


class UnknownConnectionError(LifecycleError, KeyError):
    """Code named a connection that the node has not."""


class ConnectError(LifecycleError):
    """A connection or an endpoint could not be made as asked; none was left."""


class Connection(msgspec.Struct, kw_only=True, eq=False):
    """One participant that endpoints are mapped onto; what `connect_to` returns.

    Attributes:
        name: as `connect_to` named it; empty for the node's own participant, and for one that only
            gives a publisher its own flow.
        urls: what it was made from, as text; empty if the RMW chose.
        node_name: base name of the hidden node that owns the participant; empty for the node's own.
        participant: None for the node's own, and once disconnected.
        warning: what of it could not be made as asked, while the rest was; empty otherwise.
        error: why it could not be made; empty if it was.
    """

    name: str
    urls: tuple[str, ...] = ()
    node_name: str = ""
    participant: FlowParticipant | None = None
    warning: str = ""
    error: str = ""

    @property
    def node(self) -> Node | None:
        """The hidden node that owns the participant; None for the node's own."""
        return None if self.participant is None else self.participant.node

    def read_dscp(self) -> int | None:
        """Return the DSCP on its sender sockets, 0–63; None where that is not known."""
        if self.participant is None:
            return None
        try:
            return self.participant.read_dscp()
        except MiddlewareError:
            return None


class Connections:
    """All connections of one node; its own participant is always one of them."""

    def __init__(self, node: Node, planned: Iterable[PlannedParticipant]) -> None:
        self._node = node
        self._planned = {each.name: each for each in planned}
        self.own = Connection(name="")
        self._made: dict[str, Connection] = {}  # by name of the hidden node
        self._failed: dict[str, Connection] = {}  # by name
        with contextlib.suppress(MiddlewareError):
            senders_of(node)  # before it has peers

    @property
    def named(self) -> tuple[Connection, ...]:
        """Those with a name of their own, in the order in which they were made."""
        return tuple(each for each in self._made.values() if each.name)

    @property
    def failed(self) -> tuple[Connection, ...]:
        """Those that were asked for and could not be made."""
        return tuple(self._failed.values())

    @property
    def marks(self) -> tuple[int | None, ...]:
        """DSCP on the sender sockets of each participant, as it is now; None: cannot be read."""
        return tuple(each.read_dscp() for each in tuple(self._made.values()))

    def find(self, connection: Connection | str) -> Connection:
        """Return the connection that is meant; raises UnknownConnectionError.

        The empty name is the node's own participant.
        """
        name = connection if isinstance(connection, str) else connection.name
        for each in (self.own, *self._made.values()):
            if each is connection or each.name == connection:
                return each
        names = [each.name for each in self.named]
        near = nearest(name, names)
        listed = ", ".join(repr(each) for each in names) or "none but its own participant, ''"
        raise UnknownConnectionError(
            f"cannot find connection {name!r} of {self._node.get_fully_qualified_name()}",
            hint=(f"did you mean {near!r}? " if near else "") + f"connected: {listed}",
        )

    def connect_to(self, name: str, how: ParticipantConnections) -> Connection:
        """Make the participant of a named connection; one that exists so already is returned.

        The plan says more of a connection that it knows by this name. Raises ConnectError.
        """
        what = f"cannot connect {self._node.get_fully_qualified_name()} to {name!r}"
        if not _NAME.fullmatch(name):
            raise ConnectError(
                f"{what}: a connection's name is made of letters, digits and underscores, and "
                "begins with a letter"
            )
        if not how.urls:
            raise ConnectError(f"{what}: no URL was given", hint="udpv4://, tcpv4://…:5100, shm://")
        found = next((each for each in self.named if each.name == name), None)
        if found is not None:
            if found.urls == how.urls:
                return found
            raise ConnectError(
                f"{what} ({', '.join(how.urls)}): it is connected to {', '.join(found.urls)}",
                hint="disconnect it first, or choose another name",
            )
        planned = next((each for each in self._planned.values() if each.connection == name), None)
        try:
            if planned is None:
                base = f"_{self._node.get_name()}_{name}"[:_LONGEST_NODE_NAME]
                planned = PlannedParticipant(name=base, dscp=None, reason="connect_to")
            return self._make(name, how, planned)
        except LifecycleError as error:
            message = f"{what} ({', '.join(how.urls)}): {error.message}"
            self._failed[name] = Connection(name=name, urls=how.urls, error=message)
            raise ConnectError(message, hint=error.hint) from error

    def planned(self, name: str) -> Connection:
        """Return the connection on a participant of the plan, made at first use.

        The node's own, if the plan has none of this name; raises LifecycleError.
        """
        planned = self._planned.get(name)
        if planned is None:
            return self.own
        if planned.connection:
            return self.connect_to(planned.connection, planned.connections)
        return self._made.get(name) or self._make("", planned.connections, planned)

    def is_named(self, name: str) -> bool:
        """Whether a participant of the plan is a connection with a name."""
        return name in self._planned and bool(self._planned[name].connection)

    def close(self, connection: Connection) -> None:
        """Unmake a connection that nothing is mapped onto any more."""
        self._made.pop(connection.node_name, None)
        participant, connection.participant = connection.participant, None
        if participant is not None:
            participant.destroy()

    def close_unused(self, used: Collection[Connection]) -> None:
        """Unmake participants of single flows that carry nothing any more."""
        for each in tuple(self._made.values()):
            if not each.name and each not in used:
                self.close(each)

    def forget(self, name: str) -> bool:
        """Forget a connection that could not be made; returns whether there was one."""
        return self._failed.pop(name, None) is not None

    def close_all(self) -> None:
        """Unmake every connection but the node's own."""
        for connection in reversed(tuple(self._made.values())):
            self.close(connection)
        self._failed.clear()

    def _make(
        self, name: str, how: ParticipantConnections, planned: PlannedParticipant
    ) -> Connection:
        """Make a participant; without its DSCP, which the verifier judges, where that fails."""
        make = functools.partial(
            FlowParticipant,
            planned.name,
            self._node.get_namespace(),
            self._node.context.get_domain_id(),
            transports=planned.transports,
            max_datagram_bytes=planned.max_datagram_bytes,
            non_blocking_send=planned.non_blocking_send,
            connections=how,
            served=self._node,
        )
        warning = ""
        try:
            participant = make(dscp=planned.dscp)
        except MiddlewareError as error:
            if planned.dscp is None:
                raise
            warning = str(error)
            self._node.get_logger().warning(warning)
            participant = make()
        connection = Connection(
            name=name,
            urls=how.urls,
            node_name=planned.name,
            participant=participant,
            warning=warning,
        )
        self._failed.pop(name, None)
        self._made[planned.name] = connection
        return connection


def connections_of(urls: Iterable[ConnectionUrl | str]) -> ParticipantConnections:
    """Return what `connect_to(*urls)` asks for; a URL's text is kept as it was written."""
    return ParticipantConnections(urls=tuple(str(url) for url in urls))
