"""TCP connections of Fast DDS in this process, as the kernel has them (TCP_INFO of tcp(7)).

Owns: which are dead, which are used, and how long the kernel waits before it sends again. Must not
import rclpy.

Fast DDS 2.14 never returns from the destruction of a participant whose connection is cut, until its
socket is shut down; and it never uses a connection whose first answer arrived before the connecting
thread had noted what to request next: only another participant, on another port, helps then.
"""

from __future__ import annotations

import contextlib
import socket
import struct
from collections.abc import Iterator

from lifecycle.middleware.fastdds.sockets import sockets_here

_UNANSWERED = 2
"""Retransmissions in a row after which a connection is dead for a leaving process."""

_SYN_SENT = 2  # tcp_states.h
_ESTABLISHED = 1
_STATE, _RETRANSMITS, _PROBES = 0, 2, 3  # offsets in struct tcp_info
_LAST_RECEIVED_MS, _BYTES_ACKED, _BYTES_RECEIVED = 52, 120, 128

_FIRST_REQUEST = 100
"""Bytes; the request by which Fast DDS begins has 68, and the next one 38 more."""

_IDLE_MS = 500
"""A connection in use says what it wants next within 0.1 s of the first answer."""


def give_up_dead_connections() -> int:
    """Shut down every TCP connection of this process that is not answered; return how many.

    For a process that is about to end: an accepted connection that is shut down is not made again.
    """
    count = 0
    for each in _connections():
        with contextlib.suppress(OSError):  # closed since
            if _is_dead(each):
                each.shutdown(socket.SHUT_RDWR)
                count += 1
    return count


def _connections() -> Iterator[socket.socket]:
    for each in sockets_here():
        if each.type == socket.SOCK_STREAM and each.family in (socket.AF_INET, socket.AF_INET6):
            yield each


def is_used(address: str, port: int) -> bool | None:
    """Return whether the connection that this process dialled there is used by Fast DDS.

    None while that is open: there is no connection yet, or it has only just begun.
    """
    for each in _connections():
        with contextlib.suppress(OSError):  # not connected yet
            if each.getpeername() == (address, port):
                return _is_used(each.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, 256))
    return None


def _is_used(info: bytes) -> bool | None:
    (idle_ms,) = struct.unpack_from("=I", info, _LAST_RECEIVED_MS)
    acked, received = struct.unpack_from("=QQ", info, _BYTES_ACKED)
    if acked >= _FIRST_REQUEST:
        return True
    return False if received and idle_ms >= _IDLE_MS else None


def _is_dead(each: socket.socket) -> bool:
    info = each.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, 8)
    if info[_STATE] == _SYN_SENT:
        return True
    return info[_STATE] == _ESTABLISHED and max(info[_RETRANSMITS], info[_PROBES]) >= _UNANSWERED


AT_MOST_S = 1.0
"""The least that Linux allows. By default the time doubles up to 120 s (RFC 6298 §5.5), so that
after an outage nothing passes for about as long again."""

_GIVES_UP_S = 924
"""As long as Linux tries by default (tcp_retries2 of tcp(7)): it counts how often it sent again,
and would give up after 15 s. Fast DDS 2.14 does not get over a connection that was given up."""

_TCP_RTO_MAX_MS = 44  # linux/tcp.h, since Linux 6.15


def send_again_soon() -> int:
    """Make every TCP connection of this process retransmit within `AT_MOST_S`, for good.

    Returns:
        How many sockets heed it: 0 before Linux 6.15, which has no such option.
    """
    count = 0
    for each in _connections():
        with contextlib.suppress(OSError):  # closed since, or a kernel without the option
            each.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, _GIVES_UP_S * 1000)
            each.setsockopt(socket.IPPROTO_TCP, _TCP_RTO_MAX_MS, int(AT_MOST_S * 1000))
            count += 1
    return count
