"""Node names in the ROS graph after an outage.

rmw_dds_common keeps the name of a node whose participant was dropped out of the graph, and found
again, until that participant publishes its entities anew.
"""

from __future__ import annotations

from collections.abc import Iterable

from rclpy.node import Node

from lifecycle.middleware.rcl.hidden_node import bare_node


def republish_names(nodes: Iterable[Node]) -> None:
    """Make the participants of `nodes` publish anew which nodes and endpoints they have.

    rmw_fastrtps does so whenever a node or an endpoint is made or destroyed. Here it is a hidden
    node without endpoints, for a moment: when an endpoint ends, a discovery server of Fast DDS 2.14
    drops whatever it has not relayed yet of that participant's other endpoints, and never sends it
    again. Take one node of each participant.
    """
    for node in nodes:
        bare_node(node.context).destroy_when_not_in_use()
