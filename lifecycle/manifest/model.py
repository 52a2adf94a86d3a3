"""Types of a valid manifest: system, nodes, interfaces, flows, connections, discovery, policies.

Owns: the frozen types that cross from here into plan/, with arguments and includes resolved.
Nothing here knows YAML. Pure.
"""

from __future__ import annotations

import enum
from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal

import msgspec
from msgspec import Meta

from lifecycle.codec import UInt32, says
from lifecycle.manifest.diagnostics import Diagnostic, Position
from lifecycle.manifest.qos import POLICIES, QosProfile
from lifecycle.network.connection_url import ConnectionUrl
from lifecycle.network.dscp import TransportPriorityMapping
from lifecycle.network.medium import FlowTransport as FlowTransport  # noqa: PLC0414
from lifecycle.network.nfe import UniqueRequirement


class EndpointKind(enum.Enum):
    """The six kinds of endpoint; values are NoDL v2's list names."""

    PUBLISHER = "publishers"
    SUBSCRIPTION = "subscriptions"
    SERVICE_SERVER = "service_servers"
    SERVICE_CLIENT = "service_clients"
    ACTION_SERVER = "action_servers"
    ACTION_CLIENT = "action_clients"

    @property
    def noun(self) -> str:
        """What messages call one endpoint of this kind, "service server"."""
        return self.value.removesuffix("s").replace("_", " ")

    @property
    def is_topic(self) -> bool:
        """Whether it is an end of a topic: a publisher or a subscription."""
        return self in (EndpointKind.PUBLISHER, EndpointKind.SUBSCRIPTION)

    @property
    def is_action(self) -> bool:
        """Whether it is a server or a client of an action."""
        return self in (EndpointKind.ACTION_SERVER, EndpointKind.ACTION_CLIENT)

    @property
    def meets_in(self) -> str:
        """What it is an end of, "topic", "service" or "action": these do not see each other."""
        return "topic" if self.is_topic else "action" if self.is_action else "service"

    @property
    def offers(self) -> bool:
        """Whether it feeds or serves others, as publishers and servers do; the rest asks."""
        return self is EndpointKind.PUBLISHER or self.value.endswith("_servers")

    @property
    def other_end(self) -> EndpointKind:
        """The kind that it meets: of a publisher a subscription, of a client its server."""
        return _OTHER_ENDS[self]

    def spell(self, name: str) -> str:
        """Return how requests and messages call an endpoint of a node, `publishers/video`."""
        return f"{self.value}/{name}"


_OTHER_ENDS = {
    EndpointKind.PUBLISHER: EndpointKind.SUBSCRIPTION,
    EndpointKind.SUBSCRIPTION: EndpointKind.PUBLISHER,
    EndpointKind.SERVICE_SERVER: EndpointKind.SERVICE_CLIENT,
    EndpointKind.SERVICE_CLIENT: EndpointKind.SERVICE_SERVER,
    EndpointKind.ACTION_SERVER: EndpointKind.ACTION_CLIENT,
    EndpointKind.ACTION_CLIENT: EndpointKind.ACTION_SERVER,
}


class RunKind(enum.Enum):
    """How a node is started."""

    PYTHON = "python"  # our host imports module:Class
    COMMAND = "command"  # any executable, given --ros-args
    ATTACH = "attach"  # started outside the supervisor


class RosArguments(enum.Enum):
    """Which ROS arguments a command is given."""

    AUTO = "auto"  # those that a key of the node asks for
    NONE = "none"  # the program parses its own command line


class Output(enum.Enum):
    """Where goes what a process prints."""

    BOTH = "both"
    SCREEN = "screen"  # no log file
    LOG = "log"  # the file alone


class TargetState(enum.Enum):
    """Primary state that a managed node is brought to (lifecycle_msgs/State)."""

    UNCONFIGURED = "unconfigured"
    INACTIVE = "inactive"
    ACTIVE = "active"


class Executor(enum.Enum):
    """Which of rclpy's executors runs the callbacks of a Python process."""

    SINGLE = "single"  # one callback at a time
    MULTI = "multi"  # in several threads, as callback groups allow
    EVENTS = "events"  # rclpy.experimental's EventsExecutor, one at a time


class Condition(enum.Enum):
    """What a node's own step waits for in another node; ordered.

    The condition names the step that waits: `after: {b: configured}` lets this node start at once,
    but begins its configure only when b is configured; `connected` and `active` hold its connect
    and its activate alike; `started` holds its start. `healthy` holds the activate, too, until b is
    active and what its `health` names says so. A node that is not managed has only a start,
    so for it every condition holds the start, and `active` is refused: the gate needs it running.
    """

    STARTED = "started"
    CONFIGURED = "configured"
    CONNECTED = "connected"
    ACTIVE = "active"
    HEALTHY = "healthy"

    def __str__(self) -> str:
        """Return it as the manifest spells it."""
        return self.value


class ReadyBy(enum.Enum):
    """What shows in the graph that a node is ready."""

    PUBLISHES = "publishes"
    SERVES = "serves"
    PARAMETER = "parameter"

    @property
    def kinds(self) -> tuple[EndpointKind, ...]:
        """Of which kind the endpoint may be that shows it; none for a parameter."""
        return {
            ReadyBy.PUBLISHES: (EndpointKind.PUBLISHER,),
            ReadyBy.SERVES: (EndpointKind.SERVICE_SERVER, EndpointKind.ACTION_SERVER),
        }.get(self, ())


