"""Rules about node names: missing, undeclared, duplicate; and endpoints of undeclared nodes. Pure.

A publisher on a declared topic and a server of a declared service or action feed the system,
whatever their node is called. One that only subscribes or calls is tolerated where the policy names
it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping

from lifecycle.manifest.model import EndpointPolicy, RunKind
from lifecycle.plan.model import PlannedProcess
from lifecycle.verify.observation import ObservedEndpoint
from lifecycle.verify.outcome import Outcome
from lifecycle.verify.rules.catalogue import About, Heals, Rule
from lifecycle.verify.rules.endpoints import UNDECLARED
from lifecycle.verify.tool_filter import of_supervisors
from lifecycle.verify.verdict import Finding, Stage
from lifecycle.verify.view import View, brings_up, is_beyond

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
    fix="declare it, stop it, give the system a domain of its own, or set"
    " policy.undeclared_nodes: open",
)
DUPLICATE_NODE = Rule(
    id="graph.duplicate-node",
    meaning="several nodes carry one fully qualified name",
    fix="stop the other one, or give each its own name or namespace",
)
ENDED_NODE = Rule(
    id="graph.ended-node",
    meaning="a node that may end by itself has ended",
    outcomes=(Outcome.UNVERIFIABLE,),
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
            yield ENDED_NODE.on(
                node,
                expected="node in the graph, or ended by itself",
                observed=view.over[name] or "no such node",
                message=f"node {name} has ended by itself, as it may"
                if view.over[name]
                else f"node {name} may have ended by itself, or not have started",
            )
            continue
        hint = ""
        if node.run.component:
            hint = f"look at the log of its container {node.run.container}"
        elif node.run.kind is RunKind.ATTACH:
            hint = "start it: the manifest attaches to it; compare domain, RMW and discovery range"
        elif name in others:
            hint = (
                f"is it {' or '.join(others[name])}? its command chooses the name; a `name` in the"
                " manifest is given to the command, or take the name that it has as the key"
            )
        elif not brings_up(node, view.machines):
            machine = f" --machine {node.machine}" if node.machine else ""
            hint = f"its machine has a supervisor of its own: lifecycle up MANIFEST{machine}"
        beyond = is_beyond(node, view.machines)
        if beyond:
            hint = f"the supervisor of machine {node.machine!r} verifies it"
        yield MISSING_NODE.on(
            node,
            outcome=Outcome.UNVERIFIABLE if beyond else Outcome.VIOLATED,
            expected="node in the graph",
            observed="out of reach" if beyond else "no such node",
            message=f"node {name} cannot be seen from here: it uses the shared memory of machine"
            f" {node.machine!r} alone"
            if beyond
            else f"there is no node {name} in domain {view.plan.domain_id}",
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
            expected="1 node of this name",
            observed=f"{count} nodes",
            message=f"there are {count} nodes named {name}",
            at=node.at if node else None,
            node=name,
            hint=hint,
        )


def _undeclared(view: View, others: Mapping[str, list[str]]) -> Iterator[Finding]:
    owned: dict[str, list[str]] = {}
    for endpoint in view.foreign:
        owned.setdefault(endpoint.node, []).append(f"{endpoint.kind.noun} of {endpoint.name}")
    undeclared = {name for name in view.observed if name not in view.planned} | set(owned)
    for name in sorted(undeclared):
        endpoints = ", ".join(dict.fromkeys(owned.get(name, [])))
        missing = [each for each, names in others.items() if name in names]
        yield UNDECLARED_NODE.finding(
            subject=name,
            expected="no such node",
            observed=f"node with {endpoints}" if endpoints else "node",
            message=f"the manifest does not declare node {name}",
            node=name,
            hint=f"if it is {' or '.join(missing)}, which is missing, write a `name` there; else"
            f" {UNDECLARED_NODE.fix}"
            if missing
            else "",
        )


UNATTRIBUTED_ENDPOINT = Rule(
    id="graph.unattributed-endpoint",
    meaning="the graph has an endpoint whose node is not known",
    outcomes=(Outcome.VIOLATED, Outcome.UNVERIFIABLE),
    fix="wait for discovery; a plain DDS program has no node name: give it another domain",
    heals=Heals.WITH_TIME,
    if_undiscovered=True,
    awaits=MISSING_NODE,  # discovery shows an endpoint before its node
)
OUTSIDER_RULES = (UNATTRIBUTED_ENDPOINT,)

_GUID_DIGITS = 32
_VENDORS = {
    0x0101: "RTI Connext DDS",
    0x0102: "OpenSplice DDS",
    0x0103: "OpenDDS",
    0x0106: "InterCOM DDS",
    0x0107: "CoreDX DDS",
    0x0109: "RTI Connext Micro",
    0x010A: "Vortex Cafe",
    0x010D: "Vortex Lite",
    0x010F: "Fast DDS",
    0x0110: "Cyclone DDS",
    0x0111: "GurumDDS",
    0x0112: "RustDDS",
    0x0114: "Dust DDS",
}
"""By the vendor id that a GUID prefix begins with (DDSI-RTPS §9.3.1.5, dds-foundation.org)."""


def check_outsiders(view: View) -> Iterator[Finding]:
    """Judge what tools offer under declared names, and what no known node has."""
    if view.plan.policy.undeclared_nodes is not EndpointPolicy.DECLARED:
        return
    yield from _offered_by_tools(view)
    yield from _unattributed(view)


def _offered_by_tools(view: View) -> Iterator[Finding]:
    supervisors = of_supervisors(view.plan, view.of_tools)
    for endpoint in view.of_tools:
        if endpoint in supervisors or not view.names.fed_by(endpoint.kind, endpoint.name):
            continue
        word = endpoint.kind.noun
        of_supervisor = view.names.is_of_supervisors(endpoint.kind, endpoint.name)
        verb = "feeds" if endpoint.kind.is_topic else "serves"
        whom = "whoever asks for the supervisor" if of_supervisor else "the system"
        yield UNDECLARED[endpoint.kind].finding(
            subject=endpoint.name,
            expected=f"no such {word} of {endpoint.node}",
            observed=f"{word} of type {endpoint.type}" if endpoint.type else word,
            message=f"the manifest does not declare the {word} of {endpoint.name} in"
            f" {endpoint.node}, which {verb} {whom}",
            node=endpoint.node,
            endpoint=endpoint.kind,
            hint="only the supervisor of this system offers it; if several nodes do, none is taken"
            " for the supervisor: stop those that are not"
            if of_supervisor
            else f"policy.tolerated_nodes ({view.tools[endpoint.node]}) lets it listen only: stop"
            " it, or declare its node",
        )


def _unattributed(view: View) -> Iterator[Finding]:
    """Closed world: every endpoint must be attributed to a node, at the latest before the gate.

    After it, who only listens may be a tool whose name has yet to come; who feeds may not.
    """
    for endpoint in view.unattributed:
        word = endpoint.kind.noun
        feeds = view.names.fed_by(endpoint.kind, endpoint.name)
        # The supervisor of another machine begins to offer them after its gate.
        feeds = feeds and not view.names.is_of_supervisors(endpoint.kind, endpoint.name)
        violated = feeds or view.stage is Stage.CONNECTED
        yield UNATTRIBUTED_ENDPOINT.finding(
            outcome=Outcome.VIOLATED if violated else Outcome.UNVERIFIABLE,
            subject=endpoint.name,
            expected=f"{word} of a declared node",
            observed=f"{word} of an unknown node",
            message=f"no known node has this {word} of {endpoint.name}{described(endpoint)}",
            endpoint=endpoint.kind,
        )


def described(endpoint: ObservedEndpoint) -> str:
    """Describe an endpoint's participant as far as known: vendor, address, GID; else empty."""
    known = []
    vendor = int(endpoint.gid[:4], 16) if len(endpoint.gid) == _GUID_DIGITS else 0
    if vendor:
        known.append(f"a participant of {_VENDORS.get(vendor, f'DDS vendor {vendor:#06x}')}")
    if endpoint.address:
        known.append(f"at {endpoint.address}")
    if endpoint.gid:
        known.append(f"GID {endpoint.gid}")
    return f" ({', '.join(known)})" if known else ""
