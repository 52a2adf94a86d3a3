"""Hosts of a plan: machines by address, ports that are given out, discovery addresses.

Owns: `Hosts`, `PortPool`; `Contact`, where a participant's discovery is reached (static peers),
read out of connection URLs, and `reached_hosts`, where multicast alone may not reach every
participant. Machines of one address are one host, and so are those without one, which mean this
host. Ports are given out in a fixed order, so that equal plans have equal ports. Pure.
"""

from __future__ import annotations

import ipaddress
import itertools
from collections.abc import Collection, Iterable, Mapping, Sequence

import msgspec

from lifecycle.manifest.model import DiscoveryMode, DiscoveryRange, Machine
from lifecycle.network.connection_url import ConnectionUrl, Peer, parse
from lifecycle.network.medium import LOOPBACK, LOOPBACK6, RMW_DISCOVERY, Medium
from lifecycle.network.ports import MAX_PORT
from lifecycle.plan.model import Plan, PlanError


class Hosts(msgspec.Struct, frozen=True, kw_only=True):
    """The hosts of a system. A host is known by its address; this host's is empty if not declared.

    Attributes:
        machines: all that are declared.
        used: hosts that run something, in the order in which nodes name them.
    """

    machines: tuple[Machine, ...]
    used: tuple[str, ...]

    @classmethod
    def of(cls, machines: Sequence[Machine], names: Iterable[str]) -> Hosts:
        """Return the hosts of a system; `names` are the machines that something runs on."""
        addresses = {each.name: each.address for each in machines}
        return cls(
            machines=tuple(machines),
            used=tuple(dict.fromkeys(addresses.get(name, "") for name in names)),
        )

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

    def address(self, host: str, *, ipv6: bool = False) -> str:
        """Return what others reach a host by; loopback, of IPv6 if asked for, of the only host.

        Raises:
            PlanError: the host has no address, and others are to reach it.
        """
        if host or not self.several:
            return host or (LOOPBACK6 if ipv6 else LOOPBACK)
        names = ", ".join(map(repr, self.names(""))) or "this host"
        raise PlanError(
            f"cannot give fixed ports to machine {names}: it has no address, and others must reach "
            "it",
            hint="add 'address:' to it under 'machines:'",
            at=next((each.at for each in self.machines if not each.address), None),
        )


class PortPool:
    """Ports that are still free on each host, UDP and TCP alike.

    Args:
        first: the lowest that is given out, 1–65535.
        taken: by host, what is not given out.
    """

    def __init__(self, first: int, taken: Mapping[str, Iterable[int]] | None = None) -> None:
        self._first = first
        self._taken = {host: set(ports) for host, ports in (taken or {}).items()}
        self._lowest: dict[str, int] = {}  # from `first` to below it, all of a host's are taken

    def take(self, host: str, count: int = 1) -> tuple[int, ...]:
        """Give out the lowest free ports of a host.

        Raises:
            PlanError: there are none left.
        """
        taken = self._taken.setdefault(host, set())
        every = range(self._lowest.get(host, self._first), MAX_PORT + 1)
        found = tuple(itertools.islice((port for port in every if port not in taken), count))
        if len(found) < count:
            what = f"cannot give out {count} more ports{f' on {host}' if host else ''}"
            raise PlanError(
                f"{what}: from {self._first} to {MAX_PORT} all are taken"
                if self._first <= MAX_PORT
                else f"{what}: they would begin at {self._first}, and the highest is {MAX_PORT}",
                hint="lower 'discovery.first_port'",
            )
        taken.update(found)
        self._lowest[host] = max(found, default=self._first - 1) + 1
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
    IPv6 hosts are found by multicast only: rmw_fastrtps resolves no IPv6 address of a peer.

    Args:
        plan: the system.
        own: machines that are this host.

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
