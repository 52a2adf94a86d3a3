"""LifecycleNode: the class to derive from, its state machine, and how it is run.

Owns: the node's side of everything. Names load on first use, so that the control channel's types
can be imported where there is no ROS.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from lifecycle.node.actions import GoalInterruptedError
    from lifecycle.node.author.handlers import on_action, on_goal, on_message, on_service, on_timer
    from lifecycle.node.author.node import LifecycleNode
    from lifecycle.node.author.returns import ERROR, FAILURE, SUCCESS, TransitionCallbackReturn
    from lifecycle.node.connections.connection_status import ConnectionEvent, ConnectionEventKind
    from lifecycle.node.connections.connections import Connection
    from lifecycle.node.host.standalone import run

__all__ = [
    "ERROR",
    "FAILURE",
    "SUCCESS",
    "Connection",
    "ConnectionEvent",
    "ConnectionEventKind",
    "GoalInterruptedError",
    "LifecycleNode",
    "TransitionCallbackReturn",
    "on_action",
    "on_goal",
    "on_message",
    "on_service",
    "on_timer",
    "run",
]

_HOME = {
    "Connection": "connections.connections",
    "ConnectionEvent": "connections.connection_status",
    "ConnectionEventKind": "connections.connection_status",
    "ERROR": "author.returns",
    "FAILURE": "author.returns",
    "SUCCESS": "author.returns",
    "GoalInterruptedError": "actions",
    "LifecycleNode": "author.node",
    "TransitionCallbackReturn": "author.returns",
    "on_action": "author.handlers",
    "on_goal": "author.handlers",
    "on_message": "author.handlers",
    "on_service": "author.handlers",
    "on_timer": "author.handlers",
    "run": "host.standalone",
}


def __getattr__(name: str) -> object:
    """Import the module that defines `name` (PEP 562)."""
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_HOME[name]}"), name)
