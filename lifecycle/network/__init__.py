"""Facts of networks: DDS ports, DSCP, transport priority, 5QI, NFEs and flow uniqueness.

Pure: imports nothing of the package but `lifecycle.codec`, no ROS, opens no socket.
"""

from __future__ import annotations

from lifecycle.network.budget import (
    overflows,
)
from lifecycle.network.dscp import (
    CodePoint,
    code_points,
    describe,
    dscp_name,
    dscp_of_tos,
    parse_dscp,
    tos,
)
from lifecycle.network.five_qi import (
    FiveQi,
    Proposal,
    check_class,
    five_qi_of,
    five_qis,
    propose,
)
from lifecycle.network.five_qi_dscp import (
    DscpMapping,
    dscp_mapping,
    dscp_mappings,
    parse_mapping,
)
from lifecycle.network.flow import (
    FlowTuple,
    flow_tuples,
)
from lifecycle.network.nfe import (
    FlowIdentifier,
    FlowUniqueness,
    InternetProtocol,
    LocatedNfe,
    NetworkFlowEndpoint,
    TransportProtocol,
    UniqueRequirement,
    dissimilar,
    is_ip,
    is_unique,
    is_unique_endpoint,
    located,
    meets,
    uniqueness,
)
from lifecycle.network.ports import (
    Capacity,
    EphemeralRange,
    ParticipantPorts,
    Platform,
    max_participants,
    max_unique_subscriptions,
    overlaps,
    owner_of,
    participant_ports,
    read_ephemeral_range,
    safe_domains,
    unique_flow_ports,
)
from lifecycle.network.rmw_capabilities import (
    FlowSide,
    RmwCapabilities,
    capabilities,
    dscp_feasibility,
    feasibility,
)
from lifecycle.network.transport_priority import (
    MappedPriority,
    TransportPriorityMapping,
    map_priority,
)

__all__ = [
    "Capacity",
    "CodePoint",
    "DscpMapping",
    "EphemeralRange",
    "FiveQi",
    "FlowIdentifier",
    "FlowSide",
    "FlowTuple",
    "FlowUniqueness",
    "InternetProtocol",
    "LocatedNfe",
    "MappedPriority",
    "NetworkFlowEndpoint",
    "ParticipantPorts",
    "Platform",
    "Proposal",
    "RmwCapabilities",
    "TransportPriorityMapping",
    "TransportProtocol",
    "UniqueRequirement",
    "capabilities",
    "check_class",
    "code_points",
    "describe",
    "dissimilar",
    "dscp_feasibility",
    "dscp_mapping",
    "dscp_mappings",
    "dscp_name",
    "dscp_of_tos",
    "feasibility",
    "five_qi_of",
    "five_qis",
    "flow_tuples",
    "is_ip",
    "is_unique",
    "is_unique_endpoint",
    "located",
    "map_priority",
    "max_participants",
    "max_unique_subscriptions",
    "meets",
    "overflows",
    "overlaps",
    "owner_of",
    "parse_dscp",
    "parse_mapping",
    "participant_ports",
    "propose",
    "read_ephemeral_range",
    "safe_domains",
    "tos",
    "unique_flow_ports",
    "uniqueness",
]
