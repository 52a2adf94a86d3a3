"""`lifecycle resume`: verify a paused system again, and activate it."""

from __future__ import annotations

import click

from lifecycle.cli.target import give_order, order_timeout, target_arguments


@click.command("resume")
@target_arguments
@order_timeout
def command(target: str, assignments: tuple[str, ...], machine: str, timeout: float) -> int:
    """Verify a paused system again, and activate it only if the gate opens.

    TARGET is a manifest, or the name of a running system as `lifecycle status` shows it. Exits
    with 4 if the gate stays closed: then the system stays paused, and can be asked again; with 2 if
    the manifest is not the one that runs.
    """
    return give_order("resume", target, assignments, machine, timeout)
