"""A text that changes, on the whole terminal: scrolled by keys, cut to its size, for `--watch`.

Owns: the alternate screen and the keys (xterm's control sequences), resizing (SIGWINCH), and how
the terminal is left. Where standard output is no terminal, each text is printed after the other.
"""

from __future__ import annotations

import contextlib
import os
import select
import signal
import sys
import threading
from types import FrameType, TracebackType

from lifecycle.cli.standard_streams import echo_while_read
from lifecycle.errors import ExitCode

_ENTER = "\x1b[?1049h\x1b[?25l"
_LEAVE = "\x1b[?25h\x1b[?1049l"
_HOME, _TO_LINE_END, _TO_SCREEN_END = "\x1b[H", "\x1b[K", "\x1b[J"
_REVERSE, _PLAIN = "\x1b[7m", "\x1b[0m"
_COLUMNS = 8
"""So far the arrows to the sides go."""

_KEYS = {
    b"\x1b[A": "up",
    b"\x1bOA": "up",
    b"k": "up",
    b"\x1b[B": "down",
    b"\x1bOB": "down",
    b"j": "down",
    b"\x1b[5~": "page up",
    b"b": "page up",
    b"\x1b[6~": "page down",
    b" ": "page down",
    b"\x1b[H": "begin",
    b"\x1b[1~": "begin",
    b"g": "begin",
    b"\x1b[F": "end",
    b"\x1b[4~": "end",
    b"G": "end",
    b"\x1b[C": "right",
    b"\x1bOC": "right",
    b"l": "right",
    b"\x1b[D": "left",
    b"\x1bOD": "left",
    b"h": "left",
    b"q": "quit",
}


