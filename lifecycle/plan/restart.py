"""Restart nodes while others keep running: new TCP ports and peers for their participants.

Owns: `restarted`, `moved_observer`, `moving_nodes` and `is_restarted_url`. Pure.

Fast DDS 2.14 keeps an accepted TCP connection under the listening port that its dialler names, also
once that one is gone, and takes no other in its place: a participant that returns on the same port
and dials is not found by those that stayed (eProsima/Fast-DDS#1914). One that was dialled is
dialled again. So a participant that looks for others returns on a port that it never had, and looks
for all of its partners that stayed: none of them can know that port.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from types import MappingProxyType

from lifecycle import dataclasses
from lifecycle.network.connection_url import ConnectionUrl, Peer, parse
from lifecycle.plan.connections.hosts import PortPool, contacts_of
from lifecycle.plan.model import ParticipantConnections, Plan, PlanError, PlannedNode
from lifecycle.plan.negotiation.parties import hosts_of, terms_of

RESTART_PORTS_FROM = 2000
"""How far above `first_port` the ports of restarted participants begin: out of the way of ports
that are negotiated while a system runs, and of groups' (negotiate.GROUP_PORTS_FROM)."""

OBSERVER_PORTS_FROM = 3000
"""Likewise, of observers that a discovery server did not accept."""

Reported = Mapping[str, Mapping[str, tuple[str, ...]]]
"""What nodes report as their connections: full node name → connection, empty for the node's own
participant → URLs."""

_LAST_PORT = 65535
_NOTHING: Reported = MappingProxyType({})

_Place = tuple[str, str]
"""A participant: key of its node and base name of the hidden node; for nodes' own participant,
their process and ""; for an observer, "" and its machine."""


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class _Listener:
    """One participant with a TCP port. `url` is the one of its URLs with that port."""

    host: str
    url: ConnectionUrl

    @property
    def peer(self) -> Peer:
        """Where it is dialled."""
        return contacts_of(self.host, (str(self.url),))[0].peer

    @property
    def moves(self) -> bool:
        """Whether it needs another port when it returns: it is not only dialled."""
        return bool(self.url.peers or self.url.server)


def restarted(
    plan: Plan, keys: Collection[str], *, first: Plan, reported: Reported = _NOTHING
) -> Plan:
    """Return the plan as it is once these nodes are started again.

    Args:
        plan: as the system runs.
        keys: of all nodes of the processes that are started again.
        first: the plan before anything was started again.
        reported: what the nodes of other supervisors report, which restart them without notice.

    Raises:
        PlanError: a host has no ports left.
    """
    original, current = _listeners(first), _listeners(plan, reported)
    processes = {node.process for node in first.nodes if node.key in keys}
    own = {place for place in original if not place[1] and place[0] in processes}
    new = {
        place: dataclasses.replace(each, url=_on_next_port(first, original, place, current[place]))
        for place, each in original.items()
        if (place in own or place[0] in keys) and each.moves
    }
    reached = {**current, **new}
    urls = {
        place: str(dataclasses.replace(each.url, peers=_peers(place, original, reached, set(new))))
        for place, each in new.items()
    }
    return dataclasses.replace(
        plan, nodes=tuple(_moved(node, urls) if node.key in keys else node for node in plan.nodes)
    )


def moved_observer(
    plan: Plan, connections: ParticipantConnections, number: int
) -> ParticipantConnections:
    """Return how an observer is connected on a TCP port that it never had.

    Only a discovery server need know that port.

    Args:
        plan: of its system.
        connections: how it was planned.
        number: of the try, from 0.

    Raises:
        PlanError: there is no such port.
    """
    port = plan.discovery.first_port + OBSERVER_PORTS_FROM + number
    if port > _LAST_PORT:
        raise PlanError(
            f"cannot give the supervisor's participant port {port}: the highest is {_LAST_PORT}",
            hint="lower 'discovery.first_port'",
        )
    urls = tuple(
        str(dataclasses.replace(url, port=port))
        if url.transport.is_tcp and url.port is not None
        else str(url)
        for url in map(parse, connections.urls)
    )
    return dataclasses.replace(connections, urls=urls)


