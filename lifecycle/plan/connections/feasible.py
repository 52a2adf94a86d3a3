"""What a wired plan asks of participants that they cannot do.

Owns: `infeasible`. Services and actions whose two ends have no transport in common, marks and ports
of their own where no UDP socket is. Topics are negotiated, which finds the like (`negotiate`); what
is negotiated while the system runs is judged there. Pure.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence

from lifecycle.manifest.diagnostics import Diagnostic, Position
from lifecycle.manifest.model import EndpointKind
from lifecycle.manifest.yaml.document import error
from lifecycle.network.dscp import describe
from lifecycle.network.nfe import UniqueRequirement
from lifecycle.plan.model import PlannedEndpoint, PlannedNode
from lifecycle.plan.negotiation.data_layer import Party
from lifecycle.plan.negotiation.media import carried
from lifecycle.plan.negotiation.parties import endpoint_of

_SERVERS = {
    EndpointKind.SERVICE_CLIENT: EndpointKind.SERVICE_SERVER,
    EndpointKind.ACTION_CLIENT: EndpointKind.ACTION_SERVER,
}
_WORDS = {EndpointKind.SERVICE_CLIENT: "service", EndpointKind.ACTION_CLIENT: "action"}
_NO_UDP = frozenset(("shm", "tcpv4"))

_End = tuple[PlannedNode, PlannedEndpoint]


def infeasible(
    nodes: Sequence[PlannedNode], parties: Mapping[str, Party], *, negotiated: bool
) -> tuple[Diagnostic, ...]:
    """Return what participants are asked for and cannot do.

    Args:
        nodes: with all connections that are planned.
        parties: the nodes as negotiation sees them, by key.
        negotiated: topics are where they will be; else only those on declared connections are.
    """
    carriers = _Carriers(parties)
    found = [*_services(nodes, parties, carriers)]
    for node in nodes:
        for each in node.endpoints:
            if negotiated or _on_connection(node, each):
                found += _without_udp(node, each, carriers(node, each))
    return tuple(found)


class _Carriers:
    """Knows by which transports an endpoint can be reached; nothing where nobody knows."""

    def __init__(self, parties: Mapping[str, Party]) -> None:
        self._parties = parties

    def __call__(self, node: PlannedNode, each: PlannedEndpoint) -> tuple[str, ...]:
        return endpoint_of(node, each).by or self._parties[node.key].own


_By = Callable[[PlannedNode, PlannedEndpoint], tuple[str, ...]]


def _on_connection(node: PlannedNode, each: PlannedEndpoint) -> bool:
    return any(one.name == each.participant and one.connection for one in node.participants)


def _at(node: PlannedNode, each: PlannedEndpoint) -> Position:
    return each.at or node.at


def _services(
    nodes: Sequence[PlannedNode], parties: Mapping[str, Party], carriers: _By
) -> Iterator[Diagnostic]:
    servers: dict[tuple[EndpointKind, str], list[_End]] = {}
    for node in nodes:
        for each in node.endpoints:
            servers.setdefault((each.kind, each.resolved), []).append((node, each))
    for node in nodes:
        for each in node.endpoints:
            wanted = _SERVERS.get(each.kind)
            if wanted is None:
                continue
            for other, server in servers.get((wanted, each.resolved), ()):
                mine, theirs = carriers(node, each), carriers(other, server)
                near = parties[node.key].host == parties[other.key].host
                if not mine or not theirs or carried(mine, theirs, same_host=near):
                    continue
                message = (
                    f"cannot call {_WORDS[each.kind]} {each.resolved!r} of {other.key!r} from "
                    f"{node.key!r}: the client's participant has {', '.join(mine)}, the server's "
                    f"{', '.join(theirs)}, and they are on {'one host' if near else 'two hosts'}"
                )
                hint = "map both ends onto connections that have a transport in common"
                yield error("plan.service-apart", _at(node, each), message, hint)


def _without_udp(
    node: PlannedNode, each: PlannedEndpoint, by: tuple[str, ...]
) -> Iterator[Diagnostic]:
    if not by or not {*by} <= _NO_UDP:
        return
    has = ", ".join(by)
    if each.dscp is not None and each.enforce_dscp:
        message = (
            f"cannot mark {each.kind.noun} {each.name!r} of {node.key!r} {describe(each.dscp)}: "
            f"its participant has {has}, and only UDP sockets can be marked"
        )
        hint = "use 'transport: udpv4', or remove the mark"
        yield error("plan.mark-without-udp", _at(node, each), message, hint)
    if (
        each.kind is EndpointKind.SUBSCRIPTION
        and each.unique is UniqueRequirement.STRICTLY_REQUIRED
    ):
        message = (
            f"cannot give subscription {each.name!r} of {node.key!r} a port of its own: its "
            f"participant has {has}, and only UDP has one port for each subscription"
        )
        hint = "use 'transport: udpv4', or remove 'unique'"
        yield error("plan.unique-without-udp", _at(node, each), message, hint)
