"""Ways to spoil a perfect observation, one fact at a time."""

from __future__ import annotations

from collections.abc import Callable

from msgspec.structs import replace

from lifecycle.manifest.model import EndpointKind
from lifecycle.verify.observation import (
    EndpointReport,
    NodeConfiguration,
    Observation,
    ObservedEndpoint,
    ObservedNode,
)

Edit = Callable[[Observation], Observation]


def drop_node(name: str) -> Edit:
    """The node is not in the graph."""
    return lambda seen: replace(
        seen, nodes=tuple(each for each in seen.nodes if each.full_name != name)
    )


def change_node(name: str, /, **fields: object) -> Edit:
    """The graph shows the node otherwise."""
    return lambda seen: replace(
        seen,
        nodes=tuple(
            replace(each, **fields) if each.full_name == name else each for each in seen.nodes
        ),
    )


def add_node(name: str, /, **fields: object) -> Edit:
    """The graph shows one more node."""
    return lambda seen: replace(seen, nodes=(*seen.nodes, ObservedNode(full_name=name, **fields)))


def drop_endpoint(kind: EndpointKind, name: str) -> Edit:
    """Discovery does not show the endpoint."""
    return lambda seen: replace(
        seen,
        endpoints=tuple(each for each in seen.endpoints if (each.kind, each.name) != (kind, name)),
    )


def change_endpoint(kind: EndpointKind, name: str, /, **fields: object) -> Edit:
    """Discovery shows the endpoint otherwise."""
    return lambda seen: replace(
        seen,
        endpoints=tuple(
            replace(each, **fields) if (each.kind, each.name) == (kind, name) else each
            for each in seen.endpoints
        ),
    )


def change_announced_qos(kind: EndpointKind, name: str, /, **policies: object) -> Edit:
    """Discovery announces other policies."""
    return lambda seen: replace(
        seen,
        endpoints=tuple(
            replace(each, qos=replace(each.qos, **policies))
            if (each.kind, each.name) == (kind, name) and each.qos
            else each
            for each in seen.endpoints
        ),
    )


def add_endpoint(kind: EndpointKind, node: str, name: str, /, **fields: object) -> Edit:
    """Discovery shows one more endpoint."""
    fields = {"type": "std_msgs/msg/String", **fields}
    return lambda seen: replace(
        seen,
        endpoints=(
            *seen.endpoints,
            ObservedEndpoint(kind=kind, node=node, name=name, **fields),
        ),
    )


def drop_report(name: str) -> Edit:
    """The node does not report."""
    return lambda seen: replace(
        seen, configurations=tuple(each for each in seen.configurations if each.name != name)
    )


def change_configuration(name: str, /, **fields: object) -> Edit:
    """The node reports otherwise."""
    return lambda seen: replace(
        seen,
        configurations=tuple(
            replace(each, **fields) if each.name == name else each for each in seen.configurations
        ),
    )


def add_configuration(configuration: NodeConfiguration) -> Edit:
    """One more report."""
    return lambda seen: replace(seen, configurations=(*seen.configurations, configuration))


def _change_reports(
    kind: EndpointKind,
    resolved: str,
    change: Callable[[EndpointReport], tuple[EndpointReport, ...]],
) -> Edit:
    def edit(seen: Observation) -> Observation:
        return replace(
            seen,
            configurations=tuple(
                replace(
                    each,
                    endpoints=tuple(
                        changed
                        for report in each.endpoints
                        for changed in (
                            change(report)
                            if (report.kind, report.resolved) == (kind, resolved)
                            else (report,)
                        )
                    ),
                )
                for each in seen.configurations
            ),
        )

    return edit


def change_report(kind: EndpointKind, resolved: str, /, **fields: object) -> Edit:
    """The node reports the endpoint otherwise."""
    return _change_reports(kind, resolved, lambda report: (replace(report, **fields),))


def change_reported_qos(kind: EndpointKind, resolved: str, /, **policies: object) -> Edit:
    """The node reports other policies."""
    return _change_reports(
        kind,
        resolved,
        lambda report: (replace(report, qos=replace(report.qos, **policies)),),
    )


def drop_endpoint_report(kind: EndpointKind, resolved: str) -> Edit:
    """The node's report does not mention the endpoint."""
    return _change_reports(kind, resolved, lambda _: ())


def both(*edits: Edit) -> Edit:
    """Several edits, one after the other."""

    def edit(seen: Observation) -> Observation:
        for each in edits:
            seen = each(seen)
        return seen

    return edit
