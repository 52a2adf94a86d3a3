"""The observation of a system that is exactly as planned, for tests to take facts out of.

`perfect(plan, stage)` invents what a faultless system under rmw_fastrtps_cpp would show: discovery
without history and depth, hidden nodes for extra participants, and a report from each of our nodes.
"""

from __future__ import annotations

import hashlib

from msgspec.structs import replace

from lifecycle.manifest.model import EndpointKind, RunKind
from lifecycle.manifest.qos import (
    BEST_AVAILABLE_NS,
    Durability,
    History,
    Liveliness,
    QosProfile,
    Reliability,
)
from lifecycle.network.nfe import NetworkFlowEndpoint, UniqueRequirement
from lifecycle.plan.model import Plan, PlannedEndpoint, PlannedNode, PlannedParticipant
from lifecycle.verify.observation import (
    EndpointReport,
    Identity,
    NodeConfiguration,
    Observation,
    ObservedEndpoint,
    ObservedNode,
    ParameterReport,
)
from lifecycle.verify.outcome import ConnectionReport
from lifecycle.verify.verdict import Stage
from lifecycle.verify.view import connection_of
from tests.builders import nfe, shared_memory

_TOPIC_KINDS = (EndpointKind.PUBLISHER, EndpointKind.SUBSCRIPTION)
_OWN_FLOW = (UniqueRequirement.STRICTLY_REQUIRED, UniqueRequirement.OPTIONALLY_REQUIRED)
_STATES = {Stage.CONNECTED: "inactive", Stage.ACTIVE: "active"}


def perfect(plan: Plan, stage: Stage = Stage.CONNECTED) -> Observation:
    """Everything that a system exactly as planned would show at this stage."""
    places = _Places(plan)
    nodes: list[ObservedNode] = []
    endpoints: list[ObservedEndpoint] = []
    configurations: list[NodeConfiguration] = []
    for node in plan.nodes:
        state = _STATES[stage] if node.managed else None
        nodes.append(ObservedNode(full_name=node.full_name, state=state, managed=node.managed))
        nodes += [
            ObservedNode(full_name=f"{node.namespace.rstrip('/')}/{each.name}", managed=False)
            for each in node.participants
        ]
        endpoints += [_observed(node, index) for index in range(len(node.endpoints))]
        if node.run.kind is RunKind.PYTHON:
            configurations.append(_configuration(places, node, stage))
    return Observation(
        nodes=tuple(nodes), endpoints=tuple(endpoints), configurations=tuple(configurations)
    )


class _Places:
    """What a system's parts are numbered and found by, so that big ones can be made up as well."""

    def __init__(self, plan: Plan) -> None:
        self.addresses = {each.name: each.address for each in reversed(plan.machines)}
        self.nodes = {each.key: index for index, each in enumerate(plan.nodes)}
        self.processes = {each.name: index for index, each in enumerate(plan.processes)}
        self.gids: dict[tuple[EndpointKind, str], list[str]] = {}
        for node in plan.nodes:
            for index, each in enumerate(node.endpoints):
                self.gids.setdefault((each.kind, each.resolved), []).append(_gid(node, index))
        for gids in self.gids.values():
            gids.sort()


def settled(qos: QosProfile, kind: EndpointKind) -> QosProfile:
    """What a middleware makes of a profile: nothing left to the system, nothing best available."""
    publishes = kind is EndpointKind.PUBLISHER
    reliability = {
        Reliability.SYSTEM_DEFAULT: Reliability.RELIABLE if publishes else Reliability.BEST_EFFORT,
        Reliability.BEST_AVAILABLE: Reliability.RELIABLE if publishes else Reliability.BEST_EFFORT,
    }
    durability = {
        Durability.SYSTEM_DEFAULT: Durability.VOLATILE,
        Durability.BEST_AVAILABLE: (
            Durability.TRANSIENT_LOCAL if publishes else Durability.VOLATILE
        ),
    }
    free = (Liveliness.SYSTEM_DEFAULT, Liveliness.BEST_AVAILABLE)
    deadline, lease = qos.deadline_ns, qos.liveliness_lease_duration_ns
    return replace(
        qos,
        history=History.KEEP_LAST if qos.history is History.SYSTEM_DEFAULT else qos.history,
        depth=qos.depth or 1,
        reliability=reliability.get(qos.reliability, qos.reliability),
        durability=durability.get(qos.durability, qos.durability),
        liveliness=Liveliness.AUTOMATIC if qos.liveliness in free else qos.liveliness,
        deadline_ns=None if deadline == BEST_AVAILABLE_NS else deadline,
        liveliness_lease_duration_ns=None if lease == BEST_AVAILABLE_NS else lease,
    )


def announced(qos: QosProfile) -> QosProfile:
    """What Fast DDS's discovery tells of a profile: no history, no depth."""
    return replace(qos, history=History.UNKNOWN, depth=0)


