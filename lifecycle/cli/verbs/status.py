"""`lifecycle status`: show what a running supervisor sees.

Owns: the verb, and the columns of a status as plain text.
"""

from __future__ import annotations

import os

import click

from lifecycle.cli.common import format_option
from lifecycle.errors import ExitCode, UsageError
from lifecycle.printable import json_text, one_line
from lifecycle.supervisor import NodeStatus, SystemStatus
from lifecycle.verify import ConnectionReport

_HEADS = ("node", "process", "pid", "state", "matched", "unique flows", "")


def status_text(status: SystemStatus) -> str:
    """Return a status as lines: one for the system, one for each node and each connection."""
    verdict = "not judged yet" if status.verdict is None else status.verdict.value
    verdict += f" ({status.not_ok})" if status.not_ok else ""
    rows = [_HEADS, *(tuple(map(one_line, _row(node))) for node in status.nodes)]
    widths = [max(len(row[index]) for row in rows) for index in range(len(_HEADS))]
    living = sum(not node.died for node in status.nodes)
    count = "" if living == len(status.nodes) else f" {living}/{len(status.nodes)}"
    head = (
        f"{status.system}: {status.phase}{count}, verdict {verdict}, domain {status.domain_id}, "
        f"supervisor {status.supervisor}, up for {status.elapsed_s:.1f} s"
    )
    lines = [one_line(head)]
    for row, node in zip(rows, (None, *status.nodes), strict=True):
        cells = (cell.ljust(width) for cell, width in zip(row, widths, strict=True))
        lines.append("  ".join(cells).rstrip())
        lines += [
            one_line(f"  {connection_text(each)}") for each in (node.connections if node else ())
        ]
    return "\n".join(lines)


def connection_text(connection: ConnectionReport) -> str:
    """Return one connection in one line: what it is, what it is to and what it carries."""
    made = "established" if connection.established else "waits for peers"
    state = f"failed: {connection.error}" if connection.error else made
    carries = ", ".join(connection.mappings) or "nothing"
    return f"connection {connection.name} {state}; {', '.join(connection.urls)}; carries {carries}"


def _row(node: NodeStatus) -> tuple[str, ...]:
    process = "not ours" if node.process_state is None else node.process_state.value
    return (
        node.node,
        process,
        str(node.pid or "–"),
        "dead" if node.died else (node.state if node.managed else node.reach.value) or "–",
        f"{node.matched}/{node.endpoints}",
        f"{node.unique_flows}/{node.flows}",
        node.died or (f"silent: {node.silent}" if node.silent else node.doing),
    )


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
    from lifecycle.supervisor import running, status
    from lifecycle.verify import Outcome

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
        click.echo(status_text(seen))
    return ExitCode.VIOLATED if seen.verdict is Outcome.VIOLATED else ExitCode.OK
