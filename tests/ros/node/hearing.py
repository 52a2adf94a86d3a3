"""A node class for tests of what a node receives."""

from __future__ import annotations

from std_msgs.msg import String

from lifecycle import LifecycleNode, on_message


class Hearing(LifecycleNode):
    """Keeps what it receives on `in`."""

    def __init__(self) -> None:
        super().__init__()
        self.heard: list[str] = []

    @on_message("in")
    def receive(self, message: String) -> None:
        self.heard.append(message.data)
