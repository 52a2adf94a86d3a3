"""Build the plan of a manifest: start order (`after:`), processes, flows, participants, discovery.

Owns: `build_plan`, which puts the parts of this package together, and `check_plan`, which only
reports whether that can be done. Nothing here starts anything. Pure but for the environment, for
finding executables and for reading parameter files.
"""

from __future__ import annotations

import functools
import graphlib
import hashlib
import os
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from typing import Any

import msgspec
from msgspec.structs import replace

from lifecycle.errors import UsageError
from lifecycle.manifest.diagnostics import (
    Diagnostic,
    ManifestError,
    Position,
    Severity,
    error,
    warning,
)
from lifecycle.manifest.flows import FlowNeeds, ResolvedNeed
from lifecycle.manifest.installed_types import installed_hash, search_prefixes
from lifecycle.manifest.model import (
    SIM_TIME,
    Discovery,
    DiscoveryMode,
    DiscoveryRange,
    Endpoint,
    EndpointKind,
    EndpointPolicy,
    FlowTransport,
    Link,
    Manifest,
    Mode,
    Node,
    NodeDeclaration,
    Run,
    RunKind,
    SystemDeclaration,
    UniqueHow,
)
from lifecycle.manifest.names import name_in_graph
from lifecycle.manifest.parameter_files import ParameterFiles
from lifecycle.manifest.parameter_values import portable
from lifecycle.manifest.yaml.source import read_bytes
from lifecycle.network.medium import DEFAULT_RMW
from lifecycle.network.ports import MAX_DOMAIN_ID, domain_of
from lifecycle.plan.model import (
    HeldBy,
    Plan,
    PlanError,
    PlannedEndpoint,
    PlannedFile,
    PlannedFlow,
    PlannedNode,
    declared,
    in_mode,
)
from lifecycle.plan.parameters import NodeParameters
from lifecycle.plan.processes import overcrowded, planned_processes
from lifecycle.plan.wiring import own_transports, place, wire
from lifecycle.printable import listed


def dependency_levels(nodes: Sequence[Node]) -> tuple[tuple[str, ...], ...]:
    """Layer nodes so that each is one level below the last node it waits for.

    Nodes of one level keep the manifest's order and do not wait for each other.

    Raises:
        PlanError: nodes wait for each other.
    """
    order = {node.key: index for index, node in enumerate(nodes)}
    sorter = graphlib.TopologicalSorter(
        {node.key: [each.node for each in node.after] for node in nodes}
    )
    try:
        sorter.prepare()
    except graphlib.CycleError as problem:
        circle = problem.args[1][::-1]  # each waits for the one after it
        after = nodes[order[circle[0]]].after
        at = next(each.at for each in after if each.node == circle[1])
        message = f"cannot order nodes that wait for each other: {' → '.join(circle)}"
        found = error("check.after-cycle", at, message, "remove one of these 'after'")
        raise ManifestError((found,)) from problem
    levels = []
    while ready := sorter.get_ready():
        levels.append(tuple(sorted(ready, key=order.__getitem__)))
        sorter.done(*ready)
    return tuple(levels)


_STRENGTH = (UniqueHow.NOT, UniqueHow.WEAKLY, UniqueHow.STRONGLY)


def planned_flows(nodes: Sequence[PlannedNode], links: Sequence[Link]) -> tuple[PlannedFlow, ...]:
    """Pair every publisher with every subscription of its topic, nodes and endpoints in order.

    Several links on one pair add up: the strongest uniqueness and the shortest delay hold. A link
    that names two nodes is kept even if they declare no such endpoints, so that it can be judged.
    """
    ends = [(node, each) for node in nodes for each in node.endpoints]
    readers: dict[str, list[str]] = {}
    for node, each in ends:
        if each.kind is EndpointKind.SUBSCRIPTION:
            readers.setdefault(each.resolved, []).append(node.key)
    pairs: dict[tuple[str, str, str], list[Link]] = {
        (each.resolved, node.key, reader): []
        for node, each in ends
        if each.kind is EndpointKind.PUBLISHER
        for reader in readers.get(each.resolved, ())
    }
    for link in links:
        pairs.setdefault((link.topic, link.from_node, link.to_node), []).append(link)
    measured = {(node.key, each.resolved) for node, each in ends if each.measure}
    foreign = {node.key for node in nodes if node.run.kind is not RunKind.PYTHON}
    return tuple(
        PlannedFlow(
            topic=topic,
            publisher=publisher,
            subscription=subscription,
            unique=max((each.unique for each in named), key=_STRENGTH.index, default=UniqueHow.NOT),
            max_delay_ms=min(
                (each.max_delay_ms for each in named if each.max_delay_ms is not None), default=None
            ),
            linked=bool(named),
            transport=next(
                (each.transport for each in named if each.transport is not FlowTransport.ANY),
                FlowTransport.ANY,
            ),
            quantities=tuple(number for each in named for number in each.quantities),
            measure=subscription in foreign
            and (
                any(each.measure for each in named)
                or not measured.isdisjoint({(publisher, topic), (subscription, topic)})
            ),
        )
        for (topic, publisher, subscription), named in pairs.items()
    )