class DiscoveryMode(enum.Enum):
    """How participants find each other."""

    DYNAMIC = "dynamic"  # by multicast: any participant is found
    STATIC = "static"  # only the planned participants, at planned addresses and ports
    STATIC_ENDPOINTS = "static_endpoints"  # likewise, and endpoints are known without announcement
    SERVER = "server"  # by a discovery server that the supervisor starts and watches


class DiscoveryRange(enum.Enum):
    """ROS_AUTOMATIC_DISCOVERY_RANGE."""

    SUBNET = "subnet"
    LOCALHOST = "localhost"
    OFF = "off"
    SYSTEM_DEFAULT = "system_default"


class Authority(enum.Enum):
    """Who calls connect_to and map_to (*Topological Discovery and Communication Negotiation*)."""

    NODES = "nodes"  # each node follows the instructions that it was started with
    SUPERVISOR = "supervisor"  # nodes open nothing for data until instructed


class DataLayerSource(enum.Enum):
    """What the data layer graph is made from."""

    STATIC = "static"  # the manifest alone
    DYNAMIC = "dynamic"  # the node configurations, read while the system runs


class EndpointPolicy(enum.Enum):
    """Whether a node may have endpoints that the manifest does not declare."""

    DECLARED = "declared"
    OPEN = "open"


class RosInterfaceAccess(enum.Enum):
    """What a supervisor offers over ROS topics and services."""

    OFF = "off"
    READ_ONLY = "read_only"
    FULL = "full"


class UniqueHow(enum.Enum):
    """What a link demands of its flow."""

    NOT = "not"
    WEAKLY = "weakly"
    STRONGLY = "strongly"


def spelled(pattern: str, message: str) -> Meta:
    """Return the pattern of a string, with what is said of one that does not match."""
    return Meta(pattern=pattern, extra_json_schema={"patternErrorMessage": message})


WORD = "[A-Za-z_][A-Za-z0-9_]*"

Text = Annotated[str, Meta(min_length=1)]
NodeKey = Annotated[
    str, spelled(rf"^{WORD}(/{WORD})*\Z", "use letters, digits and '_', parts joined by '/'")
]
Name = Annotated[str, spelled(rf"^{WORD}\Z", "use letters, digits and '_', not a digit first")]
_OCTET = "(25[0-5]|2[0-4][0-9]|1[0-9][0-9]|[1-9]?[0-9])"
IPv4Group = Annotated[
    str,
    spelled(
        rf"^(22[4-9]|23[0-9])(\.{_OCTET}){{3}}\Z",
        "write an IPv4 group; 239.255.* stay within an organisation (RFC 2365)",
    ),
]
Seconds = Annotated[float, Meta(gt=0, le=86400)]
SecondsOrNone = Annotated[float, Meta(ge=0, le=86400)]
Milliseconds = Annotated[float, Meta(gt=0, le=86_400_000)]
Hertz = Annotated[float, Meta(gt=0, le=1_000_000)]

PythonName = Annotated[
    str,
    spelled(
        rf"^{WORD}(\.{WORD})*:{WORD}\Z",
        "write module:Class, as in examples.teleop.nodes:Camera",
    ),
    Meta(examples=["examples.teleop.nodes:Camera"]),
]
Plugin = Annotated[
    str,
    spelled(
        rf"^[A-Za-z][A-Za-z0-9_]*/{WORD}(::{WORD})*\Z",
        "write package/Plugin, as in image_tools/image_tools::Cam2Image",
    ),
    Meta(examples=["image_tools/image_tools::Cam2Image"]),
]
Scalar = bool | int | float | str
"""A value that is one word: where its text counts, whatever scalar it is."""

ParameterValue = Scalar | tuple[Scalar, ...]
"""A ROS parameter value; arrays are tuples of one scalar type."""


Ways = tuple[tuple[str, ...], ...]
"""Sets of keys; a set is written if all of its keys are."""


class Special:
    """A value for which msgspec has no type; `written.read_special` reads it."""

    def __init__(self, value: Any) -> None:
        self.value = value


def require(condition: bool) -> None:
    """Raise ValueError for keys of a section that do not fit each other."""
    if not condition:
        raise ValueError("a section whose keys do not fit each other")


