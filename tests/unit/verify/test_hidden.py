"""Whose a hidden node is: by the plan, by a report, and else by its name."""

from __future__ import annotations

import pytest

from lifecycle.verify.hidden import Owners, is_hidden_node
from tests.unit.plan.samples import node, planned, publisher

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


@pytest.mark.parametrize(
    ("name", "hidden"), [("/robot/_camera_data", True), ("/robot/camera", False), ("/_x/y", False)]
)
def test_a_node_is_hidden_by_the_underscore_of_its_own_name(name: str, hidden: bool) -> None:
    assert is_hidden_node(name) is hidden
