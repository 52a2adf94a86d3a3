"""What each discovery mode gives to own participants, observers and connections."""

from __future__ import annotations

import pytest

from lifecycle.manifest.diagnostics import ManifestError
from lifecycle.manifest.model import (
    Authority,
    DataLayer,
    DataLayerSource,
    Discovery,
    DiscoveryMode,
    DiscoveryRange,
    FlowTransport,
    Link,
    Machine,
    Run,
    RunKind,
)
from lifecycle.plan.build import build_plan
from lifecycle.plan.media import terms_of
from lifecycle.plan.model import Plan
from tests.builders import at, link, manifest, node, planned, publisher, subscription

TWO = (
    Machine(name="robot", address="10.77.0.1", at=at(2)),
    Machine(name="operator", address="10.77.0.2", at=at(2)),
)


def system(mode: DiscoveryMode, transport: FlowTransport = FlowTransport.ANY) -> Plan:
    """A publisher, and two subscribing nodes that share a process on another host."""
    return planned(
        node("talker", publisher("t"), machine="robot"),
        node("one", subscription("t"), machine="operator", process="both"),
        node("two", subscription("t"), machine="operator", process="both"),
        machines=TWO,
        discovery=Discovery(mode=mode, transport=transport, first_port=8000),
    )


def own(plan: Plan) -> dict[str, tuple[str, ...]]:
    """URLs of own participants and observers."""
    urls = {each.key: each.connections.urls for each in plan.nodes}
    return urls | {f"observer {machine}": each.urls for machine, each in plan.observers}


def test_static_gives_each_process_ports_of_its_machine_and_everybody_else_as_peer():
    plan = system(DiscoveryMode.STATIC)
    robot, operator = "udpv4://10.77.0.1", "udpv4://10.77.0.2"
    both = (
        f"{operator}:8005?metatraffic_port=8004&output_port=8006"
        "&peer=10.77.0.1:8000&peer=10.77.0.1:8004&peer=10.77.0.2:8000&multicast=off"
    )
    assert own(plan) == {
        "talker": (
            (
                f"{robot}:8005?metatraffic_port=8004&output_port=8006&peer=10.77.0.1:8000"
                "&peer=10.77.0.2:8000&peer=10.77.0.2:8004&multicast=off"
            ),
        ),
        "one": (both,),
        "two": (both,),
        "observer robot": (
            (
                f"{robot}:8001?metatraffic_port=8000&output_port=8002&peer=10.77.0.1:8004"
                "&peer=10.77.0.2:8000&peer=10.77.0.2:8004&multicast=off"
            ),
        ),
        "observer operator": (
            (
                f"{operator}:8001?metatraffic_port=8000&output_port=8002&peer=10.77.0.1:8000"
                "&peer=10.77.0.1:8004&peer=10.77.0.2:8004&multicast=off"
            ),
        ),
    }
    assert {each.medium for each in plan.flows} == {"udpv4"}
    assert not any(each.participants for each in plan.nodes)


def test_static_over_tcp_gives_each_process_one_listening_port():
    plan = system(DiscoveryMode.STATIC, FlowTransport.TCPV4)
    assert plan.nodes[0].connections.urls == (
        "tcpv4://10.77.0.1:8004?peer=10.77.0.1:8003&peer=10.77.0.2:8003",
    )
    assert {each.medium for each in plan.flows} == {"tcpv4"}


def test_a_server_is_all_that_clients_know_and_observers_are_told_everything():
    plan = system(DiscoveryMode.SERVER)
    assert plan.server is not None
    assert (plan.server.machine, plan.server.address, plan.server.port) == (
        "robot",
        "10.77.0.1",
        8000,
    )
    assert plan.nodes[1].connections.urls == ("tcpv4://10.77.0.2:8004?server=10.77.0.1:8000",)
    assert {each.super_client for _, each in plan.observers} == {True}
    assert not any(each.connections.super_client for each in plan.nodes)


def test_shared_memory_alone_leaves_no_socket_to_own_participants():
    plan = planned(
        node("talker", publisher("t")),
        node("listener", subscription("t")),
        links=[link("/t", "talker", "listener", transport=FlowTransport.UDPV4)],
        discovery=Discovery(transport=FlowTransport.SHM),
    )
    assert {each.connections.urls for each in plan.nodes} == {("shm://",)}
    assert [each.participants[0].connections.urls for each in plan.nodes] == [("udpv4://",)] * 2
    assert plan.observers == (("", plan.observers[0][1]),)
    assert plan.observers[0][1].urls == ("shm://", "udpv4://")


