"""TCP connections of this process that nobody answers any more, given up when it leaves the graph.

Owns: which count as dead, asked of the kernel (TCP_INFO of tcp(7)). Must not import rclpy.

Fast DDS 2.14 never comes out of the destruction of a participant whose connection is cut: it waits
for the thread that reads from it, which waits for the other end (TCPChannelResourceBasic::
disconnect; measured: 5 of 5). Shutting the socket down wakes that thread.
"""

from __future__ import annotations

import contextlib
import os
import socket

from lifecycle.middleware.sockets import socket_descriptors

_UNANSWERED = 2
"""Retransmissions in a row after which a connection is dead for whoever is leaving: the kernel
sends again after 0.2 s and 0.6 s at the earliest, and participants send something each 0.5 s."""

_SYN_SENT = 2  # tcp_states.h
_ESTABLISHED = 1
_STATE, _RETRANSMITS, _PROBES = 0, 2, 3  # offsets in struct tcp_info


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


def _is_dead(each: socket.socket) -> bool:
    if each.family not in (socket.AF_INET, socket.AF_INET6):
        return False
    info = each.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, 8)
    if info[_STATE] == _SYN_SENT:
        return True
    return info[_STATE] == _ESTABLISHED and max(info[_RETRANSMITS], info[_PROBES]) >= _UNANSWERED
