"""The node configuration document: a node's identity, its endpoints as they are, its capabilities.

Owns: collecting a NodeConfiguration (schema: schemas/node_configuration.v1.schema.json) from a live
node; the transports, wire formats and communication paradigms of each RMW, as far as this package
can choose them (`connect_to`), which are the input of negotiation; what counts for its checksum, by
which a reader knows that it must read it again; and one notification for all changes within one
turn of the executor, none while there is no listener: a configuration costs a millisecond to
collect.

It is served at `~/get_configuration` and sent to a supervisor. See *Topological Discovery and
Communication Negotiation*, "Node Configuration Interface".
"""

from __future__ import annotations

import functools
import hashlib
import os
import threading
import traceback
import weakref
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any

from msgspec.structs import replace
from rclpy.exceptions import InvalidHandle
from rclpy.node import Node
from rclpy.utilities import get_rmw_implementation_identifier
from std_srvs.srv import Trigger

from lifecycle import codec
from lifecycle.errors import MiddlewareError
from lifecycle.manifest.model import EndpointKind
from lifecycle.manifest.qos import QosProfile
from lifecycle.measure.sample import Measured
from lifecycle.middleware.fastdds.nfe import SHARED_MEMORY, get_network_flow_endpoints, senders_of
from lifecycle.middleware.process.control import machine_id
from lifecycle.middleware.process.hosted import vouch_for
from lifecycle.middleware.rcl.graph_changes import is_server_matched
from lifecycle.middleware.rcl.graph_queries import endpoints_of, endpoints_of_node
from lifecycle.middleware.rcl.qos import from_rclpy
from lifecycle.middleware.rcl.rclpy_nodes import interface_of
from lifecycle.network.medium import CONNECTABLE, Medium
from lifecycle.network.nfe import NetworkFlowEndpoint
from lifecycle.node.author import parameters
from lifecycle.node.author.declaring import interface_name
from lifecycle.node.connections.connections import Connection, Connections
from lifecycle.node.connections.data_layer import NodeDataLayer
from lifecycle.node.endpoints.making import CLIENTS
from lifecycle.node.endpoints.mapping import Mapping, count_peers, wire_name
from lifecycle.plan.model import PlannedEndpoint, PlannedNode
from lifecycle.plan.negotiation.data_layer import PARADIGMS, SERIALIZATIONS
from lifecycle.verify.observation import (
    EndpointReport,
    HealthReport,
    Identity,
    NodeConfiguration,
    ObservedEndpoint,
)
from lifecycle.verify.outcome import ConnectionReport
from lifecycle.verify.tool_filter import PREFIX_DIGITS

if TYPE_CHECKING:
    from rclpy.callback_groups import CallbackGroup

    from lifecycle.node.lifecycle.gate import Later


_CONFIGURABLE_RMW = "rmw_fastrtps_cpp"
_SHARED_MEMORY = "/dev/shm"  # noqa: S108 - what Fast DDS uses
_IPV6_ADDRESSES = "/proc/net/if_inet6"


@functools.lru_cache(maxsize=1)
def transports() -> tuple[str, ...]:
    """Return what nodes of this process can be connected by, as connection URLs spell it.

    Empty where the RMW's transports are not ours to choose: then what its endpoints' NFEs show is
    all that is known.
    """
    if get_rmw_implementation_identifier() != _CONFIGURABLE_RMW:
        return ()
    return tuple(sorted(each for each in CONNECTABLE if _is_here(each)))


def _is_here(medium: Medium) -> bool:
    """Whether this host has what a medium needs."""
    if not medium.is_network:
        return os.access(_SHARED_MEMORY, os.W_OK)
    if medium.ip_version != 6:
        return True
    try:
        with open(_IPV6_ADDRESSES, encoding="ascii") as file:  # noqa: PTH123 - in each host
            return bool(file.read().strip())
    except OSError:  # a kernel without IPv6
        return False


_DIGITS = 16


def checksum(configuration: NodeConfiguration) -> str:
    """Return 16 hex digits that change exactly when a reader must read the document again.

    State, matches, what follows from them (whether a connection is established) and what is
    measured change all the time and are reported by events, so they do not count.
    """
    stable = replace(
        configuration,
        state="",
        connected=False,
        checksum="",
        measured=None,
        endpoints=tuple(
            replace(each, matched=None, server_matched=None) for each in configuration.endpoints
        ),
        connections=tuple(replace(each, established=False) for each in configuration.connections),
    )
    return hashlib.sha256(codec.to_json(stable)).hexdigest()[:_DIGITS]


