"""Plan the control plane: discovery transport, discovery server, URLs and ports of participants.

Owns: what `discovery:` results in: the transport of the control plane, the discovery server, and
for every own participant of a node the connection URLs with ports that are given out in the plan's
order (metatraffic, user data, source port; observers first, then processes, then extra
participants); and `connect_observers`, so that supervisors' own participants see what they must
judge. An observer is on the control plane like the nodes' own participants; for connections by
other transports it gets those as well, as far as one participant can have them: where ports are
fixed, not shared memory beside UDP. Pure.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TypeVar

import msgspec
from msgspec.structs import replace

from lifecycle.manifest.model import Discovery, DiscoveryMode, FlowTransport, RunKind
from lifecycle.network.connection_url import ConnectionUrl, Peer, parse
from lifecycle.network.medium import DEFAULT_TCP, LOOPBACK, RMW_DEFAULT, UDP_UNICAST, Medium, udp_to
from lifecycle.plan.connections.hosts import (
    Hosts,
    PortPool,
    contacts_of,
    fixed_url,
    peers_by,
)
from lifecycle.plan.model import (
    ParticipantConnections,
    PlannedNode,
    PlannedParticipant,
    PlannedServer,
)


class Control(msgspec.Struct, frozen=True, kw_only=True):
    """The control plane of a system.

    Attributes:
        transport: of own participants; ANY leaves it to the RMW.
        server: the discovery server, if there is one.
        observers: by host, how its observer is connected so far.
        observer_ports: by host, given out to its observer where it needs them: metatraffic, user
            data and source port of UDP, and a listening port of TCP.
    """

    transport: FlowTransport
    server: PlannedServer | None = None
    observers: Mapping[str, ParticipantConnections]
    observer_ports: Mapping[str, tuple[int, ...]]


_Slot = tuple[str, str, str]
"""A participant: what it is of ("observer", "process", "extra"), whose, and its own name."""


def control_transport(discovery: Discovery, hosts: Hosts) -> FlowTransport:
    """Return what own participants use: as declared, else what the mode needs.

    ANY leaves it to the RMW. With endpoints known without announcement, one host needs no more than
    shared memory for everything else.
    """
    if discovery.transport is not FlowTransport.ANY or discovery.mode is DiscoveryMode.DYNAMIC:
        return discovery.transport
    if discovery.mode is DiscoveryMode.SERVER:
        return FlowTransport(DEFAULT_TCP.value)
    if discovery.mode is DiscoveryMode.STATIC_ENDPOINTS and not hosts.several:
        return FlowTransport.SHM
    return FlowTransport(udp_to("".join(hosts.used)).value)


def is_fixed(discovery: Discovery) -> bool:
    """Whether participants have planned ports and find only planned peers."""
    return discovery.mode in (DiscoveryMode.STATIC, DiscoveryMode.STATIC_ENDPOINTS)


def connect_control(
    nodes: Sequence[PlannedNode], discovery: Discovery, hosts: Hosts, pool: PortPool
) -> tuple[tuple[PlannedNode, ...], Control]:
    """Connect own participants, extra ones without connection, and observers.

    A participant of a declared connection has its URLs already and is left alone, and so are all
    extra ones where endpoints are static: they carry data and become connections (`place_static`).

    Returns:
        The nodes with `connections` filled in, and what the rest of the plan must know.

    Raises:
        PlanError: a host has no address, or too few ports.
    """
    transport = control_transport(discovery, hosts)
    server = None
    if discovery.mode is DiscoveryMode.SERVER:
        tcp = transport.medium is not None and transport.medium.is_tcp
        server = _server(discovery, hosts, pool, tcp=tcp)
    ports = {host: pool.take(host, 4) for host in hosts.used}
    control = Control(
        transport=transport,
        server=server,
        observers=dict.fromkeys(hosts.used, ParticipantConnections()),
        observer_ports=ports,
    )
    if transport is FlowTransport.ANY:
        return tuple(nodes), control
    (kind,) = transport.media
    planned = discovery.mode is not DiscoveryMode.DYNAMIC and kind.is_network
    extra = discovery.mode is not DiscoveryMode.STATIC_ENDPOINTS
    slots: dict[_Slot, tuple[str, tuple[int, ...]]] = {
        ("observer", host, ""): (host, taken[3:] if kind.is_tcp else taken[:3])
        for host, taken in ports.items()
    }
    ours = [node for node in nodes if node.run.kind is RunKind.PYTHON]
    wanted = [(("process", node.process, ""), node.machine) for node in ours]
    wanted += [
        (("extra", node.key, each.name), node.machine)
        for node in ours
        for each in node.participants
        if extra and not each.connections.urls
    ]
    for slot, machine in wanted:
        if slot not in slots:
            host = hosts.host(machine)
            slots[slot] = (host, pool.take(host, kind.ports) if planned else ())
    urls = dict.fromkeys(slots, str(ConnectionUrl(transport=kind)))
    if planned:
        urls = meshed(slots, kind, hosts, server=server)

    def connected(slot: _Slot) -> ParticipantConnections:
        observes = server is not None and slot[0] == "observer"
        return ParticipantConnections(urls=(urls[slot],), super_client=observes)

    def participant(node: PlannedNode, each: PlannedParticipant) -> PlannedParticipant:
        slot = ("extra", node.key, each.name)
        if slot not in slots:
            return each
        return replace(each, transports=(), connections=connected(slot))

    return tuple(
        replace(
            node,
            transports=(),  # the URLs say so
            connections=connected(("process", node.process, "")),
            participants=tuple(participant(node, each) for each in node.participants),
        )
        if node.run.kind is RunKind.PYTHON
        else node
        for node in nodes
    ), replace(control, observers={host: connected(("observer", host, "")) for host in hosts.used})


def _server(discovery: Discovery, hosts: Hosts, pool: PortPool, *, tcp: bool) -> PlannedServer:
    machine = discovery.server_machine or next((each.name for each in hosts.machines), "")
    host = hosts.host(machine)
    return PlannedServer(
        machine=machine,
        address=hosts.address(host),
        port=pool.take(host)[0],
        tcp=tcp,
    )


_Key = TypeVar("_Key")


def meshed(
    ports: Mapping[_Key, tuple[str, tuple[int, ...]]],
    kind: Medium,
    hosts: Hosts,
    *,
    server: PlannedServer | None = None,
) -> dict[_Key, str]:
    """Return the URLs of participants that find each other at fixed ports.

    Args:
        ports: of each participant its host, and its ports as `fixed_url` takes them.
        kind: what all of them are connected by.
        hosts: of the system.
        server: by which they find each other; None: each looks for all others.

    Raises:
        PlanError: a host has no address.
    """
    v6 = kind.ip_version == 6
    alone = {
        key: fixed_url(kind, hosts.address(host, ipv6=v6), taken)
        for key, (host, taken) in ports.items()
    }
    if server is not None:
        at = (Peer(address=server.address, port=server.port),)
        return {key: str(replace(url, server=at, multicast=True)) for key, url in alone.items()}
    contacts = [contacts_of(ports[key][0], (str(url),))[0].peer for key, url in alone.items()]
    found = {}
    for index, (key, url) in enumerate(alone.items()):
        # Two ends that dial each other refuse both connections (Fast DDS 2.14). Observers are
        # first, so that they are there when dialled.
        later = [] if kind.is_tcp else contacts[index + 1 :]
        found[key] = str(replace(url, peers=tuple(sorted([*contacts[:index], *later]))))
    return found


def with_tcp(control: Control, hosts: Hosts) -> dict[str, ParticipantConnections]:
    """Return the observers as they are if they must also be found by TCP, by host."""
    return {
        host: replace(each, urls=tuple(map(str, _with_tcp(each, control, host, hosts))))
        for host, each in control.observers.items()
    }


def connect_observers(
    nodes: Sequence[PlannedNode],
    hosts: Hosts,
    control: Control,
    *,
    fixed: bool,
    may_use_tcp: bool = False,
) -> dict[str, ParticipantConnections]:
    """Return how the observer of each host is connected; nothing where the RMW may connect it.

    Args:
        nodes: with all their connections.
        hosts: of the system.
        control: what own participants have.
        fixed: nothing is found by multicast.
        may_use_tcp: connections that are not planned may use TCP.
    """
    urls = [
        (hosts.host(node.machine), parse(text))
        for node in nodes
        for each in node.participants
        if each.connection and not each.connections.static_participants
        for text in each.connections.urls
    ]
    kinds = {url.transport.unicast for _, url in urls if url.transport.is_network}
    if may_use_tcp:
        kinds.add(DEFAULT_TCP)
    if fixed:
        kinds = {each for each in kinds if each.is_tcp}
    # A peer found by multicast, or that looks for the observer, need not be looked for.
    ours = {
        contact.peer
        for host, each in with_tcp(control, hosts).items()
        for contact in contacts_of(host, each.urls)
    }
    contacts = [
        contact
        for host, url in urls
        if (not url.multicast or url.transport.is_tcp) and not ours & {*url.peers}
        for contact in contacts_of(host, (str(url),))
    ]

    def connected(host: str, base: ParticipantConnections) -> ParticipantConnections:
        known = {contact.peer for contact in contacts_of(host, base.urls)}
        wanted = [each for each in contacts if each.peer not in known]
        found = _base_urls(base)
        needed = kinds - {url.transport.unicast for url in found if url.transport.is_network}
        if any(each.is_tcp for each in needed):
            found = _with_tcp(base, control, host, hosts)
        found += [ConnectionUrl(transport=kind) for kind in UDP_UNICAST if kind in needed]
        new = [{*peers_by(url.transport, wanted, host=host)} - {*url.peers} for url in found]
        if not needed and not any(new):
            return base
        return replace(
            base,
            urls=tuple(
                str(replace(url, peers=(*url.peers, *sorted(peers))))
                for url, peers in zip(found, new, strict=True)
            ),
        )

    observers = control.observers
    if control.server is None:  # else it announces everything to them
        observers = {host: connected(host, base) for host, base in observers.items()}
    return {host: each for host, each in observers.items() if each.urls}


def _base_urls(base: ParticipantConnections) -> list[ConnectionUrl]:
    """Return the URLs of an observer; where the RMW chooses, what it would choose."""
    return [parse(text) for text in base.urls] or [
        ConnectionUrl(transport=each) for each in RMW_DEFAULT
    ]


def _with_tcp(
    base: ParticipantConnections, control: Control, host: str, hosts: Hosts
) -> list[ConnectionUrl]:
    urls = _base_urls(base)
    if control.transport.medium and control.transport.medium.is_tcp:
        return urls
    # TCP is IPv4 here; where the host is declared by IPv6, only its own nodes can use it.
    address = LOOPBACK if ":" in host else hosts.address(host) if host or not hosts.several else ""
    port = control.observer_ports[host][3]
    return [*urls, ConnectionUrl(transport=DEFAULT_TCP, address=address, port=port)]


def participant_name(node_name: str, connection: str) -> str:
    """Return the base name of the hidden node that carries a connection, `_camera_net`."""
    return f"_{node_name}_{connection}"
