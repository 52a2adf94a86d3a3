"""Connection URLs of `connect_to`: parse and write transport, address, port and options.

Owns: their grammar, `TRANSPORT://[ADDRESS][:PORT][?OPTION=VALUE&…]`, both ways, after
*Topological Discovery and Communication Negotiation* ("Statically Configured Nodes"), and which
URLs one participant cannot have together. What a URL becomes is decided in middleware/. Pure.

    udpv4://10.77.0.1:7911?metatraffic_port=7910&output_port=7999&peer=10.77.0.2:7910&multicast=off
    udpv6://[fd77::1]:7911?metatraffic_port=7910&peer=[fd77::2]:7910&multicast=off
    udpm://239.255.1.9:7901?ttl=0&interface=127.0.0.1
    tcpv4://10.77.0.1:5100?peer=10.77.0.2:5100
    tcpv4://10.77.0.1:5101?server=10.77.0.3:42100
    shm://
"""

from __future__ import annotations

import contextlib
import functools
import ipaddress
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple
from urllib.parse import parse_qsl, urlencode, urlsplit

import msgspec

from lifecycle.errors import LifecycleError, did_you_mean
from lifecycle.network.medium import CONNECTABLE, Medium, udp_to
from lifecycle.network.nfe import is_wildcard


class ConnectionUrlError(LifecycleError):
    """A text that is no connection URL, or one that contradicts itself."""


class Peer(msgspec.Struct, frozen=True, kw_only=True, order=True):
    """Where another participant's discovery listens. `port` None: its well-known ports."""

    address: str
    port: int | None = None

    def __str__(self) -> str:
        """Return `10.77.0.2:7910` or `[fd77::2]:7910`."""
        host = f"[{self.address}]" if ":" in self.address else self.address
        return host if self.port is None else f"{host}:{self.port}"


def _number(allowed: range, name: str, value: str) -> int:
    if not value.isascii() or not value.isdigit() or int(value) not in allowed:
        raise ConnectionUrlError(
            f"{name}={value!r} is not a number of {allowed.start}–{allowed.stop - 1}"
        )
    return int(value)


def _switch(name: str, value: str) -> bool:
    if value not in ("on", "off"):
        raise ConnectionUrlError(f"{name}={value!r} is neither 'on' nor 'off'")
    return value == "on"


def _peer(name: str, value: str) -> Peer:
    with contextlib.suppress(ValueError):  # an IPv6 address needs no brackets without a port
        return Peer(address=str(ipaddress.ip_address(value)))
    try:
        parts = urlsplit(f"//{value}")
        address, port = parts.hostname or "", parts.port
        ipaddress.ip_address(address)
    except ValueError:
        raise ConnectionUrlError(
            f"{name}={value!r} is no ADDRESS or ADDRESS:PORT",
            hint="an IPv6 address with a port stands in brackets, [fd77::2]:7910",
        ) from None
    return Peer(address=address, port=port)


_UDP = frozenset(each for each in CONNECTABLE if each.is_udp)
_IP = frozenset(each for each in CONNECTABLE if each.is_network)


class Option(NamedTuple):
    """One option of a URL; `read` returns its value from its name and text.

    It may stand several times where its attribute is a tuple.
    """

    attribute: str
    read: Callable[[str, str], Any]
    transports: frozenset[Medium]


_PORT = functools.partial(_number, range(1, 65536))
OPTIONS = {
    "metatraffic_port": Option("metatraffic_port", _PORT, _UDP),
    "output_port": Option("output_port", _PORT, _UDP),
    "peer": Option("peers", _peer, _IP),
    "multicast": Option("multicast", _switch, _UDP),
    "server": Option("server", _peer, _IP),
    "ttl": Option("ttl", functools.partial(_number, range(256)), _UDP),
    "interface": Option("interfaces", lambda _, value: value, _UDP),
}


