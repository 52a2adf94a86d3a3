"""Types of the graph interface: events, members, node views, links, changes; the endpoint index.

Owns: the types of layers 2 and 3; which node has which endpoint, an index whose changes cost work
in proportion to the node's endpoints and whose queries in proportion to their answer; how a message
about a connection or a mapping alters a node configuration until it is read again; and the link of
a publisher with a subscription. Whether two are matched is judged as `lifecycle.verify` judges it
(`verify/rules/matching.py`). Pure; the index is not thread-safe.
"""

from __future__ import annotations

import enum
from collections.abc import Iterable, Sequence

from lifecycle import dataclasses
from lifecycle.graph.messages import (
    ConnectionEstablished,
    ConnectionLost,
    GraphMessage,
    MappingEstablished,
    MappingLost,
)
from lifecycle.manifest.model import EndpointKind
from lifecycle.network.medium import NETWORK_MEDIA
from lifecycle.network.nfe import FlowTuple, flow_tuples
from lifecycle.verify.observation import EndpointReport, Identity, NodeConfiguration
from lifecycle.verify.outcome import ConnectionReport, Outcome
from lifecycle.verify.rules.matching import match, obstacle
from lifecycle.verify.transport import NONE, carrier
from lifecycle.verify.view import SeenEndpoint


class EventKind(enum.Enum):
    """What happened; the first nine follow from the message of the same name."""

    JOINED = "joined"
    LEFT = "left"
    STATE_CHANGED = "state_changed"
    HEARTBEAT = "heartbeat"
    CONFIGURATION_CHANGED = "configuration_changed"
    CONNECTION_ESTABLISHED = "connection_established"
    CONNECTION_LOST = "connection_lost"
    MAPPING_ESTABLISHED = "mapping_established"
    MAPPING_LOST = "mapping_lost"
    SILENT = "silent"  # no message of the node comes any more
    ALIVE = "alive"  # they come again
    GAP = "gap"  # messages of the node were lost: read its configuration again
    ENDPOINT_ADDED = "endpoint_added"
    ENDPOINT_REMOVED = "endpoint_removed"
    ENDPOINT_CHANGED = "endpoint_changed"


class NodeLiveliness(enum.Enum):
    """Whether messages of a member of the graph come."""

    ALIVE = "alive"
    SILENT = "silent"


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class GraphEvent:
    """One thing that happened.

    Attributes:
        node: fully qualified name of the node that it happened to.
        incarnation: of that node; empty if it sends no graph messages.
        message: that said so; None if discovery, silence or a configuration did.
        reason: for people; empty if there is none.
        endpoint: for the three ENDPOINT kinds; as it is now, or was.
    """

    kind: EventKind
    node: str
    incarnation: str = ""
    message: GraphMessage | None = None
    reason: str = ""
    endpoint: EndpointReport | None = None


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Member:
    """A node that is part of the graph, as far as its messages say.

    Attributes:
        incarnation: empty if it sends no graph messages: then discovery has shown it.
        state: lifecycle_msgs/State label; None while unknown.
        connected: its data layer is made; None while unknown.
        checksum: of its node configuration; None while unknown, empty if it serves none.
        reason: why it is silent; empty if it is alive.
    """

    node: str
    incarnation: str = ""
    state: str | None = None
    connected: bool | None = None
    checksum: str | None = None
    liveliness: NodeLiveliness = NodeLiveliness.ALIVE
    reason: str = ""


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class EndpointChange:
    """What is different about one node's endpoints; the new report for those that changed."""

    added: tuple[EndpointReport, ...] = ()
    removed: tuple[EndpointReport, ...] = ()
    changed: tuple[EndpointReport, ...] = ()

    def __bool__(self) -> bool:
        """Whether anything is different."""
        return bool(self.added or self.removed or self.changed)


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Owned:
    """An endpoint and the node (fully qualified) that has it."""

    node: str
    endpoint: EndpointReport


_Key = tuple[EndpointKind, str, str, str, int]
"""Kind, resolved name, type, declared name; a number distinguishes equal ones of one node."""


