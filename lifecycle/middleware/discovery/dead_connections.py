"""TCP connections of this process that carry nothing: not answered any more, or never used.

Owns: which count as dead, and which as unused, asked of the kernel (TCP_INFO of tcp(7)). Must not
import rclpy.

Fast DDS 2.14 never comes out of the destruction of a participant whose connection is cut: it waits
for the thread that reads from it, which waits for the other end (TCPChannelResourceBasic::
disconnect; measured: 5 of 5). Shutting the socket down wakes that thread.

It also never uses a connection whose first answer came before the thread that dialled had noted
what to ask for next (BIND_CONNECTION_RESPONSE in RTCPMessageManager::processRTCPMessage; seen in
packets: the request, its answer, and nothing more). Only another participant, on another port,
helps then.
"""

from __future__ import annotations

import contextlib
import os
import socket
import struct

from lifecycle.middleware.sockets.sockets import socket_descriptors

_UNANSWERED = 2
"""Retransmissions in a row after which a connection is dead for whoever is leaving: the kernel
sends again after 0.2 s and 0.6 s at the earliest, and participants send something each 0.5 s."""

_SYN_SENT = 2  # tcp_states.h
_ESTABLISHED = 1
_STATE, _RETRANSMITS, _PROBES = 0, 2, 3  # offsets in struct tcp_info
_LAST_RECEIVED_MS, _BYTES_ACKED, _BYTES_RECEIVED = 52, 120, 128

_FIRST_REQUEST = 100
"""Bytes; the request by which Fast DDS begins has 68, and the next one 38 more."""

_IDLE_MS = 500
"""A connection in use says what it wants next within a millisecond of the first answer, and on a
machine with both processors busy within 0.1 s."""


def give_up_dead_connections() -> int:
    """Shut down every TCP connection of this process that nobody answers; return how many.

    For a process that is about to end: an accepted connection that is shut down is not made again.
    """
    count = 0
    for number in socket_descriptors():
        # Closed since, or no socket any more.
        with contextlib.suppress(OSError), socket.socket(fileno=os.dup(number)) as each:
            if each.type == socket.SOCK_STREAM and _is_dead(each):
                each.shutdown(socket.SHUT_RDWR)
                count += 1
    return count


def is_used(address: str, port: int) -> bool | None:
    """Tell whether the connection that this process dialled is used by Fast DDS.

    Args:
        address: IPv4, whom it was dialled to.
        port: likewise.

    Returns:
        None while that is open: there is no connection yet, or it has only just begun.
    """
    for number in socket_descriptors():
        # Closed since, no socket any more, or not connected yet.
        with contextlib.suppress(OSError), socket.socket(fileno=os.dup(number)) as each:
            if (each.family, each.type) != (socket.AF_INET, socket.SOCK_STREAM):
                continue
            if each.getpeername() == (address, port):
                return _is_used(each.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, 256))
    return None


def _is_used(info: bytes) -> bool | None:
    if len(info) < _BYTES_RECEIVED + 8:
        return True  # before Linux 4.2 it cannot be told
    (idle_ms,) = struct.unpack_from("=I", info, _LAST_RECEIVED_MS)
    acked, received = struct.unpack_from("=QQ", info, _BYTES_ACKED)
    if acked >= _FIRST_REQUEST:
        return True
    return False if received and idle_ms >= _IDLE_MS else None


def _is_dead(each: socket.socket) -> bool:
    if each.family not in (socket.AF_INET, socket.AF_INET6):
        return False
    info = each.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, 8)
    if info[_STATE] == _SYN_SENT:
        return True
    return info[_STATE] == _ESTABLISHED and max(info[_RETRANSMITS], info[_PROBES]) >= _UNANSWERED
