"""Extra DDS participants for declared connections, and for flows that are unique or marked.

Owns: naming and describing the participants that `connections:` declares, and those that
`manifest/flows.py` groups endpoints into; the command lines of processes. On Fast DDS a publisher
sends from the sender sockets of its participant, so only one of its own makes it unique, and only
all publishers of one participant together can carry a DSCP. From the same sockets subscriptions
send their acknowledgements. Pure.
"""

from __future__ import annotations

import json
import math
import os
import re
from collections.abc import Iterator, Mapping, Sequence

from msgspec.structs import replace

from lifecycle.manifest.diagnostics import Position
from lifecycle.manifest.flows import ParticipantGroup
from lifecycle.manifest.installed_types import search_prefixes
from lifecycle.manifest.model import (
    ConnectionDeclaration,
    Node,
    ParameterValue,
    RosArguments,
    Run,
)
from lifecycle.network.dscp import describe
from lifecycle.plan.connections.control import participant_name
from lifecycle.plan.model import (
    ParticipantConnections,
    PlanError,
    PlannedEndpoint,
    PlannedParticipant,
)
from lifecycle.printable import count


def place(
    node_name: str,
    endpoints: Sequence[PlannedEndpoint],
    connections: Sequence[ConnectionDeclaration],
    groups: Sequence[ParticipantGroup],
) -> tuple[tuple[PlannedEndpoint, ...], tuple[PlannedParticipant, ...]]:
    """Put endpoints on the connections that are declared for them, the others on what flows need.

    Names of the latter count from 0 in the order in which the interface first needs them, so they
    are the same in every run. What is in no connection and no group is left alone.

    Returns:
        The endpoints with `participant` filled in, and the participants, connections first.
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


def command_line(nodes: Sequence[Node], environment: Mapping[str, str]) -> tuple[str, ...]:
    """Return the full argv of a COMMAND process, whose nodes share one `run:`.

    It is given ROS arguments only where a key of one of its nodes asks for them. Those of a process
    with several nodes are for the one node alone; who is to be renamed is known by its key.

    Raises:
        PlanError: the package or its executable cannot be found.
    """
    run = nodes[0].run
    argv = list(run.command) or [find_executable(run, environment, at=nodes[0].at)]
    given: list[str] = []
    if run.ros_args is not RosArguments.NONE:
        given = [word for node in nodes for word in _ros_arguments(node, alone=len(nodes) == 1)]
        levels = dict.fromkeys(node.log_level for node in nodes if node.log_level)
        given += [word for level in levels for word in ("--log-level", level)]
    return tuple(argv + ["--ros-args"] * bool(given) + given)


def _ros_arguments(node: Node, *, alone: bool) -> Iterator[str]:
    """Yield what one node asks for. Files precede values, because rcl lets the later one win.

    Name and namespace are given where the manifest writes them.
    """
    old = "" if alone else f"{node.key.rpartition('/')[2]}:"
    own = "" if alone else f"{node.name}:"
    if node.where("name") is not node.at:
        yield from ("-r", f"{old}__node:={node.name}")
    if node.namespace != "/" or node.where("namespace") is not node.at:
        yield from ("-r", f"{own}__ns:={node.namespace}")
    for source, target in node.remap:
        rule = source if _NODE_PREFIX.match(source) else f"{own}{source}"
        yield from ("-r", f"{rule}:={target}")
    for file in node.parameter_files:
        yield from ("--params-file", file)
    # rcl 9.2 knows a value for one node by the name alone, and so has none for a namespace; the
    # supervisor sets these.
    for name, value in node.parameters if alone or node.namespace == "/" else ():
        if value == ():
            continue  # rcl has no empty array: `[]` takes the node's default from it
        yield from ("-p", f"{own}{name}:={parameter_text(value)}")


_NODE_PREFIX = re.compile(r"\w+:(?!//)", re.ASCII)


def find_executable(run: Run, environment: Mapping[str, str], *, at: Position) -> str:
    """Find `lib/<package>/<executable>` under the first prefix that has it, where types are found.

    Raises:
        PlanError: no prefix holds the package or the executable.
    """
    prefixes = search_prefixes(environment)
    wanted = f"executable {run.executable!r} of package {run.package!r}"
    found: set[str] = set()
    for prefix in prefixes:
        folder = prefix / "lib" / run.package
        candidate = folder / run.executable
        if os.path.isfile(candidate) and os.access(candidate, os.X_OK):
            return str(candidate)
        if os.path.isdir(folder):
            found |= {each.name for each in folder.iterdir() if os.access(each, os.X_OK)}
    if found:
        raise PlanError(f"cannot find {wanted}: the package has {', '.join(sorted(found))}", at=at)
    raise PlanError(
        f"cannot find {wanted}: no lib/{run.package} with executables under "
        f"{', '.join(map(str, prefixes))}",
        hint="build and source its workspace, or correct the package name",
        at=at,
    )


def parameter_text(value: ParameterValue) -> str:
    """Write a parameter value as the YAML that rcl reads back as the same type.

    Strings are always quoted: bare `1`, `true` or `1.0` would change type.
    """
    if isinstance(value, tuple):
        return "[" + ", ".join(parameter_text(each) for each in value) + "]"
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False)
    if isinstance(value, float):
        if math.isnan(value):
            return ".nan"
        if math.isinf(value):
            return ".inf" if value > 0 else "-.inf"
    return repr(value)
