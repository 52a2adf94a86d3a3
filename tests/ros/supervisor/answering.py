"""An ordinary rclpy node with a service: `python answering.py SERVICE RELIABILITY`."""

from __future__ import annotations

import contextlib
import sys

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from std_srvs.srv import Trigger


def main(service: str, reliability: str) -> None:
    """Answer until interrupted."""
    rclpy.init(args=sys.argv)
    node = Node("answering")
    qos = QoSProfile(depth=10, reliability=ReliabilityPolicy[reliability])
    node.create_service(Trigger, service, lambda _, response: response, qos_profile=qos)
    with contextlib.suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(node)


main(*sys.argv[1:3])
