"""`lifecycle history`, `explain` and `replay`: what a run's journal tells afterwards.

Owns: which run is meant, and its timeline, explanations and judgements as text or JSON.
"""

from __future__ import annotations

import datetime as dt
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from lifecycle.cli.common import completing, format_option
from lifecycle.cli.standard_streams import echo_while_read
from lifecycle.errors import ExitCode, UsageError
from lifecycle.printable import json_text, lines, one_line

if TYPE_CHECKING:
    from lifecycle.supervisor import Explanation, RecordedRun, Rejudged

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
        shell_complete=completing("logged_systems"),
        help="The latest run of this system.",
    )(function)


def _run_option(function: F) -> F:
    return click.option(
        "--run",
        default=None,
        metavar="RUN",
        shell_complete=completing("runs"),
        help="A run's log directory, or its journal.",
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
        if not path.exists() and (ros_log_root(os.environ) / run).exists():
            path = ros_log_root(os.environ) / run
    recorded = read_run(journal_files(path))
    for place, why in recorded.unreadable:
        click.echo(lines(f"passed over {place}: {why}"), err=True)
    if recorded.run is None:
        raise UsageError(f"cannot read {str(path)!r} as a journal: no line says of which run")
    return recorded


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
    since the supervisor began, or ISO 8601. Text has what happened; JSON has every line of the
    journal, also what was seen, what processes used and how long their logs were.
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
    from lifecycle.supervisor import NodeChanged, Stopped, was_set_s

    over, said = False, dict[str, str]()
    before = None
    for each in recorded.moments:
        over = isinstance(each.event, Stopped) or (over and each.line.run is None)
        text = each.text if json else (each.event and describe(each.event))
        set_s = 0.0 if json or before is None else was_set_s(before, each.line)
        before = each.line
        if not began <= each.line.elapsed_s <= ended:
            continue
        if set_s:
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
    if not over and not json and recorded.moments and recorded.moments[-1].line.elapsed_s <= ended:
        pid = recorded.run.supervisor if recorded.run else 0
        if not Path(f"/proc/{pid}").exists():
            yield f"the journal ends here: supervisor {pid} ended without saying so"


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


@click.command("explain")
@click.argument("finding", required=False, default="", metavar="[FINDING]")
@click.option("--at", default="", metavar="TIME", help="Which moment; default: the last verdict.")
@_run_option
@_system_option
@format_option("text", "json")
def explain_command(*, finding: str, at: str, run: str | None, system: str, format_: str) -> int:
    """Say which fact turned a verdict from ok: what was seen to change, and what happened before.

    FINDING is a rule or a subject, or a part of one; without it all that held at that moment are
    explained. TIME is 12:03:05, +17.5 for seconds since the supervisor began, or ISO 8601.
    """
    from lifecycle.supervisor import explained, moment_of, named_findings

    recorded = _recorded(run, system)
    moment = moment_of(at, recorded) if at else float("inf")
    found = explained(recorded, moment, finding)
    if format_ == "json":
        from lifecycle.codec import to_json

        click.echo(json_text(to_json(found).decode()))
        return ExitCode.OK
    if not found:
        known = named_findings(recorded)
        if finding and not any(finding in each for each in known):
            there = "; ".join(known) or "none"
            raise UsageError(
                f"cannot find {finding!r} among what any verdict of that run found: {there}"
            )
        what = finding or "finding"
        when = f" at {at}" if at else " in the last verdict"
        click.echo(lines(f"no {what}{when}; lifecycle history shows when there was"))
        return ExitCode.OK
    for number, each in enumerate(found):
        click.echo(("\n" if number else "") + "\n".join(_explanation(each)))
    return ExitCode.OK


def _explanation(explanation: Explanation) -> Iterator[str]:
    from lifecycle.cli.up_output import describe

    finding = explanation.finding
    yield one_line(f"{finding.outcome.value}: {finding.rule}: {finding.message}")
    before = "from the first verdict on" if explanation.first else "ok before"
    yield f"  since {_clock(explanation.since)} ({explanation.elapsed_s:+.3f} s), {before}"
    if explanation.facts:
        yield "  what was seen to change then:"
        yield from (f"    {one_line(each)}" for each in explanation.facts)
    elif not explanation.first:
        yield "  nothing that was seen of it changed then"
    if explanation.others:
        yield f"  and {explanation.others} facts about others"
    told = [(at_s, describe(each)) for at_s, each in explanation.events]
    if any(text for _, text in told):
        yield "  what happened then:"
        yield from (f"    {at_s:+.3f} s  {text}" for at_s, text in told if text)


@click.command("replay")
@_run_argument
@format_option("text", "json")
def replay_command(*, run: str | None, system: str, format_: str) -> int:
    """Judge every observation of a run again, with the rules of this version.

    Exits with 4 if one is judged otherwise than when it was recorded: a journal is a regression
    test of verdicts. RUN is the log directory of a run, or the journal in it.
    """
    from lifecycle.supervisor import replayed

    recorded = _recorded(run, system)
    judged, differing = 0, 0
    for each in replayed(recorded):
        judged += 1
        if each is None:
            continue
        differing += 1
        if format_ == "json":
            from lifecycle.codec import to_json

            echo_while_read(json_text(to_json(each).decode()))
        else:
            for line in _rejudged(each):
                echo_while_read(line)
    if not judged:
        raise UsageError("cannot replay a journal without an observation: nothing was judged")
    if format_ == "text":
        as_recorded = "all as recorded" if not differing else f"{differing} otherwise than recorded"
        click.echo(f"{judged} observations judged again: {as_recorded}")
    return ExitCode.VIOLATED if differing else ExitCode.OK


def _rejudged(each: Rejudged) -> Iterator[str]:
    yield f"{_clock(each.at)} {each.elapsed_s:+10.3f}  {each.was.value} → {each.now.value}"
    for sign, findings in (("-", each.lost), ("+", each.new)):
        for one in findings:
            yield f"  {sign} {one.outcome.value}: {one.rule}: {one_line(one.subject)}"
