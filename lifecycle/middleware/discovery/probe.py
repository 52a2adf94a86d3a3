"""Discovery probe: an announcement that makes every reachable DDS participant answer at once.

Owns: announcing a participant that does not exist, and having it forgotten; the participants that
answered; and which participants' discovery ports it is sent to, for the discovery settings in the
environment and for connection URLs. Shared memory, TCP and a discovery server cannot be probed, and
nothing is sent where the system's own discovery would send nothing. Must not import rclpy.

Why: Fast DDS 2.14 sends a new participant's first announcement before it listens, so an answer on
the same host is often lost, and the participant that answered stays quiet for its next 3 s: a gate
that opens meanwhile has not seen it. An announcement sent once we do listen, under a GUID prefix of
its own, is answered to our participant's port, and to a socket of ours that counts who answers.
"""

from __future__ import annotations

import atexit
import contextlib
import ipaddress
import socket
import struct
import threading
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from lifecycle import dataclasses
from lifecycle.errors import MiddlewareError
from lifecycle.middleware.discovery.messages import (
    announced_ports,
    announced_prefix,
    announcement,
    disposal,
    new_prefix,
)
from lifecycle.middleware.fastdds.participant_profile import (
    DISCOVERY_SERVER_VARIABLE,
    default_profile,
)
from lifecycle.middleware.fastdds.profiles import PROFILE_NAME
from lifecycle.middleware.fastdds.sockets import (
    OpenSocket,
    open_sockets,
    own_udp_ports,
    own_udp_socket,
    udp_sockets,
)
from lifecycle.middleware.fastdds.url_profile import (
    DISCOVERY_GROUP,
    UrlTransport,
    families,
    leaves_discovery_open,
)
from lifecycle.middleware.process.control import interface_addresses
from lifecycle.network.connection_url import ConnectionUrl, Peer
from lifecycle.network.medium import RMW_DISCOVERY, TRANSPORTS_VARIABLE, Medium
from lifecycle.network.ports import (
    DG,
    LOCALHOST_PEERS_RANGE,
    PARTICIPANTS_PER_DOMAIN,
    participant_ports,
    unicast_pairs,
)

RANGE_VARIABLE = "ROS_AUTOMATIC_DISCOVERY_RANGE"

_DISPOSED_S = 2.0
"""After so long an announced participant that does not exist is disposed of, or before, when its
process leaves the graph. Peers answer it late on a loaded machine, and not once it is gone.

They are not to look at its lease if that can be helped: Fast DDS 2.14 does so in a thread of its
own, and deadlocks if another one just unmatches a writer (its issue 6502).
"""
_LEASE_S = 10.0
"""For peers that receive no disposal: this process was killed, or the link was cut."""


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class ProbeTarget:
    """Where a probe is sent: the discovery port of one participant, or a multicast group.

    Attributes:
        address: IPv4 or IPv6.
        port: 1–65535, UDP.
        interface: name of the one by which a group is reached; empty otherwise.
    """

    address: str
    port: int
    interface: str = ""


