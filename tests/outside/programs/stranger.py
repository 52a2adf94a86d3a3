"""A program that belongs to no manifest: `stranger.py NAME [pub:/t] [sub:/t] [srv:/s] ...`.

    pub:/t     a publisher of std_msgs/String that sends `STRANGER` ten times a second
    sub:/t     a subscription of std_msgs/String
    srv:/s     a std_srvs/Trigger server that answers `STRANGER`
    cli:/s     a std_srvs/Trigger client
    clock      a publisher of /clock, ten times a second
    act:/a     an action server, test_msgs/Fibonacci
    ns:/x      the node's namespace
    for:S      leaves by itself after S seconds
    churn:S    makes and destroys a subscription of /churn each S seconds

It prints `ready` once all exist, and leaves the graph properly on SIGTERM.
"""

from __future__ import annotations

import signal
import sys
import time
from typing import Any

import rclpy
from rclpy.node import Node
from std_msgs.msg import String
from std_srvs.srv import Trigger


class LeavingError(Exception):
    """SIGTERM came."""


def leave(*_: object) -> None:
    raise LeavingError


def publish_forever(node: Node, topic: str) -> None:
    publisher = node.create_publisher(String, topic, 10)
    node.create_timer(0.1, lambda: publisher.publish(String(data="STRANGER")))


def serve(node: Node, name: str) -> None:
    def answer(_: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.success, response.message = True, "STRANGER"
        return response

    node.create_service(Trigger, name, answer)


def publish_clock(node: Node, _: str) -> None:
    from rosgraph_msgs.msg import Clock

    publisher = node.create_publisher(Clock, "/clock", 10)

    def tick() -> None:
        now = Clock()
        now.clock.sec = int(time.monotonic())
        publisher.publish(now)

    node.create_timer(0.1, tick)


def serve_action(node: Node, name: str) -> None:
    from rclpy.action import ActionServer
    from test_msgs.action import Fibonacci

    keep.append(ActionServer(node, Fibonacci, name, lambda _: Fibonacci.Result()))


def churn(node: Node, period_s: str) -> None:
    made: list[Any] = []

    def turn() -> None:
        if made:
            node.destroy_subscription(made.pop())
        else:
            made.append(node.create_subscription(String, "/churn", lambda _: None, 10))

    node.create_timer(float(period_s), turn)


keep: list[Any] = []
DOES = {
    "pub": publish_forever,
    "sub": lambda node, topic: node.create_subscription(String, topic, lambda _: None, 10),
    "srv": serve,
    "cli": lambda node, name: node.create_client(Trigger, name),
    "clock": publish_clock,
    "act": serve_action,
    "churn": churn,
}


def main(name: str, *words: str) -> None:
    values = [word.partition(":")[::2] for word in words]
    namespace = next((value for key, value in values if key == "ns"), None)
    lasts_s = float(next((value for key, value in values if key == "for"), "inf"))
    signal.signal(signal.SIGTERM, leave)
    rclpy.init()
    node = Node(name, namespace=namespace, start_parameter_services=False, enable_rosout=False)
    try:
        for key, value in values:
            if key in DOES:
                DOES[key](node, value)
        print("ready", flush=True)
        until = time.monotonic() + lasts_s
        while time.monotonic() < until:
            rclpy.spin_once(node, timeout_sec=0.05)
    except (LeavingError, KeyboardInterrupt):
        pass
    finally:
        for each in keep:
            each.destroy()
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main(*sys.argv[1:])
