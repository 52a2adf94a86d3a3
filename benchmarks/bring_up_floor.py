"""The floor of bring-up: what separate processes cost, whoever brings them up.

A fork server that has imported rclpy forks one process a node; each makes one managed node of rclpy
and is asked to configure and to activate it over a socket, all of them side by side. Nothing is
verified, watched or restarted, and nothing of the lifecycle package is used.

    python benchmarks/bring_up_floor.py NODES SHAPE

Prints `active` once all are, and ends on SIGINT once its nodes have left the graph.
"""

from __future__ import annotations

import contextlib
import gc
import os
import signal
import socket
import sys

import lifecycle_msgs.msg
import lifecycle_msgs.srv
import rcl_interfaces.msg
import rcl_interfaces.srv
import rclpy
import std_msgs.msg
import type_description_interfaces.srv
from bring_up_rclpy import Theirs
from rclpy.executors import ExternalShutdownException
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.type_support import check_is_valid_msg_type, check_is_valid_srv_type
from rclpy.utilities import get_rmw_implementation_identifier

MESSAGES = (
    lifecycle_msgs.msg.TransitionEvent,
    rcl_interfaces.msg.Log,
    rcl_interfaces.msg.ParameterEvent,
    std_msgs.msg.String,
)
SERVICES = (
    lifecycle_msgs.srv.ChangeState,
    lifecycle_msgs.srv.GetAvailableStates,
    lifecycle_msgs.srv.GetAvailableTransitions,
    lifecycle_msgs.srv.GetState,
    rcl_interfaces.srv.DescribeParameters,
    rcl_interfaces.srv.GetParameterTypes,
    rcl_interfaces.srv.GetParameters,
    rcl_interfaces.srv.ListParameters,
    rcl_interfaces.srv.SetParameters,
    rcl_interfaces.srv.SetParametersAtomically,
    type_description_interfaces.srv.GetTypeDescription,
)


def preload() -> None:
    """Load what every node loads: type supports, and Fast DDS itself."""
    get_rmw_implementation_identifier()
    for message in MESSAGES:
        check_is_valid_msg_type(message)
    for service in SERVICES:
        check_is_valid_srv_type(service)


def serve(index: int, shape: str, control: socket.socket) -> None:
    """Be a node, until SIGINT."""
    rclpy.init()
    with contextlib.suppress(KeyboardInterrupt, ExternalShutdownException):
        live(Theirs(index, shape), control)
    # A managed node is part of reference cycles, and with it the participant: what is not collected
    # would neither say goodbye nor give its shared memory back.
    gc.collect()
    rclpy.try_shutdown()


def live(node: Theirs, control: socket.socket) -> None:
    try:
        control.sendall(b"s")
        for step in (node.trigger_configure, node.trigger_activate):
            control.recv(1)
            done = step()
            control.sendall(b"k" if done is TransitionCallbackReturn.SUCCESS else b"f")
        rclpy.spin(node)
    finally:
        node.destroy_node()


def main() -> int:
    nodes, shape = int(sys.argv[1]), sys.argv[2]
    signal.signal(signal.SIGINT, signal.default_int_handler)
    preload()
    gc.collect()
    gc.freeze()  # a child's first collection would copy the shared pages
    controls: list[socket.socket] = []
    children: list[int] = []
    for index in range(nodes):
        ours, theirs = socket.socketpair()
        child = os.fork()
        if not child:
            code = 1
            try:
                serve(index, shape, theirs)
                code = 0
            finally:
                os._exit(code)
        theirs.close()
        controls.append(ours)
        children.append(child)
    code = 0
    # Each step is waited for at every node, as a supervisor must that verifies before it activates.
    for step in (b"", b"c", b"a"):
        for control in controls:
            control.sendall(step)
        if any(control.recv(1) not in (b"s", b"k") for control in controls):
            print("a node failed", file=sys.stderr)
            code = 1
            break
    else:
        with contextlib.suppress(KeyboardInterrupt):
            print("active", flush=True)
            signal.pause()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    for child in children:
        os.kill(child, signal.SIGINT)
    for child in children:
        os.waitpid(child, 0)
    return code


if __name__ == "__main__":
    code = main()
    sys.stdout.flush()
    os._exit(code)
