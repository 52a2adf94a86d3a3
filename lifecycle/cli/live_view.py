"""The live view of `lifecycle up` on a terminal: a table of nodes, redrawn in place by rich.

Log lines and notices scroll above it; it shows each node's process, state, matched endpoints and
flows, and is drawn again at every event.
"""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import Callable, Sequence

from rich import box
from rich.console import Console, Group, RenderableType
from rich.live import Live as RichLive
from rich.table import Table
from rich.text import Text

from lifecycle.cli.common import wrapped
from lifecycle.cli.standard_streams import Writer
from lifecycle.cli.up_output import Rollback, describe, verdict_line
from lifecycle.cli.verbs.control import HEADS, row
from lifecycle.measure.flows import measured_summary
from lifecycle.printable import log_line, one_line
from lifecycle.supervisor.control.protocol import NodeStatus, SystemStatus
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

_AROUND_ROWS = 7
"""Of the table: the system, the columns' names and the lines around them, the verdict, and one row
for the cursor."""

_PHASES = ("connecting", "verifying", "activating", "measuring", "active")
_OUTCOMES = {Outcome.OK: "green", Outcome.VIOLATED: "red", Outcome.UNVERIFIABLE: "yellow"}
_STATES = {"active": "bold green", "inactive": "cyan", "finalized": "dim", "": "dim"}
_PROCESS = {"running": "green", "starting": "yellow", "stopping": "yellow", "exited": "dim"}
_PROCESS_COLOURS = ("cyan", "magenta", "blue", "green", "yellow", "bright_black")


class Live:
    """A listener that draws; use it in a `with`.

    Nothing is drawn while the terminal is stopped (Ctrl-S): log lines are counted then, and the
    table is drawn as it is once there is room again.

    Args:
        console: None for one on `writer`.
        writer: of the terminal; None where nothing stops.
    """

    def __init__(self, console: Console | None = None, *, writer: Writer | None = None) -> None:
        self._writer = writer
        file = None if writer is None else writer.stream()
        self._console = console or Console(file=file, highlight=False)
        self._missed = 0
        self._skipped = False
        self._live = RichLive(console=self._console, auto_refresh=False, transient=False)
        self._status: Callable[[], SystemStatus] | None = None
        self._verdict = ""
        self._drawn_s = 0.0
        self._processes: list[str] = []
        self._rollback = Rollback()

    def __enter__(self) -> Live:  # noqa: PYI034 - typing.Self is not in Python 3.10
        self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._live.stop()

    def watch(self, status: Callable[[], SystemStatus]) -> None:
        """Take the way to ask for what the table shows."""
        self._status = status
        if self._writer is not None:
            loop = asyncio.get_running_loop()
            self._writer.on_room = lambda: _soon(loop, self._catch_up)
            loop.call_later(_AGAIN_S, self._draw_again, loop)
        self._draw()

    def __call__(self, event: Event) -> None:
        """Show one event."""
        hidden = self._rollback.hides(event)
        if isinstance(event, VerdictChanged):
            self._verdict = verdict_line(event.verdict)
        elif isinstance(event, LogLine):
            if self._is_behind:
                self._missed += 1
            elif not hidden:
                self._console.print(self._log_line(event))
        elif not isinstance(event, NodeChanged | ProcessChanged) and (line := describe(event)):
            style = "red" if isinstance(event, Failure) else "dim"
            self._console.print(Text(line, style=style))
        now_s = time.monotonic()
        urgent = isinstance(event, SystemReached | Stopping | Stopped | Failure)
        if urgent or now_s - self._drawn_s >= _REDRAW_S:
            self._drawn_s = now_s
            self._draw()

    def finish(self, result: UpResult) -> None:
        """Show the verdict below the last table."""
        self._verdict = ""  # the last of the table may be another than the one that holds
        self._draw()
        self._live.stop()
        flows = result.verdict.verdict is not Outcome.VIOLATED
        text = render_text(result.verdict, flows=flows, width=self._console.width)
        style = _OUTCOMES[result.verdict.verdict]
        head, _, rest = text.partition("\n")
        self._console.print(Text(head, style=f"bold {style}"))
        if rest.strip():
            self._console.print(Text(rest.rstrip("\n")))
        if self._writer is not None:
            self._writer.close()

    @property
    def _is_behind(self) -> bool:
        return self._writer is not None and self._writer.is_behind

    def _catch_up(self) -> None:
        """Draw what was not drawn while the terminal was behind."""
        if self._skipped or self._missed:
            self._draw()

    def _draw_again(self, loop: asyncio.AbstractEventLoop) -> None:
        self._draw()
        loop.call_later(_AGAIN_S, self._draw_again, loop)

    def _draw(self) -> None:
        self._skipped = self._is_behind
        if self._skipped:
            return
        missed, self._missed = self._missed, 0
        if missed:
            text = f"{missed} log lines are missing here: the terminal was stopped"
            self._console.print(Text(text, style="dim"))
        if self._status is not None:
            self._live.update(self._picture(self._status()), refresh=True)

    def _picture(self, status: SystemStatus) -> RenderableType:
        table = Table(box=box.SIMPLE_HEAD, pad_edge=False, header_style="bold")
        for column in HEADS:
            # Where there is no room the others keep theirs; no row takes two lines.
            table.add_column(column, no_wrap=column not in ("node", ""))
        measured = one_line(measured_summary(status.measured))
        lines = wrapped([measured] if measured else [], self._console.width).splitlines()
        shown = _that_fit(status.nodes, self._console.height - _AROUND_ROWS - len(lines))
        for node in shown:
            table.add_row(*_row(node))
        parts: list[RenderableType] = [_head(status), table]
        if left := len(status.nodes) - len(shown):
            parts.append(Text(f"… {left} more nodes: lifecycle status {status.system} --watch"))
        violated = any(each.violated for each in status.measured)
        parts += [Text(line, style="red" if violated else "dim", no_wrap=True) for line in lines]
        style = "white" if status.verdict is None else _OUTCOMES[status.verdict]
        parts.append(Text(self._verdict, style=style, overflow="ellipsis", no_wrap=True))
        return Group(*parts)

    def _log_line(self, event: LogLine) -> Text:
        if event.process not in self._processes:
            self._processes.append(event.process)
        index = self._processes.index(event.process) % len(_PROCESS_COLOURS)
        return Text.assemble((f"[{event.process}] ", _PROCESS_COLOURS[index]), log_line(event.line))


