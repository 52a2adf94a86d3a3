"""A publisher with a group for its own host and TCP for others, as packets show it.

The distributed system with intelligent multicast of *Topological Discovery and Communication
Negotiation*: one datagram for all subscribers of the host, none outside, TCP to the remote one.
"""

from __future__ import annotations

import subprocess
import sys

from tests.net.hosts import Host, Hosts
from tests.net.wire import Capture

_COUNT = 5
_GROUP = "udpm://239.255.1.9:7901?ttl=0&interface=127.0.0.1"
_PROGRAM = """
import sys, time
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.executors import SingleThreadedExecutor
from std_msgs.msg import String
from lifecycle.manifest.qos import QosProfile
from lifecycle.middleware import FlowParticipant
from lifecycle.plan.model import ParticipantConnections
role, count, *urls = sys.argv[1:]
with FlowParticipant(
    "_" + role, "/", 7, connections=ParticipantConnections(urls=tuple(urls))
) as participant:
    deadline = time.monotonic() + 60
    if role == "publish":
        publisher = participant.create_publisher(String, "/flow", QosProfile())
        while publisher.get_subscription_count() < 3 and time.monotonic() < deadline:
            time.sleep(0.005)
        sys.stdin.readline()
        for number in range(int(count)):
            publisher.publish(String(data=str(number)))
        sys.stdin.read()
    else:
        got = []
        matched = SubscriptionEventCallbacks(
            matched=lambda info: info.current_count_change > 0 and print("matched", flush=True),
            use_default_callbacks=False,
        )
        participant.create_subscription(
            String, "/flow", lambda m: got.append(m.data), QosProfile(), event_callbacks=matched
        )
        executor = SingleThreadedExecutor(context=participant.node.context)
        executor.add_node(participant.node)
        while len(got) < int(count) and time.monotonic() < deadline:
            executor.spin_once(timeout_sec=0.2)
        print(*got, flush=True)
"""


def _start(host: Host, role: str, *urls: str) -> subprocess.Popen[str]:
    return host.popen(
        sys.executable,
        "-c",
        _PROGRAM,
        role,
        str(_COUNT),
        *urls,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    )


def test_one_datagram_serves_all_subscribers_of_a_host_and_tcp_the_remote_one(
    hosts: Hosts,
) -> None:
    left, right = hosts.bridged("A", "B")
    with Capture(left, "lo") as inside, Capture(left, "e0") as outside:
        publisher = _start(left, "publish", _GROUP, f"tcpv4://{left.ipv4}:5100")
        subscribers = [
            _start(left, "subscribe", _GROUP),
            _start(left, "subscribe", _GROUP),
            _start(right, "subscribe", f"tcpv4://{right.ipv4}:5100?peer={left.ipv4}:5100"),
        ]
        # Who has not found the publisher yet has every message repeated, to it alone.
        for each in subscribers:
            assert each.stdout is not None
            assert each.stdout.readline() == "matched\n"
        assert publisher.stdin is not None
        publisher.stdin.write("all are there\n")
        publisher.stdin.flush()
        received = [each.communicate(timeout=70)[0].split() for each in subscribers]
        publisher.communicate(timeout=20)
        assert received == [[str(number) for number in range(_COUNT)]] * 3
        sent = inside.data("/flow")
        first = [each for each in sent if each.multicast]
        assert [(each.destination, each.destination_port, each.ttl) for each in first] == [
            ("239.255.1.9", 7901, 0)
        ] * _COUNT
        # A reliable writer repeats for the one that has missed something, to it alone.
        repeated = [each for each in sent if not each.multicast]
        assert {each.destination for each in repeated} <= {"127.0.0.1"}
        assert len(repeated) < _COUNT
        left_host = [each for each in outside.packets() if each.outgoing]
        assert {each.protocol for each in left_host} == {"tcp"}
        # An announcement that TCP cut in two was not read there; it is the same writer.
        (writer,) = inside.writers("/flow")
        flows = {each.destination for each in left_host if writer in each.writers}
        assert flows == {right.ipv4}
