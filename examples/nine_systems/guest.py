"""A listener that no manifest knows: it declares itself, brings itself up, and is connected.

Start it beside a running system with `python -m examples.nine_systems.guest`.
"""

from __future__ import annotations

from std_msgs.msg import String

import lifecycle
from examples.nine_systems.nodes import Listener


class Guest(Listener):
    """Hears what the talker says."""

    def __init__(self) -> None:
        super().__init__("guest", lifecycle="auto")
        self.declare_subscription("chatter", String)


if __name__ == "__main__":
    lifecycle.run(Guest)
