"""Remove stale Fast DDS shared memory files from /dev/shm.

Owns: which of them are in use, and removing what a killed process left: one segment of some 540 kB
per participant and the files of its ports, which Fast DDS never reclaims. Must not import rclpy.

A file belongs to a group, `fastrtps_<segment>` or `fastrtps_port<number>` (Fast DDS 3:
`fastdds_…`), each with a lock file
(`_el` exclusive, `_sl` shared) that the owner keeps open and locked, and a port with a named
semaphore under which it is opened (sem_overview(7)).

/proc hides the processes of other PID namespaces, which may share /dev/shm (containers with the
host's IPC do). So it never proves that a file is unused; what the kernel grants to one holder does:

- the lock file of the group, locked exclusively (flock(2)): no owner lives.
- a write lease on every other file (fcntl(2), Leases): no process has it open or mapped, and none
  can open it until the lease is given back. A port needs that too, a sender may be about to look
  for it; a segment that has a lock file does not: its readers keep a dead owner's mapping for a
  while, which removing the name does not touch.

Who opens a file that has such a lease waits until it is given back, at most 45 s
(/proc/sys/fs/lease-break-time). A thread of the own process that waits so in Fast DDS holds the
GIL, and so keeps the lease from being given back: `sweep`, `disown_ports` and `leftovers` belong
into processes without participants over shared memory.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import mmap
import os
import re
import signal
import struct
import time
from collections.abc import Callable, Collection, Iterator
from pathlib import Path

from lifecycle import dataclasses
from lifecycle.errors import MiddlewareError

_DIRECTORY = Path("/dev/shm")  # noqa: S108 - where shm_open(3) keeps them
_FILE = re.compile(
    r"(?P<semaphore>sem\.)?(?P<group>fast(?:rtps|dds)_(?:port\d+|[0-9a-f]{16}))(?P<rest>_el|_sl|_mutex)?"
)
_LOCK_FIELDS = 8
"""Of a held lock in /proc/locks: number, FLOCK, ADVISORY, WRITE, pid, file, start, end."""

_AGAIN_S = 0.02
"""So often it is tried again to remove what others still use: no event says that they let go."""

_NEW_S = 0.1
"""Files of Fast DDS are locked by their owner within milliseconds."""

_PORTS = ("fastrtps_port", "fastdds_port")  # of Fast DDS 2 and 3
_OURS = re.compile("fast(?:rtps|dds)_")
_LOCKS = ("_el", "_sl")
_Inode = tuple[int, int]
"""(device, inode number)."""


_LEAST_ROOM_BYTES = 1 << 15
"""Measured: with 4 KiB a participant ends by SIGBUS, with 64 KiB it does without."""


def holds_shared_memory() -> bool:
    """Return whether this process has files of Fast DDS in /dev/shm mapped or open, with a name.

    Fast DDS removes these when it is unloaded; a process that ends before that leaves them.
    """
    found = Path("/proc/self/maps").read_text(encoding="utf-8", errors="replace").splitlines()
    found += [to for _, to in open_files()]
    own = f"{_DIRECTORY}/"
    return any(own in line and _OURS.search(line) and "(deleted)" not in line for line in found)


def open_files() -> list[tuple[int, str]]:
    """Return the descriptors of this process and what proc(5) says they are open to."""
    found = []
    for name in os.listdir("/proc/self/fd"):  # noqa: PTH208 - hot loop
        with contextlib.suppress(OSError):  # closed since
            found.append((int(name), os.readlink(f"/proc/self/fd/{name}")))  # noqa: PTH115
    return found


def own_segments() -> frozenset[str]:
    """Return the lock files of what this process sends by shared memory from.

    A participant of it that has the transport has one from when it is made until it ends.
    """
    own, names = f"{_DIRECTORY}/", ((to, Path(to).name) for _, to in open_files())
    return frozenset(
        to
        for to, name in names
        if to.startswith(own) and _OURS.match(name) and not name.startswith(_PORTS)
    )


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class _SharedFile:
    path: Path
    group: str
    inode: _Inode
    uid: int
    made_s: float

    @property
    def is_new(self) -> bool:
        """Whether a process may have made it, and not yet locked it."""
        return 0 <= time.time() - self.made_s < _NEW_S

    @property
    def is_lock(self) -> bool:
        return self.path.name.endswith(_LOCKS)

    @property
    def is_mutex(self) -> bool:
        return self.path.name.startswith("sem.")

    @property
    def is_port(self) -> bool:
        return self.group.startswith(_PORTS)


def _locked() -> Iterator[_Inode]:
    """Yield the files that somebody of this PID namespace has locked.

    Raises:
        OSError: /proc/locks cannot be read, see proc_locks(5).
    """
    for line in Path("/proc/locks").read_text(encoding="ascii").splitlines():
        fields = line.split()
        if len(fields) >= _LOCK_FIELDS and fields[1] == "FLOCK":
            major, minor, inode = fields[5].split(":")
            yield os.makedev(int(major, 16), int(minor, 16)), int(inode)


def check_room() -> None:
    """Make sure that there is some room in /dev/shm at all.

    Raises:
        MiddlewareError: there is so little that the kernel would end its users with SIGBUS.
    """
    with contextlib.suppress(OSError):
        if (free := _free_bytes()) < _LEAST_ROOM_BYTES:
            raise _no_room(free, "Fast DDS")


_TRACING_BYTES = 8192
_TRACING_FILES = "lttng-ust-wait-*"
"""Two pages that LTTng, which ROS 2 links to, maps and writes to as it is loaded; they stay."""


def check_room_to_load() -> None:
    """Make sure that libraries of ROS 2 can be loaded, before any of them is.

    Raises:
        MiddlewareError: /dev/shm is so full that the kernel would end this process with SIGBUS.
    """
    with contextlib.suppress(OSError):
        free = _free_bytes()
        # st_blocks of stat(3type): in units of 512 bytes, whatever the file system has.
        kept = sum(each.stat().st_blocks * 512 for each in _DIRECTORY.glob(_TRACING_FILES))
        if free + kept < _TRACING_BYTES:
            raise _no_room(free, "what ROS 2 loads and Fast DDS together")


def _free_bytes() -> int:
    there = os.statvfs(_DIRECTORY)
    return there.f_bavail * there.f_frsize


def _no_room(free: int, who: str) -> MiddlewareError:
    verb = "need" if " and " in who else "needs"
    return MiddlewareError(
        f"cannot share memory: {str(_DIRECTORY)!r} has {free} bytes left, and {who} "
        f"{verb} {_LEAST_ROOM_BYTES} at the very least",
        hint="make room there, or give it more (mount -o remount,size=64m; in a container "
        "--shm-size=64m)",
    )


def sweep(only: Collection[str] | None = None, *, within_s: float = 0.0) -> tuple[str, ...]:
    """Remove the files of this user that are proven to be unused.

    Args:
        only: names of files, whose groups are considered; None is all, but for what was made just
            now: its owner may not have locked it yet.
        within_s: seconds to try again while others still use what no process owns. They let go of
            the port of a participant that left when they next send over shared memory
            (SharedMemTransport::cleanup_output_ports in Fast DDS 2.14), of one that was killed only
            seconds later; and where one was killed that had sent there, none removes it.

    Returns:
        The names removed, sorted; empty where there is no /dev/shm.
    """
    deadline = time.monotonic() + within_s
    removed: tuple[str, ...] = ()
    while True:
        found, in_use = _unused(only, remove=True)
        removed += found
        if not in_use or time.monotonic() >= deadline:
            return tuple(sorted(removed))
        time.sleep(_AGAIN_S)


def disown_ports() -> tuple[str, ...]:
    """Have every sender let go of the ports of this user's processes that have been killed.

    Who has sent to a port keeps it mapped, and goes on sending there when another process has made
    it anew: what it sends is lost. Fast DDS 2.14 lets go of it after two seconds or more; here it
    does so at once. Where the memory is not as in that version nothing is done.

    Returns:
        Their names, sorted.
    """
    groups: dict[str, list[_SharedFile]] = {}
    for file in _files(lambda group: group.startswith(_PORTS[0])):  # as in Fast DDS 2
        if file.uid == os.getuid():
            groups.setdefault(file.group, []).append(file)
    used: set[_Inode] = set()
    if groups:
        with contextlib.suppress(OSError):  # each is tried then
            used.update(_locked())
    return tuple(
        sorted(
            group
            for group, files in groups.items()
            if used.isdisjoint(file.inode for file in files) and _disowned(group, files)
        )
    )


def _disowned(group: str, files: Collection[_SharedFile]) -> bool:
    """Mark a port as not ok whose owner has ended; whether it was and is now not."""
    if not any(file.is_lock for file in files):
        return False
    with contextlib.suppress(OSError, ValueError), contextlib.ExitStack() as stack:
        file = os.open(_DIRECTORY / group, os.O_RDWR | os.O_CLOEXEC | os.O_NOFOLLOW)
        stack.callback(os.close, file)
        memory = stack.enter_context(mmap.mmap(file, 0))
        flags = _port_flags(memory, int(group.partition("port")[2]))
        if flags is None or memory[flags] & _READ_AND_OK != _READ_AND_OK:
            return False
        # The semaphore first: opening the port after this waits until we are done.
        for each in sorted(files, key=lambda each: not each.is_mutex):
            if each.is_lock or each.is_mutex:
                stack.enter_context(_claim(each))
        memory[flags] &= ~_OK
        return True
    return False


_PORT_NODE = struct.Struct("=7I")
"""From port_id to the flags of SharedMemGlobal::PortNode in Fast DDS 2.14."""
_OK, _READ_AND_OK = 1, 5


def _port_flags(memory: mmap.mmap, number: int) -> int | None:
    """Return where the flags of a port are in its memory; None if that is not as it is known."""
    found = None
    start = memory.find(wanted := struct.pack("=I", number))
    while start >= 0:
        if start % 4 == 0 and start + _PORT_NODE.size <= len(memory):
            _, _, check_ms, wait_ms, descriptors, _, flags = _PORT_NODE.unpack_from(memory, start)
            if check_ms and wait_ms == check_ms // 3 and descriptors and 0 < flags < 8:
                if found is not None:
                    return None
                found = start + _PORT_NODE.size - 4
        start = memory.find(wanted, start + 1)
    return found


def leftovers(*, only: Collection[str] | None = None) -> tuple[str, ...]:
    """Return what `sweep` would remove, sorted, and remove nothing; None considers all groups."""
    return _unused(only, remove=False)[0]


def _unused(only: Collection[str] | None, *, remove: bool) -> tuple[tuple[str, ...], bool]:
    """Return the names of unused files, and whether others use some that no process owns."""
    wanted = None if only is None else {_group(name) for name in only}
    groups: dict[str, list[_SharedFile]] = {}
    for file in _files(lambda group: wanted is None or group in wanted):
        groups.setdefault(file.group, []).append(file)
    found: list[str] = []
    in_use = False
    for group, files in groups.items():
        if any(file.uid != os.getuid() for file in files):
            continue
        if only is None and remove and any(file.is_new for file in files):
            in_use = True
            continue
        with contextlib.ExitStack() as claims:
            try:
                _claim_all(group, files, claims)
            except _InUseError:
                in_use = True
            except OSError:
                continue  # owned by a process, or not as it was listed
            else:
                for file in files:
                    if remove:
                        file.path.unlink(missing_ok=True)
                    found.append(file.path.name)
    return tuple(sorted(found)), in_use


class _InUseError(Exception):
    """No process owns it, and some have it open or mapped."""


def _claim_all(group: str, files: Collection[_SharedFile], claims: contextlib.ExitStack) -> None:
    """Hold a group against all other processes.

    Raises:
        _InUseError: see there.
        OSError: a process owns it, or it is not as it was listed.
    """
    locked = any(file.is_lock for file in files)
    in_use: OSError | None = None
    # The semaphore first: opening the port after this waits until we are done.
    for file in sorted(files, key=lambda each: not each.is_mutex):
        if file.is_lock or file.is_port or not locked:
            try:
                claims.enter_context(_claim(file))
            except BlockingIOError as error:
                if file.is_lock:
                    raise
                in_use = error
    if in_use is not None:
        raise _InUseError from in_use
    # What was made meanwhile belongs to a process that just opens it.
    if set(_of_group(group)) != set(files):
        raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), group)


@contextlib.contextmanager
def _claim(file: _SharedFile) -> Iterator[None]:
    """Hold one file.

    Raises:
        OSError: another process uses it, or the kernel does not know.
    """
    mode = os.O_RDONLY if file.is_lock else os.O_RDWR
    flags = os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK
    descriptor = os.open(file.path, mode | flags)
    try:
        if file.is_lock:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        else:
            # Who then opens it is announced by a signal, by default one that kills.
            fcntl.fcntl(descriptor, fcntl.F_SETSIG, signal.SIGURG)
            fcntl.fcntl(descriptor, fcntl.F_SETLEASE, fcntl.F_WRLCK)
        yield
    finally:
        os.close(descriptor)


def _files(is_wanted: Callable[[str], bool]) -> list[_SharedFile]:
    """Return the files of some groups."""
    found = []
    for entry in _listing(_DIRECTORY):
        group = _group(entry.name)
        if group and is_wanted(group) and (file := _shared_file(Path(entry.path), group)):
            found.append(file)
    return found


_BEFORE_GROUP, _AFTER_GROUP = ("", "sem."), ("", "_el", "_sl", "_mutex")


def _of_group(group: str) -> list[_SharedFile]:
    """Return the files of a group, without a look at all the others: there may be thousands."""
    names = (f"{before}{group}{after}" for before in _BEFORE_GROUP for after in _AFTER_GROUP)
    found = (_shared_file(_DIRECTORY / name, group) for name in names)
    return [each for each in found if each is not None]


def _shared_file(path: Path, group: str) -> _SharedFile | None:
    try:
        status = path.lstat()
    except FileNotFoundError:
        return None
    return _SharedFile(
        path=path,
        group=group,
        inode=(status.st_dev, status.st_ino),
        uid=status.st_uid,
        made_s=status.st_ctime,
    )


def _listing(directory: Path) -> list[os.DirEntry[str]]:
    try:
        with os.scandir(directory) as entries:
            return list(entries)
    except FileNotFoundError:
        return []


def _group(name: str) -> str:
    match = _FILE.fullmatch(name)
    return match["group"] if match else ""
