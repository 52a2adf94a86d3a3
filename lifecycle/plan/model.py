"""Types of a plan: nodes, participants, connections, flows and processes of one system.

Owns: the types that cross from here into verify/, middleware/, node/ and supervisor/, and
`PlanError`, the one way planning fails. Every name in it is fully qualified. JSON-able through
`lifecycle.codec`. Pure.
"""

from __future__ import annotations

import enum
from collections.abc import Mapping
from typing import Annotated, Any

import msgspec
from msgspec.structs import replace

from lifecycle.codec import DomainId, DscpValue, Port, Positive, says
from lifecycle.errors import ExitCode, LifecycleError
from lifecycle.manifest.diagnostics import Position
from lifecycle.manifest.model import (
    SIM_TIME,
    Authority,
    DiscoveryRange,
    Endpoint,
    EndpointPolicy,
    FlowTransport,
    NodeDeclaration,
    ParameterDeclaration,
    ParameterValue,
    Quantity,
    Readiness,
    Run,
    SystemDeclaration,
    TargetState,
    UniqueHow,
)
from lifecycle.network.medium import UDP_UNICAST, Medium
from lifecycle.network.nfe import UniqueRequirement

_UdpUnicast = Annotated[Medium, says(enum=[each.value for each in UDP_UNICAST])]


def declared(as_: type, by: object) -> dict[str, Any]:
    """Return what a manifest decided, by field: what a plan's type takes over from one of its.

    A plan's types extend those of the manifest, so that what is declared is written down once, and
    JSON of a plan has it beside what was planned.
    """
    return {each.name: getattr(by, each.name) for each in msgspec.structs.fields(as_)}


GRAPH_TOPIC = "ros_discovery_info"
"""By which rmw maps endpoints to nodes; every participant has a writer and a reader of it."""

GRAPH_TYPE = "rmw_dds_common::msg::dds_::ParticipantEntitiesInfo_"


class StaticEndpoint(msgspec.Struct, frozen=True, kw_only=True):
    """One line of the table of static endpoint discovery (Fast DDS, STATIC EDP).

    Attributes:
        writer: a DataWriter; else a DataReader.
        topic: DDS name, `rt/chatter`, `ros_discovery_info`.
        type: DDS name, `std_msgs::msg::dds_::String_`.
        profile: the name by which rmw looks for the endpoint's profile, `/chatter`.
        user_id: 1–65535, unique in the system.
    """

    writer: bool
    topic: str
    type: str
    profile: str
    user_id: Port
    reliable: bool = True
    transient_local: bool = False


class StaticParticipant(msgspec.Struct, frozen=True, kw_only=True):
    """A participant that others know without announcement. `name` is its enclave, `/camera_net`."""

    name: str
    endpoints: tuple[StaticEndpoint, ...]


class ParticipantConnections(msgspec.Struct, frozen=True, kw_only=True):
    """How one participant is connected: the arguments of `connect_to`.

    Attributes:
        urls: its transports, as connection URLs in text; empty leaves everything to the RMW.
        static_name: its own name in `static_participants`.
        static_participants: all, itself included, where endpoints are not announced.
        super_client: it learns of everything that the discovery servers of its URLs know, as an
            observer must; else only of what matches its own endpoints.
    """

    urls: tuple[str, ...] = ()
    static_name: str = ""
    static_participants: tuple[StaticParticipant, ...] = ()
    super_client: bool = False


