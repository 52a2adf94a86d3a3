"""Who is connected to whom, and by what.

Owns: the link of one publisher → subscription pair from what both nodes say of themselves. Whether
the two are matched is judged as `lifecycle.verify` judges it (`verify/rules/matching.py`). Pure.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

from lifecycle.graph.event import NodeLiveliness
from lifecycle.graph.view import NodeView
from lifecycle.network.flow import FlowTuple, flow_tuples
from lifecycle.verify.observation import EndpointReport, Identity
from lifecycle.verify.rules.matching import MatchEnd, match, obstacle
from lifecycle.verify.transport import NETWORK, NONE, carrier
from lifecycle.verify.verdict import Outcome
from lifecycle.verify.view import UNKNOWN_QOS


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class End:
    """An endpoint and the node that has it."""

    node: NodeView
    endpoint: EndpointReport


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Link:
    """A publisher and a subscription of one topic.

    Attributes:
        topic: the name by which they meet.
        connected: OK: data can go from one to the other; VIOLATED: they cannot; UNVERIFIABLE:
            that is not known.
        reason: why it is not OK; empty if it is.
        transport: what carries the data: "intraprocess", "shm", "udpv4", "udpv6", "tcpv4", "tcpv6";
            "none" if the two have nothing in common, "unknown" where that is not known.
        flows: the network flows that the data can take; empty if no network carries them.
    """

    topic: str
    publisher: End
    subscription: End
    connected: Outcome
    reason: str
    transport: str
    flows: tuple[FlowTuple, ...] = ()

    @property
    def connections(self) -> tuple[str, str]:
        """Names of the publisher's and the subscription's connection; empty: own participant."""
        return self.publisher.endpoint.connection, self.subscription.endpoint.connection


def link(
    topic: str,
    publisher: End,
    subscription: End,
    *,
    publishers: Sequence[MatchEnd],
    subscriptions: Sequence[MatchEnd],
) -> Link:
    """Judge one pair.

    Args:
        topic: the name by which they meet.
        publisher: one end.
        subscription: the other end.
        publishers: every publisher of this topic, see `match_ends`.
        subscriptions: every subscription of it.
    """
    source, destination = publisher.endpoint.nfes or (), subscription.endpoint.nfes or ()
    transport = carrier(source, destination, _identity(publisher), _identity(subscription))
    connected, reason = _judged(publisher, subscription, transport, publishers, subscriptions)
    return Link(
        topic=topic,
        publisher=publisher,
        subscription=subscription,
        connected=connected,
        reason=reason,
        transport=transport,
        flows=flow_tuples(source, destination) if transport in NETWORK else (),
    )


def _judged(
    publisher: End,
    subscription: End,
    transport: str,
    publishers: Sequence[MatchEnd],
    subscriptions: Sequence[MatchEnd],
) -> tuple[Outcome, str]:
    source, destination = _match_end(publisher), _match_end(subscription)
    cause = _missing(publisher) or _missing(subscription) or obstacle(source, destination)
    if not cause and transport == NONE:
        cause = "they have no transport in common"
    if cause:
        return Outcome.VIOLATED, cause
    found = match(source, destination, publishers, subscriptions)
    return found or (Outcome.UNVERIFIABLE, "neither end reports whom it is matched with")


def _match_end(end: End) -> MatchEnd:
    """Return an end as the rules of matching take it; the state holds no tools."""
    endpoint = end.endpoint
    return MatchEnd(
        kind=endpoint.kind,
        type=endpoint.type,
        qos=endpoint.qos or UNKNOWN_QOS,
        gid=endpoint.gid,
        report=endpoint,
        expected=True,
    )


def match_ends(ends: Sequence[End]) -> tuple[MatchEnd, ...]:
    """Return the ends that can be matched; DDS forgets a silent one in time."""
    return tuple(
        _match_end(each) for each in ends if each.node.liveliness is not NodeLiveliness.SILENT
    )


def _missing(end: End) -> str:
    """Return why an end cannot be connected to anybody; empty if it can."""
    if end.node.liveliness is NodeLiveliness.SILENT:
        return f"{end.node.name} is silent"
    if end.endpoint.error:
        return f"{end.node.name}: {end.endpoint.error}"
    if not end.endpoint.mapped and not end.endpoint.gid:
        return f"{end.node.name} has not mapped it onto a connection"
    return ""


def _identity(end: End) -> Identity | None:
    configuration = end.node.configuration
    if configuration is None or not configuration.identity.machine_id:
        return None
    return configuration.identity
