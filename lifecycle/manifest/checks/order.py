"""Checks of `after`: known nodes, no waiting in circles, nothing that can never come.

Owns: check.after-unknown, check.after-self, check.after-cycle, check.after-unmanaged. Pure.
"""

from __future__ import annotations

from collections.abc import Iterator

from lifecycle.manifest.checks.system import System
from lifecycle.manifest.diagnostics import Diagnostic
from lifecycle.manifest.model import After, Condition, Node
from lifecycle.manifest.schema.message_text import did_you_mean
from lifecycle.manifest.yaml.document import error, warning


def check(system: System) -> Iterator[Diagnostic]:
    """Yield findings about the order in which nodes come up."""
    for node in system.manifest.nodes:
        for after in node.after:
            if not system.may_exist(after.node):
                message = f"cannot wait for node {after.node!r}: there is no such node"
                hint = did_you_mean(after.node, system.known)
                yield error("check.after-unknown", after.at, message, hint)
            elif after.node not in system.nodes:
                continue  # what is wrong in it comes first
            elif after.node == node.key:
                message = f"cannot make {node.key!r} wait for itself"
                yield error("check.after-self", after.at, message, "remove it")
            else:
                yield from _unmanaged(node, after, system.nodes[after.node])
    yield from cycles(system)


def _unmanaged(node: Node, after: After, other: Node) -> Iterator[Diagnostic]:
    """Judge conditions of nodes that have nothing but a start (see `Condition`)."""
    key, condition = after.node, after.condition
    if not node.managed and condition is Condition.ACTIVE:
        message = (
            f"cannot hold the start of {node.key!r} until {key!r} is active: {node.key!r} is not "
            f"managed, and nothing is activated before every node runs"
        )
        yield error("check.after-unmanaged", after.at, message, f"write '{key}: connected'")
    elif not other.managed and condition is not Condition.STARTED:
        message = (
            f"cannot wait until {key!r} is {condition.value}: it is not managed and only starts"
        )
        yield warning("check.after-unmanaged", after.at, message, f"write '{key}: started'")


def cycles(system: System) -> Iterator[Diagnostic]:
    """Report each circle once, at the edge that closes it; iterative, so depth has no limit."""
    edges = {
        key: [each for each in node.after if each.node in system.nodes and each.node != key]
        for key, node in system.nodes.items()
    }
    done: set[str] = set()
    for root in system.nodes:
        path: dict[str, Iterator[After]] = {} if root in done else {root: iter(edges[root])}
        while path:
            key, pending = next(reversed(path.items()))
            after = next(pending, None)
            if after is None:
                del path[key]
                done.add(key)
            elif after.node in path:
                keys = list(path)
                circle = [*keys[keys.index(after.node) :], after.node]
                message = f"cannot order nodes that wait for each other: {' → '.join(circle)}"
                yield error("check.after-cycle", after.at, message, "remove one of these 'after'")
            elif after.node not in done:
                path[after.node] = iter(edges[after.node])
