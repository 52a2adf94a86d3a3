"""DSCP (differentiated services code point): names, numbers, TOS byte, TRANSPORT_PRIORITY mapping.

Owns: every spelling of a DSCP that a user may write or read; TRANSPORT_PRIORITY → TOS byte as RTI
Connext Micro computes it (*Connext Micro, Transport Priority*), and what that silently loses. Pure.

A DSCP is the upper six bits of the byte that IPv4 calls TOS and IPv6 calls traffic class; the lower
two are ECN (RFC 2474, RFC 3168). Products differ in which of the two numbers they ask for, so both
are always shown side by side.
"""

from __future__ import annotations

import functools
import re

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


@functools.cache
def _by_number() -> dict[int, CodePoint]:
    return {each.dscp: each for each in code_points()}


def parse_dscp(value: str | int) -> int:
    """Return the DSCP, 0–63, that a user wrote as a name (any case) or as a number.

    Numbers may be decimal or hexadecimal (`0x2e`) text.

    Raises:
        ValueError: neither a name nor a number in range; names the nearest name, or which DSCP was
            meant when the number is a TOS byte.
    """
    # YAML reads `yes` and `on` as booleans, and bool is an int: True is not DSCP 1.
    if isinstance(value, bool):
        raise ValueError(  # noqa: TRY004 - callers report every refusal alike
            f"cannot use {value!r} as DSCP; use 0 to {MAX_DSCP} or a name such as EF"
        )
    number = value if isinstance(value, int) else _number(value.strip())
    if number is None:
        return _named(str(value))
    if 0 <= number <= MAX_DSCP:
        return number
    hint = ""
    if 0 <= number <= 0xFF:  # a TOS byte, most probably
        name = f" ({_by_number()[number >> 2].name})" if number >> 2 in _by_number() else ""
        ecn = " and sets ECN bits" if number & ECN_MASK else ""
        hint = f"; {number} is a TOS byte{ecn}: DSCP {number >> 2}{name}"
    raise ValueError(f"cannot use DSCP {value}; use 0 to {MAX_DSCP} or a name such as EF{hint}")


def _number(text: str) -> int | None:
    """The decimal or hexadecimal number that `text` spells, else None."""
    # int() reads more than we document ("1_0", other scripts' digits) and refuses 4301 digits.
    if not re.fullmatch(r"-?(0[xX][0-9a-fA-F]{1,8}|[0-9]{1,9})", text):
        return None
    return int(text, 16 if "x" in text.lower() else 10)


def _named(text: str) -> int:
    name = text.strip().upper().replace("_", "-")
    if (found := _by_name().get(name)) is not None:
        return found.dscp
    import difflib  # only a mistake needs it

    close = difflib.get_close_matches(name, _by_name(), n=len(_by_name()))
    # Many names are equally near (AF14: AF13, AF41); people mistype the last digit, not the first.
    nearest = max(close, key=lambda each: each[:-1] == name[:-1], default="")
    hint = f"; did you mean {nearest}?" if nearest else ""
    names = ", ".join(each.name for each in code_points())
    raise ValueError(f"cannot use {text!r} as DSCP; use 0 to {MAX_DSCP} or one of {names}{hint}")


def dscp_name(dscp: int) -> str:
    """Return the code point's name, or the number in decimal where it has none.

    `parse_dscp` reads either back, and refuses what is not 0–63.
    """
    number = parse_dscp(dscp)
    return _by_number()[number].name if number in _by_number() else str(number)


def tos(dscp: int) -> int:
    """Return the TOS byte (IPv4) or traffic class (IPv6) that carries this DSCP, ECN clear."""
    return parse_dscp(dscp) << 2


def describe(dscp: int) -> str:
    """Return DSCP and TOS side by side: `EF = DSCP 46 = TOS 184 (0xb8)`."""
    name = dscp_name(dscp)
    prefix = "" if name.isdecimal() else f"{name} = "
    return f"{prefix}DSCP {dscp} = TOS {tos(dscp)} (0x{tos(dscp):02x})"


_BITS_32 = 0xFFFFFFFF


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


class MappedPriority(msgspec.Struct, frozen=True, kw_only=True):
    """What becomes of one TRANSPORT_PRIORITY value.

    Attributes:
        tos: 0–255; None if the mask is 0 and the TOS byte is not set.
        ignored_bits: bits of the priority that made no difference: outside the mask or shifted out.
    """

    tos: int | None
    ignored_bits: int

    @property
    def dscp(self) -> int | None:
        """0–63; None if nothing is set, or ECN bits would be."""
        return None if self.tos is None or self.sets_ecn else self.tos >> 2

    @property
    def sets_ecn(self) -> bool:
        """Whether the result would write the two ECN bits, which belong to the transport."""
        return self.tos is not None and bool(self.tos & ECN_MASK)


def map_priority(priority: int, mapping: TransportPriorityMapping) -> MappedPriority:
    """Return the TOS byte for a TRANSPORT_PRIORITY value, in integer arithmetic.

    Let n be the number of 4-bit right shifts until `mask & 0xffff0000` is 0. Then
    `TOS = ((priority & mask) >> 4n) * (high - low) / (mask >> 4n) + low`.
    """
    bits = priority & _BITS_32
    if mapping.mask == 0:
        return MappedPriority(tos=None, ignored_bits=bits)
    shift = 0
    while (mapping.mask >> shift) & 0xFFFF0000:
        shift += 4
    masked, mask = (bits & mapping.mask) >> shift, mapping.mask >> shift
    return MappedPriority(
        tos=masked * (mapping.high - mapping.low) // mask + mapping.low,
        ignored_bits=bits & ~(masked << shift),
    )
