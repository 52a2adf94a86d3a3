"""Check a connection URL: addresses, interfaces and free ports before, open sockets afterwards.

Owns: what a host must have before a participant is made, and what its sockets must be afterwards.
Fast DDS says nothing when a fixed port is taken or a whitelist matches nothing: the participant
exists and receives nothing. Linux: sockets are read from proc(5). Must not import rclpy.
"""

from __future__ import annotations

import contextlib
import ipaddress
import socket
import struct
from collections.abc import Collection, Iterable, Iterator, Sequence
from pathlib import Path

from lifecycle import dataclasses
from lifecycle.errors import MiddlewareError
from lifecycle.middleware.fastdds.url_profile import UrlTransport, families
from lifecycle.middleware.process.control import interface_addresses
from lifecycle.network.connection_url import ConnectionUrl
from lifecycle.network.medium import CONNECTABLE, UDP_UNICAST, Medium

_KINDS = tuple(each for each in CONNECTABLE if each.is_network and not each.is_group)
_LISTEN = "0A"  # TCP_LISTEN of linux/tcp_states.h


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class OpenSocket:
    """A bound UDP or listening TCP socket of a process.

    Attributes:
        inode: identifies it for as long as it is open.
        kind: UDPV4, UDPV6 or TCPV4.
        address: what it is bound to.
        port: 1–65535.
    """

    inode: int
    kind: Medium
    address: str
    port: int


def check_host(urls: Sequence[ConnectionUrl]) -> None:
    """Refuse URLs whose own address or interface this host has not.

    Raises:
        MiddlewareError: names the URL and what there is.
    """
    names = {name for _, name in socket.if_nameindex()}
    addresses = {text for _, text in interface_addresses(socket.AF_INET, socket.AF_INET6)}
    for url in urls:
        wanted = [each for each in url.interfaces if each not in names]
        group = url.transport.is_group
        if url.address and not group and not ipaddress.ip_address(url.address).is_unspecified:
            wanted.append(url.address)
        for each in wanted:
            if each.partition("%")[0] not in addresses:
                there = ", ".join(sorted(addresses | (names if each in url.interfaces else set())))
                raise MiddlewareError(
                    f"cannot connect by {str(url)!r}: this host has no address {each!r}; it has "
                    f"{there}",
                    hint="`ip address` lists them; check the machine's address in the manifest",
                )


def check_free(urls: Sequence[ConnectionUrl]) -> None:
    """Refuse URLs with a port that is taken, before a participant is made of them.

    Fast DDS 2.14 hangs for ever in the destruction of a participant that could not listen on its
    TCP port, so that must not be found out afterwards.

    Raises:
        MiddlewareError: names the URL and the port.
    """
    for family in families(urls):
        if family.kind not in _KINDS:
            continue
        for url, what, port in _ports(family):
            group = url.transport.is_group
            if group and port == url.port:
                continue  # a group's port is shared
            address = "" if group else url.address
            if not _is_free(family.kind, address, port):
                raise _taken(url, what, port)


def check_sockets(urls: Sequence[ConnectionUrl], opened: Sequence[OpenSocket]) -> None:
    """Refuse a participant that has not all the ports of its URLs.

    Args:
        urls: that it was made from.
        opened: the sockets that were opened for it.

    Raises:
        MiddlewareError: names the URL and the port that another process has.
    """
    for family in families(urls):
        mine = [each for each in opened if each.kind == family.kind]
        ports = {each.port for each in mine}
        for url, what, port in _ports(family):
            if port not in ports:
                raise _taken(url, what, port)
        if family.udp and not mine:
            raise MiddlewareError(
                f"cannot connect by {str(family.urls[0])!r}: Fast DDS opened no socket for it"
            )


def open_sockets(*, kinds: Collection[Medium] = _KINDS) -> tuple[OpenSocket, ...]:
    """Return the UDP and listening TCP sockets of this process.

    Args:
        kinds: only these; the kernel takes milliseconds to list the TCP sockets of a host.
    """
    ours = set(_socket_inodes("self"))
    return tuple(each for each in _bound_sockets(kinds) if each.inode in ours)


