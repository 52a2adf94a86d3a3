"""LifecycleNode: the class to derive from, its state machine, and how it is run.

Owns: the node's side of everything.
"""

from __future__ import annotations

from lifecycle.public import names

__getattr__ = names(
    __name__,
    connections="Connection",
)