class Probe:
    """One announcement and its answers; close it when they are not needed any more.

    Args:
        doors: where to send it, all IPv4 or all IPv6.
        addresses: own ones of that family, at which answers arrive.
        receiver_ports: UDP ports where our participant receives discovery, see `discovery_ports`.
        output_port: the fixed source port of all that our participant sends, if it has one. Then
            nothing may come from or go to any other: it is sent by the participant's own socket,
            and answers are not counted.

    Attributes:
        counts: whether `answered` lists the participants that answered.
    """

    def __init__(
        self,
        targets: Iterable[ProbeTarget],
        addresses: Iterable[str],
        receiver_ports: Iterable[int],
        *,
        output_port: int | None = None,
    ) -> None:
        self.counts = output_port is None
        self._output_port = output_port
        self._answers: dict[str, str] = {}
        self._named: set[int] = set()
        self._targets, self._addresses = tuple(targets), tuple(addresses)
        self._ipv6 = any(":" in target.address for target in self._targets)
        family = socket.AF_INET6 if self._ipv6 else socket.AF_INET
        self._socket: socket.socket | None = None
        self._receivers = tuple(receiver_ports)
        own: tuple[int, ...] = ()
        if output_port is not None:
            self._socket = own_udp_socket(family, output_port)
        else:
            self._socket = socket.socket(family, socket.SOCK_DGRAM)
            self._socket.bind(("", 0))  # answers arrive at every address we name
            own = (self._socket.getsockname()[1],)
        self._listeners = self.listeners_here() if self.counts else frozenset()
        self._send((*own, *self._receivers))
        if not self.counts:
            self.close()

    def silent(self) -> frozenset[int]:
        """Return the asked UDP ports of other processes on this host that no answer named so far.

        Only of those that were bound when this was made, and still are. Most likely a participant
        has it that got no CPU time yet, however long that takes.
        """
        if not self._listeners or self._socket is None:
            return frozenset()
        self.addresses()
        left = {each for each in self._listeners if each.port not in self._named}
        if left:
            left &= self.listeners_here()
        self._listeners = frozenset(left)
        return frozenset(each.port for each in left)

    def ask_silent(self) -> None:
        """Ask those on this host once more that did not answer, to be answered by them."""
        if (ports := self.silent()) and self._socket is not None:
            targets = (each for each in self._targets if each.port in ports)
            answered_at = ((each, self._socket.getsockname()[1]) for each in self._addresses)
            ask(self._socket, answered_at, targets)

    def ask_newcomers(self, newcomers: Iterable[OpenSocket]) -> None:
        """Ask everybody anew; those of this host are `silent` until they answer."""
        self.addresses()
        self._named = set()
        self._listeners = frozenset(newcomers)
        self.ask_again(to_count=True)

    @property
    def leaves_host(self) -> bool:
        """Whether it asks participants of other hosts, too."""
        own = frozenset(self._addresses)
        return any(target.address not in own for target in self._targets)

    def listeners_here(self) -> frozenset[OpenSocket]:
        """Return the sockets of other processes on this host that one of the targets is."""
        own = frozenset(self._addresses)
        asked: dict[int, set[str]] = {}
        for target in self._targets:
            if target.address in own:
                asked.setdefault(target.port, set()).add(target.address)
        if not asked:
            return frozenset()
        return frozenset(
            each
            for each in udp_sockets(of_others=True)
            if (at := asked.get(each.port))
            and (each.address in at or ipaddress.ip_address(each.address).is_unspecified)
        )

    def ask_again(self, *, to_count: bool) -> None:
        """Send one more announcement, of another participant that does not exist.

        Not every RMW answers to each address that an announcement has: Cyclone DDS chooses one, and
        does not announce itself again for 8 s and more.

        Args:
            to_count: it is answered to us alone, so that all addresses are known; else to
                our participant alone, so that it discovers those only counted so far.
        """
        if self._socket is not None:
            self._send((self._socket.getsockname()[1],) if to_count else self._receivers)

    def announce_ourselves(self, everybody: Iterable[tuple[str, int]]) -> None:
        """Have our own participant announce itself at once.

        One that is new announces itself before it listens, so that we know it at once, and it knows
        us with our next announcement, up to 0.2 s later (profiles.py). Our participant answers one
        that does not exist, and that nobody else is told of.

        Args:
            everybody: IP addresses and UDP ports at which it is heard.
        """
        if self._socket is not None:
            own = "::1" if self._ipv6 else "127.0.0.1"
            targets = (ProbeTarget(address=own, port=port) for port in self._receivers)
            ask(self._socket, everybody, targets, self._output_port)

    def _send(self, ports: Iterable[int]) -> None:
        if self._socket is None:
            return
        answered_at = [(a, p) for p in ports for a in self._addresses]
        ask(self._socket, answered_at, self._targets, self._output_port)

    def answered(self) -> frozenset[str]:
        """Return the GUID prefixes (24 hex digits) of all participants that answered so far."""
        return frozenset(self.addresses())

    def addresses(self) -> dict[str, str]:
        """Return the IP address from which each participant answered so far, by GUID prefix."""
        with contextlib.suppress(BlockingIOError):
            while self._socket is not None:
                data, source = self._socket.recvfrom(65536, socket.MSG_DONTWAIT)
                # What calls all sockets of this process, `introduce` say, calls this one, too.
                if prefix := announced_prefix(data):
                    self._answers[prefix] = source[0]
                    self._named |= announced_ports(data)
        return dict(self._answers)

    def close(self) -> None:
        """Receive no more answers."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None


ANSWER_S = 0.15
"""A participant that a probe reaches, on this host or the next one, answers within so long."""


class _Announced(NamedTuple):
    """A participant that does not exist, and by whom and to whom it was announced."""

    family: int
    targets: tuple[ProbeTarget, ...]
    output_port: int | None
    timer: threading.Timer


_announced: dict[str, _Announced] = {}
"""By GUID prefix, what this process announced and did not dispose of yet."""


def ask(
    sender: socket.socket,
    answered_at: Iterable[tuple[str, int]],
    targets: Iterable[ProbeTarget],
    output_port: int | None = None,
) -> None:
    """Announce a participant that does not exist, so that all who receive it answer.

    It is disposed of soon, and by `dispose_of_announced`.

    Args:
        sender: UDP, of the targets' family.
        answered_at: IP addresses and UDP ports to which they answer.
        targets: where to send it.
        output_port: source port, also of the disposal; None for any.
    """
    prefix, targets = new_prefix(), tuple(targets)
    if not targets:
        return
    timer = threading.Timer(_DISPOSED_S, _dispose, [prefix])
    timer.daemon = True
    _announced[prefix] = _Announced(sender.family, targets, output_port, timer)
    send(sender, announcement(prefix, answered_at, _LEASE_S), targets)
    with contextlib.suppress(RuntimeError):  # no thread is left: it is disposed of in the end
        timer.start()


def dispose_of_announced() -> None:
    """Say that no participant that this process announced by `ask` is there any more."""
    for each in tuple(_announced):
        _dispose(each)


atexit.register(dispose_of_announced)


def _dispose(prefix: str) -> None:
    if (announced := _announced.pop(prefix, None)) is None:
        return
    announced.timer.cancel()
    with contextlib.suppress(OSError):
        if (sender := sender_by(announced.family, announced.output_port)) is not None:
            with sender:
                send(sender, disposal(prefix), announced.targets)


def sender_by(family: int, output_port: int | None) -> socket.socket | None:
    """Return a UDP socket with this source port, the participant's own; None if that is closed.

    Where the plan says by which port a participant sends, nothing may come from another.
    """
    if output_port is None:
        return socket.socket(family, socket.SOCK_DGRAM)
    return own_udp_socket(family, output_port)


def send(sender: socket.socket, message: bytes, targets: Iterable[ProbeTarget]) -> None:
    """Send a datagram to each destination, without waiting.

    A full buffer or an interface without a route costs one listener, not the sender.
    """
    for target in targets:
        with contextlib.suppress(OSError):
            if target.interface:
                _send_by(sender, target.interface)
            sender.sendto(message, socket.MSG_DONTWAIT, (target.address, target.port))


def _send_by(sender: socket.socket, interface: str) -> None:
    index = socket.if_nametoindex(interface)
    if sender.family is socket.AF_INET6:
        sender.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_MULTICAST_IF, index)
        return
    chosen = struct.pack("=4s4si", bytes(4), bytes(4), index)  # struct ip_mreqn of ip(7)
    sender.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, chosen)


def discovery_ports(domain_id: int, kind: Medium = RMW_DISCOVERY) -> tuple[int, ...]:
    """Return the UDP ports of this process on which participants receive discovery.

    Read from the kernel, never inferred: a taken port moves a participant to another one.

    Args:
        domain_id: 0–232.
        kind: UDPV4 or UDPV6.
    """
    first = participant_ports(domain_id, 0).discovery_unicast
    last = participant_ports(domain_id, 0).discovery_multicast + DG
    ports = {each.port for each in open_sockets() if each.kind == kind}
    return tuple(sorted(p for p in ports if first <= p < last and (p - first) % 2 == 0))


PEERS_VARIABLE = "ROS_STATIC_PEERS"
_WITHOUT_SERVER = ("", "SIMPLE", "NONE")
_WITH_UDP = ("", "DEFAULT", "UDPV4", "LARGE_DATA")
_CHOICES = frozenset(
    {
        "userTransports",
        "builtinTransports",
        "discoveryProtocol",
        "initialPeersList",
        "metatrafficMulticastLocatorList",
        "metatrafficUnicastLocatorList",
        "avoid_builtin_multicast",
        "portBase",
        "domainIDGain",
        "participantIDGain",
        "offsetd0",
        "offsetd1",
    }
)
"""Elements of a participant profile that say where others are looked for, or by what."""


def probes_for(
    domain_id: int, urls: Sequence[ConnectionUrl], environment: Mapping[str, str]
) -> tuple[Probe, ...]:
    """Probe every participant that an observer with these URLs could find; close the result.

    Args:
        domain_id: 0–232.
        urls: the observer's; none for what the RMW does by itself. Its participant listens already.
        environment: where ROS_AUTOMATIC_DISCOVERY_RANGE is looked up, for URLs that leave discovery
            open. OFF probes nothing, SUBNET (the default) this host, by multicast, and those of
            ROS_STATIC_PEERS, everything else this host only.

    Returns:
        One per address family; none where probing is impossible.
    """
    found = families(urls)
    if not all(family.udp for family in found) or any(url.server for url in urls):
        return ()
    if not urls and (chosen_otherwise(environment) or connects_first(urls, environment)):
        return ()
    if urls and not leaves_discovery_open(urls):
        return tuple(_probe_peers(domain_id, family) for family in found)
    range_ = _range(environment)
    return tuple(
        _probe_around(domain_id, kind, range_, environment)
        for kind in (tuple(family.kind for family in found) or (RMW_DISCOVERY,))
    )


_CONNECTING = ("TCPv4", "TCPv6", "LARGE_DATA")


def connects_first(urls: Sequence[ConnectionUrl], environment: Mapping[str, str]) -> bool:
    """Return whether participants, once discovered, make TCP connections before they say more.

    So it is with LARGE_DATA, where the range does not choose other transports, and with a file of
    profiles that has TCP. An answer by UDP says nothing then of what a participant has, and that it
    tries to connect to one that does not exist delays it.
    """
    if urls:
        return False
    builtin = environment.get(TRANSPORTS_VARIABLE, "").upper()
    if builtin.startswith("LARGE_DATA") and _range(environment) != "LOCALHOST":
        return True
    with contextlib.suppress(MiddlewareError, OSError):  # as for `chosen_otherwise`
        profile = default_profile(environment)
        if profile is not None and profile.name != PROFILE_NAME:
            text = Path(profile.file).read_text(encoding="utf-8", errors="replace")
            return any(each in text for each in _CONNECTING)
    return False


def is_served(urls: Sequence[ConnectionUrl], environment: Mapping[str, str]) -> bool:
    """Return whether a participant of these URLs finds others by a discovery server."""
    if any(url.server for url in urls) or environment.get(DISCOVERY_SERVER_VARIABLE):
        return True
    with contextlib.suppress(MiddlewareError):  # as for `chosen_otherwise`
        profile = default_profile(environment)
        protocols = () if profile is None or urls else profile.element.iter("discoveryProtocol")
        return any((each.text or "").strip() not in _WITHOUT_SERVER for each in protocols)
    return False


def probe_targets(
    domain_id: int, urls: Sequence[ConnectionUrl], environment: Mapping[str, str]
) -> tuple[tuple[Medium, tuple[ProbeTarget, ...]], ...]:
    """Return the UDP destinations of all participants that an observer with these URLs could find.

    Args:
        domain_id: 0–232.
        urls: the observer's; none for what the RMW does by itself.
        environment: as for `probes_for`.

    Returns:
        UDPV4 or UDPV6 and the destinations of that family; nothing where discovery allows no UDP.
    """
    if any(url.server for url in urls) or (not urls and chosen_otherwise(environment)):
        return ()
    found = tuple(family for family in families(urls) if family.udp)
    if urls and not leaves_discovery_open(urls):
        return tuple(
            (family.kind, _targets_of_peers(domain_id, family, _bound(family))) for family in found
        )
    range_ = _range(environment)
    return tuple(
        (kind, _targets_around(domain_id, kind, range_, environment))
        for kind in (tuple(family.kind for family in found) or (() if urls else (RMW_DISCOVERY,)))
        if range_ != "OFF"
    )


def answered_at(
    domain_id: int, urls: Sequence[ConnectionUrl], environment: Mapping[str, str]
) -> tuple[tuple[str, int], ...]:
    """Return where one answer reaches all participants of this host that an observer could find.

    Args:
        domain_id: 0–232.
        urls: the observer's; none for what the RMW does by itself.
        environment: as for `probes_for`.

    Returns:
        IPv4 addresses and UDP ports; none where participants are told whom to look for.
    """
    kind = RMW_DISCOVERY
    if urls or chosen_otherwise(environment) or _range(environment) == "OFF":
        return ()
    if _range(environment) == "SUBNET":
        return ((DISCOVERY_GROUP[kind], participant_ports(domain_id, 0).discovery_multicast),)
    found = well_known_targets(domain_id, kind.loopback, LOCALHOST_PEERS_RANGE)
    return tuple((each.address, each.port) for each in found)


def missing_port(
    domain_id: int, urls: Sequence[ConnectionUrl], environment: Mapping[str, str]
) -> int | None:
    """Return the UDP port of the multicast by which participants find each other, if it is missing.

    Fast DDS shares that port with other participants. If another kind of socket has it, no
    participant of this host receives announcements, and none of them finds another; Fast DDS 2.14
    says nothing.

    Args:
        domain_id: of a participant of this process.
        urls: its own.
        environment: as for `probes_for`.

    Returns:
        None if this process has it, or participants look for each other elsewhere, too.
    """
    if static_peers(environment):
        return None
    for address, port in answered_at(domain_id, urls, environment):
        if ipaddress.ip_address(address).is_multicast and port not in own_udp_ports():
            return port if any(each.port == port for each in udp_sockets()) else None
    return None


def _range(environment: Mapping[str, str]) -> str:
    return environment.get(RANGE_VARIABLE, "").upper() or "SUBNET"


def chosen_otherwise(environment: Mapping[str, str]) -> bool:
    """Whether the user's own settings of Fast DDS say how participants without URLs are found.

    A discovery server, transports, or where to look for others: then nothing may be probed over
    UDP, which those settings may have ruled out.
    """
    if environment.get(DISCOVERY_SERVER_VARIABLE) or not _has_udpv4(environment):
        return True
    try:
        profile = default_profile(environment)
    except MiddlewareError:  # Fast DDS cannot read it either, and takes its defaults
        return False
    if profile is None or profile.name == PROFILE_NAME:  # ours adds to the default
        return False
    return any(each.tag in _CHOICES for each in profile.element.iter())


def _has_udpv4(environment: Mapping[str, str]) -> bool:
    builtin = environment.get(TRANSPORTS_VARIABLE, "").partition("?")[0].upper()
    return builtin in _WITH_UDP


def static_peers(environment: Mapping[str, str]) -> tuple[str, ...]:
    """Return the addresses among ROS_STATIC_PEERS; a name would have to be looked up."""
    found = []
    for text in environment.get(PEERS_VARIABLE, "").split(";"):
        with contextlib.suppress(ValueError):
            found.append(str(ipaddress.ip_address(text.strip())))
    return tuple(found)


def peers_environment(hosts: Iterable[str], environment: Mapping[str, str]) -> Mapping[str, str]:
    """Return ROS_STATIC_PEERS with these hosts beside those of the user's; rmw reads it.

    It looks at the first four participants of each, and only with the range SUBNET. Participants
    without UDP over IPv4 would look for no others then, so where the user's settings take it
    away, nothing is added.

    Args:
        hosts: IPv4 addresses.
        environment: what it is now.
    """
    if environment.get(DISCOVERY_SERVER_VARIABLE) or not _has_udpv4(environment):
        return {}
    given = [each.strip() for each in environment.get(PEERS_VARIABLE, "").split(";")]
    every = dict.fromkeys([*filter(None, given), *hosts])
    return {PEERS_VARIABLE: ";".join(every)} if every else {}


def discovery_peers(
    domain_id: int, hosts: Mapping[str, int], environment: Mapping[str, str]
) -> tuple[tuple[str, int], ...]:
    """Return where participants of these hosts are looked for, beside multicast.

    Args:
        domain_id: 0–232.
        hosts: by IP address, how many participants may be there.
        environment: where settings of Fast DDS are looked up.

    Returns:
        Address and UDP port, the groups of multicast among them; nothing without hosts, or where
        the user's own settings say how others are found.
    """
    if not hosts or chosen_otherwise(environment):
        return ()
    found = [
        (target.address, target.port)
        for host, count in hosts.items()
        for target in well_known_targets(domain_id, host, min(count, LOCALHOST_PEERS_RANGE))
    ]
    group = participant_ports(domain_id, 0).discovery_multicast
    return ((DISCOVERY_GROUP[RMW_DISCOVERY], group), *found)


def _probe_around(
    domain_id: int, kind: Medium, range_: str, environment: Mapping[str, str]
) -> Probe:
    if range_ == "OFF":
        return Probe((), (), ())
    targets = _targets_around(domain_id, kind, range_, environment)
    by_interface = addresses_of(kind) if range_ == "SUBNET" else {}
    addresses = (kind.loopback, *(each for found in by_interface.values() for each in found))
    return Probe(targets, addresses, discovery_ports(domain_id, kind))


def _targets_around(
    domain_id: int, kind: Medium, range_: str, environment: Mapping[str, str]
) -> tuple[ProbeTarget, ...]:
    """Return this host's ports, and with the range SUBNET the group and the static peers'."""
    targets = [*well_known_targets(domain_id, kind.loopback, PARTICIPANTS_PER_DOMAIN)]
    if range_ == "SUBNET":
        targets += group_targets(domain_id, kind, addresses_of(kind))
        for peer in static_peers(environment):
            if (":" in peer) == (kind.ip_version == 6):
                targets += well_known_targets(domain_id, peer, LOCALHOST_PEERS_RANGE)
    return tuple(targets)


def _bound(family: UrlTransport) -> dict[str, tuple[str, ...]]:
    """Return this host's addresses that a family of URLs is bound to, by interface."""
    here = addresses_of(family.kind, loopback=True)
    if family.interfaces:
        bound = set(family.interfaces)
        here = {
            name: addresses if name in bound else tuple(a for a in addresses if a in bound)
            for name, addresses in here.items()
        }
    return here


