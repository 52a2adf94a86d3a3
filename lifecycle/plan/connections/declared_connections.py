"""Connections that a manifest spells out → participants of the plan.

Owns: placing a node's endpoints on the connections that `connections:` declares for it, with what
`flows:` asks of them. Pure.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

from lifecycle.manifest.flows.flow_needs import ParticipantGroup
from lifecycle.manifest.model import ConnectionDeclaration
from lifecycle.plan.model import ParticipantConnections, PlannedEndpoint, PlannedParticipant


def participant_name(node_name: str, connection: str) -> str:
    """Return the base name of the hidden node that carries a connection, `_camera_net`."""
    return f"_{node_name}_{connection}"


def place_declared(
    node_name: str,
    endpoints: Sequence[PlannedEndpoint],
    declared: Sequence[ConnectionDeclaration],
    groups: Sequence[ParticipantGroup],
) -> tuple[
    tuple[PlannedEndpoint, ...], tuple[PlannedParticipant, ...], tuple[ParticipantGroup, ...]
]:
    """Place endpoints on declared connections.

    Args:
        node_name: the node's base name.
        endpoints: all of the node's endpoints.
        declared: its connections.
        groups: endpoints that must share, or not share, a participant.

    Returns:
        The endpoints with `participant` filled in where a connection carries them, a participant
        for each connection, and the groups without the endpoints that are placed now.
    """
    places = {
        entry: participant_name(node_name, connection.name)
        for connection in declared
        for entry in connection.map
    }
    placed = tuple(
        dataclasses.replace(each, participant=places.get((each.kind, each.name), each.participant))
        for each in endpoints
    )
    left = tuple(
        dataclasses.replace(group, names=remaining)
        for group in groups
        if (remaining := tuple(name for name in group.names if (group.kind, name) not in places))
    )
    return placed, tuple(_participant(node_name, each, groups) for each in declared), left


def _participant(
    node_name: str, connection: ConnectionDeclaration, groups: Sequence[ParticipantGroup]
) -> PlannedParticipant:
    needs = [
        group
        for group in groups
        if {*connection.map} & {(group.kind, name) for name in group.names}
    ]
    marks = [url.dscp for url in connection.urls] + [group.dscp for group in needs]
    sizes = [group.max_datagram_bytes for group in needs]
    count = len(connection.map)
    return PlannedParticipant(
        name=participant_name(node_name, connection.name),
        dscp=next((each for each in marks if each is not None), None),
        reason=f"connection {connection.name} for {count} endpoint{'' if count == 1 else 's'}",
        max_datagram_bytes=min((each for each in sizes if each is not None), default=None),
        non_blocking_send=any(group.non_blocking_send for group in needs),
        connection=connection.name,
        connections=ParticipantConnections(urls=tuple(str(url) for url in connection.urls)),
        declared=True,
    )
