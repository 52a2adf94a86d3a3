"""Fast DDS's shared memory files that nobody uses any more.

Owns: finding and removing them in /dev/shm. A killed process leaves one segment of some 540 kB per
participant and the files of its ports; Fast DDS never reclaims a segment. Must not import rclpy.

A file belongs to a group, `fastrtps_<segment>` or `fastrtps_port<number>`, each with a lock file
(`_el` exclusive, `_sl` shared) that the owner keeps open and locked, and a port with a named
semaphore. Files are judged per group: the semaphore of a live port is neither mapped nor open.
A port is in use while any process maps or has open one of its files, or holds its lock: a sender
may be about to look for it. A segment is in use while its owner lives; its readers keep a dead
owner's mapping for a while, which removing the name does not touch.
"""

from __future__ import annotations

import contextlib
import dataclasses
import os
import re
from collections.abc import Callable, Collection, Iterable
from pathlib import Path

from lifecycle.middleware.shm_lock import PortMutex, port_mutexes
from lifecycle.network.ports import DG, PB

_DIRECTORY = Path("/dev/shm")  # noqa: S108 - where shm_open(3) keeps them
_FILE = re.compile(
    r"(?P<semaphore>sem\.)?(?P<group>fastrtps_(?:port\d+|[0-9a-f]{16}))(?P<rest>_el|_sl|_mutex)?"
)

_Inode = tuple[int, int]
"""(device, inode number)."""


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class _File:
    path: Path
    group: str
    inode: _Inode
    uid: int
    modified_s: float

    @property
    def is_lock(self) -> bool:
        return self.path.name.endswith(("_el", "_sl"))

    @property
    def is_mutex(self) -> bool:
        return self.path.name.startswith("sem.")

    @property
    def is_port(self) -> bool:
        return self.group.startswith("fastrtps_port")


def segments_of(pids: Iterable[int]) -> frozenset[str]:
    """Return the names of the Fast DDS files that these processes own now.

    Remember them while a process lives; `sweep(only=…)` then removes what it left behind.
    """
    held = {inode for pid in pids for inode in _peek(_open_inodes, pid)}
    files = _files() if held else []
    owned = {file.group for file in files if file.is_lock and file.inode in held}
    return frozenset(file.path.name for file in files if file.group in owned)


def port_files_of(domain_id: int) -> frozenset[str]:
    """Return the names that the files of a domain's ports have, whether they exist or not.

    Unique ports are not among them, they are the same in every domain (rmw_fastrtps).

    Args:
        domain_id: 0–232.
    """
    first = PB + DG * domain_id
    return frozenset(f"fastrtps_port{port}" for port in range(first, first + DG))


def sweep(
    *, only: Collection[str] | None = None, created_after_s: float | None = None
) -> tuple[str, ...]:
    """Remove the files of this user that are no longer in use.

    Args:
        only: names; other groups than theirs are left alone. None considers all.
        created_after_s: seconds since the epoch; groups with an older file are left alone. Fast
            DDS writes these files through mappings only, which leaves their times alone.

    Returns:
        The names removed, sorted; empty where there is no /dev/shm.
    """
    candidates = frozenset(_unused(only, created_after_s))
    if not candidates:
        return ()
    removed = []
    with port_mutexes(file.path for file in candidates if file.is_mutex) as mutexes:
        # Looked at again where nobody can open a port any more.
        unused = _unused(only, created_after_s, ignore=mutexes)
        spared = {
            file.group
            for file in unused
            if file not in candidates or (file.is_mutex and file.path not in mutexes)
        }
        spared |= {_group(path.name) for path, mutex in mutexes.items() if _was_alive(mutex)}
        for file in unused:
            if file.group not in spared:
                with contextlib.suppress(FileNotFoundError):
                    file.path.unlink()
                    removed.append(file.path.name)
    return tuple(sorted(removed))


def _was_alive(mutex: PortMutex) -> bool:
    """Tell whether a mutex that was taken before is free now: its holder has gone on.

    One that stays taken, and that nobody maps, was left so by a process that was killed.
    """
    return not mutex.held and mutex.acquire()


