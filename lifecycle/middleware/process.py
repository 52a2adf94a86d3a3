"""Process control that Python's standard library lacks.

Owns: prctl(2) and the deadman timer of timer_create(2), both through ctypes. Linux only. Must not
import rclpy: a fork server uses it before rclpy is loaded.
"""

from __future__ import annotations

import ctypes
import os
import signal
from collections.abc import Callable

from lifecycle.errors import MiddlewareError
from lifecycle.middleware.libc import CLOCK_MONOTONIC, TimerSpec, libc

_PR_SET_PDEATHSIG = 1
_PR_SET_CHILD_SUBREAPER = 36
_SIGEV_THREAD = 2


class _SignalEvent(ctypes.Structure):
    # struct sigevent: glibc pads it to 64 bytes.
    _fields_ = (
        ("value", ctypes.c_int64),  # union sigval
        ("signo", ctypes.c_int),
        ("notify", ctypes.c_int),
        ("function", ctypes.c_void_p),
        ("attributes", ctypes.c_void_p),
        ("padding", ctypes.c_char * 32),
    )


def die_with_parent(signal_number: signal.Signals = signal.SIGKILL) -> None:
    """Have the kernel signal this process when the thread that started it ends.

    Call it in the child and then compare `os.getppid()` with the parent's pid: a parent that died
    before the call is not noticed by it (PR_SET_PDEATHSIG, prctl(2)). Lost over exec of a set-uid
    program, kept over any other.

    Raises:
        MiddlewareError: the kernel refused.
    """
    _prctl(_PR_SET_PDEATHSIG, int(signal_number))


def adopt_orphans() -> None:
    """Become the parent of every descendant whose own parent dies (PR_SET_CHILD_SUBREAPER).

    They then can be found, signalled and waited for, also after a crash of what stood between.

    Raises:
        MiddlewareError: the kernel refused.
    """
    _prctl(_PR_SET_CHILD_SUBREAPER, 1)


def exit_after(seconds: float, code: int) -> Callable[[], None]:
    """End this process with `code` after `seconds`, whatever its threads do by then.

    glibc runs `_exit(code)` itself on a thread of its own, without Python: it also ends a process
    that hangs in C++ with the GIL held, which no Python thread or signal handler can.

    Args:
        seconds: > 0.
        code: 0–255.

    Returns:
        A function that lets it live after all.

    Raises:
        MiddlewareError: the kernel refused.
        ValueError: out of range.
    """
    if seconds <= 0 or not 0 <= code <= 0xFF:
        raise ValueError(f"cannot exit with {code} after {seconds} s: 0–255 after more than 0 s")
    create, arm = _timer_functions()
    event = _SignalEvent(
        value=code,
        notify=_SIGEV_THREAD,
        function=ctypes.cast(libc()._exit, ctypes.c_void_p),  # noqa: SLF001 - C's name
    )
    timer = ctypes.c_void_p()
    spec = TimerSpec.once(round(seconds * 1e9))
    if create(CLOCK_MONOTONIC, ctypes.byref(event), ctypes.byref(timer)) != 0:
        raise _failed("timer_create")
    if arm(timer, 0, ctypes.byref(spec), None) != 0:
        raise _failed("timer_settime")

    def live_on() -> None:
        if arm(timer, 0, ctypes.byref(TimerSpec()), None) != 0:
            raise _failed("timer_settime")

    return live_on


def _prctl(option: int, argument: int) -> None:
    if libc().prctl(option, ctypes.c_ulong(argument), 0, 0, 0) != 0:
        raise _failed("prctl")


def _timer_functions() -> tuple[ctypes._NamedFuncPointer, ctypes._NamedFuncPointer]:
    try:
        return libc().timer_create, libc().timer_settime
    except AttributeError:  # before glibc 2.34 they are in librt
        librt = ctypes.CDLL("librt.so.1", use_errno=True)
        return librt.timer_create, librt.timer_settime


def _failed(call: str) -> MiddlewareError:
    return MiddlewareError(f"cannot use {call}: {os.strerror(ctypes.get_errno())}")
