"""TCP connections over a link that is down, tried often enough to heal with it.

Owns: how long the kernel waits at most before it sends again what nobody acknowledged: it waits
twice as long each time, up to 120 s, so that after an outage nothing passes for about as long
again (RFC 6298 §5.5). Must not import rclpy.
"""

from __future__ import annotations

import contextlib
import os
import socket

from lifecycle.middleware.sockets.sockets import socket_descriptors

AT_MOST_S = 1.0
"""The least that Linux allows, and what healing may take."""

_GIVES_UP_S = 924
"""As long as Linux tries by default (tcp_retries2 of tcp(7)): it counts how often it sent again,
and would give up after 15 s. Fast DDS 2.14 does not get over a connection that was given up."""

_TCP_RTO_MAX_MS = 44  # linux/tcp.h, since Linux 6.15


def send_again_soon() -> int:
    """Have every TCP connection of this process send again within `AT_MOST_S`, for good.

    What is dialled later waits as long as ever; who is accepted by a socket that listens now does
    not.

    Returns:
        How many sockets heed it: 0 before Linux 6.15, which has no such option.
    """
    count = 0
    for number in socket_descriptors():
        # Closed since, or no socket any more, or a kernel without the option.
        with contextlib.suppress(OSError), socket.socket(fileno=os.dup(number)) as each:
            if each.type == socket.SOCK_STREAM and each.family in {socket.AF_INET, socket.AF_INET6}:
                each.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, _GIVES_UP_S * 1000)
                each.setsockopt(socket.IPPROTO_TCP, _TCP_RTO_MAX_MS, int(AT_MOST_S * 1000))
                count += 1
    return count
