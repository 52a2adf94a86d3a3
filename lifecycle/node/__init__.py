"""LifecycleNode: the class to derive from, its state machine, and how it is run.

Owns: the node's side of everything. Names load on first use: the control channel's types
need no ROS.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from lifecycle.public import public_name

if TYPE_CHECKING:
    from lifecycle.node.connections.connection_status import ConnectionEvent as ConnectionEvent
    from lifecycle.node.connections.connection_status import (
        ConnectionEventKind as ConnectionEventKind,
    )
    from lifecycle.node.connections.connections import Connection as Connection

_PUBLIC: dict[str, tuple[str, ...]] = {
    "lifecycle.node.connections.connection_status": ("ConnectionEvent", "ConnectionEventKind"),
    "lifecycle.node.connections.connections": ("Connection",),
}
"""What programs import from here (docs/api.md), by the module that has it."""


def __getattr__(name: str) -> object:
    """Load the module of a public name on first use (PEP 562)."""
    return public_name(__name__, _PUBLIC, name)
