"""The sockets of this process, found among its descriptors and left as they are."""

from __future__ import annotations

import os
import socket

import pytest

from lifecycle.middleware.fastdds.sockets import own_udp_ports, own_udp_socket
from lifecycle.middleware.process.shared_memory import open_files


@pytest.mark.parametrize("waits", [True, False])
@pytest.mark.parametrize("family", [socket.AF_INET, socket.AF_INET6])
def test_a_duplicate_of_a_socket_leaves_the_original_waiting_or_not(
    family: int, *, waits: bool
) -> None:
    before = open_files()
    with socket.socket(family, socket.SOCK_DGRAM) as own:
        own.bind(("", 0))
        own.setblocking(waits)
        port = own.getsockname()[1]
        assert port in own_udp_ports()
        found = own_udp_socket(family, port)
        assert found is not None
        with found:
            assert found.getsockname() == own.getsockname()
            found.setsockopt(socket.IPPROTO_IP, socket.IP_TOS, 0x20)
            assert own.getsockopt(socket.IPPROTO_IP, socket.IP_TOS) == 0x20
        assert os.get_blocking(own.fileno()) is waits
    assert len(open_files()) == len(before)


def test_one_of_another_family_or_protocol_is_not_taken_for_it() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as stream:
        stream.bind(("127.0.0.1", 0))
        port = stream.getsockname()[1]
        assert port not in own_udp_ports()
        assert own_udp_socket(socket.AF_INET, port) is None
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as own:
        own.bind(("127.0.0.1", 0))
        assert own_udp_socket(socket.AF_INET6, own.getsockname()[1]) is None
