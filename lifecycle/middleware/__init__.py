"""The only room that knows rcl, rmw and Fast DDS: endpoints, flows, graph, shared memory.

Owns: every use of ctypes and of private rclpy names. Names load on first use, so that a verb that
only asks for the /dev/shm sweep or for process control does not pay for importing rclpy.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from lifecycle.middleware.clients import NodeClients
    from lifecycle.middleware.discovery_server import (
        discovery_server_command,
        discovery_server_listens,
    )
    from lifecycle.middleware.dscp import get_dscp
    from lifecycle.middleware.graph import GraphObserver
    from lifecycle.middleware.graph_changes import on_graph_change
    from lifecycle.middleware.graph_queries import EndpointInfo, endpoints_of
    from lifecycle.middleware.interface_types import UnknownInterfaceError, import_interface
    from lifecycle.middleware.matched_peers import guid_of, matched_with
    from lifecycle.middleware.nfe import (
        SHARED_MEMORY,
        NetworkFlowEndpointsUnsupported,
        get_network_flow_endpoints,
        has_shared_memory,
    )
    from lifecycle.middleware.parameters import parameter_value, type_word
    from lifecycle.middleware.participant import FlowParticipant
    from lifecycle.middleware.participant_profile import ParticipantSettings
    from lifecycle.middleware.process import adopt_orphans, exit_after
    from lifecycle.middleware.profiles import discovery_environment
    from lifecycle.middleware.qos import from_rclpy, to_rclpy
    from lifecycle.middleware.server_watch import ServerWatch, is_server_matched
    from lifecycle.middleware.service_calls import ServiceUnansweredError
    from lifecycle.middleware.settings import participant_settings
    from lifecycle.middleware.shm import leftovers, segments_of, sweep
    from lifecycle.middleware.teardown import leave_and_exit
    from lifecycle.middleware.unique import (
        UniqueFlowNotFeasible,
        create_publisher,
        create_subscription,
    )

__all__ = [
    "SHARED_MEMORY",
    "EndpointInfo",
    "FlowParticipant",
    "GraphObserver",
    "NetworkFlowEndpointsUnsupported",
    "NodeClients",
    "ParticipantSettings",
    "ServerWatch",
    "ServiceUnansweredError",
    "UniqueFlowNotFeasible",
    "UnknownInterfaceError",
    "adopt_orphans",
    "create_publisher",
    "create_subscription",
    "discovery_environment",
    "discovery_server_command",
    "discovery_server_listens",
    "endpoints_of",
    "exit_after",
    "from_rclpy",
    "get_dscp",
    "get_network_flow_endpoints",
    "guid_of",
    "has_shared_memory",
    "import_interface",
    "is_server_matched",
    "leave_and_exit",
    "leftovers",
    "matched_with",
    "on_graph_change",
    "parameter_value",
    "participant_settings",
    "segments_of",
    "sweep",
    "to_rclpy",
    "type_word",
]

_HOME = {
    "SHARED_MEMORY": "nfe",
    "EndpointInfo": "graph_queries",
    "FlowParticipant": "participant",
    "GraphObserver": "graph",
    "NetworkFlowEndpointsUnsupported": "nfe",
    "NodeClients": "clients",
    "ParticipantSettings": "participant_profile",
    "ServerWatch": "server_watch",
    "ServiceUnansweredError": "service_calls",
    "UniqueFlowNotFeasible": "unique",
    "UnknownInterfaceError": "interface_types",
    "adopt_orphans": "process",
    "create_publisher": "unique",
    "create_subscription": "unique",
    "discovery_environment": "profiles",
    "discovery_server_command": "discovery_server",
    "discovery_server_listens": "discovery_server",
    "endpoints_of": "graph_queries",
    "exit_after": "process",
    "from_rclpy": "qos",
    "get_dscp": "dscp",
    "get_network_flow_endpoints": "nfe",
    "guid_of": "matched_peers",
    "has_shared_memory": "nfe",
    "import_interface": "interface_types",
    "is_server_matched": "server_watch",
    "leave_and_exit": "teardown",
    "leftovers": "shm",
    "matched_with": "matched_peers",
    "on_graph_change": "graph_changes",
    "parameter_value": "parameters",
    "participant_settings": "settings",
    "segments_of": "shm",
    "sweep": "shm",
    "to_rclpy": "qos",
    "type_word": "parameters",
}


def __getattr__(name: str) -> object:
    """Import the module that defines `name` (PEP 562)."""
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_HOME[name]}"), name)
