"""An observer discovers existing participants in time, also where none can be probed.

And it has the transports that somebody chose.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from lifecycle.middleware.fastdds.discovery import chosen_otherwise
from tests.ros.middleware.free_ports import free_ports

pytestmark = pytest.mark.thorough

_LIMIT_S = 60.0
_OBSERVERS = 3
"""Before, each missed it in two of five tries."""

_EXISTING = """
import sys
import rclpy
from std_msgs.msg import String

rclpy.init(domain_id=int(sys.argv[1]))
node = rclpy.create_node("existing")
publisher = node.create_publisher(String, "words", 1)
print("there", flush=True)
sys.stdin.read()
node.destroy_node()
rclpy.shutdown()
"""

_OBSERVES = """
import json
import sys
import time
from lifecycle.middleware.rcl.graph import GraphObserver

found = []
for _ in range(int(sys.argv[2])):
    with GraphObserver(int(sys.argv[1])) as observer:
        while True:
            endpoints = {(each.node, each.name) for each in observer.snapshot()[1]}
            if (left_s := observer.settling.left_s()) <= 0:
                break
            time.sleep(min(left_s, 0.01))
        found.append(("/existing", "/words") in endpoints)
print(json.dumps(found))
"""


def _one_transport(description: str) -> str:
    return f"""
        <transport_descriptors><transport_descriptor>
          <transport_id>mine</transport_id>{description}
        </transport_descriptor></transport_descriptors>
        <participant profile_name="mine" is_default_profile="true"><rtps>
          <userTransports><transport_id>mine</transport_id></userTransports>
          <useBuiltinTransports>false</useBuiltinTransports>
        </rtps></participant>"""


_PROFILES = {
    "shared memory": _one_transport("<type>SHM</type>"),
    "one interface": _one_transport(
        "<type>UDPv4</type><interfaceWhiteList><address>127.0.0.1</address></interfaceWhiteList>"
    ),
    "no multicast": """
        <participant profile_name="mine" is_default_profile="true"><rtps><builtin>
          <avoid_builtin_multicast>true</avoid_builtin_multicast>
        </builtin></rtps></participant>""",
    "other ports": """
        <participant profile_name="mine" is_default_profile="true"><rtps>
          <port><portBase>7600</portBase></port>
        </rtps></participant>""",
}


@contextlib.contextmanager
def an_existing_node(domain_id: int) -> Iterator[None]:
    with subprocess.Popen(
        [sys.executable, "-c", _EXISTING, str(domain_id)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as process:
        try:
            assert process.stdout is not None
            assert process.stdout.readline() == "there\n"
            yield
        finally:
            process.communicate(timeout=_LIMIT_S)  # one that is killed leaves its shared memory


def use_profile(profile: str, directory: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Have all participants that are made from now on have this default profile."""
    file = directory / "mine.xml"
    namespace = "http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles"
    file.write_text(f'<dds xmlns="{namespace}"><profiles>{profile}</profiles></dds>')
    monkeypatch.setenv("FASTRTPS_DEFAULT_PROFILES_FILE", str(file))


def seen(domain_id: int) -> list[bool]:
    """Return whether each of several observers saw that node before it said that it sees all."""
    done = subprocess.run(
        [sys.executable, "-c", _OBSERVES, str(domain_id), str(_OBSERVERS)],
        capture_output=True,
        text=True,
        timeout=_LIMIT_S,
        check=True,
    )
    return list(map(bool, json.loads(done.stdout.splitlines()[-1])))


@pytest.mark.parametrize("profile", list(_PROFILES))
def test_with_a_profile_that_says_how_others_are_found(
    fresh_domain: int, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, profile: str
) -> None:
    use_profile(_PROFILES[profile], tmp_path, monkeypatch)
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    assert chosen_otherwise(os.environ)
    with an_existing_node(fresh_domain):
        assert seen(fresh_domain) == [True] * _OBSERVERS


