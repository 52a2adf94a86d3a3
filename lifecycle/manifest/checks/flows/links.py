"""Checks of links: their ends exist, meet on the topic, and ask for what the link demands.

Owns: check.link-unknown-node, check.link-topic, check.link-not-unique. Pure.
"""

from __future__ import annotations

from collections.abc import Iterator

from lifecycle.manifest.checks.flows.flows import ASKS_UNIQUE
from lifecycle.manifest.checks.system import Resolved, System
from lifecycle.manifest.diagnostics import Diagnostic
from lifecycle.manifest.flows.flow_needs import FlowNeeds
from lifecycle.manifest.model import EndpointKind, Link, UniqueHow
from lifecycle.manifest.names import full_name_problem
from lifecycle.manifest.schema.message_text import did_you_mean
from lifecycle.manifest.yaml.document import error

_VERBS = {EndpointKind.PUBLISHER: "publish", EndpointKind.SUBSCRIPTION: "subscribe to"}


def check(system: System, needs: FlowNeeds) -> Iterator[Diagnostic]:
    """Yield findings about every link."""
    for link in system.manifest.links:
        if problem := full_name_problem(link.topic):
            message = f"cannot use {link.topic!r} as the topic of a link: {problem}"
            hint = did_you_mean(link.topic, system.names(EndpointKind.PUBLISHER))
            yield error("check.link-topic", link.at, message, hint)
            continue
        ends = [
            *_end(system, link, link.from_node, EndpointKind.PUBLISHER),
            *_end(system, link, link.to_node, EndpointKind.SUBSCRIPTION),
        ]
        yield from (each for each in ends if isinstance(each, Diagnostic))
        resolved = [each for each in ends if isinstance(each, Resolved)]
        both = link.from_node in system.nodes and link.to_node in system.nodes
        if both and len(resolved) == len(ends):
            yield from _uniqueness(link, resolved, needs)


def _end(
    system: System, link: Link, key: str, kind: EndpointKind
) -> Iterator[Resolved | Diagnostic]:
    """Yield the endpoints at one end of a link, or why there are none."""
    if not system.may_exist(key):
        message = f"cannot link node {key!r}: there is no such node"
        hint = did_you_mean(key, system.known)
        yield error("check.link-unknown-node", link.at, message, hint)
        return
    if key not in system.nodes:
        return  # what is wrong in it comes first
    found = [each for each in system.named(kind, link.topic) if each.node.key == key]
    if found:
        yield from found
        return
    topics = [
        each.name
        for each in system.endpoints
        if each.endpoint.kind is kind and each.node.key == key
    ]
    message = f"cannot link {link.topic!r}: node {key!r} does not {_VERBS[kind]} it"
    others = sorted({each.node.key for each in system.named(kind, link.topic)})
    hint = did_you_mean(link.topic, topics)
    if not hint and others:
        hint = f"node {', '.join(repr(each) for each in others)} does"
    yield error("check.link-topic", link.at, message, hint)


def _uniqueness(link: Link, ends: list[Resolved], needs: FlowNeeds) -> Iterator[Diagnostic]:
    """Compare what the link demands with what its ends ask for.

    *Unique Network Flows*: a flow is strongly unique if both NFEs are unique, weakly if one is.
    """
    silent = [each for each in ends if not _asks(each, needs)]
    if link.unique is UniqueHow.STRONGLY:
        for each in silent:
            message = f"{_flow(link)}: {_end_name(each)} does not ask to be unique"
            yield error("check.link-not-unique", link.at, message, _remedy(each))
    # A DSCP of its own makes an NFE unique as well; `flows` judges whether it is its own. That of
    # a subscription is of its acknowledgements and tells no data apart.
    marked = any(
        _dscp(each, needs) is not None
        for each in ends
        if each.endpoint.kind is EndpointKind.PUBLISHER
    )
    if link.unique is UniqueHow.WEAKLY and len(silent) == len(ends) and not marked:
        names = " nor ".join(_end_name(each) for each in ends)
        message = f"{_flow(link)}: neither {names} asks to be unique"
        yield error("check.link-not-unique", link.at, message, _remedy(ends[-1]))


def _flow(link: Link) -> str:
    return f"cannot make the flow of {link.topic!r} {link.unique.value} unique"


def _end_name(each: Resolved) -> str:
    return f"{each.endpoint.kind.noun} {each.endpoint.name!r} of {each.node.key!r}"


def _remedy(each: Resolved) -> str:
    return (
        f"add '{each.endpoint.name}: {{unique: strictly_required}}' to "
        f"nodes.{each.node.key}.flows.{each.endpoint.kind.value}"
    )


def _asks(each: Resolved, needs: FlowNeeds) -> bool:
    resolved = needs.of(each.node.key, each.endpoint.kind, each.endpoint.name)
    return resolved is not None and resolved.need.unique in ASKS_UNIQUE


def _dscp(each: Resolved, needs: FlowNeeds) -> int | None:
    resolved = needs.of(each.node.key, each.endpoint.kind, each.endpoint.name)
    return None if resolved is None else resolved.dscp
