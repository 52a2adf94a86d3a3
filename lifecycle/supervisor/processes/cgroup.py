"""Control groups (cgroup v2) of a run: what each process and all that it starts may use together.

Owns: where this process's own cgroup is, and whether it is delegated to it; the run's cgroup below
that, with one for each process that asks for resources; that all of it is removed, also after a
supervisor that was killed. Imported only where a manifest has `resources`. Must not import rclpy.

    OWN                             where the supervisor was started: delegated to it
    OWN/lifecycle-RUN/supervisor    the supervisor and its fork server: OWN may have no processes
                                    once its subgroups have controllers ("no internal processes")
    OWN/lifecycle-RUN/process-NAME  a process and all that it starts

The root of the hierarchy may have processes, so there the supervisor stays where it is.

Sources: cgroup-v2.rst (kernel), proc_pid_mountinfo(5), systemd.resource-control(5) and systemd's
CGROUP_DELEGATION.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import itertools
import os
import re
import signal
import time
from collections.abc import Collection, Iterable, Iterator, Sequence
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Protocol

from lifecycle.errors import UsageError

if TYPE_CHECKING:
    from lifecycle.manifest import Resources
    from lifecycle.plan import PlannedProcess
    from lifecycle.supervisor.processes.orphans import ProcessFamily

_PREFIX = "lifecycle-"
_SUPERVISOR = "supervisor"
_PROCESS = "process-"
_LONGEST_NAME = 200
"""Bytes of a directory's name are at most 255."""

_PROCS = "cgroup.procs"
_SUBTREE = "cgroup.subtree_control"

_COUNTED = frozenset({"memory", "pids"})
"""Controllers without which the kernel does not count what a cgroup has; cpu.stat needs none."""

_GRACE_S = 0.5
"""What a process has left behind gets so long to end before it is killed."""

_KILL_S = 5.0
"""How long the kernel may take to end what was killed, and to let go of its cgroup."""

_LOOK_S = 0.01

_ROUNDS = 3
"""How often what was started while others were moved is looked for."""


class CgroupError(UsageError):
    """There is no cgroup to be had with what the manifest asks for; nothing was started."""


class RunRecorder(Protocol):
    """What notes a run's cgroup, for who cleans up after a supervisor that was killed.

    Attributes:
        run_id: of the run.
    """

    run_id: str

    def note_cgroup(self, path: str, controllers: Sequence[str]) -> None:
        """Note the run's cgroup, and the controllers that are enabled for it in its parent."""


def own_cgroup(proc: Path = Path("/proc/self")) -> Path:
    """Return the directory of this process's own cgroup.

    Also where controllers are in hierarchies of version 1 as well ("hybrid"), and in a cgroup
    namespace, where the hierarchy begins with the namespace's own.

    Args:
        proc: has `cgroup` and `mountinfo`, see proc(5).

    Raises:
        CgroupError: no cgroup2 file system shows it.
    """
    path = _own_path((proc / "cgroup").read_text(encoding="utf-8", errors="surrogateescape"))
    mountinfo = (proc / "mountinfo").read_text(encoding="utf-8", errors="surrogateescape")
    found = [each for each in _places(path, mountinfo) if (each / _PROCS).exists()]
    if not found:
        raise CgroupError(f"no cgroup2 file system shows its cgroup {path!r}")
    return next((each for each in found if os.access(each, os.W_OK)), found[0])


def _own_path(text: str) -> str:
    """Return a process's path in the hierarchy of version 2: the line `0::PATH`, cgroups(7)."""
    for line in text.splitlines():
        if line.startswith("0::/"):
            return line[len("0::") :]
    raise CgroupError("this kernel has no cgroup v2")


def _places(path: str, mountinfo: str) -> Iterator[Path]:
    """Yield where a path of the hierarchy is in the file system, by each mount that shows it."""
    own = PurePosixPath(path)
    if ".." in own.parts:
        return  # outside of this cgroup namespace
    for line in mountinfo.splitlines():
        fields, _, rest = line.partition(" - ")
        words = fields.split(" ")
        if rest.partition(" ")[0] != "cgroup2":
            continue
        root, mounted = (re.sub(r"\\(\d{3})", _unescaped, each) for each in words[3:5])
        if own.is_relative_to(root):
            yield Path(mounted) / own.relative_to(root)


