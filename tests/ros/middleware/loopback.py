"""What really goes over the loopback interface, seen from outside Fast DDS."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import socket
import struct
import time
from collections.abc import Iterator

import pytest

_ETH_P_ALL = 3
_ETH_P_IP = 0x0800
_ETH_P_IPV6 = 0x86DD
_OUTGOING = 4
_SO_RCVBUFFORCE = 33
_WAIT_S = 10.0
_UDP = 17
_IPV6_FRAGMENT = 44
_END = b"that is all"
_IPV6_HEADER_BYTES = 40


@dataclasses.dataclass(frozen=True)
class Datagram:
    """One UDP datagram; a fragment of one has no ports of its own, so none is told."""

    family: str
    tos: int
    source: int
    destination: int
    payload: bytes
    fragment: bool = False


class Loopback:
    """Datagrams on `lo` since `watching` began."""

    def __init__(self, packets: socket.socket) -> None:
        self._packets = packets

    def until_now(self) -> list[Datagram]:
        """Return everything sent until this call, in order; the end is marked by our own packet."""
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as marker:
            marker.bind(("127.0.0.1", 0))
            end = _END + os.urandom(16)  # tests beside this one mark the ends of theirs
            marker.sendto(end, marker.getsockname())
        seen = []
        deadline = time.monotonic() + _WAIT_S
        while True:
            assert time.monotonic() < deadline, (
                "the end was lost: more traffic than the buffer takes"
            )
            packet, address = self._packets.recvfrom(1 << 17)
            if address[2] != _OUTGOING:  # each packet passes twice, out and in
                continue
            datagram = _decode(address[1], packet)
            if datagram is None:
                continue
            if datagram.payload == end:
                return seen
            seen.append(datagram)


@contextlib.contextmanager
def watching() -> Iterator[Loopback]:
    """Capture inside the block; a test that does it is marked `on_the_wire`."""
    with socket.socket(socket.AF_PACKET, socket.SOCK_DGRAM, socket.htons(_ETH_P_ALL)) as packets:
        # Beyond net.core.rmem_max, which CAP_NET_ADMIN allows: other programs use lo as well.
        with contextlib.suppress(PermissionError):
            packets.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, 1 << 26)
        packets.bind(("lo", 0))
        packets.settimeout(_WAIT_S)
        yield Loopback(packets)


def _may_capture() -> bool:
    try:
        socket.socket(socket.AF_PACKET, socket.SOCK_DGRAM).close()
    except PermissionError:
        return False
    return True


on_the_wire = pytest.mark.skipif(not _may_capture(), reason="capturing on lo needs CAP_NET_RAW")


def _decode(protocol: int, packet: bytes) -> Datagram | None:
    if protocol == _ETH_P_IP:
        header = (packet[0] & 0x0F) * 4
        (fragmentation,) = struct.unpack("!H", packet[6:8])
        if packet[9] != _UDP:
            return None
        more, offset = fragmentation & 0x2000, fragmentation & 0x1FFF
        return _udp("ipv4", packet[1], packet[header:], fragment=bool(more or offset))
    if protocol == _ETH_P_IPV6:
        traffic_class = (struct.unpack("!H", packet[:2])[0] >> 4) & 0xFF
        fragment = packet[6] == _IPV6_FRAGMENT
        if not fragment and packet[6] != _UDP:
            return None
        return _udp("ipv6", traffic_class, packet[_IPV6_HEADER_BYTES:], fragment=fragment)
    return None


def _udp(family: str, tos: int, rest: bytes, *, fragment: bool) -> Datagram:
    if fragment:
        return Datagram(family, tos, 0, 0, rest, fragment=True)
    source, destination = struct.unpack("!HH", rest[:4])
    return Datagram(family, tos, source, destination, rest[8:])