class Screen:
    """Shows one text after another; use it in a `with`, in the main thread.

    On a terminal it has the whole of it. Arrows, PgUp, PgDn, Home and End scroll; `q` and Ctrl-C
    end, `q` with success. The last text stays behind on the ordinary screen.

    Args:
        whole: False where each text belongs behind the other on a terminal, too, as JSON does.

    Attributes:
        quit: `q` was pressed.
    """

    def __init__(self, *, whole: bool = True) -> None:
        self._whole = whole and sys.stdout is not None and sys.stdout.isatty()
        self._keys = self._whole and sys.stdin is not None and sys.stdin.isatty()
        self._lock = threading.RLock()
        self._lines: list[str] = []
        self._top = self._left = 0
        self.quit = False
        self._handlers: dict[int, object] = {}
        self._modes: list[object] | None = None
        self._wake = (-1, -1)
        self._reader: threading.Thread | None = None

    def show(self, text: str) -> None:
        """Show a text in the place of the last one."""
        text = text.rstrip("\n")
        if not self._whole:
            echo_while_read(text)
            return
        with self._lock:
            self._lines = text.split("\n")
            self._draw()

    def __enter__(self) -> Screen:  # noqa: PYI034 - typing.Self is not in Python 3.10
        if self._whole:
            self._wake = os.pipe()
            for number in (signal.SIGWINCH, signal.SIGCONT, signal.SIGTERM, signal.SIGHUP):
                self._handlers[number] = signal.signal(number, self._on_signal)
            self._take()
            self._reader = threading.Thread(target=self._read, name="screen", daemon=True)
            self._reader.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> bool:
        if self._whole:
            for number, handler in self._handlers.items():
                signal.signal(number, handler)  # type: ignore[arg-type]
            assert self._reader is not None
            os.close(self._wake[1])
            self._reader.join()
            os.close(self._wake[0])
            self._give_back()
            if self._lines:
                self._write("\n".join(self._lines) + "\n")
        return self.quit and kind is KeyboardInterrupt

    def _take(self) -> None:
        """Have the whole terminal, and keys as they are pressed."""
        if self._keys:
            import termios

            descriptor = sys.stdin.fileno()
            modes = termios.tcgetattr(descriptor)
            self._modes = self._modes or [*modes]
            modes[3] &= ~(termios.ICANON | termios.ECHO)
            termios.tcsetattr(descriptor, termios.TCSADRAIN, modes)
        self._write(_ENTER)

    def _give_back(self) -> None:
        self._write(_LEAVE)
        if self._modes is not None:
            import termios

            termios.tcsetattr(sys.stdin.fileno(), termios.TCSADRAIN, self._modes)  # type: ignore[arg-type]

    def _on_signal(self, number: int, _: FrameType | None) -> None:
        if number in (signal.SIGTERM, signal.SIGHUP):
            ends = ExitCode.TERMINATED if number == signal.SIGTERM else ExitCode.HUNG_UP
            raise SystemExit(int(ends))
        # What is interrupted here may be writing: the other thread draws.
        os.write(self._wake[1], b"c" if number == signal.SIGCONT else b"w")

    def _read(self) -> None:
        """Scroll by what is pressed and draw after signals, in a thread, until it is closed."""
        # A signal that this thread took would not wake the main one, which alone runs handlers.
        signal.pthread_sigmask(signal.SIG_BLOCK, (*self._handlers, signal.SIGINT))
        woken = self._wake[0]
        watched, pressed = [woken, *([sys.stdin.fileno()] if self._keys else [])], b""
        while True:
            ready, _, _ = select.select(watched, [], [])
            if woken in ready:
                why = os.read(woken, 64)
                if not why:
                    return
                with self._lock:
                    if b"c" in why:
                        self._take()
                    self._draw()
                continue
            data = os.read(watched[1], 64)
            if not data:
                del watched[1]
            pressed += data
            while pressed:
                key = next((each for each in _KEYS if pressed.startswith(each)), b"")
                if not key and any(each.startswith(pressed) for each in _KEYS):
                    break  # the rest of it comes
                self._press(_KEYS.get(key, ""))
                pressed = pressed[len(key) or 1 :]

    def _press(self, key: str) -> None:
        if key == "quit":
            self.quit = True
            os.kill(os.getpid(), signal.SIGINT)
            return
        with self._lock:
            _, rows = self._size()
            end = len(self._lines)
            self._top = {
                "up": self._top - 1,
                "down": self._top + 1,
                "page up": self._top - rows,
                "page down": self._top + rows,
                "begin": 0,
                "end": end,
            }.get(key, self._top)
            self._left += {"right": _COLUMNS, "left": -_COLUMNS}.get(key, 0)
            self._draw()

    def _size(self) -> tuple[int, int]:
        """Return columns and rows for the text; the last row says what is shown."""
        try:
            columns, rows = os.get_terminal_size(sys.stdout.fileno())
        except OSError:
            columns, rows = 80, 24
        return max(1, columns), max(1, rows - 1)

    def _draw(self) -> None:
        from rich.cells import cell_len

        columns, rows = self._size()
        widest = max(map(cell_len, self._lines), default=0)
        self._top = max(0, min(self._top, len(self._lines) - rows))
        self._left = max(0, min(self._left, widest - columns))
        shown = self._lines[self._top : self._top + rows]
        # Cleared first: behind a full row the cursor is still on its last column.
        text = [f"{_TO_LINE_END}{_cut(each, self._left, columns)}\n" for each in shown]
        text += [f"{_TO_LINE_END}\n"] * (rows - len(shown))
        end = _cut(self._end(len(shown), wide=widest > columns), 0, columns)
        self._write(f"{_HOME}{''.join(text)}{_TO_SCREEN_END}{_REVERSE}{end}{_PLAIN}")

    def _end(self, shown: int, *, wide: bool) -> str:
        said = f"lines {self._top + 1}–{self._top + shown} of {len(self._lines)}"
        if not self._keys:
            return said
        keys = ["q ends"]
        if shown < len(self._lines):
            keys.append("↑ ↓ PgUp PgDn scroll")
        if wide:
            keys.append("← → shift")
        return f"{said}   {', '.join(keys)}"

    def _write(self, text: str) -> None:
        with contextlib.suppress(OSError, ValueError):
            sys.stdout.write(text)
            sys.stdout.flush()


def _cut(line: str, left: int, columns: int) -> str:
    """Return what is visible of a line between two columns; wide characters count as two."""
    if line.isascii():
        return line[left : left + columns]
    from rich.cells import cell_len, set_cell_size

    start = 0
    while left > 0 and start < len(line):
        left -= cell_len(line[start])
        start += 1
    rest = line[start:]
    return set_cell_size(rest, columns) if cell_len(rest) > columns else rest
