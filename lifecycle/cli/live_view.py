"""The live view of `lifecycle up` on a terminal: the lines of `lifecycle status`, redrawn in place.

Log lines and notices scroll above them.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable

from msgspec.structs import replace
from rich.console import Console
from rich.live import Live as RichLive
from rich.text import Text

from lifecycle.cli.standard_streams import Writer
from lifecycle.cli.up_output import Rollback, RunOutput, describe
from lifecycle.cli.verbs.control import status_text
from lifecycle.supervisor.control.protocol import SystemStatus
from lifecycle.supervisor.run.events import (
    Event,
    Failure,
    LogLine,
    NodeChanged,
    ProcessChanged,
    Stopped,
    Stopping,
    SystemReached,
    VerdictChanged,
)
from lifecycle.supervisor.run.options import UpResult
from lifecycle.verify.outcome import Outcome
from lifecycle.verify.report import render_text

_REDRAW_S = 0.04
"""At most 25 times a second, however many events there are."""

_AGAIN_S = 1.0
"""And once a second without any: what is measured changes, and no event says so."""

_OUTCOMES = {Outcome.OK: "green", Outcome.VIOLATED: "red", Outcome.UNVERIFIABLE: "yellow"}


class Live(RunOutput):
    """A listener that draws; use it in a `with`.

    Nothing is drawn while the terminal is stopped (Ctrl-S): log lines are counted then.

    Args:
        console: None for one on `writer`.
        writer: of the terminal; None where nothing stops.
    """

    def __init__(self, console: Console | None = None, *, writer: Writer | None = None) -> None:
        self._writer = writer
        file = None if writer is None else writer.stream()
        self._console = console or Console(file=file, highlight=False)
        self._missed = 0
        self._live = RichLive(console=self._console, auto_refresh=False, transient=False)
        self._status: Callable[[], SystemStatus] | None = None
        self._drawn_s = 0.0
        self._rollback = Rollback()

    def __enter__(self) -> Live:  # noqa: PYI034 - typing.Self is not in Python 3.10
        self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._live.stop()

    def watch(self, status: Callable[[], SystemStatus]) -> None:
        """Take the way to ask for what is shown."""
        self._status = status
        if self._writer is None:
            self._draw()
        else:
            self._draw_again(asyncio.get_running_loop())

    def __call__(self, event: Event) -> None:
        """Show one event."""
        hidden = self._rollback.hides(event)
        # The status says what nodes, processes and verdicts are.
        drawn = isinstance(event, NodeChanged | ProcessChanged | VerdictChanged)
        if isinstance(event, LogLine) and self._is_behind:
            self._missed += 1
        elif not drawn and not hidden and (line := describe(event)):
            styles = {Failure: "red", LogLine: ""}
            self._console.print(Text(line, style=styles.get(type(event), "dim")))
        now_s = time.monotonic()
        urgent = isinstance(event, SystemReached | Stopping | Stopped | Failure)
        if urgent or now_s - self._drawn_s >= _REDRAW_S:
            self._drawn_s = now_s
            self._draw()

    def finish(self, result: UpResult) -> None:
        """Show the verdict below the last status, which may have been of another one."""
        verdict = result.verdict.verdict
        if (seen := self._status) is not None:
            self._status = lambda: replace(seen(), verdict=verdict, not_ok="")
        self._draw()
        self._live.stop()
        flows = verdict is not Outcome.VIOLATED
        text = render_text(result.verdict, flows=flows, width=self._console.width)
        head, _, rest = text.partition("\n")
        self._console.print(Text(head, style=f"bold {_OUTCOMES[verdict]}"))
        if rest.strip():
            self._console.print(Text(rest.rstrip("\n")))
        if self._writer is not None:
            self._writer.close()

    @property
    def _is_behind(self) -> bool:
        return self._writer is not None and self._writer.is_behind

    def _draw_again(self, loop: asyncio.AbstractEventLoop) -> None:
        self._draw()
        loop.call_later(_AGAIN_S, self._draw_again, loop)

    def _draw(self) -> None:
        if self._is_behind:
            return
        missed, self._missed = self._missed, 0
        if missed:
            text = f"{missed} log lines are missing here: the terminal was stopped"
            self._console.print(Text(text, style="dim"))
        if self._status is not None:
            width, height = self._console.size
            # One row is the cursor's.
            text = status_text(self._status(), width=width, height=height - 1, colour=True)
            shown = Text.from_ansi(text, no_wrap=True, overflow="ellipsis")
            self._live.update(shown, refresh=True)
