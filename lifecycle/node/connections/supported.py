"""What a node can be connected by, talk in, and what for: the input of negotiation.

Owns: the transports, wire formats and communication paradigms of each RMW, as far as this package
can choose them (`connect_to`). See *Topological Discovery and Communication Negotiation*, "Node
Configuration Interface".
"""

from __future__ import annotations

import functools
import os
from pathlib import Path

from rclpy.utilities import get_rmw_implementation_identifier

from lifecycle.plan.negotiation.data_layer import PARADIGMS, SERIALIZATIONS

__all__ = ["PARADIGMS", "SERIALIZATIONS", "transports"]

_CONFIGURABLE_RMW = "rmw_fastrtps_cpp"
_SHARED_MEMORY = Path("/dev/shm")  # noqa: S108 - what Fast DDS uses
_IPV6_ADDRESSES = Path("/proc/net/if_inet6")


@functools.lru_cache(maxsize=1)
def transports() -> tuple[str, ...]:
    """Return what nodes of this process can be connected by, as connection URLs spell it.

    Empty where the RMW's transports are not ours to choose: then what its endpoints' NFEs tell is
    all that is known.
    """
    if get_rmw_implementation_identifier() != _CONFIGURABLE_RMW:
        return ()
    found = ["tcpv4", "udpm", "udpv4"]
    if os.access(_SHARED_MEMORY, os.W_OK):
        found.append("shm")
    try:
        if _IPV6_ADDRESSES.read_text(encoding="ascii").strip():
            found.append("udpv6")
    except OSError:
        pass  # a kernel without IPv6
    return tuple(sorted(found))
