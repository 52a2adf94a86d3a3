"""A text that changes, for `--watch`: on the whole terminal, else one text after the other."""

from __future__ import annotations

import signal
import sys
from types import FrameType, TracebackType
from typing import NoReturn

from lifecycle.cli.standard_streams import echo_while_read
from lifecycle.errors import ExitCode

_SIGNALS = {signal.SIGTERM: ExitCode.TERMINATED, signal.SIGHUP: ExitCode.HUNG_UP}


class Watched:
    """Shows one text after another; use it in a `with`, in the main thread. Ctrl-C ends it.

    What does not fit on the terminal is cut off. The last text stays on the ordinary screen.

    Args:
        whole: False where each text belongs behind the other on a terminal, too, as JSON does.
    """

    def __init__(self, *, whole: bool = True) -> None:
        self._live = None
        self._last = ""
        if whole and sys.stdout is not None and sys.stdout.isatty():
            from rich.live import Live  # nothing else of a verb needs rich

            self._live = Live(screen=True, auto_refresh=False, vertical_overflow="crop")

    def show(self, text: str) -> None:
        """Show a text in the place of the last one, unless it is the same."""
        if text.rstrip("\n") == self._last:
            return
        self._last = text.rstrip("\n")
        if self._live is None:
            echo_while_read(self._last)
        else:
            from rich.text import Text

            shown = Text.from_ansi(self._last, no_wrap=True, overflow="crop")
            self._live.update(shown, refresh=True)

    def __enter__(self) -> Watched:  # noqa: PYI034 - typing.Self is not in Python 3.10
        if self._live is not None:
            for number in _SIGNALS:
                signal.signal(number, _end)
            self._live.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._live is not None:
            self._live.stop()
            echo_while_read(self._last)


def _end(number: int, _: FrameType | None) -> NoReturn:
    """Leave the terminal as it was, and end as the signal says."""
    raise SystemExit(int(_SIGNALS[signal.Signals(number)]))
