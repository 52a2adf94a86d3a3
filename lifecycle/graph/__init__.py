"""The ROS graph interface: which nodes run, who is connected to whom, and what has just changed.

Owns: graph messages and their transport, the events made of them, and the state with its queries
(docs/graph_interface.md), of which the supervisor and `lifecycle verify` judge an observation. Must
not use ctypes or private rclpy names; those live in middleware/. Names that need rclpy load on
first use.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from lifecycle.public import public_name

if TYPE_CHECKING:
    from lifecycle.graph.events import FORGET_AFTER_S as FORGET_AFTER_S
    from lifecycle.graph.events import SILENT_AFTER_S as SILENT_AFTER_S
    from lifecycle.graph.events import GraphEvents as GraphEvents
    from lifecycle.graph.graph import Graph as Graph
    from lifecycle.graph.messages import ConfigurationChanged as ConfigurationChanged
    from lifecycle.graph.messages import ConnectionEstablished as ConnectionEstablished
    from lifecycle.graph.messages import ConnectionLost as ConnectionLost
    from lifecycle.graph.messages import GraphKind as GraphKind
    from lifecycle.graph.messages import GraphMessage as GraphMessage
    from lifecycle.graph.messages import GraphMessageError as GraphMessageError
    from lifecycle.graph.messages import Heartbeat as Heartbeat
    from lifecycle.graph.messages import Joined as Joined
    from lifecycle.graph.messages import Left as Left
    from lifecycle.graph.messages import MappingEstablished as MappingEstablished
    from lifecycle.graph.messages import MappingLost as MappingLost
    from lifecycle.graph.messages import StateChanged as StateChanged
    from lifecycle.graph.messages import decode as decode
    from lifecycle.graph.messages import encode as encode
    from lifecycle.graph.messages import new_incarnation as new_incarnation
    from lifecycle.graph.model import End as End
    from lifecycle.graph.model import EndpointChange as EndpointChange
    from lifecycle.graph.model import EventKind as EventKind
    from lifecycle.graph.model import GraphChange as GraphChange
    from lifecycle.graph.model import GraphEvent as GraphEvent
    from lifecycle.graph.model import Link as Link
    from lifecycle.graph.model import Member as Member
    from lifecycle.graph.model import NodeLiveliness as NodeLiveliness
    from lifecycle.graph.model import NodeView as NodeView
    from lifecycle.graph.reporter import HEARTBEAT_PERIOD_S as HEARTBEAT_PERIOD_S
    from lifecycle.graph.reporter import GraphReporter as GraphReporter
    from lifecycle.graph.scheduler import LoopScheduler as LoopScheduler
    from lifecycle.graph.scheduler import Remove as Remove
    from lifecycle.graph.scheduler import Scheduler as Scheduler
    from lifecycle.graph.scheduler import ThreadScheduler as ThreadScheduler
    from lifecycle.graph.scheduler import set_within as set_within
    from lifecycle.graph.state import Fetch as Fetch
    from lifecycle.graph.state import GraphState as GraphState
    from lifecycle.graph.state import Look as Look
    from lifecycle.graph.transport import GRAPH_QOS as GRAPH_QOS
    from lifecycle.graph.transport import DdsTransport as DdsTransport
    from lifecycle.graph.transport import GraphTransport as GraphTransport
    from lifecycle.graph.transport import steady_timer as steady_timer

_PUBLIC: dict[str, tuple[str, ...]] = {
    "lifecycle.graph.events": ("FORGET_AFTER_S", "GraphEvents", "SILENT_AFTER_S"),
    "lifecycle.graph.graph": ("Graph",),
    "lifecycle.graph.messages": (
        "ConfigurationChanged",
        "ConnectionEstablished",
        "ConnectionLost",
        "GraphKind",
        "GraphMessage",
        "GraphMessageError",
        "Heartbeat",
        "Joined",
        "Left",
        "MappingEstablished",
        "MappingLost",
        "StateChanged",
        "decode",
        "encode",
        "new_incarnation",
    ),
    "lifecycle.graph.model": (
        "End",
        "EndpointChange",
        "EventKind",
        "GraphChange",
        "GraphEvent",
        "Link",
        "Member",
        "NodeLiveliness",
        "NodeView",
    ),
    "lifecycle.graph.reporter": ("GraphReporter", "HEARTBEAT_PERIOD_S"),
    "lifecycle.graph.scheduler": (
        "LoopScheduler",
        "Remove",
        "Scheduler",
        "ThreadScheduler",
        "set_within",
    ),
    "lifecycle.graph.state": ("Fetch", "GraphState", "Look"),
    "lifecycle.graph.transport": ("DdsTransport", "GRAPH_QOS", "GraphTransport", "steady_timer"),
}
"""What programs import from here (docs/api.md), by the module that has it."""


def __getattr__(name: str) -> object:
    """Load the module of a public name on first use (PEP 562)."""
    return public_name(__name__, _PUBLIC, name)
