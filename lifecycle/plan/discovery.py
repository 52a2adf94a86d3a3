"""How participants find each other: hosts, ports that are given out, the control plane.

Ports are given out in a fixed order, so that equal plans have equal ports: observers, which are
supervisors' own participants, first, then processes, then extra participants. An observer is on the
control plane like the nodes' own participants; for connections by other transports it gets those as
well, as far as one participant can have them: where ports are fixed, not shared memory beside UDP.
Machines of one address are one host, and so are those without one, which mean this host. Pure.
"""

from __future__ import annotations

import ipaddress
import itertools
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from typing import TypeVar

import msgspec
from msgspec.structs import replace

from lifecycle.manifest.model import (
    Discovery,
    DiscoveryMode,
    DiscoveryRange,
    FlowTransport,
    Machine,
    RunKind,
)
from lifecycle.network.connection_url import ConnectionUrl, Peer, parse
from lifecycle.network.medium import (
    DEFAULT_TCP,
    LOOPBACK,
    RMW_DEFAULT,
    RMW_DISCOVERY,
    UDP_UNICAST,
    Medium,
    udp_to,
)
from lifecycle.network.ports import MAX_PORT
from lifecycle.plan.model import (
    ParticipantConnections,
    Plan,
    PlanError,
    PlannedNode,
    PlannedParticipant,
    PlannedServer,
)


class Hosts(msgspec.Struct, frozen=True, kw_only=True):
    """The hosts of a system. A host is known by its address; this host's is empty if not declared.

    Attributes:
        machines: all that are declared.
        used: hosts that run something, in the order in which nodes name them.
        server: the machine of the discovery server; empty without.
    """

    machines: tuple[Machine, ...]
    used: tuple[str, ...]
    server: str

    @classmethod
    def of(cls, plan: Plan) -> Hosts:
        """Return the hosts of a plan."""
        server, names = "", [node.machine for node in plan.nodes]
        if plan.discovery.mode is DiscoveryMode.SERVER:
            first = next((each.name for each in plan.machines), "")
            server = plan.discovery.server_machine or first
            names.append(server)
        used = dict.fromkeys(map(plan.address_of, names))
        return cls(machines=plan.machines, used=tuple(used), server=server)

    def host(self, machine: str) -> str:
        """Return the host of a machine; this host for one that is not declared."""
        return next((each.address for each in self.machines if each.name == machine), "")

    def names(self, host: str) -> tuple[str, ...]:
        """Return the machines that are this host."""
        return tuple(each.name for each in self.machines if each.address == host)

    @property
    def several(self) -> bool:
        """Whether the system runs on more than one host."""
        return len(self.used) > 1


class PortPool:
    """Ports, 1–65535, that are still free on each host, UDP and TCP alike."""

    def __init__(self, first: int, taken: Mapping[str, Iterable[int]] | None = None) -> None:
        self._first = first
        self._taken = {host: set(ports) for host, ports in (taken or {}).items()}
        self._left: dict[str, Iterator[int]] = {}  # those of a host that were not looked at yet

    def take(self, host: str, count: int = 1) -> tuple[int, ...]:
        """Give out the lowest free ports of a host.

        Raises:
            PlanError: there are none left.
        """
        taken = self._taken.setdefault(host, set())
        left = self._left.setdefault(host, iter(range(self._first, MAX_PORT + 1)))
        found = tuple(itertools.islice((port for port in left if port not in taken), count))
        if len(found) < count:
            what = f"cannot give out {count} more ports{f' on {host}' if host else ''}"
            raise PlanError(
                f"{what}: from {self._first} to {MAX_PORT} all are taken"
                if self._first <= MAX_PORT
                else f"{what}: they would begin at {self._first}, and the highest is {MAX_PORT}",
                hint="lower 'discovery.first_port'",
            )
        taken.update(found)
        return found

    def take_everywhere(self, hosts: Sequence[str], first: int) -> int:
        """Give out the lowest port from `first` on that is free on all of these hosts.

        Raises:
            PlanError: there is none left.
        """
        for port in range(first, MAX_PORT + 1):
            if not any(port in self._taken.get(host, ()) for host in hosts):
                self.reserve(hosts, port)
                return port
        raise PlanError(
            f"cannot give out one more port: from {first} to {MAX_PORT} all are taken",
            hint="lower 'discovery.first_port'",
        )

    def reserve(self, hosts: Iterable[str], port: int) -> None:
        """Take a port that was chosen elsewhere."""
        for host in hosts:
            self._taken.setdefault(host, set()).add(port)


_SPARE = 4
"""Participants of other systems and tools on a host, which take ports before or between ours."""


class Contact(msgspec.Struct, frozen=True, kw_only=True, order=True):
    """Where one participant's discovery is reached.

    Attributes:
        host: its host, see `Hosts`.
        transport: UDPV4, UDPV6 or TCPV4.
        peer: address and port, as `peer=` of a connection URL.
    """

    host: str
    transport: Medium
    peer: Peer


