"""`lifecycle verify`: judge a running system, started by anyone; for CI."""

from __future__ import annotations

import sys
from pathlib import Path

import click

from lifecycle.cli import common
from lifecycle.cli.report import ReportFile, exit_code, format_verdict, report_option


@click.command("verify")
@common.manifest_arguments
@common.format_option("text", "json", "junit", "sarif", "github")
@common.timeout_option(5.0, "How long a graph that is not ok may still become so.")
@click.option("--strict", is_flag=True, help="Exit 5 if anything could not be verified.")
@report_option
def command(  # noqa: PLR0917 - click passes options by name
    manifest: str,
    assignments: tuple[str, ...],
    format_: str,
    timeout: float,
    strict: bool,
    report: Path | None,
) -> int:
    """Attach to whatever runs and judge it against the manifest, as an active system.

    Exits with 0 if it is what was declared, 4 if it is not, and 5 under --strict, or where the
    manifest says that it blocks, if something could not be verified.
    """
    from lifecycle.supervisor.run.signals import Ended, Ending

    try:
        with (
            Ending() as ending,
            ReportFile(report, strict=strict) as written,
            ending.unmasked(),
        ):
            from lifecycle.supervisor.run.looking import judge_running, with_supervisors_numbers

            plan = common.load_plan(manifest, assignments)
            written.begin(plan)
            seen = judge_running(plan, timeout_s=timeout, strict=strict)
            seen = with_supervisors_numbers(seen)
            with ending.noted():
                unwritten = written.end(seen.verdict)
    except Ended as ended:
        common.say(f"ended before it was judged: {ended.reason}")
        return ended.exit_code
    # From here on a signal ends what waits for a reader.
    for each in seen.notices:
        common.say(each)
    colour = format_ == "text" and sys.stdout.isatty()
    text = format_verdict(seen.verdict, plan, format_, colour=colour, strict=strict)
    click.echo(text.rstrip("\n"))
    return exit_code(seen.verdict, strict=strict) or unwritten
