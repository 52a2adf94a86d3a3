"""Rediscovery after an outage or a restart: announcements, node names, TCP retransmission.

Owns: what is sent while a peer is unreachable, what makes node names complete again, and how long
the kernel waits at most before it retransmits over TCP.

Two participants that lost each other for longer than their lease (20 s) drop one another, and then
each announces itself once in 3 s. `call_out` makes both sides announce themselves at once: a
participant that receives the announcement of one that does not exist answers to where it seems to
be (see probe.py). rmw_dds_common keeps the name of a node that was dropped out of the graph until
its participant publishes its entities anew, which `republish_names` makes it do, and no endpoint
may end for it.

The kernel doubles the time between TCP retransmissions each time, up to 120 s, so that after an
outage nothing passes for about as long again (RFC 6298 §5.5).
"""

from __future__ import annotations

import contextlib
import os
import socket
from collections.abc import Iterable, Mapping, Sequence

from rclpy.node import Node

from lifecycle.middleware.discovery.dead_peers import listening
from lifecycle.middleware.discovery.messages import disposal
from lifecycle.middleware.discovery.probe import (
    RANGE_VARIABLE,
    addresses_of,
    ask,
    chosen_otherwise,
    discovery_ports,
    group_targets,
    listed_targets,
    probe_targets,
    send,
    sender_by,
    well_known_targets,
)
from lifecycle.middleware.fastdds.sockets import sockets_here
from lifecycle.middleware.fastdds.url_profile import (
    DISCOVERY_GROUP,
    UrlTransport,
    families,
    leaves_discovery_open,
)
from lifecycle.middleware.rcl.hidden_node import bare_node
from lifecycle.network.connection_url import ConnectionUrl
from lifecycle.network.medium import RMW_DISCOVERY, Medium
from lifecycle.network.ports import participant_ports

_PARTICIPANTS = 32
"""Of a host whose address is known; further participants are reached by multicast."""

_ANSWERED_AT = 32
"""Participants of this host that an announcement names; each is 56 bytes of one datagram."""


def call_out(
    domain_id: int,
    urls: Sequence[ConnectionUrl],
    peers: Iterable[str],
    environment: Mapping[str, str],
) -> None:
    """Make participants of other hosts announce themselves to ours, and ours to them.

    Only as this participant's own discovery would: to its listed peers' ports where it has a list,
    by multicast where that is how others are found, and not at all over TCP and shared memory or
    behind a discovery server. Those announce themselves each 0.5 s anyway (url_profile.py).

    Args:
        domain_id: 0–232.
        urls: our participant's; none for what the RMW does by itself.
        peers: addresses of the unreachable hosts, where nothing lists participants.
        environment: where ROS_AUTOMATIC_DISCOVERY_RANGE and settings of Fast DDS are looked up.
    """
    if any(url.server for url in urls) or (not urls and chosen_otherwise(environment)):
        return
    found = [family for family in families(urls) if family.udp]
    if urls and not leaves_discovery_open(urls):
        for family in found:
            _call_listed(domain_id, family)
        return
    if environment.get(RANGE_VARIABLE, "").upper() in ("LOCALHOST", "OFF"):
        return  # nothing is looked for on another host
    kinds = tuple(family.kind for family in found) if urls else (RMW_DISCOVERY,)
    for kind in kinds:
        ipv6 = kind.ip_version == 6
        _call_around(domain_id, kind, [each for each in peers if (":" in each) == ipv6])


def _call_around(domain_id: int, kind: Medium, peers: Sequence[str]) -> None:
    interfaces = addresses_of(kind)
    group_port = participant_ports(domain_id, 0).discovery_multicast
    ports = discovery_ports(domain_id, kind)
    ours = [(a, port) for port in ports for found in interfaces.values() for a in found]
    group = tuple(group_targets(domain_id, kind, interfaces))
    targets = [
        target for peer in peers for target in well_known_targets(domain_id, peer, _PARTICIPANTS)
    ]
    with socket.socket(kind.socket_family, socket.SOCK_DGRAM) as sender:
        # Two that do not exist: an answer goes to only one kind of address.
        ask(sender, ours, (*group, *targets))
        ask(sender, [(DISCOVERY_GROUP[kind], group_port)], group)


