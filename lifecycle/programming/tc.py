"""tc on one device of this host: an htb class for each class of flows, which nft puts packets into.

Owns: the qdisc `1f10:` at the root of a device; which classes a link has for a set of rules: the
ranking of DSCPs and 5QIs and how the link's rate is divided; the classes' queues; and what the
table `inet flowtc_<device>_<system>` puts into which class. The handle is the mark of ownership:
any other root qdisc is left alone. Where the classes change, ours is removed and made anew; where
only flows change, the table is replaced.

The kernel's own queues do not rank by DSCP as people expect: pfifo_fast and prio put EF, CS6 and DF
into one band. So each class of the rules gets a queue of its own here.

htb takes a packet whose priority (SO_PRIORITY, `meta priority` of nft) is the id of one of its
classes into that class (sch_htb.c, htb_classify), so no filter of tc is needed. nft sees packets
that this host sends before they are cut into fragments, and all fragments keep the priority. A
router sees ports in first fragments only: match by mark there.
"""

from __future__ import annotations

import enum
import math
import re
import shlex
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import msgspec

from lifecycle.codec import from_json
from lifecycle.errors import UsageError
from lifecycle.network.dscp import describe, dscp_name, parse_dscp
from lifecycle.network.five_qi import five_qi_of
from lifecycle.programming import host
from lifecycle.programming.ledger import TargetRecord
from lifecycle.programming.rules import FlowRule
from lifecycle.programming.target import Means, ProgrammingError

OWNED_HANDLE = "1f10:"
"""The root qdisc with this handle is ours, whichever device it is on."""

DEFAULT_MINOR = 0xFFF
"""Minor number of the class that everything else goes to."""

DEFAULT_QUEUE_MS = 50.0
"""How long the queue of each class may become. Without a bound of its own it is a thousand packets
(txqueuelen): measured on a link of 20 Mbit/s at 120 % load, bulk then waited 569 ms, and
49 ms with this; a UDP datagram of 64 kB still arrives whole."""

MIN_QUEUE_BYTES = 66_000
"""Room for one UDP datagram of the largest size in its fragments: a shorter queue would let none
through, however often it is sent."""

_FIRST = tuple(map(parse_dscp, ("EF", "VA")))
"""Expedited forwarding and voice-admit come before everything (RFC 3246, RFC 5865)."""

_LOWEST = tuple(map(parse_dscp, ("LE", "CS1")))
"""Less than best effort (RFC 8622, RFC 4594 §4.10)."""

_RANK_FIRST, _RANK_GBR, _RANK_MARKED, _RANK_NON_GBR, _RANK_DEFAULT, _RANK_LOWEST = range(6)

_QUEUE = "2"
"""First hex digit of the handles of queues; the others are the minor number of their class."""

_QUANTUM_BYTES = 3028
"""Two full Ethernet frames; HTB's own guess is too large for fast links and it says so."""

_LONGEST_QUEUE_MS = 10_000
_DEVICE = re.compile(r"[^\s/:#\"*]{1,15}")
_NO_DEVICE = re.compile(r"cannot find device", re.IGNORECASE)
_QUANTITY = re.compile(r"([0-9]{1,9}(?:\.[0-9]{1,3})?)([a-z]+)")
_KBIT = {"bit": 0.001, "kbit": 1, "mbit": 1000, "gbit": 1_000_000}
_MS = {"us": 0.001, "ms": 1.0, "s": 1000.0}


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


def parse_rate(text: str) -> int:
    """Return the kbit/s of a rate as tc(8) spells it, `20mbit`.

    Raises:
        ValueError: not such a rate, or below 1 kbit/s.
    """
    kbit = int(_quantity(text, _KBIT))
    if kbit < 1:
        raise ValueError(f"cannot use rate {text!r}; use a number and kbit, mbit or gbit: 20mbit")
    return kbit


def parse_queue(text: str) -> float:
    """Return the milliseconds of a time as tc(8) spells it, `50ms`.

    Raises:
        ValueError: not such a time, or zero.
    """
    queue_ms = _quantity(text, _MS)
    if queue_ms <= 0:
        raise ValueError(f"cannot use queue {text!r}; use a number and us, ms or s: 50ms")
    return queue_ms


