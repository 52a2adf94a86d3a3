"""Checks of DSCP values that are to tell flows apart.

Owns: check.dscp-exhausted, check.dscp-not-unique, check.dscp-repurposed: the limits that *Unique
Network Flows* gives for the DSCP as an identifier. Pure.
"""

from __future__ import annotations

from collections.abc import Iterator

from lifecycle.manifest.checks.flows.flows import ASKS_UNIQUE
from lifecycle.manifest.checks.system import Resolved, System, spell
from lifecycle.manifest.diagnostics import Diagnostic
from lifecycle.manifest.flows.flow_needs import FlowNeeds, ResolvedNeed
from lifecycle.manifest.model import EndpointKind, FlowIdentification, UniqueHow
from lifecycle.manifest.yaml.document import error, warning
from lifecycle.network.dscp import MAX_DSCP, describe

_DSCP_VALUES = MAX_DSCP + 1
_ASK = "ask for 'unique: strictly_required', or give each a DSCP of its own"
_OWN = "give it another DSCP, or none: then it gets one that nobody has"


def check(system: System, needs: FlowNeeds) -> Iterator[Diagnostic]:
    """Yield findings about publishers that their DSCP tells apart.

    All nodes are counted. The article counts subscriptions too; here they are told apart by their
    ports, and a DSCP that one acknowledges with must only not be an identifier of another's.
    """
    if system.manifest.network.flow_identification is FlowIdentification.DSCP:
        yield from _repurposed(system, needs)
    else:
        yield from _relied_on(system, needs)


def _publishers(system: System, needs: FlowNeeds) -> Iterator[tuple[Resolved, ResolvedNeed]]:
    for each in system.endpoints:
        need = needs.of(each.node.key, each.endpoint.kind, each.endpoint.name)
        if need is not None and each.endpoint.kind is EndpointKind.PUBLISHER:
            yield each, need


def _subscriptions(system: System, needs: FlowNeeds) -> Iterator[tuple[Resolved, ResolvedNeed]]:
    for each in system.endpoints:
        need = needs.of(each.node.key, each.endpoint.kind, each.endpoint.name)
        if need is not None and each.endpoint.kind is EndpointKind.SUBSCRIPTION:
            yield each, need


def _repurposed(system: System, needs: FlowNeeds) -> Iterator[Diagnostic]:
    publishers = list(_publishers(system, needs))
    relying = {id(need) for _, need in _relying(system, needs)}
    asking = [each for each in publishers if each[1].unique or id(each[1]) in relying]
    others = [
        *(each for each in publishers if not (each[1].unique or id(each[1]) in relying)),
        *_subscriptions(system, needs),
    ]
    for _, need in asking:
        message, hint = need.marking.problem
        if message and need.need.transport_priority is None:
            yield error("check.dscp-exhausted", need.need.at, message, hint)
    holders: dict[int, Resolved] = {}
    for each, need in asking:
        if need.dscp is not None:
            holders.setdefault(need.dscp, each)
    for each, need in (*asking, *others):
        other = None if need.dscp is None else holders.get(need.dscp)
        if need.dscp is not None and other is not None and other is not each:
            message = (
                f"cannot give {each.endpoint.kind.noun} {each.name!r} of {each.node.key!r} "
                f"{describe(need.dscp)}: it identifies {other.name!r} of {other.node.key!r} "
                f"({spell(other.at)})"
            )
            yield error("check.dscp-not-unique", need.need.at, message, _OWN)
    at = system.manifest.network.at
    if asking and at is not None:
        message = (
            f"cannot be sure that the network takes {len(asking)} of {_DSCP_VALUES} DSCP values "
            f"for identifiers: routers read them as classes, and may reset or erase them"
        )
        hint = (
            "tell those who run the network and configure each router on the way, or use "
            "'flow_identification: participant'"
        )
        yield warning("check.dscp-repurposed", at, message, hint)


def _relied_on(system: System, needs: FlowNeeds) -> Iterator[Diagnostic]:
    """Judge publishers that only their DSCP tells apart although nobody said so.

    A link may demand a unique flow of a publisher that asks for none but is marked: then its DSCP
    is re-purposed as the identifier, and of those there are 64, all else in the NFE being equal.
    """
    holders: dict[int, Resolved] = {}
    relying = list(_relying(system, needs))
    for number, (each, need) in enumerate(relying, start=1):
        assert need.dscp is not None
        other = holders.setdefault(need.dscp, each)
        if number > _DSCP_VALUES:
            message = (
                f"cannot tell publisher {each.name!r} of {each.node.key!r} apart by its DSCP: it "
                f"is number {number} of {len(relying)} that have nothing else, and a DSCP has "
                f"{_DSCP_VALUES} values"
            )
            yield error("check.dscp-exhausted", need.need.at, message, _ASK)
        elif other is not each:
            message = (
                f"cannot tell publisher {each.name!r} of {each.node.key!r} apart by "
                f"{describe(need.dscp)}: {other.name!r} of {other.node.key!r} has the same "
                f"({spell(other.at)})"
            )
            yield error("check.dscp-not-unique", need.need.at, message, _ASK)


def _relying(system: System, needs: FlowNeeds) -> Iterator[tuple[Resolved, ResolvedNeed]]:
    demanded = {
        (link.from_node, link.topic)
        for link in system.manifest.links
        if link.unique is not UniqueHow.NOT
    }
    for each, need in _publishers(system, needs):
        if need.dscp is None or need.need.unique in ASKS_UNIQUE:
            continue
        if (each.node.key, each.name) in demanded and 0 <= need.dscp <= MAX_DSCP:
            yield each, need
