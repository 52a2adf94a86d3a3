"""What was observed of a running system and what its nodes report: the input of `verify`.

Owns: the observation types; the node configuration (schema:
schemas/node_configuration.v1.schema.json), which nodes report and observers collect; and `shown`,
whether a node shows what others wait for. Pure.
"""

from __future__ import annotations

import hashlib
import ipaddress
from collections.abc import Iterable, Iterator
from typing import Annotated

import msgspec

from lifecycle import codec
from lifecycle.codec import Count, DscpValue
from lifecycle.manifest.model import EndpointKind, ParameterValue, Readiness
from lifecycle.manifest.names import topic_of
from lifecycle.manifest.parameter_values import portable
from lifecycle.manifest.qos import QosProfile
from lifecycle.measure.clock import ClockOffset
from lifecycle.measure.sample import Measured
from lifecycle.network.nfe import NetworkFlowEndpoint, UniqueRequirement
from lifecycle.plan.model import PlannedNode
from lifecycle.verify.outcome import ConnectionReport

LONGEST_CONFIGURATION = 1 << 22
"""Characters of a node configuration as JSON; one of 1,000 endpoints takes about 600,000."""

_Gid = Annotated[str, msgspec.Meta(pattern="^([0-9a-f]{32})?$")]
_Integer = Annotated[int, msgspec.Meta(ge=-codec.LARGEST - 1, le=codec.LARGEST)]
_Value = bool | _Integer | float | str | tuple[bool | _Integer | float | str, ...]
"""A `ParameterValue` as ROS can hold it."""

LONGEST_VALUE = 4096
"""Bytes of JSON; of a longer parameter value only the digest is passed on."""


class Identity(msgspec.Struct, frozen=True, kw_only=True):
    """What distinguishes one node instance from every other.

    Attributes:
        machine_id: /etc/machine-id, or the boot id where there is none.
        process_id: pid in the node's own pid namespace.
        node_id: fully qualified name and the participant's GID prefix, `/robot/camera@0103…`.
    """

    machine_id: str
    process_id: Count
    node_id: str


class EndpointReport(msgspec.Struct, frozen=True, kw_only=True):
    """What a node reports of one of its endpoints.

    Attributes:
        name: declared name; empty for one that no interface declares.
        resolved: fully qualified.
        gid: hex, empty if not yet created or not known.
        nfes: this endpoint's own network flow endpoints; None where the RMW cannot list them.
        participant: base name of the hidden node that carries it; empty for the node's own.
        matched: number of matched remote endpoints; None where unknown.
        server_matched: of a service or action client that exists: a server of its name is matched
            with it both ways; None for everything else and where the RMW cannot show it.
        dscp: DSCP read back from the sender sockets with getsockopt, 0–63; None if not read.
        error: why the endpoint could not be made as asked; empty if it was.
        fault: what the handler of an action server raised at its last goal; empty if it returned.
        connection: name of the connection it is mapped onto; empty for the node's own participant,
            or while it is mapped nowhere.
        mapped: it exists on a connection.
        lossy: the node's hint: its data bear an unreliable transport; None without one.
        size_bytes: the node's hint: its largest serialized message; None without one.
        type_hash: of the definition that it was made with (REP-2016), of publishers and
            subscriptions that exist; empty where the RMW knows none, None where it was not read.
    """

    kind: EndpointKind
    name: str
    resolved: str
    type: str
    qos: QosProfile | None = None
    gid: _Gid = ""
    unique: UniqueRequirement = UniqueRequirement.NOT_REQUIRED
    nfes: tuple[NetworkFlowEndpoint, ...] | None = None
    participant: str = ""
    matched: Count | None = None
    server_matched: bool | None = None
    dscp: DscpValue | None = None
    error: str = ""
    fault: str = ""
    connection: str = ""
    mapped: bool = False
    lossy: bool | None = None
    size_bytes: Count | None = None
    type_hash: str | None = None


