"""Whom a participant can ask, from what its connection URLs and settings say, and who answers."""

from __future__ import annotations

import contextlib
import socket
import struct
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from lifecycle.middleware.fastdds import prober as probing
from lifecycle.middleware.fastdds.discovery import (
    chosen_otherwise,
    is_served,
    reach,
    settle_s,
)
from lifecycle.middleware.fastdds.prober import ANSWER_S, Prober, Settling, leave_all
from lifecycle.network.connection_url import parse
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


def prober_of(url: str) -> Prober:
    return Prober(reach(25, (parse(url),), {}))


def test_a_listed_peer_is_asked_to_answer_both_and_is_counted(peer: socket.socket) -> None:
    url, address = url_for(peer)
    with contextlib.closing(prober_of(url)) as prober:
        prober.ask()
        message, (_, asked_from, *_) = peer.recvfrom(65536)
        assert locators(message, address) == {7910, asked_from}
        assert prober.answers() == {}
        peer.sendto(_ANSWER, (address, asked_from))
        assert prober.answers() == {_PREFIX.hex(): address}


@pytest.mark.parametrize("at_the_end", [False, True])
def test_it_is_one_participant_of_its_own_that_soon_leaves_by_a_message(
    peer: socket.socket, monkeypatch: pytest.MonkeyPatch, *, at_the_end: bool
) -> None:
    """Not by its lease: each look at one is an occasion for Fast DDS's deadlock."""
    monkeypatch.setattr(probing, "_JOINED_S", 60.0 if at_the_end else 0.05)
    url, _ = url_for(peer)
    prober = prober_of(url)
    prober.ask()
    if at_the_end:
        leave_all()
    messages = [peer.recv(65536), peer.recv(65536)]
    prober.ask()
    messages.append(peer.recv(65536))
    prober.close()
    messages.append(peer.recv(65536))
    assert {each[:8] for each in messages} == {b"RTPS\x02\x03LC"}
    (prefix,) = {each[8:20] for each in messages}
    assert prefix.startswith(b"LC")
    # PID_STATUS_INFO says that it left; PID_PARTICIPANT_LEASE_DURATION for how long it is there.
    left = struct.pack("<HH", 0x0071, 4) + b"\x00\x00\x00\x03"
    assert [left in each for each in messages] == [False, True, False, True]
    lease = struct.pack("<HHiI", 0x0002, 8, 10, 0)
    assert [lease in each for each in messages] == [True, False, True, False]
    # After INFO_TS, and the head of DATA: flags, what follows, the two ends of discovery.
    sequences = [struct.unpack_from("<iI", each, 20 + 12 + 16) for each in messages]
    assert sequences == [(0, 1), (0, 2), (0, 3), (0, 4)]
    leave_all()
    peer.setblocking(False)
    with pytest.raises(BlockingIOError):
        peer.recv(65536)


def profile(tmp_path: Path, element: str) -> dict[str, str]:
    """Return the environment of a user whose default profile has an element."""
    file = tmp_path / "profile.xml"
    file.write_text(
        f"""<dds><profiles><participant profile_name="mine" is_default_profile="true">
        <rtps>{element}</rtps></participant></profiles></dds>"""
    )
    return {"FASTRTPS_DEFAULT_PROFILES_FILE": str(file)}


def test_who_is_not_listed_is_not_asked(peer: socket.socket) -> None:
    url, address = url_for(peer)
    without = url.partition("&peer=")[0] + "&multicast=off"
    (nobody,), (one,) = reach(25, (parse(without),), {}), reach(25, (parse(url),), {})
    assert nobody.targets == ()
    assert one.targets == ((address, peer.getsockname()[1], ""),)


@pytest.mark.parametrize(
    "url",
    [
        "shm://",
        "tcpv4://127.0.0.1:5100?peer=127.0.0.1:5101",
        "udpv4://127.0.0.1:7911?server=127.0.0.1:11811",
        "udpv4://127.0.0.1:7911?metatraffic_port=7910&output_port=7912",
    ],
)
def test_over_shared_memory_and_tcp_behind_a_server_and_from_one_port_nobody_can_be_asked(
    url: str,
) -> None:
    assert reach(25, (parse(url),), {}) == ()


@pytest.mark.parametrize(
    "environment",
    [
        {"ROS_DISCOVERY_SERVER": "127.0.0.1:11811"},
        {"FASTDDS_BUILTIN_TRANSPORTS": "SHM"},
        {"FASTDDS_BUILTIN_TRANSPORTS": "TCPv4"},
        {"RMW_IMPLEMENTATION": "rmw_zenoh_cpp"},
    ],
)
def test_where_the_user_chose_how_others_are_found_nobody_is_asked(
    environment: dict[str, str],
) -> None:
    assert chosen_otherwise(environment)
    assert reach(25, (), environment) == ()


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
    assert chosen_otherwise(profile(tmp_path, element)) is chosen


