"""DSCP marks on the sockets that a participant sends from: data, and what its readers acknowledge.

Owns: their IP_TOS and IPV6_TCLASS options (ip(7), ipv6(7), RFC 2474). Fast DDS 2.14 has no DSCP
setting and always lists 0 in its NFEs; the socket option is what the kernel puts into packets. It
needs no privilege.

A participant's UDP sender sockets are all there before its first publisher is: Fast DDS looks for
interfaces once, and opens none for one that appears later (measured: neither a new interface nor a
new peer changes them). TCP connections come later, are in no NFE list, and are not marked.
"""

from __future__ import annotations

import socket
from collections.abc import Sequence

from lifecycle.errors import MiddlewareError
from lifecycle.middleware.sockets.sockets import own_sockets, where
from lifecycle.network.nfe import NetworkFlowEndpoint

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
