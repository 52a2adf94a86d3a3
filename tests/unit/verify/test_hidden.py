"""Whose a hidden node is: its owner's report says so, on which participant; a name says nothing."""

from __future__ import annotations

import dataclasses

import pytest

from lifecycle.manifest.model import EndpointKind
from lifecycle.verify.observation import NodeConfiguration, ObservedEndpoint
from lifecycle.verify.outcome import ConnectionReport
from lifecycle.verify.tool_filter import is_hidden_node, owners
from tests.builders import configuration

OURS, THEIRS = "01" * 12, "02" * 12
NAMES = ("/robot/camera", "/robot/camera_net")


def says(name: str, *hidden: str, prefix: str = OURS) -> NodeConfiguration:
    """The report of a node with connections on these hidden nodes."""
    connections = tuple(
        ConnectionReport(name="net", node_name=each, prefix=prefix) for each in hidden
    )
    return configuration(name, state="active", connections=connections)


def test_a_hidden_node_is_whose_report_names_it_whatever_it_is_called() -> None:
    found = owners(
        NAMES, [says("/other", "mine"), says("/robot/camera", "", "_camera_net_x", "net")]
    )
    assert {name: each.node for name, each in found.items()} == {
        "/robot/net": "/robot/camera",
        "/robot/_camera_net_x": "/robot/camera",
    }


def test_without_a_report_no_name_has_an_owner() -> None:
    assert owners(NAMES, ()) == {}
    assert owners(NAMES, [says("/robot/camera")]) == {}


def test_an_endpoint_is_the_owners_on_a_participant_that_it_reports() -> None:
    (owner,) = owners(NAMES, [says("/robot/camera", "_camera_net")]).values()
    seen = ObservedEndpoint(
        kind=EndpointKind.SERVICE_SERVER, node="/robot/_camera_net", name="/a", type="a/srv/B"
    )
    assert owner.has(seen)
    assert owner.has(dataclasses.replace(seen, gid=OURS + "00001204"))
    assert not owner.has(dataclasses.replace(seen, gid=THEIRS + "00001204"))


@pytest.mark.parametrize(
    ("name", "hidden"), [("/robot/_camera_data", True), ("/robot/camera", False), ("/_x/y", False)]
)
def test_a_node_is_hidden_by_the_underscore_of_its_own_name(name: str, hidden: bool) -> None:
    assert is_hidden_node(name) is hidden
