"""The address that this host sends from to a destination, as its routing decides.

Owns: asking the kernel. A publisher's socket is bound to `0.0.0.0`, so the source address of its
packets is known only by the route they take. For publishers on other machines this host cannot
tell.
"""

from __future__ import annotations

import socket

import psutil

from lifecycle.network.address import canonical, is_loopback
from lifecycle.plan.model import Plan, PlannedNode

_DISCARD_PORT = 9
"""RFC 863; connecting a UDP socket sends nothing."""


class RouteSources:
    """Observes source addresses, see export.rules.SourceAddress.

    Args:
        plan: says which machine a node is on.
        machine: the machine that this host is; empty to tell by the addresses it has.
    """

    def __init__(self, plan: Plan, machine: str = "") -> None:
        own = {
            canonical(each.address.partition("%")[0])
            for addresses in psutil.net_if_addrs().values()
            for each in addresses
            if each.family in (socket.AF_INET, socket.AF_INET6)
        }
        self._local = {
            each.name
            for each in plan.machines
            if each.name == machine or not each.address or canonical(each.address) in own
        }
        self._machines = {each.name for each in plan.machines}

    def __call__(self, node: PlannedNode, destination: str) -> str:
        """Return the address; empty for a node of another machine, or if there is no route."""
        if node.machine in self._machines and node.machine not in self._local:
            return ""
        if is_loopback(destination):
            # A packet to loopback comes from loopback, whatever the routing says.
            return canonical(destination)
        return route_source(destination)


def route_source(destination: str) -> str:
    """Return the address that this host sends from to `destination`; empty if it has no route."""
    family = socket.AF_INET6 if ":" in destination else socket.AF_INET
    with socket.socket(family, socket.SOCK_DGRAM) as sock:
        try:
            sock.connect((destination, _DISCARD_PORT))
        except OSError:
            return ""
        return canonical(str(sock.getsockname()[0]))
