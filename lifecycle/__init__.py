"""Declarative manifests for ROS 2 systems, verified before they are activated.

What a node's author needs is here: `from lifecycle import LifecycleNode, on_message, run`. The
names load on first use, so that `import lifecycle` needs no ROS.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from lifecycle.public import public_name

if TYPE_CHECKING:
    from lifecycle.node.handlers import on_action, on_goal, on_message, on_service, on_timer
    from lifecycle.node.host.standalone import run
    from lifecycle.node.node import ERROR, FAILURE, SUCCESS, LifecycleNode, TransitionCallbackReturn

__all__ = [
    "ERROR",
    "FAILURE",
    "SUCCESS",
    "LifecycleNode",
    "TransitionCallbackReturn",
    "on_action",
    "on_goal",
    "on_message",
    "on_service",
    "on_timer",
    "run",
]


_PUBLIC: dict[str, tuple[str, ...]] = {
    "lifecycle.node.handlers": (
        "on_action",
        "on_goal",
        "on_message",
        "on_service",
        "on_timer",
    ),
    "lifecycle.node.node": (
        "ERROR",
        "FAILURE",
        "LifecycleNode",
        "SUCCESS",
        "TransitionCallbackReturn",
    ),
    "lifecycle.node.host.standalone": ("run",),
}


def __getattr__(name: str) -> object:
    """Load the module of a public name on first use (PEP 562)."""
    return public_name(__name__, _PUBLIC, name)
