"""Transports between participants: UDP, TCP, shared memory, multicast; size of a UDP datagram.

Owns: the one enum of media; `FlowTransport`, the values of a manifest's `transport:`; MTU, and what
of a datagram IP fragments. Only the first fragment carries the ports, so that a rule on ports
treats the others as something else, and one lost fragment loses them all (RFC 8085, section 3.2).
RTPS can split a message itself (DATA_FRAG): then each part is a datagram of its own, with ports.
Which medium two ends get, and why, is in `plan.media`. Pure.
"""

from __future__ import annotations

import enum
import socket


class Medium(str, enum.Enum):
    """What carries data. A member is its value, wherever text is wanted.

    In the order in which a connection is named after several.
    """

    SHM = "shm"
    UDPM = "udpm"  # a multicast group, over IPv4 or IPv6 by its address
    UDPV4 = "udpv4"
    UDPV6 = "udpv6"
    TCPV4 = "tcpv4"
    TCPV6 = "tcpv6"  # seen at others; nothing of ours is connected by it
    INTRAPROCESS = "intraprocess"

    def __str__(self) -> str:
        """Return the value; as StrEnum does, which Python 3.10 has not."""
        return str(self.value)

    def __repr__(self) -> str:
        """Return the value in quotes, as messages have it."""
        return repr(self.value)

    @property
    def is_udp(self) -> bool:
        """Whether it is UDP, to one or to a group."""
        return self.startswith("udp")

    @property
    def is_tcp(self) -> bool:
        """Whether it is TCP: found by being dialled, on the one port of a participant."""
        return self.startswith("tcp")

    @property
    def is_network(self) -> bool:
        """Whether its packets are what a network sees; only these have addresses and ports."""
        return self.is_udp or self.is_tcp

    @property
    def is_group(self) -> bool:
        """Whether it is multicast: its address and port belong to all that listen there."""
        return self is Medium.UDPM

    @property
    def stays_on_host(self) -> bool:
        """Whether it carries nothing to another host; a group's datagrams have TTL 0."""
        return self.is_group or not self.is_network

    @property
    def ip_version(self) -> int | None:
        """4 or 6; None where it is either, or no IP."""
        return {"v4": 4, "v6": 6}.get(self.value[-2:])

    @property
    def socket_family(self) -> socket.AddressFamily:
        """Of its sockets: IPv6's where it says so."""
        return socket.AF_INET6 if self.ip_version == 6 else socket.AF_INET

    @property
    def loopback(self) -> str:
        """The address by which it reaches its own host."""
        return LOOPBACK6 if self.ip_version == 6 else LOOPBACK

    @property
    def any_address(self) -> str:
        """The address of a socket that listens on all interfaces."""
        return "::" if self.ip_version == 6 else "0.0.0.0"  # noqa: S104 - it is only spelled here

    @property
    def ports(self) -> int:
        """How many ports a participant has of it, where each is fixed.

        Of UDP those for discovery, for data, and to send from.
        """
        return 3 if self.is_udp else int(self.is_tcp)

    @property
    def unicast(self) -> Medium:
        """What its participants are found by: of a group's, UDP over IPv4."""
        return Medium.UDPV4 if self.is_group else self

    @property
    def meaning(self) -> str:
        """What people read; of an IP transport its value."""
        return {
            Medium.SHM: "shared memory",
            Medium.UDPM: "UDP multicast",
            Medium.INTRAPROCESS: "handed over inside their process",
        }.get(self, self.value)


def udp_to(address: str) -> Medium:
    """Return UDP over the version of IP of an address; over IPv4 if that is empty."""
    return Medium.UDPV6 if ":" in address else Medium.UDPV4


def medium_of(transport: str) -> Medium:
    """Return the medium of a transport as participants have it: a group is `udpm@ADDRESS:PORT`."""
    return Medium(transport.partition("@")[0])


LOOPBACK = "127.0.0.1"
LOOPBACK6 = "::1"

NETWORK_MEDIA = frozenset(each for each in Medium if each.is_network)
"""Media whose packets a network sees."""

CONNECTABLE = (Medium.SHM, Medium.UDPV4, Medium.UDPV6, Medium.UDPM, Medium.TCPV4)
"""Media that connections are made of, and schemes of connection URLs, in the order in which a node
reports them."""

UDP_UNICAST = tuple(each for each in CONNECTABLE if each.is_udp and not each.is_group)
"""By what participants are probed, and found without a discovery server."""

FAST_DDS = "rmw_fastrtps"
"""What the names of the RMWs begin with that we know all of this about."""

