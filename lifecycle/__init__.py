"""Declarative manifests for ROS 2 systems, verified before they are activated.

What a node's author needs is here: `from lifecycle import LifecycleNode, on_message, run`. The
names load on first use, so that `import lifecycle` needs no ROS.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

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

_NODE = ("ERROR", "FAILURE", "SUCCESS", "LifecycleNode", "TransitionCallbackReturn")
_HOME = {
    **dict.fromkeys(_NODE, "node"),
    "run": "host.standalone",
}
"""Module of `lifecycle.node` that has a name; of others `handlers`."""


def __getattr__(name: str) -> object:
    """Load the module of a public name on first use (PEP 562)."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    import importlib

    return getattr(importlib.import_module(f"lifecycle.node.{_HOME.get(name, 'handlers')}"), name)
