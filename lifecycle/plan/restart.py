"""Restart nodes while others keep running: new TCP ports and peers for their participants.

Owns: `restarted`, `moving_nodes` and `is_restarted_url`. Pure.

Fast DDS 2.14 keeps an accepted TCP connection under the listening port that its dialler names, also
once that one is gone, and takes no other in its place: a participant that returns on the same port
and dials is not found by those that stayed (eProsima/Fast-DDS#1914). One that was dialled is
dialled again. So a participant that looks for others returns on a port that it never had, and looks
for all of its partners that stayed: none of them can know that port.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from types import MappingProxyType

from msgspec.structs import replace

from lifecycle.network.connection_url import ConnectionUrl, ConnectionUrlError, Peer, parse
from lifecycle.plan.discovery import Hosts, PortPool, contacts_of
from lifecycle.plan.media import terms_of
from lifecycle.plan.model import ParticipantConnections, Plan

RESTART_PORTS_FROM = 2000
"""How far above `first_port` the ports of restarted participants begin: out of the way of ports
that are negotiated while a system runs, and of groups' (negotiate.GROUP_PORTS_FROM)."""

Reported = Mapping[str, Mapping[str, tuple[str, ...]]]
"""What nodes report as their connections: full node name → connection, empty for the node's own
participant → URLs."""

_NOTHING: Reported = MappingProxyType({})

_Place = tuple[str, str]
"""A participant: key of its node and base name of the hidden node; for nodes' own participant,
their process and ""; for an observer, "" and its machine."""


_Listener = tuple[str, ConnectionUrl]
"""A participant with a TCP port: its host, and the one of its URLs that has the port."""


def _peer(listener: _Listener) -> Peer:
    host, url = listener
    return contacts_of(host, (str(url),))[0].peer


def _moves(url: ConnectionUrl) -> bool:
    """Whether a participant needs another port when it returns: it is not only dialled."""
    return bool(url.peers or url.server)


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
    used: dict[str, int] = {}
    for host, url in current.values():
        used[host] = max(used.get(host, 0), url.port or 0)
    again: dict[_Place, _Listener] = {}
    for place, (host, url) in original.items():
        if (place[0] in (keys if place[1] else processes)) and _moves(url):
            lowest = max(used[host] + 1, first.discovery.first_port + RESTART_PORTS_FROM)
            (used[host],) = PortPool(lowest, terms_of(first).taken).take(host)
            again[place] = (host, replace(current[place][1], port=used[host]))
    reached = {place: _peer(each) for place, each in {**current, **again}.items()}
    urls = {}
    for place, (_, url) in again.items():
        peers = _peers(place, original, reached, again)
        urls[place] = str(replace(url, peers=peers))

    def moved(connections: ParticipantConnections, place: _Place) -> ParticipantConnections:
        if place not in urls:
            return connections
        texts = tuple(urls[place] if _has_port(parse(each)) else each for each in connections.urls)
        return replace(connections, urls=texts)

    return replace(
        plan,
        nodes=tuple(
            replace(
                node,
                connections=moved(node.connections, (node.process, "")),
                participants=tuple(
                    replace(each, connections=moved(each.connections, (node.key, each.name)))
                    for each in node.participants
                ),
            )
            if node.key in keys
            else node
            for node in plan.nodes
        ),
    )


def moving_nodes(plan: Plan) -> frozenset[str]:
    """Return the keys of the nodes that get TCP ports of their own when they are started again."""
    places = {place for place, (_, url) in _listeners(plan).items() if place[0] and _moves(url)}
    return frozenset(
        node.key
        for node in plan.nodes
        if (node.process, "") in places
        or any((node.key, each.name) in places for each in node.participants)
    )


def is_same_url(planned: str, reported: str, *, first_port: int) -> bool:
    """Whether a participant that was planned with one URL has it, or the other since a restart.

    Another host's supervisor restarts its nodes without notice, and to an observing command so
    does ours. Which peers there were then cannot be known afterwards. `first_port` is the first of
    the ports that the plan gives out.
    """
    try:
        was, now = parse(planned), parse(reported)
    except ConnectionUrlError:
        return planned == reported
    if was == now:
        return True
    if not was.transport.is_tcp or not _moves(was):
        return False
    if was.port is None or now.port is None or now.port < first_port + RESTART_PORTS_FROM:
        return False
    return replace(now, port=was.port, peers=was.peers) == was


def _has_port(url: ConnectionUrl) -> bool:
    return url.transport.is_tcp and url.port is not None


def _listeners(plan: Plan, reported: Reported = _NOTHING) -> dict[_Place, _Listener]:
    """Return every participant with a TCP port, in plan order, observers first."""
    hosts = Hosts.of(plan)
    found: dict[_Place, _Listener] = {}

    def listen(place: _Place, machine: str, urls: Iterable[str]) -> None:
        # A participant has at most one such URL.
        found.update(
            (place, (hosts.host(machine), url)) for url in map(parse, urls) if _has_port(url)
        )

    for machine, connections in plan.observers:
        listen(("", machine), machine, connections.urls)
    for node in plan.nodes:
        said = reported.get(node.full_name, {})
        listen((node.process, ""), node.machine, said.get("") or node.connections.urls)
        for each in node.participants:
            urls = said.get(each.connection) or each.connections.urls
            listen((node.key, each.name), node.machine, urls)
    return found


def _peers(
    place: _Place,
    original: Mapping[_Place, _Listener],
    reached: Mapping[_Place, Peer],
    again: Collection[_Place],
) -> tuple[Peer, ...]:
    """Return whom a restarted participant looks for: as planned, but for those who stay."""
    _, url = original[place]
    if url.server:
        return ()
    mine = _peer(original[place])
    planned = {other: _peer(each) for other, each in original.items()}
    found = {
        reached[other]
        for other, (_, each) in original.items()
        if planned[other] in url.peers or (mine in each.peers and other not in again)
    }
    return tuple(sorted(found | ({*url.peers} - {*planned.values()})))