def _targets_of_peers(
    domain_id: int, family: UrlTransport, here: Mapping[str, tuple[str, ...]]
) -> tuple[ProbeTarget, ...]:
    targets = listed_targets(domain_id, family.peers, LOCALHOST_PEERS_RANGE)
    if all(url.multicast for url in family.urls):
        targets += group_targets(
            domain_id, family.kind, {n: each for n, each in here.items() if each}
        )
    return tuple(targets)


def _probe_peers(domain_id: int, family: UrlTransport) -> Probe:
    here = _bound(family)
    targets = _targets_of_peers(domain_id, family, here)
    addresses = tuple(each for found in here.values() for each in found)
    fixed = family.metatraffic_port
    receivers = (fixed,) if fixed else discovery_ports(domain_id, family.kind)
    return Probe(targets, addresses, receivers, output_port=family.output_port)


def listed_targets(domain_id: int, peers: Iterable[Peer], participants: int) -> list[ProbeTarget]:
    """Return where peers of URLs are: at their port, else at those of their first participants."""
    targets: list[ProbeTarget] = []
    for peer in peers:
        if peer.port is None:
            targets += well_known_targets(domain_id, peer.address, participants)
        else:
            targets.append(ProbeTarget(address=peer.address, port=peer.port))
    return targets