class PlannedParticipant(msgspec.Struct, frozen=True, kw_only=True):
    """An extra DDS participant that carries endpoints which need their own flow or mark.

    A publisher becomes unique only in its own participant, so the planner groups publishers of one
    class (same DSCP, same need) and gives each strictly or optionally unique one its own. Marked
    subscriptions are grouped likewise: what they acknowledge with leaves by its sockets.

    Attributes:
        name: base name of the hidden node that owns it, `_camera_flow_0`; its namespace is the
            node's.
        dscp: 0–63 set on its sender sockets; None leaves them alone.
        reason: one phrase for people, "unique publisher video".
        transports: all that it may use, UDPV4, UDPV6; empty leaves it to the RMW.
        max_datagram_bytes: UDP payload above which RTPS splits messages itself, so that IP does
            not; None leaves it to the RMW.
        non_blocking_send: its sockets never wait; what finds a full buffer is lost.
        connection: name of the connection it implements, unique in the node, `net`; empty for one
            that only makes a publisher's flow unique.
        connections: the arguments of `connect_to`.
        declared: the manifest spells the connection out.
    """

    name: str
    dscp: DscpValue | None
    reason: str
    transports: tuple[_UdpUnicast, ...] = ()
    max_datagram_bytes: Positive | None = None
    non_blocking_send: bool = False
    connection: str = ""
    connections: ParticipantConnections = ParticipantConnections()
    declared: bool = False


class PlannedEndpoint(Endpoint, frozen=True, kw_only=True):
    """One endpoint as it must exist at run time.

    Attributes:
        resolved: fully qualified topic, service or action name after namespace and remap.
        transport: NETWORK must not go by shared memory.
        lossy: the data bear an unreliable transport (True), or do not (False); None leaves that to
            the QoS and to the node's own hint, which this overrides.
        quantities: each of its numbers that only a measurement could prove, as it is written.
        measure: a subscription of ours measures them where nothing else does.
        dscp: 0–63 of what it sends: a publisher's data, a subscription's acknowledgements.
        five_qi_reason: why it is this 5QI, or none, where the manifest has `auto`; else empty.
        participant: base name of the PlannedParticipant that carries it; empty for the node's own.
        max_delay_ms: declared bound, or the shortest of the links on its topic; None without.
        max_message_size: largest serialized message, bytes, as declared.
        type_hash: of the definition that is installed here (REP-2016), as `ObservedEndpoint` has
            it; empty if the type is not installed here, or without hashes.
    """

    resolved: str
    unique: UniqueRequirement = UniqueRequirement.NOT_REQUIRED
    transport: FlowTransport = FlowTransport.ANY
    lossy: bool | None = None
    quantities: tuple[Quantity, ...] = ()
    measure: bool = False
    dscp: DscpValue | None = None
    enforce_dscp: bool = True
    five_qi: int | None = None
    five_qi_reason: str = ""
    participant: str = ""
    max_delay_ms: float | None = None
    max_message_size: Positive | None = None
    type_hash: str = ""


class PlannedFile(msgspec.Struct, frozen=True, kw_only=True):
    """A path that the manifest gives a node, as it was when the plan was made.

    Attributes:
        place: where the manifest has it, below the node: `parameter_files.0`,
            `run.working_directory`.
        written: as written there, which is the same on every host.
        digest: of a parameter file's contents (SHA-256, hexadecimal, 16 digits); empty of a folder
            and of what could not be read.
    """

    place: str
    written: str
    digest: Annotated[str, says(pattern="^([0-9a-f]{16})?$")] = ""


class ExpectedParameter(msgspec.Struct, frozen=True, kw_only=True):
    """A parameter that a node must have, and what of it must be so.

    Attributes:
        type: a type name of rcl_interfaces, see ParameterDeclaration; "array" of an empty one whose
            type is declared nowhere, which fits every array.
        value: what it must be; None: anything of its type. Doubles that are not finite are ".nan",
            ".inf" and "-.inf", because JSON has no others.
        source: what sets the value: "parameters", "default_value", "mode safe" or a parameter file;
            empty without a value.
        read_only: it must be so; False asks nothing.
        optional: only a section for many nodes gives it, so that a node need not have it.
    """

    name: str
    type: str
    value: ParameterValue | None = None
    source: str = ""
    read_only: bool = False
    optional: bool = False
    at: Position

    @property
    def raw(self) -> Any:
        """The value, also where JSON has no number for it."""
        return raw_value(self.value, self.type)


def raw_value(value: Any, type_: str) -> Any:
    """Return a value of a plan as it is; doubles that JSON has no numbers for are text there."""
    if not type_.startswith("double"):
        return value
    if isinstance(value, tuple):
        return tuple(raw_value(each, type_) for each in value)
    return float(value.replace(".", "")) if isinstance(value, str) else value


