"""Output of `lifecycle up`: JSON lines, plain lines, and on a terminal a line below them."""

from __future__ import annotations

import asyncio
import contextlib
import json
import shutil
import sys
from collections.abc import Callable, Iterator

from lifecycle.cli.common import say
from lifecycle.cli.standard_streams import Writer
from lifecycle.cli.verbs.control import status_head
from lifecycle.node.host.control import Operation
from lifecycle.printable import count, json_text, log_line, one_line, sentence
from lifecycle.supervisor.control.protocol import ProcessState, Reach, SystemStatus
from lifecycle.supervisor.run import events
from lifecycle.supervisor.run.options import UpResult
from lifecycle.verify.judge import missing, not_ok
from lifecycle.verify.outcome import Outcome
from lifecycle.verify.report import render_text, to_json
from lifecycle.verify.verdict import FindingKey, Stage, Verdict

_AGAIN_S = 1.0


@contextlib.contextmanager
def output(format_: str) -> Iterator[RunOutput]:
    """Give the output for `format_`, and for text what suits the terminal.

    A run neither waits for who reads it nor ends with him: what happens is in the control socket,
    the log files, the exit code and the report, too.
    """
    marker: Callable[[str], str] = "{}\n".format
    kind: type[RunOutput] = PlainLines
    if format_ == "json":
        marker, kind = (lambda text: _json_line(events.Notice(message=text))), JsonLines
    elif sys.stdout.isatty():
        marker, kind = "\r\x1b[K{}\n".format, TerminalLines
    writer = Writer(
        sys.stdout.fileno(),
        "standard output",
        marker=marker,
        say=say,
        encoding=sys.stdout.encoding,
    )
    with contextlib.closing(writer):
        yield kind(writer)


def _json_line(event: events.Event) -> str:
    record = json.dumps(events.to_record(event), ensure_ascii=False, separators=(",", ":"))
    return json_text(record) + "\n"


class JsonLines:
    """One JSON object per line; `event` names its kind, and the last one is the verdict."""

    def __init__(self, writer: Writer) -> None:
        self._writer = writer

    def watch(self, _: Callable[[], SystemStatus]) -> None:
        """Have the way to ask for the status; events say enough."""

    def __call__(self, event: events.Event) -> None:
        """Write one event."""
        self._writer.put(_json_line(event), kept=not isinstance(event, events.LogLine))

    def finish(self, result: UpResult) -> None:
        """Write the verdict."""
        self._writer.put(to_json(result.verdict) + "\n")
        self._writer.close()


class Narrator:
    """Gives the line of each event of one run, and none where it repeats the one before.

    States that a node passes through because we ask it to have no lines: how far it is says enough.
    Nor has what processes write that are ended because of another's failure, whose cause it would
    bury: all of it is in their log files.
    """

    def __init__(self) -> None:
        self._reached: dict[str, Reach] = {}
        self._asked: set[str] = set()
        self._failed: set[str] = set()
        self._ended: set[str] = set()

    def line(self, event: events.Event) -> str | None:
        """Return the line about the next event; None if it has none."""
        if isinstance(event, events.Failure) and event.ends_run:
            self._failed.add(event.process)
        elif isinstance(event, events.ProcessChanged) and event.state is ProcessState.STOPPING:
            self._ended.add(event.process)
        elif isinstance(event, events.LogLine) and self._failed:
            buries = event.process in self._ended - self._failed
            return None if buries else describe(event)
        if isinstance(event, events.RequestSent):
            self._asked.add(event.node)
        if isinstance(event, events.NodeChanged):
            before = self._reached.get(event.node)
            self._reached[event.node] = event.reach
            if before is not event.reach:
                self._asked.discard(event.node)
            elif event.node in self._asked or not _is_lost(event):
                return None
        return describe(event)


_LOST = ("unconfigured", "inactive", "finalized", "errorprocessing")
"""States (lifecycle_msgs/State) to which somebody else has brought a node that is to be active."""


