"""Validated `network:` of a document → frozen `Network`.

Owns: the findings about it that a schema cannot see. Pure but for reading a mapping file.
"""

from __future__ import annotations

from pathlib import Path

from lifecycle.manifest.builders.cursor import Cursor
from lifecycle.manifest.diagnostics import Diagnostic
from lifecycle.manifest.model import FlowIdentification, Network
from lifecycle.manifest.yaml.document import error
from lifecycle.manifest.yaml.scalars import quote
from lifecycle.network.five_qi_dscp import DscpMapping, dscp_mappings, parse_mapping
from lifecycle.network.transport_priority import TransportPriorityMapping

_MAX_MAPPING_BYTES = 1_000_000


def build_network(root: Cursor, *, base: Path, found: list[Diagnostic]) -> Network:
    """Build what a document says of its network; the defaults where it says nothing.

    Args:
        root: the document.
        base: folder that the path of a mapping starts from.
        found: findings are appended here.
    """
    cursor = root.get("network")
    if cursor is None:
        return Network()
    return Network(
        flow_identification=cursor.choice(
            "flow_identification", FlowIdentification, FlowIdentification.PARTICIPANT
        ),
        transport_priority_mapping=_priority_mapping(cursor, found),
        five_qi_dscp=_dscp_mapping(cursor, base, found),
        max_datagram_bytes=cursor.integer("max_datagram_bytes"),
        at=cursor.key_at,
    )


def _priority_mapping(network: Cursor, found: list[Diagnostic]) -> TransportPriorityMapping | None:
    cursor = network.get("transport_priority_mapping")
    if cursor is None:
        return None
    low, high = cursor.integer("low"), cursor.integer("high")
    try:
        return TransportPriorityMapping(
            mask=cursor.integer("mask") or 0,
            low=0 if low is None else low,
            high=0xFF if high is None else high,
        )
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
