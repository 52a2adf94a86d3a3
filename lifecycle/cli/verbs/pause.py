"""`lifecycle pause`: deactivate a running system in reverse order."""

from __future__ import annotations

import click

from lifecycle.cli.target import give_order, order_timeout, target_arguments


@click.command("pause")
@target_arguments
@order_timeout
def command(target: str, assignments: tuple[str, ...], machine: str, timeout: float) -> int:
    """Deactivate every managed node of a running system, in reverse order: data stops.

    Processes, connections and flows stay as they are. TARGET is a manifest, or the name of a
    running system as `lifecycle status` shows it. Only an active system can be paused; a manifest
    that has changed since it was started is said, and does not keep it from being paused.
    """
    return give_order("pause", target, assignments, machine, timeout)
