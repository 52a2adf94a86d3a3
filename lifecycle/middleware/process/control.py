"""What this process may use and how it ends: limits, privileges, children, leaving DDS.

Owns: limits of a process, and whether there is room for participants within them; what Python does
not offer of Linux's process control, through ctypes: prctl(2), capset(2), a timer that exits; and
leaving DDS in the order that notifies peers at once and leaves nothing in /dev/shm, within a bound.
Must not import rclpy: a fork server uses it before rclpy is loaded.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import gc
import logging
import mmap
import os
import resource
import signal
import struct
import sys
import threading
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NoReturn

from lifecycle.errors import MiddlewareError
from lifecycle.middleware.fastdds.sockets import give_up_dead_connections

_logger = logging.getLogger(__name__)

MACHINE_ID_VARIABLE = "LIFECYCLE_MACHINE_ID"
"""Names the machine where the files cannot: containers and network namespaces that are hosts of
their own share /etc/machine-id or have none, and always share the kernel's boot id."""


def limit_resources(limits: Iterable[tuple[str, int]]) -> None:
    """Limit what this process may use, and all that it starts.

    Args:
        limits: name and value of setrlimit(2), `RLIMIT_NOFILE` and the like.

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


def check_threads(count: int) -> None:
    """Make sure that so many threads can be started now; else MiddlewareError."""
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
    """Make sure that a supervisor may open what so many processes need; else MiddlewareError."""
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
    """Make sure that this process may map what a participant takes; else MiddlewareError.

    With less the C library ends a process whose thread it has no memory for, in the middle of all.
    """
    soft, _ = resource.getrlimit(resource.RLIMIT_AS)
    is_limited = soft != resource.RLIM_INFINITY
    if not (is_limited and soft < _LEAST_ADDRESSES_KIB * 1024):
        with contextlib.suppress(OSError):
            flags = mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS
            mmap.mmap(-1, _ADDRESS_BYTES, flags=flags, prot=0).close()
            return
    used = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
    needed = max(_LEAST_ADDRESSES_KIB, (used * mmap.PAGESIZE + _ADDRESS_BYTES) // 1024)
    has = f"{soft // 1024} KiB" if is_limited else "so little memory"
    raise MiddlewareError(
        f"cannot run with {has}: it takes {needed} KiB of addresses (RLIMIT_AS)",
        hint=f"raise it (ulimit -v {needed}, LimitAS=)",
    )


def no_room_for_threads(count: int) -> MiddlewareError:
    """Return the error of a process that can have no more threads."""
    threads = "the thread" if count == 1 else f"the {count} threads"
    return MiddlewareError(
        f"cannot start {threads} that this needs: a limit of processes, threads or memory is"
        " reached",
        hint="raise it (ulimit -u, TasksMax= or pids.max; ulimit -v), or end other processes",
    )


def machine_id() -> str:
    """Return what distinguishes this machine: nodes of one id share memory and loopback.

    It is $LIFECYCLE_MACHINE_ID where that is set, else /etc/machine-id (machine-id(5)), else the
    kernel's boot id.
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
    """
    _prctl(_PR_SET_CHILD_SUBREAPER, 1)


def refuse_new_privileges() -> None:
    """Keep this process, and all that it starts, from gaining privileges by execve(2)."""
    _prctl(_PR_SET_NO_NEW_PRIVS, 1)


def drop_network_administration() -> None:
    """Give up CAP_NET_ADMIN, see capabilities(7), for this process and all that it starts.

    What root starts has it again, by the rules for root.
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
    """End this process with `code` (0–255) after `seconds`, whatever its threads do by then.

    glibc runs `_exit(code)` itself on a thread of its own, without Python: it also ends a process
    that hangs in C++ with the GIL held, which no Python thread or signal handler can. Where the
    limit of threads is reached, SIGALRM ends it instead. Returns a function that lets it live after
    all.
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


def leave_and_exit(
    code: int, *, nodes: Iterable[Any] = (), contexts: Iterable[Any] = (), deadline_s: float = 2.0
) -> NoReturn:
    """Destroy what is given, flush the standard streams and end the process; never returns.

    Executors must have stopped spinning. A normal exit sleeps 100 ms in Fast DDS; `os._exit` alone
    leaves a ghost in the graph for the whole lease and shared memory files for ever. Destroying a
    participant can hang in Fast DDS with the GIL held: at the deadline the process ends with the
    same code, and its supervisor sweeps /dev/shm.

    Args:
        code: exit code, 0–255.
        nodes: rclpy nodes, destroyed in this order.
        contexts: rclpy contexts, shut down and destroyed after the nodes.
        deadline_s: seconds, > 0, for all of it.
    """
    try:
        exit_after(deadline_s, code)
        give_up_dead_connections()
        for node in nodes:
            _release(node)
        for context in contexts:
            _attempt(context.try_shutdown)
            _attempt(context.destroy)
        # Fast DDS objects go with the last Python reference to them; cycles hold some.
        gc.collect()
        logging.shutdown()
        for stream in (sys.stdout, sys.stderr):
            with contextlib.suppress(OSError, ValueError, AttributeError):
                stream.flush()
    finally:
        os._exit(code)


def _release(node: Any) -> None:
    """Destroy a node and everything hanging on it that would keep its participant alive.

    rclpy's destroy_node forgets action servers and clients and a managed node's state machine; each
    holds the C++ node, and with it the participant, until it goes itself.
    """
    for waitable in tuple(node.waitables):
        if hasattr(waitable, "destroy"):
            _attempt(waitable.destroy)
    _attempt(node.destroy_node)
    vars(node).clear()


def _attempt(step: Callable[[], None]) -> None:
    try:
        step()
    except Exception:
        # The others must still be destroyed; the process ends in any case.
        _logger.exception("cannot destroy %r while leaving", step)
