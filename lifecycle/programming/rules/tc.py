"""Flow rules as a queue per class on one network device: tc makes the queues, nft fills them.

Owns: the qdisc `1f10:` at the root of a device, an htb; which classes a link has for a set of
rules: the ranking of DSCPs and 5QIs and how the link's rate is divided; the classes' queues; the
nftables table `flowtc_<device>_<system>`, which puts packets into classes; and the settings of the
tc export. Pure.

The handle is the mark of ownership: tc has no comments, so only what hangs below this handle is
ours. The kernel's own queues do not rank by DSCP as people expect: pfifo_fast and prio put EF, CS6
and DF into one band. So each class of the rules gets a queue of its own here.

htb takes a packet whose priority (SO_PRIORITY, `meta priority` of nft) is the id of one of its
classes into that class (sch_htb.c, htb_classify), so no filter of tc is needed. nft sees packets
that this host sends before they are cut into fragments, and all fragments keep the priority. A
router sees ports in first fragments only: match by mark there.
"""

from __future__ import annotations

import enum
import hashlib
import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence

import msgspec

from lifecycle.network.dscp import describe, dscp_name, parse_dscp
from lifecycle.network.five_qi import five_qi_of
from lifecycle.programming.rules.nftables import (
    Action,
    nft_keyword,
    render_table,
    table_name,
)
from lifecycle.programming.rules.rules import FlowRule, LeftOut, remarks

DEFAULT_MINOR = 0xFFF
"""Minor number of the class that everything else goes to."""

_FIRST = tuple(map(parse_dscp, ("EF", "VA")))
"""Expedited forwarding and voice-admit come before everything (RFC 3246, RFC 5865)."""

_LOWEST = tuple(map(parse_dscp, ("LE", "CS1")))
"""Less than best effort (RFC 8622, RFC 4594 §4.10)."""


class TrafficClass(msgspec.Struct, frozen=True, kw_only=True, order=True):
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

_LONGEST_QUEUE_MS = 10_000
_DEVICE = re.compile(r"[^\s/:#\"*]{1,15}")


class TcMatch(enum.Enum):
    """What rules look at."""

    FLOW = "flow"  # the 5-tuple: nothing has to be marked
    MARK = "mark"  # the DSCP: one rule per class, also for what others have marked


class TcSettings(msgspec.Struct, frozen=True, kw_only=True):
    """How a device is to treat the flows.

    Attributes:
        device: network device that the packets leave by, `eth0`.
        link_kbit: rate of the link behind it, kbit/s, 1 or more.
        guaranteed_kbit: rates by class name (`ef`, `5qi85`), kbit/s; must be above burst peaks.
        match: what rules look at.
        queue_ms: how long the queue of each class may become, in the time that the link takes to
            send it, milliseconds, > 0; what finds it full is dropped.
    """

    device: str
    link_kbit: int
    guaranteed_kbit: Mapping[str, int] = msgspec.field(default_factory=dict)
    match: TcMatch = TcMatch.FLOW
    queue_ms: float = DEFAULT_QUEUE_MS

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
    def queue_bytes(self) -> int:
        """How many bytes the queue of each class takes."""
        return max(MIN_QUEUE_BYTES, math.ceil(self.link_kbit * self.queue_ms / 8))


_QUEUE = "2"
"""First hex digit of the handles of queues; the others are the minor number of their class."""

_QUANTUM_BYTES = 3028
"""Two full Ethernet frames; HTB's own guess is too large for fast links and it says so."""

_CLASSES = re.compile(r"managed-by=lifecycle digest=[0-9a-f]+ classes=(?P<digest>[0-9a-f]+)")


class Queues(msgspec.Struct, frozen=True, kw_only=True):
    """What makes a device queue by class.

    Attributes:
        batch: the lines for `tc -batch` where nothing of ours is there.
        table: for `nft -f`; its comment has the digest of the classes.
    """

    batch: str
    table: str
    classes_digest: str


def tc_table_name(system: str, device: str) -> str:
    """Return the name of a device's table, `flowtc_eth0_teleop`.

    Raises:
        ValueError: the system's name is not one that a manifest may have.
    """
    plain = re.sub(r"[^A-Za-z0-9_.-]", "_", device)
    return table_name(system).replace("flowqos_", f"flowtc_{plain}_", 1)


def classes_digest_of(text: str) -> str:
    """Return the digest of the classes that a table's comment names; empty if it names none."""
    match = _CLASSES.search(text)
    return match["digest"] if match else ""


