"""Run directory of one supervised system: lock, process record, control socket.

Owns: where it is, how a run is found by name, that only one supervisor has it, and what it records
of the processes, so that the next `up` can find what a killed supervisor left behind. Must not
import rclpy.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import functools
import os
import re
import socket
import stat
import struct
import threading
import time
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING

import msgspec

from lifecycle import codec
from lifecycle.errors import UsageError

if TYPE_CHECKING:
    from lifecycle.plan.model import Plan

RUN_VARIABLE = "LIFECYCLE_RUN"
"""Set in every process of a run, with the run's id: what proves that a process is ours."""

PROCESS_VARIABLE = "LIFECYCLE_PROCESS"
"""Set in every process of a run, with the name of the planned process that it descends from."""

_OURS = os.O_CLOEXEC | os.O_NOFOLLOW

_SERVICES = ("run/*/lifecycle", "run/user/*/lifecycle")
"""Below /: `RuntimeDirectory=` of systemd.exec(5), and of users' own managers."""

_LONGEST_RECORD = 16 * 2**20
"""Bytes; a record names processes, a few kB."""

_RECORD_NAME = "record.json"
_PART_NAME = ".record.json"
LEDGER_NAME = "programmed.json"
"""File in a run directory that lists what is ours in networks, see programming/ledger.py."""

LEDGER_LOCK_NAME = "programmed.lock"
"""File beside it, locked while it is changed."""

OWN_CHILD = threading.Lock()
"""Held while a thread runs a program and waits for it. If that were reaped as an orphan first,
its exit code would be lost, and `subprocess` takes a lost one for success."""


class ChildRecord(msgspec.Struct, frozen=True, kw_only=True):
    """One process of ours.

    Attributes:
        start_ticks: field 22 of /proc/PID/stat, see proc(5): with the pid it names one process
            of this boot for ever.
    """

    name: str
    pid: int
    start_ticks: int


class RunRecord(msgspec.Struct, frozen=True, kw_only=True):
    """What a supervisor writes down of its run.

    Attributes:
        run_id: value of LIFECYCLE_RUN in every process of the run.
        boot_id: of the kernel; a record of an earlier boot names no living process.
        participant: GUID prefix of the supervisor's own, 24 hex digits; empty before there is one.
    """

    run_id: str
    boot_id: str
    supervisor: ChildRecord
    children: tuple[ChildRecord, ...] = ()
    participant: str = ""


def new_run_id() -> str:
    """Return a fresh value for RUN_VARIABLE."""
    return os.urandom(16).hex()


def runtime_root(environment: Mapping[str, str]) -> Path:
    """Return where run directories are: $XDG_RUNTIME_DIR/lifecycle, else /tmp/lifecycle-UID.

    Raises:
        UsageError: another user can put things there, or it is no directory.
    """
    base = environment.get("XDG_RUNTIME_DIR")
    if base and os.path.isdir(base):
        root = Path(base) / "lifecycle"
    else:
        import tempfile

        root = Path(tempfile.gettempdir()) / f"lifecycle-{os.getuid()}"
    _refuse_unsafe_parents(root)
    if os.path.lexists(root):
        _refuse_unless_private(root)
    return root


def run_roots(environment: Mapping[str, str]) -> tuple[Path, ...]:
    """Return where a command looks for runs that it asks: runtime_root, as root every service's.

    A supervisor that systemd has started is another user (`DynamicUser=`), with a directory of its
    own in /run. Root may ask it; a run of its own never uses such a directory.

    Raises:
        UsageError: as of runtime_root.
    """
    own = runtime_root(environment)
    if os.getuid() != 0:
        return (own,)
    return (own, *sorted(each for of in _SERVICES for each in Path("/").glob(of) if each != own))


def home_directory(environment: Mapping[str, str]) -> str:
    """Return HOME, else what the user database says; empty if there is neither."""
    if home := environment.get("HOME"):
        return home
    import pwd

    try:
        return pwd.getpwuid(os.getuid()).pw_dir
    except KeyError:
        return ""


