"""`lifecycle flows`: show every network flow and how unique it is, and program networks with them.

Owns: the table. Exports are flows_export.py's; apply, diff and remove are flows_program.py's.
"""

from __future__ import annotations

from typing import Any

import click

from lifecycle.cli.common import format_option, load_manifest, manifest_arguments, timeout_option
from lifecycle.cli.flows_export import NAMES, Export
from lifecycle.cli.flows_program import network_options, treatment_options, with_subcommands
from lifecycle.cli.standard_streams import echo_while_read
from lifecycle.errors import UsageError
from lifecycle.printable import lines


@click.command("flows")
@manifest_arguments
@format_option("text", "json", "csv")
@click.option("--watch", is_flag=True, help="Show them again whenever they change; Ctrl-C ends.")
@timeout_option(5.0, "How long flows that are not complete may still become so.")
@click.option(
    "--export",
    type=click.Choice(NAMES),
    help="Print the verified flows as rules, settings or request bodies of another system instead.",
)
@network_options
@treatment_options
def _show(
    *,
    manifest: str,
    assignments: tuple[str, ...],
    format_: str,
    watch: bool,
    timeout: float,
    export: str | None,
    **rest: Any,
) -> int:
    """Show every publisher → subscription pair of a running system.

    One line per network flow: its 5-tuple, on IPv6 its flow label, DSCP and TOS byte, how unique it
    is, what was required and the verdict. Exits as `lifecycle verify` does.
    """
    from lifecycle.cli.flow_table import render_flows
    from lifecycle.cli.verb_verify import exit_code
    from lifecycle.plan import build_plan
    from lifecycle.supervisor.run.attach import follow_running, judge_running
    from lifecycle.verify import Verdict

    exporter = None
    if export is not None:
        if watch:
            raise UsageError("cannot use --export with --watch; export once")
        exporter = Export(export, **rest)
    elif any(value for name, value in rest.items() if name != "match"):
        raise UsageError(
            "cannot say how to treat flows that are only shown",
            hint="give --export, or use lifecycle flows apply",
        )
    plan = build_plan(load_manifest(manifest, assignments).manifest)

    def show(verdict: Verdict) -> None:
        click.echo(render_flows(verdict.flows, format_))

    if watch:
        follow_running(plan, lambda seen: echo_while_read(render_flows(seen.flows, format_)))
    seen = judge_running(plan, timeout_s=timeout, strict=False)
    if seen.where:
        click.echo(lines(seen.where), err=True)
    if exporter is not None:
        exporter.write(seen.plan, seen.verdict.flows)
    else:
        show(seen.verdict)
    return exit_code(seen.verdict, strict=False)


command = with_subcommands(_show)