def queues(rules: Iterable[FlowRule], settings: TcSettings, *, system: str) -> Queues:
    """Return what makes a device queue these rules by class.

    Raises:
        ValueError: the rates do not fit the link, or the system's name is not one that a manifest
            may have.
    """
    every = tuple(rules)
    classes = tuple(_htb(classes_of(every), settings))
    actions = [(each, _placed(each)) for each in every if settings.match is TcMatch.FLOW]
    more = tuple(_by_mark(every)) if settings.match is TcMatch.MARK else ()

    def table(comment: str) -> str:
        # After the marks of the system's own table, which are set at `mangle`.
        return render_table(
            tc_table_name(system, settings.device),
            comment,
            actions,
            priority="-149",
            device=settings.device,
            more=more,
        )

    of_classes = _digest(*classes)
    digest = _digest(of_classes, table(""))
    qdisc = (
        f"qdisc add dev {settings.device} root handle {OWNED_HANDLE} htb default {DEFAULT_MINOR:#x}"
    )
    return Queues(
        batch="\n".join((qdisc, *classes)) + "\n",
        table=table(f"managed-by=lifecycle digest={digest} classes={of_classes}"),
        classes_digest=of_classes,
    )


def render_tc(
    rules: Iterable[FlowRule],
    settings: TcSettings,
    *,
    system: str,
    left_out: Sequence[LeftOut] = (),
) -> str:
    """Return a file for `sh FILE` that gives `tc -batch` and `nft -f` their lines.

    Args:
        rules: of verified flows.
        settings: of the device.
        system: names the table.
        left_out: flows without a rule, named in comments.

    Raises:
        ValueError: see `queues`.
    """
    every = tuple(rules)
    made = queues(every, settings, system=system)
    lines = [
        f"# Queues the verified flows of system {system} on {settings.device}: sh FILE",
        *remarks(every, left_out, lambda rule: why_not(rule, settings)),
        "set -e",
        "tc -batch - <<'END'",
        made.batch + "END",
        "nft -f - <<'END'",
        made.table + "END",
    ]
    return "\n".join(lines) + "\n"


def render_tc_removal(device: str) -> str:
    """Return the line for `tc -batch` that removes our qdisc and all below it.

    It fails, and removes nothing, if the device's root qdisc is not ours.
    """
    return f"qdisc del dev {device} root handle {OWNED_HANDLE}\n"


def why_not(rule: FlowRule, settings: TcSettings) -> str:
    """Return why a rule has no class; empty if it has one."""
    if class_of(rule) is None:
        return "it has no DSCP but DF and no 5QI to queue it by, and stays with the rest"
    if rule.dscp is None and settings.match is TcMatch.MARK:
        return "it has no DSCP, and rules look at nothing else here"
    return ""


def _digest(*parts: str) -> str:
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()[:16]


def _placed(rule: FlowRule) -> tuple[Action, ...]:
    """Into the class of a rule."""
    found = class_of(rule)
    if found is None:
        return ()
    return (Action(found.name, _into(found), found.comment),)


def _by_mark(rules: Sequence[FlowRule]) -> Iterator[str]:
    marked = {each.dscp for each in rules if each.dscp}
    for dscp in sorted(marked):
        found = _by_dscp(dscp)
        for network in ("ip", "ip6"):
            yield (
                f"{network} dscp {nft_keyword(dscp)} {_into(found)} "
                f'counter comment "{found.comment}"'
            )


def _into(class_: TrafficClass) -> str:
    return f"meta priority set {OWNED_HANDLE}{class_.minor:x}"


def _htb(classes: Sequence[TrafficClass], settings: TcSettings) -> Iterator[str]:
    device, link_kbit, major = settings.device, settings.link_kbit, OWNED_HANDLE
    rates, rest = divide(classes, link_kbit=link_kbit, guaranteed_kbit=settings.guaranteed_kbit)
    yield (
        f"class replace dev {device} parent {major} classid {major}1 "
        f"htb rate {link_kbit}kbit ceil {link_kbit}kbit quantum {_QUANTUM_BYTES}"
    )
    above = [each for each in classes if not each.below_default]
    below = [each for each in classes if each.below_default]
    leaves = [
        *((each.minor, rates[each.name], min(i, 5), each.comment) for i, each in enumerate(above)),
        (DEFAULT_MINOR, rest, 6, "everything else"),
        *((each.minor, rates[each.name], 7, each.comment) for each in below),
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
