"""What this process may use, and what this machine has: limits, addresses of interfaces, its id.

Owns: the limits that are set for a process, and whether there is room for participants within those
that are in force. Linux only. Must not import rclpy: a fork server uses it before rclpy is loaded.
"""

from __future__ import annotations

import contextlib
import functools
import mmap
import os
import resource
import socket
import threading
from collections.abc import Iterable
from pathlib import Path

from lifecycle.errors import MiddlewareError

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
