"""One report per planned flow: what carries it, how unique it is, and whether it is as declared.

Owns: turning the view and the findings into FlowReports. Pure.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from lifecycle.manifest.model import EndpointKind, UniqueHow
from lifecycle.network.nfe import (
    NetworkFlowEndpoint,
    TransportProtocol,
    is_ip,
)
from lifecycle.verify.rules import rule
from lifecycle.verify.transport import effective_transport
from lifecycle.verify.uniqueness import Uniqueness
from lifecycle.verify.verdict import Finding, FlowReport, Outcome
from lifecycle.verify.view import Actual, FlowView, View

_HOW = (UniqueHow.NOT, UniqueHow.WEAKLY, UniqueHow.STRONGLY)


def flow_reports(view: View, findings: Sequence[Finding]) -> tuple[FlowReport, ...]:
    """Report every planned flow, in plan order."""
    uniqueness = Uniqueness(view.reported, view.addresses)
    spoiled = _spoiled(findings)
    return tuple(_report(view, flow, uniqueness, spoiled) for flow in view.flows)


_Place = tuple[str, str, EndpointKind | None]


_OTHER_PROTOCOL = {
    "tcpv4": TransportProtocol.UDP,
    "tcpv6": TransportProtocol.UDP,
    "udpv4": TransportProtocol.TCP,
    "udpv6": TransportProtocol.TCP,
    "udpm": TransportProtocol.TCP,
}


def _spoiled(findings: Iterable[Finding]) -> dict[_Place, Outcome]:
    """Worst outcome of the findings that concern flows, by (subject, node, endpoint kind)."""
    worst: dict[_Place, Outcome] = {}
    for finding in findings:
        if not rule(finding.rule).concerns_flow:
            continue
        place = (finding.subject, finding.node, finding.endpoint)
        if worst.get(place) is not Outcome.VIOLATED:
            worst[place] = finding.outcome
    return worst


def _report(
    view: View, flow: FlowView, uniqueness: Uniqueness, spoiled: dict[_Place, Outcome]
) -> FlowReport:
    source = uniqueness.nfes(flow.publishers)
    destination = uniqueness.nfes(flow.subscriptions)
    ends = (uniqueness.all_unique(flow.publishers), uniqueness.all_unique(flow.subscriptions))
    topic = flow.planned.topic
    places: tuple[_Place, ...] = (
        (flow.subject, "", None),
        (flow.publisher, flow.publisher, None),
        (flow.subscription, flow.subscription, None),
        (topic, flow.publisher, EndpointKind.PUBLISHER),
        (topic, flow.subscription, EndpointKind.SUBSCRIPTION),
    )
    outcomes = (spoiled[place] for place in places if place in spoiled)
    carrier = effective_transport(view, flow)
    return FlowReport(
        topic=topic,
        publisher=flow.publisher,
        subscription=flow.subscription,
        source=_used(source, carrier),
        destination=_used(destination, carrier),
        unique=None if None in ends else _HOW[ends.count(True)],
        dscp=_dscp(flow.publishers, carrier),
        reader_dscp=_dscp(flow.subscriptions, carrier),
        requirement=flow.requirement,
        demanded=flow.planned.unique,
        transport=_transport(view, flow, source, destination),
        outcome=Outcome.worst(outcomes),
        max_delay_ms=flow.planned.max_delay_ms,
        five_qi=flow.five_qi,
        five_qi_reason="; ".join(
            dict.fromkeys(filter(None, (end.planned.five_qi_reason for end in flow.publishers)))
        ),
        effective_transport=carrier,
    )


def _used(nfes: tuple[NetworkFlowEndpoint, ...], carrier: str) -> tuple[NetworkFlowEndpoint, ...]:
    """Leave out sockets of the other protocol, where it is known that TCP or UDP carries the flow.

    An endpoint on a connection of several transports lists the sockets of all of them, and a rule
    made from those would catch other flows.
    """
    other = _OTHER_PROTOCOL.get(carrier)
    return tuple(each for each in nfes if each.transport_protocol is not other)


def _dscp(ends: Sequence[Actual], carrier: str) -> int | None:
    """The DSCP that was read back; None if none was, or several endpoints differ.

    Only UDP sockets are marked and read: of a connection that has both, TCP does not carry it.
    """
    if _OTHER_PROTOCOL.get(carrier) is TransportProtocol.UDP:
        return None
    read = {end.report.dscp if end.report else None for end in ends}
    return read.pop() if len(read) == 1 else None


def _transport(
    view: View,
    flow: FlowView,
    source: Sequence[NetworkFlowEndpoint],
    destination: Sequence[NetworkFlowEndpoint],
) -> str:
    """Say what can carry a flow: transports that both ends list, shared memory on one machine only.

    NFEs do not prove which of them carries the data, so several are joined by "or".
    """
    if not source or not destination:
        return "unknown"
    machines = {
        view.configurations[name].identity.machine_id
        for name in (flow.publisher, flow.subscription)
        if name in view.configurations
    }
    common: list[str] = []
    if len(machines) == 1 and not all(map(is_ip, source)) and not all(map(is_ip, destination)):
        common.append("shm")
    arriving = {(each.transport_protocol, each.internet_protocol) for each in destination}
    for each in source:
        place = (each.transport_protocol, each.internet_protocol)
        if is_ip(each) and place in arriving and each.transport_protocol.value not in common:
            common.append(each.transport_protocol.value)
    return " or ".join(common) or "none"