def moving_nodes(plan: Plan) -> frozenset[str]:
    """Return the keys of the nodes that get TCP ports of their own when they are started again."""
    places = {place for place, each in _listeners(plan).items() if place[0] and each.moves}
    return frozenset(
        node.key
        for node in plan.nodes
        if (node.process, "") in places
        or any((node.key, each.name) in places for each in node.participants)
    )


def is_restarted_url(planned: str, reported: str, *, first_port: int) -> bool:
    """Whether a participant that was planned with one URL has the other because of a restart.

    Another host's supervisor restarts its nodes without notice, and to an observing command so
    does ours. Which peers there were then cannot be known afterwards.

    Args:
        planned: a connection URL.
        reported: likewise.
        first_port: first of the ports that the plan gives out.

    Raises:
        ConnectionUrlError: one of them is none.
    """
    was, now = parse(planned), parse(reported)
    if not was.transport.is_tcp or not (was.peers or was.server):
        return False
    if was.port is None or now.port is None or now.port < first_port + RESTART_PORTS_FROM:
        return False
    return dataclasses.replace(now, port=was.port, peers=was.peers) == was


def _listeners(plan: Plan, reported: Reported = _NOTHING) -> dict[_Place, _Listener]:
    """Return every participant with a TCP port, in plan order, observers first."""
    hosts = hosts_of(plan)
    found: dict[_Place, _Listener] = {}
    for machine, connections in plan.observers:
        for url in _with_port(connections.urls):
            found["", machine] = _Listener(host=hosts.host(machine), url=url)
    for node in plan.nodes:
        said = reported.get(node.full_name, {})
        host = hosts.host(node.machine)
        for url in _with_port(said.get("") or node.connections.urls):
            found[node.process, ""] = _Listener(host=host, url=url)
        for each in node.participants:
            for url in _with_port(said.get(each.connection) or each.connections.urls):
                found[node.key, each.name] = _Listener(host=host, url=url)
    return found


def _with_port(urls: Collection[str]) -> Iterator[ConnectionUrl]:
    """Yield the URL with the TCP port; a participant has at most one."""
    for text in urls:
        url = parse(text)
        if url.transport.is_tcp and url.port is not None:
            yield url


def _on_next_port(
    first: Plan, original: Mapping[_Place, _Listener], place: _Place, now: _Listener
) -> ConnectionUrl:
    """Return the participant's URL on the next port of its own.

    Every participant of a host has one port of each round, whichever restarts it: supervisors that
    share a host need not ask each other.
    """
    listeners = [each for each in original if each[0] and original[each].host == now.host]
    taken = {host: set(ports) for host, ports in terms_of(first).taken}
    pool = PortPool(first.discovery.first_port + RESTART_PORTS_FROM, taken)
    mine = listeners.index(place)
    port = pool.take(now.host, len(listeners))[mine]
    if now.url.port != original[place].url.port:
        while port <= (now.url.port or 0):
            port = pool.take(now.host, len(listeners))[mine]
    return dataclasses.replace(now.url, port=port)


def _peers(
    place: _Place,
    original: Mapping[_Place, _Listener],
    reached: Mapping[_Place, _Listener],
    again: Collection[_Place],
) -> tuple[Peer, ...]:
    """Return whom a restarted participant looks for: as planned, but for those who stay."""
    mine = original[place]
    if mine.url.server:
        return ()
    found = set()
    for other, each in original.items():
        dials = each.peer in mine.url.peers
        is_dialled = mine.peer in each.url.peers
        if dials or (is_dialled and other not in again):
            found.add(reached[other].peer)
    unknown = {*mine.url.peers} - {each.peer for each in original.values()}
    return tuple(sorted(found | unknown))


def _moved(node: PlannedNode, urls: Mapping[_Place, str]) -> PlannedNode:
    """Return a node with the new URLs of its participants."""

    def moved(connections: ParticipantConnections, place: _Place) -> ParticipantConnections:
        if place not in urls:
            return connections
        return dataclasses.replace(
            connections,
            urls=tuple(
                urls[place] if [*_with_port((text,))] else text for text in connections.urls
            ),
        )

    return dataclasses.replace(
        node,
        connections=moved(node.connections, (node.process, "")),
        participants=tuple(
            dataclasses.replace(each, connections=moved(each.connections, (node.key, each.name)))
            for each in node.participants
        ),
    )
