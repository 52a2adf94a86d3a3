"""rcl, rmw and Fast DDS, used by this package alone: endpoints, participants, graph, shared memory.

Owns: every use of ctypes and of private rclpy names. Names load on first use, so that a verb that
only needs the /dev/shm sweep or process control does not pay for importing rclpy.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from lifecycle.middleware.discovery.discovery_server import (
        discovery_server_command,
        discovery_server_listens,
    )
    from lifecycle.middleware.fastdds.participant import FlowParticipant
    from lifecycle.middleware.fastdds.participant_profile import ParticipantSettings
    from lifecycle.middleware.fastdds.profiles import discovery_environment
    from lifecycle.middleware.fastdds.settings import participant_settings
    from lifecycle.middleware.process.control import adopt_orphans, exit_after
    from lifecycle.middleware.process.shared_memory import leftovers, segments_of, sweep
    from lifecycle.middleware.process.teardown import leave_and_exit
    from lifecycle.middleware.rcl.graph import GraphObserver
    from lifecycle.middleware.rcl.graph_changes import on_graph_change
    from lifecycle.middleware.rcl.graph_queries import EndpointInfo, endpoints_of
    from lifecycle.middleware.rcl.matched_peers import guid_of, matched_with
    from lifecycle.middleware.rcl.qos import (
        UnknownInterfaceError,
        from_rclpy,
        import_interface,
        to_rclpy,
    )
    from lifecycle.middleware.rcl.unique import (
        UniqueFlowNotFeasible,
        create_publisher,
        create_subscription,
    )
    from lifecycle.middleware.services.clients import NodeClients
    from lifecycle.middleware.services.parameters import parameter_value, type_word
    from lifecycle.middleware.services.server_watch import ServerWatch, is_server_matched
    from lifecycle.middleware.services.service_calls import ServiceUnansweredError
    from lifecycle.middleware.sockets.dscp import get_dscp
    from lifecycle.middleware.sockets.nfe import (
        SHARED_MEMORY,
        NetworkFlowEndpointsUnsupported,
        get_network_flow_endpoints,
        has_shared_memory,
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
    "SHARED_MEMORY": "sockets.nfe",
    "EndpointInfo": "rcl.graph_queries",
    "FlowParticipant": "fastdds.participant",
    "GraphObserver": "rcl.graph",
    "NetworkFlowEndpointsUnsupported": "sockets.nfe",
    "NodeClients": "services.clients",
    "ParticipantSettings": "fastdds.participant_profile",
    "ServerWatch": "services.server_watch",
    "ServiceUnansweredError": "services.service_calls",
    "UniqueFlowNotFeasible": "rcl.unique",
    "UnknownInterfaceError": "rcl.qos",
    "adopt_orphans": "process.control",
    "create_publisher": "rcl.unique",
    "create_subscription": "rcl.unique",
    "discovery_environment": "fastdds.profiles",
    "discovery_server_command": "discovery.discovery_server",
    "discovery_server_listens": "discovery.discovery_server",
    "endpoints_of": "rcl.graph_queries",
    "exit_after": "process.control",
    "from_rclpy": "rcl.qos",
    "get_dscp": "sockets.dscp",
    "get_network_flow_endpoints": "sockets.nfe",
    "guid_of": "rcl.matched_peers",
    "has_shared_memory": "sockets.nfe",
    "import_interface": "rcl.qos",
    "is_server_matched": "services.server_watch",
    "leave_and_exit": "process.teardown",
    "leftovers": "process.shared_memory",
    "matched_with": "rcl.matched_peers",
    "on_graph_change": "rcl.graph_changes",
    "parameter_value": "services.parameters",
    "participant_settings": "fastdds.settings",
    "segments_of": "process.shared_memory",
    "sweep": "process.shared_memory",
    "to_rclpy": "rcl.qos",
    "type_word": "services.parameters",
}


def __getattr__(name: str) -> object:
    """Import the module that defines `name` (PEP 562)."""
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_HOME[name]}"), name)
