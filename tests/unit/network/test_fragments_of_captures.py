"""The packet captures of tests: a datagram in pieces is one datagram."""

from __future__ import annotations

import itertools
import struct

from tests.net.fragments import Fragments

DATAGRAM = bytes(range(256)) * 12  # 3072 bytes
PIECES = ((0, 1480), (1480, 2960), (2960, 3072))


def ipv4(start: int, end: int, number: int = 7) -> bytes:
    fragment = start // 8 | (0x2000 if end < len(DATAGRAM) else 0)
    total = 20 + end - start
    header = struct.pack(">BBHHHBBH", 0x45, 0, total, number, fragment, 64, 17, 0)
    return header + bytes((10, 0, 0, 1, 10, 0, 0, 2)) + DATAGRAM[start:end]


def ipv6(start: int, end: int, number: int = 7) -> bytes:
    header = struct.pack(">IHBB", 6 << 28, 8 + end - start, 44, 64) + bytes(range(32))
    more = int(end < len(DATAGRAM))
    return header + struct.pack(">BBHI", 17, 0, start | more, number) + DATAGRAM[start:end]


def test_pieces_are_one_datagram_in_whatever_order_they_come() -> None:
    for packet in (ipv4, ipv6):
        for order in itertools.permutations(PIECES):
            fragments = Fragments()
            *before, last = (fragments.add(packet(*each)) for each in order)
            assert before == [b"", b""]
            assert last == DATAGRAM


def test_pieces_of_two_datagrams_are_not_mixed() -> None:
    for packet in (ipv4, ipv6):
        fragments = Fragments()
        for each in PIECES[:2]:
            assert fragments.add(packet(*each, number=1)) == b""
        assert fragments.add(packet(*PIECES[2], number=2)) == b""
        assert fragments.add(packet(*PIECES[2], number=1)) == DATAGRAM


def test_a_whole_datagram_has_no_pieces() -> None:
    header = struct.pack(">BBHHHBBH", 0x45, 0, 24, 7, 0x4000, 64, 17, 0)
    assert Fragments().add(header + bytes(8) + b"whole") == b""
    assert Fragments().add(struct.pack(">IHBB", 6 << 28, 5, 17, 64) + bytes(32) + b"whole") == b""
