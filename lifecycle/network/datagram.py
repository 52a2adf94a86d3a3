"""UDP datagram size, MTU and IP fragmentation.

Owns: the arithmetic. Pure.

A UDP datagram that does not fit the path's MTU is split by IP. Only the first fragment carries the
ports, so that a rule on ports treats the others as something else, and one lost fragment loses them
all (RFC 8085, section 3.2). RTPS can split a message itself (DATA_FRAG): then each part is a
datagram of its own, with ports.
"""

from __future__ import annotations

ETHERNET_MTU = 1500
"""Bytes of IP packet that Ethernet carries, and that a path has unless one knows better."""

SAFE_DATAGRAM_BYTES = 1400
"""What we ask of a transport: leaves room below an Ethernet MTU for tunnels on the way."""

_UDP_HEADER = 8
_IP_HEADER = {False: 20, True: 40}

RTPS_OVERHEAD_BYTES = 20 + 16 + 12 + 24 + 32
"""Around one message: RTPS header, INFO_DST, INFO_TS, DATA and, from reliable writers, HEARTBEAT
(DDSI-RTPS 9.4)."""


def max_unfragmented(*, ipv6: bool = False, mtu: int = ETHERNET_MTU) -> int:
    """Return the largest UDP payload, bytes, that IP does not split: 1472 on Ethernet, IPv6 1452.

    Args:
        ipv6: an IPv6 header is 20 bytes longer.
        mtu: of the path, >= 576.
    """
    return mtu - _IP_HEADER[ipv6] - _UDP_HEADER


def datagram_bytes(message_bytes: int) -> int:
    """Return the UDP payload, bytes, of a message that RTPS does not split.

    Args:
        message_bytes: serialized, with the four bytes of its encapsulation, > 0.
    """
    padded = (message_bytes + 3) // 4 * 4  # submessages start at multiples of 4
    return padded + RTPS_OVERHEAD_BYTES


def is_fragmented(message_bytes: int, max_datagram_bytes: int) -> bool:
    """Return whether IP would split the datagram of a message.

    Args:
        message_bytes: serialized, > 0.
        max_datagram_bytes: UDP payload that the path carries whole.
    """
    return datagram_bytes(message_bytes) > max_datagram_bytes