class ParameterReport(msgspec.Struct, frozen=True, kw_only=True):
    """What a node reports of one of its parameters.

    Attributes:
        type: as rcl_interfaces names it, "double_array"; empty for one that may have any type and
            is not set.
        value: None if it is not set, or too long to be passed on. Doubles that are not finite are
            ".nan", ".inf" and "-.inf", because JSON has no others.
        digest: of a value that is too long; else empty.
        read_only: it cannot be set once it is declared.
    """

    name: str
    type: str
    value: _Value | None = None
    digest: str = ""
    read_only: bool = False

    @classmethod
    def of(
        cls, name: str, type_: str, value: ParameterValue | None, *, read_only: bool
    ) -> ParameterReport:
        """Return the report of a parameter; `value` is None if it is not set."""
        spelled = None if value is None else portable(value)
        digest = "" if spelled is None else digest_of(spelled)
        return cls(
            name=name,
            type=type_,
            value=None if digest else spelled,
            digest=digest,
            read_only=read_only,
        )

    def has(self, value: ParameterValue) -> bool:
        """Return whether it has a value of its type; what is not a number equals itself."""
        if self.digest:
            return self.digest == digest_of(value)
        return self.value is not None and self.value == value


def digest_of(value: ParameterValue) -> str:
    """Return the digest of a value that is too long to be passed on; empty for every other.

    Args:
        value: as `portable` spells it.
    """
    document = codec.to_json(value)
    return hashlib.sha256(document).hexdigest() if len(document) > LONGEST_VALUE else ""


class HealthReport(msgspec.Struct, frozen=True, kw_only=True):
    """What a node says of its own health, or /diagnostics of it.

    Attributes:
        ok: whether all is well; None if it has not said so in time.
        message: what is wrong; empty if nothing is.
    """

    ok: bool | None
    message: str = ""


class NodeConfiguration(msgspec.Struct, frozen=True, kw_only=True):
    """The node configuration interface's document.

    Attributes:
        name: fully qualified node name.
        state: lifecycle_msgs/State label.
        connected: the data layer is made (nested state of inactive; True while active).
        transports: what the node can be connected by, names of media.
        serializations: wire formats, "cdr".
        paradigms: "publish-subscribe", "request-response".
        connections: every connection that exists or was asked for.
        checksum: of everything but state, matches, whether connections are established, what was
            measured, and itself; changes exactly when a reader must read again. Hex SHA-256, 16
            digits.
        parameters: all that are declared, sorted by name; None where the node does not report them.
        health: what its health check last returned; None of a node that is not connected, or has
            none.
        measured: what has arrived since it was activated; None while it is not active.
    """

    identity: Identity
    name: str
    state: str
    connected: bool
    rmw: str
    transports: tuple[str, ...]
    serializations: tuple[str, ...]
    paradigms: tuple[str, ...]
    endpoints: tuple[EndpointReport, ...]
    checksum: str = ""
    connections: tuple[ConnectionReport, ...] = ()
    parameters: tuple[ParameterReport, ...] | None = None
    health: HealthReport | None = None
    measured: Measured | None = None


class ConfigurationError(ValueError):
    """A text that is no node configuration, or not that of the node that gave it."""


def decode_configuration(text: str | bytes, node: str) -> NodeConfiguration:
    """Return the node configuration that a node answered with.

    Args:
        text: JSON, from any node that has a service of that name.
        node: fully qualified name of the node that was asked.

    Raises:
        ConfigurationError: it is too long, not what the schema says, another node's, or has an
            address that is none; the message says which.
    """
    try:
        found = codec.from_json(text, NodeConfiguration, longest=LONGEST_CONFIGURATION)
        for endpoint in found.endpoints:
            for nfe in endpoint.nfes or ():
                if nfe.internet_address:
                    ipaddress.ip_address(nfe.internet_address[:_SHOWN])
    except ValueError as error:
        raise ConfigurationError(str(error)) from error
    if found.name != node:
        raise ConfigurationError(f"it is that of node {found.name[:_SHOWN]!r}")
    return found


_SHOWN = 100
"""Characters of a wrong value that a message quotes; no address is as long."""


SERVES_NONE = "serves no parameters"
"""Why nothing is known of the parameters of a node that has no parameter services."""


class NodeParameters(msgspec.Struct, frozen=True, kw_only=True):
    """What a node's parameter services returned for the parameters that its plan names.

    Attributes:
        node: fully qualified name.
        parameters: those that it has; None if that could not be learnt.
        error: why it could not, to follow "it "; else empty.
    """

    node: str
    parameters: tuple[ParameterReport, ...] | None = None
    error: str = ""


