"""Ports for connection URLs in tests."""

from __future__ import annotations

import contextlib
import os
import socket

from lifecycle.network.ports import DG, PB

_FIRST = 120
"""Of a domain's ports; participants have those below, more than a test ever has."""


def free_ports(count: int) -> list[int]:
    """Return ports that are free, for UDP and TCP, and that no other test process takes.

    They are of the domain that this test has claimed for itself.
    """
    first = PB + DG * int(os.environ["ROS_DOMAIN_ID"])
    found: list[int] = []
    with contextlib.ExitStack() as stack:
        for port in range(first + _FIRST, first + DG):
            try:
                for kind in (socket.SOCK_DGRAM, socket.SOCK_STREAM):
                    each = stack.enter_context(socket.socket(socket.AF_INET, kind))
                    each.bind(("127.0.0.1", port))
            except OSError:
                continue
            found.append(port)
            if len(found) == count:
                return found
    raise AssertionError(f"fewer than {count} ports of domain {os.environ['ROS_DOMAIN_ID']} free")


def first_port() -> int:
    """Return the first of more free ports than a planner gives out to two nodes."""
    return free_ports(20)[0]
