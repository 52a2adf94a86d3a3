"""The transports of nodes and of their flows: as planned, as made, and as reported."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import rclpy
from host_process import HostProcess, driver_in, hosted
from lifecycle_driver import Driver
from planning import built_with, planned, publisher, subscription
from std_msgs.msg import String

from lifecycle import LifecycleNode, codec
from lifecycle.middleware.fastdds.nfe import senders_of
from lifecycle.middleware.fastdds.profiles import discovery_environment
from lifecycle.middleware.fastdds.sockets import own_sockets
from lifecycle.network.nfe import NetworkFlowEndpoint, UniqueRequirement, is_ip
from lifecycle.node.host.control import Event, Operation
from lifecycle.plan.model import PlannedParticipant
from lifecycle.verify.observation import EndpointReport, NodeConfiguration

Start = Callable[..., HostProcess]
UDP = ("udpv4",)
DEFAULT = UniqueRequirement.SYSTEM_DEFAULT
UNIQUE_PORTS = range(7000, 7400)


class It(LifecycleNode):
    """Publishes."""


def has_shared_memory(nfes: tuple[NetworkFlowEndpoint, ...] | None) -> bool:
    assert nfes
    return not all(is_ip(each) for each in nfes)


def ports(report: EndpointReport) -> set[int]:
    assert report.nfes
    return {each.transport_port for each in report.nfes if is_ip(each)}


def connect(host: HostProcess, node: str) -> dict[str, EndpointReport]:
    assert host.do(node, Operation.CONFIGURE).ok
    connected = host.do(node, Operation.CONNECT)
    assert connected.ok, connected.error
    assert connected.configuration is not None
    return {each.name: each for each in connected.configuration.endpoints}


def test_a_flow_that_needs_the_network_has_no_shared_memory_and_its_node_has(
    driver: Driver, context: rclpy.Context
) -> None:
    flow = PlannedParticipant(
        name="_it_flow_0",
        dscp=46,
        reason="publisher video",
        transports=UDP,
        max_datagram_bytes=1400,
        non_blocking_send=True,
    )
    spec = planned(
        "it", publisher("video", participant=flow.name), publisher("map"), participants=(flow,)
    )
    with built_with(spec, context):
        node = It()
    driver.add(node)
    assert driver.set("/it", "configure")
    assert driver.set("/it", "connect")
    configuration = codec.from_json(driver.configuration("/it"), NodeConfiguration)
    video, map_ = configuration.endpoints
    assert (video.error, video.dscp) == ("", 46)
    assert (has_shared_memory(video.nfes), has_shared_memory(map_.nfes)) == (False, True)
    assert {"shm", "tcpv4", "udpm", "udpv4"} <= set(configuration.transports)
    made = next(e for e in node.lifecycle.data_layer.endpoints.values() if e.name == "video")
    assert made.connection is not None
    assert made.connection.participant is not None
    sockets = own_sockets(senders_of(made.connection.participant.node))
    assert not any(os.get_blocking(each.fileno()) for each in sockets)


def test_nodes_of_one_process_share_a_participant_exactly_if_their_transports_are_equal(
    start: Start, fresh_domain: int
) -> None:
    endpoints = (subscription("in"), publisher("out"))
    host = start(
        hosted("one", "Echo", *endpoints, transports=UDP),
        hosted("two", "Echo", *endpoints),
        hosted("three", "Echo", *endpoints, transports=UDP),
    )
    host.until("ready")
    names = ("one", "two", "three")
    reports = {name: connect(host, f"/{name}") for name in names}
    shared = [has_shared_memory(reports[name][end].nfes) for name in names for end in ("in", "out")]
    assert shared == [False, False, True, True, False, False]
    one, two, three = (reports[name]["in"].gid[:24] for name in names)
    assert one == three != two
    # All are spun by the one executor, and their lifecycle services answer.
    with driver_in(fresh_domain) as driver:
        got: list[str] = []
        driver.node.create_subscription(String, "/out", lambda m: got.append(m.data), 10)
        sender = driver.node.create_publisher(String, "/in", 10)
        for name in names:
            # Whom its supervisor has let through others may deactivate and activate again.
            assert host.do(f"/{name}", Operation.ACTIVATE).ok
            assert driver.set(f"/{name}", "deactivate")
            assert driver.set(f"/{name}", "activate")
        driver.spin_until(lambda: sender.get_subscription_count() == 3)
        driver.spin_until(lambda: driver.node.count_publishers("/out") == 3)
        sender.publish(String(data="hello"))
        driver.spin_until(lambda: len(got) == 3)
    host.hang_up()
    assert host.wait() == 0


def test_a_plain_node_gets_its_transports_too(start: Start, fresh_domain: int) -> None:
    host = start(hosted("one", "Plain", managed=False, transports=("udpv6",)))
    host.until("ready")
    with driver_in(fresh_domain) as driver:
        # Participants without IPv6, such as the driver's, cannot meet it.
        driver.settle()
        assert "one" not in driver.node.get_node_names()
    maps = Path(f"/proc/{host.process.pid}/maps").read_text()
    assert "/dev/shm/fastrtps" not in maps
    host.hang_up()
    assert host.wait() == 0


_ALONE = """
import sys
from tests.ros.node.planning import planned
from lifecycle import LifecycleNode, run
from lifecycle.middleware.fastdds.factory import has_shared_memory

