"""Programs as people write them for rclpy, none of which knows of us: `programs.py ROLE [FILE]`.

What was done to them by hand before they are captured they do themselves while FILE is not there:
a parameter is set, a managed node is activated, a client's server does not come.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import sys
import time
from pathlib import Path

import rclpy
from rcl_interfaces.srv import ListParameters
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.lifecycle import LifecycleNode, TransitionCallbackReturn
from rclpy.node import Node
from rclpy.parameter import Parameter
from std_msgs.msg import String
from std_srvs.srv import Trigger


class Ticker(Node):
    def __init__(self, name: str, topic: str) -> None:
        super().__init__(name)
        self._publisher = self.create_publisher(String, topic, 5)
        self.create_timer(0.2, lambda: self._publisher.publish(String(data="tick")))


class Hearer(Node):
    def __init__(self, name: str, topic: str) -> None:
        super().__init__(name)
        self.create_subscription(String, topic, lambda _: None, 5)


class Server(Node):
    def __init__(self) -> None:
        super().__init__("server")
        self.declare_parameter("limit", 1)
        self.create_service(Trigger, "reset", lambda _, response: response)


class Managed(LifecycleNode):
    def on_configure(self, state: object) -> TransitionCallbackReturn:
        self._publisher = self.create_lifecycle_publisher(String, "~/status", 5)
        return TransitionCallbackReturn.SUCCESS


def several(go: Path) -> list[Node]:
    node = Ticker("left", "ticks")
    node.declare_parameter("rate", 1.0)
    if not go.exists():
        node.set_parameters([Parameter("rate", value=7.5)])
    return [node, Hearer("right", "ticks")]


def managed(go: Path) -> list[Node]:
    node = Managed("managed")
    if not go.exists():
        node.trigger_configure()
        node.trigger_activate()
    return [node, Managed("new")]


def client(go: Path) -> None:
    node = rclpy.create_node("client")
    node.create_client(Trigger, "/robot/clear")
    print("ready", flush=True)
    while not go.exists():
        time.sleep(0.05)
    node.destroy_node()


class AskedError(Exception):
    """Somebody wants to know."""


def brief() -> None:
    """Publish, and be gone before anybody who asks for the parameters has an answer."""

    def ask(request: object, response: object) -> object:
        raise AskedError

    node = rclpy.create_node("brief", start_parameter_services=False)
    node.create_publisher(String, "news", 5)
    node.create_service(ListParameters, "~/list_parameters", ask)
    with contextlib.suppress(AskedError):
        rclpy.spin(node)
    node.destroy_node()
    os._exit(0)  # at once: on a busy machine leaving takes longer than who asks waits


def main() -> None:
    own = None
    if "--ros-args" not in sys.argv:  # as with argparse in most programs: no other word is taken
        parser = argparse.ArgumentParser()
        parser.add_argument("role")
        parser.add_argument("go", type=Path, nargs="?", default=Path("go"))
        options = parser.parse_args()
        role, go, own = options.role, options.go, []
    else:
        role, go = sys.argv[1], Path("go")
    rclpy.init(args=own)
    if role in ("client", "brief"):
        client(go) if role == "client" else brief()
        rclpy.try_shutdown()
        return
    nodes = {
        "several": lambda: several(go),
        "managed": lambda: managed(go),
        "server": lambda: [Server()],
    }[role]()
    executor = SingleThreadedExecutor()
    for node in nodes:
        executor.add_node(node)
    print("ready", flush=True)
    try:
        executor.spin()
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
