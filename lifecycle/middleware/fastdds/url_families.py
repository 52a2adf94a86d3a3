"""The transports that connection URLs make, and which URLs one participant cannot have together.

Owns: the grouping of URLs into Fast DDS transports. Two URLs of one family (IPv4 UDP and a group
over IPv4) share one transport: Fast DDS would send everything twice by two of a kind. Must not
import rclpy; reads no environment.
"""

from __future__ import annotations

import dataclasses
import ipaddress
from collections.abc import Iterable, Sequence

from lifecycle.errors import MiddlewareError
from lifecycle.network.connection_url import ConnectionTransport, ConnectionUrl

UDPV4, UDPV6, TCPV4, SHM = "udpv4", "udpv6", "tcpv4", "shm"
LOOPBACK = {UDPV4: "127.0.0.1", UDPV6: "::1"}
"""The transports that carry UDP, and where each finds this host."""


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Family:
    """One transport of a participant: all URLs that it serves.

    Attributes:
        kind: "udpv4", "udpv6", "tcpv4" or "shm".
        urls: at least one.
        interfaces: addresses or names that it is bound to; empty for all.
    """

    kind: str
    urls: tuple[ConnectionUrl, ...]
    interfaces: tuple[str, ...] = ()

    @property
    def udp(self) -> bool:
        """Whether it carries UDP, and so may use multicast."""
        return self.kind in LOOPBACK

    @property
    def unicast(self) -> tuple[ConnectionUrl, ...]:
        """Its URLs that are no groups."""
        return tuple(url for url in self.urls if url.transport is not ConnectionTransport.UDPM)

    @property
    def groups(self) -> tuple[ConnectionUrl, ...]:
        """Its URLs that are groups."""
        return tuple(url for url in self.urls if url.transport is ConnectionTransport.UDPM)


def families(urls: Sequence[ConnectionUrl]) -> tuple[Family, ...]:
    """Return the transports that a participant of these URLs has, in the order of the URLs.

    Raises:
        MiddlewareError: URLs that one participant cannot have together.
    """
    by_kind: dict[str, list[ConnectionUrl]] = {}
    for url in urls:
        by_kind.setdefault(transport_of(url), []).append(url)
    found = tuple(
        Family(kind=kind, urls=tuple(each), interfaces=_interfaces(each))
        for kind, each in by_kind.items()
    )
    _check(found, urls)
    return found


def leaves_discovery_open(urls: Iterable[ConnectionUrl]) -> bool:
    """Whether UDP URLs say nothing of where others are looked for.

    Then what the environment says of that still holds (ROS_AUTOMATIC_DISCOVERY_RANGE).
    """
    udp = [url for url in urls if transport_of(url) in LOOPBACK]
    return bool(udp) and not any(
        url.peers
        or url.server
        or not url.multicast
        or url.metatraffic_port
        or url.interfaces
        or (url.address and url.transport is not ConnectionTransport.UDPM)
        for url in udp
    )


def transport_of(url: ConnectionUrl) -> str:
    """Return the kind of transport that a URL is served by; a group's is that of its address."""
    if url.transport is ConnectionTransport.UDPM:
        return UDPV4 if ipaddress.ip_address(url.address).version == 4 else UDPV6
    return str(url.transport.value)


def _interfaces(urls: Sequence[ConnectionUrl]) -> tuple[str, ...]:
    """Return what a transport of these URLs is bound to; empty for everything."""
    found: dict[str, None] = {}
    free = [url for url in urls if not _bound_to(url)]
    bound = [url for url in urls if _bound_to(url)]
    if free and bound and not all(url.transport is ConnectionTransport.UDPM for url in free):
        raise MiddlewareError(
            f"cannot use {str(free[0])!r} on all interfaces and {str(bound[0])!r} on some: one "
            "participant has one transport for both",
            hint="give both an address or interface=",
        )
    for url in bound:
        found.update(dict.fromkeys(_bound_to(url)))
    return tuple(found)


def _bound_to(url: ConnectionUrl) -> tuple[str, ...]:
    if url.interfaces:
        return url.interfaces
    group = url.transport is ConnectionTransport.UDPM
    if group or not url.address or ipaddress.ip_address(url.address).is_unspecified:
        return ()
    return (url.address,)


def _check(found: Sequence[Family], urls: Sequence[ConnectionUrl]) -> None:
    for family in found:
        for option in ("ttl", "output_port", "metatraffic_port"):
            values = {getattr(url, option): url for url in family.urls}
            values.pop(None, None)
            if len(values) > 1:
                spelt = " and ".join(repr(str(url)) for url in values.values())
                raise MiddlewareError(
                    f"cannot use {spelt} together: one participant has one {option}",
                    hint="give them to different connections",
                )
        listening = [url for url in family.urls if url.port] if family.kind == TCPV4 else []
        if len(listening) > 1:
            raise MiddlewareError(
                f"cannot listen on {str(listening[0])!r} and {str(listening[1])!r}: one "
                "participant has one TCP port",
                hint="give them to different connections",
            )
    kinds = {family.kind for family in found}
    fixed = [url for url in urls if transport_of(url) in LOOPBACK and url.port]
    if SHM in kinds and fixed:
        raise MiddlewareError(
            f"cannot use 'shm://' beside {str(fixed[0])!r}: a profile with fixed ports cannot say "
            "where shared memory listens, so it would not",
            hint="leave shm:// or the port out",
        )
    servers = [url for url in urls if url.server]
    peers = [url for url in urls if url.peers]
    if servers and peers:
        raise MiddlewareError(
            f"cannot look for peers {str(peers[0])!r} as a client of {str(servers[0])!r}: a client "
            "of a discovery server finds nobody else",
            hint="leave peer= or server= out",
        )
