"""Network flow endpoints and their creation option, on real Fast DDS."""

from __future__ import annotations

import contextlib
import gc
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import rclpy
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from std_msgs.msg import String

from lifecycle.manifest.qos import QosProfile
from lifecycle.middleware.fastdds.nfe import (
    create_subscription,
    get_network_flow_endpoints,
)
from lifecycle.middleware.fastdds.participant import FlowParticipant
from lifecycle.middleware.fastdds.sockets import get_dscps
from lifecycle.network.nfe import TransportProtocol, UniqueRequirement

MakeNode = Callable[..., Node]
SpinUntil = Callable[..., None]
WaitUntil = Callable[..., None]
QOS = QosProfile()
STRICTLY = UniqueRequirement.STRICTLY_REQUIRED


def ports(entity: object) -> set[int]:
    return {
        nfe.transport_port
        for nfe in get_network_flow_endpoints(entity)
        if nfe.transport_protocol is TransportProtocol.UDP
    }


def descriptors() -> int:
    gc.collect()
    return len(list(Path("/proc/self/fd").iterdir()))


def sockets() -> int:
    found = 0
    for file in Path("/proc/self/fd").iterdir():
        with contextlib.suppress(FileNotFoundError):  # closed by another thread meanwhile
            found += str(file.readlink()).startswith("socket:")
    return found


def ignore(_: String) -> None:
    pass


@pytest.mark.parametrize(
    "unique", [UniqueRequirement.OPTIONALLY_REQUIRED, UniqueRequirement.SYSTEM_DEFAULT]
)
def test_the_option_that_need_not_be_met_makes_working_endpoints(
    make_node: MakeNode, spin_until: SpinUntil, unique: UniqueRequirement
) -> None:
    node, got = make_node("node"), []
    create_subscription(node, String, "/a", got.append, QOS, unique=unique)
    publisher = node.create_publisher(String, "/a", 10)
    publisher.publish(String(data="hello"))
    spin_until(lambda: got, node)
    assert got == [String(data="hello")]


def test_messages_and_events_reach_a_unique_subscription(
    make_node: MakeNode, spin_until: SpinUntil
) -> None:
    node, got, matched = make_node("node", namespace="/robot"), [], []
    subscription = create_subscription(
        node,
        String,
        "video",
        got.append,
        QOS,
        unique=STRICTLY,
        event_callbacks=SubscriptionEventCallbacks(matched=matched.append),
    )
    publisher = node.create_publisher(String, "/robot/video", 10)
    publisher.publish(String(data="hello"))
    spin_until(lambda: got and matched, node)
    assert subscription.topic_name == "/robot/video"
    assert got == [String(data="hello")]
    assert matched[0].current_count == 1


def test_a_remap_rule_applies_once_to_a_unique_subscription(context: rclpy.Context) -> None:
    # With a second pass /b would become /c.
    node = Node("node", context=context, cli_args=["--ros-args", "-r", "/a:=/b", "-r", "/b:=/c"])
    subscription = create_subscription(node, String, "/a", ignore, QOS, unique=STRICTLY)
    assert subscription.topic_name == "/b"
    node.destroy_node()


@pytest.mark.thorough
def test_two_hundred_unique_subscriptions_come_and_go_and_participants_take_all_along(
    domain_id: int, wait_until: WaitUntil
) -> None:
    before = descriptors()
    # Fast DDS keeps each port until the participant ends; all 400 are shared with whatever else
    # runs on this host, so take 50 at a time.
    for _ in range(4):
        context = rclpy.Context()
        context.init(args=[], domain_id=domain_id)
        node = Node("node", context=context)
        for _ in range(50):
            subscription = create_subscription(node, String, "/a", ignore, QOS, unique=STRICTLY)
            assert len(ports(subscription)) == 1
            assert node.destroy_subscription(subscription)
        assert (node.count_subscribers("/a"), node.count_publishers("/a")) == (0, 0)
        node.destroy_node()
        context.try_shutdown()
        context.destroy()
    del subscription, node, context
    wait_until(lambda: descriptors() <= before)


def test_a_unique_subscription_on_a_participant_gives_its_port_back(
    make_node: MakeNode, spin_until: SpinUntil, wait_until: WaitUntil, domain_id: int
) -> None:
    publisher = make_node("talker").create_publisher(String, "/a", 10)
    before, got = descriptors(), []
    for number in range(10):
        with FlowParticipant("_in", "/", domain_id) as participant:
            subscription = participant.create_subscription(
                String, "/a", got.append, QOS, unique=STRICTLY
            )
            assert len(ports(subscription)) == 1
            if number == 9:
                spin_until(publisher.get_subscription_count, participant.node)
                publisher.publish(String(data="hello"))
                spin_until(lambda: got, participant.node)
    del participant, subscription
    assert got == [String(data="hello")]
    wait_until(lambda: descriptors() <= before)


def test_the_dscp_of_a_participant_is_read_back_from_every_sender_socket(
    make_node: MakeNode, domain_id: int
) -> None:
    plain = make_node("node").create_publisher(String, "/a", 10)
    with (
        FlowParticipant("_node_flow_0", "/", domain_id, dscp=46) as marked,
        FlowParticipant("_node_flow_1", "/", domain_id, dscp=8) as other,
    ):
        assert marked.read_dscp() == 46
        assert other.read_dscp() == 8
        assert get_dscps(get_network_flow_endpoints(plain)) == {0}
        # Discovery opens shared memory meanwhile, but no socket.
        sockets_in_use = sockets()
        marked.read_dscp()
        assert sockets() == sockets_in_use


# Transports are chosen once per process, and under LOCALHOST by rmw_fastrtps alone.
_MARK = """
import sys
from lifecycle.errors import MiddlewareError
from lifecycle.middleware.fastdds.participant import FlowParticipant
try:
    FlowParticipant("_node_flow_0", "/", int(sys.argv[1]), dscp=46)
except MiddlewareError as error:
    print(error)
"""


def test_shared_memory_alone_cannot_be_marked(
    domain_id: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FASTDDS_BUILTIN_TRANSPORTS", "SHM")
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "SYSTEM_DEFAULT")
    command = [sys.executable, "-c", _MARK, str(domain_id)]
    assert subprocess.check_output(command, text=True, timeout=30) == (
        "cannot find the sockets of this publisher among network flow endpoints []: it has no UDP "
        "or TCP socket in this process; a publisher that only has shared memory cannot be marked\n"
    )
