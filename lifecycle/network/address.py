"""Internet addresses as text: one spelling each, and when two of them may be the same interface.

Owns: canonical spelling and the scope rules of RFC 4007 and RFC 6890. Pure.
"""

from __future__ import annotations

import functools
import ipaddress

IpAddress = ipaddress.IPv4Address | ipaddress.IPv6Address


@functools.lru_cache(maxsize=4096)
def parse_address(text: str) -> IpAddress | None:
    """Return the address that `text` spells, else None (empty, a host name, …)."""
    try:
        return ipaddress.ip_address(text)
    except ValueError:
        return None


@functools.lru_cache(maxsize=4096)
def canonical(text: str) -> str:
    """Return the one spelling of an address (RFC 5952); text that is none is returned unchanged."""
    address = parse_address(text)
    return text if address is None else str(address)


def socket_text(address: str, port: int) -> str:
    """Return address and port as URLs write them: `10.0.0.1:7411`, `[fd00::1]:7411`."""
    return f"[{address}]:{port}" if ":" in address else f"{address}:{port}"


@functools.lru_cache(maxsize=4096)
def is_wildcard(text: str) -> bool:
    """Whether this is `0.0.0.0` or `::`, which means every unicast address of its host."""
    address = parse_address(text)
    return address is not None and address.is_unspecified


@functools.lru_cache(maxsize=4096)
def is_multicast(text: str) -> bool:
    """Whether this is a group, which is the same destination from wherever it is named."""
    address = parse_address(text)
    return address is not None and address.is_multicast


def is_loopback(text: str) -> bool:
    """Whether this address never leaves its host."""
    address = parse_address(text)
    return address is not None and address.is_loopback


def may_be_same(a: str, b: str, *, same_machine: bool | None) -> bool:
    """Return whether packets of two sockets with these local addresses can carry one address.

    - Groups and global addresses are the same where their spelling is: the network cannot
      distinguish two machines that claim one address.
    - `0.0.0.0` and `::` mean every unicast address of their machine.
    - Loopback and link-local addresses mean something on their own machine and link only
      (RFC 6890, RFC 4007).

    Args:
        a: textual address of one socket.
        b: textual address of the other.
        same_machine: whether both are on one machine; None when that is not known, which answers
            "may be" wherever it matters.
    """
    one, other = parse_address(a), parse_address(b)
    if one is None or other is None:
        return a == b
    if one.is_multicast or other.is_multicast:
        return one == other
    remote_nodes = same_machine is False
    if one.is_unspecified or other.is_unspecified:
        return not remote_nodes
    local = one.is_loopback or one.is_link_local
    return _equal(one, other) and not (local and remote_nodes)


def _equal(one: IpAddress, other: IpAddress) -> bool:
    """Equal, an IPv6 zone counting only where both name one."""
    if isinstance(one, ipaddress.IPv6Address) and isinstance(other, ipaddress.IPv6Address):
        zones_differ = one.scope_id and other.scope_id and one.scope_id != other.scope_id
        return one.packed == other.packed and not zones_differ
    return one == other
