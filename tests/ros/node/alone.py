"""A program with one node that declares its endpoints in code."""

from __future__ import annotations

import sys

from std_msgs.msg import Int32

import lifecycle


class Counter(lifecycle.LifecycleNode):
    """Counts."""

    def __init__(self) -> None:
        super().__init__("counter", lifecycle="auto")
        self.declare_publisher("count", Int32)
        self.count = 0

    def on_activate(self) -> None:
        """Fail if asked to."""
        if "fail" in sys.argv:
            raise OSError("no such counter")

    @lifecycle.on_timer(period_s=0.02)
    def tick(self) -> None:
        """Publish the next number."""
        self.count += 1
        self.publisher("count").publish(Int32(data=self.count))


if __name__ == "__main__":
    lifecycle.run(Counter, lifecycle="manual" if "manual" in sys.argv else None)