class HeldBy(enum.Enum):
    """What keeps a node from working before the gate opens."""

    STATE_MACHINE = "state machine"  # in a process of ours, which refuses other clients
    SERVICES = "lifecycle services"  # elsewhere; what others activate is deactivated again
    EXECUTOR = "executor"  # no callback runs, and what it publishes is dropped or kept
    NOTHING = "nothing"  # it works as soon as it is started


class PlannedNode(NodeDeclaration, frozen=True, kw_only=True):
    """One node as it must exist at run time.

    Attributes:
        process: name of its PlannedProcess.
        held_by: what holds it until the system is verified.
        expected_parameters: what its parameters must be once it is configured: those declared and
            those given, see lifecycle.plan.parameters.
        mode_parameters: by mode, what those of them are that some mode changes.
        has_all_parameters: it may have no others than those, and those that ROS declares itself.
        unread_parameter_files: those whose values are not known here and so not expected.
        transports: all that the node's own participant may use, UDPV4, UDPV6; empty leaves it
            to the RMW. Nodes of one process share a participant if these are equal.
        connections: how its own participant is connected; likewise shared by equals.
        authority: SUPERVISOR: `connect` maps nothing by itself; every endpoint must have been
            mapped by `map_to`, or the transition fails and names the missing ones.
        events: it notifies the graph of changes of its connections and mappings.
        membership: it notifies the graph that it joins and leaves, of its state and its checksum;
            so does a node with `events`.
        files: the paths among `parameter_files` and `run` as the manifest writes them.
    """

    process: str
    endpoints: tuple[PlannedEndpoint, ...]
    declared_parameters: tuple[ParameterDeclaration, ...]
    participants: tuple[PlannedParticipant, ...]
    endpoint_policy: EndpointPolicy
    transports: tuple[_UdpUnicast, ...] = ()
    connections: ParticipantConnections = ParticipantConnections()
    authority: Authority = Authority.NODES
    events: bool = False
    membership: bool = False
    files: tuple[PlannedFile, ...] = ()
    expected_parameters: tuple[ExpectedParameter, ...] = ()
    mode_parameters: Mapping[str, tuple[ExpectedParameter, ...]] = {}
    has_all_parameters: bool = False
    unread_parameter_files: tuple[str, ...] = ()
    held_by: HeldBy = HeldBy.STATE_MACHINE


class PlannedProcess(msgspec.Struct, frozen=True, kw_only=True):
    """One operating system process.

    Attributes:
        name: unique in the plan; the node's key when the process holds one node.
        nodes: keys of its nodes, in manifest order.
        argv: full command line for a COMMAND process; empty for PYTHON and ATTACH.
        environment: (name, value) on top of the supervisor's.
    """

    name: str
    machine: str
    run: Run
    nodes: tuple[str, ...]
    argv: tuple[str, ...] = ()
    environment: tuple[tuple[str, str], ...] = ()


class PlannedFlow(msgspec.Struct, frozen=True, kw_only=True):
    """One publisher → subscription pair that must match and what its flow must be.

    Attributes:
        publisher: key of the publishing node.
        subscription: key of the subscribing node.
        unique: the strongest demand of a link on this pair.
        linked: a `links:` entry names this pair.
        transport: what a link demands for it; ANY where none does.
        medium: the value of the Medium that will carry it; empty if that is not known before the
            nodes' configurations are.
        medium_reason: one phrase for people, "same host", "links say so".
        quantities: numbers of its links that only a measurement could prove.
        measure: a subscription of ours measures it: the node that subscribes cannot.
    """

    topic: str
    publisher: str
    subscription: str
    unique: UniqueHow = UniqueHow.NOT
    max_delay_ms: float | None = None
    linked: bool = False
    transport: FlowTransport = FlowTransport.ANY
    medium: str = ""
    medium_reason: str = ""
    quantities: tuple[Quantity, ...] = ()
    measure: bool = False


