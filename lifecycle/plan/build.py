"""Manifest → Plan.

Owns: `build_plan`, which puts the parts of this room together, and `check_plan`, which only says
whether that can be done. Nothing here starts anything. Pure but for the environment, for finding
executables and for reading parameter files.
"""

from __future__ import annotations

import dataclasses
import hashlib
import os
from collections.abc import Mapping, Sequence
from pathlib import Path

from lifecycle.errors import UsageError
from lifecycle.manifest.diagnostics import Diagnostic, ManifestError, Position
from lifecycle.manifest.flows.flow_needs import FlowNeeds, ParticipantGroup, ResolvedNeed
from lifecycle.manifest.model import (
    Discovery,
    DiscoveryMode,
    DiscoveryRange,
    Endpoint,
    FlowTransport,
    Manifest,
    Node,
    RunKind,
)
from lifecycle.manifest.names import resolve
from lifecycle.manifest.types.ament_index import search_prefixes
from lifecycle.manifest.types.type_hash import installed_hash
from lifecycle.manifest.yaml.document import error
from lifecycle.manifest.yaml.source import read_bytes
from lifecycle.network.ports import MAX_DOMAIN_ID, domain_of
from lifecycle.network.rmw_capabilities import DEFAULT_RMW
from lifecycle.plan.connections.declared_connections import place_declared
from lifecycle.plan.connections.wiring import Wired, variables_of, wire
from lifecycle.plan.errors import PlanError
from lifecycle.plan.flows import planned_flows
from lifecycle.plan.levels import dependency_levels
from lifecycle.plan.model import Plan, PlannedEndpoint, PlannedFile, PlannedNode
from lifecycle.plan.parameters import ParameterFiles
from lifecycle.plan.participants import place_flows
from lifecycle.plan.processes import planned_processes, process_name


def build_plan(manifest: Manifest, *, environment: Mapping[str, str] | None = None) -> Plan:
    """Plan a system: resolve every name, group processes, place publishers, order nodes.

    The same manifest and environment always give the same plan.

    Args:
        manifest: valid, as `lifecycle.manifest.load` returns it.
        environment: variables to read ROS_DOMAIN_ID, ROS_AUTOMATIC_DISCOVERY_RANGE,
            RMW_IMPLEMENTATION and AMENT_PREFIX_PATH from; None takes this process's own.

    Raises:
        PlanError: the manifest cannot be planned here, for example an executable is missing.
        UsageError: ROS_DOMAIN_ID or ROS_AUTOMATIC_DISCOVERY_RANGE is needed and not legal.
    """
    variables = os.environ if environment is None else environment
    domain_id = effective_domain(manifest.discovery, variables)
    discovery_range = effective_range(manifest.discovery, variables)
    rmw = variables.get("RMW_IMPLEMENTATION", "") or DEFAULT_RMW
    wired = _wired(manifest, variables, domain_id=domain_id, rmw=rmw)
    plan = Plan(
        system=manifest.system,
        manifest_path=manifest.path,
        domain_id=domain_id,
        discovery_range=discovery_range,
        policy=manifest.policy,
        machines=manifest.machines,
        processes=planned_processes(
            manifest.nodes,
            domain_id=domain_id,
            discovery_range=discovery_range,
            environment=variables,
            shared_memory=manifest.discovery.transport is FlowTransport.SHM,
        ),
        nodes=wired.nodes,
        flows=wired.flows,
        levels=dependency_levels(manifest.nodes),
        rmw=rmw,
        flow_identification=manifest.network.flow_identification,
        data_layer=manifest.data_layer,
        discovery_mode=manifest.discovery.mode,
        discovery=manifest.discovery,
        max_datagram_bytes=manifest.network.max_datagram_bytes,
        network=manifest.network,
        server=wired.server,
        observers=wired.observers,
    )
    return _told(plan)


def with_files_of_now(plan: Plan) -> Plan:
    """Return a plan with the digests that its parameter files have now."""
    nodes = tuple(
        dataclasses.replace(
            node,
            files=tuple(
                _planned_file(node.parameter_files, each.place, each.written) for each in node.files
            ),
        )
        for node in plan.nodes
    )
    return dataclasses.replace(plan, nodes=nodes)


def check_plan(
    manifest: Manifest, *, environment: Mapping[str, str] | None = None
) -> tuple[Diagnostic, ...]:
    """Return why a manifest cannot be planned, as far as that does not depend on what is installed.

    Args:
        manifest: valid.
        environment: as for `build_plan`.
    """
    variables = os.environ if environment is None else environment
    try:
        domain_id = effective_domain(manifest.discovery, variables)
    except UsageError:
        return ()  # the environment's fault, which says so where it is used
    try:
        rmw = variables.get("RMW_IMPLEMENTATION", "") or DEFAULT_RMW
        _wired(manifest, variables, domain_id=domain_id, rmw=rmw)
    except PlanError as problem:
        at = problem.at or Position(file=manifest.path, line=1, column=1)
        alone = error("plan.impossible", at, problem.message, problem.hint)
        return problem.diagnostics or (alone,)
    return ()


