"""Logs of a system's processes: output split into lines, kept, written to rotated files.

Owns: `LineReader` (pipe → lines), `ProcessLog` (what one process wrote), `RotatedFile`,
`LogDirectory` (what of a run's logs is missing) and where files go (`log_directory`, the ROS log
directory convention). Must not import rclpy.
"""

from __future__ import annotations

import asyncio
import contextlib
import datetime as dt
import errno
import os
import re
import socket
import time
from collections.abc import Callable, Mapping
from pathlib import Path

from lifecycle.errors import UsageError
from lifecycle.run_directory import home_directory

LONGEST_LINE = 64 * 1024
"""Bytes; a longer line is cut into pieces, so that a process cannot fill our memory."""

LARGEST_LOG = 16 * 2**20
"""Bytes of a log file; of each process there is one, and one older."""

_LARGEST_PIPE = 2**20
"""Bytes; /proc/sys/fs/pipe-max-size by default, pipe(7)."""

TRIED_AGAIN_S = 1.0
"""How often a log is tried that could not be written."""

_SAID_AGAIN_S = 60.0
"""How often that is said, where it is so again and again."""


def ros_log_root(environment: Mapping[str, str]) -> Path:
    """Return the ROS log directory: ROS_LOG_DIR, else ROS_HOME/log, else ~/.ros/log.

    Source: rcl_logging_get_logging_directory in rcl_logging_interface.

    Raises:
        UsageError: there is no home directory.
    """
    if environment.get("ROS_LOG_DIR"):
        return Path(environment["ROS_LOG_DIR"]).expanduser()
    if environment.get("ROS_HOME"):
        return Path(environment["ROS_HOME"]).expanduser() / "log"
    home = home_directory(environment)
    if not home:
        raise UsageError(
            "cannot find a home directory for ROS's logs: HOME is not set, and this user has none",
            hint="set ROS_LOG_DIR to a directory",
        )
    return Path(home) / ".ros" / "log"


def check_log_root(environment: Mapping[str, str]) -> None:
    """Make sure that there is, or can be, a ROS log directory: rcl starts no node without.

    Raises:
        UsageError: there cannot. That its disk is full is no reason.
    """
    root = ros_log_root(environment)
    try:
        root.mkdir(parents=True, exist_ok=True)
        # As this process is, capabilities included, and not as its real user would be.
        if not os.access(root, os.W_OK | os.X_OK, effective_ids=True):
            raise PermissionError(errno.EACCES, "it cannot be written")
    except OSError as error:
        if error.errno not in (errno.ENOSPC, errno.EDQUOT):
            raise UsageError(
                f"cannot use {str(root)!r} as ROS log directory: {error.strerror}",
                hint="set ROS_LOG_DIR to a directory that can be made and written",
            ) from error


def log_directory(environment: Mapping[str, str], system: str) -> Path:
    """Return a fresh directory for one run, named as launch names its own: time, host, pid."""
    now = dt.datetime.now().astimezone()
    stamp = now.strftime("%Y-%m-%d-%H-%M-%S-%f")
    host = socket.gethostname()
    return ros_log_root(environment) / f"{stamp}-{host}-{os.getpid()}-{system}"


KEPT_RUNS = 50
"""Runs of one system whose logs are kept; LIFECYCLE_KEEP_LOGS says otherwise."""

JOURNAL_NAME = "journal.jsonl"
"""What happened in the run, in the directory of its logs, see run/journal.py."""

LATEST = "latest"
"""Link to the directory of the run that began last, as launch has it."""


def _named(system: str) -> re.Pattern[str]:
    """What the log directory of a run of a system is called; of any system if it is empty."""
    name = re.escape(system) if system else r"[A-Za-z][A-Za-z0-9_-]*"
    return re.compile(rf"\d{{4}}(?:-\d\d){{5}}-\d{{6}}-.+-(?P<pid>\d+)-{name}")


def runs_of(root: Path, system: str = "") -> list[Path]:
    """Return the log directories of runs of a system, or of all, the newest first.

    That is by their names, except that the one that began last is the first: the clock may have
    been set back since the others.
    """
    named = _named(system)
    names: list[str] = []
    last = ""
    with contextlib.suppress(OSError):
        names = os.listdir(root)  # noqa: PTH208 - every ROS process leaves a file there
        last = (root / LATEST).readlink().name
    found = (root / name for name in names if name[0].isdigit() and named.fullmatch(name))
    there = (each for each in found if not each.is_symlink() and each.is_dir())
    return sorted(there, key=lambda each: (each.name == last, each), reverse=True)


