"""DDS port arithmetic: UDP ports of a domain and participant, and how many participants fit a host.

Owns: the formula of DDSI-RTPS §9.6.2.3 with its default constants, Linux's ephemeral ports, the
limits that follow (the article *The ROS_DOMAIN_ID*). These are the ports a participant asks for; a
busy one is replaced, so the ports of a running system are read from it. Pure.
"""

from __future__ import annotations

from collections.abc import Callable

import msgspec

PB = 7400  # port base
DG = 250  # domain gain: the ports that one domain owns
PG = 2  # participant gain: the unicast ports that one participant owns
D0 = 0  # offset of discovery (metatraffic) multicast
D1 = 10  # of discovery unicast
D2 = 1  # of user multicast
D3 = 11  # of user unicast

MAX_PORT = 65535
MAX_DOMAIN_ID = 232
"""The highest domain whose multicast ports exist; Fast DDS ends the process beyond it."""
PARTICIPANTS_PER_DOMAIN = (DG - D1) // PG
"""Participants until the unicast ports reach the next domain's multicast ports: 120."""

LOCALHOST_PEERS_RANGE = 32
"""Participants of a host that one looks for with ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST.

rmw_fastrtps takes multicast away then and gives 127.0.0.1 as a peer without a port, for which Fast
DDS tries the ports of participants 0 to 31 (maxInitialPeersRange of the transport)."""
LOCALHOST_PARTICIPANTS = LOCALHOST_PEERS_RANGE + 1
"""Participants of a host that all find each other so: one beyond the range finds all that are in
it, and these answer; two beyond it never find each other (measured with Fast DDS 2.14)."""

EPHEMERAL_RANGE_FILE = "/proc/sys/net/ipv4/ip_local_port_range"


def domain_of(text: str) -> int | None:
    """Return the domain id that ROS_DOMAIN_ID sets, 0–232; None for any other text."""
    if not (text.isascii() and text.isdecimal() and len(text) < 10):
        return None
    return domain if (domain := int(text)) <= MAX_DOMAIN_ID else None


LINUX = range(32768, 61000)
"""Ports that Linux gives to sockets bound to none; net.ipv4.ip_local_port_range changes it."""


class ParticipantPorts(msgspec.Struct, frozen=True, kw_only=True):
    """The four UDP ports of one participant; the multicast ones are shared by the whole domain."""

    discovery_multicast: int
    user_multicast: int
    discovery_unicast: int
    user_unicast: int


class Capacity(msgspec.Struct, frozen=True, kw_only=True):
    """How many participants of a domain fit on one host, and what the next one would run into."""

    participants: int
    limit: str


def domain_base(domain_id: int) -> int:
    """Return the first port of a domain, its discovery multicast port; ValueError beyond 0–232."""
    if not 0 <= domain_id <= MAX_DOMAIN_ID:
        raise ValueError(
            f"cannot use domain id {domain_id}: its ports would lie outside 1 to {MAX_PORT}; "
            f"use 0 to {MAX_DOMAIN_ID}"
        )
    return PB + DG * domain_id


def participant_ports(domain_id: int, participant_id: int) -> ParticipantPorts:
    """Return the ports of a participant, DDSI-RTPS §9.6.2.3.

    Args:
        domain_id: 0–232.
        participant_id: counts the participants of the domain on one host from 0.

    Raises:
        ValueError: a number is out of range, or a port would pass 65535. Participant 63 of domain
            232 does: Fast DDS wraps it silently to port 1.
    """
    base = domain_base(domain_id)
    if participant_id < 0:
        raise ValueError(f"cannot use participant id {participant_id}; use 0 or more")
    ports = ParticipantPorts(
        discovery_multicast=base + D0,
        user_multicast=base + D2,
        discovery_unicast=base + D1 + PG * participant_id,
        user_unicast=base + D3 + PG * participant_id,
    )
    if ports.user_unicast > MAX_PORT:
        raise ValueError(
            f"cannot use participant id {participant_id} in domain {domain_id}: its unicast ports "
            f"would be {ports.discovery_unicast} and {ports.user_unicast}, beyond {MAX_PORT}; "
            f"use 0 to {(MAX_PORT - base - D3) // PG}"
        )
    return ports


def unicast_pairs(
    domain_id: int, participants: int = PARTICIPANTS_PER_DOMAIN
) -> list[tuple[int, int]]:
    """Return the ports for discovery and user data of the first participants of one host."""
    first = participant_ports(domain_id, 0)
    between = first.user_unicast - first.discovery_unicast
    end = min(first.discovery_unicast + PG * participants, MAX_PORT + 1 - between)
    return [(port, port + between) for port in range(first.discovery_unicast, end, PG)]


def max_participants(domain_id: int, ephemeral: range) -> Capacity:
    """Return how many participants of a domain fit on one host, each process being at least one.

    `ephemeral` are the ports that its operating system gives to other sockets; it may be empty.
    """
    base = domain_base(domain_id)
    found = [((MAX_PORT - base - D3) // PG + 1, f"the highest port, {MAX_PORT}")]
    if domain_id < MAX_DOMAIN_ID:
        next_domain = f"the ports of domain {domain_id + 1}, from {base + DG}"
        found.append((PARTICIPANTS_PER_DOMAIN, next_domain))
    if ephemeral:
        inside = f"the ephemeral ports {ephemeral[0]}–{ephemeral[-1]}"
        if base + D0 in ephemeral or base + D2 in ephemeral:
            found.append((0, f"{inside}: they hold its multicast ports"))
        elif ephemeral[-1] >= base + D1:
            # The first participant whose upper port is not below the range is the first inside it.
            found.append((max(0, -(-(ephemeral[0] - base - D3) // PG)), inside))
    participants, limit = min(found, key=lambda each: each[0])
    return Capacity(participants=participants, limit=limit)


def safe_domains(ephemeral: range) -> tuple[range, ...]:
    """Return the domain ids whose first participant is clear of the ephemeral ports, as runs."""
    found: list[range] = []
    for domain in range(MAX_DOMAIN_ID + 1):
        if not max_participants(domain, ephemeral).participants:
            continue
        if found and found[-1].stop == domain:
            found[-1] = range(found[-1].start, domain + 1)
        else:
            found.append(range(domain, domain + 1))
    return tuple(found)


def read_ephemeral_range(read: Callable[[str], str]) -> range:
    """Return this machine's real ephemeral range (ip(7), ip_local_port_range).

    `read` returns the text of a file, so that this room opens nothing.

    Raises:
        OSError: `read` could not; not Linux, or no /proc.
        ValueError: the file does not hold two ports.
    """
    text = read(EPHEMERAL_RANGE_FILE)
    first, last = map(int, text.split())
    return range(first, last + 1)


def unique_flow_ports() -> range:
    """Return the ports that Fast DDS gives to unique subscriptions: 7000–7399.

    It takes the first free one of [PB − 400, PB), the same in every domain, so all processes of a
    host share these 400. Each participant takes one for `ros_discovery_info`.
    """
    return range(PB - 400, PB)


def describe_domains(runs: tuple[range, ...]) -> str:
    """Return runs of domain ids for people: `0–101, 215–232`; `none` if there is none."""
    words = (str(run[0]) if len(run) == 1 else f"{run[0]}–{run[-1]}" for run in runs)
    return ", ".join(words) or "none"
