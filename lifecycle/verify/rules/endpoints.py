"""Rules about endpoints: missing, undeclared, not made, of another type or definition. Pure.

DDS matches by the name of a type, so two ends with two definitions match and exchange garbage. Each
end announces the hash of its definition (REP-2016), and rosidl installs the hash beside it.

A publisher on a declared topic and a server of a declared service or action feed the system,
whatever their node is called. One that only subscribes or calls is tolerated where the policy names
it.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from lifecycle.manifest.diagnostics import Position
from lifecycle.manifest.model import EndpointKind, EndpointPolicy
from lifecycle.manifest.names import SUPERVISORS
from lifecycle.verify.observation import ObservedEndpoint
from lifecycle.verify.outcome import Outcome
from lifecycle.verify.rules.catalogue import About, Heals, Rule
from lifecycle.verify.rules.nodes import MISSING_NODE
from lifecycle.verify.tool_filter import action_part, is_of_observer, part_type
from lifecycle.verify.verdict import Finding, Stage
from lifecycle.verify.view import Actual, SeenEndpoint, View, Whose

MISSING_ENDPOINT = Rule(
    id="graph.missing-endpoint",
    meaning="a declared endpoint is not in the graph",
    says="{who} is declared, and is {observed}",
    fix="compare the declared name, remaps and namespace with what the node creates",
    concerns_flow=True,
    heals=Heals.WITH_TIME,
    about=About.PRESENCE,
)
TYPE_MISMATCH = Rule(
    id="graph.type-mismatch",
    meaning="an endpoint has another type than declared, or than others of its name",
    fix="correct the type in the manifest or in the node; DDS never matches two types",
    concerns_flow=True,
)
ENDPOINT_ERROR = Rule(
    id="endpoint.error",
    meaning="a node reports that it could not make an endpoint as asked",
    says="{who} could not be made: {observed}",
    fix="read the reason: it is the middleware's own",
    concerns_flow=True,
)
UNSEEN_ENDPOINT = Rule(
    id="graph.unseen-endpoint",
    meaning="an endpoint that discovery does not show to this observer is not proven either way",
    outcomes=(Outcome.UNVERIFIABLE,),
    fix="verify it where it can be seen: on its own host, or with its connection's peers",
    concerns_flow=True,
    heals=Heals.WITH_TIME,
)

UNDECLARED = {
    kind: Rule(
        id=f"graph.undeclared-{kind.noun.replace(' ', '-')}",
        meaning=f"a declared node has {'an' if kind.noun.startswith('a') else 'a'} {kind.noun}"
        " that the manifest does not declare"
        + (", or a tool has one under a declared name" if kind.offers else ""),
        says="the manifest does not declare {who}",
        fix="declare it in the node's interface, remove it, or set `endpoints: open` on the node",
    )
    for kind in EndpointKind
}


def check(view: View) -> Iterator[Finding]:
    """Judge the existence, the type, and its definition, of endpoints; then those of outsiders."""
    for facts in view.nodes.values():
        for actual in facts.actual:
            yield from _declared(actual, absent=facts.absent)
            if actual.unseen and not facts.absent:
                yield from _unseen(view, actual)
    yield from _undeclared(view)
    yield from _conflicts(view)
    yield from _definitions(view)
    if view.plan.policy.undeclared_nodes is EndpointPolicy.DECLARED:
        yield from _offered_by_tools(view)
        yield from _unattributed(view)


def _declared(actual: Actual, *, absent: bool) -> Iterator[Finding]:
    if actual.report is not None and actual.report.error:
        yield ENDPOINT_ERROR.on(actual, expected="made as asked", observed=actual.report.error)
    elif actual.observed is None and not absent and not (actual.unseen and actual.report is None):
        yield MISSING_ENDPOINT.on(
            actual, expected="in the graph", observed="not there", hint=_remapped(actual)
        )
    seen = actual.observed or actual.report
    if seen is not None and seen.type != actual.planned.type:
        yield TYPE_MISMATCH.on(
            actual, expected=actual.planned.type, observed=seen.type or "of unknown type"
        )


def _remapped(actual: Actual) -> str:
    """Return which other name its node has the endpoint under; empty if it has none."""
    report = actual.report
    if report is None or report.resolved == actual.name:
        return ""
    return (
        f"{report.kind.value}/{report.name} is {report.resolved} now: is a remap wrong, or was "
        f"{actual.node}/remap called? the name '' gives back the declared one"
    )


def _unseen(view: View, actual: Actual) -> Iterator[Finding]:
    """What discovery does not show is proven by its node's report and by matched counts."""
    report = actual.report
    if report is None:
        reason = "discovery does not show it here, and its node does not report it"
    elif actual.observed is None:
        return  # its node says that it is not there: that is violated, and said
    elif report.matched is None:
        reason = "discovery does not show it here, and nobody counts whom it is matched with"
    else:
        publishers, subscriptions = view.topics.get(actual.name, ((), ()))
        ends = subscriptions if actual.kind is EndpointKind.PUBLISHER else publishers
        known = sum(each.whose is not Whose.DEPARTED for each in ends)
        more = report.matched - known
        if more <= 0 or view.plan.policy.undeclared_nodes is EndpointPolicy.OPEN:
            return
        reason = f"it is matched with {report.matched}, of which {known} are known here"
    yield UNSEEN_ENDPOINT.on(actual, expected="in the graph", observed=reason)