def is_running(run: Path) -> bool:
    """Return whether the supervisor lives whose run a log directory is of."""
    named = _named("").fullmatch(run.name)
    return named is not None and Path(f"/proc/{named['pid']}").exists()


def begin_logs(environment: Mapping[str, str], path: Path, system: str) -> None:
    """Make the directory of a run, have `latest` lead to it, and remove those of old runs.

    LIFECYCLE_KEEP_LOGS may say how many runs of the system are kept. What cannot be done is left:
    processes' logs say themselves that they cannot be written.
    """
    with contextlib.suppress(OSError):
        path.mkdir(parents=True, exist_ok=True)
        link = path.parent / LATEST
        if link.is_symlink() or not link.exists():
            made = path.parent / f".{LATEST}-{os.getpid()}"
            made.symlink_to(path.name)
            made.replace(link)
    given = environment.get("LIFECYCLE_KEEP_LOGS", "")
    keep = int(given) if given.isascii() and given.isdigit() and int(given) else KEPT_RUNS
    for each in runs_of(path.parent, system)[keep:]:
        with contextlib.suppress(OSError):
            _remove_run(each)


def _remove_run(path: Path) -> None:
    """Remove the logs of a run that is over, unless there is more in it."""
    files = list(path.iterdir())
    ours = all(
        each.name.endswith((".log", ".log.1", JOURNAL_NAME, f"{JOURNAL_NAME}.1"))
        and each.is_file()
        and not each.is_symlink()
        for each in files
    )
    if ours and not is_running(path):
        for each in files:
            each.unlink()
        path.rmdir()


