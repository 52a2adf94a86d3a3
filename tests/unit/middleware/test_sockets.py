"""Sockets of this process: ports of URLs, DSCP, buffers, TCP connections."""

from __future__ import annotations

import contextlib
import os
import platform
import socket
import time
from collections.abc import Iterator

import pytest

from lifecycle.errors import MiddlewareError
from lifecycle.middleware.fastdds.sockets import (
    AT_MOST_S,
    check_free,
    check_host,
    give_up_dead_connections,
    open_sockets,
    send_again_soon,
    sockets_here,
    udp_sockets_of_others,
)
from lifecycle.middleware.process.shared_memory import open_files
from lifecycle.network.connection_url import parse

_UDP4 = (socket.AF_INET, socket.SOCK_DGRAM, "127.0.0.1")
_UDP6 = (socket.AF_INET6, socket.SOCK_DGRAM, "::1")
_TCP4 = (socket.AF_INET, socket.SOCK_STREAM, "127.0.0.1")


def bound(family: int, kind: int, address: str) -> socket.socket:
    each = socket.socket(family, kind)
    each.bind((address, 0))
    if kind == socket.SOCK_STREAM:
        each.listen()
    return each


@pytest.fixture
def udp() -> Iterator[int]:
    """A UDP port of 127.0.0.1 that is taken."""
    with bound(*_UDP4) as taken:
        yield taken.getsockname()[1]


@pytest.mark.parametrize(("kind", "how"), [("udpv4", _UDP4), ("udpv6", _UDP6), ("tcpv4", _TCP4)])
def test_a_bound_socket_is_listed_with_its_address_until_it_is_closed(
    kind: str, how: tuple[int, int, str]
) -> None:
    with bound(*how) as each:
        port = each.getsockname()[1]
        (found,) = (s for s in open_sockets() if (s.kind, s.port) == (kind, port))
        assert found.address == how[2]
    assert found.inode not in {s.inode for s in open_sockets()}


@pytest.mark.parametrize(
    ("option", "what"),
    [
        ("metatraffic_port", "UDP metatraffic port 127.0.0.1"),
        ("output_port", "UDP output port 127.0.0.1"),
    ],
)
def test_each_port_that_somebody_has_is_named(udp: int, option: str, what: str) -> None:
    url = f"udpv4://127.0.0.1?{option}={udp}"
    with pytest.raises(MiddlewareError) as refused:
        check_free([parse(url)])
    assert str(refused.value) == (
        f"cannot connect by '{url}': {what}:{udp} is not free on this host; end who has it "
        "(`ss -lnp`), or choose another port"
    )


@pytest.mark.parametrize(
    ("scheme", "how", "what"),
    [("udpv4", _UDP4, "UDP"), ("udpv6", _UDP6, "UDP"), ("tcpv4", _TCP4, "TCP")],
)
def test_the_data_port_is_tried_on_the_address_and_protocol_of_the_url(
    scheme: str, how: tuple[int, int, str], what: str
) -> None:
    host = f"[{how[2]}]" if ":" in how[2] else how[2]
    with bound(*how) as taken:
        port = taken.getsockname()[1]
        url = parse(f"{scheme}://{host}:{port}")
        with pytest.raises(MiddlewareError, match=rf"{what} .*:{port} is not free"):
            check_free([url])
    check_free([url])


def test_a_port_of_another_protocol_is_not_in_the_way(udp: int) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
        probe.bind(("127.0.0.1", 0))
        tcp = probe.getsockname()[1]
    with bound(socket.AF_INET, socket.SOCK_DGRAM, "127.0.0.1"):
        check_free([parse(f"tcpv4://127.0.0.1:{tcp}")])


def test_the_port_of_a_group_is_shared(udp: int) -> None:
    check_free([parse(f"udpm://239.255.1.9:{udp}?interface=127.0.0.1")])


