"""Whose a hidden node is: by the plan, by a report, and else by its name."""

from __future__ import annotations

import dataclasses

import pytest

from lifecycle.plan.model import PlannedParticipant
from lifecycle.verify.observation import NodeConfiguration
from lifecycle.verify.outcome import ConnectionReport
from lifecycle.verify.tool_filter import Owners, is_hidden_node
from tests.builders import configuration, node, planned, publisher

PLAN = planned(
    node("camera", publisher("video"), namespace="/robot"),
    node("camera_net", publisher("audio"), namespace="/robot"),
)


@pytest.mark.parametrize(
    ("hidden", "owner"),
    [
        ("/robot/_camera_data", "/robot/camera"),
        ("/robot/_camera_flow_0", "/robot/camera"),
        ("/robot/_camera_net", "/robot/camera"),
        ("/robot/_camera_net_udpv4", "/robot/camera_net"),
        ("/_camera_data", ""),
        ("/robot/_other_data", ""),
        ("/robot/camera_data", ""),
        ("/robot/_camera", ""),
    ],
)
def test_a_connection_that_no_report_has_told_of_yet_is_known_by_its_name(
    hidden: str, owner: str
) -> None:
    assert Owners(PLAN.nodes, ()).of(hidden) == owner


def says(name: str, *hidden: str) -> NodeConfiguration:
    """The report of a node with connections on these hidden nodes."""
    connections = tuple(ConnectionReport(name="net", node_name=each) for each in hidden)
    return configuration(name, state="active", connections=connections)


def test_a_hidden_node_is_whose_report_names_it_whatever_it_is_called() -> None:
    owners = Owners(
        PLAN.nodes, [says("/other", "mine"), says("/robot/camera", "", "_camera_net_x", "net")]
    )
    assert owners.of("/robot/net") == "/robot/camera"
    assert owners.of("/robot/_camera_net_x") == "/robot/camera"
    assert owners.of("/robot/_camera_net_y") == "/robot/camera_net"
    assert [owners.of(each) for each in ("/net", "/mine", "/robot/mine", "/robot/")] == [""] * 4


def test_a_hidden_node_is_whose_plan_names_it_whatever_it_is_called() -> None:
    (camera, net) = PLAN.nodes
    carried = dataclasses.replace(
        camera, participants=(PlannedParticipant(name="_camera_net_1", dscp=None, reason=""),)
    )
    assert Owners([carried, net], ()).of("/robot/_camera_net_1") == "/robot/camera"
    assert Owners([net, carried], ()).of("/robot/_camera_net_1") == "/robot/camera"
    assert Owners([camera, net], ()).of("/robot/_camera_net_1") == "/robot/camera_net"


def test_a_hidden_node_of_a_flow_is_that_of_the_node_it_is_named_after() -> None:
    plan = planned(node("camera", publisher("a")), node("camera_flow", publisher("b")))
    assert Owners(plan.nodes, ()).of("/_camera_flow_0") == "/camera"
    assert Owners(plan.nodes, ()).of("/_camera_flow_x") == "/camera_flow"
    assert Owners(plan.nodes[1:], ()).of("/_camera_flow_0") == "/camera_flow"


@pytest.mark.parametrize(
    ("tolerated", "owner"),
    [
        (("_camera_*",), ""),
        (("/robot/_camera_*",), ""),
        (("/other/_camera_*",), "/robot/camera"),
        (("*",), "/robot/camera"),
        (("/_far/*", "*_data"), "/robot/camera"),
        (("*", "_camera_d*"), ""),
        ((), "/robot/camera"),
    ],
)
def test_a_pattern_of_hidden_tools_takes_precedence_over_a_likeness(
    tolerated: tuple[str, ...], owner: str
) -> None:
    assert Owners(PLAN.nodes, (), tolerated).of("/robot/_camera_data") == owner


def test_a_node_of_the_ros2_command_is_nobodys_although_a_node_is_called_so() -> None:
    plan = planned(node("ros2cli", publisher("a")))
    assert Owners(plan.nodes, ()).of("/_ros2cli_4711") == ""


@pytest.mark.parametrize(
    ("name", "hidden"), [("/robot/_camera_data", True), ("/robot/camera", False), ("/_x/y", False)]
)
def test_a_node_is_hidden_by_the_underscore_of_its_own_name(name: str, hidden: bool) -> None:
    assert is_hidden_node(name) is hidden


@pytest.mark.parametrize(
    ("names", "hidden", "owner"),
    [
        (("a",), "/_a_net", "/a"),
        (("camera",), "/_camera_net_low_1", "/camera"),
        (("a",), "/_a_net_low_1", "/a"),
        (("a", "a_b"), "/_a_b_net_low_1", "/a_b"),
        (("b",), "/_a_net", ""),
    ],
)
def test_of_the_nodes_whose_names_it_begins_with_the_longest_owns_it(
    names: tuple[str, ...], hidden: str, owner: str
) -> None:
    nodes = planned(*(node(name, publisher("data")) for name in names)).nodes
    assert Owners(nodes, ()).of(hidden) == owner
