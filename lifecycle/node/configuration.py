"""The node configuration document: a node's identity, its endpoints as they are, its capabilities.

It is served at `~/get_configuration` and sent to a supervisor: *Topological Discovery and
Communication Negotiation*, "Node Configuration Interface". Its schema is
schemas/node_configuration.v1.schema.json.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import os
import threading
import traceback
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any

import msgspec
from msgspec.structs import replace
from rclpy.exceptions import InvalidHandle
from rclpy.node import Node
from rclpy.utilities import get_rmw_implementation_identifier
from std_srvs.srv import Trigger

from lifecycle import codec
from lifecycle.errors import MiddlewareError
from lifecycle.manifest.model import EndpointKind
from lifecycle.manifest.qos import QosProfile
from lifecycle.middleware.fastdds.factory import has_shared_memory
from lifecycle.middleware.fastdds.nfe import SHARED_MEMORY, get_network_flow_endpoints, senders_of
from lifecycle.middleware.process.control import machine_id
from lifecycle.middleware.process.process_table import vouch_for
from lifecycle.middleware.rcl.conversions import from_rclpy
from lifecycle.middleware.rcl.graph_queries import is_server_matched, own_endpoint, prefix_of
from lifecycle.network.medium import CONNECTABLE
from lifecycle.network.nfe import NetworkFlowEndpoint
from lifecycle.node.connections import Connection, Connections
from lifecycle.node.endpoint import CLIENTS, Endpoint, count_peers
from lifecycle.node.planned import parameter_reports
from lifecycle.plan.model import PlannedNode
from lifecycle.verify.observation import (
    EndpointReport,
    HealthReport,
    Identity,
    NodeConfiguration,
    ObservedEndpoint,
)
from lifecycle.verify.outcome import ConnectionReport

if TYPE_CHECKING:
    from rclpy.callback_groups import CallbackGroup

    from lifecycle.node.gate import Later
    from lifecycle.node.host.adoption import Hosted

PARADIGMS = ("publish-subscribe", "request-response")
"""Topics; services, and actions, which consist of both."""

SERIALIZATIONS = ("cdr",)
"""OMG's Common Data Representation, the one wire format of ROS 2's DDS and zenoh RMWs."""


class HostedState(msgspec.Struct, frozen=True, kw_only=True):
    """The state of a hosted node.

    Attributes:
        label: lifecycle_msgs/State label; empty for a node that is not managed.
        connected: its data layer is made.
        steady: no transition is running.
    """

    label: str
    connected: bool
    steady: bool


_CONFIGURABLE_RMW = "rmw_fastrtps_cpp"
_SHARED_MEMORY = "/dev/shm"  # noqa: S108 - what Fast DDS uses


@functools.lru_cache(maxsize=1)
def transports() -> tuple[str, ...]:
    """Return what nodes of this process can be connected by, as connection URLs spell it.

    Empty where the RMW's transports are not ours to choose.
    """
    if get_rmw_implementation_identifier() != _CONFIGURABLE_RMW:
        return ()
    shares_memory = os.access(_SHARED_MEMORY, os.W_OK)
    return tuple(sorted(each for each in CONNECTABLE if each.is_network or shares_memory))


_DIGITS = 16


def checksum(configuration: NodeConfiguration) -> str:
    """Return 16 hex digits that change exactly when a reader must read the document again.

    State, matches and what is measured are reported by events, so they do not count.
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


def connection_reports(
    spec: PlannedNode, connections: Connections, endpoints: Iterable[EndpointReport]
) -> tuple[ConnectionReport, ...]:
    """Return every connection that exists or was asked for, the node's own participant first."""
    mapped = [each for each in endpoints if each.mapped]

    def report(connection: Connection) -> ConnectionReport:
        on = [each for each in mapped if each.connection == connection.name]
        return ConnectionReport(
            name=connection.name,
            urls=connection.urls or (() if connection.name else spec.connections.urls),
            node_name=connection.node_name,
            prefix="" if connection.node is None else prefix_of(connection.node),
            established=all(each.matched for each in on if each.kind.is_topic),
            mappings=tuple(each.kind.spell(each.name) for each in on if each.name),
        )

    failed = (
        ConnectionReport(name=each.name, urls=each.urls, error=each.error)
        for each in connections.failed
    )
    return (*map(report, (connections.own, *connections.named)), *failed)