def _call_listed(domain_id: int, family: UrlTransport) -> None:
    """Call the listed peers of other hosts, in the name of those of this one."""
    here = {a for found in addresses_of(family.kind, loopback=True).values() for a in found}
    listed = family.peers
    ours = [(url.address, url.metatraffic_port) for url in family.urls if url.address in here]
    ours += [(peer.address, peer.port) for peer in listed if peer.address in here]
    answered_at = [(address, port) for address, port in ours if port is not None]
    elsewhere = (peer for peer in listed if peer.address not in here)
    targets = listed_targets(domain_id, elsewhere, _PARTICIPANTS)
    if not answered_at or not targets:
        return
    output = family.output_port
    if (own := sender_by(family.kind.socket_family, output)) is None:
        return
    with own as sender:
        ask(sender, answered_at[:_ANSWERED_AT], targets, output)


def introduce(
    newcomers: Iterable[int],
    domain_id: int,
    urls: Sequence[ConnectionUrl],
    environment: Mapping[str, str],
    pids: Iterable[int],
    *,
    rediscover: str = "",
) -> None:
    """Make participants that have been there for long announce themselves to new ones at once.

    They answered the first announcement of a new one before it listened, and else announce
    themselves once in 3 s (see probe.py). Nothing is sent where the system's own discovery finds
    only listed peers (they announce themselves each 0.5 s, url_profile.py) or nobody, behind a
    discovery server, nor over shared memory and TCP.

    Args:
        newcomers: pids of the new processes of this host; nothing is sent before their participants
            listen.
        domain_id: 0–232.
        urls: of this process's observer.
        environment: see `probe.probe_targets`.
        pids: of this host's processes whose participants are to answer, besides all that the
            observer could find.
        rediscover: GUID prefix of the observer, where the new ones are to drop it and discover it
            again; empty otherwise. Then they send it what they had sent before, too.
    """
    asked = dict(probe_targets(domain_id, urls, environment))
    if not asked or (urls and not leaves_discovery_open(urls)):
        return
    new = frozenset(newcomers)
    if not any(listening(new).values()):
        return
    # The observer itself is no target of its own probes, and is to answer as well.
    for kind, found in listening((*new, *pids, os.getpid())).items():
        family = kind.socket_family
        theirs = [each for each, pid in found.items() if pid in new]
        answered_at = [(each.address, each.port) for each in theirs]
        targets = dict.fromkeys((*asked.get(kind, ()), *found))
        if not answered_at or not targets:
            continue
        with contextlib.suppress(OSError), socket.socket(family, socket.SOCK_DGRAM) as sender:
            if rediscover:
                send(sender, disposal(rediscover), theirs)
            ask(sender, answered_at[:_ANSWERED_AT], targets)


def republish_names(nodes: Iterable[Node]) -> None:
    """Make the participants of `nodes` publish anew which nodes and endpoints they have.

    rmw_fastrtps does so whenever a node or an endpoint is made or destroyed. Here it is a hidden
    node without endpoints, for a moment: when an endpoint ends, a discovery server of Fast DDS 2.14
    drops whatever it has not relayed yet of that participant's other endpoints, and never sends it
    again. Take one node of each participant.
    """
    for node in nodes:
        bare_node(node.context).destroy_when_not_in_use()


AT_MOST_S = 1.0
"""The least that Linux allows, and what healing may take."""

_GIVES_UP_S = 924
"""As long as Linux tries by default (tcp_retries2 of tcp(7)): it counts how often it sent again,
and would give up after 15 s. Fast DDS 2.14 does not get over a connection that was given up."""

_TCP_RTO_MAX_MS = 44  # linux/tcp.h, since Linux 6.15


def send_again_soon() -> int:
    """Make every TCP connection of this process retransmit within `AT_MOST_S`, for good.

    What is dialled later waits as long as ever; those accepted by a socket that listens now do
    not.

    Returns:
        How many sockets heed it: 0 before Linux 6.15, which has no such option.
    """
    count = 0
    for each in sockets_here():
        with contextlib.suppress(OSError):  # closed since, or a kernel without the option
            if each.type == socket.SOCK_STREAM and each.family in {socket.AF_INET, socket.AF_INET6}:
                each.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, _GIVES_UP_S * 1000)
                each.setsockopt(socket.IPPROTO_TCP, _TCP_RTO_MAX_MS, int(AT_MOST_S * 1000))
                count += 1
    return count
