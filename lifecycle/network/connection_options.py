"""The options of connection URLs: `?peer=10.77.0.2:7910&multicast=off`.

Owns: which transport has which option, how a value is read and spelled, and the words that occur in
them. The URL as a whole is connection_url.py's. Pure.
"""

from __future__ import annotations

import contextlib
import dataclasses
import difflib
import enum
import functools
import ipaddress
import re
from collections.abc import Callable, Iterable
from typing import Any
from urllib.parse import parse_qsl, urlsplit

from lifecycle.errors import LifecycleError

_PORTS = range(1, 65536)
_TTLS = range(256)
_DISCOVERY_SERVER = re.compile(r"[0-9a-fA-F]{2}(\.[0-9a-fA-F]{2}){11}")


class ConnectionUrlError(LifecycleError):
    """A text that is no connection URL, or one that contradicts itself."""


class ConnectionTransport(enum.Enum):
    """How a connection carries data; values are the URL schemes."""

    UDPV4 = "udpv4"
    UDPV6 = "udpv6"
    UDPM = "udpm"  # a multicast group, over IPv4 or IPv6 as its address says
    TCPV4 = "tcpv4"
    SHM = "shm"


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True, order=True)
class Peer:
    """Where another participant's discovery listens. `port` None: its well-known ports."""

    address: str
    port: int | None = None

    def __str__(self) -> str:
        """Return `10.77.0.2:7910` or `[fd77::2]:7910`."""
        host = f"[{self.address}]" if ":" in self.address else self.address
        return host if self.port is None else f"{host}:{self.port}"


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """Return a hint with the known word that is nearest; empty if none is near."""
    close = difflib.get_close_matches(word.lower(), list(known), n=1, cutoff=0.6)
    return f"did you mean {close[0]!r}?" if close else ""


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


def _word(_: str, value: str) -> str:
    return value


def _prefix(name: str, value: str) -> str:
    if not _DISCOVERY_SERVER.fullmatch(value):
        raise ConnectionUrlError(
            f"{name}={value!r} is no GUID prefix: twelve bytes in hex with dots between them"
        )
    return value.lower()


_UDP = frozenset({ConnectionTransport.UDPV4, ConnectionTransport.UDPV6, ConnectionTransport.UDPM})
_IP = _UDP | {ConnectionTransport.TCPV4}


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Option:
    """One option.

    Attributes:
        attribute: of ConnectionUrl.
        read: returns what a value says, given the option's name and the text.
        transports: that have the option.
        repeated: it may stand several times.
    """

    attribute: str
    read: Callable[[str, str], Any]
    transports: frozenset[ConnectionTransport]
    repeated: bool = False

    def spell(self, value: Any) -> tuple[str, ...]:
        """Return the texts that say `value`."""
        if self.read is _switch:
            return ("on" if value else "off",)
        return tuple(str(each) for each in (value if self.repeated else (value,)))


_PORT = functools.partial(_number, _PORTS)
OPTIONS = {
    "metatraffic_port": Option(attribute="metatraffic_port", read=_PORT, transports=_UDP),
    "output_port": Option(attribute="output_port", read=_PORT, transports=_UDP),
    "peer": Option(attribute="peers", read=_peer, transports=_IP, repeated=True),
    "multicast": Option(attribute="multicast", read=_switch, transports=_UDP),
    "server": Option(attribute="server", read=_peer, transports=_IP, repeated=True),
    "server_prefix": Option(attribute="server_prefix", read=_prefix, transports=_IP),
    "ttl": Option(attribute="ttl", read=functools.partial(_number, _TTLS), transports=_UDP),
    "interface": Option(attribute="interfaces", read=_word, transports=_UDP, repeated=True),
    "dscp": Option(attribute="dscp", read=functools.partial(_number, range(64)), transports=_UDP),
    "max_datagram_bytes": Option(
        attribute="max_datagram_bytes",
        read=functools.partial(_number, range(500, 65501)),
        transports=_UDP,
    ),
    "non_blocking_send": Option(attribute="non_blocking_send", read=_switch, transports=_UDP),
}


def read_options(transport: ConnectionTransport, query: str) -> dict[str, Any]:
    """Return what the part after `?` says, by attribute of ConnectionUrl.

    Raises:
        ConnectionUrlError: an unknown option, one that the transport has not, or a bad value.
    """
    read: dict[str, Any] = {}
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
        if option.repeated:
            before = read.get(option.attribute, ())
            read[option.attribute] = (*before, option.read(name, value))
        elif option.attribute in read:
            raise ConnectionUrlError(f"option {name!r} stands twice")
        else:
            read[option.attribute] = option.read(name, value)
    return read
