"""Test data made by hand: what a manifest declares, what is planned of it, what a node reports.

Owns: `node` and its parts, `manifest` and `planned` (what the planner makes of it); `planned_node`,
`planned_endpoint` and `plan_of`, for tests of what runs plans, without the planner; `configuration`
and `reported`, what a node says of itself. Needs neither YAML nor ROS.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from msgspec.structs import replace

from lifecycle.manifest.diagnostics import Position
from lifecycle.manifest.model import (
    After,
    Condition,
    Discovery,
    DiscoveryRange,
    Endpoint,
    EndpointKind,
    EndpointPolicy,
    FlowNeed,
    Interface,
    Link,
    Machine,
    Manifest,
    Node,
    Policy,
    Readiness,
    Run,
    RunKind,
    Supervision,
    Timeouts,
    UniqueHow,
)
from lifecycle.manifest.qos import QosProfile, Reliability
from lifecycle.network.nfe import (
    InternetProtocol,
    NetworkFlowEndpoint,
    TransportProtocol,
    UniqueRequirement,
)
from lifecycle.plan.build import build_plan
from lifecycle.plan.model import Plan, PlannedEndpoint, PlannedNode, PlannedProcess
from lifecycle.verify.observation import EndpointReport, Identity, NodeConfiguration

FILE = "robot.lifecycle.yaml"
IMAGE = "sensor_msgs/msg/CompressedImage"
STRING = "std_msgs/msg/String"
BEST_EFFORT = QosProfile(depth=1, reliability=Reliability.BEST_EFFORT)
HERE = Position(file=FILE, line=1, column=1)
_TOPICS = (EndpointKind.PUBLISHER, EndpointKind.SUBSCRIPTION)


def at(line: int, column: int = 1) -> Position:
    """A position in the sample file."""
    return Position(file=FILE, line=line, column=column)


def endpoint(
    kind: EndpointKind,
    name: str,
    type_: str = STRING,
    qos: QosProfile | None = QosProfile(),  # noqa: B008 - frozen
    line: int = 10,
) -> Endpoint:
    """One declared endpoint."""
    return Endpoint(kind=kind, name=name, type=type_, qos=qos, at=at(line, 9))


def publisher(name: str, type_: str = STRING, **rest: object) -> Endpoint:
    """One declared publisher."""
    return endpoint(EndpointKind.PUBLISHER, name, type_, **rest)


def subscription(name: str, type_: str = STRING, **rest: object) -> Endpoint:
    """One declared subscription."""
    return endpoint(EndpointKind.SUBSCRIPTION, name, type_, **rest)


def need(
    kind: EndpointKind,
    name: str,
    unique: UniqueRequirement = UniqueRequirement.NOT_REQUIRED,
    **rest: object,
) -> FlowNeed:
    """One flow need."""
    return FlowNeed(kind=kind, name=name, unique=unique, at=at(20), **rest)


def node(
    key: str,
    *endpoints: Endpoint,
    needs: Iterable[FlowNeed] = (),
    after: Iterable[tuple[str, Condition]] = (),
    run: Run = Run(kind=RunKind.PYTHON, python="robot:Node"),  # noqa: B008 - frozen
    namespace: str = "/",
    machine: str = "",
    **rest: object,
) -> Node:
    """One node; python by default."""
    return Node(
        key=key,
        name=str(rest.pop("name", key)),
        namespace=namespace,
        machine=machine,
        run=run,
        interface=Interface(endpoints=endpoints),
        flows=tuple(needs),
        after=tuple(After(node=other, condition=when, at=at(30, 5)) for other, when in after),
        at=at(3, 3),
        **rest,
    )


def link(topic: str, from_node: str, to_node: str, **rest: object) -> Link:
    """One link."""
    return Link(topic=topic, from_node=from_node, to_node=to_node, at=at(40), **rest)


def manifest(*nodes: Node, links: Iterable[Link] = (), **rest: object) -> Manifest:
    """One system."""
    return Manifest(path=FILE, system="robot", nodes=nodes, links=tuple(links), **rest)


def planned(*nodes: Node, links: Iterable[Link] = (), **rest: object) -> Plan:
    """The plan of these nodes in an empty environment."""
    return build_plan(manifest(*nodes, links=links, **rest), environment={})


def teleop() -> Manifest:
    """The article's example, a battery beside it, a service and an action."""
    strictly = UniqueRequirement.STRICTLY_REQUIRED
    machines = (
        Machine(name="robot", address="10.77.0.1", at=at(2)),
        Machine(name="operator", address="10.77.0.2", at=at(2)),
    )
    camera = node(
        "camera",
        publisher("video", IMAGE, qos=BEST_EFFORT, line=11),
        publisher("battery", "sensor_msgs/msg/BatteryState", line=12),
        publisher("status", line=13),
        endpoint(EndpointKind.SERVICE_SERVER, "~/calibrate", "std_srvs/srv/Trigger", line=14),
        endpoint(EndpointKind.ACTION_SERVER, "dock", "robot/action/Dock", None, line=15),
        needs=(
            need(EndpointKind.PUBLISHER, "video", strictly, dscp=46, five_qi=85),
            need(EndpointKind.PUBLISHER, "battery", dscp=8),
        ),
        namespace="/robot",
        machine="robot",
    )
    viewer = node(
        "viewer",
        subscription("/robot/video", IMAGE, qos=BEST_EFFORT, line=16),
        subscription("/robot/battery", "sensor_msgs/msg/BatteryState", line=17),
        subscription("/robot/status", line=18),
        endpoint(
            EndpointKind.SERVICE_CLIENT, "/robot/camera/calibrate", "std_srvs/srv/Trigger", line=19
        ),
        endpoint(EndpointKind.ACTION_CLIENT, "/robot/dock", "robot/action/Dock", None, line=20),
        needs=(need(EndpointKind.SUBSCRIPTION, "/robot/video", strictly),),
        after=(("camera", Condition.CONFIGURED),),
        machine="operator",
    )
    return replace(
        manifest(
            camera,
            viewer,
            links=(
                link(
                    "/robot/video", "camera", "viewer", unique=UniqueHow.STRONGLY, max_delay_ms=5.0
                ),
            ),
        ),
        machines=machines,
        discovery=Discovery(domain_id=7),
    )