def test_static_endpoints_tabulate_everybody_for_everybody():
    plan = system(DiscoveryMode.STATIC_ENDPOINTS)
    tables = {each.participants[0].connections.static_participants for each in plan.nodes}
    (table,) = tables
    assert [each.participants[0].connections.static_name for each in plan.nodes] == [
        "/talker_data",
        "/one_data",
        "/two_data",
    ]
    assert next(
        (each.name, [(line.writer, line.topic, line.type, line.user_id) for line in each.endpoints])
        for each in table
    ) == (
        "/talker_data",
        [
            (True, "rt/t", "std_msgs::msg::dds_::String_", 1),
            (
                True,
                "ros_discovery_info",
                "rmw_dds_common::msg::dds_::ParticipantEntitiesInfo_",
                2,
            ),
            (
                False,
                "ros_discovery_info",
                "rmw_dds_common::msg::dds_::ParticipantEntitiesInfo_",
                3,
            ),
        ],
    )
    ids = [line.user_id for each in table for line in each.endpoints]
    assert ids == list(range(1, 10))
    assert {endpoint.participant for each in plan.nodes for endpoint in each.endpoints} == {
        "_talker_data",
        "_one_data",
        "_two_data",
    }


@pytest.mark.parametrize("mode", [each for each in DiscoveryMode if each.value != "dynamic"])
def test_rmw_adds_nothing_to_what_is_planned(mode: DiscoveryMode):
    plan = build_plan(
        manifest(node("n"), discovery=Discovery(mode=mode)),
        environment={"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"},
    )
    assert plan.discovery_range is DiscoveryRange.SYSTEM_DEFAULT
    assert dict(plan.processes[0].environment)["ROS_AUTOMATIC_DISCOVERY_RANGE"] == "SYSTEM_DEFAULT"


def test_a_command_is_told_of_the_server_by_variables():
    plan = planned(
        node("n", run=Run(kind=RunKind.COMMAND, command=("n",))),
        discovery=Discovery(mode=DiscoveryMode.SERVER),
    )
    environment = dict(plan.processes[0].environment)
    assert environment["ROS_DISCOVERY_SERVER"] == "TCPv4:[127.0.0.1]:7910"
    assert environment["FASTDDS_BUILTIN_TRANSPORTS"] == "NONE"


def test_what_node_configurations_decide_is_left_open():
    plan = planned(
        node("talker", publisher("t")),
        node("listener", subscription("t")),
        links=[link("/t", "talker", "listener", transport=FlowTransport.UDPV4)],
        data_layer=DataLayer(authority=Authority.SUPERVISOR, source=DataLayerSource.DYNAMIC),
    )
    assert [each.medium for each in plan.flows] == [""]
    assert not any(each.participants for each in plan.nodes)
    assert plan.flows[0].transport is FlowTransport.UDPV4
    assert not terms_of(plan).fixed


def test_a_pair_that_cannot_be_connected_is_refused_where_its_link_stands():
    foreign = Run(kind=RunKind.COMMAND, command=("n",))
    wish: Link = link("/t", "talker", "listener", transport=FlowTransport.TCPV4)
    with pytest.raises(ManifestError) as error:
        planned(
            node("talker", publisher("t"), run=foreign),
            node("listener", subscription("t")),
            links=[wish],
        )
    (found,) = error.value.diagnostics
    assert found.at == wish.at
    assert found.message == (
        "cannot carry '/t' from 'talker' to 'listener' by tcpv4, as a link says so: 'talker' can "
        "be connected by shm, udpv4; 'listener' by shm, udpv4, udpv6, udpm, tcpv4"
    )


def test_nodes_that_may_come_at_any_time_tell_the_graph_so():
    def members(mode: DiscoveryMode, data_layer: DataLayer) -> set[tuple[bool, bool]]:
        plan = planned(
            node("talker", publisher("t")), discovery=Discovery(mode=mode), data_layer=data_layer
        )
        return {(each.membership, each.events) for each in plan.nodes}

    negotiated = DataLayer(authority=Authority.SUPERVISOR, source=DataLayerSource.DYNAMIC)
    assert members(DiscoveryMode.DYNAMIC, DataLayer()) == {(False, False)}
    assert members(DiscoveryMode.DYNAMIC, negotiated) == {(True, False)}
    assert members(DiscoveryMode.STATIC, negotiated) == {(False, False)}
    assert members(DiscoveryMode.STATIC, DataLayer(events=True)) == {(True, True)}
