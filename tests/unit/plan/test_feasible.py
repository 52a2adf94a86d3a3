"""What a plan asks of participants that they cannot do is refused before anything runs."""

from __future__ import annotations

import pytest

from lifecycle.manifest.model import (
    Authority,
    ConnectionDeclaration,
    DataLayer,
    DataLayerSource,
    Discovery,
    DiscoveryMode,
    DiscoveryRange,
    EndpointKind,
    FlowTransport,
    Manifest,
    Node,
    Run,
    RunKind,
)
from lifecycle.network.connection_url import parse
from lifecycle.network.nfe import UniqueRequirement
from lifecycle.plan.build import build_plan, check_plan
from lifecycle.plan.model import PlanError
from tests.builders import at, endpoint, manifest, need, node, planned, publisher, subscription

TRIGGER = "std_srvs/srv/Trigger"
STRICTLY = UniqueRequirement.STRICTLY_REQUIRED


def said(system: Manifest) -> list[str]:
    """What `check` says of a system's plan."""
    return [str(each) for each in check_plan(system, environment={})]


def connection(url: str, kind: EndpointKind, name: str) -> ConnectionDeclaration:
    """One declared connection that carries one endpoint."""
    return ConnectionDeclaration(name="net", urls=(parse(url),), map=((kind, name),), at=at(25))


def caller_and_called(*urls: str, kinds: tuple[EndpointKind, EndpointKind]) -> list[Node]:
    """A client and a server, each on a connection where a URL is given."""
    return [
        node(
            name,
            endpoint(kind, "/reset", TRIGGER),
            connections=(connection(url, kind, "/reset"),) if url else (),
        )
        for name, kind, url in zip(("caller", "called"), kinds, urls, strict=True)
    ]


SERVICE = (EndpointKind.SERVICE_CLIENT, EndpointKind.SERVICE_SERVER)
ACTION = (EndpointKind.ACTION_CLIENT, EndpointKind.ACTION_SERVER)
IN_MEMORY = Discovery(mode=DiscoveryMode.STATIC, transport=FlowTransport.SHM)


@pytest.mark.parametrize(("kinds", "word"), [(SERVICE, "service"), (ACTION, "action")])
def test_both_ends_of_a_service_or_an_action_need_a_transport_in_common(
    kinds: tuple[EndpointKind, EndpointKind], word: str
):
    nodes = caller_and_called("", "udpv4://127.0.0.1:9001?multicast=off", kinds=kinds)
    assert said(manifest(*nodes, discovery=IN_MEMORY)) == [
        (
            f"robot.lifecycle.yaml:10:9: cannot call {word} '/reset' of 'called' from 'caller': "
            "the client's participant has shm, the server's udpv4, and they are on one host; map "
            "both ends onto connections that have a transport in common"
        )
    ]


@pytest.mark.parametrize(
    "urls",
    [
        ("", ""),
        ("shm://", ""),
        ("udpv4://127.0.0.1:9001?multicast=off", "udpv4://127.0.0.1:9004?multicast=off"),
    ],
)
def test_ends_that_have_one_are_fine(urls: tuple[str, str]):
    nodes = caller_and_called(*urls, kinds=SERVICE)
    assert said(manifest(*nodes, discovery=IN_MEMORY)) == []


def _needy(enforce: bool = True) -> list[Node]:
    return [
        node(
            "camera",
            publisher("video"),
            needs=[need(EndpointKind.PUBLISHER, "video", dscp=46, enforce=enforce)],
        ),
        node(
            "viewer",
            subscription("video"),
            needs=[need(EndpointKind.SUBSCRIPTION, "video", STRICTLY)],
        ),
    ]


