"""Checks of what nodes wait for that others show in the graph: what they can never show. Pure."""

from __future__ import annotations

from collections.abc import Iterator

from lifecycle.errors import did_you_mean
from lifecycle.manifest.checks.parameters import is_implicit, misfit, suggestion
from lifecycle.manifest.checks.system import DeclaredSystem
from lifecycle.manifest.diagnostics import Diagnostic
from lifecycle.manifest.model import After, EndpointPolicy, Node, Readiness, ReadyBy
from lifecycle.manifest.names import NODE_SERVICES, OUR_SERVICES, name_problem, topic_of
from lifecycle.manifest.yaml.document import error, note


def check_readiness(system: DeclaredSystem) -> Iterator[Diagnostic]:
    """Yield findings about topics, services and parameters that others are waited for to have."""
    for node in system.manifest.nodes:
        for after in node.after:
            other, wanted = system.nodes.get(after.node), after.condition
            if other in (None, node) or not isinstance(wanted, Readiness):
                continue
            if wanted.by is ReadyBy.PARAMETER:
                yield from _parameter(after, wanted, other, system)
            elif problem := name_problem(wanted.name):
                message = f"cannot wait until {after.node!r} {wanted}: {problem}"
                yield error("check.name", after.at, message)
            else:
                yield from _endpoint(after, wanted, other, system)


def _endpoint(
    after: After, wanted: Readiness, other: Node, system: DeclaredSystem
) -> Iterator[Diagnostic]:
    noun, message = wanted.by.kinds[0].noun, f"cannot wait until {after.node!r} {wanted}"
    names = [(kind, topic_of(other, wanted.name, kind)) for kind in wanted.by.kinds]
    if any(each.node.key == other.key for one in names for each in system.named(*one)):
        return
    if not _of_every_node(other).isdisjoint(name for _, name in names):
        hint = f"write '{after.node}: started'"
        yield error("check.after-undeclared", after.at, f"{message}: every node has it", hint)
        return
    declared = [each.name for each in other.interface.endpoints if each.kind in wanted.by.kinds]
    why = f"{message}: its interface declares no such {noun}"
    hint = did_you_mean(wanted.name, declared)
    if other.endpoints is EndpointPolicy.DECLARED:
        hint = hint or f"declare it in the interface of {after.node!r}, or write 'endpoints: open'"
        yield error("check.after-undeclared", after.at, why, hint)
    elif declared:
        yield note("check.after-undeclared", after.at, f"{why}, and may have others", hint)


def _of_every_node(node: Node) -> frozenset[str]:
    """Return what a node has as soon as it is there, which is not looked at in the graph."""
    own = (*NODE_SERVICES, *OUR_SERVICES, "transition_event")
    return frozenset({"/rosout", "/parameter_events", *(f"{node.full_name}/{x}" for x in own)})


def _parameter(
    after: After, wanted: Readiness, other: Node, system: DeclaredSystem
) -> Iterator[Diagnostic]:
    name, value = wanted.name, wanted.value
    message = f"cannot wait until {after.node!r} {wanted}"
    given, at = dict(other.parameters), other.where(f"parameters.{name}")
    declared = {each.name: each for each in other.interface.parameters}
    if (declaration := declared.get(name)) is None:
        if other.interface.has_all_parameters and not is_implicit(name):
            why = f"{message}: its interface declares no such parameter"
            hint = did_you_mean(name, declared) or "declare it under 'interface.parameters'"
            yield error("check.after-undeclared", after.at, why, hint)
    elif value is not None and misfit(value, declaration.type):
        why = f"{message}: it is declared as {declaration.type}"
        yield error("check.after-value", after.at, why, suggestion(value, declaration.type))
        return
    elif name not in given and declaration.default is not None:
        given, at = {name: declaration.default}, declaration.at
    modes = (each for mode in system.manifest.modes for each in mode.parameters)
    is_fixed = all((each.node, each.name) != (other.key, name) for each in modes)
    if given.get(name, value) != value and is_fixed:
        why = f"{message}: it must keep the value that it is given at {at.spelled}"
        yield error("check.after-value", after.at, why, "leave that value out")


CHECKS = (check_readiness,)
