"""Flows: every publisher → subscription pair of the computational graph.

Owns: which pairs a system has, and what `links:` demand of them. Pure.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from lifecycle.manifest.model import EndpointKind, FlowTransport, Link, UniqueHow
from lifecycle.plan.model import PlannedFlow, PlannedNode

ANY = "*"
"""A link's `from` or `to` that stands for every node."""

_STRENGTH = {UniqueHow.NOT: 0, UniqueHow.WEAKLY: 1, UniqueHow.STRONGLY: 2}


def planned_flows(nodes: Sequence[PlannedNode], links: Sequence[Link]) -> tuple[PlannedFlow, ...]:
    """Pair every publisher with every subscription of its topic, nodes and endpoints in order.

    Several links on one pair add up: the strongest uniqueness and the shortest delay hold. A link
    that names two nodes is kept even if they declare no such endpoints, so that it can be judged.
    """
    hearers: dict[str, list[str]] = {}
    for node in nodes:
        for topic in _topics(node, EndpointKind.SUBSCRIPTION):
            hearers.setdefault(topic, []).append(node.key)
    pairs: dict[tuple[str, str, str], None] = {}
    for publisher in nodes:
        for topic in _topics(publisher, EndpointKind.PUBLISHER):
            for subscription in hearers.get(topic, ()):
                pairs[topic, publisher.key, subscription] = None
    for link in links:
        if ANY not in (link.from_node, link.to_node):
            pairs.setdefault((link.topic, link.from_node, link.to_node), None)
    return tuple(_flow(pair, links) for pair in pairs)


def _topics(node: PlannedNode, kind: EndpointKind) -> Iterable[str]:
    """Resolved names of one kind, each once, in order."""
    return dict.fromkeys(each.resolved for each in node.endpoints if each.kind is kind)


def _flow(pair: tuple[str, str, str], links: Sequence[Link]) -> PlannedFlow:
    topic, publisher, subscription = pair
    named = [
        link
        for link in links
        if link.topic == topic
        and link.from_node in (publisher, ANY)
        and link.to_node in (subscription, ANY)
    ]
    told = [link.transport for link in named if link.transport is not FlowTransport.ANY]
    delays = [link.max_delay_ms for link in named if link.max_delay_ms is not None]
    return PlannedFlow(
        topic=topic,
        publisher=publisher,
        subscription=subscription,
        unique=max(
            (link.unique for link in named), key=_STRENGTH.__getitem__, default=UniqueHow.NOT
        ),
        max_delay_ms=min(delays, default=None),
        linked=bool(named),
        transport=next(iter(told), FlowTransport.ANY),
        quantities=tuple(each for link in named for each in link.quantities),
    )
