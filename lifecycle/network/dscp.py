"""DSCP (differentiated services code point): names, numbers, TOS byte, TRANSPORT_PRIORITY mapping.

Owns: how users write and read a DSCP; TRANSPORT_PRIORITY → TOS byte as RTI Connext Micro computes
it (*Connext Micro, Transport Priority*). Pure.

A DSCP is the upper six bits of the byte that IPv4 calls TOS and IPv6 calls traffic class; the lower
two are ECN (RFC 2474, RFC 3168). Products differ in which of the two numbers they ask for, so both
are always shown side by side.
"""

from __future__ import annotations

import functools

import msgspec

from lifecycle.codec import Octet, UInt32, read_table

MAX_DSCP = 63
"""Six bits."""

ECN_MASK = 0b11
"""The two lower bits of the TOS byte; Linux sends them as given to IP_TOS."""


class CodePoint(msgspec.Struct, frozen=True, kw_only=True):
    """One named code point; the table also has its RFC, behaviour and service class."""

    name: str
    dscp: int
    aliases: tuple[str, ...]


class _DscpTable(msgspec.Struct, frozen=True, kw_only=True):
    code_points: tuple[CodePoint, ...]


@functools.cache
def code_points() -> tuple[CodePoint, ...]:
    """Every named code point, by rising number."""
    return read_table("dscp", _DscpTable).code_points


@functools.cache
def _by_name() -> dict[str, CodePoint]:
    return {name: each for each in code_points() for name in (each.name, *each.aliases)}


def parse_dscp(value: str | int) -> int:
    """Return the DSCP, 0–63, of a name as in the table, or of a number.

    Raises:
        ValueError: neither a name nor a number in range.
    """
    number = _by_name()[value].dscp if value in _by_name() else value
    # YAML reads `yes` and `on` as booleans, and bool is an int: True is not DSCP 1.
    if isinstance(number, bool) or number not in range(MAX_DSCP + 1):
        names = ", ".join(each.name for each in code_points())
        raise ValueError(f"cannot use {value!r} as DSCP; use 0 to {MAX_DSCP} or one of {names}")
    return int(number)


def dscp_name(dscp: int) -> str:
    """Return the code point's name, or the number in decimal where it has none."""
    return next((each.name for each in code_points() if each.dscp == dscp), str(dscp))


def tos(dscp: int) -> int:
    """Return the TOS byte (IPv4) or traffic class (IPv6) that carries this DSCP, ECN clear."""
    return dscp << 2


def describe(dscp: int) -> str:
    """Return DSCP and TOS side by side: `EF = DSCP 46 = TOS 184 (0xb8)`."""
    name = dscp_name(dscp)
    prefix = "" if name.isdecimal() else f"{name} = "
    return f"{prefix}DSCP {dscp} = TOS {tos(dscp)} (0x{tos(dscp):02x})"


class TransportPriorityMapping(
    msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True
):
    """How a 'transport_priority' becomes a TOS byte, as RTI Connext Micro computes it.

    These are UDPInterfaceFactoryProperty's three transport priority fields.

    Attributes:
        mask: Bits of the priority that take part; 0xFF with the defaults of 'low' and 'high' takes
            the priority as the TOS byte, 0 sets nothing.
        low: TOS byte of the lowest priority.
        high: TOS byte of the highest priority, not below 'low'.
    """

    mask: UInt32
    low: Octet = 0
    high: Octet = 0xFF


DIRECT = TransportPriorityMapping(mask=0xFF)
"""Takes the priority as the TOS byte: Connext Micro's mapping "as-is"."""


def map_priority(priority: int, mapping: TransportPriorityMapping) -> int | None:
    """Return the TOS byte for a TRANSPORT_PRIORITY value; None if the mask is 0: none is set.

    Let n be the number of 4-bit right shifts until `mask & 0xffff0000` is 0. Then
    `TOS = ((priority & mask) >> 4n) * (high - low) / (mask >> 4n) + low`, in integers.
    """
    shift = 0
    while (mapping.mask >> shift) & 0xFFFF0000:
        shift += 4
    mask = mapping.mask >> shift
    if not mask:
        return None
    masked = (priority & mapping.mask) >> shift
    return masked * (mapping.high - mapping.low) // mask + mapping.low