def _unescaped(octal: re.Match[str]) -> str:
    return chr(int(octal[1], 8))


def _events(path: Path) -> dict[str, int]:
    """Return how often what happened, by a file of a cgroup; nothing where none is counted."""
    try:
        lines = path.read_text(encoding="ascii").splitlines()
    except OSError:
        return {}
    return {name: int(count) for name, _, count in (each.partition(" ") for each in lines)}


class ProcessCgroup:
    """The cgroup of one process and all that it starts.

    Attributes:
        path: its directory.
        procs: the file by which a process joins it, writing "0" there.
    """

    def __init__(self, path: Path, resources: Resources) -> None:
        self.path = path
        self.procs = str(path / _PROCS)
        self._resources = resources

    def explain(self) -> str:
        """Say that the kernel killed in it for want of memory, or refused to fork; else empty."""
        events = _events(self.path / "memory.events")
        most, tasks = self._resources.memory_max_mib, self._resources.tasks_max
        if kills := events.get("oom_kill", 0):
            of = f"memory_max_mib {most}" if most and events.get("oom") else "what the machine has"
            return f"out of memory, {of}: the kernel killed {kills} of its processes"
        if tasks and _events(self.path / "pids.events").get("max"):
            return f"its tasks_max {tasks} was reached"
        return ""

    async def end(self) -> None:
        """End what is left in it, bounded, and remove it."""
        for _ in _ending(self.path):
            await asyncio.sleep(_LOOK_S)


