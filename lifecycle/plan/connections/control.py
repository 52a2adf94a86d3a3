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

from collections.abc import Callable, Mapping, Sequence

from lifecycle import dataclasses
from lifecycle.manifest.model import Discovery, DiscoveryMode, FlowTransport, RunKind
from lifecycle.network.connection_url import ConnectionUrl, Peer, parse
from lifecycle.network.medium import DEFAULT_TCP, LOOPBACK, RMW_DEFAULT, UDP_UNICAST, Medium, udp_to
from lifecycle.plan.connections.hosts import (
    Contact,
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

DEFAULT_PREFIX = ConnectionUrl(transport=DEFAULT_TCP).server_prefix
_FIXED = (DiscoveryMode.STATIC, DiscoveryMode.STATIC_ENDPOINTS)


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Control:
    """The control plane of a system.

    Attributes:
        transport: of own participants; ANY leaves it to the RMW.
        server: the discovery server, if there is one.
        observers: how each host's observer is connected so far, (host, connections).
        observer_ports: given out to each host's observer where it needs them: metatraffic, user
            data and source port of UDP, and a listening port of TCP.
    """

    transport: FlowTransport
    server: PlannedServer | None = None
    observers: tuple[tuple[str, ParticipantConnections], ...] = ()
    observer_ports: tuple[tuple[str, tuple[int, ...]], ...] = ()


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
    return discovery.mode in _FIXED


def connect_control(
    nodes: Sequence[PlannedNode], discovery: Discovery, hosts: Hosts, pool: PortPool
) -> tuple[tuple[PlannedNode, ...], Control]:
    """Connect own participants, extra ones without connection, and observers.

    Args:
        nodes: of the whole system; a participant of a declared connection has its URLs
            already and is left alone, and so are all extra ones where endpoints are static: they
            carry data and become connections (`static_endpoints`).
        discovery: as declared.
        hosts: of the system.
        pool: what is left of each host's ports.

    Returns:
        The nodes with `connections` filled in, and what the rest of the plan must know.

    Raises:
        PlanError: a host has no address, or too few ports.
    """
    transport = control_transport(discovery, hosts)
    extra = discovery.mode is not DiscoveryMode.STATIC_ENDPOINTS
    server = None
    if discovery.mode is DiscoveryMode.SERVER:
        server = _server(
            discovery, hosts, pool, tcp=bool(transport.medium and transport.medium.is_tcp)
        )
    ports = tuple((host, pool.take(host, 4)) for host in hosts.used)
    control = Control(transport=transport, server=server, observer_ports=ports)
    if transport is FlowTransport.ANY:
        return tuple(nodes), control
    (kind,) = transport.media
    if discovery.mode is DiscoveryMode.DYNAMIC or not kind.is_network:
        same = ParticipantConnections(urls=(str(ConnectionUrl(transport=kind)),))
        connected = _connected(nodes, lambda _: same, lambda *_: same if extra else None)
        observers = tuple((host, same) for host in hosts.used)
        return connected, dataclasses.replace(control, observers=observers)
    return _with_ports(nodes, control, kind, hosts, pool, extra=extra)


def _server(discovery: Discovery, hosts: Hosts, pool: PortPool, *, tcp: bool) -> PlannedServer:
    machine = discovery.server_machine or next((each.name for each in hosts.machines), "")
    host = hosts.host(machine)
    return PlannedServer(
        machine=machine,
        address=hosts.address(host),
        port=pool.take(host)[0],
        tcp=tcp,
        prefix=DEFAULT_PREFIX,
    )


def _connected(
    nodes: Sequence[PlannedNode],
    own: Callable[[PlannedNode], ParticipantConnections],
    extra: Callable[[PlannedNode, PlannedParticipant], ParticipantConnections | None],
) -> tuple[PlannedNode, ...]:
    """Connect own participants of our nodes, and extra ones that something is given for.

    What is connected no longer has transports of its own.
    """

    def participant(node: PlannedNode, each: PlannedParticipant) -> PlannedParticipant:
        given = None if each.connections.urls else extra(node, each)
        return (
            each if given is None else dataclasses.replace(each, transports=(), connections=given)
        )

    return tuple(
        dataclasses.replace(
            node,
            transports=(),
            connections=own(node),
            participants=tuple(participant(node, each) for each in node.participants),
        )
        if node.run.kind is RunKind.PYTHON
        else node
        for node in nodes
    )


def _with_ports(
    nodes: Sequence[PlannedNode],
    control: Control,
    kind: Medium,
    hosts: Hosts,
    pool: PortPool,
    *,
    extra: bool,
) -> tuple[tuple[PlannedNode, ...], Control]:
    """Give each participant its own ports, and all the others as peers or the server."""
    count = kind.ports
    slots: dict[tuple[str, str, str], tuple[str, tuple[int, ...]]] = {}
    for host, ports in control.observer_ports:
        slots["observer", host, ""] = (host, ports[3:] if kind.is_tcp else ports[:3])
    ours = [node for node in nodes if node.run.kind is RunKind.PYTHON]
    for node in ours:
        key = ("process", node.process, "")
        host = hosts.host(node.machine)
        if key not in slots:
            slots[key] = (host, pool.take(host, count))
    for node in ours:
        for each in node.participants:
            if extra and not each.connections.urls:
                host = hosts.host(node.machine)
                slots["extra", node.key, each.name] = (host, pool.take(host, count))
    urls = _urls(slots, kind, control.server, hosts)

    def connected(key: tuple[str, str, str]) -> ParticipantConnections:
        return ParticipantConnections(
            urls=(urls[key],), super_client=control.server is not None and key[0] == "observer"
        )

    def of_extra(node: PlannedNode, each: PlannedParticipant) -> ParticipantConnections | None:
        key = ("extra", node.key, each.name)
        return connected(key) if key in slots else None

    connected_nodes = _connected(
        nodes, lambda node: connected(("process", node.process, "")), of_extra
    )
    observers = tuple((host, connected(("observer", host, ""))) for host in hosts.used)
    return connected_nodes, dataclasses.replace(control, observers=observers)


def _urls(
    slots: dict[tuple[str, str, str], tuple[str, tuple[int, ...]]],
    kind: Medium,
    server: PlannedServer | None,
    hosts: Hosts,
) -> dict[tuple[str, str, str], str]:
    """Spell each participant's URL."""
    v6 = kind.ip_version == 6
    alone = {
        key: fixed_url(kind, hosts.address(host, ipv6=v6), ports)
        for key, (host, ports) in slots.items()
    }
    if server is not None:
        at = (Peer(address=server.address, port=server.port),)
        return {
            key: str(dataclasses.replace(url, server=at, multicast=True))
            for key, url in alone.items()
        }
    contacts: dict[tuple[str, str, str], Contact] = {
        key: contacts_of(slots[key][0], (str(url),))[0] for key, url in alone.items()
    }
    order = {key: index for index, key in enumerate(alone)}

    def looks_for(key: tuple[str, str, str], other: tuple[str, str, str]) -> bool:
        # Two ends that dial each other refuse both connections (Fast DDS 2.14). Observers are
        # first, so that they are there when dialled.
        return order[other] < order[key] if kind.is_tcp else other != key

    return {
        key: str(
            dataclasses.replace(
                url,
                peers=tuple(
                    sorted(each.peer for other, each in contacts.items() if looks_for(key, other))
                ),
            )
        )
        for key, url in alone.items()
    }


def with_tcp(control: Control, hosts: Hosts) -> tuple[tuple[str, ParticipantConnections], ...]:
    """Return the observers as they are if they must also be found by TCP."""
    return tuple(
        (
            host,
            dataclasses.replace(base, urls=tuple(map(str, _with_tcp(base, control, host, hosts)))),
        )
        for host, base in _bases(control, hosts).items()
    )


def connect_observers(
    nodes: Sequence[PlannedNode],
    hosts: Hosts,
    control: Control,
    *,
    fixed: bool,
    may_use_tcp: bool = False,
) -> tuple[tuple[str, ParticipantConnections], ...]:
    """Return how the observer of each host is connected.

    Args:
        nodes: with all their connections.
        hosts: of the system.
        control: what own participants have.
        fixed: nothing is found by multicast.
        may_use_tcp: connections that are not planned may use TCP.

    Returns:
        (host, connections); nothing for a host whose observer the RMW may connect.
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
    # A peer found by multicast, or that looks for the observer, need not be looked for.
    ours = {
        contact.peer
        for host, each in with_tcp(control, hosts)
        for contact in contacts_of(host, each.urls)
    }
    contacts = [
        contact
        for host, url in urls
        if not url.multicast or url.transport.is_tcp
        if not ours & {*url.peers}
        for contact in contacts_of(host, (str(url),))
    ]
    if fixed:
        kinds = {each for each in kinds if each.is_tcp}
    found = (
        (host, _observer(host, base, kinds, contacts, control, hosts))
        for host, base in _bases(control, hosts).items()
    )
    return tuple((host, each) for host, each in found if each.urls)


def _bases(control: Control, hosts: Hosts) -> Mapping[str, ParticipantConnections]:
    known = dict(control.observers)
    return {host: known.get(host, ParticipantConnections()) for host in hosts.used}


def _observer(  # noqa: PLR0917 - all are needed, and it is called once
    host: str,
    base: ParticipantConnections,
    kinds: set[Medium],
    contacts: Sequence[Contact],
    control: Control,
    hosts: Hosts,
) -> ParticipantConnections:
    if control.server is not None:
        return base  # the server announces everything to it
    own = {contact.peer for contact in contacts_of(host, base.urls)}
    wanted = [each for each in contacts if each.peer not in own]
    urls = _base_urls(base)
    has = {url.transport.unicast for url in urls if url.transport.is_network}
    needed = kinds - has
    if not needed and not any(_peers(url, wanted, host) for url in urls):
        return base
    if any(each.is_tcp for each in needed):
        urls = _with_tcp(base, control, host, hosts)
    for kind in UDP_UNICAST:
        if kind in needed:
            urls.append(ConnectionUrl(transport=kind))
    return dataclasses.replace(base, urls=tuple(str(_meeting(url, wanted, host)) for url in urls))


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
    port = dict(control.observer_ports)[host][3]
    # TCP is IPv4 here; where the host is declared by IPv6, only its own nodes can use it.
    address = LOOPBACK if ":" in host else hosts.address(host) if host or not hosts.several else ""
    return [
        *urls,
        ConnectionUrl(transport=DEFAULT_TCP, address=address, port=port),
    ]


def _peers(url: ConnectionUrl, contacts: Sequence[Contact], host: str) -> tuple[Contact, ...]:
    known = set(peers_by(url.transport, contacts, host=host)) - {*url.peers}
    return tuple(each for each in contacts if each.peer in known)


def _meeting(url: ConnectionUrl, contacts: Sequence[Contact], host: str) -> ConnectionUrl:
    """Return a URL that also looks for these."""
    new = {each.peer for each in _peers(url, contacts, host)}
    return dataclasses.replace(url, peers=(*url.peers, *sorted(new)))


def participant_name(node_name: str, connection: str) -> str:
    """Return the base name of the hidden node that carries a connection, `_camera_net`."""
    return f"_{node_name}_{connection}"
