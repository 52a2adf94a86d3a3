"""Manifest → Plan: the computational and the data layer graph of a system, ready to run. Pure."""

from lifecycle.plan.build import build_plan, check_plan, effective_domain, with_files_of_now
from lifecycle.plan.comparison import PlanDifference, changes, differences, plan_checksum
from lifecycle.plan.connections.wiring import with_graph
from lifecycle.plan.model import (
    ParticipantConnections,
    Plan,
    PlanError,
    PlannedEndpoint,
    PlannedFile,
    PlannedFlow,
    PlannedNode,
    PlannedParticipant,
    PlannedProcess,
    PlannedServer,
)
from lifecycle.plan.negotiation.data_layer import (
    DataLayerGraph,
    NegotiatedConnection,
    NegotiatedFlow,
    NegotiationProblem,
    Party,
    PartyEndpoint,
    Terms,
)
from lifecycle.plan.negotiation.negotiate import negotiate
from lifecycle.plan.negotiation.parties import hosts_of, party_of_node, terms_of, wishes_of
from lifecycle.plan.participants import ParticipantCost, owner_of, participants_cost
from lifecycle.plan.restart import is_restarted_url, moved_observer, moving_nodes, restarted

__all__ = [
    "DataLayerGraph",
    "NegotiatedConnection",
    "NegotiatedFlow",
    "NegotiationProblem",
    "ParticipantConnections",
    "ParticipantCost",
    "Party",
    "PartyEndpoint",
    "Plan",
    "PlanDifference",
    "PlanError",
    "PlannedEndpoint",
    "PlannedFile",
    "PlannedFlow",
    "PlannedNode",
    "PlannedParticipant",
    "PlannedProcess",
    "PlannedServer",
    "Terms",
    "build_plan",
    "changes",
    "check_plan",
    "differences",
    "effective_domain",
    "hosts_of",
    "is_restarted_url",
    "moved_observer",
    "moving_nodes",
    "negotiate",
    "owner_of",
    "participants_cost",
    "party_of_node",
    "plan_checksum",
    "restarted",
    "terms_of",
    "wishes_of",
    "with_files_of_now",
    "with_graph",
]
