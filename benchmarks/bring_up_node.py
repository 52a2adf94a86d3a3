"""The node of the bring-up benchmark: as it is under `lifecycle up`, and as an rclpy node."""

from __future__ import annotations

from lifecycle import LifecycleNode


class Ours(LifecycleNode):
    """One publisher, which the manifest declares."""