def _quantity(text: str, units: Mapping[str, float]) -> float:
    """A number with a unit behind it; 0 if it is no such thing."""
    match = _QUANTITY.fullmatch(text.strip().lower())
    return float(match[1]) * units.get(match[2], 0.0) if match else 0.0


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


_REST = TrafficClass(
    rank=(_RANK_DEFAULT, 0), name="everything else", minor=DEFAULT_MINOR, comment="everything else"
)


def class_of(rule: FlowRule) -> TrafficClass | None:
    """Return the class of a rule, by its DSCP or else its 5QI; None if it stays with the rest.

    DF is the rest itself.
    """
    if rule.dscp:
        name = dscp_name(rule.dscp).lower()
        group = _RANK_LOWEST if rule.dscp in _LOWEST else _RANK_MARKED
        return TrafficClass(
            rank=(_RANK_FIRST if rule.dscp in _FIRST else group, -rule.dscp),
            name=f"dscp{name}" if name.isdecimal() else name,
            minor=0x100 + rule.dscp,
            comment=describe(rule.dscp),
        )
    if rule.dscp is None and rule.five_qi is not None:
        five_qi = five_qi_of(rule.five_qi)
        group = _RANK_GBR if five_qi.resource_type.guarantees_rate else _RANK_NON_GBR
        return TrafficClass(
            rank=(group, five_qi.priority_level),
            name=f"5qi{rule.five_qi}",
            minor=0x200 + rule.five_qi,
            comment=str(five_qi),
        )
    return None


def classes_of(rules: Iterable[FlowRule]) -> tuple[TrafficClass, ...]:
    """Return the classes of the rules, each once, the one to serve first in front."""
    return tuple(sorted({found for rule in rules if (found := class_of(rule)) is not None}))