def planned_endpoint(
    kind: EndpointKind, name: str, type_: str = STRING, **changes: object
) -> PlannedEndpoint:
    """One endpoint as it must exist, in the root namespace; topics have the default QoS."""
    qos = QosProfile() if kind in _TOPICS else None
    values = {"qos": qos, "resolved": f"/{name.lstrip('/')}", "at": HERE, **changes}
    return PlannedEndpoint(kind=kind, name=name, type=type_, **values)


def planned_node(
    key: str,
    *,
    after: Mapping[str, Condition | Readiness] = {},
    process: str = "",
    kind: RunKind = RunKind.PYTHON,
    managed: bool = True,
    timeouts: Timeouts = Timeouts(),  # noqa: B008 - frozen
    supervision: Supervision = Supervision(),  # noqa: B008 - frozen
) -> PlannedNode:
    """One node without endpoints, in the root namespace; python by default."""
    return PlannedNode(
        key=key,
        name=key,
        namespace="/",
        machine="",
        process=process or key,
        managed=managed,
        run=Run(kind=kind, python="m:C"),
        endpoints=(),
        declared_parameters=(),
        parameters=(),
        parameter_files=(),
        remap=(),
        participants=(),
        after=tuple(After(node=other, condition=when, at=HERE) for other, when in after.items()),
        timeouts=timeouts,
        supervision=supervision,
        endpoint_policy=EndpointPolicy.DECLARED,
        log_level="",
        at=HERE,
    )


def plan_of(*nodes: PlannedNode, domain_id: int = 30) -> Plan:
    """A plan of these nodes, one process each unless they name one."""
    processes: dict[str, list[PlannedNode]] = {}
    for each in nodes:
        processes.setdefault(each.process, []).append(each)
    return Plan(
        system="robot",
        manifest_path=FILE,
        domain_id=domain_id,
        discovery_range=DiscoveryRange.LOCALHOST,
        policy=Policy(),
        machines=(),
        processes=tuple(
            PlannedProcess(
                name=name, machine="", run=group[0].run, nodes=tuple(each.key for each in group)
            )
            for name, group in processes.items()
        ),
        nodes=nodes,
        flows=(),
        levels=(),
    )


def reported(kind: EndpointKind, name: str, type_: str = STRING, **rest: object) -> EndpointReport:
    """What a node says of one endpoint in the root namespace, mapped nowhere."""
    resolved = str(rest.pop("resolved", f"/{name}"))
    return EndpointReport(kind=kind, name=name, resolved=resolved, type=type_, **rest)


def configuration(
    name: str, *endpoints: EndpointReport, process_id: int = 1, **changes: object
) -> NodeConfiguration:
    """What a connected node on machine "m" says of itself."""
    made = NodeConfiguration(
        identity=Identity(machine_id="m", process_id=process_id, node_id=f"{name}@{process_id}"),
        name=name,
        state="inactive",
        connected=True,
        rmw="rmw_fastrtps_cpp",
        transports=("udpv4",),
        serializations=("cdr",),
        paradigms=("publish-subscribe",),
        endpoints=endpoints,
    )
    return replace(made, **changes)


def nfe(
    address: str,
    port: int,
    transport: TransportProtocol = TransportProtocol.UDP,
    **rest: int,
) -> NetworkFlowEndpoint:
    """A network flow endpoint of the address's family."""
    return NetworkFlowEndpoint(
        transport_protocol=transport,
        internet_protocol=InternetProtocol.IPV6 if ":" in address else InternetProtocol.IPV4,
        transport_port=port,
        internet_address=address,
        **rest,
    )


def shared_memory(port: int = 0) -> NetworkFlowEndpoint:
    """What an endpoint lists for shared memory."""
    return NetworkFlowEndpoint(
        transport_protocol=TransportProtocol.UNKNOWN,
        internet_protocol=InternetProtocol.UNKNOWN,
        transport_port=port,
    )