def _read_options(transport: Medium, query: str) -> dict[str, Any]:
    """Return the options after `?`, by attribute of ConnectionUrl."""
    default, read = ConnectionUrl(transport=transport), dict[str, Any]()
    for name, value in parse_qsl(query, keep_blank_values=True):
        if name not in OPTIONS:
            allowed = [each for each, how in OPTIONS.items() if transport in how.transports]
            raise ConnectionUrlError(
                f"unknown option {name!r}; {transport.value} has: {', '.join(allowed) or 'none'}",
                hint=did_you_mean(name, allowed),
            )
        option = OPTIONS[name]
        if transport not in option.transports:
            raise ConnectionUrlError(f"{transport.value} has no option {name!r}")
        if isinstance(getattr(default, option.attribute), tuple):
            before = read.get(option.attribute, ())
            read[option.attribute] = (*before, option.read(name, value))
        elif option.attribute in read:
            raise ConnectionUrlError(f"option {name!r} stands twice")
        else:
            read[option.attribute] = option.read(name, value)
    return read


_HOW = "write TRANSPORT://[ADDRESS][:PORT][?OPTION=VALUE&…], udpv4://10.77.0.1:7911"


class ConnectionUrl(msgspec.Struct, frozen=True, kw_only=True):
    """One transport of one connection.

    Attributes:
        address: own IP address to listen on; the group for UDPM; empty for any.
        port: user data arrives here, 1–65535; the listening port for TCPV4 (data and discovery);
            the group's port for UDPM; None leaves it to the middleware.
        metatraffic_port: discovery arrives here, UDP only; None leaves it to the middleware.
        output_port: fixed source port of what is sent, UDP only; None lets the kernel choose.
        peers: participants to look for at the start. With any, and `multicast` off, no other is
            looked for.
        multicast: discovery also announces by multicast, UDP only.
        server: discovery servers; the participant becomes their client and finds no others.
        ttl: hops of what is sent, 0–255; 0 stays on this host. None leaves it to the middleware.
        interfaces: only these are used, by address or name; empty for all.
    """

    transport: Medium
    address: str = ""
    port: int | None = None
    metatraffic_port: int | None = None
    output_port: int | None = None
    peers: tuple[Peer, ...] = ()
    multicast: bool = True
    server: tuple[Peer, ...] = ()
    ttl: int | None = None
    interfaces: tuple[str, ...] = ()

    def __str__(self) -> str:
        """Return the URL; `parse` of it is equal to this."""
        own = Peer(address=self.address, port=self.port)
        default = ConnectionUrl(transport=self.transport)
        words = [
            (name, ("off", "on")[each] if isinstance(each, bool) else str(each))
            for name, option in OPTIONS.items()
            if (value := getattr(self, option.attribute)) != getattr(default, option.attribute)
            for each in (value if isinstance(value, tuple) else (value,))
        ]
        query = urlencode(words, safe=":[]")
        return f"{self.transport.value}://{own}{'?' + query if query else ''}"

    @property
    def family(self) -> Medium:
        """The transport that carries it; that of a group is UDP, over the address's protocol."""
        return udp_to(self.address) if self.transport.is_group else self.transport

    @property
    def bound(self) -> tuple[str, ...]:
        """Addresses or names of interfaces that its transport is bound to; empty for all."""
        is_any = not self.address or is_wildcard(self.address) or self.transport.is_group
        return self.interfaces or (() if is_any else (self.address,))