def _soon(loop: asyncio.AbstractEventLoop, call: Callable[[], None]) -> None:
    with contextlib.suppress(RuntimeError):  # closed: the last is drawn without it
        loop.call_soon_threadsafe(call)


def _that_fit(nodes: Sequence[NodeStatus], rows: int) -> Sequence[NodeStatus]:
    """Return as many nodes as there are rows, those that are not active first, in their order."""
    if len(nodes) <= rows:
        return nodes
    waited_for = [each for each in nodes if each.died or each.findings or each.state != "active"]
    others = [each for each in nodes if each not in waited_for]
    kept = {each.node for each in (*waited_for, *others)[: max(1, rows - 1)]}
    return [each for each in nodes if each.node in kept]


def _head(status: SystemStatus) -> Text:
    """The pipeline, with the phase that the system is in."""
    head = Text.assemble(
        (one_line(status.system), "bold"),
        (f"  domain {status.domain_id}  {status.elapsed_s:.1f} s   ", "dim"),
    )
    reached = status.phase in _PHASES
    for index, phase in enumerate(_PHASES):
        done = reached and index < _PHASES.index(status.phase)
        now = phase == status.phase
        style = "bold green" if now and phase == "active" else "bold yellow" if now else "dim"
        head.append(" ▸ " if index else "", "dim")
        head.append(phase, "green" if done else style)
    if not reached:
        head.append(f"   {one_line(status.phase)}", "bold yellow")
    return head


def _row(node: NodeStatus) -> tuple[RenderableType, ...]:
    """Return the cells of `lifecycle status`, in colours."""
    name, process, pid, state, matched, flows, doing = row(node)
    nested = " · connected" if node.state == "inactive" and node.matched else ""
    complete = "green" if node.matched >= node.endpoints else "yellow"
    styled = (
        (name, "red" if node.findings else "bold"),
        (process, _PROCESS.get(process, "dim")),
        (pid, "dim"),
        (f"{state}{nested}", "red" if node.died else _STATES.get(node.state, "yellow")),
        (matched, complete if node.endpoints else "dim"),
        (flows, "dim"),
        (doing, "red" if node.died else "yellow"),
    )
    return tuple(
        Text(text, style=style, no_wrap=True, overflow="ellipsis") for text, style in styled
    )
