"""Static endpoint discovery (Fast DDS STATIC EDP): endpoints known without being announced.

Owns: the connection `data` that carries a node's topics in that mode, and the table of all
endpoints: DDS names, ids that are unique in the system, and rmw_fastrtps's own topic
`ros_discovery_info` of each participant. Pure.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence

from lifecycle.manifest import Durability, EndpointKind, Reliability, RunKind
from lifecycle.network import Medium
from lifecycle.plan.connections.contacts import contacts_of, fixed_url
from lifecycle.plan.connections.control import participant_name
from lifecycle.plan.connections.hosts import Hosts, PortPool
from lifecycle.plan.model import (
    ParticipantConnections,
    PlanError,
    PlannedEndpoint,
    PlannedNode,
    PlannedParticipant,
    StaticEndpoint,
    StaticParticipant,
)

DATA = "data"
"""Name of the connection that carries a node's topics."""

MAX_USER_ID = 32767
"""Fast DDS 2.14 reads ids of endpoints as int16_t."""

GRAPH_TOPIC = "ros_discovery_info"
"""By which rmw maps endpoints to nodes; every participant has a writer and a reader of it."""

GRAPH_TYPE = "rmw_dds_common::msg::dds_::ParticipantEntitiesInfo_"


def place_static(
    nodes: Sequence[PlannedNode], hosts: Hosts, pool: PortPool
) -> tuple[PlannedNode, ...]:
    """Put every topic that no declared connection carries onto a connection with fixed ports.

    A participant that makes a publisher's flow unique becomes a connection as well.

    Raises:
        PlanError: too few ports, or more endpoints than there are ids.
    """
    placed = [_place(node) for node in nodes]
    v6 = any(":" in host for host in hosts.used)
    kind = Medium.UDPV6 if v6 else Medium.UDPV4
    ports = {
        (node.key, each.name): (hosts.host(node.machine), pool.take(hosts.host(node.machine), 3))
        for node in placed
        for each in node.participants
        if _is_static(each)
    }
    bare = {
        key: fixed_url(kind, hosts.address(host), taken, ()) for key, (host, taken) in ports.items()
    }
    contacts = {key: contacts_of(ports[key][0], (str(url),))[0] for key, url in bare.items()}
    table = tuple(_table(placed))
    return tuple(
        dataclasses.replace(
            node,
            participants=tuple(
                dataclasses.replace(
                    each,
                    connections=ParticipantConnections(
                        urls=(
                            str(
                                dataclasses.replace(
                                    bare[node.key, each.name],
                                    peers=tuple(
                                        sorted(
                                            contact.peer
                                            for key, contact in contacts.items()
                                            if key != (node.key, each.name)
                                        )
                                    ),
                                )
                            ),
                        ),
                        static_name=_enclave(node, each),
                        static_participants=table,
                    ),
                )
                if _is_static(each)
                else each
                for each in node.participants
            ),
        )
        for node in placed
    )


def _is_static(participant: PlannedParticipant) -> bool:
    return not participant.connections.urls


def _place(node: PlannedNode) -> PlannedNode:
    """Give a node the participants that its topics need; still without URLs."""
    if node.run.kind is not RunKind.PYTHON:
        return node
    name = participant_name(node.name, DATA)
    moved = [each for each in node.endpoints if each.kind.is_topic and not each.participant]
    endpoints = tuple(
        dataclasses.replace(each, participant=name) if each in moved else each
        for each in node.endpoints
    )
    extra = tuple(
        each
        if each.connection
        else dataclasses.replace(
            each, transports=(), connection=each.name.removeprefix(f"_{node.name}_")
        )
        for each in node.participants
    )
    data = PlannedParticipant(
        name=name,
        dscp=None,
        reason=f"connection {DATA}, "
        + (
            "1 endpoint that is not announced"
            if len(moved) == 1
            else f"{len(moved)} endpoints that are not announced"
        ),
        connection=DATA,
    )
    return dataclasses.replace(
        node, endpoints=endpoints, participants=(*extra, *((data,) if moved else ()))
    )


def _enclave(node: PlannedNode, participant: PlannedParticipant) -> str:
    return f"{node.namespace.rstrip('/')}/{participant.name.lstrip('_')}"


def _table(nodes: Sequence[PlannedNode]) -> Iterator[StaticParticipant]:
    number = 0
    for node in nodes:
        for participant in node.participants:
            if not _is_static(participant):
                continue
            carried = [each for each in node.endpoints if each.participant == participant.name]
            lines = []
            for entry in (*(_line(each) for each in carried), *_GRAPH):
                number += 1
                if number > MAX_USER_ID:
                    raise PlanError(
                        f"cannot number more than {MAX_USER_ID} endpoints, which Fast DDS's static "
                        "endpoint discovery allows",
                        hint="use 'discovery: {mode: static}'",
                        at=node.at,
                    )
                lines.append(dataclasses.replace(entry, user_id=number))
            yield StaticParticipant(name=_enclave(node, participant), endpoints=tuple(lines))


_GRAPH = tuple(
    StaticEndpoint(
        writer=writer,
        topic=GRAPH_TOPIC,
        type=GRAPH_TYPE,
        profile=GRAPH_TOPIC,
        user_id=0,
        transient_local=True,
    )
    for writer in (True, False)
)


def _line(each: PlannedEndpoint) -> StaticEndpoint:
    package, _, name = each.type.split("/")
    qos = each.qos
    return StaticEndpoint(
        writer=each.kind is EndpointKind.PUBLISHER,
        topic=f"rt{each.resolved}",
        type=f"{package}::msg::dds_::{name}_",
        profile=each.resolved,
        user_id=0,
        reliable=qos is None or qos.reliability is not Reliability.BEST_EFFORT,
        transient_local=qos is not None and qos.durability is Durability.TRANSIENT_LOCAL,
    )
