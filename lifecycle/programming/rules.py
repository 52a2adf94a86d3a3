"""Turns verified flows into flow rules for networks, with the reason for each flow left out. Pure.

A rule says only what was observed or declared: a flow whose verdict is not ok, shared memory,
groups and tuples that two flows share in disagreement make no rule. Comments have DSCP and TOS
always side by side, because products differ in which of the two they ask for.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import TypeVar

import msgspec
from msgspec.structs import replace

from lifecycle.manifest.model import EndpointKind
from lifecycle.network import nfe
from lifecycle.network.dscp import describe
from lifecycle.network.five_qi import DscpMapping
from lifecycle.network.medium import Medium
from lifecycle.plan.model import Plan, PlannedEndpoint, PlannedNode
from lifecycle.verify.network_flows import UNKNOWN
from lifecycle.verify.outcome import Outcome
from lifecycle.verify.verdict import FlowReport

T = TypeVar("T")

MAX_FLOW_LABEL = 0xFFFFF
"""Twenty bits (RFC 6437)."""

_UNSEEN = {
    str(medium): f"{where}: no packet that a network could see"
    for medium, where in ((Medium.SHM, "shared memory"), (Medium.INTRAPROCESS, "one process"))
}
"""Why no network sees a flow, by its effective transport."""

SourceAddress = Callable[[PlannedNode, str], str]
"""Observes the address that a node's machine sends from to a destination; empty if unknown."""


class FlowRule(msgspec.Struct, frozen=True, kw_only=True):
    """One verified flow as a network can match it, and what it is to get.

    Attributes:
        key: names the flow for as long as its manifest does, whatever ports it has:
            `/robot/video /robot/camera → /viewer udp 10.77.0.2`.
        names: (topic, publisher, subscription) of every pair that this one flow carries.
        source_address: empty where the sender's routing decides and it was not observed: the rule
            then matches ports and destination only.
        source_port: 1–65535.
        destination_address: one unicast address.
        destination_port: 1–65535.
        flow_label: IPv6 flow label, 0–0xFFFFF; 0 if none is set.
        dscp: 0–63 that its packets are to carry; None leaves them alone.
        five_qi: the 5QI that was declared for it; None if none was.
        max_delay_ms: the shortest delay that a link allows its pairs; None if none does.

    Raises:
        ValueError: something that a filter could not say, or would say differently.
    """

    key: str
    names: tuple[tuple[str, str, str], ...]
    transport_protocol: nfe.TransportProtocol
    source_address: str
    source_port: int
    destination_address: str
    destination_port: int
    flow_label: int = 0
    dscp: int | None = None
    five_qi: int | None = None
    max_delay_ms: float | None = None

    def __post_init__(self) -> None:
        for port in (self.source_port, self.destination_port):
            if not 1 <= port <= 65535:
                raise ValueError(f"cannot use port {port}; use 1 to 65535")
        to = _address(self.destination_address).version
        if self.source_address and (of := _address(self.source_address).version) != to:
            raise ValueError(
                f"cannot filter packets from {self.source_address} to {self.destination_address}: "
                f"one is IPv{of}, the other IPv{to}; use two addresses of one family"
            )
        if self.flow_label and self.internet_protocol is nfe.InternetProtocol.IPV4:
            raise ValueError(
                f"cannot set flow label {self.flow_label:#x} on IPv4: only IPv6 has one (RFC 6437)"
            )

    @property
    def internet_protocol(self) -> nfe.InternetProtocol:
        """The family, which the destination decides."""
        return (
            nfe.InternetProtocol.IPV6
            if ":" in self.destination_address
            else nfe.InternetProtocol.IPV4
        )

    def left_out(self, reason: str) -> list[str]:
        """Return each pair that this one flow carries as one that is left out."""
        return [f"{_pair(*names)}: {reason}" for names in self.names]

    def describe(self) -> str:
        """Return the tuple for people: `udp 10.77.0.1:17900 → 10.77.0.2:17910`."""
        source = nfe.socket_text(self.source_address or "*", self.source_port)
        destination = nfe.socket_text(self.destination_address, self.destination_port)
        return f"{self.transport_protocol.value} {source} → {destination}"

    @property
    def named(self) -> str:
        """Its flows: `/robot/video /robot/camera → /viewer`, several with commas."""
        return ", ".join(_pair(*names) for names in self.names)

    @property
    def asks(self) -> str:
        """What it asks for: `EF = DSCP 46 = TOS 184 (0xb8), 5QI 85`."""
        found = [] if self.dscp is None else [describe(self.dscp)]
        if self.five_qi is not None:
            found.append(f"5QI {self.five_qi}")
        if self.flow_label:
            found.append(f"flow label {self.flow_label:#07x}")
        if self.max_delay_ms is not None:
            found.append(f"at most {self.max_delay_ms:g} ms")
        return ", ".join(found) or "nothing"


def _address(text: str) -> nfe.IpAddress:
    """Return the address that `text` spells.

    Raises:
        ValueError: not one unicast address: a name, a zone, a wildcard or a group.
    """
    address = nfe.parse_address(text)
    # A zone means something on its own host only.
    if address is None or "%" in text or address.is_unspecified or address.is_multicast:
        raise ValueError(
            f"cannot use address {text!r}; use one unicast address without a zone, such as "
            "10.77.0.1"
        )
    return address


