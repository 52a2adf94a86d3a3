"""What Python does not offer of Linux's process control: prctl(2), capset(2), a timer that exits.

Owns: the C library, called through ctypes. Must not import rclpy: a fork server uses it before
rclpy is loaded.
"""

from __future__ import annotations

import ctypes
import functools
import os
import signal
import struct
import time
from collections.abc import Callable

from lifecycle.errors import MiddlewareError

_PR_SET_CHILD_SUBREAPER = 36
_PR_SET_NO_NEW_PRIVS = 38
_PR_CAP_AMBIENT = 47
_PR_CAP_AMBIENT_LOWER = 3
_CAP_NET_ADMIN = 12
_CAPABILITY_VERSION_3 = 0x20080522
_SIGEV_THREAD = 2

_KILLED_S = 0.5
"""After the end by `_exit` comes SIGALRM, where no thread could be started for that."""


@functools.lru_cache(maxsize=1)
def _libc() -> ctypes.CDLL:
    return ctypes.CDLL(None, use_errno=True)


def adopt_orphans() -> None:
    """Become the parent of every descendant whose own parent dies (PR_SET_CHILD_SUBREAPER).

    They then can be found, signalled and waited for, also after a crash of what was between.

    Raises:
        MiddlewareError: the kernel refused.
    """
    _prctl(_PR_SET_CHILD_SUBREAPER, 1)


def refuse_new_privileges() -> None:
    """Keep this process, and all that it starts, from gaining privileges by execve(2).

    Raises:
        MiddlewareError: the kernel refused.
    """
    _prctl(_PR_SET_NO_NEW_PRIVS, 1)


def drop_network_administration() -> None:
    """Give up CAP_NET_ADMIN, see capabilities(7), for this process and all that it starts.

    What root starts has it again, by the rules for root.

    Raises:
        MiddlewareError: the kernel refused.
    """
    # struct __user_cap_header_struct, and two of __user_cap_data_struct: effective, permitted and
    # inheritable of capabilities 0 to 31 in the first.
    header = struct.pack("=Ii", _CAPABILITY_VERSION_3, 0)
    sets = ctypes.create_string_buffer(24)
    if _libc().capget(header, sets) != 0:
        raise _failed("capget")
    words = struct.unpack("=6I", sets)
    kept = 0xFFFFFFFF ^ (1 << _CAP_NET_ADMIN)
    sets.raw = struct.pack("=6I", *(each & kept for each in words[:3]), *words[3:])
    _prctl(_PR_CAP_AMBIENT, _PR_CAP_AMBIENT_LOWER, _CAP_NET_ADMIN)
    if _libc().capset(header, sets) != 0:
        raise _failed("capset")


def exit_after(seconds: float, code: int) -> Callable[[], None]:
    """End this process with `code` after `seconds`, whatever its threads do by then.

    glibc runs `_exit(code)` itself on a thread of its own, without Python: it also ends a process
    that hangs in C++ with the GIL held, which no Python thread or signal handler can. Where the
    limit of threads is reached, SIGALRM ends it instead.

    Args:
        seconds: > 0.
        code: 0–255.

    Returns:
        A function that lets it live after all.
    """
    signal.setitimer(signal.ITIMER_REAL, seconds + _KILLED_S)
    exits = ctypes.cast(_libc()._exit, ctypes.c_void_p).value  # noqa: SLF001 - C's name
    # struct sigevent: value, signal, how, function; glibc pads it to 64 bytes.
    ends = struct.pack("qiiP", code, 0, _SIGEV_THREAD, exits).ljust(64, b"\0")
    timer = ctypes.c_void_p()
    clock = time.CLOCK_MONOTONIC
    is_made = _libc().timer_create(clock, ends, ctypes.byref(timer)) == 0

    def arm(ns: int) -> None:
        # struct itimerspec: the interval, then the value, of seconds and nanoseconds each.
        spec = (ctypes.c_long * 4)(0, 0, *divmod(ns, 1_000_000_000))
        if is_made:
            _libc().timer_settime(timer, 0, spec, None)

    def live_on() -> None:
        signal.setitimer(signal.ITIMER_REAL, 0)
        arm(0)

    arm(round(seconds * 1e9))
    return live_on


def _prctl(option: int, *arguments: int) -> None:
    words = (ctypes.c_ulong(each) for each in (*arguments, 0, 0, 0, 0)[:4])
    if _libc().prctl(option, *words) != 0:
        raise _failed("prctl")


def _failed(call: str) -> MiddlewareError:
    return MiddlewareError(f"cannot use {call}: {os.strerror(ctypes.get_errno())}")
