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
from lifecycle.manifest.diagnostics import Diagnostic, Position, Severity, error, note, warning
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
            as_read = replace(node, remap=usable_rules(node))
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


def usable_rules(node: Node) -> tuple[tuple[str, str], ...]:
    """Return the node's remap rules that rcl reads; `check_remaps` reports the others."""
    return tuple(rule for rule in node.remap if not isinstance(read_rule(*rule), LifecycleError))


def read_rule(match: str, replacement: str) -> RemapRule | LifecycleError:
    """Return a remap rule, or why rcl refuses it."""
    try:
        return parse_rule(match, replacement)
    except LifecycleError as problem:
        return problem


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
    names.update(_of_supervisors(system.manifest))
    for node in system.manifest.nodes:
        left_out = {*_NOT_BY_DEFAULT, *(() if node.managed else MANAGED_SERVICES)}
        services = {*NODE_SERVICES, *OUR_SERVICES} - left_out
        names.update((EndpointKind.SERVICE_SERVER, f"{node.full_name}/{each}") for each in services)
        if node.managed:
            names.add((EndpointKind.PUBLISHER, f"{node.full_name}/transition_event"))
    return frozenset(names)


def _of_supervisors(manifest: Manifest) -> Iterator[tuple[EndpointKind, str]]:
    """Yield what the supervisors of a system offer by its policy."""
    access = manifest.policy.access
    if access is RosInterfaceAccess.OFF:
        return
    yield EndpointKind.PUBLISHER, DIAGNOSTICS_TOPIC
    for machine in ("", *(each.name for each in manifest.machines)):
        prefix = supervisor_prefix(manifest.system, machine)
        yield EndpointKind.PUBLISHER, supervisor_status_topic(prefix)
        for name in supervisor_services(access, (each.name for each in manifest.modes)):
            yield EndpointKind.SERVICE_SERVER, f"{prefix}/{name}"


_ANSWERING = (EndpointKind.SERVICE_SERVER, EndpointKind.ACTION_SERVER)


def check_names(system: DeclaredSystem) -> Iterator[Diagnostic]:
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


def _illegal_endpoints(system: DeclaredSystem) -> Iterator[Diagnostic]:
    for node, endpoint, unresolved in system.unresolved:
        noun = endpoint.kind.noun
        if problem := name_problem(endpoint.name):
            message = f"cannot use {endpoint.name!r} as the name of a {noun}: {problem}"
            yield error("check.name", endpoint.at, message)
        elif not node_name_problem(node.name) and not namespace_problem(node.namespace):
            yield error("check.name", endpoint.at, unresolved.message, unresolved.hint)


def _duplicate_nodes(system: DeclaredSystem) -> Iterator[Diagnostic]:
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


