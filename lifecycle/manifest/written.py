"""A manifest as it is written: one type a section, whose fields are the keys that it may have.

Owns: which keys there are, what their values may be, and what editors and messages say of them:
`schemas/manifest.v1.schema.json` is generated from these types and the texts of their docstrings
(`make schemas`). Sections that `model` has as they are written have their type there. Pure.
"""

from __future__ import annotations

import functools
import json
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, TypeVar

import msgspec
from msgspec import Meta, Struct, field

from lifecycle.manifest.model import (
    BY_DEFAULT,
    WORD,
    Condition,
    Consequence,
    DataLayer,
    Discovery,
    Dscp,
    EndpointKind,
    EndpointPolicy,
    Health,
    LinkKeys,
    Name,
    Network,
    NodeKey,
    Parameter,
    ParameterValue,
    Policy,
    PublisherFlow,
    Reaction,
    RunKeys,
    Scalar,
    Special,
    SubscriptionFlow,
    Supervision,
    TargetState,
    Text,
    Timeouts,
    Ways,
    require,
    spelled,
)
from lifecycle.manifest.qos import QosProfile
from lifecycle.manifest.yaml.document import Document, Place
from lifecycle.network.dscp import code_points, parse_dscp

MANIFEST = "manifest.v1.schema.json"
"""The file, in schemas/, that defines what a manifest may hold."""


@functools.cache
def read_schema(name: str) -> Mapping[str, Any]:
    """Return a shipped schema as it is in schemas/, for editors and for other programs."""
    # Wheels hold a copy of schemas/; a checkout holds a link to it.
    # Found as `importlib.resources` finds it, which takes longer to import than to read it.
    text = (Path(__file__).parents[1] / "_schemas" / name).read_text(encoding="utf-8")
    schema: Mapping[str, Any] = json.loads(text)
    return schema


def _rules() -> Collection[str]:
    """Return what `on_violation` may name, which the schema lists: ids and families of rules."""
    keys: Collection[str] = read_schema(MANIFEST)["$defs"]["OnViolation"]["anyOf"][1][
        "propertyNames"
    ]["enum"]
    return keys


T = TypeVar("T")
B = TypeVar("B", bound=Struct)


_TYPE = "[a-zA-Z][a-zA-Z0-9_]*"

Namespace = Annotated[str, spelled(rf"^/?({WORD}(/{WORD})*)?\Z", "write a namespace, as in /left")]
ConnectionName = Annotated[
    str, spelled(r"^[A-Za-z][A-Za-z0-9_]*\Z", "use letters, digits and '_', a letter first")
]

Truth = Literal[0, 1, "true", "false", "True", "False", "0", "1"] | bool
"""What `if:` and `unless:` may be once their substitutions are resolved."""


class ParameterTree(Special):
    """Value of a ROS parameter, or a mapping of further parameters."""


TREE = ParameterValue | Annotated[dict[str, ParameterTree], Meta(min_length=1)]
"""What a `ParameterTree` may be."""

_NOT_WRITTEN = (None, "", ())


def _written(section: object, ways: Ways) -> int:
    """Return how many of these sets of keys are written."""
    return sum(all(getattr(section, key) not in _NOT_WRITTEN for key in way) for way in ways)


RuleOrFamily = Annotated[
    str,
    Meta(
        extra_json_schema={
            "enum": "rules and families",
            "patternErrorMessage": "use 'default', a family of rules as 'flow', or the id of a"
            " rule (docs/rules.md)",
        }
    ),
]

Word = Literal["report", "deactivate", "pause", "stop"]


