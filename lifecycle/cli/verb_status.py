"""`lifecycle status`: show what a running supervisor sees."""

from __future__ import annotations

import os

import click

from lifecycle.cli.common import format_option
from lifecycle.errors import ExitCode, UsageError
from lifecycle.printable import json_text


@click.command("status")
@click.argument("target", required=False, metavar="[TARGET]")
@click.argument("assignments", nargs=-1, metavar="[NAME:=VALUE]...")
@click.option("--machine", default="", metavar="NAME", help="As it was given to `lifecycle up`.")
@format_option("text", "json")
def command(target: str | None, assignments: tuple[str, ...], machine: str, format_: str) -> int:
    """Show a running system: its nodes, their processes and states, and the last verdict.

    TARGET is a manifest or the name of a system; without one, all that run are listed. Exits with
    4 if the last verdict is violated.
    """
    from lifecycle.cli.target import target_run
    from lifecycle.codec import to_json
    from lifecycle.run_directory import runtime_root
    from lifecycle.supervisor.control.client import running, status
    from lifecycle.verify.verdict import Outcome

    if target is None:
        names = running(runtime_root(os.environ))
        if format_ == "json":
            click.echo(to_json(names).decode())
        else:
            click.echo("\n".join(names) or "no system runs")
        return ExitCode.OK
    path = target_run(os.environ, target, assignments, machine)
    try:
        seen = status(path)
    except TimeoutError as error:
        raise UsageError(f"cannot ask {path.name!r}: its supervisor does not answer") from error
    if format_ == "json":
        click.echo(json_text(to_json(seen).decode()))
    else:
        from lifecycle.cli.status_text import status_text

        click.echo(status_text(seen))
    return ExitCode.VIOLATED if seen.verdict is Outcome.VIOLATED else ExitCode.OK
