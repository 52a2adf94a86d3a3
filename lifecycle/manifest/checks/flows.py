"""Checks of flow needs, DSCP and 5QI; of links; of rates, delays and silences together. Pure."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

from lifecycle.errors import did_you_mean
from lifecycle.manifest.checks.system import DeclaredSystem, Resolved
from lifecycle.manifest.diagnostics import Diagnostic, error, note
from lifecycle.manifest.model import (
    QUANTILE,
    EndpointKind,
    FlowNeed,
    Link,
    Node,
    Quantity,
    UniqueHow,
)
from lifecycle.manifest.names import full_name_problem
from lifecycle.manifest.qos import Reliability
from lifecycle.network.dscp import ECN_MASK, describe
from lifecycle.network.nfe import UniqueRequirement

_KEPT_BY_CLASS = ("max_delay_ms", "loss")
"""What a class promises whatever the rate; the others depend on what an operator configures."""


def check_mapping(system: DeclaredSystem) -> Iterator[Diagnostic]:
    """Yield a finding about a mapping of priorities that is empty."""
    mapping = system.manifest.network.transport_priority_mapping
    if mapping is not None and mapping.low > mapping.high:
        at = system.manifest.where("network.transport_priority_mapping")
        message = f"cannot map priorities to TOS {mapping.low:#x} … {mapping.high:#x}"
        yield error("check.flow-dscp", at, message, "the highest is below the lowest: swap them")


def check_flows(system: DeclaredSystem, node: Node) -> Iterator[Diagnostic]:
    """Yield findings about flow needs, but for transports."""
    for each in system.needs.of_node(node):
        need = each.need
        endpoint = node.interface.find(need.kind, need.name)
        if endpoint is None:
            yield _unknown(node, need)
            continue  # what else it asks for is of no endpoint
        given = need.dscp is not None or need.transport_priority is not None
        # A BEST_EFFORT reader sends no ACKNACK (DDSI-RTPS §8.4.11).
        qos = endpoint.qos
        is_best_effort = qos is not None and qos.reliability is Reliability.BEST_EFFORT
        if given and need.kind is EndpointKind.SUBSCRIPTION and is_best_effort:
            message = (
                f"cannot mark anything that subscription {need.name!r} sends with a DSCP: it is "
                f"BEST_EFFORT and acknowledges nothing"
            )
            hint = "make it RELIABLE, or mark the publishers of the topic"
            yield note("check.flow-dscp", need.at, message, hint)
        if need.transport_priority is not None:
            yield from _priority(need, each.tos)
        message, hint = each.flow_class.problem
        if message:
            yield error("check.flow-five-qi", need.at, message, hint)
        for field, issue in each.flow_class.issues:
            make = error if field in _KEPT_BY_CLASS else note
            hint = "choose another class, or write 'five_qi: auto'"
            yield make("check.five-qi-class", need.at, issue, hint)


def _unknown(node: Node, need: FlowNeed) -> Diagnostic:
    """Say that a node does not declare the endpoint of a need."""
    noun, endpoints = need.kind.noun, node.interface.endpoints
    other = next((each.kind for each in endpoints if each.name == need.name), None)
    hint = did_you_mean(need.name, [each.name for each in endpoints if each.kind is need.kind])
    if other is not None and other.is_topic:
        hint = f"it is a {other.noun}: move it to 'flows.{other.value}'"
    elif other is not None:
        hint = f"it is a {other.noun}; only publishers and subscriptions have flow needs"
    message = f"cannot ask a flow of {noun} {need.name!r}: {node.key!r} declares no such {noun}"
    return error("check.flow-unknown-endpoint", need.at, message, hint)


def _priority(need: FlowNeed, tos: int | None) -> Iterator[Diagnostic]:
    """Say what a 'transport_priority' cannot be."""
    number = need.transport_priority or 0
    priority = f"transport_priority {number} ({number:#x})"
    if need.dscp is not None:
        message = f"cannot give {need.kind.noun} {need.name!r} both dscp and transport_priority"
        hint = f"keep one; the one is {describe(need.dscp)}, the other {priority}"
        yield error("check.flow-dscp", need.at, message, hint)
    elif tos is not None and tos & ECN_MASK:
        message = (
            f"cannot use {priority}: the two lowest bits of TOS {tos} are ECN and belong to the "
            "transport (RFC 3168)"
        )
        yield error("check.flow-dscp", need.at, message, f"without them it is {describe(tos >> 2)}")


_VERBS = {EndpointKind.PUBLISHER: "publish", EndpointKind.SUBSCRIPTION: "subscribe to"}


def check_links(system: DeclaredSystem) -> Iterator[Diagnostic]:
    """Yield findings about the topic and the ends of every link, and what it demands of them."""
    for link in system.manifest.links:
        if problem := full_name_problem(link.topic):
            message = f"cannot use {link.topic!r} as the topic of a link: {problem}"
            hint = did_you_mean(link.topic, system.names(EndpointKind.PUBLISHER))
            yield error("check.link-topic", link.at, message, hint)
            continue
        ends = [
            *_end(system, link, link.from_node, EndpointKind.PUBLISHER),
            *_end(system, link, link.to_node, EndpointKind.SUBSCRIPTION),
        ]
        resolved = [each for each in ends if isinstance(each, Resolved)]
        yield from (each for each in ends if isinstance(each, Diagnostic))
        if resolved == ends:
            yield from _uniqueness(link, resolved, system)


def _end(
    system: DeclaredSystem, link: Link, key: str, kind: EndpointKind
) -> Iterator[Resolved | Diagnostic]:
    """Yield the endpoints at one end of a link, or why there are none."""
    if key not in system.nodes:
        message = f"cannot link node {key!r}: there is no such node"
        hint = did_you_mean(key, system.nodes)
        yield error("check.link-unknown-node", link.at, message, hint)
        return
    others = system.named(kind, link.topic)
    if found := [each for each in others if each.node.key == key]:
        yield from found
        return
    own = [each.name for each in system.by_node.get(key, ()) if each.endpoint.kind is kind]
    hint = did_you_mean(link.topic, own)
    if not hint and others:
        hint = f"node {', '.join(map(repr, sorted({each.node.key for each in others})))} does"
    message = f"cannot link {link.topic!r}: node {key!r} does not {_VERBS[kind]} it"
    yield error("check.link-topic", link.at, message, hint)


def _uniqueness(link: Link, ends: list[Resolved], system: DeclaredSystem) -> Iterator[Diagnostic]:
    """Compare what the link demands with what its ends ask for.

    *Unique Network Flows*: a flow is strongly unique if both NFEs are unique, weakly if one is.
    """
    silent, is_marked = list[Resolved](), False
    for each in ends:
        need = system.needs.of(each.node.key, each.endpoint.kind, each.endpoint.name)
        if need is None or need.need.unique is UniqueRequirement.NOT_REQUIRED:
            silent.append(each)
        # A marked publisher has sockets beside its node's: whether alone is seen when it runs.
        is_publisher = each.endpoint.kind is EndpointKind.PUBLISHER
        is_marked |= need is not None and need.dscp is not None and is_publisher
    flow = f"cannot make the flow of {link.topic!r} {link.unique.value} unique"
    if link.unique is UniqueHow.STRONGLY:
        for each in silent:
            message = f"{flow}: {_end_name(each)} does not ask to be unique"
            yield error("check.link-not-unique", link.at, message, _remedy(each))
    if link.unique is UniqueHow.WEAKLY and silent == ends and not is_marked:
        names = " nor ".join(map(_end_name, ends))
        message = f"{flow}: neither {names} asks to be unique"
        yield error("check.link-not-unique", link.at, message, _remedy(ends[-1]))


def _end_name(each: Resolved) -> str:
    return f"{each.endpoint.kind.noun} {each.endpoint.name!r} of {each.node.key!r}"


def _remedy(each: Resolved) -> str:
    return (
        f"add '{each.endpoint.name}: {{unique: strictly_required}}' to "
        f"nodes.{each.node.key}.flows.{each.endpoint.kind.value}"
    )


_NUMBER = "check.flow-number"


def check_numbers(system: DeclaredSystem) -> Iterator[Diagnostic]:
    """Yield findings about the numbers of each endpoint, link and topic."""
    published: dict[str, list[Quantity]] = {}
    asked: dict[str, list[Quantity]] = {}
    for node in system.manifest.nodes:
        for each in system.needs.of_node(node):
            yield from _alone(each.need)
            is_publisher = each.need.kind is EndpointKind.PUBLISHER
            (published if is_publisher else asked).setdefault(each.topic, []).extend(
                each.need.quantities
            )
    for link in system.manifest.links:
        yield from _alone(link)
        asked.setdefault(link.topic, []).extend(link.quantities)
    for topic in {**published, **asked}:
        if len(system.named(EndpointKind.PUBLISHER, topic)) == 1:  # several may add up
            yield from _together(published.get(topic, ()), asked.get(topic, ()))


def _alone(declared: FlowNeed | Link) -> Iterator[Diagnostic]:
    if declared.quantile != QUANTILE and declared.max_delay_ms is None:
        message = f"cannot use quantile {declared.quantile:g} without a delay"
        yield error(_NUMBER, declared.at, message, "add 'max_delay_ms', or leave it out")
    for rate in _named("rate_hz", declared.quantities):
        if not rate.value and rate.most is None:
            yield error(_NUMBER, rate.at, "cannot use rate_hz without a number", "add min or max")
        elif rate.most is not None and rate.most < rate.value:
            yield error(_NUMBER, rate.at, f"cannot keep {rate}: min is larger than max")


def _together(published: Sequence[Quantity], asked: Sequence[Quantity]) -> Iterator[Diagnostic]:
    """Compare what the publishers of a topic declare with what its data are to be."""
    rates = [each for each in _named("rate_hz", published) if each.most or each.value]
    if not rates:
        return
    fastest, least = max(rates, key=_hertz), max(rates, key=lambda each: each.value)
    where = f"the publisher declares {fastest} ({fastest.at.spelled})"
    for rate in _named("rate_hz", asked):
        if rate.value > _hertz(fastest):
            yield error(_NUMBER, rate.at, f"cannot ask for {rate}: {where}")
        elif rate.most is not None and rate.most < least.value * (1 - least.slack):
            message = f"cannot keep {rate}: the publisher declares {least} ({least.at.spelled})"
            yield error(_NUMBER, rate.at, message)
    for silence in _named("max_silence_s", (*published, *asked)):
        period_s = 1 / _hertz(fastest)
        if silence.value < period_s:
            message = f"cannot keep {silence}: {where}, one message in {period_s:.3g} s"
            yield error(_NUMBER, silence.at, message)


def _named(name: str, numbers: Iterable[Quantity]) -> Iterator[Quantity]:
    return (each for each in numbers if each.name == name)


def _hertz(rate: Quantity) -> float:
    return rate.most or rate.value


CHECKS = (check_mapping, check_links, check_numbers)
OF_A_NODE = (check_flows,)