def _undeclared(view: View) -> Iterator[Finding]:
    for endpoint in view.of(Whose.UNDECLARED):
        node = view.planned[endpoint.node]
        wrong = _wrong_part(view, endpoint)
        if wrong is not None:
            yield wrong
            continue
        if node.endpoint_policy is EndpointPolicy.OPEN:
            continue
        similar = [
            each.planned
            for each in view.nodes[endpoint.node].actual
            if each.kind is endpoint.kind
            and each.planned.type == endpoint.type
            and each.observed is None
        ]
        hint = ""
        if len(similar) == 1:
            hint = f"{similar[0].resolved} of the same type is missing: is a remap or a name wrong?"
        yield _not_declared(endpoint, at=node.at, hint=hint)


def _not_declared(endpoint: SeenEndpoint, **fields: Any) -> Finding:
    word = endpoint.kind.noun
    return UNDECLARED[endpoint.kind].finding(
        **_named(endpoint),
        expected=f"no such {word}",
        observed=f"{word} of type {endpoint.type}" if endpoint.type else word,
        **fields,
    )


def _named(end: SeenEndpoint) -> dict[str, Any]:
    """Return what a finding is on that is on an endpoint, declared or not."""
    return {"subject": end.name, "who": end.where, "node": end.node, "endpoint": end.kind}


def _wrong_part(view: View, endpoint: SeenEndpoint) -> Finding | None:
    """Judge a part of an action that its node declares; None for everything else."""
    part = action_part(endpoint.kind, endpoint.name)
    if part is None:
        return None
    for actual in view.nodes[endpoint.node].actual:
        if (actual.kind, actual.name) != part:
            continue
        expected = part_type(endpoint.name, actual.planned.type)
        if endpoint.type != expected:
            return TYPE_MISMATCH.on(
                actual,
                who=f"{endpoint.name} of {actual.where}",
                expected=expected,
                observed=endpoint.type or "of unknown type",
            )
    return None


def _conflicts(view: View) -> Iterator[Finding]:
    """A topic, service or action of ours that an undeclared node uses with another type."""
    types = {(each.kind.meets_in, each.name): each.planned.type for each in view.actual}
    for seen in view.of(Whose.UNDECLARED, Whose.TWIN, Whose.FOREIGN, Whose.UNKNOWN):
        what = seen.kind.meets_in
        declared = types.get((what, seen.name), seen.type)
        if seen.type == declared:
            continue
        yield TYPE_MISMATCH.finding(
            **_named(seen),
            expected=f"{declared}, as the manifest declares the {what}",
            observed=seen.type or "of unknown type",
        )


DEFINITION_DIFFERS = Rule(
    id="graph.type-definition-differs",
    meaning="an endpoint's type has the declared name and another definition",
    outcomes=(Outcome.VIOLATED, Outcome.UNVERIFIABLE),
    says="{who} is of another definition, {observed}, and must be of {expected}: it is matched, and"
    " the data are not understood",
    unproven="nothing shows which definitions {who}: it announces {observed}",
    fix="build both ends from one version of the interface package, and install the same here",
    concerns_flow=True,
)
UNATTRIBUTED_ENDPOINT = Rule(
    id="graph.unattributed-endpoint",
    meaning="the graph has an endpoint whose node is not known",
    outcomes=(Outcome.VIOLATED, Outcome.UNVERIFIABLE),
    says="no known node has {who}",
    unproven="no known node has {who}",
    fix="wait for discovery; a plain DDS program has no node name: give it another domain",
    heals=Heals.WITH_TIME,
    if_undiscovered=True,
    awaits=MISSING_NODE,  # discovery shows an endpoint before its node
)
RULES = (
    *(MISSING_ENDPOINT, UNSEEN_ENDPOINT, *UNDECLARED.values()),
    *(TYPE_MISMATCH, ENDPOINT_ERROR, DEFINITION_DIFFERS, UNATTRIBUTED_ENDPOINT),
)


_Place = tuple[str, str, str]
"""What ends meet in, its name, and their type."""


def _definitions(view: View) -> Iterator[Finding]:
    """Compare the ends of everything that is declared, with what is installed or each other."""
    installed = {
        (each.kind.meets_in, each.name, each.planned.type): each.planned.type_hash
        for each in view.actual
    }
    unknown: dict[str, list[SeenEndpoint]] = {}
    differing: dict[Finding, None] = {}
    for place, ends in _ends(view).items():
        if place not in installed:
            continue  # nothing of the plan meets there, or its type is wrong: that is said
        expected, source = installed[place], "installed here"
        if not expected:
            # A stranger that differs is at fault itself, so declared ends come first.
            by_right = sorted(ends, key=lambda end: end.planned is None)
            first = next((end for end in by_right if end.type_hash), None)
            if first is None:
                continue  # nothing to compare with
            expected = first.type_hash or ""
            source = f"that of {first.node or 'an unknown node'}"
        for end in ends:
            if end.type_hash == "":
                unknown.setdefault(end.node, []).append(end)
            elif end.type_hash is not None and differ(end.type_hash, expected):
                differing[_differs(end, expected, source)] = None
    yield from differing
    for node in sorted(unknown):
        yield _unverifiable(node, unknown[node])


