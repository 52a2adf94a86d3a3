"""Traffic control on one device of this host: an owned qdisc at its root, and its nft table.

Owns: when lines are sent, and whose a qdisc is. What the lines say is `rules.tc`. The qdisc's
handle and the table's name are the marks of ownership; any other root qdisc is left alone. Where
the classes change, ours is removed and made anew; where only flows change, the table is replaced.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

from msgspec.structs import replace

from lifecycle.errors import UsageError
from lifecycle.programming.apply.ledger import Ledger, TargetRecord
from lifecycle.programming.apply.target import (
    FlowChange,
    MissingFeatureError,
    NotOursError,
    ProgrammingError,
    TargetChanges,
    deletions,
)
from lifecycle.programming.apply.targets.nft import NftTable, compare, usable
from lifecycle.programming.apply.targets.registry import TargetOptions, Targets
from lifecycle.programming.apply.tool import HostTool, demand, qdiscs
from lifecycle.programming.rules.rules import FlowRule, RuleSet
from lifecycle.programming.rules.tc import (
    OWNED_HANDLE,
    Queues,
    TcMatch,
    TcSettings,
    classes_digest_of,
    queues,
    render_tc,
    render_tc_removal,
    tc_table_name,
    why_not,
)

KIND = "tc"

_BATCH = ("tc", "-batch", "-")
_NO_DEVICE = re.compile(r"cannot find device", re.IGNORECASE)
_RATE = re.compile(r"([0-9]{1,9})(bit|kbit|mbit|gbit)")
_DURATION = re.compile(r"([0-9]{1,6}(?:\.[0-9]{1,3})?)(us|ms|s)")
_MS = {"us": 0.001, "ms": 1.0, "s": 1000.0}
_KBIT = {"bit": 0.001, "kbit": 1, "mbit": 1000, "gbit": 1_000_000}


def parse_rate(text: str) -> int:
    """Return the kbit/s of a rate as tc(8) spells it, `20mbit`.

    Raises:
        ValueError: not such a rate, or below 1 kbit/s.
    """
    match = _RATE.fullmatch(text.strip().lower())
    kbit = int(int(match[1]) * _KBIT[match[2]]) if match else 0
    if kbit < 1:
        raise ValueError(f"cannot use rate {text!r}; use a number and kbit, mbit or gbit: 20mbit")
    return kbit


def parse_queue(text: str) -> float:
    """Return the milliseconds of a time as tc(8) spells it, `50ms`.

    Raises:
        ValueError: not such a time, or zero.
    """
    match = _DURATION.fullmatch(text.strip().lower())
    queue_ms = float(match[1]) * _MS[match[2]] if match else 0.0
    if queue_ms <= 0:
        raise ValueError(f"cannot use queue {text!r}; use a number and us, ms or s: 50ms")
    return queue_ms


class TcTarget:
    """One device.

    Args:
        system: whose flows these are.
        settings: of the device.
        ledger: of the system; says that there is something, for who removes it later.
        tool: runs tc and nft.
    """

    def __init__(
        self, system: str, settings: TcSettings, ledger: Ledger, tool: HostTool | None = None
    ) -> None:
        self._system = system
        self._settings = settings
        self._ledger = ledger
        self._tool = tool or HostTool()
        self._table = NftTable(tc_table_name(system, settings.device), self._tool)

    @property
    def name(self) -> str:
        """The device."""
        return f"tc on {self._settings.device}"

    def plan(self, rules: Sequence[FlowRule]) -> TargetChanges:
        """Compare the device with the rules.

        Raises:
            NotOursError: the device has a root qdisc that is not ours.
            ProgrammingError: there is no such device, or the rates do not fit.
        """
        return self._planned(rules)[0]

    def apply(self, rules: Sequence[FlowRule]) -> TargetChanges:
        """Bring qdisc, classes and table up to date."""
        planned, wanted, listing = self._planned(rules)
        if wanted is None:
            return replace(self.remove(), left_out=planned.left_out)
        recorded = self._recorded()
        if not planned.pending and recorded:
            return planned
        # Written first: a crash in between leaves nothing unknown.
        device = self._settings.device
        self._ledger.put(TargetRecord(target=KIND, scope=device))
        try:
            if classes_digest_of(listing) != wanted.classes_digest:
                if listing or recorded:
                    self._clear()
                self._batch(wanted.batch)
            self._table.write(wanted.table)
        except ProgrammingError as error:
            # `tc -batch` is not atomic: it stops at a line, and what came before stays.
            try:
                if listing or recorded or self._is_ours(self._root()):
                    self._clear()
            except ProgrammingError as left:
                message = f"{error.message}; the qdisc {OWNED_HANDLE} on {device} is left: {left}"
                raise type(error)(message, hint=error.hint) from error
            self._ledger.drop(KIND, device)
            raise
        return planned

    def dry_run(self, rules: Sequence[FlowRule]) -> str:
        """Return the lines for tc and nft; tc itself has no dry run to check them."""
        classed, _ = self._classed(rules)
        text = render_tc(classed, self._settings, system=self._system)
        return f"# Not checked: tc has no dry run.\n{text}"

    def remove(self) -> TargetChanges:
        """Delete the qdisc if it is ours, and with it all below; and its table."""
        ours, recorded = self._is_ours(self._root()), self._recorded()
        if not recorded and not (ours and self._table.listing()):
            return TargetChanges(target=self.name)
        there = [(self._settings.device, "")] if ours or self._table.listing() else []
        self._clear()
        self._ledger.drop(KIND, self._settings.device)
        return deletions(self.name, there)

    def renew(self) -> float | None:
        """A qdisc does not expire."""
        return None

    def _planned(self, rules: Sequence[FlowRule]) -> tuple[TargetChanges, Queues | None, str]:
        """What is to change, what is wanted (None for nothing), and the table as it is."""
        classed, left_out = self._classed(rules)
        ours = self._own_root()
        listing = self._table.listing() if ours else ""
        wanted = None
        changes: tuple[FlowChange, ...] = ()
        if classed:
            try:
                wanted = queues(classed, self._settings, system=self._system)
            except ValueError as error:
                raise MissingFeatureError(str(error)) from error
            detail = ""
            if not ours and self._recorded():
                detail = "the qdisc was gone"
            elif listing and classes_digest_of(listing) != wanted.classes_digest:
                detail = "the classes change"
            changes = compare(listing, wanted.table, classed, detail=detail)
        elif ours:
            changes = deletions(self.name, [(self._settings.device, "")]).changes
        return (
            TargetChanges(target=self.name, changes=changes, left_out=left_out),
            wanted,
            listing,
        )

    def _clear(self) -> None:
        """Delete our qdisc and our table, where they are."""
        if self._is_ours(self._root()):
            self._batch(render_tc_removal(self._settings.device))
        if self._table.listing():
            self._table.remove()

    @staticmethod
    def _is_ours(root: tuple[str, str] | None) -> bool:
        return root is not None and root[1] == OWNED_HANDLE

    def _classed(self, rules: Sequence[FlowRule]) -> tuple[tuple[FlowRule, ...], tuple[str, ...]]:
        return usable(rules, lambda rule: why_not(rule, self._settings))

    def _recorded(self) -> bool:
        return self._ledger.record(KIND, self._settings.device) is not None

    def _root(self) -> tuple[str, str] | None:
        """(kind, handle) of the device's root qdisc; None if there is no such device."""
        device = self._settings.device
        try:
            listed = qdiscs(self._tool, "dev", device, doing=f"read {self.name}")
        except ProgrammingError as error:
            if _NO_DEVICE.search(error.message):
                return None
            raise
        found = next((each for each in listed if each.root), None)
        return (found.kind, found.handle) if found else ("noqueue", "0:")

    def _own_root(self) -> bool:
        """Whether the root qdisc is ours; False if the device has only what the kernel gave it."""
        device = self._settings.device
        root = self._root()
        if root is None:
            raise ProgrammingError(
                f"cannot find device {device!r} on this host", hint="see: ip link"
            )
        kind, handle = root
        if handle == "0:":
            return False
        if handle != OWNED_HANDLE:
            raise NotOursError(
                f"cannot use {self.name}: it has a root qdisc of another owner, {kind} {handle}",
                hint=f"use another device, or remove it: tc qdisc del dev {device} root",
            )
        if not self._recorded() and not self._table.listing():
            raise NotOursError(
                f"cannot use {self.name}: its root qdisc {handle} was made by lifecycle, but not "
                f"for system {self._system!r} of this user",
                hint=f"if nothing uses it any more: tc qdisc del dev {device} root handle {handle}",
            )
        return True

    def _batch(self, lines: str) -> None:
        demand(self._tool, _BATCH, doing=f"program {self.name}", stdin=lines)


