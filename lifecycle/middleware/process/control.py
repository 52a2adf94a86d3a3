"""Linux process control through ctypes: prctl(2), the deadman timer, and the C library.

Owns: prctl(2), the deadman timer of timer_create(2), loading the C library and its timers'
arguments, addresses of interfaces, and whether there is room for a participant. Linux only. Must
not import rclpy: a fork server uses it before rclpy is loaded.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import mmap
import os
import resource
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterable
from pathlib import Path

from lifecycle.errors import MiddlewareError

_NS = 1_000_000_000

MACHINE_ID_VARIABLE = "LIFECYCLE_MACHINE_ID"
"""Names the machine where the files cannot: containers and network namespaces that are hosts of
their own share /etc/machine-id or have none, and always share the kernel's boot id."""


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
    """Return it; `ctypes.get_errno()` says what failed."""
    return ctypes.CDLL(None, use_errno=True)


_PR_SET_CHILD_SUBREAPER = 36
_PR_SET_NO_NEW_PRIVS = 38
_PR_CAP_AMBIENT = 47
_PR_CAP_AMBIENT_LOWER = 3
_CAP_NET_ADMIN = 12
_CAPABILITY_VERSION_3 = 0x20080522
_SIGEV_SIGNAL = 0
_SIGEV_THREAD = 2

_KILLED_S = 0.5
"""Between the end by `_exit` and that by SIGKILL, which is used where no thread can be started."""


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


def limit_resources(limits: Iterable[tuple[str, int]]) -> None:
    """Limit what this process may use, and all that it starts.

    Args:
        limits: name and value of setrlimit(2), `RLIMIT_NOFILE` and the like. Both limits are set,
            and that of processor time so that a signal ends it that says why.

    Raises:
        MiddlewareError: one is more than is allowed.
    """
    for name, value in limits:
        number = getattr(resource, name)
        hard = value + 1 if number == resource.RLIMIT_CPU else value  # there it is SIGKILL
        try:
            resource.setrlimit(number, (value, hard))
        except (OSError, ValueError) as error:
            most = resource.getrlimit(number)[1]
            raise MiddlewareError(
                f"cannot set {name} to {value}: {error}; allowed: {most}"
            ) from error


class _CapabilityHeader(ctypes.Structure):
    _fields_ = (("version", ctypes.c_uint32), ("pid", ctypes.c_int))


class _CapabilitySets(ctypes.Structure):
    # The first of two has capabilities 0 to 31.
    _fields_ = (
        ("effective", ctypes.c_uint32),
        ("permitted", ctypes.c_uint32),
        ("inheritable", ctypes.c_uint32),
    )


def drop_network_administration() -> None:
    """Give up CAP_NET_ADMIN, see capabilities(7), for this process and all that it starts.

    What root starts has it again, by the rules for root.

    Raises:
        MiddlewareError: the kernel refused.
    """
    header = _CapabilityHeader(_CAPABILITY_VERSION_3, 0)
    sets = (_CapabilitySets * 2)()
    if libc().capget(ctypes.byref(header), sets) != 0:
        raise _failed("capget")
    kept = 0xFFFFFFFF ^ (1 << _CAP_NET_ADMIN)
    sets[0].effective &= kept
    sets[0].permitted &= kept
    sets[0].inheritable &= kept
    _prctl(_PR_CAP_AMBIENT, _PR_CAP_AMBIENT_LOWER, _CAP_NET_ADMIN)
    if libc().capset(ctypes.byref(header), sets) != 0:
        raise _failed("capset")


def exit_after(seconds: float, code: int) -> Callable[[], None]:
    """End this process with `code` after `seconds`, whatever its threads do by then.

    glibc runs `_exit(code)` itself on a thread of its own, without Python: it also ends a process
    that hangs in C++ with the GIL held, which no Python thread or signal handler can. Where the
    limit of threads is reached, the kernel ends it with SIGKILL instead.

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
    ends = _SignalEvent(
        value=code,
        notify=_SIGEV_THREAD,
        function=ctypes.cast(libc()._exit, ctypes.c_void_p),  # noqa: SLF001 - C's name
    )
    kills = _SignalEvent(notify=_SIGEV_SIGNAL, signo=signal.SIGKILL)
    timers = [_Timer(kills, seconds + _KILLED_S)]
    with contextlib.suppress(MiddlewareError):
        timers.append(_Timer(ends, seconds))

    def live_on() -> None:
        for timer in timers:
            timer.disarm()

    return live_on


class _Timer:
    """A timer of the kernel that is armed, once."""

    def __init__(self, event: _SignalEvent, seconds: float) -> None:
        create, self._arm = _timer_functions()
        self._timer = ctypes.c_void_p()
        if create(time.CLOCK_MONOTONIC, ctypes.byref(event), ctypes.byref(self._timer)) != 0:
            raise _failed("timer_create")
        self._set(TimerSpec.once(round(seconds * 1e9)))

    def disarm(self) -> None:
        self._set(TimerSpec())

    def _set(self, spec: TimerSpec) -> None:
        if self._arm(self._timer, 0, ctypes.byref(spec), None) != 0:
            raise _failed("timer_settime")


def interface_addresses(*families: socket.AddressFamily) -> tuple[tuple[str, str], ...]:
    """Return the name of an interface and an address of it, for all that this host has.

    Args:
        families: AF_INET, AF_INET6 or both.
    """
    import psutil  # 15 ms, which few processes need

    return tuple(
        (name, each.address.partition("%")[0])
        for name, addresses in psutil.net_if_addrs().items()
        for each in addresses
        if each.family in families
    )


def check_threads(count: int) -> None:
    """Make sure that so many threads can be started now.

    Raises:
        MiddlewareError: they cannot; names the limits that hold.
    """
    over = threading.Event()
    threads: list[threading.Thread] = []
    try:
        for _ in range(count):
            thread = threading.Thread(target=over.wait, daemon=True)
            thread.start()
            threads.append(thread)
    except RuntimeError as error:
        raise no_room_for_threads(count) from error
    finally:
        over.set()
        for thread in threads:
            thread.join()


_OWN_DESCRIPTORS, _DESCRIPTORS_EACH = 36, 8
"""What a supervisor has open at the very least, and besides for each process that it runs."""


def check_descriptors(processes: int) -> None:
    """Make sure that a supervisor of so many processes may open what it needs.

    Raises:
        MiddlewareError: it may not; names the limit.
    """
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    needed = _OWN_DESCRIPTORS + _DESCRIPTORS_EACH * processes
    if soft != resource.RLIM_INFINITY and soft < needed:
        most = "unlimited" if hard == resource.RLIM_INFINITY else hard
        raise MiddlewareError(
            f"cannot run {processes} processes with {soft} file descriptors: it takes {needed} "
            f"at the very least, and the hard limit is {most}",
            hint=f"raise it (ulimit -n {needed}, LimitNOFILE=)",
        )


_ADDRESS_BYTES = 512 * 2**20
"""What a participant and its threads map, each with a stack and a heap of its own."""
_LEAST_ADDRESSES_KIB = 1_400_000
"""With it the libraries, numpy's threads included; their heaps take less where there is less."""


