"""Validated document → frozen `Manifest`: machines, network, flows policy, links; nodes by `node`.

Owns: what one document declares, before it is joined with others by `include`, and the findings
that a schema cannot detect. Pure but for reading interfaces by reference.
"""

from __future__ import annotations

import ipaddress
from collections.abc import Collection, Mapping
from pathlib import Path

from lifecycle.manifest.builders.connections import (
    build_data_layer,
    build_discovery,
    section_positions,
)
from lifecycle.manifest.builders.cursor import Cursor
from lifecycle.manifest.builders.node import Findings, build_node, quantities
from lifecycle.manifest.diagnostics import Diagnostic, Severity
from lifecycle.manifest.model import (
    Link,
    Machine,
    Manifest,
    Network,
    Node,
    Policy,
)
from lifecycle.manifest.yaml.document import Place, error
from lifecycle.manifest.yaml.yaml_parser import quote
from lifecycle.network import DscpMapping, TransportPriorityMapping, dscp_mappings, parse_mapping

_MAX_MAPPING_BYTES = 1_000_000


def build_network(root: Cursor, *, base: Path, found: list[Diagnostic]) -> Network:
    """Build the network of a document; the defaults where it declares nothing.

    Args:
        root: the document.
        base: folder that the path of a mapping starts from.
        found: findings are appended here.
    """
    cursor = root.get("network")
    if cursor is None:
        return Network()
    return cursor.build(
        Network,
        transport_priority_mapping=_priority_mapping(cursor, found),
        five_qi_dscp=_dscp_mapping(cursor, base, found),
        at=cursor.key_at,
    )


def _priority_mapping(network: Cursor, found: list[Diagnostic]) -> TransportPriorityMapping | None:
    cursor = network.get("transport_priority_mapping")
    if cursor is None:
        return None
    try:
        return cursor.build(TransportPriorityMapping)
    except ValueError as problem:
        message, _, hint = str(problem).partition("; ")
        found.append(error("manifest.transport-priority", cursor.at, message, hint))
        return None


def _dscp_mapping(network: Cursor, base: Path, found: list[Diagnostic]) -> DscpMapping | None:
    """Read a mapping: a published one by its name, else a file."""
    cursor = network.get("five_qi_dscp")
    if cursor is None:
        return None
    name = cursor.value.text
    shipped = {each.name: each for each in dscp_mappings()}
    if name in shipped:
        return shipped[name]
    try:
        with (base / name).open("rb") as file:
            text = file.read(_MAX_MAPPING_BYTES)
    except (OSError, ValueError) as problem:
        why = getattr(problem, "strerror", None) or str(problem)
        message = f"cannot read the 5QI to DSCP mapping {quote(name)}: {why}"
        hint = f"name a file, or a published mapping: {', '.join(shipped)}"
        found.append(error("manifest.five-qi-dscp", cursor.at, message, hint))
        return None
    try:
        return parse_mapping(text)
    except ValueError as problem:
        message = f"cannot use {quote(name)} as a 5QI to DSCP mapping: {problem.__cause__}"
        hint = 'write {"name": …, "source": …, "values": {"85": "EF"}}'
        found.append(error("manifest.five-qi-dscp", cursor.at, message, hint))
        return None


THIS_HOST = "local"
"""Name of the machine of nodes that name none; declared implicitly, without address."""

_SEVERITIES = {"error": Severity.ERROR, "warning": Severity.WARNING, "ignore": None}


def build_manifest(
    root: Cursor,
    *,
    path: str,
    arguments: tuple[tuple[str, str], ...],
    base: Path,
    environment: Mapping[str, str],
    unsound: Collection[Place],
    found: Findings,
) -> Manifest:
    """Build what one document declares, its includes not yet joined.

    Args:
        root: a document that fits the schema, or what is left of it without the parts that do not.
        path: as the user wrote it.
        arguments: resolved values by name.
        base: folder that its relative paths start from.
        environment: for AMENT_PREFIX_PATH, where interfaces by reference are searched.
        unsound: links to leave out, which keep their place in the list.
        found: findings are appended here; with an error among them, what is wrong is left out.
    """
    nodes = tuple(
        build_node(key, cursor, base=base, machine=THIS_HOST, environment=environment, found=found)
        for key, cursor in root.entries("nodes")
    )
    return Manifest(
        path=path,
        arguments=arguments,
        system=root.text("system"),
        description=root.text("description"),
        machines=_machines(root, nodes, found),
        discovery=build_discovery(root),
        network=build_network(root, base=base, found=found),
        data_layer=build_data_layer(root, found),
        policy=_policy(root),
        nodes=nodes,
        links=tuple(_link(each) for each in root.items("links") if each.place not in unsound),
        positions=section_positions(root),
    )


def _machines(root: Cursor, nodes: tuple[Node, ...], found: Findings) -> tuple[Machine, ...]:
    machines = []
    for name, cursor in root.entries("machines"):
        address = cursor.text("address")
        if address and not _is_address(address):
            at = root.document.at((*cursor.place, "address"))
            message = f"cannot use {quote(address)} as an address; it must be IPv4 or IPv6"
            hint = "look the name up: a plan must not depend on a name server"
            found.append(error("manifest.address", at, message, hint))
        machines.append(Machine(name=name, address=address, at=cursor.key_at))
    if THIS_HOST not in {each.name for each in machines}:
        here = next((node for node in nodes if node.machine == THIS_HOST), None)
        if here is not None:
            machines.append(Machine(name=THIS_HOST, at=here.at))
    return tuple(machines)


def _is_address(text: str) -> bool:
    try:
        ipaddress.ip_address(text)
    except ValueError:
        return False
    return True


def _policy(root: Cursor) -> Policy:
    cursor = root.get("policy")
    if cursor is None:
        return Policy()
    return cursor.build(
        Policy,
        unverifiable_blocks=cursor.text("unverifiable") == "block",
        unpublished=_SEVERITIES[cursor.text("unpublished", "error")],
        unheard=_SEVERITIES[cursor.text("unheard", "warning")],
    )


def _link(cursor: Cursor) -> Link:
    return cursor.build(
        Link,
        from_node=cursor.text("from"),
        to_node=cursor.text("to"),
        quantities=quantities(cursor),
        at=cursor.at,
    )
