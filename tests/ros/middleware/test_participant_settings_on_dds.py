"""Transports, datagram sizes, send mode and DSCP of a participant, on real DDS and on the wire."""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import rclpy
from loopback import Datagram, on_the_wire, watching
from rclpy.node import Node
from std_msgs.msg import String

from lifecycle import codec
from lifecycle.manifest.qos import QosProfile
from lifecycle.middleware.fastdds.factory import has_shared_memory, participant_settings
from lifecycle.middleware.fastdds.nfe import (
    SHARED_MEMORY,
    senders_of,
)
from lifecycle.middleware.fastdds.participant import FlowParticipant
from lifecycle.middleware.fastdds.profiles import ParticipantSettings
from lifecycle.network.nfe import NetworkFlowEndpoint
from lifecycle.verify.network_flows import carrier
from lifecycle.verify.observation import Identity

HERE = Path(__file__).parent
QOS = QosProfile()
MARK = f"What process {os.getpid()} sends by the network can be read there. "
"""Nothing else on the wire has this, not even from the same test in another process."""
COUNT = 5
UDP = ("udpv4",)
BOTH = ("udpv4", "udpv6")

MakeNode = Callable[..., Node]
SpinUntil = Callable[..., None]
WaitUntil = Callable[..., None]


class Peer:
    """A subscription to /flow in another process."""

    def __init__(self, domain: int, count: int, transports: tuple[str, ...]) -> None:
        self.process = subprocess.Popen(
            [sys.executable, str(HERE / "peer.py"), str(domain), str(count), *transports],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self.nfes = codec.from_json(self._line().encode(), tuple[NetworkFlowEndpoint, ...])

    def lengths(self) -> list[int]:
        return json.loads(self._line())

    def _line(self) -> str:
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        assert line, "the peer ended"
        return line


@contextlib.contextmanager
def peer(domain: int, transports: tuple[str, ...] = (), count: int = COUNT) -> Iterator[Peer]:
    made = Peer(domain, count, transports)
    try:
        yield made
    finally:
        try:
            made.process.communicate(timeout=30)
        finally:
            made.process.kill()
            made.process.wait()
    assert made.process.returncode == 0


def sent(
    participant: FlowParticipant, other: Peer, wait_until: WaitUntil, text: str = MARK
) -> list[Datagram]:
    """Publish COUNT messages to a peer; return what left the participant's sockets meanwhile."""
    publisher = participant.create_publisher(String, "/flow", QOS)
    wait_until(publisher.get_subscription_count)
    with watching() as loopback:
        for _ in range(COUNT):
            publisher.publish(String(data=text))
        assert other.lengths() == [len(text)] * COUNT
        seen = loopback.until_now()
    mine = {nfe.transport_port for nfe in senders_of(participant.node)}
    return [each for each in seen if each.source in mine or each.fragment]


def carrying(datagrams: list[Datagram], text: str = MARK) -> list[Datagram]:
    return [each for each in datagrams if text.encode() in each.payload]


def source_of(participant: FlowParticipant) -> tuple[NetworkFlowEndpoint, ...]:
    """A publisher's NFEs as a node reports them."""
    return senders_of(participant.node) + (SHARED_MEMORY,) * has_shared_memory(participant.node)


# What Fast DDS 2.14 does between two processes of one host: shared memory exactly if both have it.
# A publisher's NFE list from rmw never says that it has; a subscription's does.
@on_the_wire
@pytest.mark.parametrize(
    ("publishing", "subscribing", "expected"),
    [
        ((), (), "shm"),
        (UDP, (), "udpv4"),
        ((), UDP, "udpv4"),
        (UDP, UDP, "udpv4"),
        (("udpv6",), ("udpv6",), "udpv6"),
    ],
)
def test_what_carries_a_flow_on_one_host_is_what_the_reports_say(
    domain_id: int,
    wait_until: WaitUntil,
    publishing: tuple[str, ...],
    subscribing: tuple[str, ...],
    expected: str,
) -> None:
    with (
        peer(domain_id, subscribing) as other,
        FlowParticipant("_flow", "/", domain_id, transports=publishing) as participant,
    ):
        datagrams = carrying(sent(participant, other, wait_until))
        here, there = (
            Identity(machine_id="m", process_id=pid, node_id="")
            for pid in (os.getpid(), other.process.pid)
        )
        assert carrier(source_of(participant), other.nfes, here, there) == expected
    if expected == "shm":
        assert datagrams == []
    else:
        listened = {nfe.transport_port for nfe in other.nfes}
        assert len(datagrams) >= COUNT  # a reliable writer may repeat one
        assert {each.destination for each in datagrams} <= listened
        assert {each.family for each in datagrams} == {expected.replace("udpv", "ipv")}


@on_the_wire
def test_with_both_internet_protocols_each_message_goes_twice(
    domain_id: int, wait_until: WaitUntil
) -> None:
    both = ("udpv4", "udpv6")
    with (
        peer(domain_id, both) as other,
        FlowParticipant("_flow", "/", domain_id, transports=both) as participant,
    ):
        datagrams = carrying(sent(participant, other, wait_until))
    families = [each.family for each in datagrams]
    assert families.count("ipv4") >= COUNT
    assert families.count("ipv6") >= COUNT


@on_the_wire
def test_inside_a_process_no_transport_carries_anything(
    domain_id: int, spin_until: SpinUntil
) -> None:
    got: list[String] = []
    with (
        FlowParticipant("_in", "/", domain_id, transports=UDP) as receiving,
        FlowParticipant("_out", "/", domain_id, transports=UDP) as sending,
    ):
        receiving.create_subscription(String, "/flow", got.append, QOS)
        publisher = sending.create_publisher(String, "/flow", QOS)
        spin_until(publisher.get_subscription_count, receiving.node)
        with watching() as loopback:
            publisher.publish(String(data=MARK))
            spin_until(lambda: got, receiving.node)
            assert carrying(loopback.until_now()) == []


@pytest.mark.thorough
@pytest.mark.parametrize("range_", ["LOCALHOST", "SUBNET", "SYSTEM_DEFAULT"])
@pytest.mark.parametrize("transports", [UDP, ("udpv6",), ("udpv4", "udpv6")])
def test_chosen_transports_are_all_there_is_in_every_discovery_range(
    fresh_domain: int,
    monkeypatch: pytest.MonkeyPatch,
    wait_until: WaitUntil,
    range_: str,
    transports: tuple[str, ...],
) -> None:
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", range_)
    with (
        FlowParticipant("_chosen", "/", fresh_domain, transports=transports) as chosen,
        FlowParticipant("_same", "/", fresh_domain, transports=transports) as same,
        FlowParticipant("_plain", "/", fresh_domain) as plain,
    ):
        assert (has_shared_memory(chosen.node), has_shared_memory(plain.node)) == (False, True)
        spelt = {
            f"{nfe.transport_protocol.value}{nfe.internet_protocol.value[2:]}"
            for nfe in senders_of(chosen.node)
        }
        assert spelt == set(transports)
        publisher = chosen.create_publisher(String, "/flow", QOS)
        same.create_subscription(String, "/flow", print, QOS)
        plain.create_subscription(String, "/flow", print, QOS)
        found = 2 if "udpv4" in transports else 1  # a plain participant has no IPv6
        wait_until(lambda: publisher.get_subscription_count() == found)


@on_the_wire
def test_a_long_message_leaves_in_datagrams_of_the_size_that_was_asked_for(
    domain_id: int, wait_until: WaitUntil
) -> None:
    text = "x" * 10_000
    with (
        peer(domain_id) as other,
        FlowParticipant(
            "_flow", "/", domain_id, transports=UDP, max_datagram_bytes=1400
        ) as participant,
    ):
        datagrams = sent(participant, other, wait_until, text)
    sizes = [len(each.payload) for each in datagrams]
    assert max(sizes) <= 1400
    assert len(sizes) >= COUNT * 8
    assert sum(sizes) > COUNT * len(text)
    assert not any(each.fragment for each in datagrams)


def test_a_participant_of_small_datagrams_still_receives_large_ones(
    domain_id: int, make_node: MakeNode, spin_until: SpinUntil
) -> None:
    """The transport's own maxMessageSize would cut off what others send."""
    got: list[int] = []
    with FlowParticipant("_in", "/", domain_id, transports=UDP, max_datagram_bytes=1400) as small:
        small.create_subscription(String, "/flow", lambda m: got.append(len(m.data)), QOS)
        script = (
            "import sys, time\n"
            "from std_msgs.msg import String\n"
            "from lifecycle.manifest.qos import QosProfile\n"
            "from lifecycle.middleware.fastdds.participant import FlowParticipant\n"
            "from lifecycle.middleware.process.control import leave_and_exit\n"
            "p = FlowParticipant('_out', '/', int(sys.argv[1]))\n"
            "publisher = p.create_publisher(String, '/flow', QosProfile())\n"
            "while not publisher.get_subscription_count(): time.sleep(0.005)\n"
            "publisher.publish(String(data='x' * 10_000))\n"
            "sys.stdin.read()\n"
            "p.destroy()\n"
            "leave_and_exit(0)\n"
        )
        sender = subprocess.Popen(
            [sys.executable, "-c", script, str(domain_id)], stdin=subprocess.PIPE
        )
        try:
            spin_until(lambda: got, small.node)
            sender.communicate(timeout=30)
        finally:
            sender.kill()
            sender.wait()
    assert got == [10_000]


@on_the_wire
@pytest.mark.parametrize("transports", [UDP, ("udpv6",)])
def test_every_datagram_of_a_user_carries_the_dscp_from_the_first_on(
    domain_id: int, wait_until: WaitUntil, transports: tuple[str, ...]
) -> None:
    with (
        peer(domain_id, transports) as other,
        FlowParticipant("_flow", "/", domain_id, dscp=46, transports=transports) as marked,
    ):
        with watching() as loopback:
            publisher = marked.create_publisher(String, "/flow", QOS)
            wait_until(publisher.get_subscription_count)
            for _ in range(COUNT):
                publisher.publish(String(data=MARK))
            assert other.lengths() == [len(MARK)] * COUNT
            seen = loopback.until_now()
        first, *rest = carrying(seen)
        assert first.tos == 46 << 2
        assert {each.tos for each in rest} == {46 << 2}
        mine = {nfe.transport_port for nfe in senders_of(marked.node)}
        unmarked = [each for each in seen if each.source in mine and each.tos != 46 << 2]
        assert unmarked == [], "its discovery shares the sockets"


def test_one_socket_without_the_mark_is_what_is_read(domain_id: int) -> None:
    from lifecycle.middleware.fastdds.sockets import get_dscps, set_dscp

    with FlowParticipant("_flow", "/", domain_id, dscp=46, transports=BOTH) as participant:
        nfes = senders_of(participant.node)
        assert len(nfes) > 1
        for lost in (nfes[0], nfes[-1]):
            set_dscp([lost], 10)
            assert get_dscps(nfes) == {10, 46}
            assert participant.read_dscp() == 10
            set_dscp([lost], 46)
            assert participant.read_dscp() == 46


# Profiles are loaded once per process. Another portBase moves every port: it shows who has it.
_USERS = """
<dds xmlns="http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles"><profiles>
<participant profile_name="mine" is_default_profile="true"><rtps>
<port><portBase>{base}</portBase></port>{extra}
</rtps></participant></profiles></dds>
"""
_PORTS = """
import sys
from std_msgs.msg import String
from lifecycle.errors import MiddlewareError
from lifecycle.manifest.qos import QosProfile
from lifecycle.middleware.fastdds.factory import has_shared_memory
from lifecycle.middleware.fastdds.participant import FlowParticipant
from lifecycle.middleware.fastdds.nfe import get_network_flow_endpoints
for transports in ((), ("udpv4",), ()):
    try:
        with FlowParticipant("_p", "/", int(sys.argv[1]), transports=transports) as participant:
            subscription = participant.create_subscription(String, "/a", print, QosProfile())
            nfes = get_network_flow_endpoints(subscription)
            port = max(each.transport_port for each in nfes)
            print(has_shared_memory(participant.node), port - 250 * int(sys.argv[1]))
    except MiddlewareError as error:
        print(error)
"""


def ports_with(domain: int, profiles: Path) -> list[str]:
    done = subprocess.run(
        [sys.executable, "-c", _PORTS, str(domain)],
        env={**os.environ, "FASTRTPS_DEFAULT_PROFILES_FILE": str(profiles)},
        check=True,
        capture_output=True,
        text=True,
        timeout=30,
    )
    return done.stdout.splitlines()


def test_a_profile_of_the_users_holds_for_every_participant_before_during_and_after(
    fresh_domain: int, tmp_path: Path
) -> None:
    profiles = tmp_path / "mine.xml"
    profiles.write_text(_USERS.format(base=3400, extra=""))
    lines = [line.split() for line in ports_with(fresh_domain, profiles)]
    assert [shared for shared, _ in lines] == ["True", "False", "True"]
    # portBase + 11 + 2 × participant, where the default base would give 7411 and more
    assert all(3411 <= int(port) < 3500 for _, port in lines)


def test_a_context_that_has_its_participant_is_not_changed(
    context: rclpy.Context, make_node: MakeNode
) -> None:
    make_node("first")
    with participant_settings(context, ParticipantSettings(transports=UDP)):
        assert has_shared_memory(make_node("second"))
