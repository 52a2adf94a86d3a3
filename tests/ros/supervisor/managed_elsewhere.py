"""A managed node of rclpy's, started as a command: it does what anybody asks of it.

Prints `base is STATE` after each transition.
"""

from __future__ import annotations

import contextlib

import rclpy
from rclpy.lifecycle import LifecycleNode, TransitionCallbackReturn


class Base(LifecycleNode):
    def on_activate(self, state):
        print("base is active", flush=True)
        return super().on_activate(state)

    def on_deactivate(self, state):
        print("base is inactive", flush=True)
        return super().on_deactivate(state)

    def on_configure(self, state):
        return TransitionCallbackReturn.SUCCESS


def main() -> None:
    rclpy.init()
    node = Base("base")
    with contextlib.suppress(KeyboardInterrupt, rclpy.executors.ExternalShutdownException):
        rclpy.spin(node)


if __name__ == "__main__":
    main()
