"""What a plan asks of participants that they cannot do is refused before anything runs."""

from __future__ import annotations

import pytest

from lifecycle.manifest.diagnostics import ManifestError
from lifecycle.manifest.model import (
    Discovery,
    DiscoveryMode,
    DiscoveryRange,
    EndpointKind,
    FlowTransport,
    Manifest,
    Run,
    RunKind,
)
from lifecycle.network.nfe import UniqueRequirement
from lifecycle.plan.build import build_plan, check_plan
from tests.builders import manifest, need, node, planned, publisher, subscription

TRIGGER = "std_srvs/srv/Trigger"
STRICTLY = UniqueRequirement.STRICTLY_REQUIRED


def said(system: Manifest) -> list[str]:
    """What `check` says of a system's plan."""
    return [str(each) for each in check_plan(system, environment={})]


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
    with pytest.raises(ManifestError) as raised:
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