def contacts_of(host: str, urls: Iterable[str]) -> tuple[Contact, ...]:
    """Return where a participant with these URLs is reached; nothing where the RMW chooses."""
    found = []
    for url in map(parse, urls):
        port = url.port if url.transport.is_tcp else url.metatraffic_port
        # A group is for data; discovery listens on the interfaces.
        own = next(iter(url.interfaces), "") if url.transport.is_group else url.address
        if port is not None:
            peer = Peer(address=own or host or LOOPBACK, port=port)
            found.append(Contact(host=host, transport=url.transport.unicast, peer=peer))
    return tuple(found)


def ports_of(urls: Iterable[ConnectionUrl]) -> tuple[int, ...]:
    """Return the ports that a participant opens by these URLs, groups' left out."""
    return tuple(
        port
        for url in urls
        for port in (
            None if url.transport.is_group else url.port,
            url.metatraffic_port,
            url.output_port,
        )
        if port is not None
    )


def peers_by(transport: Medium, contacts: Iterable[Contact], *, host: str) -> tuple[Peer, ...]:
    """Return the peers that a URL of this transport, of this host, can look for, sorted.

    A group with TTL 0 reaches no other host.
    """
    found = {
        each.peer
        for each in contacts
        if each.transport == transport.unicast and (not transport.is_group or each.host == host)
    }
    return tuple(sorted(found))


def fixed_url(transport: Medium, address: str, ports: Sequence[int]) -> ConnectionUrl:
    """Return the URL of a participant that only its peers find, as yet without these.

    The ports are those for metatraffic, user data and sending of UDP, the listening port of TCP.
    """
    if transport.is_tcp:
        return ConnectionUrl(transport=transport, address=address, port=ports[0])
    metatraffic, user, output = ports
    return ConnectionUrl(
        transport=transport,
        address=address,
        port=user,
        metatraffic_port=metatraffic,
        output_port=output,
        multicast=False,
    )


def reached_hosts(plan: Plan, own: Collection[str]) -> Mapping[str, int]:
    """Return the other hosts of a system that are looked for by address, beside multicast.

    A router does not pass multicast. Where discovery finds any participant, beyond this host, the
    addresses of `machines:` are as good as ROS_STATIC_PEERS; other modes have their own peers.
    IPv6 hosts are found by multicast only: rmw_fastrtps resolves no IPv6 address of a peer. `own`
    are the machines that are this host.

    Returns:
        By IPv4 address, how many participants may be there: the supervisor, each process, each
        participant that the plan adds, and a few of others.
    """
    far = plan.discovery_range in (DiscoveryRange.SUBNET, DiscoveryRange.SYSTEM_DEFAULT)
    by_ipv4 = (plan.discovery.transport.medium or RMW_DISCOVERY) is RMW_DISCOVERY
    if plan.discovery.mode is not DiscoveryMode.DYNAMIC or not far or not by_ipv4:
        return {}
    hosts: dict[str, int] = {}
    for machine in plan.machines:
        if machine.name in own or not machine.address:
            continue
        address = ipaddress.ip_address(machine.address)
        nodes = [each for each in plan.nodes if each.machine == machine.name]
        if nodes and address.version == 4 and not address.is_loopback:
            count = len({each.process for each in nodes})
            count += sum(len(each.participants) for each in nodes)
            hosts[str(address)] = hosts.get(str(address), 1 + _SPARE) + count
    return hosts


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


Observers = Mapping[str, ParticipantConnections]
"""How supervisors' own participants are connected, by host."""


def connect_control(plan: Plan, hosts: Hosts, pool: PortPool) -> tuple[Plan, Observers]:
    """Connect own participants, extra ones without connection, observers and a discovery server.

    Observers are connected as if they must also be found by TCP; see `connect_observers`.

    A participant of a declared connection has its URLs already and is left alone, and so are all
    extra ones where endpoints are static: they carry data and become connections (`place_static`).

    Raises:
        PlanError: a host has too few ports.
    """
    discovery, server = plan.discovery, None
    transport = control_transport(discovery, hosts)
    if discovery.mode is DiscoveryMode.SERVER:
        tcp = transport.medium is not None and transport.medium.is_tcp
        at = hosts.host(hosts.server)
        server = PlannedServer(
            machine=hosts.server, address=at or LOOPBACK, port=pool.take(at)[0], tcp=tcp
        )
    # Of an observer: for metatraffic, user data and sending of UDP, and to listen at by TCP.
    ports = {host: pool.take(host, 4) for host in hosts.used}

    if transport is FlowTransport.ANY:
        return plan, {
            host: _with_tcp(ParticipantConnections(), host, taken[3], hosts)
            for host, taken in ports.items()
        }
    (kind,) = transport.media
    planned = discovery.mode is not DiscoveryMode.DYNAMIC and kind.is_network
    extra = discovery.mode is not DiscoveryMode.STATIC_ENDPOINTS
    slots: dict[_Slot, tuple[str, tuple[int, ...]]] = {
        ("observer", host, ""): (host, taken[3:] if kind.is_tcp else taken[:3])
        for host, taken in ports.items()
    }
    ours = [node for node in plan.nodes if node.run.kind is RunKind.PYTHON]
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
        urls = meshed(slots, kind, server=server)

    def connected(slot: _Slot) -> ParticipantConnections:
        observes = server is not None and slot[0] == "observer"
        return ParticipantConnections(urls=(urls[slot],), super_client=observes)

    def participant(node: PlannedNode, each: PlannedParticipant) -> PlannedParticipant:
        slot = ("extra", node.key, each.name)
        if slot not in slots:
            return each
        return replace(each, transports=(), connections=connected(slot))

    nodes = tuple(
        replace(
            node,
            transports=(),  # the URLs say so
            connections=connected(("process", node.process, "")),
            participants=tuple(participant(node, each) for each in node.participants),
        )
        if node.run.kind is RunKind.PYTHON
        else node
        for node in plan.nodes
    )
    return replace(plan, nodes=nodes, server=server), {
        host: _with_tcp(connected(("observer", host, "")), host, taken[3], hosts)
        for host, taken in ports.items()
    }


