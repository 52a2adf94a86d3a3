"""LifecycleNode: what people subclass, its state machine, and how it is run.

Owns: the node's side of everything. Names load on first use, so that the control channel's types
can be imported where there is no ROS.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from lifecycle.node.connection_events import ConnectionEvent, ConnectionEventKind
    from lifecycle.node.connections import Connection
    from lifecycle.node.goal_run import GoalInterruptedError
    from lifecycle.node.handlers import on_action, on_goal, on_message, on_service, on_timer
    from lifecycle.node.node import LifecycleNode
    from lifecycle.node.returns import ERROR, FAILURE, SUCCESS, TransitionCallbackReturn
    from lifecycle.node.standalone import run

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
    "host",
    "on_action",
    "on_goal",
    "on_message",
    "on_service",
    "on_timer",
    "run",
]

_HOME = {
    "Connection": "connections",
    "ConnectionEvent": "connection_events",
    "ConnectionEventKind": "connection_events",
    "ERROR": "returns",
    "FAILURE": "returns",
    "SUCCESS": "returns",
    "GoalInterruptedError": "goal_run",
    "LifecycleNode": "node",
    "TransitionCallbackReturn": "returns",
    "on_action": "handlers",
    "on_goal": "handlers",
    "on_message": "handlers",
    "on_service": "handlers",
    "on_timer": "handlers",
    "run": "standalone",
}


def __getattr__(name: str) -> object:
    """Import the module that defines `name` (PEP 562)."""
    if name == "host":
        return importlib.import_module("lifecycle.node.host")
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_HOME[name]}"), name)