def build_plan(
    manifest: Manifest,
    *,
    environment: Mapping[str, str] | None = None,
    domain_id: int | None = None,
) -> Plan:
    """Plan a system: resolve every name, group processes, place publishers, order nodes.

    The same manifest and environment always give the same plan.

    Args:
        manifest: valid, as `lifecycle.manifest.loading` returns it.
        environment: None takes this process's own.
        domain_id: 0–232, in the place of the manifest's; None leaves that.

    Raises:
        ManifestError: nothing can connect some of its endpoints.
        PlanError: it cannot be planned here, for example an executable is missing.
        UsageError: ROS_DOMAIN_ID or ROS_AUTOMATIC_DISCOVERY_RANGE is needed and not legal.
    """
    variables = os.environ if environment is None else environment
    if domain_id is not None:
        discovery = msgspec.structs.replace(manifest.discovery, domain_id=domain_id)
        manifest = replace(manifest, discovery=discovery)
    parameters = NodeParameters(ParameterFiles(manifest.path), manifest.modes)
    plan = _wired(manifest, variables, parameters)
    plan = replace(plan, processes=planned_processes(manifest.nodes, plan, variables))
    return in_mode(plan, plan.modes[0].name) if plan.modes else plan


def with_files_of_now(plan: Plan) -> Plan:
    """Return a plan with the digests that its parameter files have now."""
    digest_of = functools.cache(_digest)
    nodes = tuple(
        replace(
            node,
            files=tuple(
                _planned_file(node.parameter_files, each.place, each.written, digest_of)
                for each in node.files
            ),
        )
        for node in plan.nodes
    )
    return replace(plan, nodes=nodes)


def started_by_others(plan: Plan, names: Collection[str]) -> Plan:
    """Return a plan that starts all but some nodes: it waits for those, as for attached ones.

    Raises:
        UsageError: no node has this key or full name, or another one of its process is not named.
    """
    chosen = {find_node(plan, name).key for name in names}
    for process in plan.processes:
        left = chosen.intersection(process.nodes)
        if left and len(left) < len(process.nodes):
            others = ", ".join(each for each in process.nodes if each not in left)
            raise UsageError(
                f"cannot leave out {min(left)!r} alone: its process runs {others}, too",
                hint="name all of them, or give it a process of its own in the manifest",
            )
    return attached_to(plan, chosen)


def find_node(plan: Plan, name: str) -> PlannedNode:
    """Return the node with this key or fully qualified name.

    Raises:
        UsageError: there is none; says which there are.
    """
    for each in plan.nodes:
        if name in {each.key, each.full_name}:
            return each
    known = ", ".join(each.key for each in plan.nodes) or "none"
    raise UsageError(f"cannot find node {name!r} in {plan.manifest_path}; its nodes: {known}")


def attached_to(plan: Plan, keys: Collection[str]) -> Plan:
    """Return a plan in which others run some nodes, as if the manifest attached to them."""
    chosen = frozenset(keys)
    return replace(
        plan,
        nodes=tuple(
            replace(each, run=_attached(each.run)) if each.key in chosen else each
            for each in plan.nodes
        ),
        processes=tuple(
            replace(each, run=_attached(each.run), argv=())
            if chosen.issuperset(each.nodes)
            else each
            for each in plan.processes
        ),
    )


