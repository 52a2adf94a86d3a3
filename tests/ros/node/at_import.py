"""A module that makes a node while it is imported, as scripts do."""

from __future__ import annotations

from rclpy.node import Node

from lifecycle import LifecycleNode

HELPER = Node("helper")


class Late(LifecycleNode):
    """Lives on the participant that the helper had made."""
