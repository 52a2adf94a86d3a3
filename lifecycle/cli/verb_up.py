"""`lifecycle up`: start, configure, connect, verify, and only then activate."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from lifecycle.cli.common import format_option, load_manifest, manifest_arguments, timeout_option
from lifecycle.cli.flows_program import chosen, program_options, treatment_of, treatment_options
from lifecycle.errors import UsageError

if TYPE_CHECKING:
    from lifecycle.supervisor.options import UpResult
    from lifecycle.supervisor.programming import TargetOptions, Treatment


@click.command("up")
@manifest_arguments
@format_option("text", "json")
@click.option(
    "--until",
    type=click.Choice(["connected", "verified", "active"]),
    default="active",
    show_default=True,
    help="Bring it so far, report, and shut down (an active system is held until told to end).",
)
@click.option(
    "--stop-after",
    type=click.FloatRange(min=0),
    metavar="SECONDS",
    help="Hold it so long, then shut down; exits 4 if it was found violated meanwhile.",
)
@timeout_option(30.0, "For everything from the first start to the system being active.")
@click.option(
    "--report",
    type=click.Path(dir_okay=False, path_type=Path),
    help="Write the last verdict: JSON, or by suffix JUnit (.xml) or SARIF (.sarif).",
)
@click.option("--strict", is_flag=True, help="What cannot be verified keeps the gate closed.")
@click.option(
    "--machine",
    default="",
    metavar="NAME",
    help="Run only this machine's nodes; default: all whose address is this host's.",
)
@click.option(
    "--keep-going",
    is_flag=True,
    help="Report a process that dies, but do not take the others down.",
)
@program_options
@treatment_options
def command(
    *,
    manifest: str,
    assignments: tuple[str, ...],
    format_: str,
    until: str,
    stop_after: float | None,
    timeout: float,
    report: Path | None,
    strict: bool,
    machine: str,
    keep_going: bool,
    targets: tuple[str, ...],
    mapping: str,
    flow_labels: bool,
    **rest: Any,
) -> int:
    """Bring a system up: start, configure, connect, verify, and only then activate.

    Ctrl-C ends it in reverse order (exit 130), as `lifecycle down` does (exit 0); a second Ctrl-C
    kills. If a process dies, the others are taken down and the exit code is 6.

    --program tells networks which flows were verified before anything is activated, and takes it
    back in the end.
    """
    from lifecycle.supervisor.ending import Ended, Ending

    result: UpResult | None = None
    try:
        with Ending() as ending:
            from lifecycle.supervisor.run import Forerunner

            # Its imports and ours, and reading the manifest, take as long as each other: side by
            # side.
            forerunner = Forerunner()
            try:
                from lifecycle.cli.report import write_report
                from lifecycle.cli.up_output import output
                from lifecycle.plan import build_plan
                from lifecycle.supervisor import Until, UpOptions, ended_early, up

                plan = build_plan(load_manifest(manifest, assignments).manifest)
                options = UpOptions(
                    until=Until(until),
                    stop_after_s=stop_after,
                    timeout_s=timeout,
                    strict=strict,
                    machine=machine,
                    keep_going=keep_going,
                    program=_networks(targets, **rest),
                    treatment=_treatment(targets, mapping=mapping, flow_labels=flow_labels),
                )
                with output(format_) as listener:
                    try:
                        result = up(
                            plan,
                            options,
                            [listener],
                            forerunner=forerunner,
                            ending=ending,
                            on_start=listener.watch,
                        )
                    except Ended as ended:
                        result = ended_early(ended.reason, ended.exit_code)
                    listener.finish(result)
                if report is not None:
                    write_report(report, result.verdict, plan)
            finally:
                forerunner.close()
    except Ended as ended:
        if result is None:
            click.echo(f"ended before anything was started: {ended.reason}", err=True)
        return ended.exit_code
    return result.exit_code


def _networks(targets: tuple[str, ...], **given: Any) -> tuple[TargetOptions, ...]:
    """What programs networks takes long to import, so only where it is asked for."""
    if not targets and not any(value for name, value in given.items() if name != "match"):
        return ()
    return chosen(targets, option="--program", **given)


def _treatment(targets: tuple[str, ...], *, mapping: str, flow_labels: bool) -> Treatment | None:
    if targets:
        return treatment_of(mapping=mapping, flow_labels=flow_labels)
    if mapping or flow_labels:
        raise UsageError("cannot use --dscp-from-5qi or --flow-labels without --program")
    return None
