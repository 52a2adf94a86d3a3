"""Ports at which the names of nodes arrive by UDP (`ParticipantSettings.names_by_udp`).

Owns: whether each participant of a host has the pair of ports that goes with its number (DDSI-RTPS
9.6.2.3): `ros_discovery_info` is received at the one for user data, the next after that for
discovery. Fast DDS 2.14 takes the next free port for each by itself. Where another participant has
only the second port of a pair, messages to the participant that gets the first are lost. Sockets
are read from proc(5). Must not import rclpy.
"""

from __future__ import annotations

from lifecycle.errors import MiddlewareError
from lifecycle.middleware.fastdds.dscp import own_udp_ports
from lifecycle.middleware.fastdds.url_check import udp_sockets
from lifecycle.network import unicast_pairs


def pairs_are_whole(domain_id: int) -> bool:
    """Return whether no process of this host, this one neither, has only the second port of a pair.

    Args:
        domain_id: 0–232.
    """
    ports = {each.port for each in udp_sockets()}
    return all(
        user not in ports or discovery in ports for discovery, user in unicast_pairs(domain_id)
    )


def check_own_pair(domain_id: int) -> None:
    """Refuse to go on without the names of other nodes.

    Args:
        domain_id: of a participant of this process.

    Raises:
        MiddlewareError: it has only the first port of a pair.
    """
    ports = own_udp_ports()
    for discovery, user in unicast_pairs(domain_id):
        if discovery in ports and user not in ports:
            raise MiddlewareError(
                f"cannot receive the names of other nodes: UDP port {user} is another process's",
                hint="a participant took it just now; start again",
            )
