"""Participants from connection URLs: what they open, whom they find, and what they refuse."""

from __future__ import annotations

import contextlib
import socket
import subprocess
import threading
import time
from collections.abc import Callable, Iterator

import psutil
import pytest
import rclpy
from free_ports import free_ports
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from std_msgs.msg import String

from lifecycle.errors import MiddlewareError
from lifecycle.manifest.qos import QosProfile
from lifecycle.middleware.fastdds.discovery import (
    discovery_server_command,
    discovery_server_listens,
)
from lifecycle.middleware.fastdds.factory import has_shared_memory
from lifecycle.middleware.fastdds.nfe import (
    get_network_flow_endpoints,
    senders_of,
)
from lifecycle.middleware.fastdds.participant import FlowParticipant
from lifecycle.middleware.fastdds.profiles import ParticipantSettings
from lifecycle.middleware.fastdds.sockets import OpenSocket, open_sockets
from lifecycle.middleware.rcl.graph import GraphObserver
from lifecycle.plan.model import (
    ParticipantConnections,
    PlannedServer,
)
from lifecycle.verify.tool_filter import DeclaredNames

QOS = QosProfile()
MARK = "What goes by the network can be read there. "
UNIQUE = range(7000, 7400)
"""rmw asks for a port of its own for the reader of the graph, and gets one of these."""

MakeNode = Callable[..., Node]
WaitUntil = Callable[..., None]


def connect(*urls: str) -> ParticipantConnections:
    return ParticipantConnections(urls=urls)


@pytest.fixture
def ports(fresh_domain: int) -> list[int]:
    """Ports that nobody else has."""
    return free_ports(8)


@contextlib.contextmanager
def opened() -> Iterator[list[OpenSocket]]:
    """Yield a list that holds the sockets opened in the block, after `look` or at its end."""
    before = {each.inode for each in open_sockets()}
    found: list[OpenSocket] = []
    yield found
    found += [each for each in open_sockets() if each.inode not in before]


@pytest.fixture
def spun(make_node: MakeNode) -> Iterator[Node]:
    """A node whose executor spins in a thread, as a program's does."""
    node = make_node("served")
    executor = SingleThreadedExecutor(context=node.context)
    executor.add_node(node)
    over = threading.Event()

    def spin() -> None:
        while not over.is_set():
            executor.spin_once()

    thread = threading.Thread(target=spin, daemon=True)
    thread.start()
    yield node
    over.set()
    executor.create_task(lambda: None)  # waking alone does not end a spin_once without limit
    thread.join(30)
    executor.remove_node(node)
    executor.shutdown()


def exchange(sending: FlowParticipant, receiving: FlowParticipant, wait_until: WaitUntil) -> None:
    """Send one message from one to the other, whose callback runs wherever it does."""
    got: list[str] = []
    receiving.create_subscription(String, "/flow", lambda m: got.append(m.data), QOS)
    publisher = sending.create_publisher(String, "/flow", QOS)
    wait_until(publisher.get_subscription_count)
    publisher.publish(String(data=MARK))
    wait_until(lambda: got)
    assert got == [MARK]


def fixed(kind: str, address: str, ports: list[int], peer: int) -> str:
    host = f"[{address}]" if ":" in address else address
    return (
        f"{kind}://{host}:{ports[0]}?metatraffic_port={ports[1]}&output_port={ports[2]}"
        f"&peer={host}:{peer}&multicast=off"
    )


@pytest.mark.parametrize(("kind", "address"), [("udpv4", "127.0.0.1"), ("udpv6", "::1")])
def test_with_fixed_ports_these_are_all_sockets_there_are(
    fresh_domain: int,
    spun: Node,
    wait_until: WaitUntil,
    ports: list[int],
    kind: str,
    address: str,
) -> None:
    one = fixed(kind, address, ports[0:3], ports[4])
    other = fixed(kind, address, ports[3:6], ports[1])
    with opened() as sockets:
        receiving = FlowParticipant("_in", "/", fresh_domain, connections=connect(one), served=spun)
    with receiving, FlowParticipant("_out", "/", fresh_domain, connections=connect(other)) as out:
        listened = {(s.kind, s.address, s.port) for s in sockets if s.port not in UNIQUE}
        assert listened == {(kind, address, port) for port in ports[0:3]}
        assert [nfe.transport_port for nfe in senders_of(out.node)] == [ports[5]]
        exchange(out, receiving, wait_until)


def test_a_participant_of_shared_memory_has_no_ip_socket(
    fresh_domain: int, spun: Node, wait_until: WaitUntil
) -> None:
    with opened() as sockets:
        receiving = FlowParticipant(
            "_in", "/", fresh_domain, connections=connect("shm://"), served=spun
        )
        sending = FlowParticipant("_out", "/", fresh_domain, connections=connect("shm://"))
    with receiving, sending:
        exchange(sending, receiving, wait_until)
        assert (has_shared_memory(sending.node), senders_of(sending.node)) == (True, ())
    assert sockets == []


def test_tcp_is_dialled_by_who_has_the_peer_and_opens_no_udp_socket(
    fresh_domain: int, spun: Node, wait_until: WaitUntil, ports: list[int]
) -> None:
    listening = f"tcpv4://127.0.0.1:{ports[0]}"
    with opened() as sockets:
        receiving = FlowParticipant(
            "_in", "/", fresh_domain, connections=connect(listening), served=spun
        )
        sending = FlowParticipant(
            "_out",
            "/",
            fresh_domain,
            connections=connect(f"tcpv4://127.0.0.1:{ports[1]}?peer=127.0.0.1:{ports[0]}"),
        )
    with receiving, sending:
        assert {(s.kind, s.address, s.port) for s in sockets} == {
            ("tcpv4", "127.0.0.1", port) for port in ports[0:2]
        }
        exchange(sending, receiving, wait_until)


