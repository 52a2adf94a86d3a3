"""Flow rules as lines for `tc -batch`: a queue per class on one network device, filters per flow.

Owns: the qdisc `1f10:` at the root of a device; which classes a link has for a set of rules: the
ranking of DSCPs and 5QIs and how the link's rate is divided; the classes' queues; their filters,
matching a flow or a mark with flower and with u32, and the handles of filters; and the settings of
the tc export, with what a kernel can do. Pure.

The handle is the mark of ownership: tc has no comments, so only what hangs below this handle is
ours. `tc -batch` is neither atomic nor dry-runnable, and a second `qdisc add` fails: look whether
the handle is there first, and then send `render_tc(…, with_qdisc=False)`, whose lines all replace.

The kernel's own queues do not rank by DSCP as people expect: pfifo_fast and prio put EF, CS6 and DF
into one band. So each class of the rules gets a queue of its own here.

Filters carry an explicit preference and handle, which makes them replaceable one by one. u32 names
its root tables in the order in which they are made, so a filter that matches nothing holds the
first place of each family.
"""

from __future__ import annotations

import enum
import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence

from lifecycle import dataclasses
from lifecycle.network import InternetProtocol, describe, dscp_name, five_qi_of, parse_dscp, tos
from lifecycle.programming.rules.rules import FlowRule, LeftOut, asks, named

DEFAULT_MINOR = 0xFFF
"""Minor number of the class that everything else goes to."""

_FIRST = tuple(map(parse_dscp, ("EF", "VA")))
"""Expedited forwarding and voice-admit come before everything (RFC 3246, RFC 5865)."""

_LOWEST = tuple(map(parse_dscp, ("LE", "CS1")))
"""Less than best effort (RFC 8622, RFC 4594 §4.10)."""


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True, order=True)
class TrafficClass:
    """One class of a link.

    Attributes:
        rank: lower is served first.
        name: `ef`, `dscp5`, `5qi85`: what settings call it.
        minor: minor number of its classid, 0x100–0x2ff; the same wherever the class occurs.
        comment: for people; DSCP and TOS side by side.
    """

    rank: tuple[int, int]
    name: str
    minor: int
    comment: str

    @property
    def below_default(self) -> bool:
        """Whether everything else comes before it."""
        return self.rank[0] > _RANK_DEFAULT


_RANK_FIRST, _RANK_GBR, _RANK_MARKED, _RANK_NON_GBR, _RANK_DEFAULT, _RANK_LOWEST = range(6)


def class_of(rule: FlowRule) -> TrafficClass | None:
    """Return the class of a rule, by its DSCP or else its 5QI; None if it stays with the rest.

    DF is the rest itself.
    """
    if rule.dscp is not None:
        return None if rule.dscp == 0 else _by_dscp(rule.dscp)
    return None if rule.five_qi is None else _by_five_qi(rule.five_qi)


def classes_of(rules: Iterable[FlowRule]) -> tuple[TrafficClass, ...]:
    """Return the classes of the rules, each once, the one to serve first in front."""
    return tuple(sorted({found for rule in rules if (found := class_of(rule)) is not None}))


def band_of(class_: TrafficClass, classes: Sequence[TrafficClass]) -> int:
    """Return the band of a class with prio, counted from 0; the rest has one in between."""
    index = list(classes).index(class_)
    return index + 1 if class_.below_default else index


