"""`lifecycle verify`: judge a running system, started by anyone; for CI."""

from __future__ import annotations

import sys
from pathlib import Path

import click

from lifecycle.cli.common import format_option, load_manifest, manifest_arguments, timeout_option
from lifecycle.errors import ExitCode


@click.command("verify")
@manifest_arguments
@format_option("text", "json", "junit", "sarif")
@timeout_option(5.0, "How long a graph that is not ok may still become so.")
@click.option("--strict", is_flag=True, help="Exit 5 if anything could not be verified.")
@click.option(
    "--report",
    type=click.Path(dir_okay=False, path_type=Path),
    help="Write the verdict too: JSON, or by suffix JUnit (.xml) or SARIF (.sarif).",
)
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
    from lifecycle.cli.report import format_verdict, write_report
    from lifecycle.plan import build_plan
    from lifecycle.supervisor.attach import judge_running

    plan = build_plan(load_manifest(manifest, assignments).manifest)
    seen = judge_running(plan, timeout_s=timeout, strict=strict)
    if seen.where:
        click.echo(seen.where, err=True)
    colour = format_ == "text" and sys.stdout.isatty()
    click.echo(format_verdict(seen.verdict, plan, format_, colour=colour).rstrip("\n"))
    if report is not None:
        write_report(report, seen.verdict, plan)
    return exit_code(seen.verdict, strict=strict)


def exit_code(verdict: object, *, strict: bool) -> ExitCode:
    """Return the exit code of a verdict."""
    from lifecycle.supervisor.gate import closes
    from lifecycle.verify import Outcome, Verdict

    assert isinstance(verdict, Verdict)
    if not closes(verdict, strict=strict):
        return ExitCode.OK
    violated = verdict.verdict is Outcome.VIOLATED
    return ExitCode.VIOLATED if violated else ExitCode.UNVERIFIABLE