class PlainLines:
    """One line per event, for logs and pipes."""

    def __init__(self, writer: Writer, *, colour: bool = False, width: int = 100) -> None:
        self._writer = writer
        self._colour = colour
        self._width = width
        self._narrator = Narrator()
        self._judged: str | None = None
        self._waited: set[FindingKey] = set()
        self._active = False

    def watch(self, status: Callable[[], SystemStatus]) -> None:
        """Take the way to ask for the status, once there is something to show; lines need none."""

    def __call__(self, event: events.Event) -> None:
        """Write one event, if it has a line for people."""
        line = self._narrator.line(event)
        if isinstance(event, events.SystemReached):
            self._active = event.reached == "active"
        if isinstance(event, events.VerdictChanged):
            if event.stage is Stage.ACTIVE and not self._active and missing(event.verdict):
                # Not a system that broke: nodes become active one by one, and host by host.
                line = one_line(f"not active yet; {missing(event.verdict)}")
            # A verdict changes with every count in it; people see only what reads differently.
            if line == self._judged:
                return
            self._judged = line
            waited, self._waited = self._waited, {each.key for each in event.verdict.findings}
            if event.stage is Stage.CONNECTED and self._waited < waited and missing(event.verdict):
                return  # it gets on: less of what was said is missing
        if line is not None:
            self._put(line + "\n", kept=not isinstance(event, events.LogLine))

    def finish(self, result: UpResult) -> None:
        """Write the verdict, in full where it is not ok."""
        flows = result.verdict.verdict is not Outcome.VIOLATED
        text = render_text(result.verdict, flows=flows, colour=self._colour, width=self._width)
        self._put(text)
        self._writer.close()

    def _put(self, text: str, *, kept: bool = True) -> None:
        self._writer.put(text, kept=kept)


class TerminalLines(PlainLines):
    """Lines that scroll above one that says what is going on, redrawn in place."""

    def __init__(self, writer: Writer) -> None:
        super().__init__(writer, colour=True, width=shutil.get_terminal_size().columns)
        self._status: Callable[[], SystemStatus] | None = None
        self._below = ""

    def watch(self, status: Callable[[], SystemStatus]) -> None:
        """Take the way to ask for what is going on; it is shown each second, as time passes."""
        self._status = status
        loop = asyncio.get_running_loop()

        def again() -> None:
            self._look()
            if not self._writer.is_behind:
                self._put("", kept=False)
            loop.call_later(_AGAIN_S, again)

        again()

    def __call__(self, event: events.Event) -> None:
        """Write one event, and what is going on since."""
        if isinstance(event, events.SystemReached | events.VerdictChanged | events.Stopping):
            self._look()
        super().__call__(event)

    def finish(self, result: UpResult) -> None:
        """Write the verdict in the place of what was going on."""
        self._below = ""
        super().finish(result)

    def _look(self) -> None:
        if self._status is not None:
            self._width = shutil.get_terminal_size().columns
            self._below = status_head(self._status())[: self._width - 1]

    def _put(self, text: str, *, kept: bool = True) -> None:
        # The cursor stays in front of the line, for what others write.
        self._writer.put(f"\r\x1b[K{text}{self._below}\r", kept=kept)


RunOutput = JsonLines | PlainLines
"""What shows a run: a listener that also shows how it ended, by `finish`."""


def describe(event: events.Event) -> str | None:
    """Return the line about `event` for people, printable; None if it has none."""
    if isinstance(event, events.LogLine):
        return log_line(f"[{event.process}] {event.line}")
    text = _sentence(event)
    return None if text is None else sentence(text)


