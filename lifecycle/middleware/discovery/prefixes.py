"""GUID prefixes of Fast DDS: which process of which host a participant belongs to.

Fast DDS writes its vendor, the host, the process and a number of its own into the first 16 hex
digits (GuidPrefix_t::create); all participants of a process share them. Must not import rclpy.
"""

from __future__ import annotations

_HOST_DIGITS = slice(4, 8)
_PID_DIGITS = slice(8, 12)
PROCESS_DIGITS = 16


def is_of_process(prefix: str, pid: int, like: str) -> bool:
    """Return whether a participant may be one of a process of this host, by its GUID prefix.

    Fast DDS keeps the lower 16 bits of a pid: False is certain, True is not.

    Args:
        prefix: 24 hex digits.
        pid: of the process.
        like: the prefix of a participant on this host.
    """
    written = (pid & 0xFFFF).to_bytes(2, "little").hex()
    return is_of_host(prefix, like) and prefix[_PID_DIGITS] == written


def is_of_host(prefix: str, like: str) -> bool:
    """Return whether a participant is one of this host, by its GUID prefix.

    Args:
        prefix: 24 hex digits.
        like: the prefix of a participant on this host.
    """
    return prefix[: _HOST_DIGITS.stop] == like[: _HOST_DIGITS.stop]