def _gid(node: PlannedNode, index: int) -> str:
    return hashlib.sha256(f"{node.full_name}#{index}".encode()).hexdigest()[:32]


def _carrier(node: PlannedNode, planned: PlannedEndpoint) -> str:
    return f"{node.namespace.rstrip('/')}/{planned.participant or node.name}"


def _observed(node: PlannedNode, index: int) -> ObservedEndpoint:
    planned = node.endpoints[index]
    is_topic = planned.kind in _TOPIC_KINDS
    qos = settled(planned.qos, planned.kind) if planned.qos and is_topic else None
    if qos and node.run.kind is RunKind.PYTHON:
        qos = announced(qos)
    return ObservedEndpoint(
        kind=planned.kind,
        node=_carrier(node, planned),
        name=planned.resolved,
        type=planned.type,
        qos=qos,
        gid=_gid(node, index) if is_topic else "",
    )


def _configuration(places: _Places, node: PlannedNode, stage: Stage) -> NodeConfiguration:
    number = places.nodes[node.key]
    machine = node.machine or "here"
    return NodeConfiguration(
        identity=Identity(
            machine_id=f"machine-{machine}",
            process_id=1000 + places.processes[node.process],
            node_id=f"{node.full_name}@01030000{number:04x}",
        ),
        name=node.full_name,
        state=_STATES[stage],
        connected=True,
        rmw="rmw_fastrtps_cpp",
        transports=("udpv4", "shm"),
        serializations=("cdr",),
        paradigms=("publish/subscribe", "request/response"),
        endpoints=tuple(_report(places, node, index) for index in range(len(node.endpoints))),
        connections=tuple(_connection(node, each) for each in node.participants if each.connection),
        checksum=f"{number:016x}",
        parameters=tuple(
            ParameterReport(
                name=each.name, type=each.type, value=each.value, read_only=each.read_only
            )
            for each in node.expected_parameters
        ),
    )


def _connection(node: PlannedNode, participant: PlannedParticipant) -> ConnectionReport:
    return ConnectionReport(
        name=participant.connection,
        urls=participant.connections.urls,
        node_name=participant.name,
        established=True,
        mappings=tuple(
            f"{each.kind.value}/{each.name}"
            for each in node.endpoints
            if each.participant == participant.name
        ),
    )


def _report(places: _Places, node: PlannedNode, index: int) -> EndpointReport:
    planned = node.endpoints[index]
    is_topic = planned.kind in _TOPIC_KINDS
    return EndpointReport(
        kind=planned.kind,
        name=planned.name,
        resolved=planned.resolved,
        type=planned.type,
        qos=settled(planned.qos, planned.kind) if planned.qos else None,
        gid=_gid(node, index) if is_topic else "",
        unique=planned.unique,
        nfes=_nfes(places, node, index) if is_topic else None,
        participant=planned.participant,
        connection=connection_of(node, planned),
        mapped=True,
        matched=len(_peers(places, planned)) if is_topic else None,
        server_matched=_server_matched(places, planned),
        dscp=planned.dscp,
    )


def _server_matched(places: _Places, planned: PlannedEndpoint) -> bool | None:
    """What a client says of the declared servers of its service or action."""
    kind = {
        EndpointKind.SERVICE_CLIENT: EndpointKind.SERVICE_SERVER,
        EndpointKind.ACTION_CLIENT: EndpointKind.ACTION_SERVER,
    }.get(planned.kind)
    if kind is None:
        return None
    return (kind, planned.resolved) in places.gids


def _peers(places: _Places, planned: PlannedEndpoint) -> tuple[str, ...]:
    """GIDs of the declared endpoints on the other side of the topic."""
    other = _TOPIC_KINDS[planned.kind is EndpointKind.PUBLISHER]
    return tuple(places.gids.get((other, planned.resolved), ()))


def _nfes(places: _Places, node: PlannedNode, index: int) -> tuple[NetworkFlowEndpoint, ...]:
    """Shared memory, unless its participant must not, and one UDP socket.

    The socket is the participant's, unless the endpoint has its own.
    """
    planned = node.endpoints[index]
    process, number = places.processes[node.process], places.nodes[node.key]
    if planned.kind is EndpointKind.PUBLISHER:
        names = [each.name for each in node.participants]
        extra = names.index(planned.participant) + 1 if planned.participant else 0
        address = "0.0.0.0"
        port = 40000 + 100 * (number if extra else process) + extra
    elif planned.unique in _OWN_FLOW:
        address, port = _address(places, node), 7000 + 20 * number + index
    else:
        address, port = _address(places, node), 7411 + 2 * process
    udp = nfe(address, port)
    return (udp,) if _transports(node, planned) else (shared_memory(port), udp)


def _transports(node: PlannedNode, planned: PlannedEndpoint) -> tuple[str, ...]:
    for each in node.participants:
        if each.name == planned.participant:
            return each.transports
    return node.transports


def _address(places: _Places, node: PlannedNode) -> str:
    return places.addresses.get(node.machine, "127.0.0.1")