def check_memory() -> None:
    """Make sure that this process may map what a participant takes.

    With less the C library ends a process whose thread it has no memory for, in the middle of all.

    Raises:
        MiddlewareError: it may not; names the limit.
    """
    soft, _ = resource.getrlimit(resource.RLIMIT_AS)
    is_limited = soft != resource.RLIM_INFINITY
    if not (is_limited and soft < _LEAST_ADDRESSES_KIB * 1024) and _may_map(_ADDRESS_BYTES):
        return
    used = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
    needed = max(_LEAST_ADDRESSES_KIB, (used * mmap.PAGESIZE + _ADDRESS_BYTES) // 1024)
    has = f"{soft // 1024} KiB" if is_limited else "so little memory"
    raise MiddlewareError(
        f"cannot run with {has}: it takes {needed} KiB of addresses (RLIMIT_AS)",
        hint=f"raise it (ulimit -v {needed}, LimitAS=)",
    )


def _may_map(size: int) -> bool:
    try:
        mmap.mmap(-1, size, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS, prot=0).close()
    except OSError:
        return False
    return True


def no_room_for_threads(count: int) -> MiddlewareError:
    """Return the error of a process that can have no more threads; names the limits that hold."""
    threads = "the thread" if count == 1 else f"the {count} threads"
    return MiddlewareError(
        f"cannot start {threads} that this needs: a limit of processes, threads or memory is "
        f"reached{_limits()}",
        hint="raise it (ulimit -u, TasksMax= or pids.max; ulimit -v), or end other processes",
    )


def _limits() -> str:
    """Name the limits that are known, getrlimit(2) and cgroups(7)."""
    found = []
    soft, _ = resource.getrlimit(resource.RLIMIT_NPROC)
    if soft != resource.RLIM_INFINITY:
        found.append(f"{soft} for this user")
    # Each thread has a stack; what it may have of memory ends it as well.
    for kind, name in ((resource.RLIMIT_AS, "ulimit -v"), (resource.RLIMIT_DATA, "ulimit -d")):
        soft, _ = resource.getrlimit(kind)
        if soft != resource.RLIM_INFINITY:
            found.append(f"{name} allows {soft // 1024} KiB of memory")
    with contextlib.suppress(OSError, StopIteration):
        groups = Path("/proc/self/cgroup").read_text(encoding="utf-8").splitlines()
        own = next(each for each in groups if each.startswith("0::"))[3:]
        text = Path(f"/sys/fs/cgroup{own}/pids.max").read_text(encoding="ascii").strip()
        if text != "max":
            found.append(f"{text} for this control group")
    return f" ({', '.join(found)})" if found else ""


def _prctl(option: int, *arguments: int) -> None:
    words = (ctypes.c_ulong(each) for each in (*arguments, 0, 0, 0, 0)[:4])
    if libc().prctl(option, *words) != 0:
        raise _failed("prctl")


def _timer_functions() -> tuple[ctypes._NamedFuncPointer, ctypes._NamedFuncPointer]:
    try:
        return libc().timer_create, libc().timer_settime
    except AttributeError:  # before glibc 2.34 they are in librt
        librt = ctypes.CDLL("librt.so.1", use_errno=True)
        return librt.timer_create, librt.timer_settime


def _failed(call: str) -> MiddlewareError:
    return MiddlewareError(f"cannot use {call}: {os.strerror(ctypes.get_errno())}")


def machine_id() -> str:
    """Return what distinguishes this machine from others.

    It is $LIFECYCLE_MACHINE_ID where that is set, else /etc/machine-id (machine-id(5)), else the
    kernel's boot id. Nodes of one id are taken to share memory and loopback.
    """
    return os.environ.get(MACHINE_ID_VARIABLE) or _own_machine_id()


@functools.lru_cache(maxsize=1)
def _own_machine_id() -> str:
    for path in ("/etc/machine-id", "/proc/sys/kernel/random/boot_id"):
        try:
            found = Path(path).read_text(encoding="ascii").strip()
        except OSError:
            continue
        if found:
            return found
    return ""
