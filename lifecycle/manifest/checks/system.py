"""The manifest as the checks read it: endpoints with fully qualified names, implicit ones included.

Owns: resolving all names once; an endpoint whose name cannot be resolved is reported by `names`.
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

from lifecycle.errors import LifecycleError
from lifecycle.manifest.diagnostics import Position
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
    RemapRule,
    name_in_graph,
    parse_rule,
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
