"""The ROS graph interface: which nodes run, who is connected to whom, and what has just changed.

Owns: node statuses and how they travel, the events made of them, and the state with its queries
(docs/graph_interface.md), of which the supervisor and `lifecycle verify` judge an observation. Must
not use ctypes or private rclpy names; those live in middleware/. Names that need rclpy load on
first use.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from lifecycle.public import public_name

if TYPE_CHECKING:
    from lifecycle.graph.graph import Graph as Graph
    from lifecycle.graph.model import End as End
    from lifecycle.graph.model import EndpointChange as EndpointChange
    from lifecycle.graph.model import GraphChange as GraphChange
    from lifecycle.graph.model import Link as Link
    from lifecycle.graph.model import NodeView as NodeView
    from lifecycle.graph.reporter import GraphReporter as GraphReporter
    from lifecycle.graph.reporter import receive as receive
    from lifecycle.graph.state import EventKind as EventKind
    from lifecycle.graph.state import GraphEvent as GraphEvent
    from lifecycle.graph.state import GraphEvents as GraphEvents
    from lifecycle.graph.state import GraphState as GraphState
    from lifecycle.graph.status import MappingStatus as MappingStatus
    from lifecycle.graph.status import NodeStatus as NodeStatus
    from lifecycle.graph.status import NodeStatusError as NodeStatusError
    from lifecycle.graph.status import decode as decode
    from lifecycle.graph.status import encode as encode
    from lifecycle.graph.status import new_instance as new_instance

_PUBLIC: dict[str, tuple[str, ...]] = {
    "lifecycle.graph.graph": ("Graph",),
    "lifecycle.graph.model": ("End", "EndpointChange", "GraphChange", "Link", "NodeView"),
    "lifecycle.graph.reporter": ("GraphReporter", "receive"),
    "lifecycle.graph.state": ("EventKind", "GraphEvent", "GraphEvents", "GraphState"),
    "lifecycle.graph.status": (
        "MappingStatus",
        "NodeStatus",
        "NodeStatusError",
        "decode",
        "encode",
        "new_instance",
    ),
}
"""What programs import from here (docs/api.md), by the module that has it."""


def __getattr__(name: str) -> object:
    """Load the module of a public name on first use (PEP 562)."""
    return public_name(__name__, _PUBLIC, name)