def check_together(urls: Sequence[ConnectionUrl]) -> None:
    """Refuse URLs that one participant of Fast DDS 2.14 cannot have together.

    It has one transport for all URLs of a family: with two of a kind it would send all twice.

    Raises:
        ConnectionUrlError: names two of them.
    """

    def refuse(what: str, hint: str) -> None:
        raise ConnectionUrlError(f"cannot {what}", hint=hint)

    for family in dict.fromkeys(url.family for url in urls):
        same = [url for url in urls if url.family is family]
        some = [url for url in same if url.bound]
        free = [url for url in same if not (url.bound or url.transport.is_group)]
        if some and free:
            both = f"{str(free[0])!r} on all interfaces and {str(some[0])!r} on some"
            why = "one participant has one transport for both"
            refuse(f"use {both}: {why}", "give both an address or interface=")
        one_port = ("port",) if family.is_tcp else ()
        for option in ("ttl", "output_port", "metatraffic_port", *one_port):
            values = {getattr(url, option): url for url in same}
            values.pop(None, None)
            if len(values) > 1:
                spelt = " and ".join(repr(str(url)) for url in values.values())
                what = "TCP port" if option == "port" else option
                why = f"one participant has one {what}"
                refuse(f"use {spelt} together: {why}", "give them to different connections")
    fixed = [url for url in urls if url.transport.is_udp and url.port]
    if fixed and not all(url.transport.is_network for url in urls):
        why = "with fixed ports shared memory would not listen"
        refuse(f"use 'shm://' beside {str(fixed[0])!r}: {why}", "leave shm:// or the port out")
    servers = [url for url in urls if url.server]
    peers = [url for url in urls if url.peers]
    if servers and peers:
        both = f"{str(peers[0])!r} as a client of {str(servers[0])!r}"
        why = "a client of a discovery server finds nobody else"
        refuse(f"look for peers {both}: {why}", "leave peer= or server= out")


def parse(text: str) -> ConnectionUrl:
    """Parse a connection URL.

    Raises:
        ConnectionUrlError: unknown scheme or option, a value out of range, an option that the
            transport has not, an address of the wrong family.
    """
    try:
        return _parsed(text)
    except ConnectionUrlError as error:
        message = f"cannot read connection URL {text!r}: {error.message}"
        raise ConnectionUrlError(message, hint=error.hint) from None


def _parsed(text: str) -> ConnectionUrl:
    try:
        parts = urlsplit(text)
        host, port = parts.hostname or "", parts.port
    except ValueError as error:
        is_port = str(error).startswith("Port ")
        bad = "its port is no number of 1–65535" if is_port else str(error)
        raise ConnectionUrlError(bad, hint=_HOW) from error
    # urlsplit takes no scheme with an underscore (RFC 3986 §3.1), `zmq_pgm` of the article.
    scheme = parts.scheme or (text.partition("://")[0] if "://" in text else "")
    transport = next((each for each in CONNECTABLE if each == scheme), None)
    if transport is None:
        raise ConnectionUrlError(
            f"unknown transport {scheme!r}; allowed: {', '.join(CONNECTABLE)}",
            hint=did_you_mean(scheme, CONNECTABLE) or _HOW,
        )
    if parts.path not in ("", "/") or parts.fragment or parts.username or parts.password:
        raise ConnectionUrlError("only address, port and options are allowed", hint=_HOW)
    options = _read_options(transport, parts.query)
    url = ConnectionUrl(transport=transport, address=host, port=port, **options)
    _check(url)
    return url


def _check(url: ConnectionUrl) -> None:
    if not url.transport.is_network:
        if url.address or url.port is not None:
            raise ConnectionUrlError(f"{url.transport} has no address and no port")
        return
    if url.port == 0:
        raise ConnectionUrlError("port 0 is none: leave it out to let the middleware choose")
    version = url.transport.ip_version
    if url.address:
        try:
            address = ipaddress.ip_address(url.address)
        except ValueError:
            raise ConnectionUrlError(f"{url.address!r} is no IP address") from None
        if version and address.version != version:
            raise ConnectionUrlError(f"{url.address!r} is no IPv{version} address")
        group = url.transport.is_group
        if group and not address.is_multicast:
            raise ConnectionUrlError(f"{url.address!r} is no multicast group")
        if not group and address.is_multicast:
            raise ConnectionUrlError(f"{url.address!r} is a multicast group: use udpm://")
    elif url.transport.is_group:
        raise ConnectionUrlError("udpm needs a group, udpm://239.255.1.9:7901")
    if url.transport.is_group and url.port is None:
        raise ConnectionUrlError("udpm needs a port, udpm://239.255.1.9:7901")