@pytest.mark.parametrize(
    ("url", "missing"),
    [
        ("udpv4://192.0.2.77:7911", "192.0.2.77"),
        ("udpm://239.255.1.9:7911?interface=192.0.2.78", "192.0.2.78"),
        ("udpv4://?interface=nonesuch0", "nonesuch0"),
    ],
)
def test_an_address_or_interface_this_host_has_not_is_refused(url: str, missing: str) -> None:
    with pytest.raises(MiddlewareError) as refused:
        check_host([parse(url)])
    assert str(refused.value).startswith(
        f"cannot connect by '{url}': this host has no address '{missing}'; it has "
    )
    assert "127.0.0.1" in str(refused.value)


def test_what_every_host_has_is_accepted() -> None:
    check_host(
        [
            parse("udpv4://127.0.0.1:7911"),
            parse("udpv4://0.0.0.0:7911"),
            parse("udpv4://?interface=lo"),
            parse("udpm://239.255.1.9:7911"),
            parse("shm://"),
        ]
    )


@pytest.mark.parametrize("waits", [True, False])
@pytest.mark.parametrize("family", [socket.AF_INET, socket.AF_INET6])
def test_a_duplicate_of_a_socket_leaves_the_original_waiting_or_not(
    family: int, *, waits: bool
) -> None:
    before = open_files()
    with socket.socket(family, socket.SOCK_DGRAM) as own:
        own.bind(("", 0))
        own.setblocking(waits)
        for each in sockets_here():
            if each.family == family and each.getsockname() == own.getsockname():
                each.setsockopt(socket.IPPROTO_IP, socket.IP_TOS, 0x20)
        assert own.getsockopt(socket.IPPROTO_IP, socket.IP_TOS) == 0x20
        assert os.get_blocking(own.fileno()) is waits
    assert len(open_files()) == len(before)


def test_udp_sockets_of_ours_are_not_those_of_others() -> None:
    with bound(*_UDP4) as own:
        port = own.getsockname()[1]
        assert port in {each.port for each in open_sockets()}
        assert port not in {each.port for each in udp_sockets_of_others()}


_ESTABLISHED, _SYN_SENT = 1, 2  # tcp_states.h


def _state(each: socket.socket) -> int:
    return each.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, 1)[0]


def test_a_connection_that_nobody_takes_is_given_up_and_one_that_lives_is_not() -> None:
    with contextlib.ExitStack() as stack:
        server = stack.enter_context(socket.socket())
        server.bind(("127.0.0.1", 0))
        server.listen(0)
        dialled = []
        deadline = time.monotonic() + 10
        # Once the queue of those who wait to be accepted is full, the kernel answers nobody more.
        while not dialled or _state(dialled[-1]) != _SYN_SENT:
            assert time.monotonic() < deadline
            each = stack.enter_context(socket.socket())
            each.setblocking(False)
            each.connect_ex(server.getsockname())
            dialled.append(each)
        alive = [each for each in dialled if _state(each) == _ESTABLISHED]
        assert alive
        give_up_dead_connections()
        assert _state(dialled[-1]) != _SYN_SENT
        assert [_state(each) for each in alive] == [_ESTABLISHED] * len(alive)


_TCP_RTO_MAX_MS = 44
KNOWN = tuple(int(each) for each in platform.release().split(".")[:2]) >= (6, 15)


@pytest.mark.skipif(not KNOWN, reason="the kernel has no TCP_RTO_MAX_MS, see Linux 6.15")
def test_connections_and_those_accepted_later_send_again_within_the_bound() -> None:
    def bound_ms(each: socket.socket) -> int:
        return each.getsockopt(socket.IPPROTO_TCP, _TCP_RTO_MAX_MS)

    with socket.create_server(("127.0.0.1", 0)) as server:
        with socket.create_connection(server.getsockname()) as dialled:
            assert bound_ms(dialled) > AT_MOST_S * 1000
            send_again_soon()
            assert bound_ms(dialled) == AT_MOST_S * 1000
            server.accept()[0].close()
        with socket.create_connection(server.getsockname()):
            accepted, _ = server.accept()
            with accepted:
                assert bound_ms(accepted) == AT_MOST_S * 1000
