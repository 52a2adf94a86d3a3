"""What the graph's state shows of one node, and what a change changes.

Owns: the types that `GraphState` gives out, and how an event about connections and mappings alters
a node configuration until it is read again. Pure.
"""

from __future__ import annotations

import dataclasses

from lifecycle.graph.endpoints import EndpointChange
from lifecycle.graph.event import NodeLiveliness
from lifecycle.graph.messages import (
    ConnectionEstablished,
    ConnectionLost,
    GraphMessage,
    MappingEstablished,
    MappingLost,
)
from lifecycle.verify.observation import ConnectionReport, EndpointReport, NodeConfiguration


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class NodeView:
    """A node as it is known now.

    Attributes:
        name: fully qualified.
        incarnation: which instance; empty if it sends no graph messages.
        liveliness: whether it is there and does its work.
        reason: why it is not alive; empty if it is.
        state: lifecycle_msgs/State label, empty for a node that is not managed; None while unknown.
        connected: its data layer is made; None while unknown.
        configuration: as it was read, and brought up to date by events since; None until then.
    """

    name: str
    incarnation: str = ""
    liveliness: NodeLiveliness = NodeLiveliness.ALIVE
    reason: str = ""
    state: str | None = None
    connected: bool | None = None
    configuration: NodeConfiguration | None = None

    @property
    def endpoints(self) -> tuple[EndpointReport, ...]:
        """Its endpoints; none while its configuration is not known."""
        return () if self.configuration is None else self.configuration.endpoints

    @property
    def connections(self) -> tuple[ConnectionReport, ...]:
        """Its connections; none while its configuration is not known."""
        return () if self.configuration is None else self.configuration.connections


_SAME = EndpointChange()


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class GraphChange:
    """What is different about one node.

    Attributes:
        before: the node before; None if it joined, or was restarted.
        after: the node now; None if it left.
        endpoints: what became of its endpoints.
        connections: its connections that are new or different, as they are now.
        disconnected: names of the connections that it has no more.
    """

    before: NodeView | None
    after: NodeView | None
    endpoints: EndpointChange = _SAME
    connections: tuple[ConnectionReport, ...] = ()
    disconnected: tuple[str, ...] = ()

    @property
    def node(self) -> str:
        """Fully qualified name of the node."""
        view = self.after or self.before
        assert view is not None
        return view.name

    @property
    def joined(self) -> bool:
        """The node was not there before."""
        return self.before is None

    @property
    def left(self) -> bool:
        """The node is not there any more."""
        return self.after is None

    @property
    def state_changed(self) -> bool:
        """Its lifecycle state is another one, or is known only now."""
        return self._state(self.before) != self._state(self.after)

    @property
    def liveliness_changed(self) -> bool:
        """It fell silent, got stuck, or is alive again."""
        return (
            self.before is not None
            and self.after is not None
            and self.before.liveliness is not self.after.liveliness
        )

    @staticmethod
    def _state(view: NodeView | None) -> tuple[str | None, bool | None]:
        return (None, None) if view is None else (view.state, view.connected)


def change(
    before: NodeView | None, after: NodeView | None, endpoints: EndpointChange
) -> GraphChange:
    """Return what is different between two views of one node."""
    old = {each.name: each for each in before.connections} if before else {}
    new = {each.name: each for each in after.connections} if after else {}
    return GraphChange(
        before=before,
        after=after,
        endpoints=endpoints,
        connections=tuple(each for name, each in new.items() if old.get(name) != each),
        disconnected=tuple(name for name in old if name not in new),
    )


def kept(configuration: NodeConfiguration) -> NodeConfiguration:
    """Return a configuration without what no message brings up to date: matches of servers."""
    if all(each.server_matched is None for each in configuration.endpoints):
        return configuration
    return dataclasses.replace(
        configuration,
        endpoints=tuple(
            dataclasses.replace(each, server_matched=None) for each in configuration.endpoints
        ),
    )


def altered(configuration: NodeConfiguration, message: GraphMessage) -> NodeConfiguration:
    """Return a configuration as it is after a message about a connection or a mapping.

    What the message names and the configuration has not is passed over: then the configuration is
    to be read again anyway, and its checksum says so.
    """
    if isinstance(message, ConnectionEstablished | ConnectionLost):
        return dataclasses.replace(
            configuration, connections=_connections(configuration.connections, message)
        )
    if isinstance(message, MappingEstablished | MappingLost):
        return dataclasses.replace(
            configuration,
            endpoints=tuple(_endpoint(each, message) for each in configuration.endpoints),
        )
    return configuration


def _connections(
    held: tuple[ConnectionReport, ...], message: ConnectionEstablished | ConnectionLost
) -> tuple[ConnectionReport, ...]:
    by_name = {each.name: each for each in held}
    known = by_name.get(message.connection, ConnectionReport(name=message.connection))
    urls = message.urls or known.urls
    if isinstance(message, ConnectionEstablished):
        known = dataclasses.replace(known, urls=urls, established=True, error="")
    elif message.error or not message.connection:
        known = dataclasses.replace(known, urls=urls, established=False, error=message.error)
    else:
        by_name.pop(message.connection, None)
        return tuple(by_name.values())
    by_name[message.connection] = known
    return tuple(by_name.values())


def _endpoint(
    endpoint: EndpointReport, message: MappingEstablished | MappingLost
) -> EndpointReport:
    if message.endpoint != spelled(endpoint):
        return endpoint
    lost = isinstance(message, MappingLost)
    if lost and endpoint.mapped and endpoint.connection != message.connection:
        return endpoint  # handed over: it is on another connection already
    if isinstance(message, MappingLost) and message.matched is None:
        return dataclasses.replace(
            endpoint, mapped=False, connection="", matched=None, peers=None, error=message.error
        )
    return dataclasses.replace(
        endpoint,
        mapped=True,
        connection=message.connection,
        matched=endpoint.matched if message.matched is None else message.matched,
        peers=endpoint.peers if message.matched in (None, endpoint.matched) else None,
    )


def spelled(endpoint: EndpointReport) -> str:
    """Return how messages and `map_to` call an endpoint: `publishers/video`."""
    return f"{endpoint.kind.value}/{endpoint.name or endpoint.resolved}"
