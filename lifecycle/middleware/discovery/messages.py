"""RTPS messages about participants that are written here, in the name of another.

Owns: the announcement of a participant that does not exist, as DDSI-RTPS 2.3 writes it (§8.3.5,
§9.4, §9.6.2.2), and the message by which a participant leaves (§8.5.3.3.2, §9.6.3.4, §9.6.3.9).
Must not import rclpy.
"""

from __future__ import annotations

import ipaddress
import os
import re
import struct
import time
from collections.abc import Iterable

HEADER = b"RTPS\x02\x03\x01\x0f"  # protocol 2.3, vendor eProsima: would others be answered?
PREFIX_BYTES = 12
_UDPV4, _UDPV6 = 1, 2
"""LOCATOR_KIND_UDPv4 and LOCATOR_KIND_UDPv6 (DDSI-RTPS 9.3.1)."""

_SEQUENCE = 1 << 30
"""Sequence number of a disposal: above all that the participant itself has written."""

_SPDP_READER, _SPDP_WRITER = b"\x00\x01\x00\xc7", b"\x00\x01\x00\xc2"
_PARTICIPANT = b"\x00\x00\x01\xc1"
_PL_CDR_LE = b"\x00\x03\x00\x00"
_INLINE_QOS, _DATA, _KEY = 0x02, 0x04, 0x08  # flags of DATA; 0x01 is little endian


def _parameters(parameters: Iterable[tuple[int, bytes]]) -> bytes:
    return b"".join(struct.pack("<HH", pid, len(value)) + value for pid, value in parameters)


_PID_SENTINEL = _parameters([(0x0001, b"")])
_STATUS = _parameters([(0x0071, b"\x00\x00\x00\x03")])
"""PID_STATUS_INFO: disposed and unregistered."""
PROBE_ENDPOINTS = _parameters(
    [(0x0058, struct.pack("<I", 0x3))]  # PID_BUILTIN_ENDPOINT_SET: announcer and detector only
)
"""By which announcements of participants that do not exist are known, also those of others."""


_LOCATOR = re.compile(rb"\x32\x00\x18\x00[\x01\x02]\x00\x00\x00(.{4})", re.DOTALL)
"""PID_METATRAFFIC_UNICAST_LOCATOR over UDP, and its port."""
_SWAPPED = re.compile(rb"\x00\x32\x00\x18\x00\x00\x00[\x01\x02](.{4})", re.DOTALL)
"""The same of a big-endian participant."""


def announced_prefix(data: bytes) -> str:
    """Return the GUID prefix of the participant that announced itself; empty if none did."""
    if len(data) <= len(HEADER) + PREFIX_BYTES or not data.startswith(b"RTPS"):
        return ""
    if PROBE_ENDPOINTS in data or _STATUS in data:
        return ""
    return data[len(HEADER) : len(HEADER) + PREFIX_BYTES].hex()


def announced_ports(data: bytes) -> frozenset[int]:
    """Return the UDP ports at which a participant that announced itself receives discovery."""
    found = {int.from_bytes(each[1], "little") for each in _LOCATOR.finditer(data)}
    return frozenset(found | {int.from_bytes(each[1], "big") for each in _SWAPPED.finditer(data)})


def new_prefix() -> str:
    """Return the GUID prefix of a new, random participant, 24 hex digits."""
    return (b"\x01\x0f" + os.urandom(PREFIX_BYTES - 2)).hex()


def announcement(prefix: str, locators: Iterable[tuple[str, int]], lease_s: float) -> bytes:
    """Return a DATA(p) of a participant that can be answered at `locators`.

    Args:
        prefix: its GUID prefix, see `new_prefix`.
        locators: (IP address, UDP port).
        lease_s: seconds, > 0, after which peers drop it if they receive no disposal.
    """
    seconds, rest = divmod(lease_s, 1)
    parameters = [
        (0x0015, b"\x02\x03\x00\x00"),  # PID_PROTOCOL_VERSION
        (0x0016, b"\x01\x0f\x00\x00"),  # PID_VENDORID
        (0x0050, bytes.fromhex(prefix) + _PARTICIPANT),  # PID_PARTICIPANT_GUID
        # PID_PARTICIPANT_LEASE_DURATION
        (0x0002, struct.pack("<iI", int(seconds), int(rest * 2**32))),
    ]
    located = []
    for address, port in locators:
        packed = ipaddress.ip_address(address).packed
        kind = _UDPV6 if len(packed) == 16 else _UDPV4
        locator = struct.pack("<iI", kind, port) + packed.rjust(16, b"\0")
        located.append((0x0032, locator))  # PID_METATRAFFIC_UNICAST_LOCATOR
        located.append((0x0031, locator))  # PID_DEFAULT_UNICAST_LOCATOR
    content = _parameters(parameters) + PROBE_ENDPOINTS + _parameters(located) + _PID_SENTINEL
    return _message(prefix, 1, _DATA, _PL_CDR_LE + content)


def disposal(prefix: str) -> bytes:
    """Return the RTPS message by which a participant leaves the graph.

    Args:
        prefix: its GUID prefix, 24 hex digits.
    """
    guid = bytes.fromhex(prefix) + _PARTICIPANT
    inline_qos = _parameters([(0x0070, guid)]) + _STATUS + _PID_SENTINEL  # PID_KEY_HASH
    key = _PL_CDR_LE + _parameters([(0x0050, guid)]) + _PID_SENTINEL
    return _message(prefix, _SEQUENCE, _INLINE_QOS | _KEY, inline_qos + key)


def _message(prefix: str, sequence: int, flags: int, content: bytes) -> bytes:
    """Return one DATA of a participant's announcer, with its time."""
    info_timestamp = struct.pack("<BBHII", 0x09, 0x01, 8, int(time.time()), 0)
    body = struct.pack("<HH", 0, 16) + _SPDP_READER + _SPDP_WRITER
    body += struct.pack("<iI", 0, sequence) + content
    data = struct.pack("<BBH", 0x15, 0x01 | flags, len(body)) + body
    return HEADER + bytes.fromhex(prefix) + info_timestamp + data
