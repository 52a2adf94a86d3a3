"""Checks of flow needs against what the RMW can do.

Owns: check.rmw. The capability table is `lifecycle.network`'s, and what happens at run time
decides; this only fails earlier. Pure.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from lifecycle.manifest.checks.system import System
from lifecycle.manifest.diagnostics import Diagnostic
from lifecycle.manifest.flows.flow_needs import FlowNeeds, ResolvedNeed
from lifecycle.manifest.model import EndpointKind, Node
from lifecycle.manifest.yaml.document import error, warning
from lifecycle.network.nfe import UniqueRequirement
from lifecycle.network.rmw_capabilities import (
    DEFAULT_RMW,
    Capability,
    Feasibility,
    FlowSide,
    capabilities,
    dscp_feasibility,
    feasibility,
)

VARIABLE = "RMW_IMPLEMENTATION"


def check(system: System, needs: FlowNeeds, environment: Mapping[str, str]) -> Iterator[Diagnostic]:
    """Yield findings about what the RMW of a node cannot do.

    An error where a need that must be met certainly is not; else a warning that names where the
    answer comes from. Without RMW_IMPLEMENTATION it is ROS 2's default.
    """
    for node in system.manifest.nodes:
        rmw = rmw_of(node, environment)
        for each in needs.of_node(node):
            yield from _unique(rmw, node, each)
            if each.dscp is not None:
                cell = capabilities(rmw).dscp
                must = each.need.enforce
                what = f"{each.need.kind.noun} {each.need.name!r} of {node.key!r}"
                yield from _judge(each, what, dscp_feasibility(rmw), cell, must=must)


def rmw_of(node: Node, environment: Mapping[str, str]) -> str:
    """Return the RMW identifier that a node will run with."""
    own = dict(node.run.environment).get(VARIABLE, "")
    return own or environment.get(VARIABLE, "") or DEFAULT_RMW


def _unique(rmw: str, node: Node, each: ResolvedNeed) -> Iterator[Diagnostic]:
    publishes = each.need.kind is EndpointKind.PUBLISHER
    side = FlowSide.PUBLISHER if publishes else FlowSide.SUBSCRIPTION
    answer = feasibility(rmw, side, each.need.unique)
    must = each.need.unique is UniqueRequirement.STRICTLY_REQUIRED
    what = f"{each.need.kind.noun} {each.need.name!r} of {node.key!r}"
    yield from _judge(each, what, answer, capabilities(rmw).unique(side), must=must)


def _judge(
    each: ResolvedNeed, what: str, answer: Feasibility, cell: Capability, *, must: bool
) -> Iterator[Diagnostic]:
    if answer.feasible:
        return
    why, _, hint = answer.why.rpartition("; ")
    message = f"cannot meet the need of {what}: {why} [{cell.source}]"
    make = error if must and answer.feasible is False else warning
    yield make("check.rmw", each.need.at, message, hint)