def run_name(plan: Plan, machine: str = "") -> str:
    """Return the directory's name: the system, its domain, and the machine if it is only one."""
    name = f"{plan.system}@{plan.domain_id}" + (f".{machine}" if machine else "")
    return re.sub(r"[^A-Za-z0-9_.@-]", "_", name)


def boot_id() -> str:
    """Return the id of this boot, random(4)."""
    return Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()


def start_ticks(pid: int) -> int | None:
    """Return when a process started, in clock ticks since boot; None if it does not live.

    It is the same in every time namespace whose offset is in whole ticks: the kernel adds the
    reader's (time_namespaces(7)), and rounds down after that.
    """
    fields = _status(pid)
    if fields is None or fields[0] in b"ZX":
        return None
    return int(fields[19]) - _offset_ticks()


def is_process(pid: int, started_ticks: int) -> bool:
    """Return whether a process lives that has this pid and, by `start_ticks`, began then."""
    return start_ticks(pid) == started_ticks


@functools.cache
def _offset_ticks() -> int:
    """Return what the kernel adds to the start of every process that this one reads."""
    try:
        text = Path("/proc/self/timens_offsets").read_text(encoding="ascii")
    except OSError:  # a kernel without time namespaces
        return 0
    # Lines of clock, seconds and nanoseconds.
    offsets = {each[0]: (int(each[1]), int(each[2])) for each in map(str.split, text.splitlines())}
    seconds, nanoseconds = offsets.get("boottime", (0, 0))
    ticks = os.sysconf("SC_CLK_TCK")
    return seconds * ticks + nanoseconds * ticks // 10**9


def parent_of(pid: int) -> int | None:
    """Return the pid of a process's parent; None if there is no such process."""
    fields = _status(pid)
    return None if fields is None else int(fields[1])


def groups_of(pid: int) -> tuple[int, int]:
    """Return the process group and the session of a process; zeros if there is no such process."""
    fields = _status(pid)
    return (0, 0) if fields is None else (int(fields[2]), int(fields[3]))


def _status(pid: int) -> list[bytes] | None:
    """Return the fields of proc_pid_stat(5) that follow the command."""
    try:
        text = Path(f"/proc/{pid}/stat").read_bytes()
    except (FileNotFoundError, ProcessLookupError):
        return None
    # The command is in parentheses and may hold any character; the state follows it.
    return text.rpartition(b")")[2].split()