def test_readers_of_a_group_listen_on_it(
    fresh_domain: int, spun: Node, wait_until: WaitUntil, ports: list[int]
) -> None:
    group = f"udpm://239.255.7.9:{ports[0]}?ttl=0&interface=127.0.0.1"
    with (
        FlowParticipant(
            "_in", "/", fresh_domain, connections=connect(group), served=spun
        ) as receiving,
        FlowParticipant("_out", "/", fresh_domain, connections=connect(group)) as sending,
    ):
        exchange(sending, receiving, wait_until)
        (subscription,) = (s for s in spun.subscriptions if s.topic_name == "/flow")
        listened = {
            (nfe.internet_address, nfe.transport_port)
            for nfe in get_network_flow_endpoints(subscription)
        }
        assert ("239.255.7.9", ports[0]) in listened
        assert {address for address, _ in listened} == {"239.255.7.9", "127.0.0.1"}


def test_a_fixed_port_that_is_taken_is_an_error_that_names_it(
    fresh_domain: int, ports: list[int], capfd: pytest.CaptureFixture[str]
) -> None:
    url = f"udpv4://127.0.0.1:{ports[0]}?metatraffic_port={ports[1]}&multicast=off"
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", ports[0]))
        with opened() as sockets, pytest.raises(MiddlewareError) as refused:
            FlowParticipant("_late", "/", fresh_domain, connections=connect(url))
    assert str(refused.value) == (
        f"cannot make a participant for /_late in domain {fresh_domain}: cannot connect by "
        f"'{url}': UDP 127.0.0.1:{ports[0]} is not free on this host; end who has it "
        "(`ss -lnp`), or choose another port"
    )
    assert sockets == []
    capfd.readouterr()  # Fast DDS's own words


def test_a_mark_that_no_url_could_carry_is_an_error(fresh_domain: int) -> None:
    urls = ("tcpv4://127.0.0.1:21099", "shm://")
    with pytest.raises(MiddlewareError) as refused:
        FlowParticipant("_marked", "/", fresh_domain, dscp=46, connections=connect(*urls))
    assert str(refused.value) == (
        "cannot find the sockets of this publisher among network flow endpoints []: it has no UDP "
        "or TCP socket in this process; a publisher that only has shared memory cannot be marked"
    )


def test_ports_are_free_again_when_destroy_returns(
    fresh_domain: int, spun: Node, wait_until: WaitUntil, ports: list[int]
) -> None:
    one = fixed("udpv4", "127.0.0.1", ports[0:3], ports[4])
    for _ in range(5):
        with FlowParticipant(
            "_again", "/", fresh_domain, connections=connect(one), served=spun
        ) as participant:
            participant.create_subscription(String, "/flow", print, QOS)
    assert not {each.port for each in open_sockets()} & set(ports[0:3])


def test_an_idle_connection_costs_no_thread_of_ours_and_no_time(
    fresh_domain: int, spun: Node, ports: list[int], wait_until: WaitUntil
) -> None:
    me = psutil.Process()
    one = fixed("udpv4", "127.0.0.1", ports[0:3], ports[4])
    with FlowParticipant(
        "_idle", "/", fresh_domain, connections=connect(one), served=spun
    ) as participant:
        before = threading.active_count()
        participant.create_subscription(String, "/flow", print, QOS)
        assert threading.active_count() == before

        def idle() -> bool:
            start_s = sum(me.cpu_times()[:2])
            time.sleep(0.5)  # the idle time itself; the first announcements take four of them
            return sum(me.cpu_times()[:2]) - start_s <= 0.03

        wait_until(idle)


@pytest.mark.parametrize("tcp", [True, False])
def test_clients_of_a_discovery_server_find_each_other_and_a_super_client_sees_them(
    fresh_domain: int, spun: Node, wait_until: WaitUntil, ports: list[int], tcp: bool
) -> None:
    server = PlannedServer(machine="", address="127.0.0.1", port=ports[7], tcp=tcp)
    argv, environment = discovery_server_command(server)
    assert not discovery_server_listens(server)
    process = subprocess.Popen(argv, env=environment, stdout=subprocess.DEVNULL)
    try:
        wait_until(lambda: discovery_server_listens(server))
        kind = "tcpv4" if tcp else "udpv4"
        urls = [f"{kind}://127.0.0.1:{port}?server=127.0.0.1:{ports[7]}" for port in ports]
        with (
            GraphObserver(fresh_domain, connect(urls[0])) as observer,
            FlowParticipant(
                "_in", "/", fresh_domain, connections=connect(urls[1]), served=spun
            ) as receiving,
            FlowParticipant("_out", "/", fresh_domain, connections=connect(urls[2])) as sending,
        ):
            exchange(sending, receiving, wait_until)

            def seen() -> bool:
                _, endpoints = observer.snapshot(
                    names=DeclaredNames(nodes=frozenset({"/_in", "/_out"}))
                )
                return {each.node for each in endpoints if each.name == "/flow"} == {
                    "/_in",
                    "/_out",
                }

            wait_until(seen)
    finally:
        process.terminate()
        assert process.wait(30) == 0


def test_a_second_context_of_the_process_is_left_alone(
    fresh_domain: int, ports: list[int], make_node: MakeNode
) -> None:
    with FlowParticipant(
        "_one", "/", fresh_domain, connections=connect(f"tcpv4://127.0.0.1:{ports[0]}")
    ):
        assert ParticipantSettings().governs_discovery is False
        context = rclpy.Context()
        context.init(args=[], domain_id=fresh_domain)
        plain = Node("plain", context=context, enable_rosout=False)
        assert has_shared_memory(plain) is True
        plain.destroy_node()
        context.try_shutdown()
        context.destroy()
