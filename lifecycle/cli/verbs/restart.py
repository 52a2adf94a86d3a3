"""`lifecycle restart`: take one node or a whole system down, and up again through the gate."""

from __future__ import annotations

import click

from lifecycle.cli.target import give_order, order_timeout
from lifecycle.errors import UsageError


@click.command("restart")
@click.argument("target", metavar="TARGET")
@click.argument("words", nargs=-1, metavar="[NODE] [NAME:=VALUE]...")
@click.option("--machine", default="", metavar="NAME", help="As it was given to `lifecycle up`.")
@click.option(
    "--reload", is_flag=True, help="Take the manifest as it is now, where it has changed."
)
@order_timeout
def command(
    *, target: str, words: tuple[str, ...], machine: str, timeout: float, reload: bool
) -> int:
    """Take a running system down and bring it up again, or only the process of NODE.

    What comes back is verified together with what stayed, and activated only if the gate opens: in
    a paused system it stays inactive. NODE is a key of the manifest or a node's full name; other
    nodes of its process restart with it, all others stay active.

    What is restarted is what was started. A manifest or parameter file that has changed since is
    refused (exit 2), naming what differs; --reload takes it, for NODE only if nothing else differs.
    """
    nodes = [word for word in words if ":=" not in word]
    if len(nodes) > 1:
        raise UsageError(f"cannot restart {', '.join(nodes)} at once; name one node, or none")
    assignments = tuple(word for word in words if ":=" in word)
    return give_order("restart", target, assignments, machine, timeout, *nodes, reload=reload)