class ObservedNode(msgspec.Struct, frozen=True, kw_only=True):
    """A node name in the graph.

    Attributes:
        count: how many nodes carry this name; more than one is a duplicate.
        state: lifecycle_msgs/State label; None if it could not be learnt.
        managed: it offers the lifecycle services; None if unknown.
        health: what /diagnostics says of it, where the manifest names entries; None if nothing.
    """

    full_name: str
    count: int = 1
    state: str | None = None
    managed: bool | None = None
    health: HealthReport | None = None


class ObservedEndpoint(msgspec.Struct, frozen=True, kw_only=True):
    """An endpoint as discovery shows it.

    Attributes:
        node: fully qualified node name; empty while discovery does not know it.
        qos: history and depth are UNKNOWN/0 over Fast DDS; None for services and actions.
        type_hash: of the definition that it was made with, as announced (REP-2016,
            `RIHS01_df66…`; those of several messages of a service or an action in the order of
            `manifest.installed_types.join`); empty if it announces none, None if that was not seen.
        gid: hex, of a server that of its request reader or, for an action, of its goal service;
            empty for clients of a known node, which it may have several of, and where the RMW shows
            none.
        address: IP address of its participant, where its node is not known and discovery shows it.
        silent: it publishes /clock, and whoever looked has received no time from it.
    """

    kind: EndpointKind
    node: str
    name: str
    type: str
    qos: QosProfile | None = None
    gid: str = ""
    type_hash: str | None = None
    address: str = ""
    silent: bool = False


class ArrivedMark(msgspec.Struct, frozen=True, kw_only=True):
    """With what DSCP datagrams arrive that another machine's supervisor sends beside a flow.

    Attributes:
        machine: its name.
        dscp: with which they are sent.
        arrives_as: None if they should have arrived, and did not.
    """

    machine: str
    dscp: int
    arrives_as: int | None


class Observation(msgspec.Struct, frozen=True, kw_only=True):
    """Everything seen of a system at one moment, tools and what they use included.

    Attributes:
        parameters: of nodes that do not report them in their configuration.
        measured: what subscriptions of the observer have counted; None where it has none.
        active_s: for how long nodes are seen to be there and active, seconds, each after its full
            name: those that do not report it themselves, or on another machine.
        departed: publishers and subscriptions of processes that have ended, which discovery shows
            still, and others may count as their peers still.
        clocks: of the hosts of other machines of the system, each after the machine's name; None
            where nobody compares them, or delays are not judged yet.
        marks: from other machines of the system, where flows with a DSCP come from them.
    """

    nodes: tuple[ObservedNode, ...] = ()
    endpoints: tuple[ObservedEndpoint, ...] = ()
    configurations: tuple[NodeConfiguration, ...] = ()
    parameters: tuple[NodeParameters, ...] = ()
    measured: Measured | None = None
    active_s: tuple[tuple[str, float], ...] = ()
    departed: tuple[ObservedEndpoint, ...] = ()
    clocks: tuple[tuple[str, ClockOffset], ...] | None = None
    marks: tuple[ArrivedMark, ...] = ()


def shown(
    awaited: Iterable[Readiness], node: PlannedNode, seen: Observation
) -> frozenset[Readiness]:
    """Return what of the awaited is there: discovery shows it, or the node itself reports it."""
    wanted = tuple(awaited)
    ends = {*_ends(node, seen)} if any(each.by.kinds for each in wanted) else set()
    parameters = {each.name: each for each in _parameters(node, seen)}
    return frozenset(
        each
        for each in wanted
        if any((kind, topic_of(node, each.name, kind)) in ends for kind in each.by.kinds)
        or (not each.by.kinds and _is_true(parameters.get(each.name)))
    )


def _ends(node: PlannedNode, seen: Observation) -> Iterator[tuple[EndpointKind, str]]:
    """Yield the endpoints of a node; of what it has on other participants only it knows."""
    yield from ((each.kind, each.name) for each in seen.endpoints if each.node == node.full_name)
    for report in seen.configurations:
        if report.name == node.full_name:
            yield from ((each.kind, each.resolved) for each in report.endpoints if each.mapped)


def _parameters(node: PlannedNode, seen: Observation) -> Iterator[ParameterReport]:
    for report in seen.configurations:
        if report.name == node.full_name:
            yield from report.parameters or ()
    for read in seen.parameters:
        if read.node == node.full_name:
            yield from read.parameters or ()


def _is_true(found: ParameterReport | None) -> bool:
    return found is not None and found.type == "bool" and found.has(True)
