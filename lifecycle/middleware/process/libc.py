"""The C library, for what Python does not wrap. Owns: loading it, and timers' arguments."""

from __future__ import annotations

import ctypes
import functools

CLOCK_MONOTONIC = 1
_NS = 1_000_000_000


class TimerSpec(ctypes.Structure):
    """One expiry of a timer, `struct itimerspec`."""

    _fields_ = (
        ("interval_s", ctypes.c_long),
        ("interval_ns", ctypes.c_long),
        ("value_s", ctypes.c_long),
        ("value_ns", ctypes.c_long),
    )

    @classmethod
    def once(cls, ns: int) -> TimerSpec:
        """Return a timer that expires once after so many nanoseconds; 0 turns it off."""
        return cls(value_s=ns // _NS, value_ns=ns % _NS)


@functools.lru_cache(maxsize=1)
def libc() -> ctypes.CDLL:
    """Return it; `ctypes.get_errno()` tells what failed."""
    return ctypes.CDLL(None, use_errno=True)
