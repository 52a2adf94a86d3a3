"""What a frozen manifest says of one node: how it runs, its interface, its flows, its connections.

Owns: these types; model.py has them too. Nothing here knows YAML. Pure.
"""

from __future__ import annotations

import bisect
import dataclasses

from lifecycle.manifest.choices import (
    Condition,
    EndpointKind,
    EndpointPolicy,
    FlowTransport,
    RunKind,
)
from lifecycle.manifest.diagnostics import Position
from lifecycle.manifest.qos import QosProfile
from lifecycle.network.connection_url import ConnectionUrl
from lifecycle.network.nfe import UniqueRequirement

ParameterValue = bool | int | float | str | tuple[bool | int | float | str, ...]
"""A ROS parameter value; arrays are tuples of one scalar type."""


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Run:
    """How to start a node. Exactly one of the forms is set, as `kind` says.

    Attributes:
        python: `module:Class` for PYTHON.
        command: argv for COMMAND; empty when `package`/`executable` name it instead.
        package: ament package, resolved through AMENT_PREFIX_PATH at plan time.
        environment: extra variables, (name, value).
    """

    kind: RunKind
    python: str = ""
    command: tuple[str, ...] = ()
    package: str = ""
    executable: str = ""
    environment: tuple[tuple[str, str], ...] = ()
    working_directory: str = ""


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class After:
    """The step of this node that `condition` names begins once `node` (a key) has reached it."""

    node: str
    condition: Condition
    at: Position


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Timeouts:
    """Deadlines in seconds, > 0, of each step of one node.

    Attributes:
        silent_s: the node is silent once one of its callbacks has run for so long; transitions
            have deadlines of their own. Nodes of one process share the longest.
    """

    start_s: float = 10.0
    configure_s: float = 10.0
    connect_s: float = 10.0
    activate_s: float = 10.0
    deactivate_s: float = 5.0
    cleanup_s: float = 5.0
    shutdown_s: float = 5.0
    silent_s: float = 0.8


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Endpoint:
    """One declared endpoint.

    Attributes:
        name: as declared; relative, absolute or `~/private`, before remapping.
        type: `package/msg/Type`, `package/srv/Type` or `package/action/Type`.
        qos: what it is made with; None for actions.
        qos_defaults: policies of `qos` that no manifest writes: they are the default of the kind,
            good for making the endpoint, and nobody requires them.
    """

    kind: EndpointKind
    name: str
    type: str
    qos: QosProfile | None
    qos_defaults: tuple[str, ...] = ()
    at: Position


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class ParameterDeclaration:
    """A parameter of an interface.

    Attributes:
        type: bool, int, double, string, bool_array, int_array, double_array, string_array or
            byte_array, the words of rcl_interfaces and generate_parameter_library.
    """

    name: str
    type: str
    default: ParameterValue | None = None
    description: str = ""
    read_only: bool = False
    at: Position


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Interface:
    """What a node offers and needs, in NoDL v2 words.

    Attributes:
        source: empty when inline, else the reference it was read from.
    """

    endpoints: tuple[Endpoint, ...] = ()
    parameters: tuple[ParameterDeclaration, ...] = ()
    source: str = ""


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Quantity:
    """A number that a manifest promises or asks for, and where it is written.

    Attributes:
        name: the manifest's key, which has the unit: `max_delay_ms`, `rate_hz`, `five_qi`.
    """

    name: str
    value: float
    at: Position

    def __str__(self) -> str:
        """Return `max_delay_ms 5`."""
        return f"{self.name} {self.value:g}" if self.value < 1e6 else f"{self.name} {self.value}"


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class FlowNeed:
    """What one endpoint asks of its network flow.

    Attributes:
        kind: PUBLISHER or SUBSCRIPTION.
        name: the endpoint's declared name.
        dscp: 0–63, of all that the endpoint sends: data, or a subscription's acknowledgements; None
            leaves it alone.
        transport_priority: DDS TRANSPORT_PRIORITY, mapped to a TOS byte by
            `Network.transport_priority_mapping`; None if not given. Never beside `dscp`.
        enforce: a DSCP that could not be applied is violated (True) or a warning (False).
        five_qi: 3GPP TS 23.501 Table 5.7.4-1 value; None if not asked for, or left to us.
        five_qi_auto: `five_qi: auto`: the planner proposes one.
        max_delay_ms: longest delay that the flow bears, milliseconds, > 0; None if not declared.
        loss: highest share of messages lost or late that it bears, > 0 and <= 1; likewise.
        rate_hz: messages per second, > 0; likewise.
        max_message_size: largest serialized message, bytes, > 0; None takes the type's bound.
        transport: NETWORK must not go by shared memory.
        non_blocking_send: a send never waits; what finds the socket's buffer full is lost.
        lossy: the data bear an unreliable transport (True), or do not (False); None leaves that to
            the QoS and to the node's own hint, which this overrides.
        quantities: each of its numbers that only a measurement could prove, as it is written.
    """

    kind: EndpointKind
    name: str
    unique: UniqueRequirement = UniqueRequirement.NOT_REQUIRED
    dscp: int | None = None
    transport_priority: int | None = None
    enforce: bool = True
    five_qi: int | None = None
    five_qi_auto: bool = False
    max_delay_ms: float | None = None
    loss: float | None = None
    rate_hz: float | None = None
    max_message_size: int | None = None
    transport: FlowTransport = FlowTransport.ANY
    non_blocking_send: bool = False
    lossy: bool | None = None
    quantities: tuple[Quantity, ...] = ()
    at: Position


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class ConnectionDeclaration:
    """A connection that the manifest spells out for a node: `connections: {name: {…}}`.

    Attributes:
        name: token, unique in the node.
        urls: one or more, see `lifecycle.network.connection_url`; one participant has them all.
        map: endpoints that it carries, (kind, declared name).
    """

    name: str
    urls: tuple[ConnectionUrl, ...]
    map: tuple[tuple[EndpointKind, str], ...] = ()
    at: Position


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Node:
    """One node instance.

    Attributes:
        key: its key under `nodes:`, unique in the system (prefixed by includes as `prefix/key`).
        name: ROS base name; the key's last part unless `name:` says otherwise.
        namespace: absolute, `/` for the root.
        managed: True for a ROS 2 managed node; False for a plain node, which nothing can hold
            back from sending.
        process: nodes with the same non-empty process name share one process.
        remap: (from, to) as written.
        positions: where parts of the node stand, by path below it: `machine`, `namespace`, `name`,
            `process`, `remap.scan`, `parameters.rate`, `parameter_files.0`; sorted, read with
            `where`.
        written_paths: paths as the manifest writes them, by place: `parameter_files.0`,
            `run.working_directory`; what other fields have of them is absolute.
    """

    key: str
    name: str
    namespace: str
    machine: str
    run: Run
    managed: bool = True
    process: str = ""
    parameters: tuple[tuple[str, ParameterValue], ...] = ()
    parameter_files: tuple[str, ...] = ()
    remap: tuple[tuple[str, str], ...] = ()
    after: tuple[After, ...] = ()
    timeouts: Timeouts = Timeouts()
    interface: Interface = Interface()
    flows: tuple[FlowNeed, ...] = ()
    endpoints: EndpointPolicy = EndpointPolicy.DECLARED
    connections: tuple[ConnectionDeclaration, ...] = ()
    log_level: str = ""
    positions: tuple[tuple[str, Position], ...] = ()
    written_paths: tuple[tuple[str, str], ...] = ()
    at: Position

    def where(self, part: str) -> Position:
        """Return where a part of this node stands; the node's own position if that is not known."""
        index = bisect.bisect_left(self.positions, part, key=_path)
        found = self.positions[index : index + 1]
        return found[0][1] if found and found[0][0] == part else self.at

    def __post_init__(self) -> None:
        """Sort `positions`: a node may have thousands of parameters, each looked up once."""
        object.__setattr__(self, "positions", tuple(sorted(self.positions, key=_path)))


def _path(entry: tuple[str, Position]) -> str:
    return entry[0]