class RunCgroup:
    """The cgroup of one run, below the supervisor's own.

    Args:
        own: the supervisor's own, see `own_cgroup`.
        recorder: notes the run's before it is made.
    """

    def __init__(self, own: Path, recorder: RunRecorder) -> None:
        self._own = own
        self._recorder = recorder
        self._path = own / f"{_PREFIX}{recorder.run_id}"
        self._enabled: set[str] = set()
        self._has_moved = False

    @classmethod
    def below_own(cls, recorder: RunRecorder, process: PlannedProcess) -> RunCgroup:
        """Return that of this process, not yet made.

        Args:
            recorder: see above.
            process: that asks for resources.

        Raises:
            CgroupError: there is none.
        """
        try:
            return cls(own_cgroup(), recorder)
        except CgroupError as error:
            raise _refused(process, error.message) from error

    def prepare(self, processes: Sequence[PlannedProcess], family: ProcessFamily) -> None:
        """Make sure that all that these processes ask for can be had; again for further ones.

        Args:
            processes: all have resources.
            family: knows the fork server, and what it has started already.

        Raises:
            CgroupError: it cannot; says what is missing where, and what is allowed. What was done
                for these processes is undone.
        """
        asked = {
            name: each
            for each in processes
            if each.run.resources is not None
            for name in each.run.resources.controllers()
        }
        available = _words(self._own / "cgroup.controllers")
        for name, process in sorted(asked.items()):
            if name not in available:
                raise _refused(
                    process,
                    f"the controller {name!r} is not delegated to cgroup {str(self._own)!r} of "
                    f"this supervisor; available there: {', '.join(sorted(available)) or 'none'}",
                )
        fresh = not self._path.exists()
        try:
            self._make(processes[0])
            wanted = (available & _COUNTED) | asked.keys()
            self._enable(wanted, needed=bool(asked), process=processes[0], family=family)
        except CgroupError:
            if fresh:
                self.close()
            raise

    def _make(self, process: PlannedProcess) -> None:
        self._recorder.note_cgroup(str(self._path), sorted(self._enabled))
        try:
            self._path.mkdir(exist_ok=True)
        except OSError as error:
            raise _refused(
                process,
                f"cgroup {str(self._own)!r} of this supervisor is not delegated to it: "
                f"{error.strerror}",
            ) from error

    def _enable(
        self,
        wanted: Collection[str],
        *,
        needed: bool,
        process: PlannedProcess,
        family: ProcessFamily,
    ) -> None:
        """Enable controllers for the run's processes.

        Args:
            wanted: those that are available.
            needed: some are asked for; else all are only to count, and do without if need be.
            process: of messages.
            family: see `prepare`.
        """
        missing = set(wanted) - _words(self._own / _SUBTREE)
        stayed = not self._has_moved
        try:
            if missing:
                self._leave_own(family)
                self._recorder.note_cgroup(str(self._path), sorted(self._enabled | missing))
                self._enabled |= missing
                _enable(self._own, missing)
            _enable(self._path, wanted)
        except OSError as error:
            others = () if error.errno != errno.EBUSY else _pids(self._own)
            self._disable(missing)
            if stayed:
                self._return_to_own()
            if not needed:
                return
            if others:
                listed = ", ".join(map(str, others))
                why = (
                    f"cgroup {str(self._own)!r} of this supervisor has other processes, too (pid "
                    f"{listed}), and then none below it can have controllers; allowed is a cgroup "
                    "of its own"
                )
            else:
                why = (
                    f"cgroup {str(self._own)!r} of this supervisor is not delegated to it: cannot "
                    f"enable {', '.join(sorted(wanted))}: {error.strerror}"
                )
            raise _refused(process, why) from error

    def _leave_own(self, family: ProcessFamily) -> None:
        """Leave our own cgroup to its subgroups, but for the root of the hierarchy.

        What has no cgroup of its own goes with us.
        """
        if self._has_moved or not (self._own / "cgroup.type").exists():
            return
        group = self._path / _SUPERVISOR
        group.mkdir(exist_ok=True)
        self._has_moved = True
        for _ in range(_ROUNDS):
            ours = {os.getpid(), family.pid, *family.family()}.intersection(_pids(self._own))
            if not ours:
                break
            for pid in ours:
                with contextlib.suppress(ProcessLookupError):
                    _write(group / _PROCS, str(pid))

    def _disable(self, controllers: Collection[str]) -> None:
        """Disable controllers that we have enabled."""
        for path in (self._path, self._own):
            _disable(path, controllers)
        self._enabled.difference_update(controllers)

    def _return_to_own(self) -> None:
        """Go back to our own cgroup with all that went along; nothing below it has controllers."""
        if not self._has_moved:
            return
        group = self._path / _SUPERVISOR
        with contextlib.suppress(OSError):
            for pid in _pids(group):
                with contextlib.suppress(ProcessLookupError):
                    _write(self._own / _PROCS, str(pid))
            group.rmdir()
            self._has_moved = False

    def make(self, name: str, resources: Resources) -> ProcessCgroup:
        """Make the cgroup of a process that is about to be started, with its limits.

        Args:
            name: of the process; one that ran before it may not be gone yet.
            resources: prepared before.

        Raises:
            OSError: the kernel refuses.
        """
        label = _PROCESS + re.sub(r"[^A-Za-z0-9_.-]", "_", name)[:_LONGEST_NAME]
        for number in itertools.count(1):
            path = self._path / (label if number == 1 else f"{label}.{number}")
            with contextlib.suppress(FileExistsError):
                path.mkdir()
                break
        group = ProcessCgroup(path, resources)
        try:
            for file, text in resources.settings():
                _write(path / file, text)
        except OSError:
            with contextlib.suppress(OSError):
                path.rmdir()
            raise
        return group

    def close(self) -> str:
        """End what is left in the run's cgroup, bounded, and remove it; go back to our own.

        Returns:
            Why something of it is still there; empty if nothing is.
        """
        for group in _subgroups(self._path):
            if group.name != _SUPERVISOR and not _cleared(group):
                return f"cannot remove cgroup {str(group)!r}: something in it does not end"
        self._disable(tuple(self._enabled))
        self._return_to_own()
        if not _cleared(self._path):
            return f"cannot remove cgroup {str(self._path)!r}: something in it does not end"
        return ""


def pids_left(path: str, run_id: str) -> frozenset[int]:
    """Return what is left in the cgroup of a run whose supervisor was killed, see `remove_left`."""
    group = _noted(path, run_id)
    return frozenset(pid for each in _tree(group) for pid in _pids(each)) if group else frozenset()


def remove_left(path: str, controllers: Iterable[str], run_id: str) -> None:
    """Remove the cgroup of a run whose supervisor was killed, and end what is left in it.

    Args:
        path: as it was noted; anything but a cgroup of that run is left alone.
        controllers: that were enabled for it in its parent; another run may still use them.
        run_id: of that run.
    """
    group = _noted(path, run_id)
    if group is not None and _cleared(group):
        _disable(group.parent, controllers)


