"""`lifecycle history`: what happened in a run, from its journal."""

from __future__ import annotations

import datetime as dt
import os
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import click

from lifecycle.cli.common import format_option, say
from lifecycle.cli.standard_streams import echo_while_read
from lifecycle.errors import ExitCode, UsageError
from lifecycle.printable import json_text, one_line, sentence

if TYPE_CHECKING:
    from lifecycle.supervisor.run.journal import Moment
    from lifecycle.verify.verdict import Finding


def _recorded(run: str | None, system: str) -> tuple[list[Moment], int]:
    """Read the journal that is meant, and of which supervisor it is.

    What of it cannot be read is said on stderr.

    Raises:
        UsageError: there is none.
    """
    from lifecycle.supervisor.processes.logs import ros_log_root, runs_of
    from lifecycle.supervisor.run.journal import journal_files, read_run

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
    moments = read_run(journal_files(path), lambda text: say(f"passed over {text}"))
    runs = [each.line.run for each in moments if each.line.run is not None]
    if not runs:
        raise UsageError(f"cannot read {str(path)!r} as a journal: no line says of which run")
    return moments, runs[0].supervisor


@click.command("history")
@click.argument("run", required=False, metavar="[RUN]")
@click.option("--system", default="", metavar="NAME", help="The latest run of this system.")
@format_option("text", "json")
def command(*, run: str | None, system: str, format_: str) -> int:
    """Show what happened in a run, oldest first; of RUN, or of the run that began last.

    RUN is the log directory of a run, or the journal in it. Below each verdict are the findings
    that it has and the one before had not (+), and those that are gone (-). JSON has the lines of
    the journal.
    """
    moments, supervisor = _recorded(run, system)
    if format_ == "json":
        for moment in moments:
            echo_while_read(json_text(moment.text))
        return ExitCode.OK
    for each in _timeline(moments, supervisor):
        echo_while_read(each)
    return ExitCode.OK


def _timeline(moments: list[Moment], supervisor: int) -> Iterator[str]:
    from lifecycle.cli.up_output import Narrator
    from lifecycle.supervisor.run.events import Stopped, VerdictChanged

    over, narrator = False, Narrator()
    found: tuple[Finding, ...] = ()
    for each in moments:
        over = isinstance(each.event, Stopped) or (over and each.line.run is None)
        clock = dt.datetime.fromtimestamp(each.line.at).astimezone().strftime("%H:%M:%S.%f")[:-3]
        at = f"{clock} {each.line.elapsed_s:+10.3f}"
        if each.event and (text := narrator.line(each.event)):
            yield f"{at}  {text}"
        if isinstance(each.event, VerdictChanged):
            before, found = found, each.event.verdict.findings
            known = {(one.outcome, one.rule, one.subject) for one in before}
            now = {(one.outcome, one.rule, one.subject) for one in found}
            for one in found:
                if (one.outcome, one.rule, one.subject) not in known:
                    yield sentence(f"    + {one.outcome.value} {one.rule}: {one.message}")
            for outcome, rule, subject in sorted(known - now, key=lambda gone: gone[1:]):
                yield one_line(f"    - {outcome.value} {rule}: {subject}")
    if not over and not Path(f"/proc/{supervisor}").exists():
        yield f"the journal ends here: supervisor {supervisor} ended without saying so"