DEFAULT_RMW = "rmw_fastrtps_cpp"
"""What ROS 2 Jazzy takes when RMW_IMPLEMENTATION is not set (REP 2000)."""

RMW_DEFAULT = (Medium.SHM, Medium.UDPV4)
"""What a participant has by default (Fast DDS 2.14)."""

RMW_DISCOVERY = next(each for each in RMW_DEFAULT if each.is_network)
"""By what such a participant is discovered."""

DEFAULT_TCP = Medium.TCPV4
"""By what a discovery server is reached, and an observer by TCP, where a manifest says no more."""

TRANSPORTS_VARIABLE = "FASTDDS_BUILTIN_TRANSPORTS"

BUILTIN_TRANSPORTS = {
    "DEFAULT": RMW_DEFAULT,
    "SHM": (Medium.SHM,),
    "UDPv4": (Medium.UDPV4,),
    "UDPv6": (Medium.UDPV6,),
    "LARGE_DATA": (Medium.SHM, Medium.TCPV4, Medium.UDPV4),
    "NONE": (Medium.TCPV4,),
}
"""What a participant has by each value of FASTDDS_BUILTIN_TRANSPORTS."""


class FlowTransport(enum.Enum):
    """What a manifest asks to carry data: any, a class of media, or one medium."""

    ANY = "any"  # the middleware chooses; Fast DDS prefers shared memory on one host
    NETWORK = "network"  # an IP socket, never shared memory
    SHM = Medium.SHM.value
    UDPV4 = Medium.UDPV4.value
    UDPV6 = Medium.UDPV6.value
    MULTICAST = "multicast"  # one datagram for all subscribers of a host, TTL 0
    TCPV4 = Medium.TCPV4.value

    @property
    def media(self) -> tuple[Medium, ...]:
        """The media of connections that are what is asked for; all of them for ANY."""
        if self is FlowTransport.ANY:
            return CONNECTABLE
        if self is FlowTransport.NETWORK:
            return tuple(each for each in CONNECTABLE if each.is_network)
        return (Medium.UDPM if self is FlowTransport.MULTICAST else Medium(self.value),)

    @property
    def medium(self) -> Medium | None:
        """The one medium that is asked for; None for ANY and NETWORK."""
        return self.media[0] if len(self.media) == 1 else None

    @property
    def in_memory(self) -> bool:
        """Whether it asks for what no network sees, and no other host."""
        return self.medium is not None and not self.medium.is_network

    @property
    def by_udp(self) -> bool:
        """Whether a participant with no more than it is found by UDP, as it is by default."""
        return self is FlowTransport.ANY or self.medium in UDP_UNICAST

    @property
    def builtin(self) -> str | None:
        """The value of FASTDDS_BUILTIN_TRANSPORTS that gives a participant it; None without."""
        wanted = Medium.UDPV4 if self is FlowTransport.NETWORK else self.medium
        words = (each for each, has in BUILTIN_TRANSPORTS.items() if has == (wanted,))
        return next((each for each in words if each != "NONE"), None)

    def accepts(self, medium: str) -> bool:
        """Return whether data that go by this medium go as asked for.

        Inside a process nothing leaves shared memory; a group stays on its host, and the other
        subscribers of its topic get theirs by TCP.
        """
        if self is FlowTransport.ANY or medium in self.media:
            return True
        also = {
            FlowTransport.SHM: (Medium.INTRAPROCESS,),
            FlowTransport.MULTICAST: (Medium.INTRAPROCESS, Medium.TCPV4),
        }
        return medium in also.get(self, ())


SAFE_DATAGRAM_BYTES = 1400
"""What we ask of a transport: leaves room below an Ethernet MTU for tunnels on the way."""


def is_fragmented(message_bytes: int, address: str, max_datagram_bytes: int | None = None) -> bool:
    """Return whether IP splits a serialized message that RTPS does not split.

    Args:
        message_bytes: its size.
        address: of the host that sends it; empty for IPv4.
        max_datagram_bytes: UDP payload that the path carries whole; None for Ethernet's, 1472 or,
            over IPv6, 1452.
    """
    # Submessages start at multiples of 4. Around one: RTPS header, INFO_DST, INFO_TS, DATA and,
    # from reliable writers, HEARTBEAT (DDSI-RTPS 9.4).
    payload = (message_bytes + 3) // 4 * 4 + 20 + 16 + 12 + 24 + 32
    return payload > (max_datagram_bytes or (1452 if ":" in address else 1472))
