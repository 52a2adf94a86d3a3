"""The ROS graph interface: which nodes run, who is connected to whom, and what has just changed.

Owns: graph messages and their transport, the events made of them, and the state with its queries
(docs/graph_interface.md), of which the supervisor and `lifecycle verify` judge an observation. Must
not use ctypes or private rclpy names; those live in middleware/. Names that need rclpy load on
first use.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

from lifecycle.graph.events import FORGET_AFTER_S, SILENT_AFTER_S, GraphEvents
from lifecycle.graph.messages import (
    AliveNotice,
    ConfigurationChanged,
    ConnectionEstablished,
    ConnectionLost,
    GraphKind,
    GraphMessage,
    GraphMessageError,
    Heartbeat,
    Joined,
    Left,
    MappingEstablished,
    MappingLost,
    SilentNotice,
    StateChanged,
    StuckNotice,
    decode,
    encode,
    new_incarnation,
)
from lifecycle.graph.model import (
    End,
    EndpointChange,
    EventKind,
    GraphChange,
    GraphEvent,
    Link,
    Member,
    NodeLiveliness,
    NodeView,
)
from lifecycle.graph.reporter import HEARTBEAT_PERIOD_S, Every, GraphReporter
from lifecycle.graph.scheduler import (
    LoopScheduler,
    ManualScheduler,
    Remove,
    Scheduler,
    ThreadScheduler,
    every,
    set_within,
)
from lifecycle.graph.state import Fetch, GraphState, Look
from lifecycle.graph.transport import GraphTransport, InMemoryNetwork, InMemoryTransport

if TYPE_CHECKING:
    from lifecycle.graph.dds import GRAPH_QOS, DdsTransport, steady_timer
    from lifecycle.graph.graph import Graph

__all__ = [
    "FORGET_AFTER_S",
    "GRAPH_QOS",
    "HEARTBEAT_PERIOD_S",
    "SILENT_AFTER_S",
    "AliveNotice",
    "ConfigurationChanged",
    "ConnectionEstablished",
    "ConnectionLost",
    "DdsTransport",
    "End",
    "EndpointChange",
    "EventKind",
    "Every",
    "Fetch",
    "Graph",
    "GraphChange",
    "GraphEvent",
    "GraphEvents",
    "GraphKind",
    "GraphMessage",
    "GraphMessageError",
    "GraphReporter",
    "GraphState",
    "GraphTransport",
    "Heartbeat",
    "InMemoryNetwork",
    "InMemoryTransport",
    "Joined",
    "Left",
    "Link",
    "Look",
    "LoopScheduler",
    "ManualScheduler",
    "MappingEstablished",
    "MappingLost",
    "Member",
    "NodeLiveliness",
    "NodeView",
    "Remove",
    "Scheduler",
    "SilentNotice",
    "StateChanged",
    "StuckNotice",
    "ThreadScheduler",
    "decode",
    "encode",
    "every",
    "new_incarnation",
    "set_within",
    "steady_timer",
]

_HOME = {
    "GRAPH_QOS": "dds",
    "DdsTransport": "dds",
    "Graph": "graph",
    "steady_timer": "dds",
}


def __getattr__(name: str) -> object:
    """Import the module that defines `name` (PEP 562)."""
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_HOME[name]}"), name)