def _noted(path: str, run_id: str) -> Path | None:
    group = Path(path)
    return group if group.name == f"{_PREFIX}{run_id}" and (group / _PROCS).exists() else None


def _refused(process: PlannedProcess, why: str) -> CgroupError:
    resources = process.run.resources
    assert resources is not None
    at = resources.at
    user = " --user" if os.geteuid() else ""
    return CgroupError(
        f"{at.file}:{at.line}:{at.column}: cannot give process {process.name!r} a cgroup for its "
        f"'run.resources': {why}",
        hint="start it where it is: `Delegate=yes` in its systemd unit, or "
        f"`systemd-run{user} --scope -p Delegate=yes lifecycle up ...`",
    )


def _write(path: Path, text: str) -> None:
    # These files exist, and take what is written at once.
    descriptor = os.open(path, os.O_WRONLY | os.O_CLOEXEC)
    try:
        os.write(descriptor, text.encode())
    except OSError as error:
        raise OSError(error.errno, f"{error.strerror}, writing {text!r}", str(path)) from error
    finally:
        os.close(descriptor)


def _enable(path: Path, controllers: Iterable[str]) -> None:
    """Enable controllers for what is below a cgroup, all or none."""
    words = " ".join(f"+{each}" for each in sorted(controllers))
    if words:
        _write(path / _SUBTREE, words)


def _disable(path: Path, controllers: Iterable[str]) -> None:
    """Disable controllers for what is below a cgroup, but for those that another run uses there."""
    for each in _words(path / _SUBTREE).intersection(controllers):
        with contextlib.suppress(OSError):
            _write(path / _SUBTREE, f"-{each}")


def _words(path: Path) -> set[str]:
    try:
        return set(path.read_text(encoding="ascii").split())
    except OSError:
        return set()


def _pids(path: Path) -> tuple[int, ...]:
    """Return what is in a cgroup itself; 0 for each process of another pid namespace."""
    try:
        return tuple(map(int, (path / _PROCS).read_text(encoding="ascii").split()))
    except OSError:
        return ()


def _subgroups(path: Path) -> list[Path]:
    try:
        return [Path(each.path) for each in os.scandir(path) if each.is_dir(follow_symlinks=False)]
    except FileNotFoundError:
        return []


def _tree(path: Path) -> list[Path]:
    """Return a cgroup and all below it, children before their parents."""
    return [each for child in _subgroups(path) for each in _tree(child)] + [path]


def _removed(path: Path) -> bool:
    """Remove a cgroup and all below it; False if something is in one of them."""
    try:
        for each in _tree(path):
            with contextlib.suppress(FileNotFoundError):
                each.rmdir()
    except OSError:
        return False
    return True


def _end(path: Path, *, kill: bool) -> None:
    """Ask what is in a cgroup, and below it, to end, or kill it; never this process."""
    for each in _tree(path):
        for pid in _pids(each):
            if pid not in (0, os.getpid()):
                with contextlib.suppress(ProcessLookupError, PermissionError):
                    _signal(pid, each, signal.SIGKILL if kill else signal.SIGTERM)


def _signal(pid: int, group: Path, number: int) -> None:
    """Signal a process of a cgroup, never a later owner of its pid."""
    pidfd = os.pidfd_open(pid)
    try:
        if pid in _pids(group):
            signal.pidfd_send_signal(pidfd, number)
            signal.pidfd_send_signal(pidfd, signal.SIGCONT)  # a stopped one ends once it goes on
    finally:
        os.close(pidfd)


def _ending(path: Path) -> Iterator[None]:
    """End what is in a cgroup, and remove it; pauses after each look, bounded in all."""
    for kill, limit_s in ((False, _GRACE_S), (True, _KILL_S)):
        asked = False
        deadline = time.monotonic() + limit_s
        while time.monotonic() < deadline:
            if _removed(path):
                return
            if kill or not asked:  # again for what was started meanwhile
                _end(path, kill=kill)
            asked = True
            yield


def _cleared(path: Path) -> bool:
    """End what is in a cgroup, bounded, and remove it; False if it is still there."""
    for _ in _ending(path):
        time.sleep(_LOOK_S)
    return not path.exists()
