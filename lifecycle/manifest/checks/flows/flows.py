"""Checks of what endpoints ask of their network flows, one by one.

Owns: check.flow-unknown-endpoint, check.flow-dscp, check.transport-priority, check.flow-five-qi,
check.five-qi-class, check.flow-impossible, check.flow-foreign. Pure.
"""

from __future__ import annotations

from collections.abc import Iterator

from lifecycle.manifest.checks.system import System
from lifecycle.manifest.diagnostics import Diagnostic
from lifecycle.manifest.flows.flow_needs import OWN_FLOW, FlowNeeds, ResolvedNeed
from lifecycle.manifest.model import EndpointKind, FlowNeed, Node, RunKind
from lifecycle.manifest.qos import Reliability
from lifecycle.manifest.schema.message_text import did_you_mean
from lifecycle.manifest.yaml.document import error, warning
from lifecycle.network.dscp import MAX_DSCP, describe
from lifecycle.network.five_qi import five_qi_of
from lifecycle.network.nfe import UniqueRequirement

ASKS_UNIQUE = (*OWN_FLOW, UniqueRequirement.SYSTEM_DEFAULT)
"""Requirements that may make an endpoint's NFE unique."""

_FIVE_QI = range(1, 255)  # one octet, 0 and 255 reserved (TS 24.501 §9.11.4.12)
_KEPT_BY_CLASS = ("max_delay_ms", "loss")
"""What a class promises whatever the rate; the others depend on what an operator configures."""


def endpoints(system: System) -> Iterator[Diagnostic]:
    """Yield findings about flow needs of endpoints that are not declared."""
    for node in system.manifest.nodes:
        for need in node.flows:
            yield from _endpoint(node, need)


def check(system: System, needs: FlowNeeds) -> Iterator[Diagnostic]:
    """Yield findings about flow needs, but for `endpoints`."""
    for node in system.manifest.nodes:
        for each in needs.of_node(node):
            yield from _marking(node, each)
            yield from _class(each)
            if node.run.kind is not RunKind.PYTHON:
                yield from _foreign(node, each)


def _endpoint(node: Node, need: FlowNeed) -> Iterator[Diagnostic]:
    noun = need.kind.noun
    declared = [each.name for each in node.interface.endpoints if each.kind is need.kind]
    if need.name in declared:
        return
    other = next(
        (
            each.kind
            for each in node.interface.endpoints
            if each.name == need.name and each.kind is not need.kind
        ),
        None,
    )
    hint = did_you_mean(need.name, declared)
    if other in (EndpointKind.PUBLISHER, EndpointKind.SUBSCRIPTION):
        hint = f"it is a {other.noun}: move it to 'flows.{other.value}'"
    elif other is not None:
        hint = f"it is a {other.noun}; only publishers and subscriptions have flow needs"
    message = f"cannot ask a flow of {noun} {need.name!r}: {node.key!r} declares no such {noun}"
    yield error("check.flow-unknown-endpoint", need.at, message, hint)


def _marking(node: Node, each: ResolvedNeed) -> Iterator[Diagnostic]:
    need = each.need
    given = [
        word
        for word, value in (("a DSCP", need.dscp), ("a priority", need.transport_priority))
        if value is not None
    ]
    if given and need.kind is EndpointKind.SUBSCRIPTION and _is_best_effort(node, need):
        message = (
            f"cannot mark anything that subscription {need.name!r} sends with {given[0]}: it is "
            f"BEST_EFFORT and acknowledges nothing"
        )
        hint = "make it RELIABLE, or mark the publishers of the topic"
        yield warning("check.flow-dscp", need.at, message, hint)
    if len(given) > 1:
        message = (
            f"cannot give {need.kind.noun} {need.name!r} both dscp and transport_priority: each is "
            f"the whole mark"
        )
        yield error("check.flow-dscp", need.at, message, f"keep one; {_both(need)}")
        return
    if need.dscp is not None and not 0 <= need.dscp <= MAX_DSCP:
        message = f"cannot use DSCP {need.dscp}; allowed: 0 to {MAX_DSCP}"
        yield error("check.flow-dscp", need.at, message)
    message, hint = each.marking.problem
    if message and need.transport_priority is not None:
        yield error("check.flow-dscp", need.at, message, hint)
    for note in each.marking.notes:
        rule = "check.five-qi-class" if need.transport_priority is None else ""
        message, _, hint = note.partition("; ")
        yield warning(rule or "check.transport-priority", need.at, message, hint)