class RunDirectory:
    """One run's directory, held by an exclusive lock as long as this object is open.

    Attributes:
        run_id: see RUN_VARIABLE.
        previous: what the supervisor before us wrote, if it did not leave in order.
        participant: GUID prefix of our supervisor's own, for the record; empty before there is one.
    """

    def __init__(self, path: Path, run_id: str) -> None:
        self.path = path
        self.run_id = run_id
        self.participant = ""
        self.previous: RunRecord | None = None
        self._lock: int | None = None
        self._children: dict[int, ChildRecord] = {}

    @classmethod
    def acquire(
        cls,
        root: Path,
        name: str,
        run_id: str,
        *,
        processes: Mapping[int, str] = MappingProxyType({}),
    ) -> RunDirectory:
        """Take the directory for the run `run_id`.

        `processes` are those of it that run already, names by pid.

        Raises:
            UsageError: another supervisor has it, or the directory belongs to another user, is
                writable by others, or cannot be made or written.
        """
        directory = cls(root / name, run_id)
        try:
            directory._take()
            directory.previous = read_record(directory.path)
            directory.socket_path.unlink(missing_ok=True)
            directory.record(processes)
        except BlockingIOError:
            record = read_record(directory.path)
            pid = f" (pid {record.supervisor.pid})" if record else ""
            raise UsageError(
                f"cannot bring up {name!r}: another supervisor{pid} runs it already",
                hint=f"end it first: lifecycle down {name}",
            ) from None
        except OSError as error:
            directory.release(removes=directory.previous is None)
            if error.errno in (errno.ENOSPC, errno.EDQUOT):
                raise UsageError(
                    f"cannot write in run directory {str(directory.path)!r}: {error.strerror}",
                    hint="make room there, or set XDG_RUNTIME_DIR to another directory",
                ) from error
            raise _unusable(error.filename or directory.path, str(error.strerror)) from error
        return directory

    def _take(self) -> None:
        """Make the directory and lock it, also where its last supervisor just removes it.

        Raises:
            BlockingIOError: another supervisor has it.
        """
        _refuse_unsafe_parents(self.path.parent)
        path = self.path / "lock"
        while True:
            private_directory(self.path.parent)
            private_directory(self.path)
            _refuse_unless_run(self.path)
            try:
                lock = os.open(path, os.O_RDWR | os.O_CREAT | _OURS, 0o600)
            except FileNotFoundError:
                continue
            try:
                _take_lock(lock)
                if path.exists() and os.path.samestat(os.fstat(lock), path.lstat()):
                    self._lock = lock
                    return
            except FileNotFoundError:
                pass
            finally:
                if self._lock is None:
                    os.close(lock)

    @property
    def socket_path(self) -> Path:
        """Where `lifecycle down` and `status` reach the supervisor."""
        return self.path / "control"

    def record(self, processes: Mapping[int, str]) -> None:
        """Write down what runs, names by pid, in one piece.

        Raises:
            OSError: it cannot be written.
        """
        known, self._children = self._children, {}
        for pid, name in processes.items():
            if pid in known:
                self._children[pid] = known[pid]
            elif (ticks := start_ticks(pid)) is not None:
                self._children[pid] = ChildRecord(name=name, pid=pid, start_ticks=ticks)
        record = RunRecord(
            run_id=self.run_id,
            boot_id=boot_id(),
            supervisor=ChildRecord(
                name="supervisor", pid=os.getpid(), start_ticks=start_ticks(os.getpid()) or 0
            ),
            children=tuple(self._children.values()),
            participant=self.participant,
        )
        part = self.path / _PART_NAME
        part.unlink(missing_ok=True)
        new = os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL | _OURS, 0o600)
        with os.fdopen(new, "wb") as file:
            file.write(codec.to_json(record))
        # Replacing a file has some file systems write the new one to the disk first (ext4(5),
        # auto_da_alloc), which takes long on a busy one; who reads meanwhile finds the other name.
        (self.path / _RECORD_NAME).unlink(missing_ok=True)
        part.rename(self.path / _RECORD_NAME)

    def release(self, *, removes: bool = True) -> None:
        """Give up the lock, and remove the directory: nothing of ours may run then.

        A list of what is still programmed in networks stays, and with it the directory.
        """
        if self._lock is None:
            return
        with contextlib.suppress(FileNotFoundError):
            for each in tuple(self.path.iterdir()) if removes else ():
                # The lock last: who takes it must not find what is being removed.
                if each.name not in (LEDGER_NAME, "lock"):
                    with contextlib.suppress(IsADirectoryError):
                        each.unlink(missing_ok=True)
            if removes:
                (self.path / "lock").unlink(missing_ok=True)
            # Another supervisor may have it by now, or it is not empty.
            with contextlib.suppress(OSError):
                self.path.rmdir()
        os.close(self._lock)
        self._lock = None


def read_record(path: Path) -> RunRecord | None:
    """Return the record in a run directory; None if there is none that can be read."""
    # It may just take the place of the one before it.
    for name in (_RECORD_NAME, _PART_NAME, _RECORD_NAME):
        with contextlib.suppress(OSError, ValueError):
            data = read_regular(path / name, _LONGEST_RECORD + 1, os.O_NOFOLLOW)
            return codec.from_json(data, RunRecord, longest=_LONGEST_RECORD)
    return None


def read_regular(path: str | Path, most: int, flags: int = 0) -> bytes:
    """Return the first `most` bytes of a regular file, without ever waiting for a writer.

    Raises:
        OSError: it cannot be read, or is a pipe, a device or anything else that is no file.
    """
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC | flags)
    with os.fdopen(descriptor, "rb") as file:
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):
            raise OSError(errno.EINVAL, "it is not a regular file")
        return file.read(most)


