"""Connections and mappings of one node: those that it must have, has, and still lacks.

Owns: `Instructions`, and `steps`, the difference of two in the order in which it is made. Comparing
them makes one case of the first wiring, of a change and of making again what was lost. Pure.
"""

from __future__ import annotations

import functools
from collections.abc import Collection

import msgspec

from lifecycle.node.host.control import Command, Operation
from lifecycle.plan.model import ParticipantConnections, PlannedNode
from lifecycle.verify.observation import NodeConfiguration
from lifecycle.verify.outcome import Outcome
from lifecycle.verify.rules.catalogue import NOT_WIRED, node_of
from lifecycle.verify.verdict import Finding


class Instructions(msgspec.Struct, frozen=True, kw_only=True):
    """What one node must have, or what it has.

    Attributes:
        node: fully qualified name.
        connections: (name, how it is connected), in the order in which they are made.
        mappings: (endpoint as `publishers/video`, name of its connection); an empty name is the
            node's own participant.
    """

    node: str
    connections: tuple[tuple[str, ParticipantConnections], ...] = ()
    mappings: tuple[tuple[str, str], ...] = ()


def planned_instructions(node: PlannedNode) -> Instructions:
    """Return what the plan instructs a node to do.

    A participant that is no connection, made only to distinguish a publisher's flow, is the
    node's own to make: for its publisher, the node's own participant is named in its place.
    """
    named = {each.name: each for each in node.participants if each.connection}
    return Instructions(
        node=node.full_name,
        connections=tuple((each.connection, each.connections) for each in named.values()),
        mappings=tuple(
            (
                each.kind.spell(each.name),
                named[each.participant].connection if each.participant in named else "",
            )
            for each in node.endpoints
        ),
    )


def wired(configuration: NodeConfiguration) -> Instructions:
    """Return what a node says that it has; what it could not make it has not."""
    return Instructions(
        node=configuration.name,
        connections=tuple(
            (each.name, ParticipantConnections(urls=each.urls))
            for each in configuration.connections
            if each.name and not each.error
        ),
        mappings=tuple(
            (each.kind.spell(each.name or each.resolved), each.connection)
            for each in configuration.endpoints
            if each.mapped
        ),
    )


def steps(
    wanted: Instructions, has: Instructions, *, ours: Collection[str] = ()
) -> tuple[Command, ...]:
    """Return what is missing, in the order in which it is made: make before break.

    A connection whose URLs differ cannot be had twice under one name: it alone is broken first.

    Args:
        wanted: what must be.
        has: what is.
        ours: names of connections that this authority made; others are not its to break.
    """
    step = functools.partial(Command, node=wanted.node)
    connections, mappings = dict(has.connections), dict(has.mappings)
    made: list[Command] = []
    stale: set[str] = set()
    for name, how in wanted.connections:
        if name in connections:
            if connections[name].urls == how.urls:
                continue
            stale.add(name)
            made.append(step(operation=Operation.DISCONNECT_FROM, connection=name))
        made.append(step(operation=Operation.CONNECT_TO, connection=name, connections=how))
    for endpoint, name in wanted.mappings:
        if name in stale or mappings.get(endpoint) != name:
            made.append(step(operation=Operation.MAP_TO, connection=name, endpoint=endpoint))
    needed = {name for name, _ in wanted.connections}
    made += [
        step(operation=Operation.DISCONNECT_FROM, connection=name)
        for name in connections
        if name in ours and name not in needed
    ]
    return tuple(made)


def not_wired(subject: str, message: str) -> Finding:
    """Return the finding that something could not be wired.

    Args:
        subject: fully qualified node name, or the system's name.
        message: a whole sentence with the reason.
    """
    return NOT_WIRED.finding(
        outcome=Outcome.VIOLATED,
        subject=subject,
        expected="wired",
        observed="not wired",
        message=message,
        node=node_of(subject),
    )
