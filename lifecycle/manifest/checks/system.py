"""The manifest as the checks read it: every endpoint with its fully qualified name.

Owns: resolving all names once, so that each check compares names that are already whole. An
endpoint whose name cannot be resolved is left out here and reported by `names`. Pure.
"""

from __future__ import annotations

import dataclasses
import functools

from lifecycle.errors import LifecycleError
from lifecycle.manifest.diagnostics import Position
from lifecycle.manifest.model import Endpoint, EndpointKind, EndpointPolicy, Manifest, Node
from lifecycle.manifest.names import full_node_name, resolve
from lifecycle.manifest.remapping import RemapRule, parse_rule


def spell(at: Position) -> str:
    """Spell a position inside a message: `robot.lifecycle.yaml:14:7`."""
    return f"{at.file}:{at.line}:{at.column}"


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Resolved:
    """One endpoint of one node, with the name it will have in the graph."""

    node: Node
    endpoint: Endpoint
    name: str

    @property
    def at(self) -> Position:
        """Where the endpoint is declared."""
        return self.endpoint.at

    def __str__(self) -> str:
        noun = self.endpoint.kind.noun
        return f"{noun} {self.endpoint.name!r} of node {self.node.key!r} ({spell(self.at)})"


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Unresolved:
    """An endpoint whose name cannot be resolved, and why."""

    node: Node
    endpoint: Endpoint
    problem: LifecycleError


@dataclasses.dataclass(frozen=True, kw_only=True)
class System:
    """A manifest and what follows from it alone.

    Attributes:
        endpoints: in the order of the manifest.
        unresolved: the endpoints that are missing from `endpoints`.
        lost: keys of nodes that are declared, but left out because something is wrong in them; None
            if there may be any, because a file or section that may declare them is unreadable.
    """

    manifest: Manifest
    endpoints: tuple[Resolved, ...]
    unresolved: tuple[Unresolved, ...]
    lost: frozenset[str] | None = frozenset()

    @classmethod
    def of(cls, manifest: Manifest, *, lost: frozenset[str] | None = frozenset()) -> System:
        """Resolve every endpoint of a manifest; rules that rcl refuses are left out."""
        resolved: list[Resolved] = []
        unresolved: list[Unresolved] = []
        for node in manifest.nodes:
            rules = usable_rules(node)
            for endpoint in node.interface.endpoints:
                outcome = _resolve(node, endpoint, rules)
                if isinstance(outcome, Resolved):
                    resolved.append(outcome)
                else:
                    unresolved.append(outcome)
        return cls(
            manifest=manifest,
            endpoints=tuple(resolved),
            unresolved=tuple(unresolved),
            lost=lost,
        )

    def may_exist(self, key: str) -> bool:
        """Whether there is a node of this key, or may be once what is wrong has been put right."""
        return key in self.nodes or self.lost is None or key in self.lost

    @property
    def known(self) -> list[str]:
        """Keys of nodes that are declared, to suggest one of them."""
        return [*self.nodes, *sorted(self.lost or ())]

    @functools.cached_property
    def nodes(self) -> dict[str, Node]:
        """Nodes by manifest key."""
        return {node.key: node for node in self.manifest.nodes}

    @functools.cached_property
    def by_name(self) -> dict[tuple[EndpointKind, str], tuple[Resolved, ...]]:
        """Endpoints by kind and fully qualified name."""
        grouped: dict[tuple[EndpointKind, str], list[Resolved]] = {}
        for each in self.endpoints:
            grouped.setdefault((each.endpoint.kind, each.name), []).append(each)
        return {key: tuple(group) for key, group in grouped.items()}

    def named(self, kind: EndpointKind, name: str) -> tuple[Resolved, ...]:
        """Return the endpoints of one kind with this fully qualified name."""
        return self.by_name.get((kind, name), ())

    def names(self, kind: EndpointKind) -> tuple[str, ...]:
        """Return the fully qualified names that endpoints of one kind have."""
        return self._names.get(kind, ())

    @functools.cached_property
    def _names(self) -> dict[EndpointKind, tuple[str, ...]]:
        grouped: dict[EndpointKind, list[str]] = {}
        for kind, name in self.by_name:
            grouped.setdefault(kind, []).append(name)
        return {kind: tuple(names) for kind, names in grouped.items()}

    @functools.cached_property
    def is_open(self) -> bool:
        """Whether something may take part that the manifest does not declare."""
        return self.manifest.policy.undeclared_nodes is EndpointPolicy.OPEN or any(
            node.endpoints is EndpointPolicy.OPEN for node in self.manifest.nodes
        )


def _resolve(
    node: Node, endpoint: Endpoint, rules: tuple[tuple[str, str], ...]
) -> Resolved | Unresolved:
    try:
        name = resolve(
            endpoint.name,
            node_name=node.name,
            namespace=node.namespace,
            remap=rules,
            kind=endpoint.kind,
        )
    except LifecycleError as problem:
        return Unresolved(node=node, endpoint=endpoint, problem=problem)
    return Resolved(node=node, endpoint=endpoint, name=name)


def usable_rules(node: Node) -> tuple[tuple[str, str], ...]:
    """Return the node's remap rules that rcl reads; `remaps` reports the others."""
    return tuple(rule for rule in node.remap if not isinstance(read_rule(*rule), LifecycleError))


def read_rule(match: str, replacement: str) -> RemapRule | LifecycleError:
    """Return a remap rule, or why rcl refuses it."""
    try:
        return parse_rule(match, replacement)
    except LifecycleError as problem:
        return problem


def full_name(node: Node) -> str:
    """Return the node's fully qualified name."""
    return full_node_name(node.name, node.namespace)
