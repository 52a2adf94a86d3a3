"""Filters of `tc`: which packets of a device go to which class.

Owns: matching a flow or a mark with flower and with u32, and the handles of filters. Pure.

Filters carry an explicit preference and handle, which makes them replaceable one by one. u32
names its root tables in the order in which they are made, so a filter that matches nothing holds
the first place of each family.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator, Mapping, Sequence

from lifecycle.network.dscp import tos
from lifecycle.network.nfe import InternetProtocol
from lifecycle.programming.rules.rules import FlowRule
from lifecycle.programming.rules.tc_classes import DEFAULT_MINOR, TrafficClass, band_of, class_of
from lifecycle.programming.rules.tc_settings import OWNED_HANDLE, TcMatch, TcSettings

MAX_FILTERS = 0xFFE
"""u32 has node numbers up to 0xfff; the last one holds the place."""

_ANCHOR = 0xFFF


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class TcFilter:
    """One filter.

    Attributes:
        key: of its FlowRule; the class name if it matches a mark.
        protocol: `ip` or `ipv6`.
        number: 1–0xffe, what its handle is made of.
        line: for `tc -batch`; makes it or replaces it.
        removal: for `tc -batch`; deletes it and nothing else.
    """

    key: str
    protocol: str
    number: int
    line: str
    removal: str


def tc_filters(
    rules: Iterable[FlowRule], settings: TcSettings, *, numbers: Mapping[str, int] = {}
) -> tuple[TcFilter, ...]:
    """Return the filters of the rules.

    Args:
        rules: of verified flows.
        settings: of the device.
        numbers: of filters that are there already, by key; each keeps its number.

    Raises:
        ValueError: the kernel has no classifier for it, or there are more than MAX_FILTERS.
    """
    classed = [(rule, found) for rule in rules if (found := class_of(rule)) is not None]
    matches = list(_matches(classed, settings))
    if len(matches) > MAX_FILTERS:
        raise ValueError(
            f"cannot make {len(matches)} filters on {settings.device}: {MAX_FILTERS} fit; "
            f"match by mark, or program fewer flows"
        )
    taken = {numbers[key] for key, *_ in matches if key in numbers}
    free = iter([number for number in range(1, _ANCHOR) if number not in taken])
    return tuple(
        _filter(
            settings,
            key=key,
            protocol=protocol,
            number=numbers[key] if key in numbers else next(free),
            match=match,
            minor=minor,
        )
        for key, protocol, match, minor in matches
    )


def anchors(settings: TcSettings) -> tuple[TcFilter, ...]:
    """Return the filters that hold u32's first table of each family; none for flower.

    They match nothing: a packet whose version field is 0 is neither IPv4 nor IPv6.
    """
    if settings.features.classifier() != "u32":
        return ()
    return tuple(
        _filter(
            settings,
            key="",
            protocol=protocol,
            number=_ANCHOR,
            match="match u8 0x00 0xf0 at 0",
            minor=DEFAULT_MINOR,
        )
        for protocol in _PREFERENCES
    )


_PREFERENCES = {"ip": 10, "ipv6": 11}
_TABLES = {"ip": "800", "ipv6": "801"}


_Match = tuple[str, str, str, int]
"""(key, protocol, what to match, minor of the class)."""


def _matches(
    classed: Sequence[tuple[FlowRule, TrafficClass]], settings: TcSettings
) -> Iterator[_Match]:
    classes = tuple(sorted({class_ for _, class_ in classed}))
    banded = settings.features.qdisc(settings.link_kbit) == "prio"
    flower = settings.features.classifier() == "flower"

    def minor(class_: TrafficClass) -> int:
        return band_of(class_, classes) + 1 if banded else class_.minor

    if settings.match is TcMatch.FLOW:
        for rule, class_ in classed:
            text = _flower(rule) if flower else _u32(rule)
            yield rule.key, _protocol(rule), text, minor(class_)
        return
    for class_ in classes:
        marks = {rule.dscp for rule, each in classed if each == class_}
        for dscp in marks - {None}:
            assert dscp is not None
            for protocol in _PREFERENCES:
                field = "ip dsfield" if protocol == "ip" else "ip6 priority"
                byte = f"{tos(dscp):#04x}"
                text = f"ip_tos {byte}/0xfc" if flower else f"match {field} {byte} 0xfc"
                yield f"{class_.name} {protocol}", protocol, text, minor(class_)


def _filter(
    settings: TcSettings, *, key: str, protocol: str, number: int, match: str, minor: int
) -> TcFilter:
    kind = settings.features.classifier()
    handle = f"{number:#x}" if kind == "flower" else f"{_TABLES[protocol]}::{number:x}"
    place = (
        f"dev {settings.device} parent {OWNED_HANDLE} protocol {protocol} "
        f"pref {_PREFERENCES[protocol]} handle {handle} {kind}"
    )
    target = "classid" if kind == "flower" else "flowid"
    return TcFilter(
        key=key,
        protocol=protocol,
        number=number,
        line=f"filter replace {place} {match} {target} {OWNED_HANDLE}{minor:x}",
        removal=f"filter del {place}",
    )


def _flower(rule: FlowRule) -> str:
    source = f" src_ip {rule.source_address}" if rule.source_address else ""
    return (
        f"ip_proto {rule.transport_protocol.value}{source} dst_ip {rule.destination_address} "
        f"src_port {rule.source_port} dst_port {rule.destination_port}"
    )


def _u32(rule: FlowRule) -> str:
    """Offsets count from the IP header, so it must have no options and no extension headers.

    All but the first fragment have data where the ports would be.
    """
    ip, bits = ("ip6", 128) if _protocol(rule) == "ipv6" else ("ip", 32)
    plain = " match u8 0x05 0x0f at 0 match u16 0 0x1fff at 6" if ip == "ip" else ""
    source = f" match {ip} src {rule.source_address}/{bits}" if rule.source_address else ""
    return (
        f"match {ip} protocol {rule.protocol_number} 0xff{plain}{source} "
        f"match {ip} dst {rule.destination_address}/{bits} "
        f"match {ip} sport {rule.source_port} 0xffff "
        f"match {ip} dport {rule.destination_port} 0xffff"
    )


def _protocol(rule: FlowRule) -> str:
    return "ipv6" if rule.internet_protocol is InternetProtocol.IPV6 else "ip"