def collect(
    hosted: Hosted,
    endpoints: Iterable[Endpoint],
    health: HealthReport | None = None,
) -> NodeConfiguration:
    """Return the configuration of a node as it is now."""
    node, state = hosted.node, hosted.reported
    reports = []
    for each in endpoints:
        with contextlib.suppress(InvalidHandle):  # it is being destroyed
            reports.append(_endpoint_report(node, each))
    name, prefix = hosted.full_name, prefix_of(node)
    vouch_for(prefix)  # before it is answered with
    configuration = NodeConfiguration(
        identity=Identity(
            machine_id=machine_id(),
            process_id=os.getpid(),
            node_id=f"{name}@{prefix}",
        ),
        name=name,
        state=state.label,
        connected=state.connected,
        rmw=get_rmw_implementation_identifier(),
        transports=transports()
        or tuple(sorted({nfe.medium for each in reports for nfe in each.nfes or ()})),
        serializations=SERIALIZATIONS,
        paradigms=PARADIGMS,
        endpoints=tuple(reports),
        connections=connection_reports(hosted.spec, hosted.connections, reports),
        parameters=parameter_reports(node),
        health=health,
        measured=hosted.gate.measured(),
    )
    return replace(configuration, checksum=checksum(configuration))


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


def _endpoint_report(node: Node, endpoint: Endpoint) -> EndpointReport:
    planned, placement = endpoint.planned, endpoint.placement
    report = EndpointReport(
        kind=endpoint.kind,
        name=endpoint.name,
        resolved=endpoint.wire_name,
        type=planned.type,
        qos=planned.qos,
        unique=planned.unique,
        participant=planned.participant,
        error=endpoint.error,
        fault=endpoint.fault,
        lossy=endpoint.lossy,
        size_bytes=endpoint.size_bytes,
    )
    if placement is None:
        return report
    connection, entity = placement.connection, placement.entity
    report = replace(
        report,
        participant=connection.node_name,
        error=report.error or (connection.warning if planned.enforce_dscp else ""),
        connection=connection.name,
        mapped=True,
    )
    if endpoint.kind in CLIENTS and placement.unwatch is not None:
        return replace(report, server_matched=is_server_matched(entity))
    if not endpoint.kind.is_topic:
        return report
    # A participant knows its own endpoints; the node's own need not know those of another.
    witness = connection.node or node
    info = own_endpoint(witness, endpoint.kind, report.resolved)
    return replace(
        report,
        qos=_actual_qos(entity, info),
        gid=info.gid if info is not None else "",
        matched=count_peers(entity),
        type_hash=info.type_hash if info is not None else None,
        nfes=_nfes(witness, endpoint.kind, entity),
        dscp=connection.read_dscp(),
    )


def _nfes(witness: Node, kind: EndpointKind, entity: Any) -> tuple[NetworkFlowEndpoint, ...] | None:
    """Return all NFEs of an endpoint; rmw_fastrtps lists shared memory of subscriptions only."""
    publishes = kind is EndpointKind.PUBLISHER
    try:
        nfes = senders_of(witness) if publishes else get_network_flow_endpoints(entity)
    except MiddlewareError:
        return None  # "unknown to the RMW" is a value here, and the verifier's to judge
    if publishes and has_shared_memory(witness):
        return (*nfes, SHARED_MEMORY)
    return nfes


def _actual_qos(entity: Any, info: ObservedEndpoint | None) -> QosProfile:
    """Return the QoS in force; history and depth, which the graph lacks, as they were asked for."""
    asked = from_rclpy(entity.qos_profile)
    if info is None or info.qos is None:
        return asked
    return replace(info.qos, history=asked.history, depth=asked.depth)


Listener = Callable[["NodeConfiguration"], None]


class ConfigurationChanges:
    """The listeners of one node's configuration, notified once in a turn of the executor.

    Args:
        later: runs a function in the node's executor.
        collect: returns the configuration as it is now; it takes a millisecond.
        failed: called with the traceback if that raises; no listener is notified then.
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
        self._scheduled = False

    def listen(self, listener: Listener) -> Callable[[], None]:
        """Call `listener` in the executor after each change; returns what ends that."""
        self._listeners.append(listener)

        def remove() -> None:
            if listener in self._listeners:
                self._listeners.remove(listener)

        return remove

    def close(self) -> None:
        """Notify of nothing any more: the node's process leaves DDS."""
        self._listeners.clear()

    def touch(self) -> None:
        """Something of the configuration has changed, match counts included; from any thread."""
        with self._lock:
            if self._scheduled or not self._listeners:
                return
            # Before it is handed over: it may have run when `later` returns.
            self._scheduled = True
        if not self._later(self._notify):
            self._scheduled = False

    def _notify(self) -> None:
        with self._lock:
            self._scheduled = False
        configuration = self.collect() if self._listeners else None
        if configuration is not None:
            for listener in tuple(self._listeners):
                listener(configuration)

    def collect(self) -> NodeConfiguration | None:
        """Return the configuration as it is now; None, and a line in the log, if that fails."""
        try:
            return self._collect()
        except Exception:  # noqa: BLE001 - describing itself must not end the node
            self._failed(traceback.format_exc())
            return None
