"""DSCP of a participant's sockets: IP_TOS and IPV6_TCLASS on those that its NFEs list.

Owns: these options (ip(7), ipv6(7), RFC 2474) on the sockets that a participant sends from: data,
and what its readers acknowledge; finding the sockets of this process by a network flow endpoint's
protocol, address and port among its descriptors (proc(5)), and reading them; and the receive
buffers of those on which it receives discovery.

Fast DDS 2.14 has no DSCP setting, always lists 0 in its NFEs and exposes no socket; the socket
option is what the kernel puts into packets. It needs no privilege.

A participant's UDP sender sockets all exist before its first publisher does: Fast DDS looks for
interfaces once, and opens none for one that appears later. TCP connections are opened later, are in
no NFE list, and are not marked.
"""

from __future__ import annotations

import contextlib
import ipaddress
import os
import socket
from collections.abc import Iterator, Sequence

from lifecycle.errors import MiddlewareError
from lifecycle.middleware.process.shared_memory import open_files
from lifecycle.network.nfe import InternetProtocol, NetworkFlowEndpoint, TransportProtocol
from lifecycle.network.ports import DG, participant_ports

_FAMILY = {InternetProtocol.IPV4: socket.AF_INET, InternetProtocol.IPV6: socket.AF_INET6}
_TYPE = {TransportProtocol.UDP: socket.SOCK_DGRAM, TransportProtocol.TCP: socket.SOCK_STREAM}


@contextlib.contextmanager
def own_sockets(nfes: Sequence[NetworkFlowEndpoint]) -> Iterator[list[socket.socket]]:
    """Yield duplicates of this process's sockets that `nfes` names; they are closed afterwards.

    Raises:
        MiddlewareError: there is none.
    """
    wanted = {
        (
            _FAMILY[nfe.internet_protocol],
            _TYPE[nfe.transport_protocol],
            _address(nfe.internet_address),
            nfe.transport_port,
        )
        for nfe in nfes
        if nfe.internet_protocol in _FAMILY and nfe.transport_protocol in _TYPE
    }
    with contextlib.ExitStack() as stack:
        found = [
            # Not by its own dup(), which would make the original wait where it must not.
            stack.enter_context(socket.socket(fileno=os.dup(each.fileno())))
            for each in sockets_here()
            if each.family in _FAMILY.values() and _key(each) in wanted
        ]
        if not found:
            listed = ", ".join(f"{nfe.internet_address}:{nfe.transport_port}" for nfe in nfes)
            raise MiddlewareError(
                f"cannot find the sockets of this publisher among network flow endpoints "
                f"[{listed}]: it has no UDP or TCP socket in this process",
                hint="a publisher that only has shared memory cannot be marked",
            )
        yield found


def own_udp_socket(family: int, port: int) -> socket.socket | None:
    """Return a duplicate of a UDP socket of this process that has this port; None if none has.

    What is set on it is set on the original. Close it.
    """
    for each in _own_udp_sockets():
        if each.family == family and each.getsockname()[1] == port:
            # Not by its own dup(), which would make the original wait where it must not.
            return socket.socket(fileno=os.dup(each.fileno()))
    return None


def own_udp_ports() -> frozenset[int]:
    """Return the ports of this process's UDP sockets."""
    return frozenset(each.getsockname()[1] for each in _own_udp_sockets())


def _own_udp_sockets() -> Iterator[socket.socket]:
    for each in sockets_here():
        if each.type == socket.SOCK_DGRAM and each.family in _FAMILY.values():
            yield each


def sockets_here() -> Iterator[socket.socket]:
    """Yield duplicates of this process's sockets; each is closed when the next is asked for.

    What is set on a duplicate is set on the original.
    """
    for number in socket_descriptors():
        with contextlib.suppress(OSError):  # closed since, or no socket any more
            duplicate = os.dup(number)
            try:
                each = socket.socket(fileno=duplicate)
            except OSError:
                os.close(duplicate)
                continue
            with each:
                yield each


def socket_descriptors() -> list[int]:
    """Return the descriptors of this process that are sockets."""
    return [number for number, to in open_files() if to.startswith("socket:")]


_DISCOVERY_BYTES = 1 << 22