def _ends(view: View) -> dict[_Place, list[SeenEndpoint]]:
    """Return the ends of all topics, services and actions by where they meet.

    What tools have of topics is their own matter.
    """
    found: dict[_Place, list[SeenEndpoint]] = {}
    declared = (each for each in view.actual if each.observed is not None or each.beyond)
    others = (each for each in view.others if not (each.is_passing and each.kind.is_topic))
    for end in (*declared, *others):
        found.setdefault(_place(end), []).append(end)
    return found


def differ(one: str, other: str) -> bool:
    """Return whether two hashes are of two definitions; other hash versions are not compared.

    A hash begins with its version, `RIHS01_` (REP-2016).
    """
    parts = one.split(), other.split()
    if len(parts[0]) != len(parts[1]):
        return True
    return any(
        a != b and a.partition("_")[0] == b.partition("_")[0] for a, b in zip(*parts, strict=True)
    )


def _place(end: SeenEndpoint) -> _Place:
    return end.kind.meets_in, end.name, end.type


def _at(end: SeenEndpoint) -> Position | None:
    return end.planned.at if end.planned else None


def _differs(end: SeenEndpoint, expected: str, source: str) -> Finding:
    return DEFINITION_DIFFERS.finding(
        **_named(end),
        outcome=Outcome.VIOLATED,
        expected=f"{end.type} as {expected}, which is {source}",
        observed=f"{end.type} as {end.type_hash}",
        at=_at(end),
    )


def _unverifiable(node: str, ends: list[SeenEndpoint]) -> Finding:
    """One finding for a node: who announces no hash announces none for any of its endpoints."""
    who = node or "an unknown node"
    listed = ", ".join(dict.fromkeys(f"{end.name} ({end.kind.noun})" for end in ends))
    return DEFINITION_DIFFERS.finding(
        outcome=Outcome.UNVERIFIABLE,
        subject=who,
        who=f"{who} uses on {listed}",
        expected="a type hash",
        observed="no type hash",
        at=next(filter(None, map(_at, ends)), None),
        node=node,
        hint="ROS 2 announces them since Iron; run the node under a newer one, or accept the gap",
    )


def _offered_by_tools(view: View) -> Iterator[Finding]:
    for each in view.of(Whose.TOOL):
        if not view.names.fed_by(each.kind, each.name):
            continue
        if not is_of_observer(each.kind, each.node, each.name, each.type):
            yield _not_declared(
                each,
                hint=f"policy.tolerated_nodes ({view.tools[each.node]}) lets it listen only: stop"
                " it, or declare its node",
            )


def _unattributed(view: View) -> Iterator[Finding]:
    """Closed world: every endpoint must be attributed to a node, at the latest before the gate.

    After it, who only listens may be a tool whose name has yet to come; who feeds may not.
    """
    for endpoint in view.of(Whose.UNKNOWN):
        word = endpoint.kind.noun
        # The supervisor of another machine begins to offer what is its own after its gate.
        its_own = endpoint.name.startswith(SUPERVISORS)
        feeds = view.names.fed_by(endpoint.kind, endpoint.name) and not its_own
        violated = feeds or view.stage is Stage.CONNECTED
        yield UNATTRIBUTED_ENDPOINT.finding(
            outcome=Outcome.VIOLATED if violated else Outcome.UNVERIFIABLE,
            subject=endpoint.name,
            who=f"this {word} of {endpoint.name}{_described(endpoint.observed)}",
            expected="that of a declared node",
            observed="that of an unknown node",
            endpoint=endpoint.kind,
        )


_VENDORS = {
    "0101": "RTI Connext DDS",
    "0103": "OpenDDS",
    "0109": "RTI Connext Micro",
    "010f": "Fast DDS",
    "0110": "Cyclone DDS",
    "0111": "GurumDDS",
    "0112": "RustDDS",
}
"""By the vendor id that a GUID prefix begins with (DDSI-RTPS §9.3.1.5, dds-foundation.org)."""


def _described(endpoint: ObservedEndpoint | None) -> str:
    """Describe an endpoint's participant as far as known: vendor, address, GID; else empty."""
    if endpoint is None:
        return ""
    vendor = _VENDORS.get(endpoint.gid[:4], "")
    known = [f"a participant of {vendor}"] if vendor else []
    known += [f"at {endpoint.address}"] if endpoint.address else []
    known += [f"GID {endpoint.gid}"] if endpoint.gid else []
    return f" ({', '.join(known)})" if known else ""
