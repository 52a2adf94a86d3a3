"""Datagrams that were too long for one packet, put together again.

Owns: `Fragments`. A burst of announcements is one long datagram; what its later pieces announce
was on the wire like the rest.
"""

from __future__ import annotations

import dataclasses
import struct

IPV6_FRAGMENT = 44
"""The IPv6 extension header (RFC 8200, section 4.5)."""

_OFFSET, _MORE, _IPV6_MORE = 0x1FFF, 0x2000, 0x0001
_IPV6_HEADER, _EXTENSION = 40, 8


@dataclasses.dataclass(frozen=True)
class _Piece:
    datagram: tuple[bytes, ...]
    offset: int
    last: bool
    octets: bytes


class Fragments:
    """Collects the pieces of datagrams."""

    def __init__(self) -> None:
        self._pieces: dict[tuple[bytes, ...], dict[int, _Piece]] = {}

    def add(self, packet: bytes) -> bytes:
        """Return what the datagram carries, without IP headers, if this was its missing piece.

        Args:
            packet: from its IP header on; of one that is whole nothing is returned.
        """
        piece = _ipv4(packet) if packet[0] >> 4 == 4 else _ipv6(packet)
        if piece is None:
            return b""
        pieces = self._pieces.setdefault(piece.datagram, {})
        pieces[piece.offset] = piece
        whole = b""
        while (following := pieces.get(len(whole))) is not None:
            whole += following.octets
            if following.last:
                del self._pieces[piece.datagram]
                return whole
            if not following.octets:
                break
        return b""


def _ipv4(packet: bytes) -> _Piece | None:
    total, number, fragment = struct.unpack_from(">HHH", packet, 2)
    if not fragment & (_OFFSET | _MORE):
        return None
    header = (packet[0] & 15) * 4
    return _Piece(
        datagram=(packet[12:20], packet[9:10], struct.pack(">H", number)),
        offset=(fragment & _OFFSET) * 8,
        last=not fragment & _MORE,
        octets=packet[header:total],
    )


def _ipv6(packet: bytes) -> _Piece | None:
    if packet[6] != IPV6_FRAGMENT:
        return None
    (total,) = struct.unpack_from(">H", packet, 4)
    field, number = struct.unpack_from(">HI", packet, _IPV6_HEADER + 2)
    return _Piece(
        datagram=(packet[8:40], packet[_IPV6_HEADER : _IPV6_HEADER + 1], struct.pack(">I", number)),
        offset=field & 0xFFF8,
        last=not field & _IPV6_MORE,
        octets=packet[_IPV6_HEADER + _EXTENSION : _IPV6_HEADER + total],
    )
