"""Participants from connection URLs: what they open, whom they find, and what they refuse."""

from __future__ import annotations

import contextlib
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator

import psutil
import pytest
import rclpy
from free_ports import free_ports
from loopback import Datagram, on_the_wire, watching
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from std_msgs.msg import String
from std_srvs.srv import Trigger

from lifecycle import codec
from lifecycle.errors import MiddlewareError
from lifecycle.manifest.qos import QosProfile
from lifecycle.middleware.discovery.discovery_server import (
    discovery_server_command,
    discovery_server_listens,
)
from lifecycle.middleware.fastdds.nfe import (
    get_network_flow_endpoints,
    senders_of,
)
from lifecycle.middleware.fastdds.participant import FlowParticipant
from lifecycle.middleware.fastdds.participant_profile import ParticipantSettings
from lifecycle.middleware.fastdds.settings import has_shared_memory
from lifecycle.middleware.fastdds.sockets import OpenSocket, open_sockets
from lifecycle.middleware.rcl.graph import GraphObserver
from lifecycle.network.connection_url import parse
from lifecycle.plan.model import (
    ParticipantConnections,
    PlannedServer,
    StaticEndpoint,
    StaticParticipant,
)

QOS = QosProfile()
MARK = "What goes by the network can be read there. "
UNIQUE = range(7000, 7400)
"""rmw asks for a port of its own for the reader of the graph, and gets one of these."""

MakeNode = Callable[..., Node]
SpinUntil = Callable[..., None]
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
        assert (sending.has_shared_memory, senders_of(sending.node)) == (True, ())
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


@on_the_wire
def test_urls_that_govern_discovery_send_nothing_to_anybody_else(
    fresh_domain: int, monkeypatch: pytest.MonkeyPatch, wait_until: WaitUntil, ports: list[int]
) -> None:
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    monkeypatch.setenv("ROS_STATIC_PEERS", "127.0.0.1")
    one = fixed("udpv4", "127.0.0.1", ports[0:3], ports[4])
    with (
        watching() as loopback,
        FlowParticipant("_one", "/", fresh_domain, connections=connect(one)),
    ):
        sent: list[Datagram] = []

        def announced() -> bool:
            sent.extend(each for each in loopback.until_now() if each.source == ports[2])
            return bool(sent)

        wait_until(announced)
        assert {each.destination for each in sent} == {ports[4]}


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


