"""A system of nodes that know nothing of us, in one process; prints "ready" once it is up.

Two namespaces, two nodes of equal endpoints, services, an action, a mix of QoS, a hidden topic, a
managed node that is active, parameters that tempt YAML, and a topic that nobody publishes.
"""

from __future__ import annotations

import signal
import sys

import rclpy
import rclpy.utilities
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.action import ActionClient, ActionServer
from rclpy.executors import SingleThreadedExecutor
from rclpy.lifecycle import LifecycleNode, TransitionCallbackReturn
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from std_msgs.msg import Int32, String
from std_srvs.srv import SetBool, Trigger
from test_msgs.action import Fibonacci

from lifecycle.middleware.process.control import leave_and_exit


class Scanner(Node):
    def __init__(self, namespace: str) -> None:
        super().__init__("scanner", namespace=namespace)
        sensor = QoSProfile(depth=3, reliability=ReliabilityPolicy.BEST_EFFORT)
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.create_publisher(Int32, "scan", sensor)
        self.create_publisher(String, "_hidden/map", latched)
        self.create_service(Trigger, "~/reset", lambda _, response: response)
        self.declare_parameter("rate", 10.0, ParameterDescriptor(description="scans: per second"))
        self.declare_parameter("on", "08")
        self.declare_parameter("frames", ["$(arg x)", "no", 'a "b"\n'])
        self.declare_parameter("limits.low", -3, ParameterDescriptor(read_only=True))
        self.declare_parameter("unset", descriptor=ParameterDescriptor(dynamic_typing=True))


class Off(Node):
    """A node named as what YAML 1.1 takes for a boolean."""

    def __init__(self) -> None:
        super().__init__("off")
        sensor = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
        for side in ("left", "right"):
            self.create_subscription(Int32, f"/{side}/scan", lambda _: None, sensor)
            self.create_client(Trigger, f"/{side}/scanner/reset")
        self._dock = ActionClient(self, Fibonacci, "/left/dock")
        self.create_subscription(String, "nobody_says_this", lambda _: None, 10)


class Twice(Node):
    """Publishes one topic twice, which a manifest cannot say."""

    def __init__(self) -> None:
        super().__init__("twice", start_parameter_services=False)
        self.create_publisher(String, "echo", 10)
        self.create_publisher(String, "echo", 10)


class Managed(LifecycleNode):
    def __init__(self) -> None:
        super().__init__("managed", namespace="/left")
        self.create_service(SetBool, "lights", lambda _, response: response)
        self._dock = ActionServer(self, Fibonacci, "dock", lambda _: Fibonacci.Result())

    def on_configure(self, state: object) -> TransitionCallbackReturn:
        self._publisher = self.create_lifecycle_publisher(String, "status", 10)
        return TransitionCallbackReturn.SUCCESS


def main() -> None:
    # A process that destroys many nodes may hang: this one leaves DDS itself, and ends at once.
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    managed = Managed()
    managed.trigger_configure()
    managed.trigger_activate()
    executor = SingleThreadedExecutor()
    nodes = (Scanner("/left"), Scanner("/right"), Off(), Twice(), managed)
    for node in nodes:
        executor.add_node(node)
    print("ready", flush=True)
    try:
        while True:
            executor.spin_once(timeout_sec=0.5)
    finally:
        executor.shutdown()
        leave_and_exit(0, nodes=nodes, contexts=[rclpy.utilities.get_default_context()])


if __name__ == "__main__":
    main()