class It(LifecycleNode):
    def on_configure(self):
        print("shared memory:", has_shared_memory(self), flush=True)

run(It, lifecycle="auto", spec=planned("it", transports=tuple(sys.argv[1:])))
"""


@pytest.mark.parametrize(("transports", "expected"), [((), "True"), (UDP, "False")])
def test_a_node_in_a_terminal_has_the_transports_of_its_plan(
    fresh_domain: int, transports: tuple[str, ...], expected: str
) -> None:
    with subprocess.Popen(
        [sys.executable, "-c", _ALONE, *transports],
        cwd=Path(__file__).parents[3],
        stdout=subprocess.PIPE,
        text=True,
    ) as process:
        assert process.stdout is not None
        line = next(each for each in process.stdout if not each.startswith("/it: "))
        process.terminate()
        assert process.wait(30) == 0
    assert line == f"shared memory: {expected}\n"


def test_a_unique_subscription_takes_another_port_each_time_it_is_connected(start: Start) -> None:
    """Fast DDS 2.14 keeps the old one until the participant ends, which is with the process."""
    host = start(
        hosted(
            "one",
            "Echo",
            subscription("in", unique=UniqueRequirement.STRICTLY_REQUIRED),
            publisher("out"),
        )
    )
    host.until("ready")
    taken = [ports(connect(host, "/one")["in"])]
    for _ in range(2):
        assert host.do("/one", Operation.DISCONNECT).ok
        connected = host.do("/one", Operation.CONNECT)
        assert connected.configuration is not None
        taken.append(ports(connected.configuration.endpoints[0]))
    assert len(set.union(*taken)) == 3
    assert set.union(*taken) <= bound_ports()
    host.hang_up()
    assert host.wait() == 0


def bound_ports() -> set[int]:
    lines = Path("/proc/net/udp").read_text().splitlines()[1:]
    return {int(line.split()[1].rpartition(":")[2], 16) for line in lines}


def test_transports_that_cannot_be_had_end_the_process_with_the_reason(
    start: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    profiles = tmp_path / "mine.xml"
    profiles.write_text(
        '<profiles><participant profile_name="mine" is_default_profile="true"><rtps>'
        "<builtinTransports>UDPv4</builtinTransports></rtps></participant></profiles>"
    )
    monkeypatch.setenv("FASTRTPS_DEFAULT_PROFILES_FILE", str(profiles))
    host = start(hosted("one", "Good", transports=UDP))
    assert host.read() == Event(
        kind="failed",
        node="/one",
        ok=False,
        error=(
            "cannot give a participant udpv4: the default participant profile 'mine' of "
            f"'{profiles}' already chooses its transports (<builtinTransports>); take "
            "<builtinTransports> out of it, or what needs udpv4 out of the manifest"
        ),
    )
    assert host.wait() == 1


# The article's SYSTEM_DEFAULT: "the middleware configures unique flows by other means", here a
# profile that the user side-loads, named by the topic.
_SIDE_LOADED = """
<dds xmlns="http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles"><profiles>
  <data_reader profile_name="/in"><propertiesPolicy><properties><property>
    <name>fastdds.unique_network_flows</name><value>true</value>
  </property></properties></propertiesPolicy></data_reader>
</profiles></dds>
"""


def test_system_default_leaves_it_to_the_users_profile_and_reports_what_came_of_it(
    start: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    profiles = tmp_path / "side_loaded.xml"
    profiles.write_text(_SIDE_LOADED)
    monkeypatch.setenv("FASTRTPS_DEFAULT_PROFILES_FILE", str(profiles))
    # What a supervisor does to its processes' environment: nothing, given a profile of the user's.
    for name, value in discovery_environment(tmp_path).items():
        monkeypatch.setenv(name, value)
    assert os.environ["FASTRTPS_DEFAULT_PROFILES_FILE"] == str(profiles)
    host = start(
        hosted("one", "Echo", subscription("in", unique=DEFAULT), publisher("out")),
        hosted("two", "Echo", subscription("in", unique=DEFAULT), publisher("out"), transports=UDP),
    )
    host.until("ready")
    one, two = (connect(host, name)["in"] for name in ("/one", "/two"))
    assert (one.unique, two.unique) == (DEFAULT, DEFAULT)
    assert ports(one) | ports(two) <= set(UNIQUE_PORTS)
    assert not ports(one) & ports(two)


def test_system_default_without_a_profile_comes_to_nothing_and_is_reported_so(
    start: Start,
) -> None:
    host = start(
        hosted("one", "Echo", subscription("in", unique=DEFAULT), publisher("out")),
        hosted("two", "Echo", subscription("in", unique=DEFAULT), publisher("out")),
    )
    host.until("ready")
    one, two = (connect(host, name)["in"] for name in ("/one", "/two"))
    assert (one.unique, one.error) == (DEFAULT, "")
    assert ports(one) == ports(two)
    assert not ports(one) & set(UNIQUE_PORTS)