def endpoint_reports(
    node: Node, data_layer: NodeDataLayer, undeclared: Iterable[tuple[EndpointKind, Any]]
) -> tuple[EndpointReport, ...]:
    """Return what the endpoints of one of our nodes are now.

    Args:
        node: the node itself.
        data_layer: its declared endpoints and their entities.
        undeclared: kind and rclpy object of endpoints that its code made by itself.
    """
    return (
        *(_report(node, mapping) for mapping in data_layer.mappings),
        *(_undeclared_report(node, kind, entity) for kind, entity in undeclared),
    )


def foreign_reports(
    node: Node,
    spec: PlannedNode,
    connections: Connections,
    endpoints: Iterable[tuple[EndpointKind, Any, Connection]],
) -> tuple[tuple[EndpointReport, ...], tuple[ConnectionReport, ...]]:
    """Return what endpoints and connections of a node are now of which the class is not ours.

    Args:
        node: the node itself.
        spec: what it was planned to be.
        connections: its participant, and those that give endpoints flows of their own.
        endpoints: kind, rclpy object and connection of what it has made.
    """
    declared = {(each.kind, each.resolved): each for each in spec.endpoints}
    reports: list[EndpointReport] = []
    for kind, entity, connection in endpoints:
        try:
            report = _undeclared_report(node, kind, entity, connection)
        except InvalidHandle:
            continue  # destroyed meanwhile
        planned = declared.pop((kind, report.resolved), None)
        reports.append(report if planned is None else _named(report, planned, connection))
    reports += [
        EndpointReport(
            kind=each.kind,
            name=each.name,
            resolved=each.resolved,
            type=each.type,
            qos=each.qos,
            mapped=False,
        )
        for each in declared.values()
    ]
    return tuple(reports), tuple(
        _foreign_connection(each, spec, reports) for each in (connections.own, *connections.named)
    )


def _named(
    report: EndpointReport, planned: PlannedEndpoint, connection: Connection
) -> EndpointReport:
    error = connection.warning if planned.enforce_dscp else ""
    return replace(report, name=planned.name, unique=planned.unique, error=error)


def _foreign_connection(
    connection: Connection, spec: PlannedNode, reports: Iterable[EndpointReport]
) -> ConnectionReport:
    urls = connection.urls or (() if connection.name else spec.connections.urls)
    on = [each for each in reports if each.mapped and each.connection == connection.name]
    return ConnectionReport(
        name=connection.name,
        urls=urls,
        node_name=connection.node_name,
        prefix=_prefix_of(connection),
        established=all(each.matched for each in on if each.kind.is_topic),
        mappings=tuple(each.kind.spell(each.name) for each in on if each.name),
    )


def collect(
    node: Node,
    state: str,
    *,
    connected: bool,
    endpoints: tuple[EndpointReport, ...],
    connections: tuple[ConnectionReport, ...],
    health: HealthReport | None = None,
    measured: Measured | None = None,
) -> NodeConfiguration:
    """Return the configuration of `node` as it is now.

    Args:
        node: the node itself.
        state: lifecycle_msgs/State label; empty for a plain node.
        connected: its data layer is made.
        endpoints: what they are now.
        connections: what they are now, the node's own participant first.
        health: what it says of itself; None if it says nothing.
        measured: what its subscriptions have counted; None while it is not active.
    """
    name, prefix = node.get_fully_qualified_name(), _gid_prefix(node)
    vouch_for(prefix)  # before it is answered with
    configuration = NodeConfiguration(
        identity=Identity(
            machine_id=machine_id(),
            process_id=os.getpid(),
            node_id=f"{name}@{prefix}",
        ),
        name=name,
        state=state,
        connected=connected,
        rmw=get_rmw_implementation_identifier(),
        transports=transports() or _transports(endpoints),
        serializations=SERIALIZATIONS,
        paradigms=PARADIGMS,
        endpoints=endpoints,
        connections=connections,
        parameters=parameters.reports(node),
        health=health,
        measured=measured,
    )
    return replace(configuration, checksum=checksum(configuration))


def connection_reports(
    spec: PlannedNode, data_layer: NodeDataLayer
) -> tuple[ConnectionReport, ...]:
    """Return every connection that exists or was asked for, the node's own participant first."""
    connections = data_layer.connections
    made = tuple(
        ConnectionReport(
            name=each.name,
            urls=each.urls or (spec.connections.urls if each is connections.own else ()),
            node_name=each.node_name,
            prefix=_prefix_of(each),
            established=data_layer.status.established(each),
            mappings=tuple(mapping.spelling for mapping in data_layer.status.on(each)),
        )
        for each in (connections.own, *connections.named)
    )
    failed = tuple(
        ConnectionReport(name=each.name, urls=each.urls, error=each.error)
        for each in connections.failed
    )
    return (*made, *failed)


