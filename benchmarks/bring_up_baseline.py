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
from lifecycle_msgs.msg import State, Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.task import Future

AGAIN_S = 1.0
LOST_S = 20.0
LOOK_S = 0.02
END_S = 10.0
STEPS = {
    State.PRIMARY_STATE_UNCONFIGURED: Transition.TRANSITION_CONFIGURE,
    State.PRIMARY_STATE_INACTIVE: Transition.TRANSITION_ACTIVATE,
}
NEXT = {
    State.PRIMARY_STATE_UNCONFIGURED: State.PRIMARY_STATE_INACTIVE,
    State.PRIMARY_STATE_INACTIVE: State.PRIMARY_STATE_ACTIVE,
}
PROGRAM = Path(__file__).with_name("bring_up_rclpy.py")


class Driver(Node):
    """Configures and activates all nodes at once."""

    def __init__(self, nodes: int) -> None:
        super().__init__("driver")
        names = [f"/node_{index}" for index in range(nodes)]
        self._changes = [self.create_client(ChangeState, f"{name}/change_state") for name in names]
        self._states = [self.create_client(GetState, f"{name}/get_state") for name in names]
        self._state = [State.PRIMARY_STATE_UNCONFIGURED] * nodes
        self._asked_s: list[float | None] = [None] * nodes
        self._sent_s = [0.0] * nodes
        self.create_timer(LOOK_S, self._look)

    @property
    def is_done(self) -> bool:
        """Whether all nodes are active."""
        return all(each == State.PRIMARY_STATE_ACTIVE for each in self._state)

    def _look(self) -> None:
        """Ask each node that can be asked; where a reply is late, for its state first.

        A reply is lost while the client is not matched with its writer yet.
        """
        for index, asked_s in enumerate(self._asked_s):
            if self._state[index] == State.PRIMARY_STATE_ACTIVE:
                continue
            if asked_s is None:
                if self._changes[index].service_is_ready():
                    self._change(index)
            elif time.monotonic() - asked_s > AGAIN_S and self._states[index].service_is_ready():
                self._asked_s[index] = time.monotonic()
                call = self._states[index].call_async(GetState.Request())
                call.add_done_callback(functools.partial(self._told, index))

    def _change(self, index: int) -> None:
        state = self._state[index]
        request = ChangeState.Request()
        request.transition.id = STEPS[state]
        self._asked_s[index] = self._sent_s[index] = time.monotonic()
        call = self._changes[index].call_async(request)
        call.add_done_callback(functools.partial(self._changed, index, state))

    def _changed(self, index: int, before: int, _: Future) -> None:
        if self._state[index] == before:
            self._reached(index, NEXT[before])

    def _told(self, index: int, future: Future) -> None:
        """Ask for a transition again only long after: a node of rclpy ends on a second one."""
        state = future.result().current_state.id
        if state > self._state[index] or time.monotonic() - self._sent_s[index] > LOST_S:
            self._reached(index, state)

    def _reached(self, index: int, state: int) -> None:
        if state in (*STEPS, State.PRIMARY_STATE_ACTIVE):
            self._state[index] = state
            if state in STEPS:
                self._change(index)


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
