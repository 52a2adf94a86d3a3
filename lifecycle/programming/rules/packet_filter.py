"""Packet filters: what a rule may ask a network to match, and the one place where that is checked.

Owns: protocol numbers, ports and port ranges, addresses and their families, and the IPFilterRule
text of RFC 6733 §4.3.1 in the shape that 3GPP TS 29.214 §5.3.8 allows. Schemas of the interfaces
that carry filters as strings do not look inside them, so a wrong one would only be found when no
packet matches. Pure.
"""

from __future__ import annotations

import enum
import ipaddress
import re

from lifecycle import dataclasses
from lifecycle.network import IpAddress

PROTOCOL_NUMBERS = {"udp": 17, "tcp": 6}
"""The two that carry flows here (IANA Assigned Internet Protocol Numbers)."""

_NUMBER = re.compile(r"[0-9]{1,5}")
_DESCRIPTION = re.compile(
    r"permit (?P<direction>in|out) (?P<protocol>\S+)"
    r" from (?P<source>\S+)(?: (?P<source_ports>\S+))?"
    r" to (?P<destination>\S+)(?: (?P<destination_ports>\S+))?"
)


class Direction(enum.Enum):
    """Which way a filter's packets go, as seen from the device (3GPP TS 29.214 §5.3.8)."""

    OUT = "out"  # downlink: out of the network, towards the device
    IN = "in"  # uplink: from the device into the network


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class PortRange:
    """One port or several neighbours.

    Attributes:
        low: 1–65535.
        high: 1–65535, not below `low`.
    """

    low: int
    high: int

    def __post_init__(self) -> None:
        check_port(self.low)
        check_port(self.high)
        if self.low > self.high:
            raise ValueError(
                f"cannot use ports {self.low}-{self.high}: the lower one comes first; "
                f"use {self.high}-{self.low}"
            )

    def __str__(self) -> str:
        return str(self.low) if self.low == self.high else f"{self.low}-{self.high}"


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class PacketFilter:
    """Packets of one direction of one flow.

    Attributes:
        protocol: 1–255, as in the IP header.
        source: one address.
        source_ports: None for any.
        destination: one address of the same family.
        destination_ports: None for any.
    """

    direction: Direction
    protocol: int
    source: str
    source_ports: PortRange | None
    destination: str
    destination_ports: PortRange | None

    def __post_init__(self) -> None:
        check_protocol(self.protocol)
        check_same_family(self.source, self.destination)

    def text(self, *, protocol_by_name: bool = False) -> str:
        """Return the filter as IPFilterRule text: `permit out 17 from A 1 to B 2`.

        Args:
            protocol_by_name: write `udp` or `tcp` instead of the number, which the grammar does not
                know and some servers insist on. Other protocols keep their number.
        """
        names = {number: name for name, number in PROTOCOL_NUMBERS.items()}
        number = str(self.protocol)
        protocol = names.get(self.protocol, number) if protocol_by_name else number
        ends = " to ".join(
            str(check_address(address)) + ("" if ports is None else f" {ports}")
            for address, ports in (
                (self.source, self.source_ports),
                (self.destination, self.destination_ports),
            )
        )
        return f"permit {self.direction.value} {protocol} from {ends}"


def parse_filter(text: str) -> PacketFilter:
    """Read IPFilterRule text back, as a server may return it.

    Raises:
        ValueError: not `permit in|out PROTOCOL from ADDRESS [PORTS] to ADDRESS [PORTS]` with
            values in range.
    """
    match = _DESCRIPTION.fullmatch(text)
    if match is None:
        raise ValueError(
            f"cannot read filter {text!r}; "
            f"use 'permit in|out PROTOCOL from ADDRESS [PORTS] to ADDRESS [PORTS]'"
        )
    ports = [
        parse_ports(part) if (part := match[name]) else None
        for name in ("source_ports", "destination_ports")
    ]
    return PacketFilter(
        direction=Direction(match["direction"]),
        protocol=parse_protocol(match["protocol"]),
        source=match["source"],
        source_ports=ports[0],
        destination=match["destination"],
        destination_ports=ports[1],
    )


def parse_protocol(text: str) -> int:
    """Return the protocol number, 1–255, of `17` or `udp`.

    Raises:
        ValueError: neither a number in range nor a known name.
    """
    known = PROTOCOL_NUMBERS.get(text.lower())
    if known is not None:
        return known
    if not _NUMBER.fullmatch(text):
        names = ", ".join(PROTOCOL_NUMBERS)
        raise ValueError(f"cannot use protocol {text!r}; use 1 to 255 or one of {names}")
    return check_protocol(int(text))


def parse_ports(text: str) -> PortRange:
    """Return the ports of `17910` or `17900-17910`.

    Raises:
        ValueError: neither one port nor low-high, or out of range. Lists are valid IPFilterRule
            text, but not every network takes them, so they are refused.
    """
    low, dash, high = text.partition("-")
    if not _NUMBER.fullmatch(low) or (dash and not _NUMBER.fullmatch(high)):
        raise ValueError(f"cannot use ports {text!r}; use one port, or low-high, of 1 to 65535")
    return PortRange(low=int(low), high=int(high if dash else low))


def check_protocol(number: int) -> int:
    """Return an IP protocol number.

    Raises:
        ValueError: not 1–255; 0 is IPv6's hop-by-hop header and no protocol of a flow.
    """
    if not 1 <= number <= 255:
        raise ValueError(f"cannot use protocol {number}; use 1 to 255, such as 17 for UDP")
    return number


def check_port(port: int) -> int:
    """Return a port.

    Raises:
        ValueError: not 1–65535.
    """
    if not 1 <= port <= 65535:
        raise ValueError(f"cannot use port {port}; use 1 to 65535")
    return port


def check_address(text: str) -> IpAddress:
    """Return the address that `text` spells.

    Raises:
        ValueError: not one unicast address: a name, a zone, a wildcard or a group.
    """
    try:
        address = ipaddress.ip_address(text)
    except ValueError:
        raise ValueError(
            f"cannot use address {text!r}; use one IPv4 or IPv6 address, such as 10.77.0.1"
        ) from None
    if "%" in text:
        raise ValueError(
            f"cannot use address {text!r}: its zone means something on its own host only; "
            f"use {text.partition('%')[0]}"
        )
    if address.is_unspecified or address.is_multicast:
        kind = "a group" if address.is_multicast else "every address of its host"
        raise ValueError(f"cannot use address {text!r}: it is {kind}; use one unicast address")
    return address


def check_same_family(a: str, b: str) -> None:
    """Check that two addresses can be the ends of one packet.

    Raises:
        ValueError: one of them is not an address, or one is IPv4 and the other IPv6.
    """
    one, other = check_address(a), check_address(b)
    if one.version != other.version:
        raise ValueError(
            f"cannot filter packets from {a} to {b}: one is IPv{one.version}, the other "
            f"IPv{other.version}; use two addresses of one family"
        )