class EndpointIndex:
    """The endpoints of all nodes."""

    def __init__(self) -> None:
        self._by_node: dict[str, dict[_Key, EndpointReport]] = {}
        self._by_name: dict[tuple[EndpointKind, str], dict[tuple[str, _Key], Owned]] = {}

    def update(self, node: str, endpoints: Iterable[EndpointReport]) -> EndpointChange:
        """Set the endpoints of `node` and return what is different from before."""
        new: dict[_Key, EndpointReport] = {}
        for endpoint in endpoints:
            key = (endpoint.kind, endpoint.resolved, endpoint.type, endpoint.name, 0)
            while key in new:
                key = (*key[:4], key[4] + 1)
            new[key] = endpoint
        old = self._by_node.get(node, {})
        removed = {key: each for key, each in old.items() if key not in new}
        added = {key: each for key, each in new.items() if key not in old}
        changed = {key: each for key, each in new.items() if key in old and old[key] != each}
        for key in (*removed, *changed):
            self._drop(node, key, old[key])
        for key, endpoint in (*added.items(), *changed.items()):
            self._put(node, key, endpoint)
        if new:
            self._by_node[node] = new
        else:
            self._by_node.pop(node, None)
        return EndpointChange(
            added=tuple(added.values()),
            removed=tuple(removed.values()),
            changed=tuple(changed.values()),
        )

    def named(self, kind: EndpointKind, name: str) -> tuple[Owned, ...]:
        """Return the endpoints of a kind that have this resolved name."""
        return tuple(self._by_name.get((kind, name), {}).values())

    def names(self, kind: EndpointKind) -> tuple[str, ...]:
        """Return every name that an endpoint of this kind has."""
        return tuple(name for each, name in self._by_name if each is kind)

    def _put(self, node: str, key: _Key, endpoint: EndpointReport) -> None:
        place = (endpoint.kind, endpoint.resolved)
        self._by_name.setdefault(place, {})[node, key] = Owned(node=node, endpoint=endpoint)

    def _drop(self, node: str, key: _Key, endpoint: EndpointReport) -> None:
        place = (endpoint.kind, endpoint.resolved)
        self._by_name[place].pop((node, key), None)
        if not self._by_name[place]:
            del self._by_name[place]


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class NodeView:
    """A node as it is known now.

    Attributes:
        name: fully qualified.
        incarnation: which instance; empty if it sends no graph messages.
        liveliness: whether messages of it come.
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
            endpoint, mapped=False, connection="", matched=None, error=message.error
        )
    return dataclasses.replace(
        endpoint,
        mapped=True,
        connection=message.connection,
        matched=endpoint.matched if message.matched is None else message.matched,
    )


def spelled(endpoint: EndpointReport) -> str:
    """Return how messages and `map_to` call an endpoint: `publishers/video`."""
    return f"{endpoint.kind.value}/{endpoint.name or endpoint.resolved}"


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class End:
    """An endpoint and the node that has it."""

    node: NodeView
    endpoint: EndpointReport


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Link:
    """A publisher and a subscription of one topic.

    Attributes:
        topic: the name by which they meet.
        connected: OK: data can go from one to the other; VIOLATED: they cannot; UNVERIFIABLE:
            that is not known.
        reason: why it is not OK; empty if it is.
        transport: what carries the data: "intraprocess", "shm", "udpv4", "udpv6", "tcpv4", "tcpv6";
            "none" if the two have nothing in common, "unknown" where that is not known.
        flows: the network flows that the data can take; empty if no network carries them.
    """

    topic: str
    publisher: End
    subscription: End
    connected: Outcome
    reason: str
    transport: str
    flows: tuple[FlowTuple, ...] = ()

    @property
    def connections(self) -> tuple[str, str]:
        """Names of the publisher's and the subscription's connection; empty: own participant."""
        return self.publisher.endpoint.connection, self.subscription.endpoint.connection


def link(
    topic: str,
    publisher: End,
    subscription: End,
    *,
    publishers: Sequence[SeenEndpoint],
    subscriptions: Sequence[SeenEndpoint],
) -> Link:
    """Judge one pair.

    Args:
        topic: the name by which they meet.
        publisher: one end.
        subscription: the other end.
        publishers: every publisher of this topic, see `match_ends`.
        subscriptions: every subscription of it.
    """
    source, destination = publisher.endpoint.nfes or (), subscription.endpoint.nfes or ()
    transport = carrier(source, destination, _identity(publisher), _identity(subscription))
    connected, reason = _judged(publisher, subscription, transport, publishers, subscriptions)
    return Link(
        topic=topic,
        publisher=publisher,
        subscription=subscription,
        connected=connected,
        reason=reason,
        transport=transport,
        flows=flow_tuples(source, destination) if transport in NETWORK_MEDIA else (),
    )


def _judged(
    publisher: End,
    subscription: End,
    transport: str,
    publishers: Sequence[SeenEndpoint],
    subscriptions: Sequence[SeenEndpoint],
) -> tuple[Outcome, str]:
    source, destination = _match_end(publisher), _match_end(subscription)
    cause = _missing(publisher) or _missing(subscription) or obstacle(source, destination)
    if not cause and transport == NONE:
        cause = "they have no transport in common"
    if cause:
        return Outcome.VIOLATED, cause
    found = match(source, destination, publishers, subscriptions)
    return found or (Outcome.UNVERIFIABLE, "neither end reports whom it is matched with")


def _match_end(end: End) -> SeenEndpoint:
    """Return an end as the rules of matching take it; the state holds no tools."""
    endpoint = end.endpoint
    return SeenEndpoint(
        kind=endpoint.kind,
        node=end.node.name,
        name=endpoint.resolved,
        type=endpoint.type,
        qos=endpoint.qos,
        report=endpoint,
    )


def match_ends(ends: Sequence[End]) -> tuple[SeenEndpoint, ...]:
    """Return the ends that can be matched; DDS forgets a silent one in time."""
    return tuple(
        _match_end(each) for each in ends if each.node.liveliness is not NodeLiveliness.SILENT
    )


def _missing(end: End) -> str:
    """Return why an end cannot be connected at all; empty if it can."""
    if end.node.liveliness is NodeLiveliness.SILENT:
        return f"{end.node.name} is silent"
    if end.endpoint.error:
        return f"{end.node.name}: {end.endpoint.error}"
    if not end.endpoint.mapped and not end.endpoint.gid:
        return f"{end.node.name} has not mapped it onto a connection"
    return ""


def _identity(end: End) -> Identity | None:
    configuration = end.node.configuration
    if configuration is None or not configuration.identity.machine_id:
        return None
    return configuration.identity