def is_held(path: Path) -> bool:
    """Whether a supervisor holds this run directory now; what is not ours is none."""
    try:
        lock = os.open(path / "lock", os.O_RDWR | _OURS)
    except OSError:
        return False
    try:
        fcntl.flock(lock, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    finally:
        os.close(lock)
    return False


def _take_lock(descriptor: int) -> None:
    """Take a lock that only a supervisor holds for longer than it takes to see whether one does.

    Raises:
        BlockingIOError: a supervisor has it.
    """
    deadline = time.monotonic() + _LOOK_S
    while time.monotonic() < deadline:
        with contextlib.suppress(BlockingIOError):
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return
        time.sleep(_LOOK_S / 10)
    raise BlockingIOError(errno.EWOULDBLOCK, os.strerror(errno.EWOULDBLOCK))


_LOOK_S = 0.1
"""Within which `is_held` has given a lock back, also where it was interrupted."""

FORK_SERVER = "zygote"
"""The fork server's name in a record; every other process there runs nodes, or serves them."""


def lost(path: Path) -> UsageError:
    """Return why a run has no answer: its supervisor was killed, with what still runs of it."""
    record = read_record(path)
    pid = f" (pid {record.supervisor.pid})" if record is not None else ""
    if is_held(path):
        return UsageError(
            f"cannot ask {path.name!r}: its supervisor{pid} is just starting or ending",
            hint="try again",
        )
    here = record is not None and record.boot_id == boot_id()
    left = sorted(
        f"{each.name} (pid {each.pid})"
        for each in (record.children if record is not None and here else ())
        if each.name != FORK_SERVER and is_process(each.pid, each.start_ticks)
    )
    still = f"{', '.join(left)} still run" if left else "none of its processes runs any more"
    return UsageError(
        f"cannot ask {path.name!r}: its supervisor{pid} died; {still}",
        hint=f"end what is left of it: lifecycle down {path.name}; the next lifecycle up does, too",
    )


def silent(path: Path) -> UsageError:
    """Return the error that a supervisor runs, and does not answer within a few seconds."""
    record = read_record(path)
    pid = record.supervisor.pid if record is not None else "PID"
    return UsageError(
        f"cannot ask {path.name!r}: its supervisor (pid {pid}) does not answer",
        hint=f"let it go on if it was stopped: kill -CONT {pid}; "
        f"or end all of it: kill -9 {pid}; lifecycle down {path.name}",
    )


def left_behind(*roots: Path) -> tuple[Path, ...]:
    """Return the directories of all runs whose supervisor was killed, sorted by name."""
    return tuple(each for each in _all(roots) if not is_held(each) and read_record(each))


def running(*roots: Path) -> tuple[Path, ...]:
    """Return the directories of all runs that a supervisor holds, sorted by name."""
    return tuple(each for each in _all(roots) if is_held(each))


def _all(roots: Iterable[Path]) -> list[Path]:
    found = (each for root in roots if root.is_dir() for each in root.iterdir())
    return sorted(found, key=lambda path: path.name)


def find_run(roots: Iterable[Path], word: str) -> Path:
    """Return the directory of the run that `word` means.

    Args:
        roots: see run_roots.
        word: a run's name, `teleop@7`, or its system, `teleop`, where only one such run is there;
            else its directory.

    Raises:
        UsageError: no such run, or more than one.
    """
    roots = tuple(roots)
    runs = running(*roots)
    found = [each for each in runs if _is_named(each, word)]
    if len(found) == 1:
        return found[0]
    if found:
        names = [each.name for each in found]
        what = names if len(set(names)) > 1 else map(str, found)
        raise UsageError(f"cannot tell which {word!r} is meant; running: {', '.join(what)}")
    for each in left_behind(*roots):
        if _is_named(each, word):
            return each
    raise UsageError(
        f"cannot find a running system {word!r}; "
        f"running: {', '.join(each.name for each in runs) or 'none'}",
        hint="" if runs else "start it: lifecycle up MANIFEST",
    )


def _is_named(path: Path, word: str) -> bool:
    return word in (path.name, path.name.rpartition("@")[0], str(path))


@contextlib.contextmanager
def short_path(path: Path) -> Iterator[str]:
    """Give a name of `path` that fits in a socket address, 107 bytes (unix(7)), however deep."""
    descriptor = os.open(path.parent, os.O_PATH | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        yield f"/proc/self/fd/{descriptor}/{path.name}"
    finally:
        os.close(descriptor)


_SHORTEST_S = 0.001
"""Less would be no limit at all, socket(7)."""


def connect(path: Path, timeout_s: float) -> socket.socket:
    """Connect to a control socket, with that limit for whatever is done on it.

    Raises:
        TimeoutError: the listener there accepts no connection.
        ConnectionRefusedError: nothing listens there any more.
        FileNotFoundError: there never was a listener.
    """
    sock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        with short_path(path) as name:
            # With a timeout of Python's, a full queue would be an error at once.
            seconds, fraction = divmod(max(timeout_s, _SHORTEST_S), 1)
            limit = struct.pack("@ll", int(seconds), int(fraction * 1e6))
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, limit)
            sock.connect(name)
        sock.settimeout(timeout_s)
    except BlockingIOError:
        sock.close()
        raise TimeoutError from None
    except OSError:
        sock.close()
        raise
    return sock


def private_directory(path: Path) -> None:
    """Make `path` if need be, and insist that no other user can put things into it.

    Raises:
        UsageError: another user can, or something else is in its place.
    """
    with contextlib.suppress(FileExistsError):
        path.mkdir(mode=0o700, parents=True)
    _refuse_unless_private(path)


def _refuse_unless_private(path: Path) -> None:
    try:
        status = path.lstat()
    except FileNotFoundError:
        return  # just removed by the run that had it
    what = ""
    if stat.S_ISLNK(status.st_mode):
        what = "it is a symbolic link"
    elif not stat.S_ISDIR(status.st_mode):
        what = "it is not a directory"
    elif status.st_uid != os.getuid():
        what = f"it belongs to user {status.st_uid}, and this is user {os.getuid()}"
    elif status.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        what = "others can write it"
    if what:
        raise _unusable(path, what)


def _refuse_unless_run(path: Path) -> None:
    """Insist that a directory is a run's, or empty: at the end all that is in it is removed."""
    try:
        names = {each.name for each in path.iterdir()}
    except FileNotFoundError:
        return  # just removed by the run that had it
    # A run that ends removes its lock last, and leaves what is programmed still.
    marks = ("lock", LEDGER_NAME, LEDGER_LOCK_NAME)
    if names and names.isdisjoint(marks) and read_record(path) is None:
        raise _unusable(path, f"it holds {min(names)!r}, and was no run's")


def _refuse_unsafe_parents(root: Path) -> None:
    """Insist that no other user can put another directory into the place of `root`.

    Each directory above it must belong to this user or to root, and be writable by all only with
    the sticky bit, as /tmp is.
    """
    trusted = {os.getuid(), 0, _unmapped_uid()}
    # Where links lead to: they lie in the directories above, which are looked at as well.
    for path in {*root.absolute().parents, *Path(os.path.realpath(root.parent) + "/x").parents}:
        try:
            status = path.stat()
        except FileNotFoundError:
            continue
        except OSError as error:
            raise _unusable(path, str(error.strerror)) from error
        if status.st_uid not in trusted:
            raise _unusable(
                root,
                f"{str(path)!r} belongs to user {status.st_uid}, and this is user {os.getuid()}",
            )
        if status.st_mode & stat.S_IWOTH and not status.st_mode & stat.S_ISVTX:
            raise _unusable(root, f"everybody can write {str(path)!r}")


def _unmapped_uid() -> int:
    """Return as whom the owner of / is seen in a user namespace without root's uid; else 0."""
    uids = Path("/proc/self/uid_map").read_text(encoding="ascii").split()
    if int(uids[1]) == 0 and int(uids[0]) == 0:
        return 0
    return int(Path("/proc/sys/kernel/overflowuid").read_text(encoding="ascii"))


def _unusable(path: Path | str, what: str) -> UsageError:
    return UsageError(
        f"cannot use {str(path)!r} as run directory: {what}; it must be a directory of this user "
        "that others cannot write",
        hint="remove it, or set XDG_RUNTIME_DIR to such a directory",
    )
