"""`lifecycle history`: what happened in a run, from its journal.

Owns: which run is meant, and its timeline as text or JSON.
"""

from __future__ import annotations

import datetime as dt
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from lifecycle.cli.common import format_option
from lifecycle.cli.completion import completing
from lifecycle.cli.standard_streams import echo_while_read
from lifecycle.errors import ExitCode, UsageError
from lifecycle.printable import json_text, lines, one_line

if TYPE_CHECKING:
    from lifecycle.supervisor import RecordedRun
    from lifecycle.verify import Finding, Verdict

F = TypeVar("F", bound=Callable[..., Any])


def _run_argument(function: F) -> F:
    """Add `[RUN]` and `--system` to a verb."""
    return click.argument(
        "run", required=False, metavar="[RUN]", shell_complete=completing("runs")
    )(_system_option(function))


def _system_option(function: F) -> F:
    return click.option(
        "--system",
        default="",
        metavar="NAME",
        help="The latest run of this system.",
    )(function)


def _recorded(run: str | None, system: str) -> RecordedRun:
    """Read the journal that is meant; what of it cannot be read is said on stderr.

    Raises:
        UsageError: there is none.
    """
    from lifecycle.supervisor import journal_files, read_run, ros_log_root, runs_of

    if run is None:
        root = ros_log_root(os.environ)
        there = [each for each in runs_of(root, system) if any(each.glob("journal.jsonl"))]
        if not there:
            of = f" of {system!r}" if system else ""
            raise UsageError(
                f"cannot find a run{of} with a journal in {str(root)!r}",
                hint="journals are beside the logs of a run, where ROS_LOG_DIR says",
            )
        path = there[0]
    else:
        path = Path(run)
        if not os.path.exists(path) and os.path.exists(ros_log_root(os.environ) / run):
            path = ros_log_root(os.environ) / run
    recorded = read_run(journal_files(path))
    for place, why in recorded.unreadable:
        click.echo(lines(f"passed over {place}: {why}"), err=True)
    if recorded.run is None:
        raise UsageError(f"cannot read {str(path)!r} as a journal: no line says of which run")
    return recorded


_SET_S = 0.5
"""A clock that is ahead by so much more, or less, than at the line before was set meanwhile."""


def _clock(at: float) -> str:
    return dt.datetime.fromtimestamp(at).astimezone().strftime("%H:%M:%S.%f")[:-3]


@click.command("history")
@_run_argument
@click.option("--since", default="", metavar="TIME", help="Only what came then or later.")
@click.option("--until", default="", metavar="TIME", help="Only what came before it was over.")
@click.option("--node", default="", metavar="NODE", help="Only what names this node or process.")
@format_option("text", "json")
def command(
    *, run: str | None, system: str, since: str, until: str, node: str, format_: str
) -> int:
    """Show what happened in a run, oldest first; of RUN, or of the run that began last.

    RUN is the log directory of a run, or the journal in it. TIME is 12:03:05, +17.5 for seconds
    since the supervisor began, or ISO 8601. Below each verdict are the findings that it has and the
    one before had not (+), and those that are gone (-). JSON has the lines of the journal.
    """
    from lifecycle.supervisor import moment_of

    recorded = _recorded(run, system)
    began = moment_of(since, recorded, first=True) if since else float("-inf")
    ended = moment_of(until, recorded) if until else float("inf")
    for each in _timeline(recorded, began, ended, node, json=format_ == "json"):
        echo_while_read(each)
    return ExitCode.OK


def _timeline(
    recorded: RecordedRun, began: float, ended: float, node: str, *, json: bool
) -> Iterator[str]:
    from lifecycle.cli.up_output import describe
    from lifecycle.supervisor import NodeChanged, Stopped, VerdictChanged

    over, said = False, dict[str, str]()
    found: tuple[Finding, ...] = ()
    ahead_s: float | None = None
    for each in recorded.moments:
        over = isinstance(each.event, Stopped) or (over and each.line.run is None)
        text = each.text if json else (each.event and describe(each.event))
        # The host's clock is ahead of the one that only goes forward: by as much, until it is set.
        before_s, ahead_s = ahead_s, each.line.at - each.line.elapsed_s
        set_s = 0.0 if before_s is None or json else ahead_s - before_s
        changed: list[str] = []
        if isinstance(each.event, VerdictChanged):
            changed = [] if json else list(_changes(found, each.event.verdict))
            found = each.event.verdict.findings
        if not began <= each.line.elapsed_s <= ended:
            continue
        if abs(set_s) >= _SET_S:
            way = "forward" if set_s > 0 else "back"
            yield (
                f"{_clock(each.line.at)} {each.line.elapsed_s:+10.3f}  the clock of this host was "
                f"set {way} by {abs(set_s):.1f} s"
            )
        if not text:
            continue
        if node and not _names(text, node):
            continue
        if isinstance(each.event, NodeChanged) and not json:
            # Its state changes more often than how far it is, of which the line is.
            if said.get(each.event.node) == text:
                continue
            said[each.event.node] = text
        yield (
            json_text(text)
            if json
            else f"{_clock(each.line.at)} {each.line.elapsed_s:+10.3f}  {text}"
        )
        yield from changed
    if not over and not json and recorded.moments and recorded.moments[-1].line.elapsed_s <= ended:
        pid = recorded.run.supervisor if recorded.run else 0
        if not Path(f"/proc/{pid}").exists():
            yield f"the journal ends here: supervisor {pid} ended without saying so"


def _changes(before: tuple[Finding, ...], verdict: Verdict) -> Iterator[str]:
    """Say which findings came and which are gone."""
    known = {(each.rule, each.subject, each.outcome) for each in before}
    now = {(each.rule, each.subject, each.outcome) for each in verdict.findings}
    for each in verdict.findings:
        if (each.rule, each.subject, each.outcome) not in known:
            yield one_line(f"    + {each.outcome.value} {each.rule}: {each.message}")
    for rule, subject, outcome in sorted(known - now):
        yield one_line(f"    - {outcome.value} {rule}: {subject}")


def _names(text: str, node: str) -> bool:
    name = node.strip("/")
    start = 0
    while (found := text.find(name, start)) >= 0:
        end = found + len(name)
        start = found + 1
        before = text[found - 1 : found]
        if not _is_of_name(text[end : end + 1]) and not _is_of_name(before):
            return True
    return False


def _is_of_name(character: str) -> bool:
    return character.isalnum() or character == "_"
