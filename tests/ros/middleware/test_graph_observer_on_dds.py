"""What the observer sees of a real graph, and how soon it is told of changes."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator

import psutil
import pytest
import rclpy
from managed_node import ManagedNode
from rcl_interfaces.srv import SetParameters
from rclpy.node import Node
from std_msgs.msg import String
from std_srvs.srv import Trigger

from lifecycle.manifest.model import EndpointKind
from lifecycle.manifest.qos import Durability, History, QosProfile, Reliability
from lifecycle.middleware.fastdds.participant import FlowParticipant, quiet_node
from lifecycle.middleware.rcl.conversions import to_rclpy
from lifecycle.middleware.rcl.graph import GraphObserver
from lifecycle.middleware.rcl.graph_queries import endpoints_of
from lifecycle.verify.observation import ObservedNode
from tests.ros.faults.system import BARE_DDS
from tests.ros.supervisor.running import ROOT
from tests.stalls import assert_in_time

SET_PARAMETERS = "rcl_interfaces/srv/SetParameters"
MakeNode = Callable[..., Node]
WaitUntil = Callable[..., None]


@pytest.fixture
def observer(domain_id: int) -> Iterator[GraphObserver]:
    with GraphObserver(domain_id) as observer:
        yield observer


@contextlib.contextmanager
def a_node(domain_id: int, name: str) -> Iterator[None]:
    """Have a node on a participant of its own, and none at the end."""
    context, node = quiet_node(name, "/", domain_id)
    try:
        yield
    finally:
        node.destroy_node()
        context.try_shutdown()
        context.destroy()


def nodes(observer: GraphObserver) -> dict[str, ObservedNode]:
    return {node.full_name: node for node in observer.snapshot()[0]}


def endpoints(observer: GraphObserver) -> list[tuple[EndpointKind, str, str, str]]:
    return [(each.kind, each.node, each.name, each.type) for each in observer.snapshot()[1]]


def test_an_empty_graph_has_neither_the_observer_nor_what_it_brings(
    observer: GraphObserver, wait_until: WaitUntil
) -> None:
    wait_until(lambda: observer.snapshot() == ((), ()))


def test_endpoints_show_with_node_type_and_qos_and_without_the_noise(
    observer: GraphObserver, make_node: MakeNode, wait_until: WaitUntil
) -> None:
    node = make_node("camera", namespace="/robot", enable_rosout=True)
    qos = QosProfile(
        depth=3,
        reliability=Reliability.BEST_EFFORT,
        durability=Durability.TRANSIENT_LOCAL,
        deadline_ns=100_000_000,
    )
    node.create_publisher(String, "video", to_rclpy(qos))
    node.create_subscription(String, "/cmd", lambda _: None, 10)
    node.create_service(Trigger, "~/reset", lambda _, response: response)
    node.create_client(Trigger, "/dock")
    expected = [
        (EndpointKind.PUBLISHER, "/robot/camera", "/robot/video", "std_msgs/msg/String"),
        (EndpointKind.SERVICE_CLIENT, "/robot/camera", "/dock", "std_srvs/srv/Trigger"),
        (
            EndpointKind.SERVICE_SERVER,
            "/robot/camera",
            "/robot/camera/reset",
            "std_srvs/srv/Trigger",
        ),
        (EndpointKind.SUBSCRIPTION, "/robot/camera", "/cmd", "std_msgs/msg/String"),
    ]
    wait_until(lambda: endpoints(observer) == expected)
    publisher = observer.snapshot()[1][0]
    # Fast DDS does not announce history and depth.
    assert publisher.qos == QosProfile(
        history=History.UNKNOWN,
        depth=0,
        reliability=Reliability.BEST_EFFORT,
        durability=Durability.TRANSIENT_LOCAL,
        deadline_ns=100_000_000,
    )
    assert len(bytes.fromhex(publisher.gid)) == 16


def test_what_is_made_anew_under_one_name_and_type_is_shown_as_it_is(
    observer: GraphObserver, make_node: MakeNode, wait_until: WaitUntil
) -> None:
    camera, viewer = make_node("camera"), make_node("viewer")
    camera.create_publisher(String, "/still", 10)
    camera.create_service(Trigger, "~/reset", lambda _, response: response)
    first = viewer.create_publisher(String, "/video", 10)

    def shown(node: str) -> dict[tuple[EndpointKind, str], object]:
        found = observer.snapshot()[1]
        return {(each.kind, each.name): each for each in found if each.node == node}

    wait_until(lambda: (len(shown("/camera")), len(shown("/viewer"))) == (2, 1))
    wait_until(lambda: all(each.managed is False for each in nodes(observer).values()))
    before, of_camera, of_viewer = nodes(observer), shown("/camera"), shown("/viewer")
    # Made anew at once, with the name and type it had: no count differs, but its QoS does.
    viewer.destroy_publisher(first)
    viewer.create_publisher(String, "/video", to_rclpy(QosProfile(depth=1)))
    viewer.create_publisher(
        String, "/video", to_rclpy(QosProfile(depth=1, reliability=Reliability.BEST_EFFORT))
    )
    reliabilities = {Reliability.RELIABLE, Reliability.BEST_EFFORT}
    wait_until(
        lambda: (
            {each.qos.reliability for each in observer.snapshot()[1] if each.name == "/video"}
            == reliabilities
        )
    )
    assert of_viewer[EndpointKind.PUBLISHER, "/video"] not in observer.snapshot()[1]
    assert shown("/camera") == of_camera
    assert nodes(observer) == before


def named(observer: GraphObserver, name: str) -> int:
    """How many nodes of a name the RMW has."""
    return observer.node.get_node_names().count(name)


def homes(observer: GraphObserver) -> list[str]:
    """Participants that have a node `/twin`, by what they publish."""
    events = endpoints_of(observer.node, EndpointKind.PUBLISHER, "/parameter_events")
    return [each.gid[:24] for each in events if each.node == "/twin"]


def home_of_one_that_left(observer: GraphObserver, domain_id: int, wait_until: WaitUntil) -> str:
    """Return the participant of a `/twin` that came and has left."""
    with a_node(domain_id, "twin"):
        wait_until(lambda: homes(observer))
        gone = homes(observer)[0]
        wait_until(lambda: "/twin" in nodes(observer))
    wait_until(lambda: "/twin" not in nodes(observer))
    return gone


@contextlib.contextmanager
def a_ghost(domain_id: int, participant: str, name: str) -> Iterator[None]:
    """Have another process say that a participant that has left still has a node."""
    claim = [
        *(sys.executable, BARE_DDS, "--write", "rt/said:std_msgs::msg::dds_::String_"),
        *("--node", "/", "bare", "--ghost", participant, "/", name),
    ]
    environment = {**os.environ, "ROS_DOMAIN_ID": str(domain_id)}
    with subprocess.Popen(claim, cwd=ROOT, env=environment) as claims:
        try:
            yield
        finally:
            claims.terminate()


def test_a_ghost_is_not_counted_beside_participants_of_connections(
    observer: GraphObserver, domain_id: int, wait_until: WaitUntil
) -> None:
    """rmw_dds_common keeps the names of a participant that is heard once more after it has left."""
    gone = home_of_one_that_left(observer, domain_id, wait_until)
    with (
        FlowParticipant("_twin_flow_0", "/", domain_id) as participant,
        a_node(domain_id, "twin"),
        a_ghost(domain_id, gone, "twin"),
    ):
        participant.create_publisher(String, "/video", QosProfile())
        wait_until(lambda: homes(observer))
        assert homes(observer)[0] != gone
        wait_until(lambda: named(observer, "twin") == 2)
        wait_until(lambda: "/bare" in nodes(observer) and nodes(observer)["/twin"].count == 1)
        assert named(observer, "twin") == 2


def test_a_name_without_any_endpoint_is_nobody(
    observer: GraphObserver, domain_id: int, wait_until: WaitUntil
) -> None:
    wait_until(lambda: observer.prefix)
    gone = observer.prefix[:8] + "ffff" + "00000001" + "0000"
    with a_ghost(domain_id, gone, "brief"):
        wait_until(lambda: named(observer, "brief") and "/bare" in nodes(observer))
        assert "/brief" not in nodes(observer)


def test_a_node_that_comes_again_beside_a_ghost_of_its_name_has_its_own_services(
    observer: GraphObserver, context: rclpy.Context, domain_id: int, wait_until: WaitUntil
) -> None:
    gone = home_of_one_that_left(observer, domain_id, wait_until)
    with a_ghost(domain_id, gone, "twin"):
        wait_until(lambda: named(observer, "twin") == 1)
        node = ManagedNode("twin", context=context)
        try:
            wait_until(lambda: named(observer, "twin") == 2)
            alone = ObservedNode(full_name="/twin", count=1, managed=True)
            wait_until(lambda: nodes(observer).get("/twin") == alone)
        finally:
            node.destroy_node()


def test_of_a_node_that_leaves_the_services_of_the_node_interface_stay_its_own(
    observer: GraphObserver, make_node: MakeNode, wait_until: WaitUntil
) -> None:
    """It is known as ours by two of them, which may leave first."""
    node, another = make_node("leaving"), make_node("another")
    known_by = node.create_service(Trigger, "~/get_configuration", lambda _, reply: reply)
    for name in ("map_to", "remap"):
        node.create_service(SetParameters, f"~/{name}", lambda _, reply: reply)
    another.create_service(SetParameters, "~/remap", lambda _, reply: reply)
    remap = (EndpointKind.SERVICE_SERVER, "/another", "/another/remap", SET_PARAMETERS)
    wait_until(lambda: endpoints(observer) == [remap])

    node.destroy_service(known_by)
    node.create_publisher(String, "last", 10)
    last = (EndpointKind.PUBLISHER, "/leaving", "/last", "std_msgs/msg/String")
    wait_until(lambda: last in endpoints(observer))
    wait_until(lambda: "/leaving/get_configuration" not in observer.services_of("/leaving"))
    assert sorted(endpoints(observer), key=lambda each: each[1]) == [remap, last]


def test_the_guard_wakes_for_a_new_publisher_and_again_when_it_goes(
    observer: GraphObserver, make_node: MakeNode, wait_until: WaitUntil
) -> None:
    node = make_node("talker")
    wait_until(lambda: "/talker" in nodes(observer))
    shown: list[bool] = []
    woken = threading.Condition()

    def look() -> None:
        with woken:
            shown.append("/new" in {each[2] for each in endpoints(observer)})
            woken.notify()

    remove = observer.on_change(look)

    def late_s() -> float:
        shown.clear()
        began = time.monotonic()
        publisher = node.create_publisher(String, "/new", 10)
        with woken:
            assert woken.wait_for(lambda: True in shown, timeout=30)
        taken_s = time.monotonic() - began
        node.destroy_publisher(publisher)
        with woken:
            assert woken.wait_for(lambda: shown[-1] is False, timeout=30)
        return taken_s - 2.0  # Fast DDS repeats what was lost only after 3 s

    assert_in_time(late_s)

    remove()
    seen_by_another: list[set[str]] = []
    observer.on_change(lambda: seen_by_another.append({each[2] for each in endpoints(observer)}))
    # Told of the first, the one that was taken away is called no more: it may have been just then.
    node.create_publisher(String, "/newer", 10)
    wait_until(lambda: seen_by_another and "/newer" in seen_by_another[-1])
    looks = len(shown)
    node.create_publisher(String, "/newest", 10)
    wait_until(lambda: "/newest" in seen_by_another[-1])
    assert len(shown) == looks


def test_an_exception_of_a_callback_is_logged_and_ends_nothing(
    observer: GraphObserver,
    make_node: MakeNode,
    wait_until: WaitUntil,
    caplog: pytest.LogCaptureFixture,
) -> None:
    def breaks() -> None:
        raise ValueError("broken")

    observer.on_change(breaks)
    make_node("one")
    wait_until(lambda: "cannot handle a graph change" in caplog.text)
    wait_until(lambda: "/one" in nodes(observer))


def test_a_snapshot_of_ten_nodes_is_quick(
    observer: GraphObserver, context: rclpy.Context, wait_until: WaitUntil
) -> None:
    made = [ManagedNode(f"node{number}", context=context) for number in range(10)]
    for node in made:
        for topic in "abcd":
            node.create_publisher(String, f"/{topic}", 10)
            node.create_subscription(String, f"/{topic}", lambda _: None, 10)
    wait_until(lambda: len(endpoints(observer)) == 80)
    took_s = []
    for _ in range(10):
        began = time.thread_time()  # while others run, nothing is taken
        observer.snapshot()
        took_s.append(time.thread_time() - began)
    assert min(took_s) < 0.05  # 5 ms where nothing else runs
    for node in made:
        node.destroy_node()


def test_watching_a_still_graph_costs_nothing(
    observer: GraphObserver, make_node: MakeNode, wait_until: WaitUntil
) -> None:
    make_node("still")
    wait_until(lambda: "/still" in nodes(observer))
    calls: list[None] = []
    observer.on_change(lambda: calls.append(None))
    thread = next(each for each in threading.enumerate() if each.name == "graph-guard")

    def used_s() -> float:
        return sum(
            each.user_time + each.system_time
            for each in psutil.Process().threads()
            if each.id == thread.native_id
        )

    def still_and_idle() -> bool:
        calls.clear()
        before = used_s()
        time.sleep(0.3)  # a span to measure, not a wait
        return not calls and used_s() == before

    wait_until(still_and_idle)


def test_destroying_twice_is_harmless(domain_id: int) -> None:
    observer = GraphObserver(domain_id)
    observer.destroy()
    observer.destroy()
    assert not [each for each in threading.enumerate() if each.name == "graph-guard"]
