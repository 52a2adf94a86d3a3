"""The obvious way to bring nodes up: one process each, then service calls one after the other.

Run by bring_up.py: `bring_up_baseline.py NODES` drives, `bring_up_baseline.py --node INDEX` is one
node. Prints `active` once all are.
"""

from __future__ import annotations

import contextlib
import signal
import subprocess
import sys

import rclpy
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rclpy.executors import ExternalShutdownException
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.node import Node
from std_msgs.msg import String

CALL_S = 5.0


class Theirs(LifecycleNode):
    """One publisher."""

    def __init__(self, index: int) -> None:
        super().__init__(f"node_{index}")
        self._index = index

    def on_configure(self, _: LifecycleState) -> TransitionCallbackReturn:
        """Make it."""
        self._out = self.create_lifecycle_publisher(String, f"out_{self._index}", 10)
        return TransitionCallbackReturn.SUCCESS


def node(index: int) -> None:
    rclpy.init()
    with contextlib.suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(Theirs(index))


def drive(nodes: int) -> None:
    processes = [
        subprocess.Popen([sys.executable, __file__, "--node", str(index)]) for index in range(nodes)
    ]
    rclpy.init()
    driver = Node("driver")
    clients = [
        driver.create_client(ChangeState, f"/node_{index}/change_state") for index in range(nodes)
    ]
    for transition in (Transition.TRANSITION_CONFIGURE, Transition.TRANSITION_ACTIVATE):
        for client in clients:
            change(driver, client, transition)
    print("active", flush=True)
    for process in processes:
        process.send_signal(signal.SIGINT)
    for process in processes:
        end(process)
    driver.destroy_node()
    rclpy.shutdown()


def end(process: subprocess.Popen[bytes]) -> None:
    """Wait for a node's end, but not for ever: destroying a participant may hang for good."""
    try:
        process.wait(10)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def change(driver: Node, client: object, transition: int) -> None:
    """Ask until it is answered: a reply is lost while the client is not matched yet."""
    request = ChangeState.Request()
    request.transition.id = transition
    while True:
        client.wait_for_service()
        future = client.call_async(request)
        rclpy.spin_until_future_complete(driver, future, timeout_sec=CALL_S)
        if future.done():
            return


if __name__ == "__main__":
    if sys.argv[1] == "--node":
        node(int(sys.argv[2]))
    else:
        drive(int(sys.argv[1]))