def widen_discovery_buffers(domain_id: int) -> int:
    """Give the sockets on which this process receives discovery room for many participants.

    Fast DDS 2.14 leaves them the system's default, which holds some 160 small datagrams: twenty
    participants that announce their endpoints send four times as many, and what is lost is sent
    again. Data keep their buffers: what waits in a large one is late. The kernel gives twice what
    is asked for, and no more than twice net.core.rmem_max (socket(7)).

    Args:
        domain_id: 0–232; other ports than discovery's own of this domain stay as they are.

    Returns:
        How many sockets have more room than before.
    """
    first = participant_ports(domain_id, 0).discovery_multicast
    ports = range(first, first + DG, 2)
    count = 0
    for each in _own_udp_sockets():
        before = each.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF)
        if before < _DISCOVERY_BYTES and each.getsockname()[1] in ports:
            each.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _DISCOVERY_BYTES)
            count += each.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) > before
    return count


def _key(each: socket.socket) -> tuple[int, int, str, int]:
    address = each.getsockname()
    return each.family, each.type, _address(address[0]), address[1]


def _address(text: str) -> str:
    try:
        # A scope (fe80::1%eth0) distinguishes interfaces; rmw leaves it out.
        return str(ipaddress.ip_address(text.partition("%")[0]))
    except ValueError:
        return text


def where(each: socket.socket) -> str:
    """Return a socket's own address for messages, `0.0.0.0:7411`."""
    address = each.getsockname()
    return f"{address[0]}:{address[1]}"


_OPTION = {
    socket.AF_INET: (socket.IPPROTO_IP, socket.IP_TOS),
    socket.AF_INET6: (socket.IPPROTO_IPV6, socket.IPV6_TCLASS),
}
_MAX_DSCP = 63


def set_dscp(nfes: Sequence[NetworkFlowEndpoint], dscp: int) -> int:
    """Mark every socket of this process that `nfes` names, and read the marks back.

    The mark is the socket's: everything the participant sends from it carries the mark, its
    discovery as well. The two ECN bits of the byte stay 0.

    Args:
        nfes: of a publisher of this process.
        dscp: 0–63.

    Returns:
        The number of sockets marked, at least 1.

    Raises:
        MiddlewareError: `dscp` out of range, no socket found, or the kernel kept another value.
    """
    check_dscp(dscp)
    marked = 0
    with own_sockets(nfes) as sockets:
        for each in sockets:
            try:
                each.setsockopt(*_OPTION[each.family], dscp << 2)
            except OSError as error:
                raise MiddlewareError(
                    f"cannot set DSCP {dscp} on {where(each)}: {error.strerror}"
                ) from error
            marked += 1
    found = get_dscp(nfes)
    if found != dscp:
        raise MiddlewareError(f"cannot set DSCP {dscp}: the kernel keeps {found}")
    return marked


def get_dscp(nfes: Sequence[NetworkFlowEndpoint]) -> int:
    """Return the DSCP (0–63) that the sockets named by `nfes` send with, asked of the kernel.

    Raises:
        MiddlewareError: no socket found, or they differ.
    """
    values = _read(nfes)
    distinct = set(values.values())
    if len(distinct) != 1:
        raise MiddlewareError(
            "cannot tell one DSCP: "
            + ", ".join(f"{name} sends with {value}" for name, value in sorted(values.items()))
        )
    return distinct.pop()


def get_dscps(nfes: Sequence[NetworkFlowEndpoint]) -> set[int]:
    """Return every DSCP that the sockets named by `nfes` send with; one if all are marked alike.

    Raises:
        MiddlewareError: no socket found.
    """
    return set(_read(nfes).values())


def check_dscp(dscp: int) -> None:
    """Refuse what is not a DSCP, a TOS byte with ECN bits in particular.

    Raises:
        MiddlewareError: `dscp` is not 0–63.
    """
    if 0 <= dscp <= _MAX_DSCP:
        return
    hint = ""
    if _MAX_DSCP < dscp <= 0xFF:
        hint = f"as a TOS byte, {dscp} is DSCP {dscp >> 2}"
        if dscp & 3:
            hint += " with ECN bits set, which belong to the network (RFC 3168)"
    raise MiddlewareError(f"cannot use DSCP {dscp}: allowed are 0–{_MAX_DSCP}", hint=hint)


def _read(nfes: Sequence[NetworkFlowEndpoint]) -> dict[str, int]:
    with own_sockets(nfes) as sockets:
        return {where(each): each.getsockopt(*_OPTION[each.family]) >> 2 for each in sockets}
