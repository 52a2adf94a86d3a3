"""What the processes of a system print: split into lines, kept, written to files.

Owns: `LineReader` (pipe → lines), `ProcessLog` (last lines of one process and its file) and where
files go (`log_directory`, the ROS log directory convention). Must not import rclpy.
"""

from __future__ import annotations

import asyncio
import collections
import contextlib
import datetime as dt
import os
import socket
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import IO

LONGEST_LINE = 64 * 1024
"""Bytes; a longer line is cut into pieces, so that a process cannot fill our memory."""

_TAIL_LINES = 20


def ros_log_root(environment: Mapping[str, str]) -> Path:
    """Return the ROS log directory: ROS_LOG_DIR, else ROS_HOME/log, else ~/.ros/log.

    Source: rcl_logging_get_logging_directory in rcl_logging_interface.
    """
    if environment.get("ROS_LOG_DIR"):
        return Path(environment["ROS_LOG_DIR"]).expanduser()
    if environment.get("ROS_HOME"):
        return Path(environment["ROS_HOME"]).expanduser() / "log"
    return Path("~/.ros/log").expanduser()


def log_directory(environment: Mapping[str, str], system: str) -> Path:
    """Return a fresh directory for one run, named as launch names its own: time, host, pid."""
    now = dt.datetime.now().astimezone()
    stamp = now.strftime("%Y-%m-%d-%H-%M-%S-%f")
    host = socket.gethostname()
    return ros_log_root(environment) / f"{stamp}-{host}-{os.getpid()}-{system}"


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
        self.ended = self._loop.create_future()
        os.set_blocking(descriptor, False)
        self._loop.add_reader(descriptor, self._read)

    def _read(self) -> None:
        try:
            data = os.read(self._descriptor, LONGEST_LINE)
        except BlockingIOError:
            return
        if not data:
            self.close()
            return
        *lines, self._rest = (self._rest + data).split(b"\n")
        for line in lines:
            self._line(line)
        while len(self._rest) >= LONGEST_LINE:
            self._line(self._rest[:LONGEST_LINE])
            self._rest = self._rest[LONGEST_LINE:]

    def _line(self, line: bytes) -> None:
        self._on_line(line.rstrip(b"\r").decode("utf-8", errors="replace"))

    def close(self) -> None:
        """Read what is there, give up the descriptor and hand out an unfinished last line."""
        if not self._open:
            return
        self._open = False
        self._loop.remove_reader(self._descriptor)
        with contextlib.suppress(BlockingIOError):
            while data := os.read(self._descriptor, LONGEST_LINE):
                self._rest += data
        os.close(self._descriptor)
        for line in self._rest.split(b"\n"):
            if line:
                self._line(line)
        self._rest = b""
        if not self.ended.done():
            self.ended.set_result(None)


class ProcessLog:
    """The output of one process: the last lines in memory, all of them in a file."""

    def __init__(self, directory: Path, process: str) -> None:
        self._tail: collections.deque[str] = collections.deque(maxlen=_TAIL_LINES)
        self.path = directory / f"{process.replace('/', '.')}.log"
        self._file: IO[str] | None = None

    def open(self) -> None:
        """Create the file, and its directory where it is missing.

        Raises:
            OSError: the directory cannot be written.
        """
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self._file = self.path.open("a", encoding="utf-8", buffering=1)

    def add(self, line: str) -> None:
        """Keep one line."""
        self._tail.append(line)
        if self._file is not None:
            self._file.write(line + "\n")

    @property
    def tail(self) -> tuple[str, ...]:
        """The last lines, oldest first."""
        return tuple(self._tail)

    def close(self) -> None:
        """Close the file."""
        if self._file is not None:
            self._file.close()
            self._file = None
