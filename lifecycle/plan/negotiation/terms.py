"""What a plan gives to a negotiation, before anything runs and while it does.

Owns: `terms_of` and `Terms` of a plan in the making: ports that are taken, groups, observers. Pure.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from lifecycle.manifest.model import DataLayer, Discovery, DiscoveryMode
from lifecycle.network.connection_url import Peer, parse
from lifecycle.network.ports import DG, domain_base
from lifecycle.plan.connections.contacts import contacts_of, ports_of
from lifecycle.plan.connections.control import is_fixed
from lifecycle.plan.connections.hosts import Hosts
from lifecycle.plan.model import ParticipantConnections, Plan, PlannedNode, PlannedServer
from lifecycle.plan.negotiation.data_layer import Terms

Observers = Sequence[tuple[str, ParticipantConnections]]


def hosts_of(plan: Plan) -> Hosts:
    """Return the hosts of a plan."""
    machines = [node.machine for node in plan.nodes]
    if plan.server is not None:
        machines.append(plan.server.machine)
    return Hosts.of(plan.machines, machines)


def terms_of(plan: Plan) -> Terms:
    """Return what the nodes of a running plan can negotiate under."""
    hosts = hosts_of(plan)
    observers = {hosts.host(machine): each for machine, each in plan.observers}
    return make_terms(
        plan.discovery,
        plan.data_layer,
        plan.nodes,
        hosts,
        observers=tuple(observers.items()),
        server=plan.server,
        domain_id=plan.domain_id,
        max_datagram_bytes=plan.max_datagram_bytes,
    )


def make_terms(
    discovery: Discovery,
    data_layer: DataLayer,
    nodes: Sequence[PlannedNode],
    hosts: Hosts,
    *,
    observers: Observers,
    server: PlannedServer | None,
    domain_id: int,
    max_datagram_bytes: int | None,
) -> Terms:
    """Return the terms of a plan's parts.

    Args:
        discovery: as declared.
        data_layer: as declared.
        nodes: with the connections that they have whatever is negotiated.
        hosts: of the system.
        observers: (host, how its supervisor's own participant is connected).
        server: the discovery server; None without.
        domain_id: 0–232.
        max_datagram_bytes: UDP payload that the path carries unfragmented; None assumes Ethernet.
    """
    taken = written_ports(nodes, hosts, discovery, domain_id=domain_id)
    for host, each in observers:
        taken.setdefault(host, set()).update(ports_of(parse(text) for text in each.urls))
    if server is not None:
        taken.setdefault(hosts.host(server.machine), set()).add(server.port)
    return Terms(
        fixed=is_fixed(discovery),
        server=None if server is None else Peer(address=server.address, port=server.port),
        server_tcp=server is None or server.tcp,
        first_port=discovery.first_port,
        taken=tuple((host, tuple(sorted(ports))) for host, ports in sorted(taken.items())),
        multicast_group=data_layer.multicast_group,
        max_datagram_bytes=max_datagram_bytes,
        observers=tuple(
            contact for host, each in observers for contact in contacts_of(host, each.urls)
        ),
    )


def written_ports(
    nodes: Sequence[PlannedNode], hosts: Hosts, discovery: Discovery, *, domain_id: int
) -> dict[str, set[int]]:
    """Return the ports of each host that URLs name, and those that a domain uses by itself."""
    base = domain_base(domain_id)
    domain = set(range(base, base + DG)) if discovery.mode is DiscoveryMode.DYNAMIC else set()
    taken: dict[str, set[int]] = {host: set(domain) for host in hosts.used}
    for node in nodes:
        ports = taken.setdefault(hosts.host(node.machine), set())
        ports.update(ports_of(parse(text) for text in urls_of(node)))
    return taken


def urls_of(node: PlannedNode) -> Iterable[str]:
    """Return every connection URL of a node: its own participant's and all others'."""
    yield from node.connections.urls
    for each in node.participants:
        yield from each.connections.urls
