"""Declarative manifests for ROS 2 systems, verified before they are activated.

What a node's author needs is here: `from lifecycle import LifecycleNode, on_message, run`. The
names load on first use, so that `import lifecycle` needs no ROS.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from lifecycle.node.actions import GoalInterruptedError
    from lifecycle.node.author.handlers import on_action, on_goal, on_message, on_service, on_timer
    from lifecycle.node.author.node import (
        ERROR,
        FAILURE,
        SUCCESS,
        LifecycleNode,
        TransitionCallbackReturn,
    )
    from lifecycle.node.host.standalone import run

__all__ = [
    "ERROR",
    "FAILURE",
    "SUCCESS",
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


def __getattr__(name: str) -> object:
    """Load a name of `lifecycle.node` (PEP 562)."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from lifecycle import node

    return getattr(node, name)
