"""The rule about definitions of interfaces: types of one name that are not the same type. Pure.

DDS matches by the name of a type, so two ends with two definitions match and exchange garbage. Each
end announces the hash of its definition (REP-2016), and rosidl installs the hash beside it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

from lifecycle.manifest import EndpointKind, Position
from lifecycle.verify.observation import ObservedEndpoint
from lifecycle.verify.rules.catalogue import Rule
from lifecycle.verify.rules.endpoints import MEETS
from lifecycle.verify.verdict import Finding, Outcome
from lifecycle.verify.view import View

DEFINITION_DIFFERS = Rule(
    id="graph.type-definition-differs",
    meaning="an endpoint's type has the declared name and another definition",
    outcomes=(Outcome.VIOLATED, Outcome.UNVERIFIABLE),
    fix="build both ends from one version of the interface package, and install the same here",
    concerns_flow=True,
)
RULES = (DEFINITION_DIFFERS,)


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class _TypedEnd:
    """One end of a topic, service or action.

    Attributes:
        type_hash: as announced or reported; empty if there is none, None if that was not seen.
        at: its declaration; None if there is none.
    """

    kind: EndpointKind
    node: str
    type_hash: str | None
    at: Position | None


_Place = tuple[str, str, str]
"""What ends meet in, its name, and their type."""


def check(view: View) -> Iterator[Finding]:
    """Compare the ends of everything that is declared, with what is installed or each other."""
    installed = {
        _place(each.planned.kind, each.planned.resolved, each.planned.type): each.planned.type_hash
        for each in view.actual
    }
    unknown: dict[str, list[tuple[_Place, _TypedEnd]]] = {}
    for place, ends in _ends(view).items():
        if place not in installed:
            continue  # nothing of the plan meets there, or its type is wrong: that is said
        expected = installed[place]
        source = "the definition installed here"
        if not expected:
            # A stranger that differs is at fault itself, so declared ends come first.
            by_right = sorted(ends, key=lambda end: end.at is None)
            first = next(((end.type_hash, end.node) for end in by_right if end.type_hash), None)
            if first is None:
                continue  # nothing to compare with
            expected, source = first[0], first[1] or "an unknown node"
        for end in dict.fromkeys(ends):
            if end.type_hash == "":
                unknown.setdefault(end.node, []).append((place, end))
            elif end.type_hash is not None and differ(end.type_hash, expected):
                yield _differs(place, end, expected, source)
    for node in sorted(unknown):
        yield _unverifiable(node, unknown[node])


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


def _ends(view: View) -> dict[_Place, list[_TypedEnd]]:
    found: dict[_Place, list[_TypedEnd]] = {}
    for seen in view.seen:
        at = seen.planned.at if seen.planned else None
        end = _TypedEnd(kind=seen.kind, node=seen.node, type_hash=seen.type_hash, at=at)
        found.setdefault(_place(seen.kind, seen.name, seen.type), []).append(end)
    outsiders = (*view.undeclared, *view.foreign, *view.of_tools, *view.unattributed)
    others: list[tuple[ObservedEndpoint, Position | None]] = [
        (actual.observed, actual.planned.at)
        for actual in view.actual
        if actual.observed is not None
    ]
    others += [(each, None) for each in outsiders]
    for each, at in others:
        if not each.kind.is_topic:
            end = _TypedEnd(kind=each.kind, node=each.node, type_hash=each.type_hash, at=at)
            found.setdefault(_place(each.kind, each.name, each.type), []).append(end)
    return found


def _place(kind: EndpointKind, name: str, type_: str) -> _Place:
    return MEETS[kind], name, type_


def _differs(place: _Place, end: _TypedEnd, expected: str, source: str) -> Finding:
    what, name, type_ = place
    node = end.node or "an unknown node"
    return DEFINITION_DIFFERS.finding(
        Outcome.VIOLATED,
        subject=name,
        expected=f"{type_} as {expected}",
        observed=f"{type_} as {end.type_hash}",
        message=f"cannot accept the {end.kind.noun} of {name} in {node}: its {type_} is not"
        f" that of {source}; both have the name, so the {what} is matched and the data are not"
        " understood",
        at=end.at,
        node=end.node,
        endpoint=end.kind,
    )


def _unverifiable(node: str, ends: list[tuple[_Place, _TypedEnd]]) -> Finding:
    """One finding for a node: who announces no hash announces none for any of its endpoints."""
    who = node or "an unknown node"
    listed = ", ".join(dict.fromkeys(f"{name} ({end.kind.noun})" for (_, name, _), end in ends))
    return DEFINITION_DIFFERS.finding(
        Outcome.UNVERIFIABLE,
        subject=who,
        expected="a type hash",
        observed="none announced",
        message=f"cannot verify which definitions {who} uses on {listed}: it announces no type"
        " hashes",
        at=next((end.at for _, end in ends if end.at), None),
        node=node,
        hint="ROS 2 announces them since Iron; run the node under a newer one, or accept the gap",
    )