class EnterMode(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A mode that is entered.

    Attributes:
        mode: Name of the mode to enter.
    """

    mode: Annotated[str, Meta(examples=["safe"])]


class OnViolation(Special):
    """What is done about violations of an active system.

    No more than to report it, deactivate the nodes that it is about (all where it is about none of
    the system), enter a mode, pause the whole system, or end the run in order with exit code 4. One
    value for all rules, or by id or family of rules; the node's counts before the system's.
    """


ForRules = Annotated[dict[RuleOrFamily, Word | EnterMode], Meta(min_length=1)]
"""What is done by rule or family."""


def read_special(type_: type, value: object) -> object:
    """Return what msgspec has no types for: a type that holds itself, a choice of two mappings.

    Raises:
        ValueError: the value does not fit.
    """
    if type_ is ParameterTree:
        return ParameterTree(msgspec.convert(value, TREE, dec_hook=read_special))
    if type_ is Dscp:
        names = {name for each in code_points() for name in (each.name, *each.aliases)}
        if isinstance(value, str):
            require(value in names)
            return Dscp(parse_dscp(value))
        return Dscp(parse_dscp(msgspec.convert(value, int, strict=isinstance(value, bool))))
    by_rule = isinstance(value, dict) and [*value] != ["mode"]
    reactions = msgspec.convert(value if by_rule else {BY_DEFAULT: value}, ForRules)
    require(reactions.keys() <= {*_rules()})
    return OnViolation(
        tuple(
            Reaction(rule=rule, what=Consequence.MODE, mode=each.mode)
            if isinstance(each, EnterMode)
            else Reaction(rule=rule, what=Consequence(each))
            for rule, each in reactions.items()
        )
    )


def read(plain: object, type_: type[T], *, strict: bool = True) -> T:
    """Return a part of a document, with substitutions resolved, as its type.

    Args:
        plain: lists, mappings and scalars.
        type_: what the part must be.
        strict: whether 5.0 is refused where an integer must be.

    Raises:
        msgspec.ValidationError: it does not fit. This says one thing that is wrong, and not well.
    """
    return msgspec.convert(plain, type_, strict=strict, dec_hook=read_special)


def read_part(document: Document, type_: type[T], place: Place = ()) -> T:
    """Return a part of a valid document as its type; all its defaults where it is not written."""
    return read(document.plain(place), type_, strict=False)


def build(type_: type[B], section: Struct, /, **computed: Any) -> B:
    """Return what the model has of a section: the fields of the same name, and those computed.

    What is not written (None) keeps the default of the model's type.
    """
    for name in type_.__struct_fields__:
        value = getattr(section, name, None)
        if value is not None:
            computed.setdefault(name, value)
    return type_(**computed)


class Argument(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One argument.

    Attributes:
        default: Value when none is given. Without it the argument is required.
        description: What the argument means; shown by messages that ask for it.
        choices: The only values allowed.
    """

    default: Scalar | None = None
    description: str = ""
    choices: Annotated[tuple[Scalar, ...], Meta(min_length=1)] | None = None


class Machine(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One host.

    Attributes:
        address: IPv4 or IPv6 address; this host if left out.
    """

    address: Annotated[str, Meta(examples=["10.77.0.1", "fd00::1"])] = ""


class Mode(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One mode.

    Attributes:
        inactive: Keys of the nodes that are kept inactive in it; all others are as declared.
        parameters: Values that parameters have in it, by key of the node; all others are as they
            are given. Nested mappings are joined with dots.
    """

    inactive: tuple[NodeKey, ...] = ()
    parameters: dict[NodeKey, dict[str, ParameterTree]] = field(default_factory=dict)


def _interface_type(kind: str, example: str) -> Meta:
    message = f"write package/{kind}/Type, as in {example}"
    return Meta(
        description=f"ROS type, package/{kind}/Type.",
        pattern=rf"^{_TYPE}/{kind}/{_TYPE}\Z",
        examples=[example],
        extra_json_schema={"patternErrorMessage": message},
    )


class ActionEndpoint(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One server or client of an action.

    Attributes:
        name: Name as the node's code uses it: relative, absolute or ~/private, before namespace and
            remapping.
        description: What it is for; for people.
    """

    name: Text
    type: Annotated[str, _interface_type("action", "example_interfaces/action/Fibonacci")]
    description: str = ""


class TopicEndpoint(ActionEndpoint, frozen=True, kw_only=True):
    """One publisher or subscription.

    Attributes:
        qos: A preset by its ROS name, or a profile. Policies that are not written are defaults to
            make the endpoint with; nothing requires them.
    """

    type: Annotated[str, _interface_type("msg", "sensor_msgs/msg/Image")]
    qos: Preset | Qos | None = None


class ServiceEndpoint(TopicEndpoint, frozen=True, kw_only=True):
    """One server or client of a service."""

    type: Annotated[str, _interface_type("srv", "std_srvs/srv/Trigger")]


Preset = Literal[
    "default",
    "sensor_data",
    "parameters",
    "parameter_events",
    "services_default",
    "system_default",
    "best_available",
    "rosout_default",
    "clock",
    "action_status_default",
]
"""A QoS profile by its ROS name (rmw/qos_profiles.h)."""


class Qos(QosProfile, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """QoS profile, with rmw's names.

    What is left out is taken from 'preset', or from the default of the endpoint's kind.

    Attributes:
        preset: Preset by its ROS name (rmw/qos_profiles.h).
    """

    preset: Preset | None = None
    depth: Annotated[int, Meta(ge=0, le=2**31 - 1)] = 10

    def __post_init__(self) -> None:
        """Raise ValueError for what is only observed."""
        kinds = (self.history, self.reliability, self.durability, self.liveliness)
        require(all(each.value != "UNKNOWN" for each in kinds))


class Interface(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What the node offers and needs, with the keys of NoDL v2.

    Attributes:
        publishers: Topics it publishes.
        subscriptions: Topics it subscribes to.
        service_servers: Services it offers.
        service_clients: Services it calls.
        action_servers: Actions it offers.
        action_clients: Actions it calls.
        parameters: Parameters it declares, by name; parts joined by dots.
    """

    publishers: tuple[TopicEndpoint, ...] = ()
    subscriptions: tuple[TopicEndpoint, ...] = ()
    service_servers: tuple[ServiceEndpoint, ...] = ()
    service_clients: tuple[ServiceEndpoint, ...] = ()
    action_servers: tuple[ActionEndpoint, ...] = ()
    action_clients: tuple[ActionEndpoint, ...] = ()
    parameters: dict[Text, Parameter] | None = None


InterfaceReference = Annotated[
    str,
    spelled(r"^(local|nodl)://.", "write local://PATH or nodl://PACKAGE/NAME"),
    Meta(
        description="A NoDL document: local://PATH, relative to this manifest, or"
        " nodl://PACKAGE/NAME through the ament index.",
        examples=["local://camera.nodl.yaml"],
    ),
]


Names = Text | Annotated[tuple[Text, ...], Meta(min_length=1)]


class Ready(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What another node, of any program, shows in the graph once it is ready.

    It is waited for until all that is written is there. A managed node waits with its configure,
    any other with its start.

    Attributes:
        publishes: Topics that it has publishers of, by the names that its own code uses: relative,
            absolute or ~/private, before its namespace and remapping.
        serves: Services and actions that it has servers of, likewise.
        parameter: Parameters that it has and that are true.
    """

    ANY_OF: ClassVar[Ways] = (("publishes",), ("serves",), ("parameter",))

    publishes: Annotated[Names, Meta(examples=["scan"])] | None = None
    serves: Annotated[Names, Meta(examples=["~/reset"])] | None = None
    parameter: Annotated[Names, Meta(examples=["ready"])] | None = None

    def __post_init__(self) -> None:
        """Raise ValueError unless one of its sets of keys is written."""
        require(_written(self, self.ANY_OF) > 0)


class Flows(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What endpoints ask of their network flows, by declared name.

    Attributes:
        publishers: Needs of publishers.
        subscriptions: Needs of subscriptions.
    """

    publishers: dict[str, PublisherFlow] = field(default_factory=dict)
    subscriptions: dict[str, SubscriptionFlow] = field(default_factory=dict)


MappedNames = Annotated[
    dict[EndpointKind, tuple[Text, ...]],
    Meta(extra_json_schema={"propertyNames": {"enum": [each.value for each in EndpointKind]}}),
]


class Connection(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One DDS participant of the node's, by one or more transports, and its endpoints.

    Attributes:
        urls: Connection URLs: TRANSPORT://[ADDRESS][:PORT][?OPTION=VALUE&…].
        map: Declared names of the endpoints that it carries, by their list in the interface; 'all'
            for every one of the node.
    """

    urls: Annotated[
        tuple[Text, ...],
        Meta(
            min_length=1,
            examples=[
                ["udpv4://10.77.0.1:7911?metatraffic_port=7910&peer=10.77.0.2:7910&multicast=off"]
            ],
        ),
    ]
    map: Literal["all"] | MappedNames = field(default_factory=dict)


class Node(Supervision, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One node instance.

    Attributes:
        if: This is there only if it is true.
        unless: This is there only if it is not true.
        attach: Others start this node; short for run: {attach: true}.
        machine: Key of a machine under 'machines'; this host if left out.
        namespace: Namespace of the node, / if left out.
        name: ROS name of the node; its key if left out.
        process: Nodes with the same name here share one process.
        managed: False for a node without the ROS 2 lifecycle; one that runs in a process of ours is
            held all the same.
        parameters: Parameter values. Nested mappings are joined with dots, as in ROS parameter
            files.
        parameter_files: ROS parameter files, relative to this manifest; later ones win,
            'parameters' above all.
        remap: Remap rules, from: to.
        after: What each step waits for, by key of the other node: 'started' holds this node's
            start, 'configured' its configure, 'connected' its connect, 'active' its activate; so
            does 'healthy', until the other is active and healthy. Or what it shows in the graph.
        interface: What the node offers and needs, with the keys of NoDL v2, or a NoDL document.
        connections: Connections that this node makes, by a name that is unique in it. Endpoints
            that none carries stay with the node's own participant.
        endpoints: Whether the node may have endpoints that its interface does not declare.
        log_level: Lowest severity the node logs.
        on_violation: What is done about violations that concern it.
        state: State that a managed node is brought to and kept in.
        may_end: Whether its process may end by itself with exit status 0, as that of a client does
            after its last call.
    """

    ONE_OF: ClassVar[Ways] = (("run",), ("attach",))

    if_: Truth | None = field(name="if", default=None)
    unless: Truth | None = None
    run: RunKeys | None = None
    attach: Annotated[bool, Meta(extra_json_schema={"const": True})] | None = None
    machine: Text | None = None
    namespace: Annotated[str, Meta(examples=["/robot"])] = ""
    name: Text | None = None
    process: Name | None = None
    managed: bool = True
    parameters: dict[str, ParameterTree] = field(default_factory=dict)
    parameter_files: tuple[Text, ...] = ()
    remap: dict[Text, Text] = field(default_factory=dict)
    after: dict[NodeKey, Condition | Ready] = field(default_factory=dict)
    timeouts: Timeouts = Timeouts()
    interface: Interface | InterfaceReference | None = None
    flows: Flows = Flows()
    connections: dict[ConnectionName, Connection] = field(default_factory=dict)
    endpoints: EndpointPolicy = EndpointPolicy.DECLARED
    log_level: Literal["debug", "info", "warn", "error", "fatal"] | None = None
    on_violation: OnViolation | None = None
    health: Health | None = None
    state: TargetState = TargetState.ACTIVE
    may_end: bool = False

    def __post_init__(self) -> None:
        """Raise ValueError unless exactly one way to start is written, here and in `run`."""
        for each in (self, self.run) if self.run else (self,):
            require(each.attach is not False and _written(each, each.ONE_OF) == 1)


class Include(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One other manifest.

    Attributes:
        manifest: Path of the other manifest, relative to this one.
        if: This is there only if it is true.
        unless: This is there only if it is not true.
        arguments: Values of its arguments.
        namespace: Put before the namespace of each of its nodes.
        prefix: Put before the key of each of its nodes: 'left' makes 'left/camera'.
    """

    manifest: Text
    if_: Truth | None = field(name="if", default=None)
    unless: Truth | None = None
    arguments: dict[Name, Scalar] = field(default_factory=dict)
    namespace: Namespace = ""
    prefix: NodeKey | None = None


class Shared(Supervision, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Nodes of a document or group, and what they share.

    Attributes:
        use_sim_time: Short for the parameter use_sim_time of each node here and in what is
            included.
        parameters: Parameter values for each node here and in what is included; what a node, its
            files or a group nearer to it set wins. They are compared where a node has them.
        remap: Remap rules, from: to, for each node here and in what is included; a rule for the
            same name that is nearer to a node wins.
        groups: Nodes and includes that share a namespace, a condition, remaps or parameters.
        nodes: Node instances, by a key that is unique in this document.
        include: Other manifests whose nodes, machines and links become part of this system.
            Discovery, network, data layer and policy are this document's own.
    """

    ANY_OF: ClassVar[Ways] = (("nodes",), ("include",), ("groups",))

    use_sim_time: bool | None = None
    parameters: dict[str, ParameterTree] = field(default_factory=dict)
    remap: dict[Text, Text] = field(default_factory=dict)
    groups: tuple[Group, ...] | None = None
    nodes: dict[Name, Node] | None = None
    include: tuple[Include, ...] | None = None

    def __post_init__(self) -> None:
        """Raise ValueError unless one of its sets of keys is written."""
        require(_written(self, self.ANY_OF) > 0)


class Group(Shared, frozen=True, kw_only=True):
    """One group.

    Attributes:
        if: This is there only if it is true.
        unless: This is there only if it is not true.
        namespace: Put before the namespace of each of its nodes.
        prefix: Put before the key of each of its nodes: 'left' makes 'left/camera'.
        machine: Key of the machine of its nodes that name none.
    """

    if_: Truth | None = field(name="if", default=None)
    unless: Truth | None = None
    namespace: Namespace = ""
    prefix: NodeKey | None = None
    machine: Text | None = None


class Manifest(Shared, frozen=True, kw_only=True):
    """One system: what runs where, what it offers and needs, which network flows it must have.

    YAML 1.2: only true and false are booleans; tags and merge keys are refused. $(arg NAME),
    $(env NAME [DEFAULT]), $(find-pkg-share PACKAGE), $(file PATH), $(command PROGRAM …) and the
    conditions may be written in every value; an unquoted value that is one whole substitution takes
    the type of what it becomes.

    Attributes:
        manifest_version: Always 1 for documents that this schema describes.
        system: Name of the system.
        description: What the system is for; for people.
        arguments: Values that the command line sets with name:=value. An argument without default
            is required.
        machines: Hosts, by name. Nodes without 'machine' run on this host.
        modes: Named sets of active nodes and parameters; the first is entered at the start, others
            by `lifecycle mode`.
        links: What must hold between one publishing and one subscribing node.
    """

    manifest_version: Literal[1]
    system: Annotated[
        str,
        spelled(r"^[A-Za-z][A-Za-z0-9_-]*\Z", "use letters, digits, '_' and '-', a letter first"),
        Meta(examples=["teleop"]),
    ]
    description: str = ""
    arguments: dict[Name, Argument] = field(default_factory=dict)
    machines: dict[Name, Machine] = field(default_factory=dict)
    discovery: Discovery = Discovery()
    network: Network = Network()
    data_layer: DataLayer = DataLayer()
    policy: Policy = Policy()
    on_violation: OnViolation | None = None
    modes: Annotated[dict[Name, Mode], Meta(min_length=1)] | None = None
    links: tuple[LinkKeys, ...] = ()

    def __post_init__(self) -> None:
        """Raise ValueError for a rule that there is not."""
        super().__post_init__()
        if self.policy.trust:
            require({*self.policy.trust} <= {each for each in _rules() if "." in each})