def _attached(run: Run) -> Run:
    """Others run it; that a host of ours does (`lifecycle run`) is known by its class."""
    return Run(kind=RunKind.ATTACH, python=run.python)


def check_plan(
    manifest: Manifest,
    *,
    environment: Mapping[str, str] | None = None,
    files: ParameterFiles | None = None,
) -> tuple[Diagnostic, ...]:
    """Return why a manifest cannot be planned, as far as that does not depend on what is installed.

    `files` are parameter files of its nodes that were read already.
    """
    variables = os.environ if environment is None else environment
    parameters = NodeParameters(files or ParameterFiles(manifest.path), manifest.modes)
    try:
        plan = _wired(manifest, variables, parameters)
    except UsageError:
        return ()  # the environment's fault, reported where it is used
    except ManifestError as problem:
        return problem.diagnostics
    except PlanError as problem:
        at = problem.at or Position(file=manifest.path, line=1, column=1)
        return (error("plan.impossible", at, problem.message, problem.hint),)
    return (*overcrowded(plan, variables), *_without_clock(manifest, parameters))


def _without_clock(manifest: Manifest, parameters: NodeParameters) -> Iterator[Diagnostic]:
    """Warn of simulated time that no node is declared to publish; others may, like a bag."""
    if any(
        each.kind is EndpointKind.PUBLISHER
        and name_in_graph(node, each.name, each.kind) == "/clock"
        for node in manifest.nodes
        for each in node.interface.endpoints
    ):
        return
    users = [
        (node, each)
        for node in manifest.nodes
        for each in parameters.expected(node)
        if each.name == SIM_TIME and each.value is True
    ]
    if users:
        names = listed([node.key for node, _ in users], 4)
        yield warning(
            "check.no-clock",
            users[0][1].at,
            f"cannot tell who gives {names} simulated time: no node declares a publisher of"
            " '/clock'",
            "declare it in the simulator's node, or start what publishes it before",
        )


def _wired(manifest: Manifest, variables: Mapping[str, str], parameters: NodeParameters) -> Plan:
    """Plan nodes, flows, order and how they are connected, but no processes yet."""
    prefixes = search_prefixes(variables)
    needs = FlowNeeds(manifest)
    hash_of = functools.cache(functools.partial(installed_hash, prefixes=prefixes))
    digest_of = functools.cache(_digest)
    nodes = tuple(
        _planned_node(node, needs, parameters, hash_of, digest_of) for node in manifest.nodes
    )
    plan = Plan(
        **{**declared(SystemDeclaration, manifest), "modes": tuple(map(_portable, manifest.modes))},
        manifest_path=manifest.path,
        domain_id=effective_domain(manifest.discovery, variables),
        discovery_range=effective_range(manifest.discovery, variables),
        processes=(),
        nodes=nodes,
        flows=planned_flows(nodes, manifest.links),
        levels=dependency_levels(manifest.nodes),
        rmw=variables.get("RMW_IMPLEMENTATION", "") or DEFAULT_RMW,
    )
    plan = wire(plan, manifest.links)
    crowded = overcrowded(plan, variables)
    if refused := tuple(each for each in crowded if each.severity is Severity.ERROR):
        raise ManifestError(refused)
    return plan


def effective_domain(discovery: Discovery, environment: Mapping[str, str]) -> int:
    """Return the domain, 0–232: the manifest's, else ROS_DOMAIN_ID, else 0.

    Raises:
        UsageError: the manifest names none and ROS_DOMAIN_ID is not a number from 0 to 232.
    """
    if discovery.domain_id is not None:
        return discovery.domain_id
    text = environment.get("ROS_DOMAIN_ID", "")
    if not text:
        return 0
    domain = domain_of(text)
    if domain is None:
        raise UsageError(
            f"cannot use ROS_DOMAIN_ID={text!r}: a domain is a number from 0 to {MAX_DOMAIN_ID}",
            hint="unset it, or set discovery.domain_id in the manifest",
        )
    return domain