@pytest.mark.parametrize("transports", ["SHM", "LARGE_DATA"])
def test_with_transports_that_the_environment_chooses(
    fresh_domain: int, monkeypatch: pytest.MonkeyPatch, transports: str
) -> None:
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "SUBNET")
    monkeypatch.setenv("FASTDDS_BUILTIN_TRANSPORTS", transports)
    with an_existing_node(fresh_domain):
        assert seen(fresh_domain) == [True] * _OBSERVERS


@contextlib.contextmanager
def a_discovery_server(port: int) -> Iterator[None]:
    """Run Fast DDS's own, which is part of the wheels."""
    program = Path(sys.executable).with_name("fast-discovery-server")
    libraries = {each.parent for each in Path(sys.prefix).rglob("libfastrtps.so.2.14")}
    libraries |= {each.parent for each in Path(sys.prefix).rglob("libtinyxml2*")}
    with subprocess.Popen(
        [str(program), "-i", "0", "-l", "127.0.0.1", "-p", str(port)],
        env={**os.environ, "LD_LIBRARY_PATH": ":".join(map(str, libraries))},
        stdout=subprocess.PIPE,
        text=True,
    ) as process:
        try:
            assert process.stdout is not None
            assert "Server is running" in process.stdout.readline()
            yield
        finally:
            process.send_signal(signal.SIGINT)
            process.communicate(timeout=_LIMIT_S)


def test_with_a_discovery_server_that_the_environment_names(
    fresh_domain: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    (port,) = free_ports(1)
    with a_discovery_server(port):
        monkeypatch.setenv("ROS_DISCOVERY_SERVER", f"127.0.0.1:{port}")
        monkeypatch.delenv("ROS_SUPER_CLIENT", raising=False)
        with an_existing_node(fresh_domain):
            assert seen(fresh_domain) == [True] * _OBSERVERS


_CLIENT = """
    <participant profile_name="mine" is_default_profile="true"><rtps><builtin><discovery_config>
      <discoveryProtocol>CLIENT</discoveryProtocol>
      <discoveryServersList><RemoteServer prefix="44.53.00.5f.45.50.52.4f.53.49.4d.41">
        <metatrafficUnicastLocatorList><locator><udpv4>
          <address>127.0.0.1</address><port>{port}</port>
        </udpv4></locator></metatrafficUnicastLocatorList>
      </RemoteServer></discoveryServersList>
    </discovery_config></builtin></rtps></participant>"""


def test_with_a_discovery_server_that_a_profile_names(
    fresh_domain: int, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (port,) = free_ports(1)
    with a_discovery_server(port):
        use_profile(_CLIENT.format(port=port), tmp_path, monkeypatch)
        with an_existing_node(fresh_domain):
            assert seen(fresh_domain) == [True] * _OBSERVERS


_HAS_SHARED_MEMORY = """
import sys
from lifecycle.middleware.rcl.graph import GraphObserver
from lifecycle.middleware.process.shared_memory import own_segments

with GraphObserver(int(sys.argv[1])):
    print(bool(own_segments()))
"""


@pytest.mark.parametrize(
    ("range_", "transports", "profile", "expected"),
    [
        ("SUBNET", "", "", "False"),
        ("LOCALHOST", "", "", "False"),
        ("SUBNET", "DEFAULT", "", "True"),
        ("SUBNET", "", "shared memory", "True"),
    ],
)
def test_an_observer_has_shared_memory_only_if_the_environment_or_a_profile_chose_it(
    fresh_domain: int,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    range_: str,
    transports: str,
    profile: str,
    expected: str,
) -> None:
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", range_)
    monkeypatch.delenv("FASTDDS_BUILTIN_TRANSPORTS", raising=False)
    if transports:
        monkeypatch.setenv("FASTDDS_BUILTIN_TRANSPORTS", transports)
    if profile:
        use_profile(_PROFILES[profile], tmp_path, monkeypatch)
    command = [sys.executable, "-c", _HAS_SHARED_MEMORY, str(fresh_domain)]
    assert subprocess.check_output(command, text=True, timeout=_LIMIT_S).split()[-1] == expected
