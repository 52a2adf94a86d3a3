"""A plain rclpy node, started as a command or by a test, that is what its arguments say.

    foreign.py NAME [--publish TOPIC:TYPE:RELIABILITY] [--subscribe TOPIC:TYPE:RELIABILITY]
               [--serve ACTION:TYPE] [--answer SERVICE:TYPE] [--call SERVICE:TYPE]
               [--redefine TYPE] [--exit STATUS] [--ros-args …]

`--redefine` makes it announce another definition of a type, package/msg/Type or package/srv/Type.

Prints `ready` once its endpoints exist, and lives until SIGINT, SIGTERM or the end of its parent.
"""

from __future__ import annotations

import argparse
import gc
import importlib
import os
import signal
import sys
import threading

import rclpy
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.waitable import Waitable
from redefine import redefine  # beside it: this is run as a program


def endpoint(text: str) -> tuple[str, type, QoSProfile]:
    topic, type_, reliability = text.split(":")
    package, _, name = type_.split("/")
    message = getattr(importlib.import_module(f"{package}.msg"), name)
    return topic, message, QoSProfile(depth=10, reliability=ReliabilityPolicy[reliability])


def action(text: str) -> tuple[str, type]:
    name, type_ = text.split(":")
    package, _, class_ = type_.split("/")
    return name, getattr(importlib.import_module(f"{package}.action"), class_)


def service(text: str) -> tuple[str, type]:
    name, type_ = text.split(":")
    return name, interface(type_)


def interface(type_: str) -> type:
    package, kind, name = type_.split("/")
    return getattr(importlib.import_module(f"{package}.{kind}"), name)


def serve(node: Node, name: str, type_: type) -> Waitable:
    from rclpy.action import ActionServer  # late: numpy, and few need it

    return ActionServer(node, type_, name, lambda _: type_.Result())


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("name")
    parser.add_argument("--publish", type=endpoint, action="append", default=[])
    parser.add_argument("--subscribe", type=endpoint, action="append", default=[])
    parser.add_argument("--serve", type=action, action="append", default=[])
    parser.add_argument("--answer", type=service, action="append", default=[])
    parser.add_argument("--call", type=service, action="append", default=[])
    parser.add_argument("--redefine", type=interface, action="append", default=[])
    parser.add_argument("--exit", type=int)
    options = parser.parse_args(rclpy.utilities.remove_ros_args(sys.argv)[1:])
    if options.exit is not None:
        print("cannot find /dev/lidar0", file=sys.stderr)
        sys.exit(options.exit)
    for each in options.redefine:
        redefine(each)
    end = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: end.set())
    rclpy.init(args=sys.argv, signal_handler_options=rclpy.SignalHandlerOptions.NO)
    node = Node(options.name)
    for topic, message, qos in options.publish:
        node.create_publisher(message, topic, qos)
    for topic, message, qos in options.subscribe:
        node.create_subscription(message, topic, lambda _: None, qos)
    for name, type_ in options.answer:
        node.create_service(type_, name, lambda _, response: response)
    for name, type_ in options.call:
        node.create_client(type_, name)
    servers = [serve(node, name, type_) for name, type_ in options.serve]
    print("ready", flush=True)
    parent = os.getppid()
    # Bounded: if whoever started this dies without a signal, it must not outlive the test run.
    while not end.is_set() and os.getppid() == parent:
        rclpy.spin_once(node, timeout_sec=0.1)
    while servers:
        servers.pop().destroy()
    node.destroy_node()
    rclpy.shutdown()
    del node
    gc.collect()
    os._exit(0)


if __name__ == "__main__":
    main()