def effective_range(discovery: Discovery, environment: Mapping[str, str]) -> DiscoveryRange:
    """Return how far discovery reaches: the manifest's value, else the environment's.

    `system_default` in the manifest leaves it to ROS_AUTOMATIC_DISCOVERY_RANGE where that is set;
    other modes than DYNAMIC define themselves who is found, and rmw must add nothing to that.

    Raises:
        UsageError: the manifest leaves it to the environment, which has an illegal value.
    """
    if discovery.mode is not DiscoveryMode.DYNAMIC:
        return DiscoveryRange.SYSTEM_DEFAULT
    if discovery.range is not DiscoveryRange.SYSTEM_DEFAULT:
        return discovery.range
    text = environment.get("ROS_AUTOMATIC_DISCOVERY_RANGE", "")
    if not text:
        return DiscoveryRange.SYSTEM_DEFAULT
    try:
        return DiscoveryRange[text]
    except KeyError:
        allowed = ", ".join(each.name for each in DiscoveryRange)
        raise UsageError(
            f"cannot use ROS_AUTOMATIC_DISCOVERY_RANGE={text!r}: it must be one of {allowed}",
            hint="unset it, or set discovery.range in the manifest",
        ) from None


def _planned_node(
    node: Node,
    needs: FlowNeeds,
    parameters: NodeParameters,
    hash_of: Callable[[str], str],
    digest_of: Callable[[str], str],
) -> PlannedNode:
    endpoints = tuple(
        _planned_endpoint(node, endpoint, needs.of(node.key, endpoint.kind, endpoint.name), hash_of)
        for endpoint in node.interface.endpoints
    )
    endpoints, participants = place(node, endpoints, needs)
    expected = parameters.expected(node)
    given = tuple((name, portable(value)) for name, value in node.parameters)
    return PlannedNode(
        **{**declared(NodeDeclaration, node), "parameters": given},
        process=node.process_name,
        held_by=_held_by(node),
        endpoints=endpoints,
        declared_parameters=tuple(
            each if each.default is None else replace(each, default=portable(each.default))
            for each in node.interface.parameters
        ),
        expected_parameters=expected,
        mode_parameters=parameters.in_modes(node, expected),
        has_all_parameters=node.interface.has_all_parameters
        and node.endpoints is EndpointPolicy.DECLARED,
        unread_parameter_files=parameters.unread(node),
        participants=participants,
        endpoint_policy=node.endpoints,
        transports=own_transports(node, needs) if node.run.kind is RunKind.PYTHON else (),
        files=tuple(
            _planned_file(node.parameter_files, place, text, digest_of)
            for place, text in node.written_paths
        ),
    )


def _portable(mode: Mode) -> Mode:
    parameters = tuple(replace(each, value=portable(each.value)) for each in mode.parameters)
    return replace(mode, parameters=parameters)


def _held_by(node: Node) -> HeldBy:
    if node.run.kind is RunKind.PYTHON:
        return HeldBy.STATE_MACHINE if node.managed else HeldBy.EXECUTOR
    return HeldBy.SERVICES if node.managed else HeldBy.NOTHING


def _planned_file(
    files: tuple[str, ...], place: str, written: str, digest_of: Callable[[str], str]
) -> PlannedFile:
    part, _, index = place.partition(".")
    digest = digest_of(files[int(index)]) if part == "parameter_files" else ""
    return PlannedFile(place=place, written=written, digest=digest)


def _digest(path: str) -> str:
    """Return the digest of a file's contents; empty if it cannot be read."""
    try:
        contents = read_bytes(path, file=path)
    except ManifestError:
        return ""  # reported by check.parameter-file
    return hashlib.sha256(contents).hexdigest()[:16]


def _planned_endpoint(
    node: Node, endpoint: Endpoint, need: ResolvedNeed | None, hash_of: Callable[[str], str]
) -> PlannedEndpoint:
    asked: dict[str, Any] = {}
    if need is not None:
        asked = {
            **{name: getattr(need.need, name) for name in _ASKED},
            "dscp": need.dscp,
            "enforce_dscp": need.need.enforce,
            "five_qi": need.five_qi,
            "five_qi_reason": need.flow_class.reason,
            "max_delay_ms": need.max_delay_ms,
        }
    return PlannedEndpoint(
        **declared(Endpoint, endpoint),
        resolved=name_in_graph(node, endpoint.name, endpoint.kind),
        type_hash=hash_of(endpoint.type),
        **asked,
    )


_ASKED = ("unique", "transport", "lossy", "quantities", "measure", "max_message_size")
"""What an endpoint asks of its flow and gets as it is written."""
