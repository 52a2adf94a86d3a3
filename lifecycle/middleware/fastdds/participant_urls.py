"""What a participant was asked for by its URLs, and what of that it has got.

Owns: the one DSCP of a participant, the sockets on ports that its URLs name, and whether it has
shared memory.
"""

from __future__ import annotations

from rclpy.node import Node

from lifecycle.errors import MiddlewareError
from lifecycle.middleware.fastdds.participant_profile import ParticipantSettings
from lifecycle.middleware.fastdds.url_families import LOOPBACK, transport_of
from lifecycle.middleware.sockets.nfe import has_shared_memory
from lifecycle.middleware.sockets.url_check import open_sockets
from lifecycle.network.connection_url import ConnectionTransport, ConnectionUrl

_UDP_ALONE = "only UDP sockets can be marked"


def one_dscp(dscp: int | None, settings: ParticipantSettings) -> int | None:
    """Return the DSCP that is asked for, by whoever asks.

    Fast DDS opens TCP connections whenever it has something to send and lists none of them, so
    whoever would mark them comes too late (ip(7): a connection is marked by its own socket).

    Raises:
        MiddlewareError: by several, and differently; or for what has no UDP socket.
    """
    if dscp is not None and settings.urls and not any(_is_udp(url) for url in settings.urls):
        listed = " and ".join(repr(str(url)) for url in settings.urls)
        raise MiddlewareError(
            f"cannot mark what {listed} carries with DSCP {dscp}: {_UDP_ALONE}",
            hint="remove the mark, or carry it by udpv4://",
        )
    asked = {
        each: None for each in (dscp, *(url.dscp for url in settings.urls)) if each is not None
    }
    if len(asked) > 1:
        raise MiddlewareError(
            f"cannot mark one participant with DSCPs {' and '.join(map(str, asked))}",
            hint="give the URLs to different connections",
        )
    return next(iter(asked), None)


def fixed_sockets(settings: ParticipantSettings) -> set[int]:
    """Return this process's sockets that have a port which the URLs name, by their inodes."""
    ports = {
        port
        for url in settings.urls
        for port in (url.port, url.metatraffic_port, url.output_port)
        if port is not None
    }
    return {each.inode for each in open_sockets() if each.port in ports} if ports else set()


def uses_shared_memory(node: Node, settings: ParticipantSettings) -> bool:
    """Tell whether it has the transport, without a probe that static discovery would not allow."""
    if settings.urls:
        return any(url.transport is ConnectionTransport.SHM for url in settings.urls)
    return has_shared_memory(node)


def _is_udp(url: ConnectionUrl) -> bool:
    return transport_of(url) in LOOPBACK
