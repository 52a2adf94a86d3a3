"""Checks of names: legal ones, and none of them twice.

Owns: check.name, check.duplicate-node, check.duplicate-endpoint. Pure.
"""

from __future__ import annotations

from collections.abc import Iterator

from lifecycle.manifest.checks.system import Resolved, System, full_name, spell
from lifecycle.manifest.diagnostics import Diagnostic
from lifecycle.manifest.model import EndpointKind, Node
from lifecycle.manifest.names import expand, name_problem, namespace_problem, node_name_problem
from lifecycle.manifest.yaml.document import error, warning

_ANSWERING = (EndpointKind.SERVICE_SERVER, EndpointKind.ACTION_SERVER)


def check(system: System) -> Iterator[Diagnostic]:
    """Yield findings about the names of nodes and endpoints."""
    for node in system.manifest.nodes:
        yield from _illegal_node(node)
    yield from _illegal_endpoints(system)
    yield from _duplicate_nodes(system)
    for group in system.by_name.values():
        yield from _duplicate_endpoints(group)


def _illegal_node(node: Node) -> Iterator[Diagnostic]:
    if problem := node_name_problem(node.name):
        message = f"cannot use {node.name!r} as the name of a node: {problem}"
        yield error("check.name", node.where("name"), message)
    if problem := namespace_problem(node.namespace):
        message = f"cannot use {node.namespace!r} as a namespace: {problem}"
        yield error("check.name", node.where("namespace"), message)


def _illegal_endpoints(system: System) -> Iterator[Diagnostic]:
    for each in system.unresolved:
        node, endpoint = each.node, each.endpoint
        noun = endpoint.kind.noun
        if problem := name_problem(endpoint.name):
            message = f"cannot use {endpoint.name!r} as the name of a {noun}: {problem}"
            yield error("check.name", endpoint.at, message)
        elif not node_name_problem(node.name) and not namespace_problem(node.namespace):
            yield error("check.name", endpoint.at, each.problem.message, each.problem.hint)


def _duplicate_nodes(system: System) -> Iterator[Diagnostic]:
    first: dict[str, Node] = {}
    for node in system.manifest.nodes:
        other = first.setdefault(full_name(node), node)
        if other is not node:
            message = (
                f"cannot run two nodes with the name {full_name(node)!r}: "
                f"{other.key!r} has it as well ({spell(other.at)})"
            )
            hint = "give one of them another 'name:' or 'namespace:'"
            yield error("check.duplicate-node", node.at, message, hint)


def _duplicate_endpoints(group: tuple[Resolved, ...]) -> Iterator[Diagnostic]:
    """Judge endpoints of one kind and one name: twice in a node, or answered by several."""
    first: dict[str, Resolved] = {}
    for each in group:
        other = first.setdefault(each.node.key, each)
        noun = each.endpoint.kind.noun
        if other is not each and not _remapped(each) and not _remapped(other):
            message = (
                f"cannot have two {noun}s {each.name!r} in one node: "
                f"{other.endpoint.name!r} is the same ({spell(other.at)})"
            )
            yield error("check.duplicate-endpoint", each.at, message, "remove one")
    servers = list(first.values())
    if len(servers) > 1 and servers[0].endpoint.kind in _ANSWERING:
        for each in servers[1:]:
            message = (
                f"cannot tell which of {len(servers)} servers answers {each.name!r}: "
                f"{servers[0]} offers it as well"
            )
            hint = "move one of them with 'namespace:' or 'remap:'"
            yield warning("check.several-servers", each.at, message, hint)


def _remapped(each: Resolved) -> bool:
    """Whether a rule gave it its name; then the rule is what `remaps` reports."""
    return expand(each.endpoint.name, each.node.name, each.node.namespace) != each.name
