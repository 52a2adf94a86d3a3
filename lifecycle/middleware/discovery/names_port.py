"""Ports at which names of nodes arrive by UDP (`ParticipantSettings.names_by_udp`).

Owns: whether each participant that is made here has the port that goes with its own. rmw_fastrtps'
`ros_discovery_info` is received at the participant's port for user data, the one after that of its
discovery (DDSI-RTPS 9.6.2.3). Fast DDS 2.14 takes the next two that are free, each by itself: a
participant with ports of its own choice may have the second of a pair whose first is free, and what
is sent to that by name of the participant then made is lost, for good. Sockets are read from
proc(5). Must not import rclpy.
"""

from __future__ import annotations

from lifecycle.errors import MiddlewareError
from lifecycle.middleware.fastdds.url_check import open_sockets, udp_sockets
from lifecycle.network import PARTICIPANTS_PER_DOMAIN, UDP_UNICAST, participant_ports


def pairs_are_whole(domain_id: int) -> bool:
    """Return whether no process of this host, this one neither, has only the second port of a pair.

    Args:
        domain_id: 0–232.
    """
    ports = {each.port for each in udp_sockets()}
    return all(user not in ports or discovery in ports for discovery, user in _pairs(domain_id))


def check_own_pair(domain_id: int) -> None:
    """Refuse to go on without the names of other nodes.

    Args:
        domain_id: of a participant of this process.

    Raises:
        MiddlewareError: it has only the first port of a pair.
    """
    ports = {each.port for each in open_sockets(kinds=UDP_UNICAST)}
    for discovery, user in _pairs(domain_id):
        if discovery in ports and user not in ports:
            raise MiddlewareError(
                f"cannot receive the names of other nodes: UDP port {user} is another process's",
                hint="a participant took it just now; start again",
            )


def _pairs(domain_id: int) -> list[tuple[int, int]]:
    """Return the ports for discovery and user data of all participants that a host can have."""
    found = []
    for participant in range(PARTICIPANTS_PER_DOMAIN):
        try:
            ports = participant_ports(domain_id, participant)
        except ValueError:  # the domain has no such port
            break
        found.append((ports.discovery_unicast, ports.user_unicast))
    return found
