"""A node in a process of its own that reports to the graph: joined, heartbeats, and SIGTERM: left.

    python -m tests.ros.graph.reporting_node NAME TOPIC

It serves `~/get_configuration` with one publisher of TOPIC, and makes it on the ordinary graph too.
"""

from __future__ import annotations

import signal
import sys
import threading

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from std_msgs.msg import String
from std_srvs.srv import Trigger

from lifecycle import codec
from lifecycle.graph.reporter import GraphReporter
from lifecycle.manifest.model import EndpointKind
from lifecycle.middleware.process.control import leave_and_exit
from lifecycle.verify.observation import EndpointReport
from tests.builders import configuration


class ReportingNode:
    """An ordinary rclpy node with a reporter and the configuration service."""

    def __init__(self, node: Node, topic: str) -> None:
        self.node = node
        self.name = node.get_fully_qualified_name()
        report = EndpointReport(
            kind=EndpointKind.PUBLISHER,
            name="out",
            resolved=topic,
            type="std_msgs/msg/String",
            mapped=True,
            matched=0,
        )
        self.configuration = configuration(self.name, report, checksum="1")
        self.asked = 0
        node.create_publisher(String, topic, 1)
        node.create_service(Trigger, "~/get_configuration", self._serve)
        self.reporter = GraphReporter(node)
        self.reporter.report(state="inactive", connected=True, checksum="1")

    def _serve(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self.asked += 1
        response.success = True
        response.message = codec.to_json(self.configuration).decode()
        return response


def main() -> None:
    """Report until SIGTERM."""
    rclpy.init(signal_handler_options=rclpy.SignalHandlerOptions.NO)
    node = Node(sys.argv[1], enable_rosout=False)
    reporting = ReportingNode(node, sys.argv[2])
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    threading.Thread(target=executor.spin, daemon=True).start()
    print("reporting", flush=True)
    signal.sigwait({signal.SIGTERM})
    reporting.reporter.left("asked to")
    leave_and_exit(0, nodes=[node], contexts=[rclpy.get_default_context()], deadline_s=5)


if __name__ == "__main__":
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTERM})
    main()
