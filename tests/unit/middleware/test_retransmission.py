"""How long the kernel waits before it sends again over TCP."""

from __future__ import annotations

import platform
import socket

import pytest

from lifecycle.middleware.fastdds.sockets import AT_MOST_S, send_again_soon

_TCP_RTO_MAX_MS = 44
KNOWN = tuple(int(each) for each in platform.release().split(".")[:2]) >= (6, 15)


@pytest.mark.skipif(not KNOWN, reason="the kernel has no TCP_RTO_MAX_MS, see Linux 6.15")
def test_connections_and_those_accepted_later_send_again_within_the_bound() -> None:
    def bound_ms(each: socket.socket) -> int:
        return each.getsockopt(socket.IPPROTO_TCP, _TCP_RTO_MAX_MS)

    with socket.create_server(("127.0.0.1", 0)) as server:
        with socket.create_connection(server.getsockname()) as dialled:
            assert bound_ms(dialled) > AT_MOST_S * 1000
            assert send_again_soon() >= 2
            assert bound_ms(dialled) == AT_MOST_S * 1000
            server.accept()[0].close()
        with socket.create_connection(server.getsockname()):
            accepted, _ = server.accept()
            with accepted:
                assert bound_ms(accepted) == AT_MOST_S * 1000


def test_other_sockets_are_left_alone() -> None:
    of_others = send_again_soon()
    one, other = socket.socketpair()
    with one, other, socket.socket(socket.AF_INET, socket.SOCK_DGRAM):
        assert send_again_soon() == of_others
