"""A status as plain text. Owns: its columns."""

from __future__ import annotations

from lifecycle.printable import one_line
from lifecycle.supervisor.control.status import NodeStatus, SystemStatus
from lifecycle.verify.observation import ConnectionReport

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
