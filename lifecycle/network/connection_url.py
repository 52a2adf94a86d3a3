"""Connection URLs: what `connect_to` is told, transport and addresses.

Owns: their grammar, `TRANSPORT://[ADDRESS][:PORT][?OPTION=VALUE&…]`, both ways. The idea is that of
*Topological Discovery and Communication Negotiation* ("Statically Configured Nodes"); the options
are in connection_options.py, and what a URL becomes is middleware/'s. Pure.

    udpv4://10.77.0.1:7911?metatraffic_port=7910&output_port=7999&peer=10.77.0.2:7910&multicast=off
    udpv6://[fd77::1]:7911?metatraffic_port=7910&peer=[fd77::2]:7910&multicast=off
    udpm://239.255.1.9:7901?ttl=0&interface=127.0.0.1
    tcpv4://10.77.0.1:5100?peer=10.77.0.2:5100
    tcpv4://10.77.0.1:5101?server=10.77.0.3:42100
    shm://
"""

from __future__ import annotations

import dataclasses
import ipaddress
from urllib.parse import urlencode, urlsplit

from lifecycle.network.connection_options import (
    OPTIONS,
    ConnectionTransport,
    ConnectionUrlError,
    Peer,
    did_you_mean,
    read_options,
)

__all__ = ["ConnectionTransport", "ConnectionUrl", "ConnectionUrlError", "Peer", "parse"]

_HOW = "write TRANSPORT://[ADDRESS][:PORT][?OPTION=VALUE&…], udpv4://10.77.0.1:7911"


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class ConnectionUrl:
    """One transport of one connection.

    Attributes:
        address: own IP address to listen on; the group for UDPM; empty for any.
        port: user data arrives here, 1–65535; the listening port for TCPV4 (data and discovery);
            the group's port for UDPM; None leaves it to the middleware.
        metatraffic_port: discovery arrives here, UDP only; None leaves it to the middleware.
        output_port: fixed source port of what is sent, UDP only; None lets the kernel choose.
        peers: participants to look for at the start. With any, and `multicast` off, nobody else is
            looked for.
        multicast: discovery also announces by multicast, UDP only.
        server: discovery servers; the participant becomes their client and finds nobody else.
        server_prefix: GUID prefix of the first server; those after it count up in the byte that
            `fast-discovery-server -i ID` sets.
        ttl: hops of what is sent, 0–255; 0 stays on this host. None leaves it to the middleware.
        interfaces: only these are used, by address or name; empty for all.
        dscp: 0–63 on the sender sockets; None leaves them.
        max_datagram_bytes: longest UDP payload before RTPS splits messages; None leaves it.
        non_blocking_send: never wait for room in a socket's buffer.
    """

    transport: ConnectionTransport
    address: str = ""
    port: int | None = None
    metatraffic_port: int | None = None
    output_port: int | None = None
    peers: tuple[Peer, ...] = ()
    multicast: bool = True
    server: tuple[Peer, ...] = ()
    server_prefix: str = "44.53.00.5f.45.50.52.4f.53.49.4d.41"
    ttl: int | None = None
    interfaces: tuple[str, ...] = ()
    dscp: int | None = None
    max_datagram_bytes: int | None = None
    non_blocking_send: bool = False

    def __str__(self) -> str:
        """Return the URL; `parse` of it is equal to this."""
        return _spell(self)


def parse(text: str) -> ConnectionUrl:
    """Return what a connection URL says.

    Raises:
        ConnectionUrlError: unknown scheme or option, a value out of range, an option that the
            transport has not, an address of the wrong family.
    """
    try:
        parts = urlsplit(text)
        port = parts.port
        host = parts.hostname or ""
    except ValueError as error:
        bad = "its port is no number of 1–65535" if _has_host(text) else str(error)
        raise ConnectionUrlError(
            f"cannot read connection URL {text!r}: {bad}", hint=_HOW
        ) from error
    try:
        transport = ConnectionTransport(parts.scheme)
    except ValueError:
        allowed = ", ".join(each.value for each in ConnectionTransport)
        # urlsplit takes no scheme with an underscore (RFC 3986 §3.1), `zmq_pgm` of the article.
        scheme = parts.scheme or (text.partition("://")[0] if "://" in text else "")
        raise ConnectionUrlError(
            f"cannot read connection URL {text!r}: unknown transport {scheme!r}; "
            f"allowed: {allowed}",
            hint=did_you_mean(scheme, (each.value for each in ConnectionTransport)) or _HOW,
        ) from None
    if parts.path not in ("", "/") or parts.fragment or parts.username or parts.password:
        raise ConnectionUrlError(
            f"cannot read connection URL {text!r}: only address, port and options are allowed",
            hint=_HOW,
        )
    try:
        options = read_options(transport, parts.query)
        url = ConnectionUrl(transport=transport, address=host, port=port, **options)
        _check(url)
    except ConnectionUrlError as error:
        message = f"cannot read connection URL {text!r}: {error.message}"
        raise ConnectionUrlError(message, hint=error.hint) from None
    return url


def _has_host(text: str) -> bool:
    """Whether the part before the port can be read."""
    try:
        return bool(urlsplit(text).scheme) and urlsplit(text).hostname is not None
    except ValueError:
        return False


def _check(url: ConnectionUrl) -> None:
    if url.transport is ConnectionTransport.SHM:
        if url.address or url.port is not None:
            raise ConnectionUrlError("shm has no address and no port")
        return
    if url.port == 0:
        raise ConnectionUrlError("port 0 is none: leave it out to let the middleware choose")
    version = {ConnectionTransport.UDPV6: 6, ConnectionTransport.UDPM: 0}.get(url.transport, 4)
    if url.address:
        try:
            address = ipaddress.ip_address(url.address)
        except ValueError:
            raise ConnectionUrlError(f"{url.address!r} is no IP address") from None
        if version and address.version != version:
            raise ConnectionUrlError(f"{url.address!r} is no IPv{version} address")
        group = url.transport is ConnectionTransport.UDPM
        if group and not address.is_multicast:
            raise ConnectionUrlError(f"{url.address!r} is no multicast group")
        if not group and address.is_multicast:
            raise ConnectionUrlError(f"{url.address!r} is a multicast group: use udpm://")
    elif url.transport is ConnectionTransport.UDPM:
        raise ConnectionUrlError("udpm needs a group, udpm://239.255.1.9:7901")
    if url.transport is ConnectionTransport.UDPM and url.port is None:
        raise ConnectionUrlError("udpm needs a port, udpm://239.255.1.9:7901")


def _spell(url: ConnectionUrl) -> str:
    own = str(Peer(address=url.address, port=url.port)) if url.address else ""
    if not url.address and url.port is not None:
        own = f":{url.port}"
    default = ConnectionUrl(transport=url.transport)
    words: list[tuple[str, str]] = []
    for name, option in OPTIONS.items():
        value = getattr(url, option.attribute)
        if value != getattr(default, option.attribute):
            words += [(name, text) for text in option.spell(value)]
    query = urlencode(words, safe=":[]")
    return f"{url.transport.value}://{own}{'?' + query if query else ''}"