def _duplicate_endpoints(group: tuple[Resolved, ...]) -> Iterator[Diagnostic]:
    """Judge endpoints of one kind and one name: twice in a node, or answered by several."""
    first: dict[str, Resolved] = {}
    for each in group:
        other = first.setdefault(each.node.key, each)
        noun = each.endpoint.kind.noun
        if other is not each and not _remapped(each) and not _remapped(other):
            message = (
                f"cannot have two {noun}s {each.name!r} in one node: "
                f"{other.endpoint.name!r} is the same ({other.at.spelled})"
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
            yield note("check.several-servers", each.at, message, hint)


def _remapped(each: Resolved) -> bool:
    """Whether a rule gave it its name; then `check_remaps` reports the rule."""
    return expand(each.endpoint.name, each.node.name, each.node.namespace) != each.name


def check_remaps(system: DeclaredSystem) -> Iterator[Diagnostic]:
    """Yield findings about remap rules."""
    resolved: dict[str, list[Resolved]] = {}
    for each in system.endpoints:
        resolved.setdefault(each.node.key, []).append(each)
    for node in system.manifest.nodes:
        rules: list[tuple[str, RemapRule]] = []
        for match, replacement in node.remap:
            rule = read_rule(match, replacement)
            if isinstance(rule, LifecycleError):
                yield error("check.remap-rule", _place(node, match), rule.message, rule.hint)
            else:
                rules.append((match, rule))
        shared = {node.where(each) for each in node.shared}
        # A rule for many nodes is one for those that have the name.
        yield from (
            finding
            for finding in _unused(node, rules)
            if finding.severity is Severity.ERROR or finding.at not in shared
        )
        yield from _collisions(node, resolved.get(node.key, []))


def _place(node: Node, match: str) -> Position:
    return node.where(f"remap.{match}")


def _unused(node: Node, rules: list[tuple[str, RemapRule]]) -> Iterator[Diagnostic]:
    names = _graph_names(node)
    used = {id(_first(node, rules, name, kind)) for name, kind in names if name}
    for match, rule in rules:
        at = _place(node, match)
        if rule.kind in (RemapKind.NODE_NAME, RemapKind.NAMESPACE):
            key = "name" if rule.kind is RemapKind.NODE_NAME else "namespace"
            message = f"cannot remap {match!r} here: the manifest says who the node is"
            yield error("check.remap-identity", at, message, f"write '{key}: {rule.replacement}'")
        elif rule.node not in ("", node.name):
            message = (
                f"cannot apply the rule {match!r}: it is for node {rule.node!r}, "
                f"this one is {node.name!r}"
            )
            yield warning("check.remap-unused", at, message, "remove the prefix, or the rule")
        elif id(rule) not in used:
            yield from _never_matches(node, match, rule, names)


def _first(
    node: Node, rules: list[tuple[str, RemapRule]], name: str, kind: RemapKind
) -> RemapRule | None:
    fitting = (rule for _, rule in rules if rule.applies_to(kind, node.name))
    return next((rule for rule in fitting if _expanded(node, rule.match) == name), None)


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


def _never_matches(
    node: Node,
    match: str,
    rule: RemapRule,
    names: list[tuple[str, RemapKind]],
) -> Iterator[Diagnostic]:
    at = _place(node, match)
    wanted = _expanded(node, rule.match)
    actions = [each.name for each in node.interface.endpoints if each.kind.is_action]
    if not wanted:
        return
    if any(_expanded(node, name) == wanted for name in actions):
        yield error(
            "check.remap-action",
            at,
            f"cannot remap the action {wanted!r}: rcl remaps its hidden topics and services only",
            f"remap {match}/_action/send_goal, …/cancel_goal, …/get_result, …/feedback and "
            "…/status, or declare the action by its final name",
        )
    elif any(name == wanted and kind & rule.kind for name, kind in names):
        message = f"cannot apply the rule {match!r}: an earlier rule for {wanted!r} always wins"
        yield warning("check.remap-shadowed", at, message, "remove one of the two")
    elif node.endpoints is EndpointPolicy.DECLARED:
        known = [name for name, kind in names if kind & rule.kind]
        message = f"cannot apply the rule {match!r}: no endpoint of the node is named {wanted!r}"
        yield warning("check.remap-unused", at, message, did_you_mean(wanted, known))


def _collisions(node: Node, resolved: list[Resolved]) -> Iterator[Diagnostic]:
    """Refuse a rule that gives an endpoint the name of another one of its kind and node."""
    first: dict[tuple[EndpointKind, str], Resolved] = {}
    for each in resolved:
        other = first.setdefault((each.endpoint.kind, each.name), each)
        before = [expand(one.endpoint.name, node.name, node.namespace) for one in (other, each)]
        if other is each or before == [each.name, each.name]:
            continue
        moved, stays = (each, other) if before[1] != each.name else (other, each)
        message = (
            f"cannot remap {each.endpoint.kind.noun} {moved.endpoint.name!r} onto {each.name!r}: "
            f"{stays.endpoint.name!r} of the same node has that name ({stays.at.spelled})"
        )
        yield error("check.remap-collision", _rule_place(moved), message, "remap only one of them")


def _rule_place(moved: Resolved) -> Position:
    """Return the place of the rule that renamed an endpoint; the endpoint's if it is not plain."""
    node = moved.node
    expanded = expand(moved.endpoint.name, node.name, node.namespace)
    for match, replacement in usable_rules(node):
        rule = parse_rule(match, replacement)
        if rule.match and _expanded(node, rule.match) == expanded:
            return _place(node, match)
    return moved.at


CHECKS = (
    check_names,
    check_remaps,
)
