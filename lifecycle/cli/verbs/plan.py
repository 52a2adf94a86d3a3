"""`lifecycle plan`: what a manifest becomes."""

from __future__ import annotations

import shutil

import click

from lifecycle.cli import common
from lifecycle.errors import ExitCode
from lifecycle.plan.model import Plan
from lifecycle.plan.processes import without_secrets
from lifecycle.plan.render import render_text


@click.command("plan")
@common.manifest_arguments
@common.format_option("text", "json", "mermaid", "svg", "html")
@common.run_commands_option
def command(
    *, manifest: str, assignments: tuple[str, ...], format_: str, run_commands: bool
) -> int:
    """Show what a manifest becomes: processes, order, nodes, participants, flows, ports.

    Starts nothing and needs no ROS. The other formats draw it, as `lifecycle graph` draws what runs
    beside it: mermaid for Markdown, svg and html for a browser.
    """
    plan = common.load_plan(manifest, assignments, run_commands=run_commands)
    click.echo(render(plan, format_).rstrip("\n"))
    return ExitCode.OK


def render(plan: Plan, format_: str) -> str:
    """Return the plan in one of the formats of `--format`."""
    if format_ == "text":
        return render_text(plan, width=shutil.get_terminal_size((100, 24)).columns)
    if format_ == "json":
        return common.json_of(without_secrets(plan))
    from lifecycle.export.picture import build_picture
    from lifecycle.export.picture_writers import WRITERS

    return WRITERS[format_](build_picture(plan))
