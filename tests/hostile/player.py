"""Plays nodes of any name, one DDS participant for all: reads `WAY NAME` lines, answers `done`."""

from __future__ import annotations

import sys
import threading

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from std_msgs.msg import String
from std_srvs.srv import Trigger

from tests.hostile.answers import ANSWERS


def _answer(text: str, *, success: bool = True):
    def serve(_: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.success, response.message = success, text
        return response

    return serve


def _play(node: Node, way: str) -> None:
    match way:
        case "publish":
            node.create_publisher(String, "/chatter", 10)
        case _:
            answer = ANSWERS[way]
            success = way != "no success"
            from rcl_interfaces.srv import SetParameters

            node.create_publisher(String, "~/said", 10)
            node.create_service(Trigger, "~/get_configuration", _answer(answer, success=success))
            node.create_service(SetParameters, "~/map_to", lambda _, response: response)


class _Spinning:
    """Nodes, and the thread that spins them."""

    def __init__(self) -> None:
        self.nodes: list[Node] = []
        self._begin()

    def _begin(self) -> None:
        self.executor = SingleThreadedExecutor()
        self._thread = threading.Thread(target=self.executor.spin, daemon=True)
        self._thread.start()

    def leave(self) -> None:
        """Unmake all nodes.

        No executor may hold them then: they would be unmade later, and rmw_dds_common, which knows
        them by their names, gives the endpoints of the next node of a name to the last one.
        """
        self.executor.shutdown()
        self._thread.join()
        for each in self.nodes:
            each.destroy_node()
        self.nodes.clear()
        self._begin()


def main() -> None:
    rclpy.init()
    spinning = _Spinning()
    for line in sys.stdin:
        way, _, name = line.strip().rpartition(" ")
        if name == "leave":
            spinning.leave()
        elif way.startswith("say "):
            _, topic, index = f"{way} {name}".split(" ")
            _say(spinning.nodes, topic, int(index))
        else:
            node = Node(name, enable_rosout=False)
            spinning.nodes.append(node)
            _play(node, way.replace("_", " "))
            spinning.executor.add_node(node)
        print("done", flush=True)


def _say(nodes: list[Node], topic: str, index: int) -> None:
    from lifecycle.graph.reporter import STATUS_QOS
    from lifecycle.middleware.rcl.conversions import latched
    from tests.hostile.answers import MESSAGES

    node = Node("_ros2cli_teller", enable_rosout=False)
    nodes.append(node)
    qos = STATUS_QOS if topic.endswith("graph") else latched(64)
    publisher = node.create_publisher(String, topic, qos)
    for _ in range(200):
        if publisher.get_subscription_count():
            break
        threading.Event().wait(0.02)
    for text in MESSAGES[index : index + 1] or MESSAGES:
        publisher.publish(String(data=text))


if __name__ == "__main__":
    main()