def test_a_mark_that_no_url_could_carry_is_an_error_that_lists_them(fresh_domain: int) -> None:
    urls = ("tcpv4://127.0.0.1:21099", "shm://")
    with pytest.raises(MiddlewareError) as refused:
        FlowParticipant("_marked", "/", fresh_domain, dscp=46, connections=connect(*urls))
    assert str(refused.value) == (
        "cannot mark what 'tcpv4://127.0.0.1:21099' and 'shm://' carries with DSCP 46: only UDP "
        "sockets can be marked; remove the mark, or carry it by udpv4://"
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


def test_services_and_clients_answer_in_the_executor_of_the_node_they_serve(
    fresh_domain: int, spun: Node, wait_until: WaitUntil
) -> None:
    threads: list[int] = []

    def answer(_: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        threads.append(threading.get_ident())
        response.message = MARK
        return response

    with (
        FlowParticipant(
            "_server", "/", fresh_domain, connections=connect("shm://"), served=spun
        ) as serving,
        FlowParticipant(
            "_client", "/", fresh_domain, connections=connect("shm://"), served=spun
        ) as asking,
    ):
        group = spun.default_callback_group
        serving.create(
            lambda node: node.create_service(Trigger, "/ask", answer, callback_group=group),
            *("service server", "/ask"),
        )
        client = asking.create(
            lambda node: node.create_client(Trigger, "/ask", callback_group=group),
            *("service client", "/ask"),
        )
        wait_until(client.service_is_ready)
        answers = []

        def answered() -> bool:
            # An answer is lost if the server does not know yet where its client listens.
            if time.monotonic() > since + 2.0 * len(answers):
                answers.append(client.call_async(Trigger.Request()))
            return any(each.done() for each in answers)

        since = time.monotonic()
        wait_until(answered)
        assert next(each for each in answers if each.done()).result().message == MARK
        asking.destroy_endpoint(client)
        assert list(spun.clients) == []
    assert list(spun.services) == [] or all(s.srv_name != "/ask" for s in spun.services)
    assert threads != [threading.get_ident()]


def test_a_guest_is_gated_by_the_callback_groups_of_its_host(
    fresh_domain: int, make_node: MakeNode
) -> None:
    host = make_node("host")
    with FlowParticipant(
        "_guest", "/", fresh_domain, connections=connect("shm://"), served=host
    ) as participant:
        subscription = participant.create_subscription(String, "/flow", print, QOS)
        assert subscription.callback_group is host.default_callback_group
        assert subscription in list(host.subscriptions)
        assert subscription not in list(participant.node.subscriptions)
        # The host's own participant is asked, not the guest's.
        assert has_shared_memory(host) is True
    assert subscription not in list(host.subscriptions)


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


# Static endpoint discovery ------------------------------------------------------------------------

_GRAPH = ("ros_discovery_info", "rmw_dds_common::msg::dds_::ParticipantEntitiesInfo_")
_STRING = "std_msgs::msg::dds_::String_"


def static(name: str, first: int, *, writer: bool) -> StaticParticipant:
    own = StaticEndpoint(
        writer=writer, topic="rt/flow", type=_STRING, profile="/flow", user_id=first
    )
    graph = tuple(
        StaticEndpoint(
            writer=each,
            topic=_GRAPH[0],
            type=_GRAPH[1],
            profile=_GRAPH[0],
            user_id=first + 1 + index,
            transient_local=True,
        )
        for index, each in enumerate((True, False))
    )
    return StaticParticipant(name=name, endpoints=(own, *graph))


_SENDS = """
import sys, time
from std_msgs.msg import String
from lifecycle import codec
from lifecycle.manifest.qos import QosProfile
from lifecycle.middleware.fastdds.participant import FlowParticipant
from lifecycle.plan.model import ParticipantConnections

connections = codec.from_json(sys.argv[2].encode(), ParticipantConnections)
with FlowParticipant("_out", "/", int(sys.argv[1]), connections=connections) as sending:
    publisher = sending.create_publisher(String, "/flow", QosProfile())
    while True:
        publisher.publish(String(data=sys.argv[3]))
        time.sleep(0.05)
"""


_SEDP_WRITERS = (bytes.fromhex("000003c2"), bytes.fromhex("000004c2"))


@on_the_wire
def test_static_endpoints_find_each_other_without_being_announced(
    fresh_domain: int, spun: Node, wait_until: WaitUntil, ports: list[int]
) -> None:
    table = (static("/out", 1, writer=True), static("/in", 11, writer=False))
    one = fixed("udpv4", "127.0.0.1", ports[0:3], ports[4])
    other = ParticipantConnections(
        urls=(fixed("udpv4", "127.0.0.1", ports[3:6], ports[1]),),
        static_name="/out",
        static_participants=table,
    )
    command = [sys.executable, "-c", _SENDS, str(fresh_domain), codec.to_json(other).decode(), MARK]
    got: list[str] = []
    with (
        watching() as loopback,
        FlowParticipant(
            "_in",
            "/",
            fresh_domain,
            connections=ParticipantConnections(
                urls=(one,), static_name="/in", static_participants=table
            ),
            served=spun,
        ) as receiving,
        subprocess.Popen(command) as sending,
    ):
        try:
            receiving.create_subscription(String, "/flow", lambda m: got.append(m.data), QOS)
            wait_until(lambda: got)
        finally:
            sending.kill()
        assert set(got) == {MARK}
        mine = [each for each in loopback.until_now() if each.source in (ports[2], ports[5])]
        assert mine, "they announce themselves"
        assert not [each for each in mine if any(w in each.payload for w in _SEDP_WRITERS)]
        with pytest.raises(MiddlewareError, match="cannot make a writer of '/other'"):
            receiving.create_publisher(String, "/other", QOS)
        with pytest.raises(MiddlewareError, match="this process has it with id 12 already, not 2"):
            FlowParticipant("_out", "/", fresh_domain, connections=other)


# Discovery server ---------------------------------------------------------------------------------


@pytest.mark.parametrize("tcp", [True, False])
def test_clients_of_a_discovery_server_find_each_other_and_a_super_client_sees_them(
    fresh_domain: int, spun: Node, wait_until: WaitUntil, ports: list[int], tcp: bool
) -> None:
    server = PlannedServer(
        machine="",
        address="127.0.0.1",
        port=ports[7],
        tcp=tcp,
        prefix=parse(f"udpv4://127.0.0.1:7911?server=127.0.0.1:{ports[7]}").server_prefix,
    )
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
                _, endpoints = observer.snapshot(declared=("/_in", "/_out"))
                return {each.node for each in endpoints if each.name == "/flow"} == {
                    "/_in",
                    "/_out",
                }

            wait_until(seen)
    finally:
        process.terminate()
        assert process.wait(30) == 0


@pytest.mark.parametrize("how", ["shm", "peer"])
def test_an_observer_sees_by_url_what_is_there_before_it(
    fresh_domain: int, wait_until: WaitUntil, ports: list[int], how: str
) -> None:
    urls = ("shm://", "shm://")
    if how == "peer":
        urls = (
            fixed("udpv4", "127.0.0.1", ports[0:3], ports[4]),
            fixed("udpv4", "127.0.0.1", ports[3:6], ports[1]),
        )
    with FlowParticipant("_there", "/", fresh_domain, connections=connect(urls[0])) as there:
        there.create_publisher(String, "/flow", QOS)
        with GraphObserver(fresh_domain, connect(urls[1])) as observer:
            wait_until(
                lambda: [
                    e for e in observer.snapshot(declared=("/_there",))[1] if e.node == "/_there"
                ]
            )


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
