"""The manifest as the checks read it: endpoints with fully qualified names; checks of these names.

Owns: resolving all names once; illegal, duplicate, unused or colliding names and remap rules.
The names of the endpoints that every ROS 2 node, or every managed one, has without declaring them
(rcl's rosout and type description service, rclpy's parameter services, rcl_lifecycle's services and
event), so that what connects to them is not reported as unconnected. Pure.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator, Mapping
from pathlib import Path

import msgspec
from msgspec.structs import replace

from lifecycle.errors import LifecycleError, did_you_mean
from lifecycle.manifest.diagnostics import Diagnostic, Position, error, warning
from lifecycle.manifest.flows import FlowNeeds
from lifecycle.manifest.installed_types import search_prefixes
from lifecycle.manifest.model import (
    Endpoint,
    EndpointKind,
    EndpointPolicy,
    Machine,
    Manifest,
    Node,
    RosInterfaceAccess,
)
from lifecycle.manifest.names import (
    DIAGNOSTICS_TOPIC,
    MANAGED_SERVICES,
    NODE_SERVICES,
    OUR_SERVICES,
    RemapKind,
    RemapRule,
    expand,
    hidden_names,
    name_in_graph,
    name_problem,
    namespace_problem,
    node_name_problem,
    parse_rule,
    remap_kind,
    supervisor_prefix,
    supervisor_services,
    supervisor_status_topic,
)
from lifecycle.manifest.parameter_files import ParameterFiles
from lifecycle.network.medium import DEFAULT_RMW

_RMW_VARIABLE = "RMW_IMPLEMENTATION"


class Resolved(msgspec.Struct, frozen=True, kw_only=True):
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
        return f"{noun} {self.endpoint.name!r} of node {self.node.key!r} ({self.at.spelled})"


class DeclaredSystem:
    """A manifest and what follows from it alone.

    Attributes:
        endpoints: in the order of the manifest; by remap rules that rcl reads.
        unresolved: those that have no name, and why.
        environment: of the process that will run the system.
        files: the parameter files that nodes name.
    """

    def __init__(
        self, manifest: Manifest, *, environment: Mapping[str, str], files: ParameterFiles
    ) -> None:
        self.manifest = manifest
        self.environment = environment
        self.files = files
        self.endpoints: list[Resolved] = []
        self.unresolved: list[tuple[Node, Endpoint, LifecycleError]] = []
        for node in manifest.nodes:
            rules = (pair for pair, rule in read_rules(node) if isinstance(rule, RemapRule))
            as_read = replace(node, remap=tuple(rules))
            for endpoint in node.interface.endpoints:
                try:
                    name = name_in_graph(as_read, endpoint.name, endpoint.kind)
                except LifecycleError as problem:  # noqa: PERF203 - each is reported
                    self.unresolved.append((node, endpoint, problem))
                else:
                    self.endpoints.append(Resolved(node=node, endpoint=endpoint, name=name))

    @functools.cached_property
    def prefixes(self) -> tuple[Path, ...]:
        """Where packages are installed, in the order in which they are searched."""
        return search_prefixes(self.environment)

    @functools.cached_property
    def needs(self) -> FlowNeeds:
        """What the endpoints of the system ask of their flows."""
        return FlowNeeds(self.manifest)

    def rmw_of(self, node: Node) -> str:
        """Return the RMW identifier that a node will run with."""
        own = dict(node.run.environment).get(_RMW_VARIABLE, "")
        return own or self.environment.get(_RMW_VARIABLE, "") or DEFAULT_RMW

    @functools.cached_property
    def nodes(self) -> dict[str, Node]:
        """Nodes by manifest key."""
        return {node.key: node for node in self.manifest.nodes}

    @functools.cached_property
    def processes(self) -> dict[str, list[Node]]:
        """Nodes by the name of their process."""
        grouped: dict[str, list[Node]] = {}
        for node in self.manifest.nodes:
            grouped.setdefault(node.process_name, []).append(node)
        return grouped

    @functools.cached_property
    def hosts(self) -> dict[str, list[Machine]]:
        """The machines that nodes run on, by address; those without one are this host."""
        used = {node.machine for node in self.manifest.nodes}
        found: dict[str, list[Machine]] = {}
        for machine in self.manifest.machines:
            if machine.name in used:
                found.setdefault(machine.address, []).append(machine)
        return found

    @functools.cached_property
    def by_name(self) -> dict[tuple[EndpointKind, str], tuple[Resolved, ...]]:
        """Endpoints by kind and fully qualified name."""
        grouped: dict[tuple[EndpointKind, str], list[Resolved]] = {}
        for each in self.endpoints:
            grouped.setdefault((each.endpoint.kind, each.name), []).append(each)
        return {key: tuple(group) for key, group in grouped.items()}

    @functools.cached_property
    def by_node(self) -> dict[str, list[Resolved]]:
        """Endpoints by the key of their node."""
        grouped: dict[str, list[Resolved]] = {}
        for each in self.endpoints:
            grouped.setdefault(each.node.key, []).append(each)
        return grouped

    def named(self, kind: EndpointKind, name: str) -> tuple[Resolved, ...]:
        """Return the endpoints of one kind with this fully qualified name."""
        return self.by_name.get((kind, name), ())

    def names(self, kind: EndpointKind) -> tuple[str, ...]:
        """Return the fully qualified names that endpoints of one kind have."""
        return tuple(name for of, name in self.by_name if of is kind)

    @functools.cached_property
    def is_open(self) -> bool:
        """Whether something may take part that the manifest does not declare."""
        return self.manifest.policy.undeclared_nodes is EndpointPolicy.OPEN or any(
            node.endpoints is EndpointPolicy.OPEN for node in self.manifest.nodes
        )


def read_rules(node: Node) -> list[tuple[tuple[str, str], RemapRule | LifecycleError]]:
    """Return each remap rule of a node, as written and as read, or why rcl refuses it."""
    found: list[tuple[tuple[str, str], RemapRule | LifecycleError]] = []
    for pair in node.remap:
        try:
            found.append((pair, parse_rule(*pair)))
        except LifecycleError as problem:  # noqa: PERF203 - each is reported
            found.append((pair, problem))
    return found


_NOT_BY_DEFAULT = ("get_logger_levels", "set_logger_levels")
"""Services that a node has only if its code asks for them."""

_OF_THE_GRAPH = (
    (EndpointKind.PUBLISHER, "/parameter_events"),
    (EndpointKind.PUBLISHER, "/rosout"),
    # What tools and simulators take part in, outside of any one system.
    (EndpointKind.PUBLISHER, "/clock"),
    # The graph interface's transport.
    (EndpointKind.PUBLISHER, "/lifecycle/graph"),
    (EndpointKind.SUBSCRIPTION, "/lifecycle/graph"),
    (EndpointKind.SUBSCRIPTION, "/diagnostics"),
    (EndpointKind.SUBSCRIPTION, "/parameter_events"),
    (EndpointKind.SUBSCRIPTION, "/rosout"),
)


def implicit_names(system: DeclaredSystem) -> frozenset[tuple[EndpointKind, str]]:
    """Return kind and fully qualified name of every endpoint that exists undeclared."""
    names = set(_OF_THE_GRAPH)
    manifest, access = system.manifest, system.manifest.policy.access
    if access is not RosInterfaceAccess.OFF:
        names.add((EndpointKind.PUBLISHER, DIAGNOSTICS_TOPIC))
        offered = supervisor_services(access, (each.name for each in manifest.modes))
        for machine in ("", *(each.name for each in manifest.machines)):
            prefix = supervisor_prefix(manifest.system, machine)
            names.add((EndpointKind.PUBLISHER, supervisor_status_topic(prefix)))
            names.update((EndpointKind.SERVICE_SERVER, f"{prefix}/{name}") for name in offered)
    for node in system.manifest.nodes:
        left_out = {*_NOT_BY_DEFAULT, *(() if node.managed else MANAGED_SERVICES)}
        services = {*NODE_SERVICES, *OUR_SERVICES} - left_out
        names.update((EndpointKind.SERVICE_SERVER, f"{node.full_name}/{each}") for each in services)
        if node.managed:
            names.add((EndpointKind.PUBLISHER, f"{node.full_name}/transition_event"))
    return frozenset(names)


def check_node_name(_system: DeclaredSystem, node: Node) -> Iterator[Diagnostic]:
    """Yield findings about name and namespace of a node."""
    if problem := node_name_problem(node.name):
        message = f"cannot use {node.name!r} as the name of a node: {problem}"
        yield error("check.name", node.where("name"), message)
    if problem := namespace_problem(node.namespace):
        message = f"cannot use {node.namespace!r} as a namespace: {problem}"
        yield error("check.name", node.where("namespace"), message)


def check_endpoint_names(system: DeclaredSystem) -> Iterator[Diagnostic]:
    """Yield findings about names of endpoints that rcl refuses."""
    for node, endpoint, unresolved in system.unresolved:
        if problem := name_problem(endpoint.name):
            message = (
                f"cannot use {endpoint.name!r} as the name of a {endpoint.kind.noun}: {problem}"
            )
            yield error("check.name", endpoint.at, message)
        elif not node_name_problem(node.name) and not namespace_problem(node.namespace):
            yield error("check.name", endpoint.at, unresolved.message, unresolved.hint)


def check_duplicate_nodes(system: DeclaredSystem) -> Iterator[Diagnostic]:
    """Yield findings about two nodes of one name."""
    first: dict[str, Node] = {}
    for node in system.manifest.nodes:
        other = first.setdefault(node.full_name, node)
        if other is not node:
            message = (
                f"cannot run two nodes with the name {node.full_name!r}: "
                f"{other.key!r} has it as well ({other.at.spelled})"
            )
            hint = "give one of them another 'name:' or 'namespace:'"
            yield error("check.duplicate-node", node.at, message, hint)


def check_duplicate_endpoints(system: DeclaredSystem) -> Iterator[Diagnostic]:
    """Judge endpoints of one kind and one name: twice in a node, or answered by several."""
    for (kind, name), group in system.by_name.items():
        first: dict[str, Resolved] = {}
        for each in group:
            other = first.setdefault(each.node.key, each)
            if other is not each:
                message = (
                    f"cannot have two {kind.noun}s {name!r} in one node: "
                    f"{other.endpoint.name!r} is the same ({other.at.spelled})"
                )
                hint = "remove one, or remap one of them"
                yield error("check.duplicate-endpoint", each.at, message, hint)


def check_remaps(_system: DeclaredSystem, node: Node) -> Iterator[Diagnostic]:
    """Yield findings about the remap rules of a node."""
    names = _graph_names(node)
    actions = [
        _expanded(node, each.name) for each in node.interface.endpoints if each.kind.is_action
    ]
    for (match, _), rule in read_rules(node):
        at = node.where(f"remap.{match}")
        if isinstance(rule, LifecycleError):
            yield error("check.remap-rule", at, rule.message, rule.hint)
            continue
        if rule.kind in (RemapKind.NODE_NAME, RemapKind.NAMESPACE):
            key = "name" if rule.kind is RemapKind.NODE_NAME else "namespace"
            message = f"cannot remap {match!r} here: the manifest says who the node is"
            yield error("check.remap-identity", at, message, f"write '{key}: {rule.replacement}'")
            continue
        wanted = _expanded(node, rule.match)
        known = [name for name, kind in names if rule.applies_to(kind, node.name)]
        # A rule for many nodes is one for those that have the name.
        if not wanted or wanted in known or f"remap.{match}" in node.shared:
            continue
        if rule.node not in ("", node.name):
            why, hint = f"it is for node {rule.node!r}, this one is {node.name!r}", "remove it"
        elif wanted in actions:
            why = "rcl remaps only the hidden topics and services of an action"
            hint = (
                f"remap {match}/_action/send_goal, …/cancel_goal, …/get_result, …/feedback and "
                "…/status, or declare the action by its final name"
            )
        elif node.endpoints is EndpointPolicy.DECLARED:
            why = f"no endpoint of the node is named {wanted!r}"
            hint = did_you_mean(wanted, known)
        else:
            continue
        yield warning("check.remap-unused", at, f"cannot apply the rule {match!r}: {why}", hint)


def _graph_names(node: Node) -> list[tuple[str, RemapKind]]:
    """Return the names, before remapping, that rcl looks for a rule for."""
    names = []
    for endpoint in node.interface.endpoints:
        expanded = _expanded(node, endpoint.name)
        if endpoint.kind.is_action:
            names += [(name, remap_kind(hidden)) for name, hidden in hidden_names(expanded)]
        else:
            names.append((expanded, remap_kind(endpoint.kind)))
    return names


def _expanded(node: Node, name: str) -> str:
    """Return the fully qualified name; empty for one that is not legal, which `names` reports."""
    try:
        return expand(name, node.name, node.namespace)
    except LifecycleError:
        return ""


CHECKS = (check_endpoint_names, check_duplicate_nodes, check_duplicate_endpoints)
OF_A_NODE = (check_node_name, check_remaps)
