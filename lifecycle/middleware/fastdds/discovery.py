"""Where participants are looked for: by settings in the environment, by URLs, by a server.

Owns: which UDP ports a participant of this process asks in order to find others, and where it
cannot ask: over shared memory and TCP, behind a discovery server, and where the user's own settings
of Fast DDS choose transports or peers; the command line and environment of
`fast-discovery-server`, and whether one listens. Must not import rclpy.
"""

from __future__ import annotations

import contextlib
import ipaddress
import os
import shutil
import sysconfig
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from lifecycle.errors import MiddlewareError
from lifecycle.middleware.fastdds.profiles import (
    DISCOVERY_SERVER_VARIABLE,
    PEERS_VARIABLE,
    RANGE_VARIABLE,
    DefaultProfile,
    default_profile,
)
from lifecycle.middleware.fastdds.sockets import (
    interface_addresses,
    open_sockets,
    sockets_in,
    udp_sockets_of_others,
)
from lifecycle.middleware.fastdds.url_profile import (
    DISCOVERY_GROUP,
    UrlTransport,
    families,
    leaves_discovery_open,
)
from lifecycle.middleware.versions import DISTRIBUTIONS, INSTALL, installed
from lifecycle.network.connection_url import ConnectionUrl
from lifecycle.network.medium import DEFAULT_TCP, RMW_DISCOVERY, TRANSPORTS_VARIABLE, Medium
from lifecycle.network.nfe import parse_address
from lifecycle.network.ports import (
    DG,
    LOCALHOST_PEERS_RANGE,
    PARTICIPANTS_PER_DOMAIN,
    participant_ports,
    unicast_pairs,
)
from lifecycle.plan.model import PlannedServer

SETTLE_S = 3.5
"""Within so long everybody is known: Fast DDS announces itself, and sends again what was lost, each
3 s. It is waited for in full where nobody can be asked."""

_CONNECTED_S = 1.5
"""So much later those are known that make TCP connections first."""

_CONNECTING = ("TCPv4", "TCPv6", "LARGE_DATA")
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


class Target(NamedTuple):
    """The UDP port of a participant, or of a multicast group and the interface it is reached by."""

    address: str
    port: int
    interface: str = ""


class Reach(NamedTuple):
    """Whom a participant of this process can ask over one address family.

    Attributes:
        kind: UDPV4 or UDPV6.
        targets: where participants receive discovery.
        addresses: of this host, at which answers arrive.
        receivers: UDP ports of this process where its participants receive discovery.
    """

    kind: Medium
    targets: tuple[Target, ...]
    addresses: tuple[str, ...]
    receivers: tuple[int, ...]


def reach(
    domain_id: int, urls: Sequence[ConnectionUrl], environment: Mapping[str, str]
) -> tuple[Reach, ...]:
    """Return whom a participant with these URLs can ask; it has its sockets already.

    Args:
        domain_id: 0–232.
        urls: its own; none for what the RMW does by itself.
        environment: has ROS_AUTOMATIC_DISCOVERY_RANGE, for URLs that leave discovery open. OFF asks
            nobody, SUBNET (the default) this host, by multicast, and those of ROS_STATIC_PEERS,
            everything else this host only.

    Returns:
        One per address family; none where others cannot be asked, or may only be from one port.
    """
    found = families(urls) or (UrlTransport(kind=RMW_DISCOVERY),)
    if any(url.server or url.output_port for url in urls):
        return ()
    if not all(family.kind.is_udp for family in found):
        return ()
    if not urls and (chosen_otherwise(environment) or _connects_first(environment)):
        return ()
    is_open = not urls or leaves_discovery_open(urls)
    return tuple(_reach(domain_id, each, environment if is_open else None) for each in found)


def settle_s(urls: Sequence[ConnectionUrl], environment: Mapping[str, str]) -> float:
    """Return within how many seconds a participant of these URLs knows all that were there."""
    return SETTLE_S + (_CONNECTED_S if not urls and _connects_first(environment) else 0.0)


