"""A node that connects itself also sees to it that what is lost is connected again.

*Topological Discovery and Communication Negotiation*, "Statically Configured Nodes": who calls
`connect_to` is responsible for a new one after the connection dies, and must be able to learn of it
by asking and by being told.
"""

from __future__ import annotations

import rclpy
from lifecycle_driver import Driver
from planning import built_with, planned, subscription
from std_msgs.msg import String

from lifecycle import LifecycleNode, on_message
from lifecycle.graph.state import EventKind, GraphEvent

UDP = "udpv4://127.0.0.1"


class SelfReliant(LifecycleNode):
    """Connects itself when it is configured, and again whenever it lost all its peers."""

    def __init__(self) -> None:
        super().__init__("it")
        self.heard: list[str] = []
        self.lost: list[bool] = []
        self.on_connection_event(self._react)

    def on_configure(self) -> None:
        self._instruct()

    def _instruct(self) -> None:
        self.connect_to(UDP, name="net")
        self.map_to("in", "net")

    def _react(self, event: GraphEvent) -> None:
        connection = event.connection
        if event.kind is EventKind.CONNECTION_LOST and connection and not connection.established:
            self.lost.append(self.established())
            self.disconnect("net")
            self._instruct()

    def established(self) -> bool:
        """Poll what `connect_to` made."""
        (net,) = (each for each in self.connections if each.name == "net")
        return net.established

    @on_message("in")
    def hear(self, message: String) -> None:
        self.heard.append(message.data)


def test_a_node_issues_a_new_connect_to_after_its_connection_died(
    driver: Driver, context: rclpy.Context
) -> None:
    with built_with(planned("it", subscription("in")), context):
        node = SelfReliant()
    driver.add(node)
    for label in ("configure", "connect", "activate"):
        assert driver.set("/it", label)
    talker = driver.node.create_publisher(String, "/in", 10)
    driver.spin_until(node.established)
    driver.spin_until(lambda: _said(talker, node, "before"))
    driver.node.destroy_publisher(talker)
    driver.spin_until(lambda: node.lost)
    assert node.lost == [False]
    talker = driver.node.create_publisher(String, "/in", 10)
    driver.spin_until(lambda: _said(talker, node, "after"))
    # The message may be handled before the news that its sender is matched.
    driver.spin_until(node.established)
    driver.node.destroy_publisher(talker)


def _said(talker: rclpy.publisher.Publisher, node: SelfReliant, text: str) -> bool:
    """Say it once somebody listens; return whether it was heard."""
    if talker.get_subscription_count() and text not in node.heard:
        talker.publish(String(data=text))
    return text in node.heard
