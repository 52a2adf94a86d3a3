"""LifecycleNode: the class to derive from, its state machine, and how it is run.

Owns: the node's side of everything. Names load on first use: the control channel's types
need no ROS.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from lifecycle.public import public_name

if TYPE_CHECKING:
    from lifecycle.node.actions import GoalInterruptedError as GoalInterruptedError
    from lifecycle.node.author.handlers import on_action as on_action
    from lifecycle.node.author.handlers import on_goal as on_goal
    from lifecycle.node.author.handlers import on_message as on_message
    from lifecycle.node.author.handlers import on_service as on_service
    from lifecycle.node.author.handlers import on_timer as on_timer
    from lifecycle.node.author.node import ERROR as ERROR
    from lifecycle.node.author.node import FAILURE as FAILURE
    from lifecycle.node.author.node import SUCCESS as SUCCESS
    from lifecycle.node.author.node import LifecycleNode as LifecycleNode
    from lifecycle.node.author.node import TransitionCallbackReturn as TransitionCallbackReturn
    from lifecycle.node.connections.connection_status import ConnectionEvent as ConnectionEvent
    from lifecycle.node.connections.connection_status import (
        ConnectionEventKind as ConnectionEventKind,
    )
    from lifecycle.node.connections.connections import Connection as Connection
    from lifecycle.node.host.standalone import run as run

_PUBLIC: dict[str, tuple[str, ...]] = {
    "lifecycle.node.actions": ("GoalInterruptedError",),
    "lifecycle.node.author.handlers": (
        "on_action",
        "on_goal",
        "on_message",
        "on_service",
        "on_timer",
    ),
    "lifecycle.node.author.node": (
        "ERROR",
        "FAILURE",
        "LifecycleNode",
        "SUCCESS",
        "TransitionCallbackReturn",
    ),
    "lifecycle.node.connections.connection_status": ("ConnectionEvent", "ConnectionEventKind"),
    "lifecycle.node.connections.connections": ("Connection",),
    "lifecycle.node.host.standalone": ("run",),
}
"""What programs import from here (docs/api.md), by the module that has it."""


def __getattr__(name: str) -> object:
    """Load the module of a public name on first use (PEP 562)."""
    return public_name(__name__, _PUBLIC, name)
