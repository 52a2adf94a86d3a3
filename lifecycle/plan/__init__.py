"""Manifest → Plan: the computational and the data layer graph of a system, ready to run. Pure."""

from lifecycle.plan.build import build_plan, check_plan, effective_domain
from lifecycle.plan.data_layer import (
    DataLayerGraph,
    NegotiatedConnection,
    NegotiatedFlow,
    NegotiationProblem,
    NodeChange,
    Party,
    PartyEndpoint,
    Terms,
    difference,
)
from lifecycle.plan.errors import PlanError
from lifecycle.plan.model import (
    ParticipantConnections,
    Plan,
    PlannedEndpoint,
    PlannedFlow,
    PlannedNode,
    PlannedParticipant,
    PlannedProcess,
    PlannedServer,
)
from lifecycle.plan.negotiate import negotiate
from lifecycle.plan.participants import ParticipantCost, owner_of, participants_cost
from lifecycle.plan.parties import party_of_node, wishes_of
from lifecycle.plan.restart import is_restarted_url, restarted
from lifecycle.plan.terms import hosts_of, terms_of
from lifecycle.plan.wiring import with_graph

__all__ = [
    "DataLayerGraph",
    "NegotiatedConnection",
    "NegotiatedFlow",
    "NegotiationProblem",
    "NodeChange",
    "ParticipantConnections",
    "ParticipantCost",
    "Party",
    "PartyEndpoint",
    "Plan",
    "PlanError",
    "PlannedEndpoint",
    "PlannedFlow",
    "PlannedNode",
    "PlannedParticipant",
    "PlannedProcess",
    "PlannedServer",
    "Terms",
    "build_plan",
    "check_plan",
    "difference",
    "effective_domain",
    "hosts_of",
    "is_restarted_url",
    "negotiate",
    "owner_of",
    "participants_cost",
    "party_of_node",
    "restarted",
    "terms_of",
    "wishes_of",
    "with_graph",
]
