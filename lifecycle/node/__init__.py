"""LifecycleNode: the class to derive from, its state machine, and how it is run.

Owns: the node's side of everything. Names load on first use: the control channel's types
need no ROS.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from lifecycle.public import public_name

if TYPE_CHECKING:
    from lifecycle.node.connections import Connection as Connection
    from lifecycle.node.connections import ConnectionEvent as ConnectionEvent
    from lifecycle.node.connections import ConnectionEventKind as ConnectionEventKind

_PUBLIC: dict[str, tuple[str, ...]] = {
    "lifecycle.node.connections": ("Connection", "ConnectionEvent", "ConnectionEventKind"),
}
"""What programs import from here (docs/api.md), by the module that has it."""


def __getattr__(name: str) -> object:
    """Load the module of a public name on first use (PEP 562)."""
    return public_name(__name__, _PUBLIC, name)
