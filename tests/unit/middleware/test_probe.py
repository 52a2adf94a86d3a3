"""Whom an observer asks, from what its connection URLs say, and who answers."""

from __future__ import annotations

import contextlib
import socket
import struct
from collections.abc import Iterator
from pathlib import Path

import pytest

from lifecycle.middleware.discovery import probe as probing
from lifecycle.middleware.discovery.messages import announcement, disposal, new_prefix
from lifecycle.middleware.discovery.probe import (
    Probe,
    ProbeTarget,
    answered_at,
    chosen_otherwise,
    connects_first,
    dispose_of_announced,
    is_served,
    missing_port,
    probes_for,
)
from lifecycle.network.connection_url import parse
from lifecycle.network.ports import participant_ports
from lifecycle.pytest_plugin import claimed_domain
from tests.unit.middleware.other_process import of_another_process

_WAIT_S = 5.0
_PREFIX = bytes(range(12))
_ANSWER = b"RTPS\x02\x03\x01\x0f" + _PREFIX + b"more"
_METATRAFFIC_UNICAST = 0x0032


@pytest.fixture(params=["127.0.0.1", "::1"])
def peer(request: pytest.FixtureRequest) -> Iterator[socket.socket]:
    """A socket where another participant's discovery would listen."""
    family = socket.AF_INET6 if ":" in request.param else socket.AF_INET
    with socket.socket(family, socket.SOCK_DGRAM) as found:
        found.settimeout(_WAIT_S)
        found.bind((request.param, 0))
        yield found


def url_for(peer: socket.socket) -> tuple[str, str]:
    """Return a URL that looks for `peer` alone, and its address."""
    address, port = peer.getsockname()[:2]
    host, kind = (f"[{address}]", "udpv6") if ":" in address else (address, "udpv4")
    return f"{kind}://{host}:7911?metatraffic_port=7910&peer={host}:{port}&multicast=off", address


def locators(message: bytes, address: str) -> set[int]:
    """Return the ports at which an announcement wants to be answered at `address`."""
    packed = socket.inet_pton(socket.AF_INET6 if ":" in address else socket.AF_INET, address)
    kind = 2 if ":" in address else 1
    head = struct.pack("<HHi", _METATRAFFIC_UNICAST, 24, kind)
    ports, at = set(), message.find(head)
    while at >= 0:
        (port,) = struct.unpack_from("<I", message, at + len(head))
        if message[at + len(head) + 4 :][:16] == packed.rjust(16, b"\0"):
            ports.add(port)
        at = message.find(head, at + 1)
    return ports


def test_a_listed_peer_is_asked_to_answer_the_observer_and_is_counted(peer: socket.socket) -> None:
    url, address = url_for(peer)
    (probe,) = probes_for(25, (parse(url),), {})
    try:
        message, (_, asked_from, *_) = peer.recvfrom(65536)
        assert locators(message, address) == {7910, asked_from}
        assert probe.answered() == frozenset()
        peer.sendto(_ANSWER, (address, asked_from))
        assert probe.answered() == {_PREFIX.hex()}
    finally:
        probe.close()


def test_what_introduces_others_to_each_other_is_no_participant_that_answers(
    peer: socket.socket,
) -> None:
    url, address = url_for(peer)
    (probe,) = probes_for(25, (parse(url),), {})
    try:
        called, (_, asked_from, *_) = peer.recvfrom(65536)
        another = (announcement(new_prefix(), at, 0.5) for at in ([(address, 7910)], ()))
        left = disposal(called[8:20].hex())
        for message in (called, *another, left, _ANSWER):
            peer.sendto(message, (address, asked_from))
        assert probe.answered() == {_PREFIX.hex()}
    finally:
        probe.close()


@pytest.mark.parametrize("at_the_end", [False, True])
def test_who_was_announced_and_does_not_exist_is_soon_said_to_have_left(
    peer: socket.socket, monkeypatch: pytest.MonkeyPatch, *, at_the_end: bool
) -> None:
    """Not by its lease: each look at one is an occasion for Fast DDS's deadlock."""
    monkeypatch.setattr(probing, "_DISPOSED_S", 60.0 if at_the_end else 0.05)
    url, _ = url_for(peer)
    for each in probes_for(25, (parse(url),), {}):
        each.close()
    if at_the_end:
        dispose_of_announced()
    came, left = peer.recv(65536), peer.recv(65536)
    assert lease_s(came) == 10.0
    expected = disposal(came[8:20].hex())
    assert (left[:24], left[32:]) == (expected[:24], expected[32:])  # but for the time between
    dispose_of_announced()
    peer.setblocking(False)
    with pytest.raises(BlockingIOError):
        peer.recv(65536)


def lease_s(message: bytes) -> float:
    at = message.index(struct.pack("<HH", 0x0002, 8)) + 4
    seconds, rest = struct.unpack_from("<iI", message, at)
    return float(seconds + rest / 2**32)


