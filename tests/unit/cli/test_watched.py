"""A text that changes, on a terminal of 80 columns and 24 rows, and on none."""

from __future__ import annotations

import contextlib
import fcntl
import os
import pty
import signal
import struct
import subprocess
import sys
import termios
import time

PROGRAM = """
import time

from lifecycle.cli import main
from lifecycle.cli.standard_streams import watched

# Wide characters, and what is too wide and too long for the terminal.
text = "\\n".join(f"{number:3} " + "界" * 60 + "." * 60 for number in range(1, 101))
with watched() as show:
    show("first")
    show(text)
    while True:
        time.sleep(0.5)  # a signal just before it is handled after it
"""


def test_a_text_is_cut_to_the_terminal_and_a_signal_leaves_it_as_it_was() -> None:
    pid, end = pty.fork()
    if pid == 0:
        os.execv(sys.executable, [sys.executable, "-c", PROGRAM])
    fcntl.ioctl(end, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 80, 0, 0))
    try:
        seen = _read(end, until=b" 20 ")
        assert b"\x1b[?1049h" in seen
        assert b"100 " not in seen
        os.kill(pid, signal.SIGTERM)
        seen = _read(end, until=b"")
        assert b"100 " in seen.rpartition(b"\x1b[?1049l")[2]
    finally:
        _, status = os.waitpid(pid, 0)
        os.close(end)
    assert os.waitstatus_to_exitcode(status) == 143


def _read(end: int, *, until: bytes) -> bytes:
    """Read until something is seen; without it to the end."""
    seen = b""
    deadline = time.monotonic() + 20
    while not until or until not in seen:
        assert time.monotonic() < deadline, seen
        data = b""
        with contextlib.suppress(OSError):  # the other end is closed
            data = os.read(end, 65536)
        if not data:
            break
        seen += data
    return seen


def test_without_a_terminal_each_text_follows_the_other() -> None:
    program = PROGRAM.partition("    while True:")[0]
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    shown = done.stdout.splitlines()
    assert shown[0] == "first"
    assert len(shown) == 101
    assert "\x1b" not in done.stdout
