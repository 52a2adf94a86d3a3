"""A plain rclpy node with parameters that knows nothing of us, and serves them as it is told.

    with_parameters.py [NAME] [--mute] [--hang] [--late FILE] [--ros-args …]

--mute serves no parameters, --hang never answers, --late declares the last one once FILE is there.
Prints `ready` once it is up, and lives until SIGINT, SIGTERM or the end of its parent.
"""

from __future__ import annotations

import argparse
import os
import signal
import sys
import threading
from pathlib import Path

import rclpy
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.node import Node


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("name", nargs="?", default="arm")
    for option in ("--mute", "--hang"):
        parser.add_argument(option, action="store_true")
    parser.add_argument("--late", type=Path)
    options = parser.parse_args(rclpy.utilities.remove_ros_args(sys.argv)[1:])
    end = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: end.set())
    rclpy.init(args=sys.argv, signal_handler_options=rclpy.SignalHandlerOptions.NO)
    node = Node(options.name, start_parameter_services=not options.mute)
    node.declare_parameter("gain", 1.5)
    node.declare_parameter("limits.low", -3, ParameterDescriptor(read_only=True))
    node.declare_parameter("joints", ["a", "b"])
    node.declare_parameter("offset", float("nan"))
    node.declare_parameter("unset", rclpy.Parameter.Type.DOUBLE)
    if not options.late:
        node.declare_parameter("mode", "slow", ParameterDescriptor(dynamic_typing=True))
    print("ready", flush=True)
    if not options.hang:
        executor = rclpy.executors.SingleThreadedExecutor()
        executor.add_node(node)
        threading.Thread(target=executor.spin, daemon=True).start()
    while options.late and not options.late.exists() and not end.wait(0.05):
        pass
    if options.late:
        node.declare_parameter("mode", "slow", ParameterDescriptor(dynamic_typing=True))
    parent = os.getppid()
    while not end.wait(0.5) and os.getppid() == parent:
        pass
    os._exit(0)


if __name__ == "__main__":
    main()