def _reach(domain_id: int, family: UrlTransport, environment: Mapping[str, str] | None) -> Reach:
    """Return whom a participant can ask over one family; None for an environment: its URLs say."""
    kind = family.kind
    here = _addresses_of(kind)
    if environment is None:
        peers = [(each.address, each.port, LOCALHOST_PEERS_RANGE) for each in family.peers]
        by_multicast = all(url.multicast for url in family.urls)
        if bound := set(family.interfaces):
            here = {name: [one for one in at if {name, one} & bound] for name, at in here.items()}
    elif (range_ := _range(environment)) == "OFF":
        return Reach(kind, (), (), ())
    else:
        peers = [(kind.loopback, None, PARTICIPANTS_PER_DOMAIN)]
        by_multicast = range_ == "SUBNET"
        if by_multicast:
            parsed = map(parse_address, _static_peers(environment))  # a name would be looked up
            same = (each for each in parsed if each and each.version == kind.ip_version)
            peers += [(str(each), None, LOCALHOST_PEERS_RANGE) for each in same]
        else:
            here = {"": [kind.loopback]}
    targets: list[Target] = []
    for address, port, participants in peers:
        if port is None:
            targets += _well_known(domain_id, address, participants)
        else:
            targets.append(Target(address, port))
    if by_multicast:
        group = participant_ports(domain_id, 0).discovery_multicast
        targets += [Target(DISCOVERY_GROUP[kind], group, name) for name, at in here.items() if at]
    if fixed := family.option("metatraffic_port"):
        receivers = [fixed]
    else:
        ports = participant_ports(domain_id, 0)
        possible = range(ports.discovery_unicast, ports.discovery_multicast + DG, 2)
        receivers = sorted(
            {each.port for each in open_sockets() if each.kind == kind and each.port in possible}
        )
    addresses = tuple(each for at in here.values() for each in at)
    return Reach(kind, tuple(targets), addresses, tuple(receivers))


def _well_known(domain_id: int, address: str, participants: int) -> Iterator[Target]:
    """Yield the discovery ports of a host's first participants (DDSI-RTPS 9.6.2.3)."""
    return (Target(address, port) for port, _ in unicast_pairs(domain_id, participants))


def _addresses_of(kind: Medium) -> dict[str, list[str]]:
    """Return this host's addresses of a family by interface: loopback first, others next.

    Link-local ones of IPv6 mean nothing to others without an interface of theirs.
    """
    found: dict[str, list[str]] = {}
    every = [
        (name, ipaddress.ip_address(at)) for name, at in interface_addresses(kind.socket_family)
    ]
    for name, address in sorted(every, key=lambda each: (not each[1].is_loopback, each[0])):
        if not (address.version == 6 and address.is_link_local):
            found.setdefault(name, []).append(str(address))
    return found


def is_served(urls: Sequence[ConnectionUrl], environment: Mapping[str, str]) -> bool:
    """Return whether a participant of these URLs finds others by a discovery server."""
    if any(url.server for url in urls) or environment.get(DISCOVERY_SERVER_VARIABLE):
        return True
    profile = None if urls else _users_profile(environment)
    protocols = () if profile is None else profile.element.iter("discoveryProtocol")
    return any((each.text or "").strip() not in ("", "SIMPLE", "NONE") for each in protocols)


def missing_port(
    domain_id: int, urls: Sequence[ConnectionUrl], environment: Mapping[str, str]
) -> int | None:
    """Return the UDP port of the multicast by which participants find each other, if it is missing.

    If another kind of socket has it, no participant of this host finds another, and Fast DDS 2.14
    says nothing. None if this process has it, or participants look for each other elsewhere, too.
    """
    if urls or chosen_otherwise(environment) or _range(environment) != "SUBNET":
        return None
    port = participant_ports(domain_id, 0).discovery_multicast
    if _static_peers(environment) or any(each.port == port for each in open_sockets()):
        return None
    return port if any(each.port == port for each in udp_sockets_of_others()) else None


def chosen_otherwise(environment: Mapping[str, str]) -> bool:
    """Whether the user's own settings say how participants without URLs are found.

    Then nothing may be asked over UDP, which those settings may have ruled out. An RMW without DDS
    has nothing that answers.
    """
    if environment.get(DISCOVERY_SERVER_VARIABLE) or not _has_udpv4(environment):
        return True
    if "zenoh" in environment.get("RMW_IMPLEMENTATION", ""):
        return True
    profile = _users_profile(environment)
    return profile is not None and any(each.tag in _CHOICES for each in profile.element.iter())


def _connects_first(environment: Mapping[str, str]) -> bool:
    """Return whether participants, once discovered, make TCP connections before they say more.

    An answer by UDP says nothing then of what a participant has.
    """
    builtin = environment.get(TRANSPORTS_VARIABLE, "").upper()
    if builtin.startswith("LARGE_DATA") and _range(environment) != "LOCALHOST":
        return True
    with contextlib.suppress(OSError):
        if (profile := _users_profile(environment)) is not None:
            text = Path(profile.file).read_text(encoding="utf-8", errors="replace")
            return any(each in text for each in _CONNECTING)
    return False


