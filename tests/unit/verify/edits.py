"""Ways to spoil a perfect observation, one fact at a time."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from msgspec.structs import replace

from lifecycle.manifest.model import EndpointKind
from lifecycle.verify.observation import (
    NodeConfiguration,
    Observation,
    ObservedEndpoint,
    ObservedNode,
)

Edit = Callable[[Observation], Observation]


def _without(field: str, is_one: Callable[[Any], bool]) -> Edit:
    return lambda seen: replace(
        seen, **{field: tuple(each for each in getattr(seen, field) if not is_one(each))}
    )


def _changed(field: str, is_one: Callable[[Any], bool], change: Callable[[Any], Any]) -> Edit:
    return lambda seen: replace(
        seen,
        **{field: tuple(change(each) if is_one(each) else each for each in getattr(seen, field))},
    )


def drop_node(name: str) -> Edit:
    """The node is not in the graph."""
    return _without("nodes", lambda each: each.full_name == name)


def change_node(name: str, /, **fields: object) -> Edit:
    """The graph shows the node otherwise."""
    return _changed(
        "nodes", lambda each: each.full_name == name, lambda each: replace(each, **fields)
    )


def add_node(name: str, /, **fields: object) -> Edit:
    """The graph shows one more node."""
    return lambda seen: replace(seen, nodes=(*seen.nodes, ObservedNode(full_name=name, **fields)))


def drop_endpoint(kind: EndpointKind, name: str) -> Edit:
    """Discovery does not show the endpoint."""
    return _without("endpoints", lambda each: (each.kind, each.name) == (kind, name))


def change_endpoint(kind: EndpointKind, name: str, /, **fields: object) -> Edit:
    """Discovery shows the endpoint otherwise."""
    return _changed(
        "endpoints",
        lambda each: (each.kind, each.name) == (kind, name),
        lambda each: replace(each, **fields),
    )


def change_announced_qos(kind: EndpointKind, name: str, /, **policies: object) -> Edit:
    """Discovery announces other policies."""
    return _changed(
        "endpoints",
        lambda each: (each.kind, each.name) == (kind, name) and each.qos,
        lambda each: replace(each, qos=replace(each.qos, **policies)),
    )


def add_endpoint(kind: EndpointKind, node: str, name: str, /, **fields: object) -> Edit:
    """Discovery shows one more endpoint."""
    fields = {"type": "std_msgs/msg/String", **fields}
    return lambda seen: replace(
        seen,
        endpoints=(*seen.endpoints, ObservedEndpoint(kind=kind, node=node, name=name, **fields)),
    )


def drop_report(name: str) -> Edit:
    """The node does not report."""
    return _without("configurations", lambda each: each.name == name)


def change_configuration(name: str, /, **fields: object) -> Edit:
    """The node reports otherwise."""
    return _changed(
        "configurations", lambda each: each.name == name, lambda each: replace(each, **fields)
    )


def add_configuration(configuration: NodeConfiguration) -> Edit:
    """One more report."""
    return lambda seen: replace(seen, configurations=(*seen.configurations, configuration))


def _of_every_report(edit: Callable[[Any], Any]) -> Edit:
    return _changed("configurations", lambda _: True, edit)


def change_report(kind: EndpointKind, resolved: str, /, **fields: object) -> Edit:
    """The node reports the endpoint otherwise."""
    return _of_every_report(
        _changed(
            "endpoints",
            lambda each: (each.kind, each.resolved) == (kind, resolved),
            lambda each: replace(each, **fields),
        )
    )


def change_reported_qos(kind: EndpointKind, resolved: str, /, **policies: object) -> Edit:
    """The node reports other policies."""
    return _of_every_report(
        _changed(
            "endpoints",
            lambda each: (each.kind, each.resolved) == (kind, resolved),
            lambda each: replace(each, qos=replace(each.qos, **policies)),
        )
    )


def drop_endpoint_report(kind: EndpointKind, resolved: str) -> Edit:
    """The node's report does not mention the endpoint."""
    return _of_every_report(
        _without("endpoints", lambda each: (each.kind, each.resolved) == (kind, resolved))
    )


def both(*edits: Edit) -> Edit:
    """Several edits, one after the other."""

    def edit(seen: Observation) -> Observation:
        for each in edits:
            seen = each(seen)
        return seen

    return edit


unchanged = both()
"""Everything is as planned."""