def divide(
    classes: Iterable[TrafficClass], *, link_kbit: int, guaranteed_kbit: Mapping[str, int] = {}
) -> tuple[dict[str, int], int]:
    """Return the guaranteed rate of each class by name, and that of the rest, in kbit/s.

    Classes without a given rate share what is left equally with the rest; those below the rest
    get a hundredth of the link, so that they do not starve.

    Args:
        classes: of the link.
        link_kbit: rate of the link, kbit/s: a little below the real one, or its queue is elsewhere.
        guaranteed_kbit: rates by class name, kbit/s. A prioritised class needs more than its burst
            peak, or it queues behind itself.

    Raises:
        ValueError: a rate is not positive, an unknown class has one, or there is not enough.
    """
    every = tuple(classes)
    known = ", ".join(each.name for each in every) or "none"
    if link_kbit < 1:
        raise ValueError(f"cannot divide a link of {link_kbit} kbit/s; use 1 or more")
    for name, rate in guaranteed_kbit.items():
        if name not in {each.name for each in every}:
            raise ValueError(
                f"cannot guarantee a rate to class {name!r}; classes of these rules are: {known}"
            )
        if rate < 1:
            raise ValueError(f"cannot guarantee {rate} kbit/s to class {name}; use 1 or more")
    rates = {
        each.name: guaranteed_kbit.get(each.name, max(1, link_kbit // 100))
        for each in every
        if each.below_default or each.name in guaranteed_kbit
    }
    open_ = [each.name for each in every if each.name not in rates]
    left = link_kbit - sum(rates.values())
    share = left // (len(open_) + 1)
    if share < 1:
        given = ", ".join(f"{name} {rate}" for name, rate in rates.items())
        raise ValueError(
            f"cannot guarantee {sum(rates.values())} kbit/s ({given}) on a link of "
            f"{link_kbit} kbit/s: something must be left for "
            f"{', '.join((*open_, 'everything else'))}"
        )
    rates.update((name, share) for name in open_)
    return {each.name: rates[each.name] for each in every}, left - share * len(open_)


def _by_dscp(dscp: int) -> TrafficClass:
    name = dscp_name(dscp).lower()
    group = _RANK_MARKED
    if dscp in _FIRST:
        group = _RANK_FIRST
    elif dscp in _LOWEST:
        group = _RANK_LOWEST
    return TrafficClass(
        rank=(group, -dscp),
        name=f"dscp{name}" if name.isdecimal() else name,
        minor=0x100 + dscp,
        comment=describe(dscp),
    )


def _by_five_qi(value: int) -> TrafficClass:
    five_qi = five_qi_of(value)
    group = _RANK_GBR if five_qi.resource_type.guarantees_rate else _RANK_NON_GBR
    return TrafficClass(
        rank=(group, five_qi.priority_level),
        name=f"5qi{value}",
        minor=0x200 + value,
        comment=str(five_qi),
    )


OWNED_HANDLE = "1f10:"
"""The root qdisc with this handle is ours, whichever device it is on."""

DEFAULT_QUEUE_MS = 50.0
"""How long the queue of each class may become. Without a bound of its own it is a thousand packets
(txqueuelen): measured on a link of 20 Mbit/s at 120 % load, bulk then waited 569 ms, and
49 ms with this; a UDP datagram of 64 kB still arrives whole."""

MIN_QUEUE_BYTES = 66_000
"""Room for one UDP datagram of the largest size in its fragments: a shorter queue would let none
through, however often it is sent."""

QDISCS = ("htb", "prio")
CLASSIFIERS = ("flower", "u32")

_LONGEST_QUEUE_MS = 10_000
_DEVICE = re.compile(r"[^\s/:#]{1,15}")


class TcMatch(enum.Enum):
    """What filters look at."""

    FLOW = "flow"  # the 5-tuple: nothing has to be marked
    MARK = "mark"  # the DSCP: one filter per class, also for what others have marked


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class TcFeatures:
    """What the kernel of the device has; not every kernel has all of it, so probe.

    Attributes:
        qdiscs: of QDISCS.
        classifiers: of CLASSIFIERS.
    """

    qdiscs: tuple[str, ...] = QDISCS
    classifiers: tuple[str, ...] = CLASSIFIERS

    def classifier(self) -> str:
        """Return the classifier to use.

        Raises:
            ValueError: the kernel has none of them.
        """
        return _first(CLASSIFIERS, self.classifiers, "classifier", "cls_")

    def qdisc(self, link_kbit: int | None) -> str:
        """Return the queueing discipline to use: htb divides a rate, so it needs one.

        Raises:
            ValueError: the kernel has none of them.
        """
        wanted = QDISCS if link_kbit is not None else QDISCS[1:]
        try:
            return _first(wanted, self.qdiscs, "queueing discipline", "sch_")
        except ValueError as error:
            if link_kbit is None and "htb" in self.qdiscs:
                raise ValueError(f"{error}; with the rate of the link, htb will do") from None
            raise


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class TcSettings:
    """How a device is to treat the flows.

    Attributes:
        device: network device that the packets leave by, `eth0`.
        link_kbit: rate of the link behind it, kbit/s; None gives strict priority without rates.
        guaranteed_kbit: rates by class name (`ef`, `5qi85`), kbit/s; must be above burst peaks.
        match: what filters look at.
        queue_ms: how long the queue of each class may become, in the time that the link takes to
            send it, milliseconds, > 0; what finds it full is dropped. Only where there is a rate.
        features: of the kernel.
    """

    device: str
    link_kbit: int | None = None
    guaranteed_kbit: Mapping[str, int] = dataclasses.field(default_factory=dict)
    match: TcMatch = TcMatch.FLOW
    queue_ms: float = DEFAULT_QUEUE_MS
    features: TcFeatures = TcFeatures()

    def __post_init__(self) -> None:
        if not _DEVICE.fullmatch(self.device) or self.device in {".", ".."}:
            raise ValueError(
                f"cannot use device {self.device!r}; "
                f"use the name of a network device, such as eth0, of at most 15 characters"
            )
        if not 0 < self.queue_ms <= _LONGEST_QUEUE_MS:
            raise ValueError(
                f"cannot use a queue of {self.queue_ms:g} ms; use more than 0 and at most "
                f"{_LONGEST_QUEUE_MS}"
            )

    @property
    def queue_bytes(self) -> int | None:
        """How many bytes the queue of each class takes; None without a rate."""
        if self.link_kbit is None:
            return None
        return max(MIN_QUEUE_BYTES, math.ceil(self.link_kbit * self.queue_ms / 8))


def _first(wanted: Sequence[str], present: Sequence[str], what: str, module: str) -> str:
    for each in wanted:
        if each in present:
            return each
    modules = " or ".join(f"{module}{each}" for each in wanted)
    raise ValueError(
        f"cannot find a {what} in this kernel: {' or '.join(wanted)} would do; "
        f"load the module {modules}, or use a kernel that has it"
    )


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


_PRIO_BANDS = 16
"""TCQ_PRIO_BANDS."""

_QUEUE = "2"
"""First hex digit of the handles of queues; the others are the minor number of their class."""

_QUANTUM_BYTES = 3028
"""Two full Ethernet frames; HTB's own guess is too large for fast links and it says so."""


def render_tc(
    rules: Iterable[FlowRule],
    settings: TcSettings,
    *,
    system: str,
    digest: str,
    with_qdisc: bool = True,
    left_out: Sequence[LeftOut] = (),
) -> str:
    """Return lines for `tc -batch FILE`.

    Args:
        rules: of verified flows.
        settings: of the device.
        system: named in a comment.
        digest: of the rules; named in a comment.
        with_qdisc: start with the qdisc, which fails if it is there; False to bring up to date
            what is.
        left_out: flows without a rule, named in comments.

    Raises:
        ValueError: the kernel lacks what is needed, or the rates do not fit the link.
    """
    every = tuple(rules)
    lines = [
        f"# managed-by=lifecycle digest={digest} system={system} handle={OWNED_HANDLE}",
        *(f"# {named(each)}: {each.describe()}: {asks(each)}" for each in every),
        *(f"# left out: {each}" for each in left_out),
        *(
            f"# left out: {named(each)}: {why}"
            for each in every
            if (why := _why_not(each, settings))
        ),
        *_classes(classes_of(every), settings, with_qdisc=with_qdisc),
        *(each.line for each in anchors(settings)),
        *(each.line for each in tc_filters(every, settings)),
    ]
    return "\n".join(lines) + "\n"


def render_tc_removal(device: str) -> str:
    """Return the line for `tc -batch FILE` that removes our qdisc and all below it.

    It fails, and removes nothing, if the device's root qdisc is not ours.
    """
    settings = TcSettings(device=device)
    return f"qdisc del dev {settings.device} root handle {OWNED_HANDLE}\n"


def _why_not(rule: FlowRule, settings: TcSettings) -> str:
    """Why a rule has no filter; empty if it has one."""
    if class_of(rule) is None:
        return "it has no DSCP but DF and no 5QI, and stays with the rest"
    if rule.dscp is None and settings.match is TcMatch.MARK:
        return "it has no DSCP, and filters look at nothing else here"
    return ""


def _classes(
    classes: Sequence[TrafficClass], settings: TcSettings, *, with_qdisc: bool
) -> Iterator[str]:
    if settings.features.qdisc(settings.link_kbit) == "prio":
        yield from _prio(classes, settings, with_qdisc=with_qdisc)
    else:
        assert settings.link_kbit is not None
        yield from _htb(classes, settings, settings.link_kbit, with_qdisc=with_qdisc)


def _htb(
    classes: Sequence[TrafficClass], settings: TcSettings, link_kbit: int, *, with_qdisc: bool
) -> Iterator[str]:
    device, major = settings.device, OWNED_HANDLE
    rates, rest = divide(classes, link_kbit=link_kbit, guaranteed_kbit=settings.guaranteed_kbit)
    if with_qdisc:
        yield f"qdisc add dev {device} root handle {major} htb default {DEFAULT_MINOR:#x}"
    yield (
        f"class replace dev {device} parent {major} classid {major}1 "
        f"htb rate {link_kbit}kbit ceil {link_kbit}kbit quantum {_QUANTUM_BYTES}"
    )
    above = [each for each in classes if not each.below_default]
    leaves = [
        *((each.minor, rates[each.name], min(i, 5), each.comment) for i, each in enumerate(above)),
        (DEFAULT_MINOR, rest, 6, "everything else"),
        *(
            (each.minor, rates[each.name], 7, each.comment)
            for each in classes
            if each.below_default
        ),
    ]
    for minor, rate, prio, comment in leaves:
        yield f"# class {major}{minor:x}: {comment}"
        yield (
            f"class replace dev {device} parent {major}1 classid {major}{minor:x} "
            f"htb rate {rate}kbit ceil {link_kbit}kbit prio {prio} quantum {_QUANTUM_BYTES}"
        )
        yield (
            f"qdisc replace dev {device} parent {major}{minor:x} handle {_QUEUE}{minor:03x}: "
            f"bfifo limit {settings.queue_bytes}"
        )


def _prio(
    classes: Sequence[TrafficClass], settings: TcSettings, *, with_qdisc: bool
) -> Iterator[str]:
    if settings.guaranteed_kbit:
        raise ValueError(
            f"cannot guarantee a rate to {', '.join(settings.guaranteed_kbit)} with prio; "
            f"give the rate of the link, and a kernel with htb"
        )
    bands = len(classes) + 1
    if bands > _PRIO_BANDS:
        raise ValueError(
            f"cannot give {len(classes)} classes a band each: prio has {_PRIO_BANDS}; "
            f"give the rate of the link, then htb has no such limit"
        )
    rest = sum(not each.below_default for each in classes)
    for each in classes:
        yield f"# band {band_of(each, classes)}: {each.comment}"
    yield f"# band {rest}: everything else"
    # prio can be changed in place, but only by `replace` and with at least two bands.
    yield (
        f"qdisc {'add' if with_qdisc else 'replace'} dev {settings.device} root "
        f"handle {OWNED_HANDLE} prio bands {max(2, bands)} priomap {' '.join([str(rest)] * 16)}"
    )