class Limits(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Limits of a process by setrlimit(2), after LimitAS= and the like of systemd.exec(5).

    What is left out is as for the supervisor.

    Attributes:
        as_mib: Address space of the process in MiB, as LimitAS=.
        cpu_sec: Processor time in seconds, as LimitCPU=; SIGXCPU ends the process then.
        nofile: Open files of the process, as LimitNOFILE=.
        nproc: Processes and threads of its user, all together, as LimitNPROC=; the kernel does not
            apply it to root.
    """

    as_mib: Annotated[int, Meta(ge=1, le=2**24)] | None = None
    cpu_sec: Annotated[int, Meta(ge=1, le=31_536_000)] | None = None
    nofile: Annotated[int, Meta(ge=1, le=2**20)] | None = None
    nproc: Annotated[int, Meta(ge=1, le=2**22)] | None = None

    def resources(self) -> tuple[tuple[str, int], ...]:
        """Return name and value for setrlimit(2) of those that are set."""
        found = (
            ("RLIMIT_AS", self.as_mib and self.as_mib * 2**20),
            ("RLIMIT_CPU", self.cpu_sec),
            ("RLIMIT_NOFILE", self.nofile),
            ("RLIMIT_NPROC", self.nproc),
        )
        return tuple((name, value) for name, value in found if value is not None)


class ResourceLimits(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What a process and all that it starts may use together, as systemd.resource-control(5).

    None sets no limit. systemd sets them, for a scope of the process.

    Attributes:
        memory_max_mib: Memory in MiB beyond which the kernel kills, as MemoryMax=.
        memory_high_mib: Memory in MiB beyond which the kernel slows down and reclaims, as
            MemoryHigh=.
        cpu_quota_percent: Processor time in percent of one CPU, as CPUQuota=; 250 is two CPUs and a
            half.
        cpu_weight: Share of the processors among siblings that want more than there is, as
            CPUWeight=; 100 without it.
        tasks_max: Processes and threads, as TasksMax=.
    """

    memory_max_mib: Annotated[int, Meta(ge=1, le=2**24)] | None = None
    memory_high_mib: Annotated[int, Meta(ge=1, le=2**24)] | None = None
    cpu_quota_percent: Annotated[int, Meta(ge=1, le=102_400)] | None = None
    cpu_weight: Annotated[int, Meta(ge=1, le=10_000)] | None = None
    tasks_max: Annotated[int, Meta(ge=1, le=2**22)] | None = None

    def properties(self) -> tuple[str, ...]:
        """Return the limits as systemd.resource-control(5) spells them, `MemoryMax=64M`."""
        found = (
            ("MemoryMax", self.memory_max_mib, "M"),
            ("MemoryHigh", self.memory_high_mib, "M"),
            ("CPUQuota", self.cpu_quota_percent, "%"),
            ("CPUWeight", self.cpu_weight, ""),
            ("TasksMax", self.tasks_max, ""),
        )
        return tuple(f"{name}={value}{unit}" for name, value, unit in found if value is not None)


class Resources(ResourceLimits, frozen=True, kw_only=True):
    """What a process may use, and where that is written, which is no difference."""

    at: Position

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Resources) and self.properties() == other.properties()

    def __hash__(self) -> int:
        return hash(self.properties())


