"""Sockets of this process and host: ports of connection URLs, DSCP, buffers, TCP connections.

Owns: what a host must have before a participant is made from connection URLs; the DSCP (IP_TOS of
ip(7), IPV6_TCLASS of ipv6(7), RFC 2474) of the sockets that a participant sends from; the receive
buffers of those on which it receives discovery; and its TCP connections as the kernel has them
(TCP_INFO of tcp(7)). Sockets are found among a process's descriptors and in proc(5). Must not
import rclpy.

Fast DDS says nothing when a fixed port is taken or a whitelist matches nothing: the participant
receives nothing. It has no DSCP setting; the socket option, which needs no privilege, is what the
kernel puts into packets. A participant's UDP sender sockets all exist before its first publisher
does. TCP connections are opened later, are in no NFE list, and are not marked.

Fast DDS 2.14 never returns from the destruction of a participant whose TCP connection is cut, until
its socket is shut down.
"""

from __future__ import annotations

import contextlib
import os
import socket
import struct
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import msgspec

from lifecycle.errors import MiddlewareError
from lifecycle.middleware.process.shared_memory import open_files
from lifecycle.network.connection_url import ConnectionUrl
from lifecycle.network.dscp import tos
from lifecycle.network.medium import CONNECTABLE, UDP_UNICAST, Medium, udp_to
from lifecycle.network.nfe import NetworkFlowEndpoint, canonical, is_wildcard
from lifecycle.network.ports import DG, participant_ports

_TYPE = {True: socket.SOCK_STREAM, False: socket.SOCK_DGRAM}  # by Medium.is_tcp
_KINDS = {
    (each.socket_family, _TYPE[each.is_tcp]): each
    for each in CONNECTABLE
    if each.is_network and not each.is_group
}
DSCP_OPTION = {
    socket.AF_INET: (socket.IPPROTO_IP, socket.IP_TOS),
    socket.AF_INET6: (socket.IPPROTO_IPV6, socket.IPV6_TCLASS),
}
"""What a socket of each family sends with; arrives as a control message of the same kind."""

_DISCOVERY_BYTES = 1 << 22

_RELEASED_S = 0.5
"""An executor that waits for endpoints of a participant lets go of it within a millisecond; on a
busy machine later."""


class OpenSocket(msgspec.Struct, frozen=True, kw_only=True):
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


def sockets_here() -> Iterator[socket.socket]:
    """Yield duplicates of this process's sockets; each is closed when the next is asked for.

    What is set on a duplicate is set on the original.
    """
    for number, to in open_files():
        if not to.startswith("socket:"):
            continue
        with contextlib.suppress(OSError):  # closed since, or no socket any more
            duplicate = os.dup(number)
            try:
                each = socket.socket(fileno=duplicate)
            except OSError:
                os.close(duplicate)
                continue
            with each:
                yield each


def open_sockets() -> tuple[OpenSocket, ...]:
    """Return the bound UDP and listening TCP sockets of this process."""
    found: dict[OpenSocket, None] = {}
    for each, bound in _bound_here():
        is_tcp = bound.kind.is_tcp
        if bound.port and (not is_tcp or each.getsockopt(socket.SOL_SOCKET, socket.SO_ACCEPTCONN)):
            found[bound] = None
    return tuple(found)


def _bound_here() -> Iterator[tuple[socket.socket, OpenSocket]]:
    """Yield as `sockets_here` does, with what each of them is bound to."""
    for each in sockets_here():
        if (kind := _KINDS.get((each.family, each.type))) is not None:
            address, port = each.getsockname()[:2]
            inode = os.fstat(each.fileno()).st_ino
            yield each, OpenSocket(inode=inode, kind=kind, address=_address(address), port=port)


def udp_sockets_of_others() -> Iterator[OpenSocket]:
    """Yield the UDP sockets of our network namespace that other processes have."""
    ours = {each.inode for each in open_sockets()}
    for kind in UDP_UNICAST:
        table = Path("/proc/thread-self/net", "udp6" if kind.ip_version == 6 else "udp")
        with contextlib.suppress(FileNotFoundError):  # a kernel without IPv6
            yield from (each for each, _ in sockets_in(table, kind) if each.inode not in ours)


def interface_addresses(*families: socket.AddressFamily) -> tuple[tuple[str, str], ...]:
    """Return each address of this host, AF_INET or AF_INET6, and the name of its interface."""
    import psutil  # 15 ms, which few processes need

    return tuple(
        (name, each.address.partition("%")[0])
        for name, addresses in psutil.net_if_addrs().items()
        for each in addresses
        if each.family in families
    )


def check_host(urls: Sequence[ConnectionUrl]) -> None:
    """Refuse URLs whose own address or interface this host has not, by MiddlewareError."""
    names = {name for _, name in socket.if_nameindex()}
    addresses = {text for _, text in interface_addresses(socket.AF_INET, socket.AF_INET6)}
    for url in urls:
        wanted = [each for each in url.interfaces if each not in names]
        if url.address and not url.transport.is_group and not is_wildcard(url.address):
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
    """Refuse URLs with a port that is taken, by MiddlewareError; who is leaving is waited for.

    Fast DDS 2.14 hangs for ever in the destruction of a participant that could not listen on its
    TCP port, so that must not be found out afterwards.
    """
    for url in urls:
        protocol = "TCP" if url.transport.is_tcp else "UDP"
        group = url.transport.is_group
        address = "" if group else url.address
        for what, port in (
            (protocol, None if group else url.port),  # a group's port is shared
            (f"{protocol} metatraffic port", url.metatraffic_port),
            (f"{protocol} output port", url.output_port),
        ):
            kind = udp_to(url.address) if group else url.transport
            if port is not None and not _becomes_free(kind, address, port):
                where = f"{url.address}:{port}" if url.address else f"port {port}"
                raise MiddlewareError(
                    f"cannot connect by {str(url)!r}: {what} {where} is not free on this host",
                    hint="end who has it (`ss -lnp`), or choose another port",
                )