def _wired(manifest: Manifest, variables: Mapping[str, str], *, domain_id: int, rmw: str) -> Wired:
    """Plan nodes, flows and how they are connected."""
    prefixes = search_prefixes(variables)
    needs = FlowNeeds(manifest, prefixes)
    files = ParameterFiles(manifest.path)
    nodes = tuple(_planned_node(node, needs, prefixes, files) for node in manifest.nodes)
    return wire(
        manifest,
        nodes,
        planned_flows(nodes, manifest.links),
        domain_id=domain_id,
        rmws={
            node.key: dict(node.run.environment).get("RMW_IMPLEMENTATION", "") or rmw
            for node in manifest.nodes
        },
    )


def _told(plan: Plan) -> Plan:
    """Tell processes that make their own participants how to, by variables."""
    variables = dict(variables_of(plan.discovery, plan.server))
    return dataclasses.replace(
        plan,
        processes=tuple(
            dataclasses.replace(
                each, environment=tuple({**variables, **dict(each.environment)}.items())
            )
            if each.run.kind is RunKind.COMMAND
            else each
            for each in plan.processes
        ),
    )


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
    """Return how far discovery reaches: the manifest's word, else the environment's.

    `system_default` in the manifest leaves it to ROS_AUTOMATIC_DISCOVERY_RANGE where that is set;
    other modes than DYNAMIC say themselves who is found, and rmw must add nothing to that.

    Raises:
        UsageError: the manifest leaves it to the environment, which says something illegal.
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
    node: Node, needs: FlowNeeds, prefixes: Sequence[Path], files: ParameterFiles
) -> PlannedNode:
    endpoints = tuple(
        _planned_endpoint(
            node, endpoint, needs.of(node.key, endpoint.kind, endpoint.name), prefixes
        )
        for endpoint in node.interface.endpoints
    )
    # Only a node in our own host can be given more participants; what others start keeps its own.
    ours = node.run.kind is RunKind.PYTHON
    groups: tuple[ParticipantGroup, ...] = needs.groups(node) if ours else ()
    endpoints, connected, groups = place_declared(node.name, endpoints, node.connections, groups)
    endpoints, participants = place_flows(node.name, endpoints, groups)
    return PlannedNode(
        key=node.key,
        name=node.name,
        namespace=node.namespace,
        machine=node.machine,
        process=process_name(node),
        managed=node.managed,
        run=node.run,
        endpoints=endpoints,
        declared_parameters=node.interface.parameters,
        parameters=node.parameters,
        parameter_files=node.parameter_files,
        expected_parameters=files.expected(node),
        unread_parameter_files=files.unread(node),
        remap=node.remap,
        participants=(*connected, *participants),
        after=node.after,
        timeouts=node.timeouts,
        endpoint_policy=node.endpoints,
        log_level=node.log_level,
        transports=needs.node_transports(node) if ours else (),
        files=tuple(
            _planned_file(node.parameter_files, place, text) for place, text in node.written_paths
        ),
        at=node.at,
    )


def _planned_file(files: tuple[str, ...], place: str, written: str) -> PlannedFile:
    part, _, index = place.partition(".")
    if part != "parameter_files":
        return PlannedFile(place=place, written=written)
    try:
        contents = read_bytes(files[int(index)], file=written)
    except ManifestError:
        return PlannedFile(place=place, written=written)  # check.parameter-file says so
    return PlannedFile(
        place=place, written=written, digest=hashlib.sha256(contents).hexdigest()[:16]
    )


def _planned_endpoint(
    node: Node, endpoint: Endpoint, need: ResolvedNeed | None, prefixes: Sequence[Path]
) -> PlannedEndpoint:
    resolved = resolve(
        endpoint.name,
        node_name=node.name,
        namespace=node.namespace,
        remap=node.remap,
        kind=endpoint.kind,
    )
    planned = PlannedEndpoint(
        kind=endpoint.kind,
        name=endpoint.name,
        resolved=resolved,
        type=endpoint.type,
        qos=endpoint.qos,
        qos_defaults=endpoint.qos_defaults,
        type_hash=installed_hash(endpoint.type, prefixes),
        at=endpoint.at,
    )
    if need is None:
        return planned
    message, hint = need.marking.problem
    if message:
        raise PlanError(message, hint=hint, at=need.need.at)
    return dataclasses.replace(
        planned,
        unique=need.need.unique,
        dscp=need.dscp,
        enforce_dscp=need.need.enforce,
        dscp_reason=need.marking.reason,
        five_qi=need.five_qi,
        five_qi_reason=need.flow_class.reason,
        transport=need.need.transport,
        max_delay_ms=need.max_delay_ms,
        loss=need.need.loss,
        rate_hz=need.need.rate_hz,
        max_message_size=need.max_message_size,
        max_message_size_reason=""
        if need.max_message_size == need.need.max_message_size
        else "the bound of its type",
        lossy=need.need.lossy,
        quantities=need.need.quantities,
    )
