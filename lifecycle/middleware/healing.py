"""Finding each other again, soon after a link has come back.

Owns: what is sent while somebody is out of reach, and what makes node names whole again. Two
participants that lost each other for longer than their lease (20 s) forget one another, and then
each announces itself once in 3 s. `call_out` makes both sides announce themselves at once: whoever
hears the announcement of a participant that does not exist answers to where it seems to be (see
knock.py). And rmw_dds_common keeps the name of a node that was forgotten out of the graph until
its participant tells its entities anew, which `tell_names` makes it do.
"""

from __future__ import annotations

import contextlib
import os
import socket
from collections.abc import Iterable

from rcl_interfaces.msg import ParameterEvent
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.node import Node
from rclpy.qos import QoSProfile

from lifecycle.middleware.knock import (
    MULTICAST_GROUP,
    RANGE_VARIABLE,
    announcement,
    discovery_ports,
    host_addresses,
)
from lifecycle.network.ports import participant_ports

CALL_EACH_S = 0.25
"""While somebody is missing; a call is a few datagrams."""

_PARTICIPANTS = 32
"""Of a host whose address is known; who has more of them is reached by multicast."""


def call_out(domain_id: int, peers: Iterable[str] = ()) -> None:
    """Make participants of other hosts announce themselves to ours, and ours to them.

    Args:
        domain_id: 0–232.
        peers: IPv4 addresses of hosts, beside whoever hears multicast.
    """
    if os.environ.get(RANGE_VARIABLE, "").upper() in ("LOCALHOST", "OFF"):
        return
    addresses = host_addresses()
    group_port = participant_ports(domain_id, 0).discovery_multicast
    ours = [(a, port) for port in discovery_ports(domain_id) for a in addresses]
    # Two that do not exist: an answer goes to only one kind of address.
    calls = [announcement(ours), announcement([(MULTICAST_GROUP, group_port)])]
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.setblocking(False)
        for address in addresses:
            packed = socket.inet_aton(address)
            # The interface may be down, which is what we are here for.
            with contextlib.suppress(OSError):
                sender.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, packed)
                for call in calls:
                    sender.sendto(call, (MULTICAST_GROUP, group_port))
        ports = (participant_ports(domain_id, n).discovery_unicast for n in range(_PARTICIPANTS))
        for port in ports:
            for peer in peers:
                with contextlib.suppress(OSError):
                    sender.sendto(calls[0], (peer, port))


def tell_names(nodes: Iterable[Node]) -> None:
    """Have the participants of `nodes` tell anew which nodes and endpoints they have.

    rmw_fastrtps does so whenever an entity is made or unmade. Take one node of each participant.
    """
    for node in nodes:
        # Every node publishes parameter events: a second publisher of them, for a moment, is
        # nothing new to anybody.
        publisher = Node.create_publisher(
            node,
            ParameterEvent,
            "/parameter_events",
            QoSProfile(depth=1),
            event_callbacks=PublisherEventCallbacks(use_default_callbacks=False),
        )
        Node.destroy_publisher(node, publisher)