def _sentence(event: events.Event) -> str | None:  # noqa: PLR0911, PLR0912 - one case for each kind
    match event:
        case events.RunStarted():
            return (
                f"{event.system}: {count(len(event.nodes), 'node')} in "
                f"{count(len(event.processes), 'process')}, domain {event.domain_id}, {event.rmw}, "
                f"discovery range {event.discovery_range}; logs in {event.log_directory}"
            )
        case events.ProcessChanged():
            pid = f" (pid {event.pid})" if event.pid else ""
            detail = f", {event.detail}" if event.detail else ""
            return f"process {event.process}: {event.state.value}{pid}{detail}"
        case events.NodeChanged():
            but = f", but {event.state}" if _is_lost(event) else ""
            return f"{event.node}: {event.reach.value}{but}"
        case events.WiringChanged():
            return _wiring_changed(event)
        case events.WiringLost():
            what = f"{event.endpoint} on " if event.endpoint else ""
            return f"{event.node}: lost {what}{event.connection or 'its own participant'}"
        case events.NodeSilent():
            return f"{event.node}: silent; {event.message}"
        case events.NodeAlive(there=True):
            return f"{event.node}: alive again after {event.silent_s:.1f} s"
        case events.NodeAlive():
            after = f"not silent any more after {event.silent_s:.1f} s"
            return f"{event.node}: {after}, but not there yet"
        case events.MachineConnection(established=True):
            again = f" again after {event.lost_s:.1f} s" if event.lost_s else ""
            return f"machine {event.machine}: connected{again}"
        case events.MachineConnection():
            what = "was shut down by its supervisor" if event.left else "connection lost"
            return f"machine {event.machine}: {what}"
        case events.VerdictChanged():
            waits = missing(event.verdict)
            if waits and event.stage is Stage.CONNECTED:
                return f"not verified yet; {waits}"
            return f"{event.stage.value}: {verdict_line(event.verdict)}"
        case events.GateOpened():
            trusted = f"; taken on trust: {event.trusted}" if event.trusted else ""
            activating = f"activating {count(len(event.nodes), 'node')}"
            return f"gate open on verdict {event.outcome}: {activating}{trusted}"
        case events.SystemReached():
            return f"system {event.reached} after {event.elapsed_s:.2f} s"
        case events.Failure():
            # What ends the run comes first in the last verdict; once is enough.
            named = f"failed: {event.subject} ({event.rule})"
            return named if event.ends_run else f"{named}: {event.message}"
        case events.RestartScheduled():
            last = f"; its last line: {event.stderr}" if event.stderr else ""
            others = len(event.nodes) - 1
            with_it = f" with {count(others, 'other node')}" if others else ""
            return f"{event.process} is started again in {event.in_s:.1f} s{with_it}{last}"
        case events.Restarted():
            return (
                f"{event.process} is back {event.took_s:.2f} s after its failure; "
                f"restarted {count(event.restarts, 'time')}"
            )
        case events.GaveUp():
            return f"gave up {event.process} after {count(event.restarts + 1, 'failure')}"
        case events.ConsequenceTaken():
            whom = f" {', '.join(event.nodes)}" if event.nodes else ""
            return f"on_violation: {event.action}{whom} for {event.rule} of {event.subject}"
        case events.ModeEntered():
            without = f", without {', '.join(event.inactive)}" if event.inactive else ""
            given = ", ".join(event.parameters)
            return f"mode {event.mode}{without}{f', other parameters of {given}' if given else ''}"
        case events.ManifestApplied():
            return _manifest_applied(event)
        case events.Notice():
            return event.message
        case events.Stopping():
            return f"stopping: {event.reason}"
        case events.Stopped():
            return f"stopped after {event.elapsed_s:.2f} s"
    return None


def _is_lost(event: events.NodeChanged) -> bool:
    return event.reach is Reach.ACTIVE and event.state in _LOST


def _wiring_changed(event: events.WiringChanged) -> str:
    again = f" (try {event.attempt})" if event.attempt > 1 else ""
    if event.error:
        return event.error + again
    where = f"connection {event.connection}" if event.connection else "its own participant"
    if event.operation is Operation.CONNECT_TO:
        return f"{event.node}: connected to {event.connection}, {', '.join(event.urls)}{again}"
    if event.operation is Operation.MAP_TO:
        return f"{event.node}: {event.endpoint} mapped onto {where}{again}"
    return f"{event.node}: disconnected from {event.connection}"


def _manifest_applied(event: events.ManifestApplied) -> str:
    what = {
        "added": event.added,
        "removed": event.removed,
        "restarted": event.restarted,
        "parameters of": event.parameters,
    }
    nodes = "".join(f"; {word} {', '.join(names)}" for word, names in what.items() if names)
    said = {
        "begun": f"applying {event.manifest}{nodes}",
        "applied": f"{event.manifest} is in force, revision {event.revision}{nodes}",
        "rolling_back": f"going back to the manifest before: {event.reason}",
        "rolled_back": f"the manifest before is in force again, revision {event.revision}",
    }
    return said[event.stage]


def verdict_line(verdict: Verdict) -> str:
    """Return a verdict in one printable line, with what keeps it from being ok."""
    text = f"verdict {verdict.verdict.value}"
    why = not_ok(verdict)
    if why:
        return one_line(f"{text}; {why}")
    if verdict.flows:
        text += f", {count(len(verdict.flows), 'flow')}"
    if verdict.tolerated:
        text += f"; tolerated: {', '.join(each.name for each in verdict.tolerated)}"
    return one_line(text)
