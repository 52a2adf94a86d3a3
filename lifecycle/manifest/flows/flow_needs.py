"""What every flow need comes to once mappings, links, types and machines are taken into account.

Owns: `FlowNeeds`, which the checks and the planner both read, so that `check` judges what `plan`
will do. Reads interface definitions; starts nothing.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from pathlib import Path

from lifecycle.errors import LifecycleError
from lifecycle.manifest.flows.dscp_resolution import Marking, identifiers, marking_of
from lifecycle.manifest.flows.flow_class import FlowClass, class_of
from lifecycle.manifest.model import (
    DiscoveryMode,
    EndpointKind,
    FlowIdentification,
    FlowNeed,
    FlowTransport,
    Manifest,
    Node,
    RunKind,
)
from lifecycle.manifest.names import resolve
from lifecycle.manifest.types.message_size import bounded_size
from lifecycle.network.datagram import SAFE_DATAGRAM_BYTES, is_fragmented, max_unfragmented
from lifecycle.network.nfe import UniqueRequirement

OWN_FLOW = (UniqueRequirement.STRICTLY_REQUIRED, UniqueRequirement.OPTIONALLY_REQUIRED)
"""Requirements that make us give an endpoint an NFE of its own."""


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class ResolvedNeed:
    """One endpoint's need, resolved.

    Attributes:
        need: as declared.
        topic: fully qualified name; empty if it cannot be resolved.
        unique: it must get an NFE of its own.
        marking: DSCP, of a publisher's data or of a subscription's acknowledgements.
        flow_class: 5QI; publishers only.
        max_delay_ms: declared, else the shortest of the links from this node on the topic.
        max_message_size: declared, else the type's bound, bytes; None without either.
        max_datagram_bytes: what its participant must not exceed so that IP does not fragment it;
            None if that cannot happen or cannot be told.
        transports: all that its participant may use; empty for any.
        told_apart: every subscription of its topic asks for an NFE of its own, which identifies the
            flow (weakly unique) whatever the publisher has.
    """

    need: FlowNeed
    topic: str
    unique: bool
    marking: Marking
    flow_class: FlowClass
    max_delay_ms: float | None = None
    max_message_size: int | None = None
    max_datagram_bytes: int | None = None
    transports: tuple[str, ...] = ()
    told_apart: bool = False

    @property
    def dscp(self) -> int | None:
        """The DSCP that its packets are to carry, 0–63."""
        return self.marking.dscp

    @property
    def five_qi(self) -> int | None:
        """The 5QI, 1–254, `auto` resolved."""
        return self.flow_class.five_qi

    @property
    def prioritised(self) -> bool:
        """Whether a network is to treat this flow differently from others."""
        return self.unique or self.dscp is not None or self.five_qi is not None


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class ParticipantGroup:
    """Endpoints of one kind and node that share an extra participant.

    Attributes:
        kind: PUBLISHER, or SUBSCRIPTION: then what they acknowledge with carries the DSCP.
        names: declared, in the interface's order.
        unique: it carries one publisher that needs an NFE of its own.
        five_qi: the class by which a network tells it from others; None if it need not.
    """

    kind: EndpointKind = EndpointKind.PUBLISHER
    names: tuple[str, ...]
    unique: bool
    dscp: int | None
    five_qi: int | None
    transports: tuple[str, ...]
    max_datagram_bytes: int | None
    non_blocking_send: bool


class FlowNeeds:
    """All flow needs of a system, resolved."""

    def __init__(self, manifest: Manifest, prefixes: Sequence[Path]) -> None:
        self._manifest = manifest
        self._prefixes = prefixes
        self._addresses = {each.name: each.address for each in manifest.machines}
        self._machines = {each.key: each.machine for each in manifest.nodes}
        self._delays: dict[tuple[str, str], float] = {}
        for link in manifest.links:
            if link.max_delay_ms is not None:
                place = (link.from_node, link.topic)
                self._delays[place] = min(
                    link.max_delay_ms, self._delays.get(place, link.max_delay_ms)
                )
        self._sizes: dict[str, int | None] = {}
        self._told_apart = _told_apart(manifest)
        resolved = {
            (node.key, need.kind, need.name): self._resolve(node, need)
            for node in manifest.nodes
            for need in node.flows
        }
        if manifest.network.flow_identification is FlowIdentification.DSCP:
            resolved = _with_identifiers(resolved, manifest)
        self._resolved = {key: self._with_datagrams(key[0], each) for key, each in resolved.items()}

    def of(self, node_key: str, kind: EndpointKind, name: str) -> ResolvedNeed | None:
        """Return the need of an endpoint by its declared name; None if it has none."""
        return self._resolved.get((node_key, kind, name))

    def of_node(self, node: Node) -> Iterator[ResolvedNeed]:
        """Return all needs of a node, in the order of the manifest."""
        for need in node.flows:
            yield self._resolved[node.key, need.kind, need.name]

    def node_transports(self, node: Node) -> tuple[str, ...]:
        """Return all that a node's own participant may use; empty for any.

        Its subscriptions receive there; so if one must not get its data by shared memory, none of
        the node's can.
        """
        for each in self.of_node(node):
            if each.need.kind is not EndpointKind.SUBSCRIPTION or each.dscp is not None:
                continue  # a marked one receives on a participant beside it
            if each.transports:
                return each.transports
        return ()

    def groups(self, node: Node) -> tuple[ParticipantGroup, ...]:
        """Return the extra participants that a node's endpoints need: as few as meet every need.

        A publisher that needs an NFE of its own shares with none. Others share if they ask for the
        same DSCP, 5QI, transports and way of sending; the smaller datagram size serves both.
        Subscriptions need one if they are marked, because acknowledgements leave by the sockets of
        the participant; they share it with those of the same DSCP and transports, not with
        publishers: a network that looks at marks must not take the one for the other's flow. Within
        one node only: a participant belongs to a node, whose hidden node is what the graph shows.
        """
        found: dict[object, ParticipantGroup] = {}
        own = (None, None, self.node_transports(node), False)
        for endpoint in node.interface.endpoints:
            each = self.of(node.key, endpoint.kind, endpoint.name)
            if each is None or endpoint.kind not in (
                EndpointKind.PUBLISHER,
                EndpointKind.SUBSCRIPTION,
            ):
                continue
            if endpoint.kind is EndpointKind.SUBSCRIPTION:
                if each.dscp is not None:
                    _add_subscription(found, each, each.transports or own[2])
                continue
            five_qi = None if each.unique or each.told_apart else each.five_qi
            transports = each.transports or own[2]
            class_ = (each.dscp, five_qi, transports, each.need.non_blocking_send)
            if not each.unique and class_ == own and each.max_datagram_bytes is None:
                continue
            key = endpoint.name if each.unique else class_
            known = found.get(key)
            sizes = (each.max_datagram_bytes, known.max_datagram_bytes if known else None)
            found[key] = ParticipantGroup(
                names=(*(known.names if known else ()), endpoint.name),
                unique=each.unique,
                dscp=each.dscp,
                five_qi=five_qi,
                transports=transports,
                max_datagram_bytes=min((size for size in sizes if size is not None), default=None),
                non_blocking_send=each.need.non_blocking_send,
            )
        return tuple(found.values())

    def _resolve(self, node: Node, need: FlowNeed) -> ResolvedNeed:
        topic = _topic(node, need.kind, need.name)
        delay, size = self._max_delay_ms(node, need, topic), self._max_message_size(node, need)
        flow_class = class_of(need, max_delay_ms=delay, message_bytes=size)
        return ResolvedNeed(
            need=need,
            topic=topic,
            unique=need.unique in OWN_FLOW,
            marking=marking_of(need, self._manifest.network, flow_class.five_qi),
            flow_class=flow_class,
            max_delay_ms=delay,
            max_message_size=size,
            transports=self._transports(node) if self._by_participant(need) else (),
            told_apart=topic in self._told_apart,
        )

    def _max_delay_ms(self, node: Node, need: FlowNeed, topic: str) -> float | None:
        if need.max_delay_ms is not None or need.kind is not EndpointKind.PUBLISHER:
            return need.max_delay_ms
        return self._delays.get((node.key, topic))

    def _max_message_size(self, node: Node, need: FlowNeed) -> int | None:
        if need.max_message_size is not None or need.kind is not EndpointKind.PUBLISHER:
            return need.max_message_size
        for endpoint in node.interface.endpoints:
            if (endpoint.kind, endpoint.name) == (need.kind, need.name):
                if endpoint.type not in self._sizes:
                    self._sizes[endpoint.type] = bounded_size(endpoint.type, self._prefixes)
                return self._sizes[endpoint.type]
        return None

    def _by_participant(self, need: FlowNeed) -> bool:
        """Whether the need is met by what its participant may use, with no connection at all.

        Where discovery says what participants have, negotiation decides (`lifecycle.plan`).
        """
        discovery = self._manifest.discovery
        return (
            need.transport is FlowTransport.NETWORK
            and discovery.mode is DiscoveryMode.DYNAMIC
            and discovery.transport is FlowTransport.ANY
        )

    def _transports(self, node: Node) -> tuple[str, ...]:
        return ("udpv6",) if ":" in self._addresses.get(node.machine, "") else ("udpv4",)

    def _with_datagrams(self, node_key: str, each: ResolvedNeed) -> ResolvedNeed:
        """Say how small datagrams must be; only a flow that a network knows can be harmed."""
        if each.need.kind is not EndpointKind.PUBLISHER or not each.prioritised:
            return each
        declared = self._manifest.network.max_datagram_bytes
        ipv6 = ":" in self._addresses.get(self._machines[node_key], "")
        limit = declared or max_unfragmented(ipv6=ipv6)
        size = each.max_message_size
        # Of what size messages are nobody knows; if the path is known to be narrow, be careful.
        small = declared is None if size is None else not is_fragmented(size, limit)
        if small:
            return each
        return dataclasses.replace(each, max_datagram_bytes=declared or SAFE_DATAGRAM_BYTES)


def _add_subscription(
    found: dict[object, ParticipantGroup], each: ResolvedNeed, transports: tuple[str, ...]
) -> None:
    key = (EndpointKind.SUBSCRIPTION, each.dscp, transports)
    known = found.get(key)
    found[key] = ParticipantGroup(
        kind=EndpointKind.SUBSCRIPTION,
        names=(*(known.names if known else ()), each.need.name),
        unique=False,
        dscp=each.dscp,
        five_qi=None,
        transports=transports,
        max_datagram_bytes=None,
        non_blocking_send=False,
    )


def _topic(node: Node, kind: EndpointKind, name: str) -> str:
    try:
        return resolve(
            name, node_name=node.name, namespace=node.namespace, remap=node.remap, kind=kind
        )
    except LifecycleError:
        return ""


def _told_apart(manifest: Manifest) -> frozenset[str]:
    """Topics whose every subscription gets an NFE of its own."""
    answers: dict[str, bool] = {}
    for node in manifest.nodes:
        needs = {need.name: need for need in node.flows if need.kind is EndpointKind.SUBSCRIPTION}
        for endpoint in node.interface.endpoints:
            if endpoint.kind is not EndpointKind.SUBSCRIPTION:
                continue
            topic = _topic(node, endpoint.kind, endpoint.name)
            need = needs.get(endpoint.name)
            own = need is not None and need.unique in OWN_FLOW and node.run.kind is RunKind.PYTHON
            answers[topic] = answers.get(topic, True) and own
    return frozenset(topic for topic, every in answers.items() if every)


_Key = tuple[str, EndpointKind, str]


def _with_identifiers(
    resolved: dict[_Key, ResolvedNeed], manifest: Manifest
) -> dict[_Key, ResolvedNeed]:
    """Give each publisher that needs a unique flow a DSCP of its own (*Unique Network Flows*).

    A DSCP that is written stays. The others get what nobody else has, over all nodes, in the order
    of the manifest; when the 64 are used up, the rest have a problem instead.
    """
    asking = [
        key
        for key, each in resolved.items()
        if each.unique and each.need.kind is EndpointKind.PUBLISHER
    ]
    free = iter(identifiers(each.dscp for each in resolved.values() if each.dscp is not None))
    nodes = {node.key: node for node in manifest.nodes}
    found = dict(resolved)
    for number, key in enumerate(asking, start=1):
        each = resolved[key]
        if each.dscp is not None or nodes[key[0]].run.kind is not RunKind.PYTHON:
            continue
        dscp = next(free, None)
        if dscp is None:
            message = (
                f"cannot give publisher {key[2]!r} of {key[0]!r} a DSCP of its own: it is number "
                f"{number} of {len(asking)} publishers that need one, and a DSCP has 64 values"
            )
            hint = "use 'flow_identification: participant', or ask for fewer unique publishers"
            marking = Marking(problem=(message, hint))
        else:
            marking = Marking(dscp=dscp, reason="its identifier")
        found[key] = dataclasses.replace(each, marking=marking)
    return found