class RuleSet(msgspec.Struct, frozen=True, kw_only=True):
    """What may be programmed, and what may not.

    Attributes:
        left_out: what makes no rule, each with its reason: `/map /a → /b: shared memory: no packet
            that a network could see`.
    """

    rules: tuple[FlowRule, ...]
    left_out: tuple[str, ...] = ()


class Treatment(msgspec.Struct, frozen=True, kw_only=True):
    """What flows get beyond what the manifest says.

    Attributes:
        mapping: gives the DSCP of flows that have a 5QI and no DSCP; None gives none.
        label_flows: each IPv6 flow gets a flow label of its own, so that the 3-tuple of addresses
            and label distinguishes it from others too.
    """

    mapping: DscpMapping | None = None
    label_flows: bool = False


def flow_rules(
    flows: Iterable[FlowReport],
    plan: Plan,
    *,
    source_address: SourceAddress | None = None,
    treatment: Treatment | None = None,
) -> RuleSet:
    """Turn verified flows into rules.

    What a flow is to get comes from the plan: the DSCP and 5QI of its publisher, else the 5QI of
    its subscription; a DSCP that was read back from the sockets is used where none was planned.

    A publisher sends from `0.0.0.0:port`. Its address is the one its machine was observed to send
    from to that destination (`source_address`), else the machine's declared address if the
    destination is the declared address of the other machine: another interface would send from
    another address. Else it stays open, and port and destination have to do.

    Args:
        flows: as `verify` reports them.
        plan: that they were judged against.
        source_address: see SourceAddress; None if nothing was observed.
        treatment: what flows get beyond what the manifest says.
    """
    left_out: list[str] = []
    by_tuple: dict[str, list[FlowRule]] = {}
    for report in flows:
        for rule in _rules_of(report, plan, source_address, left_out):
            by_tuple.setdefault(rule.describe(), []).append(rule)
    rules: list[FlowRule] = []
    for sharing in by_tuple.values():
        asked = {(each.dscp, each.five_qi) for each in sharing}
        if asked == {(None, None)}:
            for each in sharing:
                left_out += each.left_out("neither a dscp nor a five_qi")
        elif len(asked) > 1:
            left_out += _disagreement(sharing)
        else:
            rules.append(_treated(_merged(sharing), treatment or Treatment()))
    return RuleSet(rules=_distinct(rules), left_out=tuple(dict.fromkeys(left_out)))


def _rules_of(
    report: FlowReport,
    plan: Plan,
    source_address: SourceAddress | None,
    left_out: list[str],
) -> Iterator[FlowRule]:
    """One rule for each tuple of one pair."""
    names = (report.topic, report.publisher, report.subscription)

    def leave_out(reason: str) -> None:
        left_out.append(f"{_pair(*names)}: {reason}")

    if report.outcome is not Outcome.OK:
        return leave_out(f"not verified: its verdict is {report.outcome.value}")
    if not report.source or not report.destination:
        return leave_out("its network flow endpoints are not known")
    if report.effective_transport in _UNSEEN:
        return leave_out(_UNSEEN[report.effective_transport])
    unknown = report.effective_transport == UNKNOWN
    if unknown and not all(map(nfe.is_ip, (*report.source, *report.destination))):
        leave_out(_UNSEEN[Medium.SHM])
    if not report.tuples and not unknown:
        leave_out("its two ends have no IP transport in common")
    publisher = _node(plan, report.publisher)
    subscription = _node(plan, report.subscription)
    # One host may be one machine, or machines of one address.
    addresses = {each.name: each.address for each in plan.machines}
    ends = [addresses.get(each.machine, "") for each in (publisher, subscription) if each]
    remote = len(ends) < 2 or ends[0] != ends[1]
    dscp, five_qi = _ask(report, publisher, subscription)
    for each in report.tuples:
        # A zone (`fe80::1%eth0`) names an interface of its own host and is not in the packet.
        sender, to = (
            address.partition("%")[0] for address in (each.source_address, each.destination_address)
        )
        flow = replace(each, source_address=sender, destination_address=to)
        if nfe.is_multicast(to):
            leave_out(f"group {to}: no unicast 5-tuple")
            continue
        if nfe.is_loopback(to) and remote:
            leave_out("loopback: never leaves the subscription's machine")
            continue
        try:
            yield FlowRule(
                key=f"{_pair(*names)} {flow.transport_protocol.value} {to}",
                names=(names,),
                transport_protocol=flow.transport_protocol,
                source_address=_source(flow, plan, publisher, subscription, source_address),
                source_port=flow.source_port,
                destination_address=to,
                destination_port=flow.destination_port,
                flow_label=flow.flow_label,
                dscp=dscp,
                five_qi=five_qi,
                max_delay_ms=report.max_delay_ms,
            )
        except ValueError as error:
            leave_out(str(error))


