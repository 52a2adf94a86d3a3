"""The obvious way to bring nodes up: one process each, and lifecycle service calls side by side.

What one writes without a supervisor: every node is a `python` of its own, and each is asked to
configure as soon as its service is there, and to activate as soon as it has. Nothing is verified.

    python benchmarks/bring_up_baseline.py NODES SHAPE

Prints `active` once all are, and ends its nodes and itself on SIGINT.
"""

from __future__ import annotations

import contextlib
import functools
import signal
import subprocess
import sys
import time
from pathlib import Path

import rclpy
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.task import Future

AGAIN_S = 2.0
LOOK_S = 0.02
END_S = 10.0
PROGRAM = Path(__file__).with_name("bring_up_rclpy.py")


class Driver(Node):
    """Configures and activates all nodes at once."""

    def __init__(self, nodes: int) -> None:
        super().__init__("driver")
        self._calls = [
            self.create_client(ChangeState, f"/node_{index}/change_state") for index in range(nodes)
        ]
        self._steps = [
            [Transition.TRANSITION_ACTIVATE, Transition.TRANSITION_CONFIGURE] for _ in self._calls
        ]
        self._asked_s = [0.0] * nodes
        self.create_timer(LOOK_S, self._ask)

    @property
    def is_done(self) -> bool:
        """Whether all nodes are active."""
        return not any(self._steps)

    def _ask(self) -> None:
        """Ask whoever can be asked; again if there was no answer.

        A reply is lost while the client is not matched with it yet.
        """
        for index, call in enumerate(self._calls):
            late = time.monotonic() - self._asked_s[index] > AGAIN_S
            if self._steps[index] and late and call.service_is_ready():
                self._request(index)

    def _request(self, index: int) -> None:
        step = self._steps[index][-1]
        request = ChangeState.Request()
        request.transition.id = step
        self._asked_s[index] = time.monotonic()
        answered = functools.partial(self._answered, index, step)
        self._calls[index].call_async(request).add_done_callback(answered)

    def _answered(self, index: int, step: int, _: Future) -> None:
        """Go on, also after a refusal: then an earlier request was carried out."""
        if self._steps[index] and self._steps[index][-1] == step:
            self._steps[index].pop()
            if self._steps[index]:
                self._request(index)


def main() -> None:
    nodes, shape = int(sys.argv[1]), sys.argv[2]
    processes = [
        subprocess.Popen([sys.executable, str(PROGRAM), str(index), shape], start_new_session=True)
        for index in range(nodes)
    ]
    rclpy.init()
    driver = Driver(nodes)
    with contextlib.suppress(KeyboardInterrupt, ExternalShutdownException):
        while not driver.is_done:
            rclpy.spin_once(driver)
        print("active", flush=True)
        rclpy.spin(driver)
    for process in processes:
        process.send_signal(signal.SIGINT)
    for process in processes:
        end(process)
    driver.destroy_node()
    rclpy.try_shutdown()


def end(process: subprocess.Popen[bytes]) -> None:
    """Wait for a node's end, but not for ever: destroying a participant may hang for good."""
    try:
        process.wait(END_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


if __name__ == "__main__":
    main()