_Key = TypeVar("_Key")


def meshed(
    ports: Mapping[_Key, tuple[str, tuple[int, ...]]],
    kind: Medium,
    *,
    server: PlannedServer | None = None,
) -> dict[_Key, str]:
    """Return the URLs of participants that find each other at fixed ports.

    Args:
        ports: of each participant its host, and its ports as `fixed_url` takes them.
        kind: what all of them are connected by.
        server: by which they find each other; None: each looks for all others.
    """
    # Of several hosts each has an address (check.discovery-address).
    alone = {
        key: fixed_url(kind, host or kind.loopback, taken) for key, (host, taken) in ports.items()
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


def connect_observers(
    plan: Plan, hosts: Hosts, observers: Observers, *, may_use_tcp: bool
) -> dict[str, ParticipantConnections]:
    """Return how the observer of each host is connected; nothing where the RMW may connect it.

    The nodes have all their connections; `may_use_tcp`: those that are not planned may use TCP.
    """
    urls = [
        (hosts.host(node.machine), parse(text))
        for node in plan.nodes
        for each in node.participants
        if each.connection and not each.connections.static_participants
        for text in each.connections.urls
    ]
    kinds = {url.transport.unicast for _, url in urls if url.transport.is_network}
    if may_use_tcp:
        kinds.add(DEFAULT_TCP)
    if is_fixed(plan.discovery):
        kinds = {each for each in kinds if each.is_tcp}
    # A peer found by multicast, or that looks for the observer, need not be looked for.
    ours = {
        contact.peer for host, each in observers.items() for contact in contacts_of(host, each.urls)
    }
    contacts = [
        contact
        for host, url in urls
        if (not url.multicast or url.transport.is_tcp) and not ours & {*url.peers}
        for contact in contacts_of(host, (str(url),))
    ]
    control = control_transport(plan.discovery, hosts)
    by_tcp = control.medium is not None and control.medium.is_tcp

    def connected(host: str, base: ParticipantConnections) -> ParticipantConnections:
        found = [url for url in map(parse, base.urls) if by_tcp or not url.transport.is_tcp]
        own = tuple(map(str, found)) if control is not FlowTransport.ANY else ()
        known = {contact.peer for contact in contacts_of(host, own)}
        wanted = [each for each in contacts if each.peer not in known]
        needed = kinds - {url.transport.unicast for url in found if url.transport.is_network}
        if any(each.is_tcp for each in needed):
            found = [*map(parse, base.urls)]
        found += [ConnectionUrl(transport=kind) for kind in UDP_UNICAST if kind in needed]
        new = [{*peers_by(url.transport, wanted, host=host)} - {*url.peers} for url in found]
        if plan.server is not None or not (needed or any(new)):
            return replace(base, urls=own)
        return replace(
            base,
            urls=tuple(
                str(replace(url, peers=(*url.peers, *sorted(peers))))
                for url, peers in zip(found, new, strict=True)
            ),
        )

    found = {host: connected(host, base) for host, base in observers.items()}
    return {host: each for host, each in found.items() if each.urls}


def _with_tcp(
    base: ParticipantConnections, host: str, port: int, hosts: Hosts
) -> ParticipantConnections:
    # Where the RMW chooses, what it would choose.
    urls = [*map(parse, base.urls)] or [ConnectionUrl(transport=each) for each in RMW_DEFAULT]
    if not any(each.transport.is_tcp for each in urls):
        # TCP is IPv4 here; where the host is declared by IPv6, only its own nodes can use it.
        address = LOOPBACK if ":" in host or not (host or hosts.several) else host
        urls.append(ConnectionUrl(transport=DEFAULT_TCP, address=address, port=port))
    return replace(base, urls=tuple(map(str, urls)))