class ProcessKeys(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What is asked of the process of a node, as it is written: all nodes in it ask for the same.

    Attributes:
        ros_args: ROS arguments of a command: 'auto' appends those that 'name', 'namespace',
            'remap', 'parameters' and 'log_level' ask for; 'none' never appends any.
        output: Where what the process prints goes: to the terminal, to its log file, or both.
        no_new_privileges: Whether the process and what it starts can gain no privileges by running
            a program, as NoNewPrivileges= of systemd.exec(5).
        limits: Limits of what the process may use, by setrlimit(2); what is left out is as for the
            supervisor.
    """

    ros_args: RosArguments = RosArguments.AUTO
    output: Output = Output.BOTH
    no_new_privileges: bool = False
    limits: Limits | None = None


PROCESS_KEYS = (
    *("environment", "working_directory", "prefix", "resources"),
    *ProcessKeys.__struct_fields__,
)
"""Keys of `run` that are of the process, whatever runs in it."""


class RunKeys(ProcessKeys, frozen=True, kw_only=True, omit_defaults=True):
    """How the node comes to run; exactly one way.

    Attributes:
        python: Node class, module:Class, or a function that returns nodes, module:function.
        arguments: Keyword arguments that the class or function of 'python' is called with.
        executor: What runs the callbacks of the Python process; nodes that share it must agree.
        threads: Threads of 'executor: multi'; one for each processor, at least two, if left out.
        command: Program and its arguments; ROS arguments are appended as 'ros_args' says.
        package: Installed package that holds 'executable'.
        executable: Executable in lib/PACKAGE.
        attach: Others start this node.
        environment: Environment variables on top of the supervisor's.
        working_directory: Folder the process starts in, relative to this manifest.
        component: Plugin that a component container loads, package/Plugin.
        container: Node that loads 'component': the key of a node here, or the full name of one that
            others start.
        extra_arguments: Extra arguments of the request that loads 'component' (LoadNode.srv), as
            'use_intra_process_comms' of rclcpp_components.
        prefix: What comes before the process's command line, as for gdb, nice, taskset and perf.
        resources: What the process and all that it starts may use together, as
            systemd.resource-control(5); set by systemd where that runs, else unverifiable.
    """

    ONE_OF: ClassVar[Ways] = (
        ("python",),
        ("command",),
        ("package", "executable"),
        ("component", "container"),
        ("attach",),
    )

    python: PythonName = ""
    arguments: Mapping[Name, ParameterValue] = msgspec.field(default_factory=dict)
    executor: Executor = Executor.SINGLE
    threads: Annotated[int, Meta(ge=1, le=256)] | None = None
    command: Annotated[tuple[Scalar, ...], Meta(min_length=1)] = ()
    package: Text = ""
    executable: Text = ""
    attach: Annotated[bool, Meta(extra_json_schema={"const": True})] | None = None
    environment: Mapping[Name, Scalar] = msgspec.field(default_factory=dict)
    working_directory: Text = ""
    component: Plugin = ""
    container: Annotated[Text, Meta(examples=["container", "/robot/container"])] = ""
    extra_arguments: Annotated[Mapping[str, ParameterValue], Meta(min_length=1)] = msgspec.field(
        default_factory=dict
    )
    prefix: Annotated[
        tuple[Scalar, ...],
        Meta(min_length=1, examples=[["gdb", "-ex", "run", "--args"], ["nice", "-n", 5]]),
    ] = ()
    resources: ResourceLimits | None = None


class Run(RunKeys, frozen=True, kw_only=True):
    """How to start a node. Exactly one of the forms is set, as `kind` says.

    Attributes:
        threads: 0 is one for each processor, at least two.
        command: empty when `package`/`executable` name it.
        working_directory: absolute.
        container: key, or full name, of the container's node; the node's kind is ATTACH then.
    """

    kind: RunKind
    python: str = ""
    arguments: Mapping[str, ParameterValue] = msgspec.field(default_factory=dict)
    threads: int = 0
    command: tuple[str, ...] = ()
    component: str = ""
    environment: Mapping[str, str] = msgspec.field(default_factory=dict)
    prefix: tuple[str, ...] = ()
    resources: Resources | None = None


class Readiness(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """What any node, also one that knows nothing of us, shows in the graph once it is ready.

    It holds the configure of a managed node that waits for it, which may call the service or read
    the topic, and the start of any other. The node that shows it must have started; it is waited
    for before the gate opens, so it must not depend on that.

    Attributes:
        by: that it has a publisher, a server of a service or an action, or a true parameter.
        name: as the node's own code uses it, before its namespace and its remap rules.
    """

    by: ReadyBy
    name: str

    def __str__(self) -> str:
        """Return it as people read it after the node's name: `publishes scan`."""
        if self.by is not ReadyBy.PARAMETER:
            return f"{self.by.value} {self.name}"
        return f"has parameter {self.name}: true"


class After(msgspec.Struct, frozen=True, kw_only=True):
    """A step of this node, see `condition`, begins once `node` (a key) has reached it."""

    node: str
    condition: Condition | Readiness
    at: Position

    def __str__(self) -> str:
        """Return `driver active`, `driver publishes scan`."""
        return f"{self.node} {self.condition}"


class Timeouts(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Deadline of each step of a node, in seconds.

    Attributes:
        start_s: Seconds from starting the process until the node answers.
        configure_s: Seconds for configure.
        connect_s: Seconds for connect.
        activate_s: Seconds for activate.
        deactivate_s: Seconds for deactivate.
        cleanup_s: Seconds for cleanup.
        shutdown_s: Seconds for shutdown.
        silent_s: Seconds that a callback other than a transition's may take before the node counts
            as silent; nodes of one process share the longest.
    """

    start_s: Seconds = 10.0
    configure_s: Seconds = 10.0
    connect_s: Seconds = 10.0
    activate_s: Seconds = 10.0
    deactivate_s: Seconds = 5.0
    cleanup_s: Seconds = 5.0
    shutdown_s: Seconds = 5.0
    silent_s: Seconds = 0.8


class Restart(enum.Enum):
    """When a process that ended unasked is started again, in the words of systemd.service(5)."""

    NO = "no"
    ON_FAILURE = "on-failure"
    ALWAYS = "always"


class OnFailure(enum.Enum):
    """What is restarted with a process that failed."""

    NODE = "node"
    DEPENDENTS = "dependents"
    ALL = "all"


class Supervision(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What is done when the process of a node fails; as systemd spells it.

    All nodes of one process have the same.

    Attributes:
        restart: When the process of a node is started again that ended unasked: 'on-failure' for
            any end but exit status 0, for a step that failed and for the watchdog, 'always' also
            for exit status 0.
        restart_sec: Seconds from a failure to the next start.
        restart_steps: Failures in a row over which the delay grows from 'restart_sec' to
            'restart_max_delay_sec'.
        restart_max_delay_sec: Longest delay in seconds, reached after 'restart_steps' failures in a
            row.
        start_limit_burst: Starts within 'start_limit_interval_sec', after which supervision gives
            up.
        start_limit_interval_sec: Seconds in which starts are counted, 0 for no limit; a process
            that ran for so long begins anew with 'restart_sec'.
        on_failure: What is restarted together with a process that failed: nothing else, those that
            have it in 'after', directly or through others, or the whole system.
        watchdog_sec: Seconds after which a process that is stopped or hangs in a callback is ended,
            and started again; 0 for never.
    """

    restart: Restart = Restart.NO
    restart_sec: SecondsOrNone = 0.1
    restart_steps: Annotated[int, Meta(ge=0, le=1000)] = 0
    restart_max_delay_sec: SecondsOrNone | None = None
    start_limit_burst: Annotated[int, Meta(ge=1, le=1000)] = 5
    start_limit_interval_sec: SecondsOrNone = 10.0
    on_failure: OnFailure = OnFailure.NODE
    watchdog_sec: SecondsOrNone = 3.0


SUPERVISION_KEYS = Supervision.__struct_fields__


class Consequence(enum.Enum):
    """What is done about a violation of an active system; each is stronger than the one before."""

    REPORT = "report"  # nothing but the verdict
    DEACTIVATE = "deactivate"  # the nodes it is about; all where it is about none of the system
    MODE = "mode"  # another mode is entered
    PAUSE = "pause"  # all nodes, as `lifecycle pause`
    STOP = "stop"  # the run ends


SIM_TIME = "use_sim_time"
"""The parameter with which a node takes its time from /clock."""

BY_DEFAULT = "default"
"""Key of `on_violation` for every rule that it does not name."""


class Reaction(msgspec.Struct, frozen=True, kw_only=True):
    """What is done about violations of some rules.

    Attributes:
        rule: id of a rule, family of rules (the id's part before the dot) or BY_DEFAULT.
        mode: name of the one that is entered, for MODE; else empty.
    """

    rule: str
    what: Consequence
    mode: str = ""


OnViolation = tuple[Reaction, ...]
"""Each rule, family or BY_DEFAULT once; may be empty."""


class Endpoint(msgspec.Struct, frozen=True, kw_only=True):
    """One declared endpoint.

    Attributes:
        name: as declared; relative, absolute or `~/private`, before remapping.
        type: `package/msg/Type`, `package/srv/Type` or `package/action/Type`.
        qos: what it is made with; None for actions.
        qos_defaults: policies of `qos` that no manifest writes: they are the default of the kind,
            good for making the endpoint, and not required.
    """

    kind: EndpointKind
    name: str
    type: str
    qos: QosProfile | None
    qos_defaults: tuple[Annotated[str, says(enum=[*POLICIES])], ...] = ()
    at: Position


ParameterType = Literal[
    "bool",
    "int",
    "double",
    "string",
    "bool_array",
    "int_array",
    "double_array",
    "string_array",
    "byte_array",
]


class Parameter(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One parameter declaration.

    Attributes:
        type: Type, as generate_parameter_library and rcl_interfaces name it.
        default_value: Value when none is given.
        description: What it means; for people.
        read_only: It cannot change once the node runs.
    """

    type: ParameterType
    default: ParameterValue | None = msgspec.field(name="default_value", default=None)
    description: str = ""
    read_only: bool = False


class ParameterDeclaration(Parameter, frozen=True, kw_only=True):
    """A parameter of an interface, where it is declared; its default has its type."""

    name: str
    at: Position


class Interface(msgspec.Struct, frozen=True, kw_only=True):
    """What a node offers and needs, in NoDL v2 terms.

    Attributes:
        has_all_parameters: `parameters` are all that the node has: it is written down, or a NoDL
            document, which describes a node as a whole.
    """

    endpoints: tuple[Endpoint, ...] = ()
    parameters: tuple[ParameterDeclaration, ...] = ()
    has_all_parameters: bool = False

    def find(self, kind: EndpointKind, name: str) -> Endpoint | None:
        """Return the endpoint of a kind by its declared name; None if there is none."""
        return next((e for e in self.endpoints if e.kind is kind and e.name == name), None)


QUANTILE = 0.99
"""Share of the messages that a delay is declared of, where the manifest does not say."""

RATE_SLACK = 0.05
"""Share of a plain `rate_hz` that may be missing: timers and clocks are not that exact."""


class Rate(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How often messages arrive.

    Attributes:
        min: Fewest messages per second.
        max: Most messages per second.
    """

    min: Hertz | None = None
    max: Hertz | None = None


class MeasuredKeys(msgspec.Struct, frozen=True, kw_only=True):
    """What is measured where data arrive, in nodes that are run by us, once they are active.

    Attributes:
        max_delay_ms: Longest delay from publication to the start of the callback, milliseconds.
        quantile: Share of the messages that must keep 'max_delay_ms'.
        loss: Highest share of messages lost that this flow bears.
        rate_hz: Messages per second, of which 5 % may be missing; or 'min' and 'max', exactly.
        max_silence_s: Longest time without a message, seconds.
        measure: Whether a subscription of ours measures it where the node that subscribes does not
            run in our host.
    """

    max_delay_ms: Milliseconds | None = None
    quantile: Annotated[float, Meta(gt=0, lt=1)] = QUANTILE
    loss: Annotated[float, Meta(gt=0, le=1)] | None = None
    rate_hz: Hertz | Rate | None = None
    max_silence_s: Seconds | None = None
    measure: bool = False


class Quantity(msgspec.Struct, frozen=True, kw_only=True):
    """A number that a manifest promises or asks for, and where it is written.

    Attributes:
        name: the manifest's key, which has the unit: `max_delay_ms`, `rate_hz`, `five_qi`.
        value: of a rate its lower bound; 0 where only `max` is written.
        most: upper bound of a rate; None without.
        slack: share of the lower bound of a rate that may be missing.
        quantile: of a delay: the share of the messages that must not exceed it.
    """

    name: str
    value: float
    at: Position
    most: float | None = None
    slack: float = 0.0
    quantile: float = QUANTILE

    def __str__(self) -> str:
        """Return `max_delay_ms 5`, `rate_hz {min: 10, max: 20}`."""
        if self.most is not None:
            least = f"min: {self.value:g}, " if self.value else ""
            return f"{self.name} {{{least}max: {self.most:g}}}"
        share = f" for {self.quantile:.6g}" if self.quantile != QUANTILE else ""
        return f"{self.name} {self.value:.15g}{share}"


class Dscp(int):
    """A differentiated services code point: a name (RFC 2474, 2597, 3246, …) or 0 to 63."""


class SubscriptionFlow(MeasuredKeys, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One subscription's flow.

    Attributes:
        unique: require_unique_network_flow_endpoints: whether this endpoint must have a network
            flow endpoint that no other has.
        dscp: Differentiated services code point of everything it sends, which is its
            acknowledgements: the data carry the publisher's. A name (RFC 2474, 2597, 3246, …) or 0
            to 63.
        transport_priority: DDS TRANSPORT_PRIORITY of the DataReader, instead of 'dscp': goes
            through 'network.transport_priority_mapping' to become a TOS byte, which is four times
            the DSCP. Without a mapping it is the TOS byte.
        enforce: Whether a DSCP that could not be applied is violated (true) or a warning (false).
        transport: What carries it: what the planner chooses (any), an IP socket (network), shared
            memory (shm), UDP (udpv4, udpv6), one datagram with TTL 0 for all subscriptions of the
            host (multicast), TCP (tcpv4).
        lossy: Whether the data bear an unreliable transport; what the node itself says if left out.
    """

    unique: UniqueRequirement = UniqueRequirement.NOT_REQUIRED
    dscp: Dscp | None = None
    transport_priority: Annotated[UInt32, Meta(examples=[184])] | None = None
    enforce: bool = True
    transport: FlowTransport = FlowTransport.ANY
    lossy: bool | None = None


class PublisherFlow(SubscriptionFlow, frozen=True, kw_only=True):
    """One publisher's flow.

    Attributes:
        dscp: Differentiated services code point of everything it sends: a name (RFC 2474, 2597,
            3246, …) or 0 to 63.
        transport_priority: DDS TRANSPORT_PRIORITY, instead of 'dscp': goes through
            'network.transport_priority_mapping' to become a TOS byte, which is four times the DSCP.
            Without a mapping it is the TOS byte.
        five_qi: 5G QoS identifier, 3GPP TS 23.501 Table 5.7.4-1; 'auto' proposes one from
            'max_delay_ms', 'loss' and 'rate_hz' and says why.
        max_delay_ms: Longest delay from publication to the start of the callback, milliseconds;
            that of the links of its topic if left out.
        max_message_size: Largest serialized message, bytes.
        non_blocking_send: Never wait for room in the socket's buffer: what finds it full is lost,
            and only a RELIABLE publisher sends it again.
    """

    five_qi: Literal["auto"] | Annotated[int, Meta(ge=1, le=254)] | None = None
    max_message_size: Annotated[int, Meta(ge=1, le=2**32 - 1)] | None = None
    non_blocking_send: bool = False


class FlowNeed(PublisherFlow, frozen=True, kw_only=True):
    """What one endpoint asks of its network flow.

    Attributes:
        kind: PUBLISHER or SUBSCRIPTION.
        name: the endpoint's declared name.
        dscp: 0–63, of all that the endpoint sends; None leaves it alone. Never beside
            `transport_priority`.
        five_qi: None if not asked for, or left to us.
        five_qi_auto: `five_qi: auto`: the planner proposes one.
        rate_hz: messages per second that a network must carry: the upper bound where it has one.
        quantities: each of its numbers that only a measurement could prove, as it is written.
    """

    kind: EndpointKind
    name: str
    dscp: int | None = None  # type: ignore[assignment]
    five_qi: int | None = None
    five_qi_auto: bool = False
    rate_hz: float | None = None
    quantities: tuple[Quantity, ...] = ()
    at: Position


class ConnectionDeclaration(msgspec.Struct, frozen=True, kw_only=True):
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


class Health(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What shows whether the node is healthy, which it then must be (rule node.unhealthy).

    Attributes:
        check: Its own method `health`, of a lifecycle.LifecycleNode.
        diagnostics: Names of its entries on /diagnostics, patterns with '*' and '?'.
        interval_s: Seconds between two calls of that method.
        timeout_s: Seconds within which it must have returned where it is async; one that is not is
            noticed by timeouts.silent_s.
    """

    check: bool = False
    diagnostics: tuple[Text, ...] = ()
    interval_s: Seconds = 1.0
    timeout_s: Seconds = 1.0


class NodeDeclaration(msgspec.Struct, frozen=True, kw_only=True):
    """What a manifest declares of one node that its plan takes over as it is.

    Attributes:
        key: its key under `nodes:`, unique in the system (prefixed by includes as `prefix/key`).
        name: ROS base name; the key's last part unless `name:` is set.
        namespace: absolute, `/` for the root.
        managed: True for a ROS 2 managed node; False for a plain node.
        parameters: (name, value) given on top of parameter files.
        remap: (from, to) as written.
        state: where a managed node is brought to, and kept.
        may_end: its process may end by itself with exit status 0.
        supervision: what is done when its process fails.
        on_violation: what is done about violations that concern it; before that of the system.
        health: what shows that it is healthy; None if nothing is asked of it.
    """

    key: str
    name: str
    namespace: str
    machine: str
    run: Run
    managed: bool = True
    parameters: tuple[tuple[str, ParameterValue], ...] = ()
    parameter_files: tuple[str, ...] = ()
    remap: tuple[tuple[str, str], ...] = ()
    after: tuple[After, ...] = ()
    timeouts: Timeouts = Timeouts()
    log_level: str = ""
    state: TargetState = TargetState.ACTIVE
    may_end: bool = False
    supervision: Supervision = Supervision()
    on_violation: OnViolation = ()
    health: Health | None = None
    at: Position

    @property
    def full_name(self) -> str:
        """Fully qualified node name, `/robot/camera`."""
        return f"{self.namespace.rstrip('/')}/{self.name}"

    @property
    def holds(self) -> bool:
        """It waits for the gate: a managed node, or a plain one in a process of ours."""
        return self.managed or self.run.kind is RunKind.PYTHON


class Node(NodeDeclaration, frozen=True, kw_only=True):
    """One node instance.

    Attributes:
        process: nodes with the same non-empty process name share one process.
        positions: where parts of the node are, by path below it: `machine`, `namespace`, `name`,
            `process`, `restart_sec`, `on_violation.param`, `remap.scan`, `parameters.rate`,
            `parameter_files.0`; read with `where`.
        written_paths: paths as the manifest writes them, by place: `parameter_files.0`,
            `run.working_directory`; what other fields have of them is absolute.
        shared: parts that are written for several nodes, by path as in `positions`.
    """

    process: str = ""
    interface: Interface = Interface()
    flows: tuple[FlowNeed, ...] = ()
    endpoints: EndpointPolicy = EndpointPolicy.DECLARED
    connections: tuple[ConnectionDeclaration, ...] = ()
    positions: Mapping[str, Position] = msgspec.field(default_factory=dict)
    written_paths: tuple[tuple[str, str], ...] = ()
    shared: frozenset[str] = frozenset()

    @property
    def process_name(self) -> str:
        """The name of its process: as declared, else the node's key."""
        return self.process or self.key

    def where(self, part: str) -> Position:
        """Return the position of a part of this node; the node's own if that is not known."""
        return self.positions.get(part, self.at)


THIS_HOST = "local"
"""Name of the machine of nodes that name none; declared implicitly, without address."""


class Machine(msgspec.Struct, frozen=True, kw_only=True):
    """A host. `address` is an IPv4 or IPv6 address, or empty for this host."""

    name: str
    address: str = ""
    at: Position


DISCOVER_BY = tuple(
    each for each in FlowTransport if each not in (FlowTransport.NETWORK, FlowTransport.MULTICAST)
)
"""What participants may find each other by."""


class Discovery(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How DDS participants find each other.

    Attributes:
        domain_id: DDS domain; ROS_DOMAIN_ID, else 0, if left out.
        mode: How participants find each other: by multicast (dynamic); at planned addresses and
            ports, and no others (static); the same, and endpoints are not announced
            (static_endpoints); by a discovery server that the supervisor starts and watches
            (server).
        range: ROS_AUTOMATIC_DISCOVERY_RANGE.
        transport: What the nodes' own participants use: the middleware's default, or what the mode
            needs, UDP or for 'server' TCP (any); shared memory alone, so that a node has no IP
            socket until it is connected (shm); one kind of IP socket.
        first_port: First of the ports given out on each machine, where the mode or a connection
            fixes them.
        server_machine: Key of the machine that runs the discovery server; the first one if left
            out.
        settle_s: Seconds in which a supervisor sees everybody who is there, where it can ask none:
            3.5, or 5 with LARGE_DATA, if left out.
    """

    domain_id: Annotated[int, Meta(ge=0, le=232)] | None = None
    mode: DiscoveryMode = DiscoveryMode.DYNAMIC
    range: DiscoveryRange = DiscoveryRange.SYSTEM_DEFAULT
    transport: Annotated[
        FlowTransport, Meta(extra_json_schema={"enum": [each.value for each in DISCOVER_BY]})
    ] = FlowTransport.ANY
    first_port: Annotated[int, Meta(ge=1024, le=65535)] = 7910
    server_machine: str = ""
    settle_s: Seconds | None = None

    def __post_init__(self) -> None:
        """Raise ValueError for a transport that carries data alone."""
        if self.transport not in DISCOVER_BY:
            raise ValueError(f"no participant is found by {self.transport.value}")


class DataLayer(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How endpoints come onto connections; for the whole system.

    Attributes:
        authority: Who calls connect_to and map_to: each node by itself, as planned (nodes),
            or the supervisor (supervisor).
        source: What connections are made from: this manifest (static), or the node configurations,
            read while the system runs (dynamic).
        events: Whether nodes report connections made and lost to the graph, and lost ones are
            made again.
        multicast_group: First of the IPv4 groups given out, one to each topic that goes by
            multicast.
    """

    authority: Authority = Authority.NODES
    source: DataLayerSource = DataLayerSource.STATIC
    events: bool = False
    multicast_group: IPv4Group = "239.255.1.1"


class Network(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How flow needs become network resources.

    Attributes:
        max_datagram_bytes: UDP payload that the path carries without fragments; 1472 on Ethernet
            with IPv4 if left out.
    """

    transport_priority_mapping: TransportPriorityMapping | None = None
    max_datagram_bytes: Annotated[int, Meta(ge=1200, le=65500)] | None = None


TOLERATED_NODES = (
    "_ros2cli_*",
    "launch_ros_*",
    "rqt_*",
    "rviz",
    "rviz2",
    "rviz_*",
    "rosbag2_recorder",
    "rosbag2_player",
    "transform_listener_impl_*",
)
"""Names of nodes that tools make, as the tools choose them: the default of `tolerated_nodes`."""


RuleId = Annotated[str, Meta(extra_json_schema={"enum": "rules"})]
"""Id of a rule of `lifecycle.verify`, which the schema lists (docs/rules.md)."""


class Policy(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How strict checks and verification are.

    Attributes:
        undeclared_nodes: Whether nodes that no manifest declares may be in the graph.
        tolerated_nodes: Names of nodes that may be there although no manifest declares them, as
            long as they only subscribe: tools. `*` matches any characters, `?` for one; a pattern
            with a slash is compared with the full name, any other with the base name.
        unverifiable: Whether what cannot be observed keeps the gate closed (block), or is taken on
            trust and named when it opens (allow).
        trust: Ids of rules (docs/rules.md) of which what cannot be verified is taken on trust: it
            is reported, and neither closes the gate nor counts for --strict. What is violated is
            never trusted.
        unpublished: A subscription that no declared node publishes to.
        unheard: A publisher that no declared node subscribes to.
        ros_interface: What the supervisor offers in ROS once the system is active, or is held up on
            its way there: nothing (off), /diagnostics, a status topic and a service for it
            (read_only), or also services that pause, resume, restart and end the system (full). If
            left out read_only, where the packages that it takes are installed.
    """

    undeclared_nodes: EndpointPolicy = EndpointPolicy.DECLARED
    tolerated_nodes: tuple[Annotated[str, Meta(pattern=r"^[A-Za-z0-9_/*?]+\Z")], ...] = (
        TOLERATED_NODES
    )
    unverifiable: Literal["allow", "block"] = "allow"
    trust: Annotated[tuple[RuleId, ...], Meta(examples=[["flow.unreported"]])] = ()
    unpublished: Literal["error", "warning", "ignore"] = "error"
    unheard: Literal["error", "warning", "ignore"] = "warning"
    ros_interface: RosInterfaceAccess | None = None

    @property
    def unverifiable_blocks(self) -> bool:
        """Whether an unverifiable finding closes the gate."""
        return self.unverifiable == "block"

    @property
    def access(self) -> RosInterfaceAccess:
        """What the supervisor offers in ROS."""
        return self.ros_interface or RosInterfaceAccess.READ_ONLY


class LinkKeys(MeasuredKeys, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One link.

    Attributes:
        topic: Fully qualified topic name, after namespace and remapping.
        from: Key of the publishing node.
        to: Key of the subscribing node.
        unique: How unique the flow between them must be.
        transport: What carries it: what the planner chooses (any), an IP socket (network), shared
            memory (shm), UDP (udpv4, udpv6), one datagram with TTL 0 for all subscriptions of the
            host (multicast), TCP (tcpv4).
    """

    topic: Annotated[Text, Meta(examples=["/robot/video"])]
    from_node: NodeKey = msgspec.field(name="from")
    to_node: NodeKey = msgspec.field(name="to")
    unique: UniqueHow = UniqueHow.NOT
    transport: FlowTransport = FlowTransport.ANY


class Link(LinkKeys, frozen=True, kw_only=True):
    """A link, where it is written, and what of it nothing but a measurement could prove."""

    quantities: tuple[Quantity, ...] = ()
    at: Position


class ModeParameter(msgspec.Struct, frozen=True, kw_only=True):
    """The value that a parameter of a node has in a mode.

    Attributes:
        node: its key.
    """

    node: str
    name: str
    value: ParameterValue
    at: Position


class Mode(msgspec.Struct, frozen=True, kw_only=True):
    """A named set of nodes that are active, all that are to be so but these, and of parameters.

    Attributes:
        inactive: keys of the nodes that are kept inactive in it.
        parameters: values that are other ones in it; all others are as they are given.
    """

    name: str
    inactive: tuple[str, ...] = ()
    parameters: tuple[ModeParameter, ...] = ()
    at: Position


class SystemDeclaration(msgspec.Struct, frozen=True, kw_only=True):
    """What a manifest declares of its system that the plan takes over as it is.

    Attributes:
        on_violation: what is done about violations for which nothing nearer says it.
        modes: the first is entered at the start; none: every node is as it is declared.
        unproven: warnings about what is declared and not proven, or in force for nothing.
        positions: where sections and their values are, by path, `discovery`, `discovery.mode`.
    """

    system: str
    unproven: tuple[Diagnostic, ...] = ()
    machines: tuple[Machine, ...] = ()
    discovery: Discovery = Discovery()
    network: Network = Network()
    data_layer: DataLayer = DataLayer()
    policy: Policy = Policy()
    on_violation: OnViolation = ()
    modes: tuple[Mode, ...] = ()
    positions: Mapping[str, Position] = msgspec.field(default_factory=dict)

    def address_of(self, machine: str) -> str:
        """Return the address of a machine; empty if it has none, or is not declared."""
        return next((each.address for each in self.machines if each.name == machine), "")


class Manifest(SystemDeclaration, frozen=True, kw_only=True):
    """One system, valid on its own; the input of `lifecycle.plan`.

    Attributes:
        path: the file it was read from, as the user wrote it.
        arguments: resolved values by name.
        left_out: keys of the nodes that `if:` or `unless:` leaves out, as far as they are known;
            one that ends in `/` is the prefix of a group or include.
    """

    path: str
    description: str = ""
    arguments: tuple[tuple[str, str], ...] = ()
    nodes: tuple[Node, ...] = ()
    links: tuple[Link, ...] = ()
    left_out: tuple[str, ...] = ()

    def where(self, path: str) -> Position:
        """Return the position of a value, else of its section; the file's start without either."""
        start = Position(file=self.path, line=1, column=1)
        section = self.positions.get(path.partition(".")[0], start)
        return self.positions.get(path, section)
