"""Who is matched with whom, by GUID and not by number."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from std_msgs.msg import String

from lifecycle.middleware import guid_of, matched_with

pytestmark = pytest.mark.ros

MakeNode = Callable[..., Node]
WaitUntil = Callable[..., Any]


@pytest.mark.parametrize("reliability", [ReliabilityPolicy.RELIABLE, ReliabilityPolicy.BEST_EFFORT])
def test_an_endpoint_names_those_that_it_is_matched_with_and_nobody_else(
    make_node: MakeNode, wait_until: WaitUntil, reliability: ReliabilityPolicy
) -> None:
    qos = QoSProfile(depth=1, reliability=reliability)
    here, there = make_node("here"), make_node("there")
    publisher = here.create_publisher(String, "/a", qos)
    first = there.create_subscription(String, "/a", lambda _: None, qos)
    second = there.create_subscription(String, "/a", lambda _: None, qos)
    other = there.create_subscription(String, "/b", lambda _: None, qos)
    everybody = [guid_of(each) for each in (first, second, other)]
    assert len({guid_of(publisher), *everybody}) == 4

    wait_until(lambda: matched_with(publisher, everybody) == tuple(sorted(everybody[:2])))
    wait_until(lambda: matched_with(second, [guid_of(publisher)]) == (guid_of(publisher),))
    assert matched_with(other, [guid_of(publisher)]) == ()

    there.destroy_subscription(first)
    wait_until(lambda: matched_with(publisher, everybody) == (everybody[1],))


def test_a_guid_is_that_which_the_graph_shows(make_node: MakeNode) -> None:
    node = make_node("here")
    made = [node.create_publisher(String, "/a", 1) for _ in range(2)]
    shown = {bytes(each.endpoint_gid).hex() for each in node.get_publishers_info_by_topic("/a")}
    assert {guid_of(each) for each in made} == shown


def test_asking_often_leaves_a_subscription_that_can_be_destroyed(
    make_node: MakeNode, wait_until: WaitUntil
) -> None:
    """Each question borrows a reference of the reader, and gives it back."""
    node, there = make_node("here"), make_node("there")
    publisher = there.create_publisher(String, "/a", 1)
    for _ in range(20):
        subscription = node.create_subscription(String, "/a", lambda _: None, 1)
        wait_until(lambda: matched_with(subscription, [guid_of(publisher)]))  # noqa: B023
        for _ in range(50):
            assert matched_with(subscription, [guid_of(publisher)]) == (guid_of(publisher),)
        assert node.destroy_subscription(subscription)
    wait_until(lambda: publisher.get_subscription_count() == 0)
