"""Who is connected to whom, and by what.

Owns: the judgement of one publisher → subscription pair from what both nodes say of themselves, by
the conditions of `lifecycle.verify` (types, QoS, matches, carrier). Three outcomes: what neither
end tells is unverifiable. Pure.
"""

from __future__ import annotations

import dataclasses

from lifecycle.graph.event import NodeLiveliness
from lifecycle.graph.view import NodeView
from lifecycle.manifest.qos import Certainty, incompatibilities
from lifecycle.network.medium import NETWORK_MEDIA
from lifecycle.network.nfe import FlowTuple, flow_tuples
from lifecycle.verify.observation import EndpointReport, Identity
from lifecycle.verify.transport import NONE, carrier
from lifecycle.verify.verdict import Outcome


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
            nobody tells.
        reason: why it is not OK; empty if it is.
        transport: what carries the data: the word of a Medium;
            "none" if the two have nothing in common, "unknown" where nobody tells.
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
    topic: str, publisher: End, subscription: End, *, publishers: int, subscriptions: int
) -> Link:
    """Judge one pair.

    Args:
        topic: the name by which they meet.
        publisher: one end.
        subscription: the other end.
        publishers: how many publishers there are of this topic and type.
        subscriptions: likewise. An end that matched as many has matched every one of them.
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
        flows=flow_tuples(source, destination) if transport in NETWORK_MEDIA else (),
    )


def _judged(
    publisher: End, subscription: End, transport: str, publishers: int, subscriptions: int
) -> tuple[Outcome, str]:
    obstacle = _missing(publisher) or _missing(subscription) or _mismatch(publisher, subscription)
    if not obstacle and transport == NONE:
        obstacle = "they have no transport in common"
    if obstacle:
        return Outcome.VIOLATED, obstacle
    return _matched(publisher.endpoint, subscription.endpoint, publishers, subscriptions)


def _missing(end: End) -> str:
    """Return why an end cannot be connected to anybody; empty if it can."""
    if end.node.liveliness is NodeLiveliness.SILENT:
        return f"{end.node.name} is silent"
    if end.endpoint.error:
        return f"{end.node.name}: {end.endpoint.error}"
    if not end.endpoint.mapped and not end.endpoint.gid:
        return f"{end.node.name} has not mapped it onto a connection"
    return ""


def _mismatch(publisher: End, subscription: End) -> str:
    """Return why two ends cannot match (DDS 1.4 §2.2.2.5, §2.2.3); empty if they can."""
    types = publisher.endpoint.type, subscription.endpoint.type
    if types[0] != types[1]:
        return f"the types differ, {types[0]} and {types[1]}"
    offered, requested = publisher.endpoint.qos, subscription.endpoint.qos
    if offered is None or requested is None:
        return ""
    found = incompatibilities(offered, requested)
    certain = any(each.severity is Certainty.CERTAIN for each in found)
    return "the QoS is incompatible" if certain else ""


def _matched(
    publisher: EndpointReport, subscription: EndpointReport, publishers: int, subscriptions: int
) -> tuple[Outcome, str]:
    """Conclude from the peers of each end, or from their number where it cannot tell them apart."""
    counts = (publisher.matched, subscriptions), (subscription.matched, publishers)
    named = [
        other.gid in end.peers
        for end, other in ((publisher, subscription), (subscription, publisher))
        if end.peers is not None and other.gid and len(end.peers) == end.matched
    ]
    if named:
        matched = all(named)
        return (Outcome.OK, "") if matched else (Outcome.VIOLATED, "they have not matched")
    if any(matched is not None and matched >= there for matched, there in counts):
        return Outcome.OK, ""
    if 0 in (publisher.matched, subscription.matched):
        return Outcome.VIOLATED, "they have not matched"
    known = [f"{matched} of {there}" for matched, there in counts if matched is not None]
    if known:
        return Outcome.UNVERIFIABLE, f"matched {' and '.join(known)}, nobody tells which"
    return Outcome.UNVERIFIABLE, "neither end tells its matches"


def _identity(end: End) -> Identity | None:
    configuration = end.node.configuration
    if configuration is None or not configuration.identity.machine_id:
        return None
    return configuration.identity