@pytest.mark.parametrize(
    ("range_", "everybody"),
    [
        ("", (("239.255.0.1", 13650),)),
        ("LOCALHOST", tuple(("127.0.0.1", 13660 + 2 * each) for each in range(32))),
        ("OFF", ()),
    ],
)
def test_our_own_participant_is_to_answer_where_all_of_this_host_hear_it(
    range_: str, everybody: tuple[tuple[str, int], ...]
) -> None:
    found = answered_at(25, (), {"ROS_AUTOMATIC_DISCOVERY_RANGE": range_})
    assert found == everybody
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as ours:
        ours.settimeout(_WAIT_S)
        ours.bind(("127.0.0.1", 0))
        probe = Probe((), ("127.0.0.1",), (ours.getsockname()[1],))
        try:
            probe.announce_ourselves(found)
        finally:
            probe.close()
        message = ours.recv(65536)
    for address, port in everybody:
        assert port in locators(message, address)


@pytest.mark.parametrize(
    ("url", "environment"),
    [("udpv4://127.0.0.1:7911?metatraffic_port=7910", {}), ("", {"ROS_DISCOVERY_SERVER": "x"})],
)
def test_where_participants_are_told_whom_to_look_for_ours_announces_itself_by_itself(
    url: str, environment: dict[str, str]
) -> None:
    assert answered_at(25, (parse(url),) if url else (), environment) == ()


_SUBNET = {"ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET"}


@pytest.mark.parametrize(
    ("url", "environment", "misses"),
    [
        ("", _SUBNET, True),
        ("", {}, True),
        ("", {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}, False),
        ("", {"ROS_AUTOMATIC_DISCOVERY_RANGE": "OFF"}, False),
        ("", {**_SUBNET, "ROS_STATIC_PEERS": "127.0.0.1"}, False),
        ("", {**_SUBNET, "ROS_DISCOVERY_SERVER": "127.0.0.1"}, False),
        ("udpv4://127.0.0.1:7911?metatraffic_port=7910", _SUBNET, False),
    ],
)
def test_the_port_of_multicast_is_missing_where_only_another_process_has_it(
    url: str, environment: dict[str, str], *, misses: bool
) -> None:
    urls = (parse(url),) if url else ()
    with claimed_domain() as domain, contextlib.ExitStack() as stack:
        port = participant_ports(domain, 0).discovery_multicast
        assert missing_port(domain, urls, environment) is None
        stack.enter_context(of_another_process(_sharing(port)))
        assert missing_port(domain, urls, environment) == (port if misses else None)
        stack.enter_context(_sharing(port))
        assert missing_port(domain, urls, environment) is None


def _sharing(port: int) -> socket.socket:
    """Return a socket at a port that others may have, too, as Fast DDS has it for multicast."""
    shared = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    shared.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    shared.bind(("", port))
    return shared


def test_who_is_not_listed_is_not_asked(peer: socket.socket) -> None:
    url, _ = url_for(peer)
    without = url.partition("&peer=")[0] + "&multicast=off"
    for probe in probes_for(25, (parse(without),), {}):
        probe.close()
    for probe in probes_for(25, (parse(url),), {}):
        probe.close()
    peer.recv(65536)
    peer.setblocking(False)
    with pytest.raises(BlockingIOError):
        peer.recv(65536)


@pytest.mark.parametrize(
    "url",
    [
        "shm://",
        "tcpv4://127.0.0.1:5100?peer=127.0.0.1:5101",
        "udpv4://127.0.0.1:7911?server=127.0.0.1:11811",
    ],
)
def test_over_shared_memory_and_tcp_and_behind_a_server_nobody_can_be_asked(url: str) -> None:
    assert probes_for(25, (parse(url),), {}) == ()


@pytest.mark.parametrize(
    "environment",
    [
        {"ROS_DISCOVERY_SERVER": "127.0.0.1:11811"},
        {"FASTDDS_BUILTIN_TRANSPORTS": "SHM"},
        {"FASTDDS_BUILTIN_TRANSPORTS": "TCPv4"},
    ],
)
def test_where_the_user_chose_how_others_are_found_nobody_is_asked(
    environment: dict[str, str],
) -> None:
    assert chosen_otherwise(environment)
    assert probes_for(25, (), environment) == ()


@pytest.mark.parametrize(
    ("element", "chosen"),
    [
        ("<builtin><avoid_builtin_multicast>true</avoid_builtin_multicast></builtin>", True),
        ("<useBuiltinTransports>false</useBuiltinTransports><userTransports/>", True),
        ("<port><domainIDGain>200</domainIDGain></port>", True),
        ("<port><portBase>7600</portBase></port>", True),
        ("<port><offsetd0>4</offsetd0></port>", True),
        ("<sendSocketBufferSize>65536</sendSocketBufferSize>", False),
    ],
)
def test_a_profile_of_the_users_is_read_for_where_others_are_looked_for(
    tmp_path: Path, element: str, chosen: bool
) -> None:
    file = tmp_path / "profile.xml"
    file.write_text(
        f"""<dds><profiles><participant profile_name="mine" is_default_profile="true">
        <rtps>{element}</rtps></participant></profiles></dds>"""
    )
    assert chosen_otherwise({"FASTRTPS_DEFAULT_PROFILES_FILE": str(file)}) is chosen