def _source(
    flow: nfe.FlowTuple,
    plan: Plan,
    publisher: PlannedNode | None,
    subscription: PlannedNode | None,
    observe: SourceAddress | None,
) -> str:
    """The address that the flow's packets come from; empty if it is not known."""
    if not nfe.is_wildcard(flow.source_address):
        return flow.source_address
    if publisher is None:
        return ""
    v6 = flow.internet_protocol is nfe.InternetProtocol.IPV6
    if observe is not None and (seen := observe(publisher, flow.destination_address)):
        return nfe.canonical(seen) if (":" in seen) is v6 else ""
    declared = {each.name: nfe.canonical(each.address) for each in plan.machines if each.address}
    address = declared.get(publisher.machine, "")
    other = "" if subscription is None else declared.get(subscription.machine, "")
    if address and other == flow.destination_address and (":" in address) is v6:
        return address
    return ""


def _ask(
    report: FlowReport, publisher: PlannedNode | None, subscription: PlannedNode | None
) -> tuple[int | None, int | None]:
    sends = _endpoint(publisher, EndpointKind.PUBLISHER, report.topic)
    takes = _endpoint(subscription, EndpointKind.SUBSCRIPTION, report.topic)
    dscp = None if sends is None else sends.dscp
    # 0 is what an unmarked socket reads back: it was not asked for.
    dscp = dscp if dscp is not None else report.dscp or None
    asked = [each.five_qi for each in (sends, takes) if each is not None]
    return dscp, next((each for each in asked if each is not None), None)


def _merged(sharing: Sequence[FlowRule]) -> FlowRule:
    """One rule for pairs that one flow carries; it is called after the first of them by name."""
    first = min(sharing, key=lambda each: each.names)
    delays = [each.max_delay_ms for each in sharing if each.max_delay_ms is not None]
    names = sorted({name for each in sharing for name in each.names})
    return replace(first, names=tuple(names), max_delay_ms=min(delays, default=None))


def _treated(rule: FlowRule, treatment: Treatment) -> FlowRule:
    """The rule with what follows from its 5QI and its 5-tuple."""
    mapping, is_ipv6 = treatment.mapping, rule.internet_protocol is nfe.InternetProtocol.IPV6
    if mapping is not None and rule.dscp is None and rule.five_qi is not None:
        rule = replace(rule, dscp=mapping.dscp_for(rule.five_qi))
    if treatment.label_flows and is_ipv6 and not rule.flow_label:
        # Equal for equal 5-tuples and evenly spread, as RFC 6437 §3 asks; never 0, which is none.
        digest = hashlib.sha256(rule.describe().encode()).digest()
        label = 1 + int.from_bytes(digest[:8], "big") % MAX_FLOW_LABEL
        rule = replace(rule, flow_label=label)
    return rule


def _distinct(rules: Sequence[FlowRule]) -> tuple[FlowRule, ...]:
    """Number the keys that occur again: several publishers of one node on one topic."""
    seen: dict[str, int] = {}
    distinct = []
    for rule in sorted(rules, key=lambda each: (each.key, each.source_port, each.destination_port)):
        seen[rule.key] = seen.get(rule.key, 0) + 1
        number = seen[rule.key]
        distinct.append(rule if number == 1 else replace(rule, key=f"{rule.key} #{number}"))
    return tuple(distinct)


def _disagreement(sharing: Sequence[FlowRule]) -> Iterator[str]:
    """Two flows in one tuple that are to be treated differently: the network sees only one."""
    for each in sharing:
        asked = (each.dscp, each.five_qi)
        other = next(other for other in sharing if (other.dscp, other.five_qi) != asked)
        yield from each.left_out(
            f"shares its 5-tuple with {other.named}, which is to be treated differently; "
            "make one of them unique"
        )


def _pair(topic: str, publisher: str, subscription: str) -> str:
    return f"{topic} {publisher} → {subscription}"


def _node(plan: Plan, full_name: str) -> PlannedNode | None:
    return next((each for each in plan.nodes if each.full_name == full_name), None)


def _endpoint(node: PlannedNode | None, kind: EndpointKind, topic: str) -> PlannedEndpoint | None:
    """The planned endpoint; of several on one topic the one that asks something of its data.

    The DSCP of a subscription is of what it sends back, which no rule is about.
    """
    found = [
        each
        for each in (() if node is None else node.endpoints)
        if each.kind is kind and each.resolved == topic
    ]
    publishes = kind is EndpointKind.PUBLISHER
    asking = [
        each for each in found if (publishes and each.dscp is not None) or each.five_qi is not None
    ]
    return next(iter((*asking, *found)), None)


def expressed(
    rules: Iterable[FlowRule], make: Callable[[FlowRule], T]
) -> tuple[list[tuple[FlowRule, T]], tuple[str, ...]]:
    """Return each rule with what a network makes of it, and the flows that it cannot express.

    Where it cannot, `make` raises a ValueError with the reason.
    """
    made: list[tuple[FlowRule, T]] = []
    left_out: list[str] = []
    for rule in rules:
        try:
            made.append((rule, make(rule)))
        except ValueError as error:  # noqa: PERF203 - the others are made
            left_out += rule.left_out(str(error))
    return made, tuple(left_out)