def udp_sockets(*, of_others: bool = False) -> tuple[OpenSocket, ...]:
    """Return the UDP sockets of our network namespace, or only those that others have."""
    ours = set(_socket_inodes("self")) if of_others else set[int]()
    return tuple(each for each in _bound_sockets(UDP_UNICAST) if each.inode not in ours)


def udp_sockets_of(pids: Iterable[int]) -> dict[int, tuple[OpenSocket, ...]]:
    """Return the UDP sockets of processes; those that are gone, or not ours, have none."""
    inodes: dict[int, int] = {}
    for pid in pids:
        with contextlib.suppress(OSError):
            inodes |= dict.fromkeys(_socket_inodes(str(pid)), pid)
    found: dict[int, list[OpenSocket]] = {}
    for each in _bound_sockets(UDP_UNICAST) if inodes else ():
        if each.inode in inodes:
            found.setdefault(inodes[each.inode], []).append(each)
    return {pid: tuple(sockets) for pid, sockets in found.items()}


def _is_free(kind: Medium, address: str, port: int) -> bool:
    stream = kind.is_tcp
    with socket.socket(
        kind.socket_family, socket.SOCK_STREAM if stream else socket.SOCK_DGRAM
    ) as probe:
        if stream:  # as Fast DDS does: connections that are over are not in the way
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        if kind.ip_version == 6:
            probe.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 1)
        try:
            probe.bind((address or kind.any_address, port))
            if stream:
                probe.listen()
        except OSError:
            return False
    return True


def _taken(url: ConnectionUrl, what: str, port: int) -> MiddlewareError:
    where = f"{url.address}:{port}" if url.address else f"port {port}"
    return MiddlewareError(
        f"cannot connect by {str(url)!r}: {what} {where} is not free on this host",
        hint="end who has it (`ss -lnp`), or choose another port",
    )


def _ports(family: UrlTransport) -> Iterator[tuple[ConnectionUrl, str, int]]:
    protocol = "TCP" if family.kind.is_tcp else "UDP"
    for url in family.urls:
        for attribute in ("port", "metatraffic_port", "output_port"):
            port = getattr(url, attribute)
            if port is not None:
                name = attribute.replace("_", " ") if attribute != "port" else "port"
                what = protocol if name == "port" else f"{protocol} {name}"
                yield url, what, port


def _bound_sockets(kinds: Collection[Medium]) -> Iterator[OpenSocket]:
    for kind in _KINDS:
        if kind not in kinds:
            continue
        table = f"{'tcp' if kind.is_tcp else 'udp'}{'6' if kind.ip_version == 6 else ''}"
        path = Path("/proc/thread-self/net") / table
        with contextlib.suppress(FileNotFoundError):  # a kernel without IPv6
            for line in path.read_text(encoding="ascii").splitlines()[1:]:
                fields = line.split()
                if kind.is_tcp and fields[3] != _LISTEN:
                    continue
                address, _, port = fields[1].partition(":")
                if int(port, 16):
                    yield OpenSocket(
                        inode=int(fields[9]),
                        kind=kind,
                        address=_address(kind.socket_family, address),
                        port=int(port, 16),
                    )


def _address(family: int, text: str) -> str:
    """Spell an address of /proc/net, written there as 32-bit integers in the host's byte order."""
    words = [int(text[at : at + 8], 16) for at in range(0, len(text), 8)]
    return socket.inet_ntop(family, struct.pack(f"={len(words)}I", *words))


def _socket_inodes(process: str) -> Iterator[int]:
    for descriptor in Path("/proc", process, "fd").iterdir():
        with contextlib.suppress(OSError):  # closed meanwhile
            target = str(descriptor.readlink())
            if target.startswith("socket:["):
                yield int(target[len("socket:[") : -1])
