"""The data layer graph of a plan, as text for people.

Owns: the sections of `lifecycle plan` about discovery, the authority and connections with their
URLs. Pure.
"""

from __future__ import annotations

from collections.abc import Iterator

from lifecycle.manifest.model import (
    DataLayer,
    DataLayerSource,
    DiscoveryMode,
    EndpointKind,
    FlowTransport,
)
from lifecycle.plan.model import ParticipantConnections, Plan, PlannedFlow, PlannedNode
from lifecycle.plan.render.table import table

RMW_CHOOSES = "as the RMW chooses"


def data_layer(plan: Plan, width: int) -> list[str]:
    """Say how participants find each other and who connects them; nothing where all is usual."""
    rows: list[tuple[str, str]] = []
    if plan.discovery_mode is not DiscoveryMode.DYNAMIC or (
        plan.discovery.transport is not FlowTransport.ANY
    ):
        transport = plan.discovery.transport
        told = "" if transport is FlowTransport.ANY else f", own participants by {transport.value}"
        rows.append(("discovery", f"{plan.discovery_mode.value}{told}"))
    if plan.server is not None:
        protocol = "TCP" if plan.server.tcp else "UDP"
        where = f" on machine {plan.server.machine}" if plan.server.machine else ""
        at = f"{plan.server.address}:{plan.server.port}"
        rows.append(("discovery server", f"{protocol} {at}{where}"))
    layer = plan.data_layer
    if (layer.authority, layer.source, layer.events) != (
        DataLayer().authority,
        DataLayer().source,
        DataLayer().events,
    ):
        source = "the manifest" if layer.source is DataLayerSource.STATIC else "node configurations"
        again = "; what is lost is made again" if layer.events else ""
        rows.append(("authority", f"{layer.authority.value}, from {source}{again}"))
    for machine, each in plan.observers:
        named = f"observer on {machine}" if machine else "observer"
        if machine and any(not other for other, _ in plan.observers):
            continue  # the one host's, under another name
        rows += [(named if not i else "", text) for i, text in enumerate(_spelled(each))]
    return table(rows, width=width)


def connections(plan: Plan, width: int) -> list[str]:
    """List each node's participants with their URLs and what they carry."""
    lines: list[str] = []
    for node in plan.nodes:
        rows = list(_rows(node))
        if rows:
            lines += [f"  {node.full_name}", *table(rows, indent=4, width=width)]
    return lines


def _rows(node: PlannedNode) -> Iterator[tuple[str, str, str]]:
    connected = [each for each in node.participants if each.connection or each.connections.urls]
    if not connected and not node.connections.urls:
        return
    entries = [("own participant", node.connections, "")]
    entries += [(each.connection or each.name, each.connections, each.name) for each in connected]
    for name, each, participant in entries:
        carried = [
            f"{_WORDS.get(endpoint.kind, endpoint.kind.value)} {endpoint.resolved}"
            for endpoint in node.endpoints
            if endpoint.participant == participant
        ]
        texts = (*_spelled(each), *([f"carries {', '.join(carried)}"] if carried else []))
        for index, text in enumerate(texts):
            yield ("" if index else name, "", text)


_WORDS = {EndpointKind.PUBLISHER: "publisher", EndpointKind.SUBSCRIPTION: "subscription"}


def _spelled(each: ParticipantConnections) -> list[str]:
    texts = list(each.urls) or [RMW_CHOOSES]
    if each.static_name:
        texts.append(f"known to others as {each.static_name}, without being told")
    if each.super_client:
        texts.append("is told of everything that the server knows")
    return texts


def medium(flow: PlannedFlow) -> str:
    """Say what carries a flow and why; empty if that is not known yet."""
    if not flow.medium:
        return flow.medium_reason
    return f"{flow.medium} ({flow.medium_reason})"