@pytest.mark.parametrize(
    ("protocol", "served"), [("SIMPLE", False), ("CLIENT", True), ("SUPER_CLIENT", True)]
)
def test_a_profile_of_the_users_is_read_for_a_discovery_server(
    tmp_path: Path, protocol: str, *, served: bool
) -> None:
    chosen = f"<discoveryProtocol>{protocol}</discoveryProtocol>"
    environment = profile(
        tmp_path, f"<builtin><discovery_config>{chosen}</discovery_config></builtin>"
    )
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
    near = {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    asked = reach(25, (), {**near, **profile(tmp_path, element)})
    assert bool(asked) is not (connects or "builtinTransports" in element)
    large = {"FASTDDS_BUILTIN_TRANSPORTS": "LARGE_DATA"}
    assert reach(25, (), large) == ()
    assert settle_s((), large) > settle_s((), {}) == settle_s((parse("shm://"),), large)
    assert reach(25, (), {**large, **near})


@pytest.mark.parametrize("transports", ["", "DEFAULT", "UDPv4?max_msg_size=1400B"])
def test_transports_with_multicast_leave_everybody_to_be_asked(transports: str) -> None:
    assert not chosen_otherwise({"FASTDDS_BUILTIN_TRANSPORTS": transports})


def announced(port: int) -> bytes:
    """Return an answer that names a port for discovery."""
    return _ANSWER + struct.pack("<HHiI", _METATRAFFIC_UNICAST, 24, 1, port) + bytes(16)


def settled(settling: Settling, named: frozenset[str] = frozenset()) -> bool:
    settling.saw(named, "")
    return settling.left_s() == 0.0


def test_another_process_that_listens_is_waited_for_until_it_answers_and_its_node_is_known(
    peer: socket.socket,
) -> None:
    """It may have had no processor since it was asked: no time says that it is no participant."""
    (url, address), port = url_for(peer), peer.getsockname()[1]
    with (
        of_another_process(peer),
        contextlib.closing(Settling(reach(25, (parse(url),), {}))) as settling,
        socket.socket(peer.family, socket.SOCK_DGRAM) as answering,
    ):
        answering.connect((address, settling.prober._sockets[0].getsockname()[1]))
        time.sleep(ANSWER_S)
        assert not settled(settling)
        answering.send(announced(port + 2))
        known = frozenset({_PREFIX.hex()})
        assert not settled(settling, known)
        answering.send(announced(port))
        assert settled(settling, known)
        assert settled(settling)  # who was known and left is not on the way into the graph


def test_a_process_that_closed_its_port_is_waited_for_no_more(peer: socket.socket) -> None:
    url, _ = url_for(peer)
    with contextlib.ExitStack() as stack:
        closes = stack.enter_context(contextlib.ExitStack())
        closes.enter_context(of_another_process(peer))
        settling = Settling(reach(25, (parse(url),), {}))
        stack.callback(settling.close)
        time.sleep(ANSWER_S)
        assert not settled(settling)
        closes.close()
        assert settled(settling)


def test_who_answers_and_never_has_a_node_is_waited_for_once(
    peer: socket.socket,
) -> None:
    url, _ = url_for(peer)
    with contextlib.closing(Settling(reach(25, (parse(url),), {}), 2.0)) as settling:
        _, asked_from = peer.recvfrom(65536)
        peer.sendto(_ANSWER, asked_from)
        time.sleep(ANSWER_S)
        assert not settled(settling)
        time.sleep(2.0)
        assert settled(settling)
        assert settling.expect_newcomers(everybody=True)
        peer.sendto(_ANSWER, asked_from)
        time.sleep(ANSWER_S)
        assert settled(settling)


def test_a_socket_of_another_process_that_came_is_asked_for_once(peer: socket.socket) -> None:
    url, _ = url_for(peer)
    with contextlib.closing(Settling(reach(25, (parse(url),), {}))) as settling:
        time.sleep(ANSWER_S)
        assert settled(settling)
        assert not settling.expect_newcomers()
        with of_another_process(peer):
            assert settling.expect_newcomers()
            assert not settled(settling)


def test_where_nobody_can_be_asked_it_is_a_time() -> None:
    settling = Settling((), 0.2)
    assert 0.0 < settling.left_s() <= 0.2
    time.sleep(0.2)
    assert settled(settling)
    assert not settling.expect_newcomers()
    assert settling.expect_newcomers(everybody=True)
    assert not settled(settling)
    assert settling.unasked_s == 0.2
    settling.within(0.001)
    time.sleep(0.001)
    assert settled(settling)
