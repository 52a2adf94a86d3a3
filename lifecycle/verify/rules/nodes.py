"""Rules about node names: missing, undeclared, duplicate. Pure."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping

from lifecycle.manifest.model import EndpointPolicy, RunKind
from lifecycle.plan.model import PlannedProcess
from lifecycle.verify.outcome import Outcome
from lifecycle.verify.rules.catalogue import About, Heals, Rule
from lifecycle.verify.verdict import Finding, Stage
from lifecycle.verify.view import View, Whose, brings_up, is_beyond

MISSING_NODE = Rule(
    id="graph.missing-node",
    meaning="a declared node is not in the graph",
    outcomes=(Outcome.VIOLATED, Outcome.UNVERIFIABLE),
    fix="look at the node's process and its log; compare domain, RMW and discovery range",
    says="there is no {who} {expected}",
    concerns_flow=True,
    heals=Heals.WITH_TIME,
    about=About.PRESENCE,
    if_undiscovered=True,
)
UNDECLARED_NODE = Rule(
    id="graph.undeclared-node",
    meaning="the graph has a node that the manifest does not declare",
    says="the manifest does not declare {who}",
    fix="declare it, stop it, give the system a domain of its own, or set"
    " policy.undeclared_nodes: open",
)
DUPLICATE_NODE = Rule(
    id="graph.duplicate-node",
    meaning="several nodes carry one fully qualified name",
    says="there are {observed} named {who}",
    fix="stop the other one, or give each its own name or namespace",
)
ENDED_NODE = Rule(
    id="graph.ended-node",
    meaning="a node that may end by itself has ended",
    outcomes=(Outcome.UNVERIFIABLE,),
    unproven="{who} may end by itself, and is not there: {observed}",
    fix="nothing, if its work was to be done once; without `may_end` its end is a failure",
    concerns_flow=True,
    heals=Heals.NEVER,
)
RULES = (MISSING_NODE, ENDED_NODE, UNDECLARED_NODE, DUPLICATE_NODE)


def check(view: View) -> Iterator[Finding]:
    """Judge node names."""
    others = _other_names(view)
    yield from _missing(view, others)
    yield from _duplicate(view)
    if view.plan.policy.undeclared_nodes is EndpointPolicy.DECLARED:
        yield from _undeclared(view, others)


def _missing(view: View, others: Mapping[str, list[str]]) -> Iterator[Finding]:
    for name, node in view.planned.items():
        if name in view.observed:
            continue
        if name in view.over:
            how = view.over[name] or "it has ended, or not started"
            yield ENDED_NODE.on(node, expected="there, or ended by itself", observed=how)
            continue
        hint = ""
        if node.run.component:
            hint = f"look at the log of its container {node.run.container}"
        elif node.run.kind is RunKind.ATTACH:
            hint = "start it: the manifest attaches to it; compare domain, RMW and discovery range"
        elif name in others:
            meant = others[name]
            chosen = meant[0].rpartition("/")[2] if len(meant) == 1 else "…"
            hint = f"is it {' or '.join(meant)}? write 'name: {chosen}' at nodes.{node.key}"
        elif not brings_up(node, view.machines):
            machine = f" --machine {node.machine}" if node.machine else ""
            hint = f"its machine has a supervisor of its own: lifecycle up MANIFEST{machine}"
        beyond = is_beyond(node, view.machines)
        if beyond:
            hint = f"the supervisor of machine {node.machine!r} verifies it"
        far = f"it uses the shared memory of machine {node.machine!r} alone"
        yield MISSING_NODE.on(
            node,
            outcome=Outcome.UNVERIFIABLE if beyond else Outcome.VIOLATED,
            expected=f"in domain {view.plan.domain_id}",
            observed=far if beyond else "not there",
            hint=hint,
        )


def _other_names(view: View) -> dict[str, list[str]]:
    """Return what missing nodes may be called, where their names are their commands' to choose.

    Those are the undeclared nodes of the namespace. What is given `__node:=` is renamed by rcl.
    """
    strangers: dict[str, list[str]] = {}
    for name in view.observed:
        if name not in view.planned:
            strangers.setdefault(name.rpartition("/")[0], []).append(name)
    if not strangers:
        return {}
    chooses = {each.name for each in view.plan.processes if each.argv and not _renames(each)}
    return {
        name: strangers[place][:_NAMED]
        for name, node in view.planned.items()
        if name not in view.observed
        and node.process in chooses
        and (place := name.rpartition("/")[0]) in strangers
    }


_NAMED = 3


def _renames(process: PlannedProcess) -> bool:
    return any(word.startswith("__node:=") for word in process.argv)


def _duplicate(view: View) -> Iterator[Finding]:
    identities = Counter(each.name for each in view.reported)
    for name, observed in view.observed.items():
        count = max(observed.count, identities[name])
        if count < 2:
            continue
        node = view.planned.get(name)
        # Before the gate one of them may have run before the supervisor did.
        started = node is not None and node.run.kind is not RunKind.ATTACH
        takes = started and view.stage is Stage.CONNECTED
        hint = ""
        process = node.process if node is not None else ""
        if any(each.name == process and _renames(each) for each in view.plan.processes):
            hint = (
                f"`name` renames every node of process {process}: if they are in it, leave it out; "
                "else stop the other one"
            )
        elif takes:
            hint = f"{DUPLICATE_NODE.fix}; have one that ran before adopted: lifecycle up --adopt"
        yield DUPLICATE_NODE.finding(
            subject=name,
            expected="1 node",
            observed=f"{count} nodes",
            at=node.at if node else None,
            node=name,
            hint=hint,
        )


def _undeclared(view: View, others: Mapping[str, list[str]]) -> Iterator[Finding]:
    owned: dict[str, list[str]] = {}
    for endpoint in view.of(Whose.FOREIGN):
        owned.setdefault(endpoint.node, []).append(f"{endpoint.kind.noun} of {endpoint.name}")
    undeclared = {name for name in view.observed if name not in view.planned} | set(owned)
    for name in sorted(undeclared):
        endpoints = ", ".join(dict.fromkeys(owned.get(name, [])))
        missing = [each for each, names in others.items() if name in names]
        yield UNDECLARED_NODE.finding(
            subject=name,
            who=f"node {name}",
            expected="no such node",
            observed=f"node with {endpoints}" if endpoints else "node",
            node=name,
            hint=f"if it is {' or '.join(missing)}, which is missing, write a `name` there; else"
            f" {UNDECLARED_NODE.fix}"
            if missing
            else "",
        )