def _users_profile(environment: Mapping[str, str]) -> DefaultProfile | None:
    """Return the default profile of the user's; ours adds to Fast DDS's defaults."""
    with contextlib.suppress(MiddlewareError):  # Fast DDS cannot read it either, and takes those
        found = default_profile(environment)
        return found if found is not None and found.is_users else None
    return None


def _range(environment: Mapping[str, str]) -> str:
    return environment.get(RANGE_VARIABLE, "").upper() or "SUBNET"


def _has_udpv4(environment: Mapping[str, str]) -> bool:
    builtin = environment.get(TRANSPORTS_VARIABLE, "").partition("?")[0].upper()
    return builtin in ("", "DEFAULT", "UDPV4", "LARGE_DATA")


def _static_peers(environment: Mapping[str, str]) -> tuple[str, ...]:
    listed = environment.get(PEERS_VARIABLE, "").split(";")
    return tuple(filter(None, map(str.strip, listed)))


def peers_environment(hosts: Iterable[str], environment: Mapping[str, str]) -> Mapping[str, str]:
    """Return ROS_STATIC_PEERS, which rmw reads, with these hosts beside those of the user's.

    Nothing is added for participants without UDP over IPv4: they would look for no others then.
    """
    if environment.get(DISCOVERY_SERVER_VARIABLE) or not _has_udpv4(environment):
        return {}
    every = dict.fromkeys([*_static_peers(environment), *hosts])
    return {PEERS_VARIABLE: ";".join(every)} if every else {}


def discovery_peers(
    domain_id: int, hosts: Mapping[str, int], environment: Mapping[str, str]
) -> tuple[tuple[str, int], ...]:
    """Return addresses and UDP ports where participants are looked for, multicast among them.

    Args:
        domain_id: 0–232.
        hosts: by IP address, how many participants may be there.
        environment: if it says how others are found, nothing is returned.
    """
    if not hosts or chosen_otherwise(environment):
        return ()
    found = [
        (target.address, target.port)
        for host, count in hosts.items()
        for target in _well_known(domain_id, host, min(count, LOCALHOST_PEERS_RANGE))
    ]
    group = participant_ports(domain_id, 0).discovery_multicast
    return ((DISCOVERY_GROUP[RMW_DISCOVERY], group), *found)


_PROGRAM = "fast-discovery-server"
_LISTEN = "0A"  # TCP_LISTEN of linux/tcp_states.h


def discovery_server_command(server: PlannedServer) -> tuple[tuple[str, ...], dict[str, str]]:
    """Return the command line of a discovery server on this host, and its whole environment.

    Raises:
        MiddlewareError: the program is not installed.
    """
    options = ("-t", server.address, "-q") if server.tcp else ("-l", server.address, "-p")
    command = (_program(), *installed().server_arguments)
    argv = (*command, "-i", "0", *options, str(server.port))  # the id that clients expect
    current = dict(os.environ)
    # A profile or a server of the environment's would be applied to the server itself.
    for variable in (
        *(each.profiles_variable for each in DISTRIBUTIONS),
        TRANSPORTS_VARIABLE,
        DISCOVERY_SERVER_VARIABLE,
    ):
        current.pop(variable, None)
    current["SKIP_DEFAULT_XML"] = "1"
    # Where the wheels keep Fast DDS and what it needs.
    data, pure = (Path(sysconfig.get_path(each)) for each in ("data", "purelib"))
    places = (data / "lib", pure / "ros_fastrtps.libs", pure / "ros_fastdds.libs")
    paths = [str(each) for each in places if each.is_dir()]
    paths += filter(None, current.get("LD_LIBRARY_PATH", "").split(":"))
    current["LD_LIBRARY_PATH"] = ":".join(dict.fromkeys(paths))
    return argv, current


def discovery_server_listens(server: PlannedServer, pid: int | None = None) -> bool:
    """Return whether the server's port is open in the network of a process, None for ours."""
    owner, name = "self" if pid is None else str(pid), "tcp" if server.tcp else "udp"
    table, kind = Path("/proc", owner, "net", name), DEFAULT_TCP if server.tcp else RMW_DISCOVERY
    with contextlib.suppress(FileNotFoundError, ProcessLookupError):
        return any(
            each.port == server.port
            and each.address in (server.address, kind.any_address)
            and (not server.tcp or state == _LISTEN)
            for each, state in sockets_in(table, kind)
        )
    return False


def _program() -> str:
    for directory in (sysconfig.get_path("scripts"), None):
        found = shutil.which(_PROGRAM, path=directory)
        if found is not None:
            return found
    raise MiddlewareError(
        f"cannot find {_PROGRAM!r}", hint=f"it comes with Fast DDS; set PATH, or {INSTALL}"
    )
