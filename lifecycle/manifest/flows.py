"""Effective flow needs of endpoints: 5QI, datagrams and transport after links.

Owns: `FlowNeeds`, which the checks and the planner both read, so that `check` judges what `plan`
will do; `five_qi: auto`, and whether a class keeps what is declared (the table is in
`lifecycle.network`). Pure.
"""

from __future__ import annotations

from collections.abc import Iterator

import msgspec
from msgspec.structs import replace

from lifecycle.manifest.model import (
    DiscoveryMode,
    EndpointKind,
    FlowNeed,
    FlowTransport,
    Manifest,
    Node,
)
from lifecycle.manifest.names import topic_of
from lifecycle.network.dscp import DIRECT, ECN_MASK, map_priority
from lifecycle.network.five_qi import Needs, check_class, five_qi_of, propose
from lifecycle.network.medium import (
    SAFE_DATAGRAM_BYTES,
    Medium,
    is_fragmented,
    udp_to,
)

_OPERATOR_SPECIFIC = range(128, 255)  # TS 24.501 §9.11.4.12


class FlowClass(msgspec.Struct, frozen=True, kw_only=True):
    """A 5QI with its reason and problems.

    Attributes:
        five_qi: 1–254; None if not asked for, or if none fits.
        reason: why it is this one, or none, for `auto`; else empty.
        problem: message and hint of why it cannot be; two empty texts if it can.
        issues: what is declared and the class does not keep, see `check_class`.
    """

    five_qi: int | None = None
    reason: str = ""
    problem: tuple[str, str] = ("", "")
    issues: tuple[tuple[str, str], ...] = ()


def class_of(need: FlowNeed, *, max_delay_ms: float | None) -> FlowClass:
    """Return the class of one publisher's flow; the delay is declared, or that of its links."""
    size = need.max_message_size
    rate_bps = None if need.rate_hz is None or size is None else need.rate_hz * size * 8
    needs = Needs(
        max_delay_ms=max_delay_ms, loss=need.loss, rate_bps=rate_bps, max_message_size=size
    )
    if need.five_qi_auto:
        if max_delay_ms is None:
            message = f"cannot propose a 5QI for {need.name!r}: no max_delay_ms is declared"
            hint = "add 'max_delay_ms', or a link of its topic that has one"
            return FlowClass(reason=message, problem=(message, hint))
        # A guaranteed rate must be bought as a number; where none is declared, only if nothing else
        # is fast enough.
        found, why = propose(needs, need.rate_hz is not None)
        if found is None and need.rate_hz is None:
            found, why = propose(needs, None)
        hint = "relax 'max_delay_ms', 'loss', 'rate_hz' or 'max_message_size'"
        if found is None:
            return FlowClass(reason=why, problem=(why, hint))
        return FlowClass(five_qi=found.value, reason=why)
    # What an operator's own class promises, only that operator knows.
    if need.five_qi is None or need.five_qi in _OPERATOR_SPECIFIC:
        return FlowClass(five_qi=need.five_qi)
    try:
        class_ = five_qi_of(need.five_qi)
    except ValueError as error:
        message, _, hint = str(error).partition("; ")
        return FlowClass(five_qi=need.five_qi, problem=(message, hint))
    return FlowClass(five_qi=need.five_qi, issues=tuple(check_class(class_, needs)))


class ResolvedNeed(msgspec.Struct, frozen=True, kw_only=True):
    """One endpoint's need, resolved.

    Attributes:
        need: as declared.
        topic: fully qualified name; empty if it cannot be resolved.
        unique: it must get an NFE of its own.
        flow_class: 5QI; publishers only.
        tos: what becomes of its 'transport_priority', 0–255; None without, and if nothing is set.
        max_delay_ms: declared, else the shortest of the links from this node on the topic.
        max_datagram_bytes: what its participant must not exceed so that IP does not fragment it;
            None if that cannot happen or is not known.
        transports: all that its participant may use; empty for any.
    """

    need: FlowNeed
    topic: str
    unique: bool
    flow_class: FlowClass
    tos: int | None = None
    max_delay_ms: float | None = None
    max_datagram_bytes: int | None = None
    transports: tuple[Medium, ...] = ()

    @property
    def dscp(self) -> int | None:
        """The DSCP of its data, of a subscription of what it acknowledges with, 0–63."""
        if self.need.dscp is not None:
            return int(self.need.dscp)
        return None if self.tos is None or self.tos & ECN_MASK else self.tos >> 2

    @property
    def five_qi(self) -> int | None:
        """The 5QI, 1–254, `auto` resolved."""
        return self.flow_class.five_qi

    @property
    def non_blocking_send(self) -> bool:
        """What finds the socket's buffer full is lost."""
        return self.need.non_blocking_send

    @property
    def prioritised(self) -> bool:
        """Whether a network is to treat this flow differently from others."""
        return self.unique or self.dscp is not None or self.five_qi is not None


class FlowNeeds:
    """All flow needs of a system, resolved."""

    def __init__(self, manifest: Manifest) -> None:
        self._manifest = manifest
        self._delays: dict[tuple[str, str], float] = {}
        for link in manifest.links:
            if link.max_delay_ms is not None:
                place = (link.from_node, link.topic)
                self._delays[place] = min(
                    link.max_delay_ms, self._delays.get(place, link.max_delay_ms)
                )
        self._resolved = {
            (node.key, need.kind, need.name): self._resolve(node, need)
            for node in manifest.nodes
            for need in node.flows
        }

    def of(self, node_key: str, kind: EndpointKind, name: str) -> ResolvedNeed | None:
        """Return the need of an endpoint by its declared name; None if it has none."""
        return self._resolved.get((node_key, kind, name))

    def of_node(self, node: Node) -> Iterator[ResolvedNeed]:
        """Return all needs of a node, in the order of the manifest."""
        for need in node.flows:
            yield self._resolved[node.key, need.kind, need.name]

    def _resolve(self, node: Node, need: FlowNeed) -> ResolvedNeed:
        topic = topic_of(node, need.name, need.kind)
        network, discovery = self._manifest.network, self._manifest.discovery
        tos = None
        if need.transport_priority is not None:
            mapping = network.transport_priority_mapping or DIRECT
            tos = map_priority(need.transport_priority, mapping)
        delay = need.max_delay_ms
        if delay is None and need.kind is EndpointKind.PUBLISHER:
            delay = self._delays.get((node.key, topic))
        # Where discovery sets what participants have, negotiation decides (`lifecycle.plan`).
        by_participant = (
            need.transport is FlowTransport.NETWORK
            and discovery.mode is DiscoveryMode.DYNAMIC
            and discovery.transport is FlowTransport.ANY
        )
        address = self._manifest.address_of(node.machine)
        resolved = ResolvedNeed(
            need=need,
            topic=topic,
            unique=need.unique.asks,
            flow_class=class_of(need, max_delay_ms=delay),
            tos=tos,
            max_delay_ms=delay,
            transports=(udp_to(address),) if by_participant else (),
        )
        # The size of messages is not known; if the path is known to be narrow, be careful.
        size, declared = need.max_message_size, network.max_datagram_bytes
        is_small = declared is None if size is None else not is_fragmented(size, address, declared)
        # Only a flow that a network knows can be harmed.
        if need.kind is EndpointKind.PUBLISHER and resolved.prioritised and not is_small:
            return replace(resolved, max_datagram_bytes=declared or SAFE_DATAGRAM_BYTES)
        return resolved