class TcOptions(TargetOptions):
    """The options of one device.

    Args:
        settings: read from them.
    """

    kind = KIND
    hint = "give --device eth0 --rate 20mbit"

    def __init__(self, settings: TcSettings) -> None:
        self.settings = settings

    @classmethod
    def read(cls, given: Mapping[str, Any]) -> TcOptions:
        """Read rates, times and classes."""
        rate = given.get("rate")
        try:
            queue_ms = parse_queue(given.get("queue") or "50ms")
            guaranteed = map(_guarantee, given.get("guarantee") or ())
            guaranteed_kbit = {name: parse_rate(text) for name, text in guaranteed}
            device = given.get("device")
            if not device:
                raise UsageError(
                    "cannot program tc without a device; only devices that are named are touched",
                    hint=cls.hint,
                )
            if not rate:
                raise UsageError(
                    "cannot program tc without the rate of the link, which its classes divide",
                    hint=cls.hint,
                )
            settings = TcSettings(
                device=device,
                link_kbit=parse_rate(rate),
                guaranteed_kbit=guaranteed_kbit,
                match=TcMatch(given.get("match") or TcMatch.FLOW.value),
                queue_ms=queue_ms,
            )
        except ValueError as error:
            raise UsageError(str(error)) from error
        return cls(settings)

    @classmethod
    def restore(cls, record: TargetRecord, means: Targets) -> TcTarget:
        """Return the device of a record."""
        return cls(TcSettings(device=record.scope, link_kbit=1)).open(means)

    def open(self, means: Targets) -> TcTarget:
        """Return the device."""
        return TcTarget(means.ledger.system, self.settings, means.ledger)

    def export(self, rules: RuleSet, system: str) -> str:
        """Return the lines for tc and nft."""
        return render_tc(rules.rules, self.settings, system=system, left_out=rules.left_out)


def _guarantee(text: str) -> tuple[str, str]:
    name, equals, rate = text.partition("=")
    if not (name and equals and rate):
        raise ValueError(f"cannot read guarantee {text!r}; write CLASS=RATE, ef=2mbit")
    return name, rate


TARGET = TcOptions