def leftovers(*, only: Collection[str] | None = None) -> tuple[str, ...]:
    """Return what `sweep` would remove, sorted, and remove nothing."""
    return tuple(sorted(file.path.name for file in _unused(only, None)))


def _unused(
    only: Collection[str] | None, created_after_s: float | None, ignore: Collection[Path] = ()
) -> list[_File]:
    """Return the files that may go; that we map the semaphores `ignore` is no use of them."""
    files = _files()
    wanted = None if only is None else {_group(name) for name in only}
    # Listed before looking at processes: whoever made a listed file is looked at afterwards.
    ours = {file.inode for file in files if file.path in ignore}
    held, mapped = _inodes_in_use(ours)
    locks = {file.group for file in files if file.is_lock}
    spared = {
        file.group
        for file in files
        if file.inode in held
        or (file.inode in mapped and (file.is_port or file.group not in locks))
        or file.uid != os.getuid()
        or (wanted is not None and file.group not in wanted)
        or (created_after_s is not None and file.modified_s < created_after_s)
    }
    return [file for file in files if file.group not in spared]


def _files() -> list[_File]:
    found = []
    for entry in _listing(_DIRECTORY):
        group = _group(entry.name)
        if not group:
            continue
        with contextlib.suppress(FileNotFoundError):
            status = entry.stat(follow_symlinks=False)
            found.append(
                _File(
                    path=Path(entry.path),
                    group=group,
                    inode=(status.st_dev, status.st_ino),
                    uid=status.st_uid,
                    modified_s=status.st_mtime,
                )
            )
    return found


def _listing(directory: Path) -> list[os.DirEntry[str]]:
    try:
        with os.scandir(directory) as entries:
            return list(entries)
    except FileNotFoundError:
        return []


def _group(name: str) -> str:
    match = _FILE.fullmatch(name)
    return match["group"] if match else ""


def _all_pids() -> list[int]:
    return [int(entry.name) for entry in _listing(Path("/proc")) if entry.name.isdigit()]


def _inodes_in_use(ours: set[_Inode]) -> tuple[set[_Inode], set[_Inode]]:
    """Return what any process has open or locked, and what any process maps.

    Processes of other users cannot be looked into; /proc/locks shows their locks all the same.
    """
    held, mapped = _locked_inodes(), set()
    for pid in _all_pids():
        # Open files first: a file is opened, mapped, and then closed.
        held |= _peek(_open_inodes, pid)
        mapped |= _peek(_mapped_inodes, pid) - (ours if pid == os.getpid() else set())
    return held, mapped


def _peek(look: Callable[[int], set[_Inode]], pid: int) -> set[_Inode]:
    """Look into a process; nothing where it has ended or belongs to somebody else."""
    try:
        return look(pid)
    except (FileNotFoundError, PermissionError, ProcessLookupError):
        return set()


def _open_inodes(pid: int) -> set[_Inode]:
    found: set[_Inode] = set()
    for entry in _listing(Path(f"/proc/{pid}/fd")):
        with contextlib.suppress(FileNotFoundError):
            if os.readlink(entry.path).startswith(f"{_DIRECTORY}/"):  # noqa: PTH115 - hot loop
                status = entry.stat()
                found.add((status.st_dev, status.st_ino))
    return found


def _mapped_inodes(pid: int) -> set[_Inode]:
    found: set[_Inode] = set()
    with Path(f"/proc/{pid}/maps").open("rb") as maps:
        for line in maps:
            if b" /dev/shm/" in line:
                fields = line.split(maxsplit=5)
                found.add(_device_inode(fields[3].decode(), int(fields[4])))
    return found


def _locked_inodes() -> set[_Inode]:
    """Return (device, inode) of every file lock held on this machine, see proc_locks(5)."""
    found: set[_Inode] = set()
    for line in Path("/proc/locks").read_text(encoding="ascii").splitlines():
        place = next((word for word in line.split() if word.count(":") == 2), "")
        if place:
            device, _, inode = place.rpartition(":")
            found.add(_device_inode(device, int(inode)))
    return found


def _device_inode(device: str, inode: int) -> _Inode:
    major, minor = (int(part, 16) for part in device.split(":"))
    return os.makedev(major, minor), inode
