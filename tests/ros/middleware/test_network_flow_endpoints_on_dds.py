"""Network flow endpoints and their creation option, on real Fast DDS."""

from __future__ import annotations

import contextlib
import gc
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import rclpy
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from std_msgs.msg import String

from lifecycle.errors import MiddlewareError
from lifecycle.manifest.qos import QosProfile
from lifecycle.middleware.fastdds.nfe import (
    create_publisher,
    create_subscription,
    get_network_flow_endpoints,
)
from lifecycle.middleware.fastdds.participant import FlowParticipant
from lifecycle.middleware.fastdds.sockets import get_dscps
from lifecycle.middleware.versions import installed
from lifecycle.network.nfe import TransportProtocol, UniqueRequirement

MakeNode = Callable[..., Node]
SpinUntil = Callable[..., None]
WaitUntil = Callable[..., None]
QOS = QosProfile()
STRICTLY = UniqueRequirement.STRICTLY_REQUIRED
REFUSED = "Unique network flow endpoints not supported on publishers"


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


def test_strictly_unique_subscriptions_each_get_a_port_of_their_own(make_node: MakeNode) -> None:
    node, other = make_node("one"), make_node("two")
    plain = node.create_subscription(String, "/a", ignore, 10)
    unique = [
        create_subscription(each, String, topic, ignore, QOS, unique=STRICTLY)
        for each in (node, other)
        for topic in ("/a", "/b")
    ]
    taken = [port for each in (plain, *unique) for port in ports(each)]
    assert len(taken) == len(set(taken)) == 5
    assert all(7000 <= port < 7400 for each in unique for port in ports(each))


@pytest.mark.parametrize(
    "unique", [UniqueRequirement.OPTIONALLY_REQUIRED, UniqueRequirement.SYSTEM_DEFAULT]
)
def test_the_option_that_need_not_be_met_makes_working_endpoints(
    make_node: MakeNode, spin_until: SpinUntil, unique: UniqueRequirement
) -> None:
    node, got = make_node("node"), []
    create_subscription(node, String, "/a", got.append, QOS, unique=unique)
    publisher = create_publisher(node, String, "/a", QOS, unique=unique)
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


def test_a_strictly_unique_publisher_is_refused_with_the_reason_of_the_rmw(
    make_node: MakeNode,
) -> None:
    node = make_node("node")
    before = list(node.publishers)
    with pytest.raises(MiddlewareError) as refused:
        create_publisher(node, String, "video", QOS, unique=STRICTLY)
    assert str(refused.value) == (
        "cannot create publisher '/video' with network flow endpoints strictly_required: "
        f"{REFUSED}; give the publisher its own participant, or ask for optionally_required"
    )
    assert list(node.publishers) == before
    assert node.count_publishers("/video") == 0


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
            with pytest.raises(MiddlewareError):
                create_publisher(node, String, "/a", QOS, unique=STRICTLY)
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
from lifecycle.middleware.fastdds.nfe import senders_of
from lifecycle.middleware.fastdds.participant import FlowParticipant
try:
    with FlowParticipant("_node_flow_0", "/", int(sys.argv[1]), dscp=46) as participant:
        print(sorted({nfe.internet_protocol.value for nfe in senders_of(participant.node)}))
        print(participant.read_dscp())
except MiddlewareError as error:
    print(error)
"""
_IPV6_PROFILE = """
<dds xmlns="http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles"><profiles>
<participant profile_name="v6" is_default_profile="true">
<rtps><builtinTransports>UDPv6</builtinTransports></rtps></participant></profiles></dds>
"""


def mark(domain: int, **environment: str) -> list[str]:
    done = subprocess.run(
        [sys.executable, "-c", _MARK, str(domain)],
        env={**os.environ, **environment},
        check=True,
        capture_output=True,
        text=True,
        timeout=30,
    )
    return done.stdout.splitlines()


def test_shared_memory_alone_cannot_be_marked(domain_id: int) -> None:
    lines = mark(
        domain_id,
        FASTDDS_BUILTIN_TRANSPORTS="SHM",
        ROS_AUTOMATIC_DISCOVERY_RANGE="SYSTEM_DEFAULT",
    )
    assert "\n".join(lines) == (
        "cannot find the sockets of this publisher among network flow endpoints []: it has no UDP "
        "or TCP socket in this process; a publisher that only has shared memory cannot be marked"
    )


def test_ipv6_sockets_are_marked_by_their_traffic_class(domain_id: int, tmp_path: Path) -> None:
    profile = tmp_path / "v6.xml"
    profile.write_text(_IPV6_PROFILE)
    assert mark(domain_id, **{installed().profiles_variable: str(profile)}) == [
        "['ipv4', 'ipv6']",
        "46",
    ]