def serve(node: Node, collect: Callable[[], NodeConfiguration], group: CallbackGroup) -> None:
    """Offer `~/get_configuration`, which answers with the document as JSON, in every state."""

    def describe(_: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        try:
            response.message = codec.to_json(collect()).decode()
            response.success = True
        except Exception as error:  # noqa: BLE001 - asking must not end the node
            node.get_logger().error(traceback.format_exc())
            response.message = f"cannot describe this node: {error!r}"
        return response

    Node.create_service(node, Trigger, "~/get_configuration", describe, callback_group=group)


def _report(node: Node, mapping: Mapping) -> EndpointReport:
    endpoint, entity, connection = mapping.endpoint, mapping.entity, mapping.connection
    carrier = connection.node_name if connection is not None else ""
    report = EndpointReport(
        kind=endpoint.kind,
        name=endpoint.name,
        resolved=mapping.wire_name,
        type=endpoint.type,
        qos=endpoint.qos,
        unique=endpoint.unique,
        participant=carrier if connection is not None else endpoint.participant,
        error=mapping.error,
        connection=connection.name if connection is not None else "",
        mapped=connection is not None,
        lossy=mapping.lossy,
        size_bytes=mapping.size_bytes,
    )
    if entity is None:
        return report
    if endpoint.kind in CLIENTS:
        return replace(report, server_matched=is_server_matched(entity))
    if not endpoint.kind.is_topic:
        return report
    # A participant knows its own endpoints; the node's own need not know those of another.
    hidden = connection.participant if connection is not None else None
    witness = node if hidden is None else hidden.node
    report = _with_matches(report, witness, entity)
    return replace(
        report, nfes=_nfes(witness, endpoint.kind, entity, connection), dscp=_dscp(connection)
    )


def _undeclared_report(
    node: Node, kind: EndpointKind, entity: Any, connection: Connection | None = None
) -> EndpointReport:
    """Report an endpoint that no interface declares; it has no name but the one on the wire."""
    resolved = wire_name(entity)
    interface = interface_of(entity)
    report = EndpointReport(
        kind=kind, name="", resolved=resolved, type=interface_name(interface), mapped=True
    )
    if connection is None:
        connection = Connection(name="")
    elif kind in CLIENTS:
        return replace(report, server_matched=is_server_matched(entity))
    if not kind.is_topic:
        return report
    hidden = connection.participant
    witness = node if hidden is None else hidden.node
    report = _with_matches(report, witness, entity)
    return replace(
        report,
        nfes=_nfes(witness, kind, entity, connection),
        dscp=_dscp(connection),
        connection=connection.name,
        participant=connection.node_name,
    )


def _with_matches(report: EndpointReport, witness: Node, entity: Any) -> EndpointReport:
    """Add to the report on a publisher or subscription its GID, QoS, type hash and matches.

    Args:
        report: the topic's name and the kind count.
        witness: the node whose participant carries it.
        entity: its rclpy object.
    """
    info = _own_endpoint(witness, report.resolved, report.kind)
    return replace(
        report,
        qos=_actual_qos(entity, info),
        gid=info.gid if info is not None else "",
        matched=count_peers(entity),
        type_hash=info.type_hash if info is not None else None,
    )


def _own_endpoint(node: Node, topic: str, kind: EndpointKind) -> ObservedEndpoint | None:
    """Return what this process's graph cache says of the node's own endpoint on `topic`.

    It knows own endpoints at once, discovery has no part in it. None if there is none, or if
    there are several: nothing says which is which.
    """
    name = node.get_fully_qualified_name()
    own = [info for info in endpoints_of(node, kind, topic) if info.node == name]
    return own[0] if len(own) == 1 else None


_GID_PREFIXES: weakref.WeakKeyDictionary[Node, str] = weakref.WeakKeyDictionary()


def _gid_prefix(node: Node) -> str:
    """Return the participant's part of the node's GIDs in hex; empty if unknown."""
    known = _GID_PREFIXES.get(node, "") or _read_gid_prefix(node)
    if known:
        _GID_PREFIXES[node] = known
    return known


def _read_gid_prefix(node: Node) -> str:
    for name in ("~/transition_event", "/parameter_events"):
        topic = node.resolve_topic_name(name)
        info = _own_endpoint(node, topic, EndpointKind.PUBLISHER)
        if info is not None:
            return info.gid[:PREFIX_DIGITS]
    return ""


def _prefix_of(connection: Connection) -> str:
    """Return the GID prefix of a connection's own participant in hex; empty if unknown.

    It has nothing but what is mapped onto it, of which this process's graph cache knows at once. Of
    another process that has a node of this name, it may know too.
    """
    if connection.participant is None:
        return ""
    node = connection.participant.node
    name = node.get_fully_qualified_name()
    found: set[str] = set()
    for kind in (each for each in EndpointKind if not each.is_action):
        for each, _ in endpoints_of_node(node, kind, name) or ():
            infos = endpoints_of(node, kind, each)
            found.update(info.gid[:PREFIX_DIGITS] for info in infos if info.node == name)
    return found.pop() if len(found) == 1 else ""


def _nfes(
    witness: Node, kind: EndpointKind, entity: Any, connection: Connection | None
) -> tuple[NetworkFlowEndpoint, ...] | None:
    """Return all NFEs of a connected endpoint, shared memory included.

    rmw_fastrtps lists shared memory for subscriptions only, but what carries a flow depends on
    both ends having it.
    """
    publishes = kind is EndpointKind.PUBLISHER
    try:
        nfes = senders_of(witness) if publishes else get_network_flow_endpoints(entity)
    except MiddlewareError:
        return None  # "unknown to the RMW" is a value here, and the verifier's to judge
    if publishes and connection is not None and connection.has_shared_memory:
        return (*nfes, SHARED_MEMORY)
    return nfes


def _dscp(connection: Connection | None) -> int | None:
    try:
        return None if connection is None else connection.read_dscp()
    except MiddlewareError:
        return None  # likewise: sockets that cannot be read are "not read"


def _actual_qos(entity: Any, info: ObservedEndpoint | None) -> QosProfile:
    """Return the QoS in force; history and depth, which the graph lacks, as they were asked for."""
    asked = from_rclpy(entity.qos_profile)
    if info is None or info.qos is None:
        return asked
    return replace(info.qos, history=asked.history, depth=asked.depth)


def _transports(endpoints: tuple[EndpointReport, ...]) -> tuple[str, ...]:
    """Return what the node can be reached by, as far as its endpoints' NFEs show."""
    return tuple(sorted({nfe.medium for each in endpoints for nfe in each.nfes or ()}))


Listener = Callable[["NodeConfiguration"], None]


class ConfigurationChanges:
    """The listeners of one node's configuration.

    Args:
        later: runs a function in the node's executor.
        collect: returns the configuration as it is now.
        failed: called with the traceback if it cannot be collected; no listener is notified then.
    """

    def __init__(
        self,
        later: Later,
        collect: Callable[[], NodeConfiguration],
        *,
        failed: Callable[[str], None],
    ) -> None:
        self._later = later
        self._collect = collect
        self._failed = failed
        self._listeners: list[Listener] = []
        self._lock = threading.Lock()
        self._behind: list[Listener] = []
        self._scheduled = False

    def listen(self, listener: Listener) -> None:
        """Call `listener` with the configuration, in the executor, after each change."""
        self._listeners.append(listener)

    def close(self) -> None:
        """Notify of nothing any more: the node's process leaves DDS."""
        self._listeners.clear()
        with self._lock:
            self._behind = []

    def touch(self) -> None:
        """Something of the configuration has changed, match counts included; from any thread."""
        with self._lock:
            self._behind = list(self._listeners)
            if self._scheduled or not self._behind:
                return
            # Before it is handed over: it may have run when `later` returns.
            self._scheduled = True
        if not self._later(self._notify):
            self._scheduled = False

    def give(self, listener: Listener) -> tuple[NodeConfiguration, bool]:
        """Return the configuration as it is now to who gives it to `listener`.

        Returns:
            And whether that takes the place of its notification: it is not notified any more of
            what changed before.
        """
        with self._lock:
            behind = listener in self._behind
            self._behind = [each for each in self._behind if each != listener]
        return self._collect(), behind

    def _notify(self) -> None:
        with self._lock:
            self._scheduled = False
            behind, self._behind = self._behind, []
        if not behind:
            return
        configuration = self.collect()
        if configuration is None:
            return
        for listener in behind:
            listener(configuration)

    def collect(self) -> NodeConfiguration | None:
        """Return the configuration as it is now; None, and a line in the log, if that fails."""
        try:
            return self._collect()
        except Exception:  # noqa: BLE001 - describing itself must not end the node
            self._failed(traceback.format_exc())
            return None
