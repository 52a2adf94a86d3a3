"""Shared memory files of Fast DDS in /dev/shm: how much room there is, and removing what is unused.

A killed process leaves a segment of some 540 kB per participant and the files of its ports, which
Fast DDS never reclaims. Must not import rclpy.

A file belongs to a group, `fastrtps_<segment>` or `fastrtps_port<number>` (`fastdds_` with Fast DDS
3), each with a lock file (`_el` exclusive, `_sl` shared) that the owner keeps locked (flock(2)); a
port has a named semaphore, too (sem_overview(7)). Nobody owns a group whose locks can be had. Then
a port may still have senders, which map it, and one without a lock file has them alone.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import re
import stat
import time
from collections.abc import Iterable, Iterator
from pathlib import Path

from lifecycle.errors import MiddlewareError

_DIRECTORY = Path("/dev/shm")  # noqa: S108 - where shm_open(3) keeps them
_NAMES = r"fast(?:rtps|dds)_(?:port\d+|[0-9a-f]{16})"
_FILE = re.compile(rf"(?:sem\.)?(?P<group>{_NAMES})(?:_el|_sl|_mutex)?")
_LOCKS = ("_el", "_sl")

_AGAIN_S = 0.05
"""So often it is tried again to remove what others still use: no event says that they let go."""

_NEW_S = 0.1
"""Files of Fast DDS are locked by their owner within milliseconds."""

_LEAST_ROOM_BYTES = 1 << 15
"""Measured: with 4 KiB a participant ends by SIGBUS, with 64 KiB it does without. LTTng, which ROS
2 links to, maps and writes two pages as it is loaded."""


def holds_shared_memory() -> bool:
    """Return whether this process has named files of Fast DDS in /dev/shm mapped or open.

    Fast DDS removes these when it is unloaded; a process that ends before that leaves them.
    """
    return bool(_mapped("self")) or any(_group(Path(to).name) for _, to in open_files())


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
    groups = {to: _group(to.rpartition("/")[2]) for _, to in open_files()}
    return frozenset(to for to, group in groups.items() if group and "_port" not in group)


def check_room() -> None:
    """Make sure that the kernel would not end this process by SIGBUS when ROS 2 is loaded."""
    with contextlib.suppress(OSError):
        there = os.statvfs(_DIRECTORY)
        if (free := there.f_bavail * there.f_frsize) < _LEAST_ROOM_BYTES:
            raise MiddlewareError(
                f"cannot share memory: {str(_DIRECTORY)!r} has {free} bytes left, and Fast DDS "
                f"needs {_LEAST_ROOM_BYTES} at the very least",
                hint="make room there, or give it more (mount -o remount,size=64m; in a container "
                "--shm-size=64m)",
            )


def sweep(*, within_s: float = 0.0) -> tuple[str, ...]:
    """Remove the files of this user that no process uses, and return their names, sorted.

    What was made just now is left: its owner may not have locked it yet.

    Args:
        within_s: seconds to try again while others still use what no process owns.
    """
    deadline = time.monotonic() + within_s
    removed: tuple[str, ...] = ()
    while True:
        found, in_use = _unused(remove=True)
        removed += found
        if not in_use or time.monotonic() >= deadline:
            return tuple(sorted(removed))
        time.sleep(_AGAIN_S)


def leftovers() -> tuple[str, ...]:
    """Return what `sweep` would remove, new or not, sorted, and remove nothing."""
    return _unused(remove=False)[0]


def _unused(*, remove: bool) -> tuple[tuple[str, ...], bool]:
    """Return the names of unused files, and whether others use some that no process owns."""
    groups: dict[str, dict[Path, os.stat_result]] = {}
    for path in _DIRECTORY.iterdir() if _DIRECTORY.is_dir() else ():
        if group := _group(path.name):
            with contextlib.suppress(FileNotFoundError):
                groups.setdefault(group, {})[path] = path.lstat()
    in_use = False
    unowned: dict[str, dict[Path, os.stat_result]] = {}
    for group, files in groups.items():
        if not all(
            stat.S_ISREG(each.st_mode) and each.st_uid == os.getuid() for each in files.values()
        ):
            continue
        # One that is new may not be locked yet by who made it.
        if remove and any(0 <= time.time() - each.st_ctime < _NEW_S for each in files.values()):
            in_use = True
            continue
        with contextlib.suppress(OSError), _locked(files):  # else a process owns it
            unowned[group] = files
    # Reading what all processes map takes milliseconds, in which a participant that is made would
    # be refused its port for a lock of ours: none is held meanwhile.
    shared = {name for name, files in unowned.items() if "_port" in name or not _locks(files)}
    processes = filter(str.isdigit, os.listdir("/proc")) if shared else ()  # noqa: PTH208 - names
    in_others = shared & set().union(*map(_mapped, processes))
    found: list[str] = []
    for group in unowned.keys() - in_others:
        files = unowned[group]
        with contextlib.suppress(OSError), _locked(files) if remove else contextlib.nullcontext():
            for path in files:
                if remove:
                    path.unlink(missing_ok=True)
                found.append(path.name)
    return tuple(sorted(found)), in_use or bool(in_others)


def _locks(files: Iterable[Path]) -> list[Path]:
    return [each for each in files if each.name.endswith(_LOCKS)]


@contextlib.contextmanager
def _locked(files: Iterable[Path]) -> Iterator[None]:
    """Hold the locks of a group; raises OSError where a process has one, or one is no file."""
    with contextlib.ExitStack() as held:
        for each in _locks(files):
            flags = os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK
            descriptor = os.open(each, flags)
            held.callback(os.close, descriptor)
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield


def _mapped(process: str) -> frozenset[str]:
    """Return the groups of which a process has a file mapped that still has its name.

    A container may have a directory of its own there, with files of the same names.
    """
    own, found = f" {_DIRECTORY}/", set[str]()
    with contextlib.suppress(OSError):  # it has ended, or is another user's
        if not os.path.samefile(f"/proc/{process}/root{_DIRECTORY}", _DIRECTORY):  # noqa: PTH121
            return frozenset()
        for line in Path(f"/proc/{process}/maps").read_text(errors="replace").splitlines():
            if own in line:
                found.add(_group(line.rpartition("/")[2]))
    return frozenset(found - {""})


def _group(name: str) -> str:
    match = _FILE.fullmatch(name)
    return match["group"] if match else ""
