"""Rules about node names: missing, undeclared, duplicate. Pure."""

from __future__ import annotations

from collections.abc import Iterator

from lifecycle.manifest import EndpointPolicy, RunKind
from lifecycle.verify.rules.catalogue import About, Heals, Rule
from lifecycle.verify.verdict import Finding, Outcome
from lifecycle.verify.view import View

MISSING_NODE = Rule(
    id="graph.missing-node",
    meaning="a declared node is not in the graph",
    outcomes=(Outcome.VIOLATED, Outcome.UNVERIFIABLE),
    fix="look at the node's process and its log; compare domain, RMW and discovery range",
    concerns_flow=True,
    heals=Heals.WITH_TIME,
    about=About.PRESENCE,
    if_undiscovered=True,
    absence="node",
)
UNDECLARED_NODE = Rule(
    id="graph.undeclared-node",
    meaning="the graph has a node that the manifest does not declare",
    outcomes=(Outcome.VIOLATED,),
    fix="declare it, stop it, give the system a domain of its own, or set"
    " policy.undeclared_nodes: open",
)
DUPLICATE_NODE = Rule(
    id="graph.duplicate-node",
    meaning="several nodes carry one fully qualified name",
    outcomes=(Outcome.VIOLATED,),
    fix="stop the other one, or give each its own name or namespace",
)
ENDED_NODE = Rule(
    id="graph.ended-node",
    meaning="a node that may end by itself has ended",
    outcomes=(Outcome.UNVERIFIABLE,),
    fix="nothing, if its work was to be done once; without `may_end` its end is a failure",
    concerns_flow=True,
    about=About.PRESENCE,
)
RULES = (MISSING_NODE, ENDED_NODE, UNDECLARED_NODE, DUPLICATE_NODE)


def check(view: View) -> Iterator[Finding]:
    """Judge node names."""
    yield from _missing(view)
    yield from _duplicate(view)
    if view.plan.policy.undeclared_nodes is EndpointPolicy.DECLARED:
        yield from _undeclared(view)


def _missing(view: View) -> Iterator[Finding]:
    for name, node in view.planned.items():
        if name in view.observed:
            continue
        if name in view.over:
            yield ENDED_NODE.on_node(
                Outcome.UNVERIFIABLE,
                node,
                expected="node in the graph, or ended by itself",
                observed=view.over[name],
                message=f"cannot verify node {name}: it has ended by itself, as it may",
            )
            continue
        hint = ""
        if node.run.component:
            hint = f"look at the log of its container {node.run.container}"
        elif node.run.kind is RunKind.ATTACH:
            hint = "start it: the manifest attaches to it; compare domain, RMW and discovery range"
        elif not view.brings_up(node):
            machine = f" --machine {node.machine}" if node.machine else ""
            hint = f"its machine has a supervisor of its own: lifecycle up MANIFEST{machine}"
        beyond = view.is_beyond(node)
        if beyond:
            hint = f"the supervisor of machine {node.machine!r} verifies it"
        yield MISSING_NODE.on_node(
            Outcome.UNVERIFIABLE if beyond else Outcome.VIOLATED,
            node,
            expected="node in the graph",
            observed="out of reach" if beyond else "no such node",
            message=f"cannot verify node {name}: it talks by the shared memory of machine"
            f" {node.machine!r} alone"
            if beyond
            else f"cannot find node {name} in domain {view.plan.domain_id}",
            hint=hint,
        )


def _duplicate(view: View) -> Iterator[Finding]:
    identities: dict[str, int] = {}
    for configuration in view.reported:
        identities[configuration.name] = identities.get(configuration.name, 0) + 1
    for name, observed in view.observed.items():
        count = max(observed.count, identities.get(name, 0))
        if count < 2:
            continue
        node = view.planned.get(name)
        yield DUPLICATE_NODE.finding(
            Outcome.VIOLATED,
            subject=name,
            expected="1 node of this name",
            observed=f"{count} nodes",
            message=f"cannot tell {count} nodes named {name} apart",
            at=node.at if node else None,
            node=name,
        )


def _undeclared(view: View) -> Iterator[Finding]:
    owned: dict[str, list[str]] = {}
    for endpoint in view.foreign:
        owned.setdefault(endpoint.node, []).append(f"{endpoint.kind.noun} of {endpoint.name}")
    names = {name for name in view.observed if name not in view.planned} | set(owned)
    for name in sorted(names):
        endpoints = ", ".join(dict.fromkeys(owned.get(name, [])))
        yield UNDECLARED_NODE.finding(
            Outcome.VIOLATED,
            subject=name,
            expected="no such node",
            observed=f"node with {endpoints}" if endpoints else "node",
            message=f"cannot allow node {name}: the manifest does not declare it",
            node=name,
        )