@pytest.mark.parametrize(
    ("discovery", "has"),
    [(Discovery(mode=DiscoveryMode.SERVER), "tcpv4"), (IN_MEMORY, "shm")],
)
def test_marks_and_ports_of_ones_own_need_udp(discovery: Discovery, has: str):
    mark = (
        "robot.lifecycle.yaml:10:9: cannot mark publisher 'video' of 'camera' EF = DSCP 46 = TOS "
        f"184 (0xb8): its participant has {has}, and only UDP sockets can be marked; use "
        "'transport: udpv4', or remove the mark"
    )
    port = (
        "robot.lifecycle.yaml:10:9: cannot give subscription 'video' of 'viewer' a port of its "
        f"own: its participant has {has}, and only UDP has one port for each subscription; use "
        "'transport: udpv4', or remove 'unique'"
    )
    assert said(manifest(*_needy(), discovery=discovery)) == [mark, port]
    assert said(manifest(*_needy(enforce=False), discovery=discovery)) == [port]


def test_what_is_negotiated_while_the_system_runs_is_not_judged_before():
    layer = DataLayer(authority=Authority.SUPERVISOR, source=DataLayerSource.DYNAMIC)
    assert said(manifest(*_needy(), discovery=IN_MEMORY, data_layer=layer)) == []


def test_every_pair_that_cannot_be_connected_is_said_at_its_publisher():
    by = {"FASTDDS_BUILTIN_TRANSPORTS": "UDPv6"}
    foreign = Run(kind=RunKind.COMMAND, command=("viewer",), environment=by)
    system = manifest(
        node(
            "camera",
            publisher("video", line=11),
            publisher("audio", line=12),
            needs=[
                need(EndpointKind.PUBLISHER, name, transport=FlowTransport.SHM)
                for name in ("video", "audio")
            ],
        ),
        node("viewer", subscription("video"), subscription("audio"), run=foreign),
    )
    tail = "'camera' can be connected by shm, udpv4, udpv6, udpm, tcpv4; 'viewer' by udpv6"
    lines = [
        f"robot.lifecycle.yaml:{line}:9: cannot carry '/{topic}' from 'camera' to 'viewer' by "
        f"shm, as the publisher asks for it: {tail}"
        for line, topic in ((12, "audio"), (11, "video"))
    ]
    assert said(system) == lines
    with pytest.raises(PlanError) as raised:
        build_plan(system, environment={})
    assert [str(each) for each in raised.value.diagnostics] == lines


def test_static_ports_by_ipv6_are_on_its_loopback_where_no_host_has_an_address():
    plan = planned(
        node("talker", publisher("t")),
        node("listener", subscription("t")),
        discovery=Discovery(
            mode=DiscoveryMode.STATIC, transport=FlowTransport.UDPV6, first_port=8000
        ),
    )
    assert plan.nodes[0].connections.urls == (
        (
            "udpv6://[::1]:8005?metatraffic_port=8004&output_port=8006&peer=[::1]:8000"
            "&peer=[::1]:8007&multicast=off"
        ),
    )


def test_a_flow_of_its_own_is_a_connection_where_endpoints_are_static():
    plan = planned(
        node("camera", publisher("video"), needs=[need(EndpointKind.PUBLISHER, "video", STRICTLY)]),
        node("viewer", subscription("video")),
        discovery=Discovery(mode=DiscoveryMode.STATIC_ENDPOINTS, first_port=8000),
    )
    (own,) = plan.nodes[0].participants
    assert own.name == "_camera_flow_0"
    assert own.connection == "flow_0"
    assert own.connections.urls == (
        (
            "udpv4://127.0.0.1:8005?metatraffic_port=8004&output_port=8006&peer=127.0.0.1:8007"
            "&multicast=off"
        ),
    )
    assert [each.medium for each in plan.flows] == ["udpv4"]


def test_a_command_with_shared_memory_alone_looks_further_than_loopback():
    """rmw_fastrtps_cpp 8.4 looks for peers at 127.0.0.1, and shared memory stays here anyway."""
    plan = planned(
        node("talker", publisher("t")),
        node("listener", subscription("t"), run=Run(kind=RunKind.COMMAND, command=("hear",))),
        discovery=Discovery(range=DiscoveryRange.LOCALHOST, transport=FlowTransport.SHM),
    )
    reach = {
        each.name: dict(each.environment)["ROS_AUTOMATIC_DISCOVERY_RANGE"]
        for each in plan.processes
    }
    assert reach == {"talker": "LOCALHOST", "listener": "SYSTEM_DEFAULT"}
