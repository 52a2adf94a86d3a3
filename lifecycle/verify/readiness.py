"""Whether a node shows in the graph what others wait for. Pure."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from lifecycle.manifest.checks.parameters import misfit
from lifecycle.manifest.model import EndpointKind, Readiness
from lifecycle.manifest.names import topic_of
from lifecycle.plan.model import PlannedNode
from lifecycle.plan.parameters import as_type, portable
from lifecycle.verify.observation import Observation, ParameterReport
from lifecycle.verify.rules.parameters import is_value


def shown(
    awaited: Iterable[Readiness], node: PlannedNode, seen: Observation
) -> frozenset[Readiness]:
    """Return what of the awaited is there: discovery shows it, or the node itself reports it."""
    wanted = tuple(awaited)
    ends = {*_ends(node, seen)} if any(each.by.kinds for each in wanted) else set()
    parameters = {each.name: each for each in _parameters(node, seen)}
    return frozenset(
        each
        for each in wanted
        if any((kind, topic_of(node, each.name, kind)) in ends for kind in each.by.kinds)
        or (not each.by.kinds and _has(parameters.get(each.name), each))
    )


def _ends(node: PlannedNode, seen: Observation) -> Iterator[tuple[EndpointKind, str]]:
    """Yield the endpoints of a node; of what it has on other participants only it knows."""
    yield from ((each.kind, each.name) for each in seen.endpoints if each.node == node.full_name)
    for report in seen.configurations:
        if report.name == node.full_name:
            yield from ((each.kind, each.resolved) for each in report.endpoints if each.mapped)


def _parameters(node: PlannedNode, seen: Observation) -> Iterator[ParameterReport]:
    for report in seen.configurations:
        if report.name == node.full_name:
            yield from report.parameters or ()
    for read in seen.parameters:
        if read.node == node.full_name:
            yield from read.parameters or ()


def _has(found: ParameterReport | None, wanted: Readiness) -> bool:
    if found is None or wanted.value is None:
        return False
    value = as_type(wanted.value, found.type)
    return not misfit(value, found.type) and is_value(found, portable(value))
