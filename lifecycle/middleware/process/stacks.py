"""Where the threads of a process stand: asked by a signal, answered by faulthandler into a file.

Owns: the signal, the wait for the answer, and what of it is shown. The answer is written by a C
signal handler, so that code which never gives up the interpreter's lock is seen as well. Must not
import rclpy.
"""

from __future__ import annotations

import contextlib
import faulthandler
import os
import re
import signal
import sysconfig
import time
from pathlib import Path

SIGNAL = signal.SIGRTMAX - 3
"""One that programs do not use; only who has called `answer` is sent it."""

_WITHIN_S = 0.25
_STILL_S = 0.01
"""An answer is complete once nothing came for so long: it is written within a millisecond."""

_MOST_BYTES = 1 << 16
_FRAME = re.compile(r'  File "(?P<file>.*)", line (?P<line>\d+) in (?P<name>.*)')
_SHOWN = 3

_PACKAGE = f"{Path(__file__).parents[2]}{os.sep}"
_HOST = f"{_PACKAGE}node{os.sep}host{os.sep}"
_STDLIB = f"{sysconfig.get_path('stdlib')}{os.sep}"
_PACKAGES = ("site-packages", "dist-packages")


def answer(descriptor: int) -> bool:
    """Have this process append its stacks to a file whenever it is asked; whether that works.

    The caller's thread, and those that begin after this, do not take the signal: what waits in one
    of them is not interrupted. One thread has to call `show_stacks_here`.
    """
    signal.pthread_sigmask(signal.SIG_BLOCK, {SIGNAL})
    try:
        # Of its own offset, and at the end wherever the file is cut.
        file = os.open(f"/proc/self/fd/{descriptor}", os.O_WRONLY | os.O_APPEND | os.O_CLOEXEC)
        faulthandler.register(SIGNAL, file=file, all_threads=True)
    except (OSError, RuntimeError, ValueError):
        return False
    return True


def show_stacks_here() -> None:
    """Take the signal in this thread; it must not mind being interrupted."""
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {SIGNAL})


def ask(pid: int, descriptor: int, keep_bytes: int) -> str:
    """Return the stacks of a process that answers into a file; empty if it does not in time.

    Args:
        pid: of the process.
        descriptor: of the file.
        keep_bytes: its beginning, which is something else.
    """
    try:
        os.ftruncate(descriptor, keep_bytes)
        os.kill(pid, SIGNAL)
    except OSError:
        return ""
    began = grown = time.monotonic()
    size = keep_bytes
    while (now := time.monotonic()) - began < _WITHIN_S:
        if (more := os.fstat(descriptor).st_size) != size:
            size, grown = more, now
        elif size > keep_bytes and now - grown >= _STILL_S:
            break
        time.sleep(0.001)
    return os.pread(descriptor, _MOST_BYTES, keep_bytes).decode(errors="replace")


def brief(stacks: str) -> str:
    """Return where the code of a callback stands; empty where no thread is in one.

    The function that was called back, and the last ones that it called: `hear (robot.py:12) > read
    (robot.py:40)`. What is neither below our executor nor rclpy's is no callback; what belongs to
    these, or to Python, is left out.
    """
    found = []
    for thread in re.split(r"\n\n|(?=Current thread|Thread 0x)", stacks):
        frames = [match.groups() for match in map(_FRAME.match, thread.splitlines()) if match]
        # What a host was forked from is below it, a command line with its libraries.
        hosts = [index for index, (file, *_) in enumerate(frames) if file.startswith(_HOST)]
        frames = frames[: hosts[0] + 1] if hosts else frames
        users = [index for index, (file, *_) in enumerate(frames) if _is_users(file)]
        if not users or not any(_is_executor(file) for file, *_ in frames[users[-1] + 1 :]):
            continue
        chosen = [*users[: _SHOWN - 1], users[-1]] if len(users) > _SHOWN else users
        shown = [frames[index] for index in dict.fromkeys(reversed(chosen))]
        found.append(" > ".join(f"{name} ({_short(file)}:{line})" for file, line, name in shown))
    return "; ".join(dict.fromkeys(found[:2]))


def _is_executor(file: str) -> bool:
    return file.startswith(_PACKAGE) or "/rclpy/" in file


def _is_users(file: str) -> bool:
    if file.startswith("<") or _is_executor(file):
        return False
    return not file.startswith(_STDLIB) or any(each in file for each in _PACKAGES)


def _short(file: str) -> str:
    with contextlib.suppress(ValueError, OSError):
        return str(Path(file).relative_to(Path.cwd()))
    return file