def divide(
    classes: Sequence[TrafficClass], *, link_kbit: int, guaranteed_kbit: Mapping[str, int] = {}
) -> dict[TrafficClass, int]:
    """Return the guaranteed rate of each class and of the rest, in kbit/s, the first in front.

    Classes without a given rate share what is left equally with the rest; those below the rest
    get a hundredth of the link, so that they do not starve.

    Args:
        classes: of the link.
        link_kbit: rate of the link, kbit/s: a little below the real one, or its queue is elsewhere.
        guaranteed_kbit: rates by class name, kbit/s. A prioritised class needs more than its burst
            peak, or it queues behind itself.

    Raises:
        ValueError: an unknown class has a rate, or there is not enough.
    """
    names = [each.name for each in classes]
    for name in guaranteed_kbit:
        if name not in names:
            raise ValueError(
                f"cannot guarantee a rate to class {name!r}; classes of these rules are: "
                f"{', '.join(names) or 'none'}"
            )
    every = sorted((*classes, _REST))
    given = {
        each: guaranteed_kbit.get(each.name, max(1, link_kbit // 100))
        for each in every
        if each.below_default or each.name in guaranteed_kbit
    }
    others = [each for each in every if each not in given]
    left = link_kbit - sum(given.values())
    share = left // len(others)
    if share < 1:
        rates = ", ".join(f"{each.name} {rate}" for each, rate in given.items())
        raise ValueError(
            f"cannot guarantee {sum(given.values())} kbit/s ({rates}) on a link of "
            f"{link_kbit} kbit/s: something must be left for "
            f"{', '.join(each.name for each in others)}"
        )
    found = {each: given.get(each, share) for each in every}
    found[_REST] += left - share * len(others)
    return found


def _htb(classes: Sequence[TrafficClass], settings: TcSettings) -> Iterator[str]:
    device, link_kbit, major = settings.device, settings.link_kbit, OWNED_HANDLE
    rates = divide(classes, link_kbit=link_kbit, guaranteed_kbit=settings.guaranteed_kbit)
    yield (
        f"class replace dev {device} parent {major} classid {major}1 "
        f"htb rate {link_kbit}kbit ceil {link_kbit}kbit quantum {_QUANTUM_BYTES}"
    )
    for index, (class_, rate) in enumerate(rates.items()):
        minor = class_.minor
        prio = 7 if class_.below_default else 6 if class_ is _REST else min(index, 5)
        yield f"# class {major}{minor:x}: {class_.comment}"
        yield (
            f"class replace dev {device} parent {major}1 classid {major}{minor:x} "
            f"htb rate {rate}kbit ceil {link_kbit}kbit prio {prio} quantum {_QUANTUM_BYTES}"
        )
        yield (
            f"qdisc replace dev {device} parent {major}{minor:x} handle {_QUEUE}{minor:03x}: "
            f"bfifo limit {settings.queue_bytes}"
        )


class Qdisc(msgspec.Struct, frozen=True, kw_only=True):
    """What is read of a queueing discipline in the list of `tc -j qdisc show`."""

    kind: str
    dev: str = ""
    handle: str = "0:"
    root: bool = False


async def qdiscs(tool: host.HostTool, *options: str, doing: str) -> tuple[Qdisc, ...]:
    """Return the queueing disciplines that `tc -j qdisc show` lists.

    Raises:
        ProgrammingError: it failed, or what it prints is no such list.
    """
    argv = ("tc", "-j", "qdisc", "show", *options)
    text = await host.demand(tool, argv, doing=doing)
    try:
        return from_json(text.strip() or "[]", tuple[Qdisc, ...])
    except ValueError as error:
        raise ProgrammingError(
            f"cannot {doing}: what {shlex.join(argv)!r} prints is no list of qdiscs: {error}",
            hint="look at what it prints, and which program that is",
        ) from error


class TcTarget(host.TableTarget):
    """One device."""

    kind = "tc"
    takes = ("device", "rate", "guarantee", "queue", "match")
    hint = "give --device eth0 --rate 20mbit"

    def __init__(
        self, settings: TcSettings, means: Means, tool: host.HostTool | None = None
    ) -> None:
        self._device = settings.device
        device = re.sub(r"[^A-Za-z0-9_.-]", "_", self._device)
        table = host.table_name(means.ledger.system, f"flowtc_{device}")
        super().__init__(settings, means, tool, table=table, scope=self._device)
        self.name = f"tc on {self._device}"

    @classmethod
    def read(cls, given: Mapping[str, Any]) -> TcSettings:
        """Read rates, times and classes."""
        try:
            queue_ms = parse_queue(given.get("queue") or f"{DEFAULT_QUEUE_MS:g}ms")
            guaranteed_kbit = dict(map(_guarantee, given.get("guarantee") or ()))
            if not given.get("device"):
                raise UsageError(
                    "cannot program tc without a device; only devices that are named are touched",
                    hint=cls.hint,
                )
            if not given.get("rate"):
                raise UsageError(
                    "cannot program tc without the rate of the link, which its classes divide",
                    hint=cls.hint,
                )
            return TcSettings(
                device=given["device"],
                link_kbit=parse_rate(given["rate"]),
                guaranteed_kbit=guaranteed_kbit,
                match=TcMatch(given.get("match") or TcMatch.FLOW),
                queue_ms=queue_ms,
            )
        except ValueError as error:
            raise UsageError(str(error)) from error

    @classmethod
    def restore(cls, record: TargetRecord) -> TcSettings:
        """Return the device of a record."""
        return TcSettings(device=record.scope, link_kbit=1)

    def lines(self, rule: FlowRule) -> Sequence[str]:
        """Return what puts its packets into their class."""
        class_ = class_of(rule)
        if class_ is None:
            raise ValueError(
                "it has no DSCP but DF and no 5QI to queue it by, and stays with the rest"
            )
        matches, comment = [host.flow_match(rule)], f"{class_.comment}: {rule.named}"
        if self._settings.match is TcMatch.MARK:
            if rule.dscp is None:
                raise ValueError("it has no DSCP, and rules look at nothing else here")
            matches = [f"{each} dscp {rule.dscp}" for each in ("ip", "ip6")]
            comment = class_.comment
        statement = f"meta priority set {OWNED_HANDLE}{class_.minor:x}"
        out = f'oifname "{self._device}"'
        return [host.chain_line(f"{out} {match}", statement, comment) for match in matches]

    def wanted(self, placed: host.Placed) -> host.Wanted:
        """Return lines for `tc -batch`, and the table."""
        table = host.render_table(
            self._table,
            (each for _, lines in placed for each in lines),
            priority="-149",  # after the marks of the system's own table, which are set at `mangle`
        )
        root = f"dev {self._device} root handle {OWNED_HANDLE}"
        classes = _htb(classes_of(rule for rule, _ in placed), self._settings)
        qdisc = f"qdisc add {root} htb default {DEFAULT_MINOR:#x}"
        return host.Wanted(table, beside="\n".join((qdisc, *classes, "")))

    def script(self, wanted: host.Wanted, remarks: Sequence[str]) -> str:
        """Return a file for `sh FILE` that gives `tc -batch` and `nft -f` their lines."""
        system = self._ledger.system
        lines = [
            f"# Queues the verified flows of system {system} on {self._device}: sh FILE",
            *remarks,
            "set -e",
            "tc -batch - <<'END'",
            f"{wanted.beside}END",
            "nft -f - <<'END'",
            f"{wanted.table}END",
            "",
        ]
        return "\n".join(lines)

    async def found(self) -> bool:
        """Whether the device has our qdisc, and there is our table."""
        return await self._own_root() and await self.has_table()

    async def write(self, wanted: host.Wanted, *, anew: bool) -> None:
        """Write the table, and before it the qdisc and its classes anew."""
        if anew:
            if await self.has_begun():
                await self.clear()
            await self._batch(wanted.beside)
        await self.write_table(wanted.table)

    async def clear(self) -> bool:
        """Delete our qdisc and our table, where they are."""
        ours = await self.has_begun()
        if ours:
            await self._batch(f"qdisc del dev {self._device} root handle {OWNED_HANDLE}\n")
        return await super().clear() or ours

    async def _root(self) -> Qdisc | None:
        """The device's root qdisc; None if there is no such device."""
        try:
            listed = await qdiscs(self._tool, "dev", self._device, doing=f"read {self.name}")
        except ProgrammingError as error:
            if _NO_DEVICE.search(error.message):
                return None
            raise
        return next((each for each in listed if each.root), Qdisc(kind="noqueue"))

    async def has_begun(self) -> bool:
        """Whether the device has our qdisc."""
        root = await self._root()
        return root is not None and root.handle == OWNED_HANDLE

    async def _own_root(self) -> bool:
        """Whether the root qdisc is ours; False if the device has only what the kernel gave it."""
        device, root = self._device, await self._root()
        if root is None:
            raise ProgrammingError(
                f"cannot find device {device!r} on this host", hint="see: ip link"
            )
        if root.handle == "0:":
            return False
        if root.handle != OWNED_HANDLE:
            raise ProgrammingError(
                f"cannot use {self.name}: it has a root qdisc of another owner, {root.kind} "
                f"{root.handle}",
                hint=f"use another device, or remove it: tc qdisc del dev {device} root",
            )
        if self._ledger.find(self._record) is None and not await self.has_table():
            raise ProgrammingError(
                f"cannot use {self.name}: its root qdisc {root.handle} was made by lifecycle, but "
                f"not for system {self._ledger.system!r} of this user",
                hint="if nothing uses it any more: "
                f"tc qdisc del dev {device} root handle {root.handle}",
            )
        return True

    async def _batch(self, lines: str) -> None:
        doing = f"program {self.name}"
        await host.demand(self._tool, ("tc", "-batch", "-"), doing=doing, stdin=lines)


def _guarantee(text: str) -> tuple[str, int]:
    name, equals, rate = text.partition("=")
    if not (name and equals and rate):
        raise ValueError(f"cannot read guarantee {text!r}; write CLASS=RATE, ef=2mbit")
    return name, parse_rate(rate)


TARGET = TcTarget