def _is_best_effort(node: Node, need: FlowNeed) -> bool:
    """Whether a reader sends no ACKNACK: a BEST_EFFORT one never does (DDSI-RTPS §8.4.11)."""
    qos = next(
        (
            each.qos
            for each in node.interface.endpoints
            if (each.kind, each.name) == (need.kind, need.name)
        ),
        None,
    )
    return qos is not None and qos.reliability is Reliability.BEST_EFFORT


def _both(need: FlowNeed) -> str:
    dscp, priority = need.dscp or 0, need.transport_priority or 0
    spelled = describe(dscp) if 0 <= dscp <= MAX_DSCP else f"DSCP {dscp}"
    return f"the one is {spelled}, the other goes through a mapping from {priority:#x}"


def _class(each: ResolvedNeed) -> Iterator[Diagnostic]:
    need, class_ = each.need, each.flow_class
    if need.five_qi is not None and need.five_qi not in _FIVE_QI:
        message = f"cannot use five_qi {need.five_qi}; allowed: {_FIVE_QI[0]} to {_FIVE_QI[-1]}"
        yield error("check.flow-five-qi", need.at, message)
        return
    message, hint = class_.problem
    if message:
        yield error("check.flow-five-qi", need.at, message, hint)
        return
    for issue in class_.issues:
        make = error if issue.field in _KEPT_BY_CLASS else warning
        hint = "choose another class, or write 'five_qi: auto'"
        yield make("check.five-qi-class", need.at, issue.message, hint)
    if need.five_qi is None or class_.five_qi is None:
        return
    try:
        known = five_qi_of(class_.five_qi)
    except ValueError:
        message = (
            f"cannot check what {need.name!r} declares against 5QI {need.five_qi}: 128 to 254 are "
            f"an operator's own"
        )
        if each.max_delay_ms is not None or need.loss is not None:
            yield warning("check.five-qi-class", need.at, message, "ask that operator")
        return
    if known.flagged:
        message = f"cannot be sure of {', '.join(known.flagged)} of {known}: {known.note}"
        yield warning(
            "check.five-qi-class", need.at, message, "choose another, or ask the operator"
        )


def _foreign(node: Node, each: ResolvedNeed) -> Iterator[Diagnostic]:
    """Judge needs of a node that others start: it keeps the one participant that it makes."""
    need = each.need
    what = f"{need.kind.noun} {need.name!r} of {node.key!r}"
    hint = "write it as 'run: {python: module:Class}'"
    if need.unique is UniqueRequirement.STRICTLY_REQUIRED and need.kind is EndpointKind.PUBLISHER:
        message = (
            f"cannot make {what} strictly unique: no RMW does that for a publisher, and only a "
            f"node with 'run: python' can be given a participant of its own"
        )
        yield error("check.flow-impossible", need.at, message, hint)
    elif each.unique:
        message = f"cannot make {what} unique from outside: its own code must ask for it"
        yield warning("check.flow-foreign", need.at, message, hint)
    if each.dscp is not None:
        message = f"cannot mark {what} with a DSCP: only a node with 'run: python' can be marked"
        yield warning("check.flow-foreign", need.at, message, hint)
    if need.non_blocking_send:
        message = f"cannot make {what} send without waiting: its participant is not ours"
        yield warning("check.flow-foreign", need.at, message, hint)