@pytest.mark.parametrize(
    ("protocol", "served"), [("SIMPLE", False), ("CLIENT", True), ("SUPER_CLIENT", True)]
)
def test_a_profile_of_the_users_is_read_for_a_discovery_server(
    tmp_path: Path, protocol: str, *, served: bool
) -> None:
    file = tmp_path / "profile.xml"
    file.write_text(
        f"""<dds><profiles><participant profile_name="mine" is_default_profile="true"><rtps>
        <builtin><discovery_config><discoveryProtocol>{protocol}</discoveryProtocol>
        </discovery_config></builtin></rtps></participant></profiles></dds>"""
    )
    environment = {"FASTRTPS_DEFAULT_PROFILES_FILE": str(file)}
    assert is_served((), environment) is served
    assert not is_served((parse("shm://"),), environment)


@pytest.mark.parametrize(
    ("element", "connects"),
    [
        ("<builtinTransports>LARGE_DATA</builtinTransports>", True),
        ("<builtinTransports>DEFAULT</builtinTransports>", False),
    ],
)
def test_where_participants_connect_first_an_answer_is_not_enough(
    tmp_path: Path, element: str, *, connects: bool
) -> None:
    file = tmp_path / "profile.xml"
    file.write_text(
        f"""<dds><profiles><participant profile_name="mine" is_default_profile="true">
        <rtps>{element}</rtps></participant></profiles></dds>"""
    )
    assert connects_first((), {"FASTRTPS_DEFAULT_PROFILES_FILE": str(file)}) is connects
    large = {"FASTDDS_BUILTIN_TRANSPORTS": "LARGE_DATA"}
    assert connects_first((), large)
    assert not connects_first((parse("shm://"),), large)
    assert not connects_first((), {**large, "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"})


@pytest.mark.parametrize("transports", ["", "DEFAULT", "UDPv4?max_msg_size=1400B"])
def test_transports_with_multicast_leave_everybody_to_be_asked(transports: str) -> None:
    assert not chosen_otherwise({"FASTDDS_BUILTIN_TRANSPORTS": transports})


@contextlib.contextmanager
def listening_elsewhere(peer: socket.socket) -> Iterator[tuple[str, int]]:
    """Give a socket to another process; return its URL and port."""
    (url, _), port = url_for(peer), peer.getsockname()[1]
    with of_another_process(peer):
        yield url, port


def announced(port: int, order: str = "<") -> bytes:
    """Return an answer that names a port for discovery."""
    return _ANSWER + struct.pack(f"{order}HHiI", _METATRAFFIC_UNICAST, 24, 1, port) + bytes(16)


@pytest.mark.parametrize("byte_order", ["<", ">"])
def test_another_process_that_listens_is_silent_until_an_answer_names_its_port(
    peer: socket.socket, byte_order: str
) -> None:
    """It may have had no processor since it was asked: no time says that it is no participant."""
    with listening_elsewhere(peer) as (url, port):
        (probe,) = probes_for(25, (parse(url),), {})
        family, address = (socket.AF_INET6, "::1") if "[" in url else (socket.AF_INET, "127.0.0.1")
        with socket.socket(family, socket.SOCK_DGRAM) as answering:
            answering.connect((address, probe._socket.getsockname()[1]))
            assert probe.silent() == {port}
            answering.send(announced(port + 2))
            assert probe.silent() == {port}
            answering.send(announced(port, byte_order))
            assert probe.silent() == frozenset()
        probe.close()


def test_a_process_that_closed_its_port_is_silent_no_more(peer: socket.socket) -> None:
    with listening_elsewhere(peer) as (url, port):
        (probe,) = probes_for(25, (parse(url),), {})
        assert probe.silent() == {port}
    assert probe.silent() == frozenset()
    probe.close()


def test_only_processes_that_did_not_answer_are_asked_again(
    peer: socket.socket, monkeypatch: pytest.MonkeyPatch
) -> None:
    with listening_elsewhere(peer) as (url, port):
        peers = f"peer={url.partition('peer=')[2].partition('&')[0]}"
        another = url.replace(peers, f"{peers}&{peers.rpartition(':')[0]}:7913")
        (probe,) = probes_for(25, (parse(another),), {})
        asked: list[ProbeTarget] = []
        monkeypatch.setattr(probing, "send", lambda *sent: asked.extend(sent[2]))
        probe.ask_silent()
        assert [each.port for each in asked] == [port]
    probe.ask_silent()
    assert len(asked) == 1
    probe.close()
