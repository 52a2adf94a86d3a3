"""Dependency levels: which nodes wait for which.

Owns: `dependency_levels`, the longest-path layering of the `after:` graph. Pure.
"""

from __future__ import annotations

from collections.abc import Sequence

from lifecycle.manifest.model import Node
from lifecycle.plan.errors import PlanError


def dependency_levels(nodes: Sequence[Node]) -> tuple[tuple[str, ...], ...]:
    """Layer nodes so that each stands one level below the last node it waits for.

    Nodes of one level keep the manifest's order and do not wait for each other.

    Raises:
        PlanError: a node waits for itself along some path, or for a node that does not exist.
    """
    by_key = {node.key: node for node in nodes}
    depth: dict[str, int] = {}
    for node in nodes:
        _settle(node, by_key, depth)
    if not nodes:
        return ()
    levels: list[list[str]] = [[] for _ in range(max(depth.values()) + 1)]
    for node in nodes:
        levels[depth[node.key]].append(node.key)
    return tuple(tuple(level) for level in levels)


def _settle(root: Node, by_key: dict[str, Node], depth: dict[str, int]) -> None:
    """Find the level of `root` and of all it waits for; iterative, so depth has no limit."""
    path: list[str] = [root.key]
    while path:
        node = by_key[path[-1]]
        open_dependency = ""
        for after in node.after:
            if after.node not in by_key:
                raise PlanError(
                    f"cannot wait for node {after.node!r}: the manifest declares no such node",
                    at=after.at,
                )
            if after.node in path:
                cycle = " → ".join([*path[path.index(after.node) :], after.node])
                raise PlanError(
                    f"cannot order the nodes: they wait for each other, {cycle}", at=after.at
                )
            if after.node not in depth:
                open_dependency = after.node
                break
        if open_dependency:
            path.append(open_dependency)
            continue
        depth[node.key] = 1 + max((depth[after.node] for after in node.after), default=-1)
        path.pop()
