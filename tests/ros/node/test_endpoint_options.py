"""What rclpy's factories take and its endpoints can do, declared endpoints take and can do."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from planning import client, publisher, server, subscription
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.duration import Duration
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.qos import LivelinessPolicy, QoSProfile
from rclpy.serialization import deserialize_message
from rclpy.service_introspection import ServiceIntrospectionState
from service_msgs.msg import ServiceEventInfo
from std_msgs.msg import Int32, String
from std_srvs.srv import Trigger

from lifecycle import LifecycleNode, on_message, on_service
from lifecycle.errors import LifecycleError
from lifecycle.manifest.qos import Liveliness, QosProfile


class Optioned(LifecycleNode):
    """Has every option of every kind."""

    def __init__(self) -> None:
        super().__init__()
        self.got: list[Any] = []
        self.matched: list[str] = []
        self.slow = MutuallyExclusiveCallbackGroup()

        def noting(what: str) -> Callable[[Any], None]:
            return lambda _: self.matched.append(what)

        self.set_options(
            "out",
            event_callbacks=PublisherEventCallbacks(matched=noting("publisher")),
            callback_group=self.slow,
        )
        self.set_options(
            "in",
            callback_group=self.slow,
            raw=True,
            event_callbacks=SubscriptionEventCallbacks(matched=noting("subscription")),
        )

    def on_configure(self) -> None:
        self.set_options(
            "reset", callback_group=self.slow, introspection=ServiceIntrospectionState.CONTENTS
        )
        self.set_options("ask", introspection=ServiceIntrospectionState.METADATA)

    @on_message("in")
    def receive(self, data: bytes) -> None:
        self.got.append(deserialize_message(data, Int32).data)

    @on_service("reset")
    def reset(self) -> None:
        """Do nothing."""


ENDPOINTS = (
    publisher("out"),
    subscription("in", "std_msgs/msg/Int32"),
    server("reset", "std_srvs/srv/Trigger"),
    client("ask", "std_srvs/srv/Trigger"),
)


@pytest.mark.parametrize("apart", [False, True], ids=["own", "connection"])
def test_options_hold_wherever_an_endpoint_is(
    active: Callable[..., Any],
    make_node: Callable[..., Any],
    driver: Any,
    *,
    apart: bool,
) -> None:
    node = active(Optioned, *ENDPOINTS, to="connect")
    if apart:
        net = node.connect_to("udpv4://", name="net")
        for each in ("publishers/out", "subscriptions/in", "service_servers/reset"):
            moved = node.map_to(each, net)
            driver.spin_until(moved.done)
    driver.set("/it", "activate")
    assert node.subscription("in").callback_group is node.slow
    assert node.service("reset").callback_group is node.slow
    peer = make_node("peer")
    driver.executor.add_node(peer)
    heard: list[ServiceEventInfo] = []
    ears = peer.create_subscription(String, "out", lambda _: None, 10)
    peer.create_subscription(
        Trigger.Event, "reset/_service_event", lambda each: heard.append(each.info), 10
    )
    numbers = peer.create_publisher(Int32, "in", 10)
    asking = peer.create_client(Trigger, "reset")
    driver.spin_until(lambda: node.subscription("in").get_publisher_count() == 1)
    driver.spin_until(lambda: node.publisher("out").get_subscription_count() == 1)
    driver.spin_until(lambda: set(node.matched) == {"publisher", "subscription"})
    driver.spin_until(asking.service_is_ready)
    for number in range(3, 8):
        numbers.publish(Int32(data=number))
    driver.spin_until(lambda: len(node.got) == 5)
    assert node.got == [3, 4, 5, 6, 7]
    asking.call_async(Trigger.Request())
    driver.spin_until(lambda: len(heard) == 2)
    assert [each.event_type for each in heard] == [1, 2]
    assert ears.topic_name == node.publisher("out").topic_name


def test_a_declared_publisher_asserts_its_liveliness(
    active: Callable[..., Any], make_node: Callable[..., Any], driver: Any
) -> None:
    qos = QosProfile(
        depth=1, liveliness=Liveliness.MANUAL_BY_TOPIC, liveliness_lease_duration_ns=200_000_000
    )
    node = active(LifecycleNode, publisher("out", qos=qos))
    out = node.publisher("out")
    assert (out.topic_name, out.wait_for_all_acked()) == ("/out", True)
    alive: list[int] = []
    events = SubscriptionEventCallbacks(liveliness=lambda each: alive.append(each.alive_count))
    wanted = QoSProfile(
        depth=1,
        liveliness=LivelinessPolicy.MANUAL_BY_TOPIC,
        liveliness_lease_duration=Duration(seconds=1),
    )
    peer = make_node("peer")
    driver.executor.add_node(peer)
    peer.create_subscription(String, "out", lambda _: None, wanted, event_callbacks=events)
    driver.spin_until(lambda: out.get_subscription_count() == 1)
    out.assert_liveliness()
    driver.spin_until(lambda: alive[-1:] == [1])


def test_what_an_endpoint_cannot_have_is_refused(active: Callable[..., Any], driver: Any) -> None:
    node = active(Optioned, *ENDPOINTS, to="configure")
    with pytest.raises(LifecycleError, match=r"cannot find endpoint 'nothing' of /it"):
        node.set_options("nothing", raw=True)
    driver.set("/it", "connect")
    with pytest.raises(LifecycleError, match=r"cannot set options of subscriptions/in of /it: "):
        node.set_options("in", raw=True)