def well_known_targets(domain_id: int, address: str, participants: int) -> Iterator[ProbeTarget]:
    """Yield the discovery ports of a host's first participants (DDSI-RTPS 9.6.2.3)."""
    for port, _ in unicast_pairs(domain_id, participants):
        yield ProbeTarget(address=address, port=port)


def group_targets(domain_id: int, kind: Medium, interfaces: Iterable[str]) -> Iterator[ProbeTarget]:
    """Yield the group of discovery by each interface."""
    port = participant_ports(domain_id, 0).discovery_multicast
    for interface in interfaces:
        yield ProbeTarget(address=DISCOVERY_GROUP[kind], port=port, interface=interface)


def addresses_of(kind: Medium, *, loopback: bool = False) -> dict[str, tuple[str, ...]]:
    """Return this host's addresses of a family by interface; interfaces without one are left out.

    Link-local ones of IPv6 mean nothing to others without an interface of theirs.
    """
    found: dict[str, tuple[str, ...]] = {}
    for name, text in sorted(interface_addresses(kind.socket_family), key=lambda each: each[0]):
        each = ipaddress.ip_address(text)
        if (loopback or not each.is_loopback) and not (each.version == 6 and each.is_link_local):
            found[name] = (*found.get(name, ()), str(each))
    return found
