"""Extra DDS participants: for declared and negotiated connections, for unique or marked flows.

On Fast DDS a publisher sends from the sender sockets of its participant, so only one of its own
makes it unique, and only all publishers of one participant together can carry a DSCP. From the same
sockets subscriptions send their acknowledgements. Pure.
"""

from __future__ import annotations

from collections.abc import Sequence

from msgspec.structs import replace

from lifecycle.manifest.flows import ParticipantGroup
from lifecycle.manifest.model import ConnectionDeclaration
from lifecycle.network.dscp import describe
from lifecycle.plan.model import (
    ParticipantConnections,
    PlannedEndpoint,
    PlannedNode,
    PlannedParticipant,
)
from lifecycle.plan.parties import NegotiatedConnection
from lifecycle.printable import count


def participant_name(node_name: str, connection: str) -> str:
    """Return the base name of the hidden node that carries a connection, `_camera_net`."""
    return f"_{node_name}_{connection}"


def place(
    node_name: str,
    endpoints: Sequence[PlannedEndpoint],
    connections: Sequence[ConnectionDeclaration],
    groups: Sequence[ParticipantGroup],
) -> tuple[tuple[PlannedEndpoint, ...], tuple[PlannedParticipant, ...]]:
    """Put endpoints on the connections that are declared for them, the others on what flows need.

    Names of the latter count from 0 in the order in which the interface first needs them, so they
    are the same in every run. What is in no connection and no group is left alone. Returns the
    endpoints with `participant` filled in, and the participants, connections first.
    """
    places = {
        entry: participant_name(node_name, connection.name)
        for connection in connections
        for entry in connection.map
    }
    participants = [_connection(node_name, connection, groups) for connection in connections]
    for group in groups:
        names = tuple(name for name in group.names if (group.kind, name) not in places)
        if names:
            index = len(participants) - len(connections)
            flow = _flow(f"_{node_name}_flow_{index}", replace(group, names=names))
            places |= {(group.kind, name): flow.name for name in names}
            participants.append(flow)
    placed = tuple(
        replace(each, participant=places.get((each.kind, each.name), "")) for each in endpoints
    )
    return placed, tuple(participants)


def _connection(
    node_name: str, connection: ConnectionDeclaration, groups: Sequence[ParticipantGroup]
) -> PlannedParticipant:
    """Return the participant of a connection, with what the flows of its endpoints ask for."""
    needs = [
        group
        for group in groups
        if {*connection.map} & {(group.kind, name) for name in group.names}
    ]
    marks = [url.dscp for url in connection.urls] + [group.dscp for group in needs]
    sizes = [group.max_datagram_bytes for group in needs]
    return PlannedParticipant(
        name=participant_name(node_name, connection.name),
        dscp=next((each for each in marks if each is not None), None),
        reason=f"connection {connection.name} for {count(len(connection.map), 'endpoint')}",
        max_datagram_bytes=min((each for each in sizes if each is not None), default=None),
        non_blocking_send=any(group.non_blocking_send for group in needs),
        connection=connection.name,
        connections=ParticipantConnections(urls=tuple(str(url) for url in connection.urls)),
        declared=True,
    )


def _flow(name: str, group: ParticipantGroup) -> PlannedParticipant:
    return PlannedParticipant(
        name=name,
        dscp=group.dscp,
        reason=_reason(group),
        transports=group.transports,
        max_datagram_bytes=group.max_datagram_bytes,
        non_blocking_send=group.non_blocking_send,
    )


def _reason(group: ParticipantGroup) -> str:
    noun = f"{group.kind.noun}{'s' if len(group.names) > 1 else ''}"
    facts = [f"{'unique ' if group.unique else ''}{noun} {', '.join(group.names)}"]
    if group.dscp is not None:
        facts.append(f"marked {describe(group.dscp)}")
    if group.five_qi is not None:
        facts.append(f"for 5QI {group.five_qi}")
    if group.transports:
        facts.append(f"by {' and '.join(group.transports)} only")
    if group.max_datagram_bytes is not None:
        facts.append(f"in datagrams of at most {group.max_datagram_bytes} bytes")
    if group.non_blocking_send:
        facts.append("sent without waiting")
    return " ".join(facts)


def place_negotiated(node: PlannedNode, connections: Sequence[NegotiatedConnection]) -> PlannedNode:
    """Give a node the connections that were negotiated for it.

    An extra participant that made a publisher's flow unique and carries none any more is removed;
    the publisher's connection takes its purpose.
    """
    places = {label: each for each in connections for label in each.map}
    endpoints = []
    carriers = {each.name: each for each in node.participants}
    takes: dict[str, list[PlannedParticipant]] = {}
    for each in node.endpoints:
        connection = places.get(each.kind.spell(each.name))
        if connection is None:
            endpoints.append(each)
            continue
        if each.participant in carriers:
            takes.setdefault(connection.name, []).append(carriers[each.participant])
        name = participant_name(node.name, connection.name)
        endpoints.append(replace(each, participant=name))
    used = {each.participant for each in endpoints}
    kept = [each for each in node.participants if each.connection or each.name in used]
    made = [_participant(node.name, each, takes.get(each.name, ())) for each in connections]
    return replace(node, endpoints=tuple(endpoints), participants=(*kept, *made))


def _participant(
    node_name: str, connection: NegotiatedConnection, replaced: Sequence[PlannedParticipant]
) -> PlannedParticipant:
    sizes = [each.max_datagram_bytes for each in replaced if each.max_datagram_bytes is not None]
    reason = f"connection {connection.name}, {connection.reason}"
    return PlannedParticipant(
        name=participant_name(node_name, connection.name),
        dscp=next((each.dscp for each in replaced), None),
        reason="; ".join([reason, *dict.fromkeys(each.reason for each in replaced)]),
        max_datagram_bytes=min(sizes, default=None),
        non_blocking_send=any(each.non_blocking_send for each in replaced),
        connection=connection.name,
        connections=ParticipantConnections(urls=connection.urls),
    )