class LineReader:
    """Turns the bytes of a pipe into lines, in the running event loop.

    The descriptor is owned: it is closed at end of file or by `close`.
    """

    def __init__(self, descriptor: int, on_line: Callable[[str], None]) -> None:
        self._descriptor = descriptor
        self._on_line = on_line
        self._rest = b""
        self._loop = asyncio.get_running_loop()
        self._open = True
        os.set_blocking(descriptor, False)
        self._loop.add_reader(descriptor, self._read)

    def drain(self) -> None:
        """Read what is there: of a process that has ended, its last words.

        No more than a pipe holds: a process left behind may write faster than we read.
        """
        for _ in range(_LARGEST_PIPE // LONGEST_LINE):
            if not self._open or not self._read():
                return

    def _read(self) -> bool:
        """Read once; whether there may be more."""
        try:
            data = os.read(self._descriptor, LONGEST_LINE)
        except BlockingIOError:
            return False
        if not data:
            self._end()
            return False
        *lines, self._rest = (self._rest + data).split(b"\n")
        for line in lines:
            self._line(line)
        while len(self._rest) >= LONGEST_LINE:
            self._line(self._rest[:LONGEST_LINE])
            self._rest = self._rest[LONGEST_LINE:]
        return True

    def _line(self, line: bytes) -> None:
        self._on_line(line.rstrip(b"\r").decode("utf-8", errors="replace"))

    def close(self) -> None:
        """Read what is there, give up the descriptor and emit an unfinished last line."""
        self.drain()
        self._end()

    def _end(self) -> None:
        if self._open:
            self._open = False
            self._loop.remove_reader(self._descriptor)
            os.close(self._descriptor)
            if self._rest:
                self._line(self._rest)


class Traceback:
    """Finds Python's last traceback among the lines of a process.

    Attributes:
        last: its exception, and the place in the user's code that it came by; empty before one.
    """

    def __init__(self) -> None:
        self.last = ""
        self._place = ""
        self._is_users = False
        self._inside = False

    def add(self, line: str) -> None:
        """Take the next line of standard error."""
        if line.startswith("Traceback (most recent call last):"):
            self._inside, self._place, self._is_users = True, "", False
        elif not self._inside:
            return
        elif found := _FRAME.match(line):
            is_users = not _LIBRARY.search(found[1])
            if is_users or not self._is_users:
                self._place, self._is_users = f"{found[1]}:{found[2]}", is_users
        elif line.strip() and not line.startswith(" "):
            self._inside = False
            self.last = f"{line} ({self._place})" if self._place else line


_FRAME = re.compile(r'  File "([^"]+)", line (\d+)')
_LIBRARY = re.compile(r"^<|/(?:site|dist)-packages/|/lib/python3")


class LogDirectory:
    """Where the logs of one run are, and what of them could not be written.

    A log that cannot be written ends nothing: that is said once, what is missing is counted, in
    the file where it is missing, and said again once all of it can be written.
    """

    def __init__(self, path: Path, say: Callable[[str], None]) -> None:
        self.path = path
        self._say = say
        self._said_s: float | None = None
        self._why = ""
        self._failing: set[str] = set()
        self._lost = 0

    def fails(self, process: str, error: OSError | None, *, lines: int) -> None:
        """Note that so many lines of a process could not be written."""
        self._failing.add(process)
        self._lost += lines
        self._why = "" if error is None else error.strerror or str(error)
        now_s = time.monotonic()
        if self._said_s is None or now_s - self._said_s > _SAID_AGAIN_S:
            self._said_s = now_s
            self._say(
                f"cannot write the log of process {process!r} in {str(self.path)!r}: {self._why}; "
                "the run goes on, and what is lost is counted"
            )

    def recovers(self, process: str) -> None:
        """Note that the log of a process can be written again."""
        self._failing.discard(process)
        if not self._failing:
            self.report_lost()

    def report_lost(self) -> None:
        """Say what is missing, if that was not said."""
        lost, self._lost = self._lost, 0
        if lost:
            self._say(f"{_missing(lost)} missing in {str(self.path)!r}: {self._why}")


class RotatedFile:
    """A file of lines: one that is full becomes `NAME.1`, and replaces the one before.

    Args:
        path: of the file; it, and its directory, are made where they are missing.
        largest: bytes that it has at most.
        mode: its permissions.
        head: returns the line that each file begins with.

    Attributes:
        error: why the last line could not be written; None if it was.
    """

    def __init__(
        self,
        path: Path,
        largest: int,
        *,
        mode: int = 0o666,
        head: Callable[[], bytes] = bytes,
    ) -> None:
        self.path = path
        self.largest = largest
        self.error: OSError | None = None
        self._mode = mode
        self._head = head
        self._failed_s = 0.0
        self._file: int | None = None
        self._bytes = 0
        self._torn = False

    def add(self, line: bytes) -> bool:
        """Append a line; False if that failed, now or within the last second."""
        now_s = time.monotonic()
        if self.error is not None and now_s - self._failed_s < TRIED_AGAIN_S:
            return False
        try:
            self._write(line)
            self.error = None
        except OSError as error:
            self.error, self._failed_s = error, now_s
        return self.error is None

    def _write(self, line: bytes) -> None:
        if self._bytes and self._bytes + len(line) > self.largest:
            self.path.replace(self.path.with_name(f"{self.path.name}.1"))
            self.close()
        if self._file is None:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            flags = os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC
            self._file = os.open(self.path, flags, self._mode)
            self._bytes = os.fstat(self._file).st_size
        left = memoryview(b"\n" * self._torn + (b"" if self._bytes else self._head()) + line)
        while left:
            written = os.write(self._file, left)
            self._bytes += written
            left = left[written:]
            self._torn = bool(left)

    def close(self) -> None:
        """Close it; the next line opens it again."""
        if self._file is not None:
            os.close(self._file)
        self._file, self._bytes, self._torn = None, 0, False


class ProcessLog:
    """The output of one process; where it is kept, in two files of LARGEST_LOG at most."""

    def __init__(self, directory: LogDirectory, process: str, *, kept: bool = True) -> None:
        self._kept = kept
        self._directory = directory
        self._process = process
        self.path = directory.path / f"{process.replace('/', '.')}.log"
        self._file = RotatedFile(self.path, LARGEST_LOG)
        self._lost = 0
        self._open = False

    def open(self) -> None:
        """Create the file, and its directory where it is missing."""
        self._open = self._kept
        if self._open and not self._file.add(b""):
            self._directory.fails(self._process, self._file.error, lines=0)

    def add(self, line: str) -> None:
        """Write one line, and before it how many are missing there."""
        if not self._open:
            return
        file, before = self._file, self._file.error
        text = f"{line}\n"
        if self._lost and before is not None:
            text = f"{_missing(self._lost)} missing here: {before.strerror}\n{text}"
        if not file.add(text.encode(errors="backslashreplace")):
            self._lost += 1
            self._directory.fails(self._process, file.error, lines=1)
        elif before is not None:
            self._lost = 0
            self._directory.recovers(self._process)

    @property
    def shown(self) -> str:
        """Its path for messages; empty where there is no file."""
        return str(self.path) if self._kept else ""

    def close(self) -> None:
        """Close the file."""
        self._open = False
        self._file.close()


def _missing(lines: int) -> str:
    return "1 log line is" if lines == 1 else f"{lines} log lines are"
