"""A text that changes, for `--watch`: on the whole terminal, else one text after the other."""

from __future__ import annotations

import shutil
import signal
import sys
from types import FrameType, TracebackType
from typing import NoReturn

from lifecycle.cli.standard_streams import echo_while_read
from lifecycle.errors import ExitCode

_SIGNALS = {signal.SIGTERM: ExitCode.TERMINATED, signal.SIGHUP: ExitCode.HUNG_UP}

# XTerm Control Sequences: the alternate screen, the cursor, and lines that end at the edge.
_BEGIN, _END = "\x1b[?1049h\x1b[?25l\x1b[?7l", "\x1b[?7h\x1b[?25h\x1b[?1049l"
_HOME, _ERASE_LINE, _ERASE_BELOW = "\x1b[H", "\x1b[K", "\x1b[J"


class Watched:
    """Shows one text after another; use it in a `with`, in the main thread. Ctrl-C ends it.

    What does not fit on the terminal is cut off. The last text stays on the ordinary screen.

    Args:
        whole: False where each text belongs behind the other on a terminal, too, as JSON does.
    """

    def __init__(self, *, whole: bool = True) -> None:
        self._whole = whole and sys.stdout is not None and sys.stdout.isatty()
        self._last = ""

    def show(self, text: str) -> None:
        """Show a text in the place of the last one, unless it is the same."""
        if text.rstrip("\n") == self._last:
            return
        self._last = text.rstrip("\n")
        if not self._whole:
            echo_while_read(self._last)
            return
        rows = [f"{_ERASE_LINE}{row}" for row in self._last.split("\n")]
        height = shutil.get_terminal_size().lines
        if len(rows) < height:
            rows.append(_ERASE_BELOW)
        self._write(_HOME + "\n".join(rows[:height]))

    def __enter__(self) -> Watched:  # noqa: PYI034 - typing.Self is not in Python 3.10
        if self._whole:
            for number in _SIGNALS:
                signal.signal(number, _end)
            self._write(_BEGIN)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._whole:
            self._write(_END)
            echo_while_read(self._last)

    def _write(self, text: str) -> None:
        sys.stdout.write(text)
        sys.stdout.flush()


def _end(number: int, _: FrameType | None) -> NoReturn:
    """Leave the terminal as it was, and end as the signal says."""
    raise SystemExit(int(_SIGNALS[signal.Signals(number)]))
