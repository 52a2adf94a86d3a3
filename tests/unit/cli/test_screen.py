"""A text that changes, on a terminal of 80 columns and 24 rows, and on none."""

from __future__ import annotations

import fcntl
import os
import pty
import re
import select
import signal
import struct
import subprocess
import sys
import termios
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

PROGRAM = """
import signal
import sys
import time

from lifecycle.cli import main
from lifecycle.cli.screen import Screen

# A row, wide characters, and what is too wide and too long for the terminal.
text = "\\n".join(f"{number:3} " + "界" * 60 + "." * 60 for number in range(1, 101))
with Screen() as screen:
    screen.show("first")
    screen.show(text)
    while True:
        time.sleep(60)
print("left by a key")
"""


class Terminal:
    """A program in a terminal of its own."""

    def __init__(self) -> None:
        self.pid, self.end = pty.fork()
        if self.pid == 0:
            os.execv(sys.executable, [sys.executable, "-c", PROGRAM])
        self.resize(80, 24)
        self.shown = b""

    def resize(self, columns: int, rows: int) -> None:
        fcntl.ioctl(self.end, termios.TIOCSWINSZ, struct.pack("HHHH", rows, columns, 0, 0))

    def until(self, wanted: str) -> list[str]:
        """Return the rows of the first picture that has this in it."""
        deadline = time.monotonic() + 20
        while True:
            *_, last = self.shown.decode(errors="replace").rpartition("\x1b[H")
            if wanted in last and last.endswith("\x1b[0m"):
                plain = re.sub(r"\x1b\[\d*[a-zA-Z]", "", last)
                return plain.split("\r\n")
            ready, _, _ = select.select([self.end], [], [], max(0.0, deadline - time.monotonic()))
            assert ready, self.shown
            self.shown += os.read(self.end, 65536)

    def press(self, keys: str) -> None:
        os.write(self.end, keys.encode())

    def finish(self) -> tuple[int, str]:
        """Return the exit code, and what is on the terminal after the screen was left."""
        while True:
            try:
                data = os.read(self.end, 65536)
            except OSError:
                break
            if not data:
                break
            self.shown += data
        _, status = os.waitpid(self.pid, 0)
        return os.waitstatus_to_exitcode(status), self.shown.decode().rpartition("\x1b[?1049l")[2]


@pytest.fixture
def terminal() -> Iterator[Terminal]:
    made = Terminal()
    yield made
    try:
        os.kill(made.pid, signal.SIGKILL)
        os.waitpid(made.pid, 0)
    except (ProcessLookupError, ChildProcessError):
        pass
    os.close(made.end)


def _cells(row: str) -> int:
    return sum(2 if each == "界" else 1 for each in row)


def test_a_text_that_is_too_large_is_cut_to_the_terminal_and_scrolled(terminal: Terminal) -> None:
    rows = terminal.until("lines 1–23 of 100")
    assert len(rows) == 24
    assert max(map(_cells, rows)) <= 80
    assert rows[0].startswith("  1 界")
    assert rows[-1] == "lines 1–23 of 100   q ends, ↑ ↓ PgUp PgDn scroll, ← → shift"
    terminal.press("\x1b[6~\x1b[B")
    assert terminal.until("lines 25–47 of 100")[0].startswith(" 25 ")
    terminal.press("G\x1b[C")
    rows = terminal.until("lines 78–100 of 100")
    assert max(map(_cells, rows)) <= 80
    terminal.resize(40, 10)
    rows = terminal.until("lines 78–86 of 100")
    assert len(rows) == 10
    assert max(map(_cells, rows)) <= 40
    terminal.press("q")
    code, left = terminal.finish()
    assert code == 0
    assert "left by a key" in left
    assert left.splitlines()[-2].startswith("100 ")


def test_a_signal_leaves_the_terminal_as_it_was(terminal: Terminal) -> None:
    before = termios.tcgetattr(terminal.end)
    terminal.until("lines 1–23 of 100")
    assert termios.tcgetattr(terminal.end) != before
    os.kill(terminal.pid, signal.SIGTERM)
    deadline = time.monotonic() + 20
    while b"\x1b[?1049l" not in terminal.shown:
        assert time.monotonic() < deadline
        terminal.shown += os.read(terminal.end, 65536)
    assert terminal.finish()[0] == 143


def test_without_a_terminal_each_text_follows_the_other(tmp_path: Path) -> None:
    program = PROGRAM.replace("while True:\n        time.sleep(60)", "pass")
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    shown = done.stdout.splitlines()
    assert shown[0] == "first"
    assert shown[-1] == "left by a key"
    assert len(shown) == 102
    assert "\x1b" not in done.stdout
