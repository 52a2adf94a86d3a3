"""The nodes of the bring-up benchmark as they are under `lifecycle up`."""

from __future__ import annotations

from std_msgs.msg import String

from lifecycle import LifecycleNode, on_message


class Ours(LifecycleNode):
    """One publisher, which the manifest declares."""


class Chained(LifecycleNode):
    """Five publishers, and five subscriptions."""

    @on_message("in_0")
    @on_message("in_1")
    @on_message("in_2")
    @on_message("in_3")
    @on_message("in_4")
    def receive(self, _: String) -> None:
        """Nothing is sent."""
