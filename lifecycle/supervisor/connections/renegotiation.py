"""What must be of a system whose connections are negotiated, for somebody who only looks on.

Owns: `Expectation`. What the authority of such a system decided is in no manifest, but negotiation
is a pure function: whoever knows the same node configurations comes to the same data layer graph,
but for ports and groups that were given out earlier, and those are in the nodes' reports. Pure.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping

from lifecycle.manifest.model import Authority, DataLayerSource
from lifecycle.plan import DataLayerGraph, NegotiatedConnection, Plan
from lifecycle.supervisor.connections.negotiation import NegotiatedSource
from lifecycle.supervisor.connections.unwired import not_wired
from lifecycle.verify.observation import NodeConfiguration, Observation
from lifecycle.verify.verdict import Finding


def is_negotiated(plan: Plan) -> bool:
    """Whether a plan's connections are decided from what its nodes report while they run."""
    layer = plan.data_layer
    return layer.authority is Authority.SUPERVISOR and layer.source is DataLayerSource.DYNAMIC


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Expectation:
    """What must be, as far as an onlooker can know.

    Attributes:
        plan: with the connections and the endpoints made in code that must be seen now.
        findings: pairs of declared nodes that nothing can connect.
    """

    plan: Plan
    findings: tuple[Finding, ...] = ()

    @classmethod
    def of(cls, plan: Plan, observation: Observation) -> Expectation:
        """Negotiate again from what was seen; what is not negotiated is expected as it is planned.

        A connection that no negotiation would have made, because somebody else called connect_to,
        is not expected, and what is mapped onto it is mapped wrongly. The URLs of one that fits
        are not judged: only its authority knows which ports it gave out.
        """
        if not is_negotiated(plan):
            return cls(plan=plan)
        known = {each.name: each for each in observation.configurations}
        source = _negotiated_again(plan, known)
        return cls(
            plan=source.expected,
            findings=tuple(not_wired(plan.system, each) for each in source.problems),
        )


def _negotiated_again(plan: Plan, known: Mapping[str, NodeConfiguration]) -> NegotiatedSource:
    """Find those of the reported connections that a negotiation comes to, and what it comes to.

    It begins with all of them, and each round leaves out those that nobody would have made; an
    endpoint on one of these stays there, which may make another superfluous.
    """
    before = DataLayerGraph(connections=tuple(_reported(plan, known)))
    while True:
        source = NegotiatedSource(plan, before=before)
        source.instructions(known)
        made = {(each.node, each.name) for each in source.graph.connections}
        stays = tuple(each for each in before.connections if (each.node, each.name) in made)
        if stays == before.connections:
            return source
        before = DataLayerGraph(connections=stays)


def _reported(plan: Plan, known: Mapping[str, NodeConfiguration]) -> Iterator[NegotiatedConnection]:
    """Yield the connections that nodes have and no manifest declares."""
    planned = {each.full_name: each for each in plan.nodes}
    for name, configuration in known.items():
        node = planned.get(name)
        declared = {each.connection for each in node.participants} if node else set()
        for each in configuration.connections:
            if each.name and not each.error and each.name not in declared:
                yield NegotiatedConnection(
                    node=node.key if node else name,
                    name=each.name,
                    urls=each.urls,
                    map=tuple(sorted(each.mappings)),
                    reason="",
                )
