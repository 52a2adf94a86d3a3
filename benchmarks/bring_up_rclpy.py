"""The node of the bring-up benchmark as rclpy's own managed node, and as a program of its own.

    python benchmarks/bring_up_rclpy.py INDEX SHAPE

Everything but `lifecycle up` runs it; it imports nothing of the lifecycle package.
"""

from __future__ import annotations

import contextlib
import sys

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from std_msgs.msg import String

CHAIN = 5
"""Publishers of a node, each of which the next node subscribes to."""


class Theirs(LifecycleNode):
    """One publisher; in a chain five, and five subscriptions."""

    def __init__(self, index: int, shape: str) -> None:
        super().__init__(f"node_{index}")
        self._index = index
        self._chain = shape == "chain"

    def on_configure(self, _: LifecycleState) -> TransitionCallbackReturn:
        """Make them."""
        if not self._chain:
            self.create_lifecycle_publisher(String, f"out_{self._index}", 10)
            return TransitionCallbackReturn.SUCCESS
        for number in range(CHAIN):
            self.create_lifecycle_publisher(String, f"link_{self._index}_{number}", 10)
            if self._index:
                topic = f"link_{self._index - 1}_{number}"
                self.create_subscription(String, topic, self._receive, 10)
        return TransitionCallbackReturn.SUCCESS

    def _receive(self, _: String) -> None:
        """Nothing is sent."""


def main() -> None:
    # launch_ros appends --ros-args.
    index, shape = sys.argv[1:3]
    rclpy.init()
    with contextlib.suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(Theirs(int(index), shape))


if __name__ == "__main__":
    main()