class PlannedServer(msgspec.Struct, frozen=True, kw_only=True):
    """The discovery server that a supervisor starts, watches and ends.

    Attributes:
        machine: where it runs; empty for this host.
        address: given to clients, and listened on.
        port: 1–65535.
        tcp: over TCP; else UDP.
    """

    machine: str
    address: str
    port: Port
    tcp: bool = True


class Plan(SystemDeclaration, frozen=True, kw_only=True):
    """A system, planned.

    Attributes:
        levels: node keys by dependency level; a level's nodes have no order among themselves.
        rmw: RMW identifier of processes that set none of their own, `rmw_fastrtps_cpp`.
        server: the discovery server; None without.
        observers: (machine, how its supervisor's own participant is connected); machine is empty
            for this host. Machines without an entry leave it to the RMW.
    """

    manifest_path: str
    domain_id: DomainId
    discovery_range: DiscoveryRange
    processes: tuple[PlannedProcess, ...]
    nodes: tuple[PlannedNode, ...]
    flows: tuple[PlannedFlow, ...]
    levels: tuple[tuple[str, ...], ...]
    rmw: str = ""
    server: PlannedServer | None = None
    observers: tuple[tuple[str, ParticipantConnections], ...] = ()

    def node(self, key: str) -> PlannedNode:
        """Return the node with this manifest key.

        Raises:
            KeyError: no such key.
        """
        for node in self.nodes:
            if node.key == key:
                return node
        raise KeyError(key)

    @property
    def awaited(self) -> dict[str, frozenset[Readiness]]:
        """What others wait for of each node, by its key, that the graph shows."""
        found: dict[str, frozenset[Readiness]] = {}
        for after in (each for node in self.nodes for each in node.after):
            if isinstance(after.condition, Readiness):
                found[after.node] = found.get(after.node, frozenset()) | {after.condition}
        return found

    @property
    def bounds(self) -> tuple[Quantity, ...]:
        """Every number that the manifest declares of data that flow."""
        return (
            *(
                number
                for node in self.nodes
                for each in node.endpoints
                for number in each.quantities
            ),
            *(number for flow in self.flows for number in flow.quantities),
        )


def uses_sim_time(node: PlannedNode) -> bool:
    """Return whether a node is given `use_sim_time: true`, by whatever way."""
    return any(each.name == SIM_TIME and each.value is True for each in node.expected_parameters)


def in_mode(plan: Plan, name: str) -> Plan:
    """Return a plan as it is in a mode; a plan without modes, or with an unknown one, as it is."""
    mode = next((each for each in plan.modes if each.name == name), None)
    if mode is None:
        return plan
    switched = {key for each in plan.modes for key in each.inactive}

    def as_in_mode(node: PlannedNode) -> PlannedNode:
        if node.mode_parameters:
            node = _with_parameters(node, node.mode_parameters.get(name, ()))
        if node.key not in switched:
            return node
        state = TargetState.INACTIVE if node.key in mode.inactive else TargetState.ACTIVE
        return node if node.state is state else replace(node, state=state)

    return replace(plan, nodes=tuple(map(as_in_mode, plan.nodes)))


def _with_parameters(node: PlannedNode, given: tuple[ExpectedParameter, ...]) -> PlannedNode:
    """Return a node that is started with other values, and must have them."""
    values = {each.name: each for each in given}
    known = {each.name for each in node.expected_parameters}
    return replace(
        node,
        expected_parameters=(
            *(values.get(each.name, each) for each in node.expected_parameters),
            *(each for each in given if each.name not in known),
        ),
        parameters=(
            *(each for each in node.parameters if each[0] not in values),
            *((each.name, each.value) for each in given if each.value is not None),
        ),
    )


class PlanError(LifecycleError):
    """A valid manifest that cannot be planned here: no such executable, not enough ports.

    Attributes:
        at: the declaration that cannot be planned; None when no single one is to blame.
    """

    exit_code = ExitCode.MANIFEST_INVALID

    def __init__(self, message: str, *, hint: str = "", at: Position | None = None) -> None:
        super().__init__(message, hint=hint)
        self.at = at

    def __str__(self) -> str:
        place = f"{self.at.spelled}: " if self.at else ""
        return place + super().__str__()
