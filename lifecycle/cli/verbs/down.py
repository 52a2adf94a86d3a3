"""`lifecycle down`: end a running system in reverse order."""

from __future__ import annotations

import os

import click

from lifecycle.cli.common import timeout_option
from lifecycle.cli.target import target_arguments, target_run
from lifecycle.errors import ExitCode


@click.command("down")
@target_arguments
@timeout_option(60.0, "How long it may take.")
def command(target: str, assignments: tuple[str, ...], machine: str, timeout: float) -> int:
    """End a running system in reverse order, and wait until nothing of it is left.

    TARGET is a manifest, or the name of a running system as `lifecycle status` shows it. Where the
    supervisor itself was killed, what it left behind is ended too.
    """
    from lifecycle.supervisor import down

    path = target_run(os.environ, target, assignments, machine)
    try:
        return down(path, timeout)
    except TimeoutError:
        click.echo(f"cannot end {path.name!r} within {timeout:g} s; it still runs", err=True)
        return ExitCode.BRING_UP_FAILED