def own_sockets(nfes: Sequence[NetworkFlowEndpoint]) -> Iterator[socket.socket]:
    """Yield those of `sockets_here` that `nfes` name; raises MiddlewareError if there is none."""
    wanted = {(nfe.medium, _address(nfe.internet_address), nfe.transport_port) for nfe in nfes}
    is_found = False
    for each, bound in _bound_here():
        if (bound.kind, bound.address, bound.port) in wanted:
            is_found = True
            yield each
    if not is_found:
        listed = ", ".join(f"{nfe.internet_address}:{nfe.transport_port}" for nfe in nfes)
        raise MiddlewareError(
            f"cannot find the sockets of this publisher among network flow endpoints [{listed}]: "
            "it has no UDP or TCP socket in this process",
            hint="a publisher that only has shared memory cannot be marked",
        )


def set_dscp(nfes: Sequence[NetworkFlowEndpoint], dscp: int) -> None:
    """Mark every socket of this process that `nfes` names, and read the marks back.

    Everything the participant sends carries the mark, 0–63, its discovery as well.

    Raises:
        MiddlewareError: no socket found, or the kernel kept another value.
    """
    for each in own_sockets(nfes):
        mark(each, dscp)


def mark(made: socket.socket, dscp: int) -> None:
    """Have a socket send with a DSCP, 0–63; raises MiddlewareError if the kernel does not."""
    option = DSCP_OPTION[made.family]
    try:
        made.setsockopt(*option, tos(dscp))
    except OSError as error:
        raise MiddlewareError(f"cannot set DSCP {dscp}: {error.strerror}") from error
    if (kept := made.getsockopt(*option) >> 2) != dscp:
        raise MiddlewareError(f"cannot set DSCP {dscp}: the kernel keeps {kept}")


def get_dscps(nfes: Sequence[NetworkFlowEndpoint]) -> set[int]:
    """Return every DSCP that the sockets named by `nfes` send with, see `own_sockets`."""
    return {each.getsockopt(*DSCP_OPTION[each.family]) >> 2 for each in own_sockets(nfes)}


def widen_discovery_buffers(domain_id: int) -> None:
    """Give the sockets on which this process receives discovery room for many participants.

    Fast DDS 2.14 leaves them the system's default, which holds a quarter of what twenty
    participants announce. Data keep their buffers: what waits in a large one is late.
    """
    first = participant_ports(domain_id, 0).discovery_multicast
    ports = range(first, first + DG, 2)
    for each in sockets_here():
        if each.type != socket.SOCK_DGRAM or each.family not in DSCP_OPTION:
            continue
        before = each.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF)
        if before < _DISCOVERY_BYTES and each.getsockname()[1] in ports:
            each.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _DISCOVERY_BYTES)


def _address(text: str) -> str:
    # A scope (fe80::1%eth0) distinguishes interfaces; rmw leaves it out.
    return canonical(text.partition("%")[0])


def _becomes_free(kind: Medium, address: str, port: int) -> bool:
    deadline = time.monotonic() + _RELEASED_S
    while True:
        with socket.socket(kind.socket_family, _TYPE[kind.is_tcp]) as probe:
            if kind.is_tcp:  # as Fast DDS does: connections that are over are not in the way
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            if kind.ip_version == 6:
                probe.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 1)
            with contextlib.suppress(OSError):
                probe.bind((address or kind.any_address, port))
                if kind.is_tcp:
                    probe.listen()
                return True
        if time.monotonic() >= deadline:
            return False
        time.sleep(0.001)


def sockets_in(table: Path, kind: Medium) -> Iterator[tuple[OpenSocket, str]]:
    """Yield what is bound by a table of proc(5), `net/udp` and the like, and its state in hex."""
    for line in table.read_text(encoding="ascii").splitlines()[1:]:
        fields = line.split()
        written, _, port = fields[1].partition(":")
        # An address is written as 32-bit integers in the host's byte order.
        words = [int(written[at : at + 8], 16) for at in range(0, len(written), 8)]
        address = socket.inet_ntop(kind.socket_family, struct.pack(f"={len(words)}I", *words))
        if number := int(port, 16):
            inode = int(fields[9])
            yield OpenSocket(inode=inode, kind=kind, address=address, port=number), fields[3]


_UNANSWERED = 2
"""Retransmissions in a row after which a connection is dead for a leaving process."""

_SYN_SENT = 2  # tcp_states.h
_ESTABLISHED = 1
_STATE, _RETRANSMITS, _PROBES = 0, 2, 3  # offsets in struct tcp_info


def give_up_dead_connections() -> None:
    """Shut down every TCP connection of this process that is not answered.

    For a process that is about to end: an accepted connection that is shut down is not made again.
    """
    for each in _connections():
        with contextlib.suppress(OSError):  # closed since
            if _is_dead(each):
                each.shutdown(socket.SHUT_RDWR)


def _connections() -> Iterator[socket.socket]:
    for each in sockets_here():
        if each.type == socket.SOCK_STREAM and each.family in (socket.AF_INET, socket.AF_INET6):
            yield each


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


def send_again_soon() -> None:
    """Make every TCP connection of this process retransmit within `AT_MOST_S`, for good.

    Without effect before Linux 6.15, which has no such option.
    """
    for each in _connections():
        with contextlib.suppress(OSError):  # closed since, or a kernel without the option
            each.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, _GIVES_UP_S * 1000)
            each.setsockopt(socket.IPPROTO_TCP, _TCP_RTO_MAX_MS, int(AT_MOST_S * 1000))
