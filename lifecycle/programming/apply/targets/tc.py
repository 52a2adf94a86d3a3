"""Traffic control on one device of this host: one owned qdisc at its root, and what hangs below it.

Owns: when lines are sent, which ones, and whose a qdisc is. What the lines say is `rules.tc`. The
qdisc's handle is the mark of ownership, the ledger says for which system; any other root qdisc is
left alone.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from lifecycle import dataclasses
from lifecycle.errors import UsageError
from lifecycle.programming.apply.ledger import Entry, Ledger, TargetRecord, digest_of
from lifecycle.programming.apply.target import (
    ChangeKind,
    FlowChange,
    MissingFeatureError,
    NotOursError,
    ProgrammingError,
    TargetChanges,
    deletions,
    describe_rule,
)
from lifecycle.programming.apply.targets.registry import TargetOption, TargetOptions, Targets
from lifecycle.programming.apply.tool import (
    HostTool,
    Tool,
    demand,
    failure,
    qdiscs_of,
    refused,
)
from lifecycle.programming.rules.rules import FlowRule, rules_digest
from lifecycle.programming.rules.tc import (
    CLASSIFIERS,
    DEFAULT_QUEUE_MS,
    OWNED_HANDLE,
    QDISCS,
    TcFeatures,
    TcFilter,
    TcMatch,
    TcSettings,
    anchors,
    class_of,
    render_tc,
    render_tc_removal,
    tc_filters,
)

KIND = "tc"

_BATCH = ("tc", "-batch", "-")
_HARMLESS = "qdisc add dev lo root handle 1: pfifo\n"
"""Every kernel with traffic control has pfifo (net/sched/sch_fifo.c), so only privilege fails."""

_NO_DEVICE = re.compile(r"cannot find device", re.IGNORECASE)
_NEW_CLASS = re.compile(rf" classid ({re.escape(OWNED_HANDLE)}[0-9a-f]+) ")
_CLASS_ID = re.compile(rf"^class htb ({re.escape(OWNED_HANDLE)}[0-9a-f]+) ", re.MULTILINE)
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


def probe_features(tool: Tool) -> TcFeatures | None:
    """Ask the kernel what it has, in a network namespace that is thrown away.

    Returns:
        What it has; None where this user may not make a namespace, so that only trying shows it.
    """
    for unshare in (("unshare", "-n"), ("unshare", "-Urn")):
        # Root whose CAP_NET_ADMIN was taken away makes a namespace that it may change nothing in:
        # what fails there would say nothing of the kernel.
        try:
            tried = tool.run([*unshare, *_BATCH], stdin=_HARMLESS)
        except MissingFeatureError:
            return None
        if tried.returncode == 0 or not refused(tried, by="unshare"):
            break
    else:
        return None

    def works(*lines: str) -> bool:
        text = "\n".join(lines) + "\n"
        return tool.run([*unshare, *_BATCH], stdin=text).returncode == 0

    def root(qdisc: str) -> str:
        return f"qdisc add dev lo root handle 1: {qdisc}"

    qdiscs = tuple(each for each in QDISCS if works(root(each)))
    matches = {"flower": "ip_proto udp", "u32": "match u8 0 0 at 0"}
    targets = {"flower": "classid", "u32": "flowid"}
    classifiers = tuple(
        each
        for each in CLASSIFIERS
        if qdiscs
        and works(
            root(qdiscs[0]),
            f"filter add dev lo parent 1: protocol ip pref 1 {each} {matches[each]} "
            f"{targets[each]} 1:1",
        )
    )
    return TcFeatures(qdiscs=qdiscs, classifiers=classifiers)


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class _Wanted:
    """What should be on the device.

    Attributes:
        qdisc: "htb" or "prio".
        fresh: lines of the qdisc and its classes where there are none.
        there: the same where there are some: they replace.
        anchors: lines of the filters that only hold a place.
        filters: (filter, what it is for) of each flow or mark.
    """

    qdisc: str
    fresh: tuple[str, ...]
    there: tuple[str, ...]
    anchors: tuple[str, ...]
    filters: tuple[tuple[TcFilter, str], ...]

    @property
    def digest(self) -> str:
        """Distinguishes one structure of classes from another."""
        return digest_of(*self.fresh)

    @property
    def entries(self) -> tuple[Entry, ...]:
        """The filters as the ledger keeps them, each with the line that deletes it."""
        return tuple(
            Entry(
                key=each.key,
                digest=digest_of(each.line),
                what=what,
                id=str(each.number),
                body=each.removal,
            )
            for each, what in self.filters
        )


class TcTarget:
    """One device.

    Args:
        system: whose flows these are.
        settings: of the device; its features are replaced by what the kernel has.
        ledger: of the system.
        tool: runs tc.
    """

    def __init__(
        self, system: str, settings: TcSettings, ledger: Ledger, tool: Tool | None = None
    ) -> None:
        self._system = system
        self._settings = settings
        self._ledger = ledger
        self._tool = tool or HostTool()
        self._probed = False

    @property
    def name(self) -> str:
        """The device."""
        return f"tc on {self._settings.device}"

    def plan(self, rules: Sequence[FlowRule]) -> TargetChanges:
        """Compare the device with the rules.

        Raises:
            NotOursError: the device has a root qdisc that is not ours.
            MissingFeatureError: the kernel lacks what is needed.
            ProgrammingError: there is no such device, or the rates do not fit.
        """
        classed, left_out = self._classed(rules)
        record = self._record()
        root = self._own_root(record)
        wanted = self._wanted(classed, record) if classed else None
        detail = self._unexpected(record, wanted, root)
        before = {each.key: each for each in record.entries} if root else {}
        changes = []
        for entry in () if wanted is None else wanted.entries:
            old = before.pop(entry.key, None)
            kind = ChangeKind.CREATE
            if old is not None:
                same = old.digest == entry.digest and not detail
                kind = ChangeKind.KEEP if same else ChangeKind.UPDATE
            why = detail if old is not None or not root else ""
            changes.append(FlowChange(kind=kind, key=entry.key, what=entry.what, detail=why))
        changes += [
            FlowChange(kind=ChangeKind.DELETE, key=each.key, what=each.what)
            for each in before.values()
        ]
        return TargetChanges(target=self.name, changes=tuple(changes), left_out=left_out)

    def apply(self, rules: Sequence[FlowRule]) -> TargetChanges:
        """Bring qdisc, classes and filters up to date."""
        planned = self.plan(rules)
        classed, _ = self._classed(rules)
        if not classed:
            self.remove()
            return planned
        record = self._record()
        wanted = self._wanted(classed, record)
        if not planned.pending and record.digest == wanted.digest:
            return planned
        root = self._own_root(record)
        entries = wanted.entries
        stale = tuple(each for each in record.entries if each.body not in _bodies(entries))
        made = TargetRecord(target=KIND, scope=self._settings.device, digest=wanted.digest)
        # Written first, with what is still there: a crash in between leaves nothing unknown.
        self._ledger.put(dataclasses.replace(made, entries=(*_without(stale, entries), *entries)))
        if root and (root != wanted.qdisc or self._altered(record)):
            # What is there cannot be changed into what is wanted, or is not known: start again.
            self._start_again(record)
            root = ""
        try:
            self._batch(
                [
                    *(wanted.there if root else wanted.fresh),
                    *wanted.anchors,
                    *(each.line for each, _ in wanted.filters),
                ]
            )
            if root:
                self._delete(stale)
                self._delete_classes(wanted)
        except ProgrammingError as error:
            raise self._stopped_half_way(error, root) from error
        self._ledger.put(dataclasses.replace(made, entries=entries, seen=self._seen()))
        return planned

    def _start_again(self, record: TargetRecord) -> None:
        """Delete our qdisc, to make it anew."""
        try:
            self._batch([render_tc_removal(self._settings.device).strip()])
        except ProgrammingError:
            self._ledger.put(record)  # as it was
            raise

    def _stopped_half_way(self, error: ProgrammingError, root: str) -> ProgrammingError:
        """Take back what a batch began, and return the error that says what is left.

        `tc -batch` is not atomic: it stops at the line that fails, and what came before stays.

        Args:
            error: why it stopped.
            root: the kind of our qdisc that was there before; empty where there was none.
        """
        device = self._settings.device
        if root:
            message = (
                f"{error.message}; the qdisc {OWNED_HANDLE} on {device} is left half-changed, and "
                "made anew the next time"
            )
            return type(error)(message, hint=error.hint)
        try:
            found = self._root()
            if found is not None and found[1] == OWNED_HANDLE:
                self._batch([render_tc_removal(device).strip()])
        except ProgrammingError as left:
            message = f"{error.message}; the qdisc {OWNED_HANDLE} on {device} is left: {left}"
            return type(error)(message, hint=error.hint)
        self._ledger.drop(KIND, device)
        return error

    def dry_run(self, rules: Sequence[FlowRule]) -> str:
        """Return the lines for `tc -batch`; tc itself has no dry run to check them."""
        classed, _ = self._classed(rules)
        self._probe()
        text = self._render(classed, with_qdisc=True)
        return f"# Not checked: tc has no dry run.\n{text}"

    def remove(self) -> TargetChanges:
        """Delete the qdisc if it is ours, and with it all below."""
        record = self._record()
        if not record.digest:
            return TargetChanges(target=self.name)
        entries: list[tuple[str, str]] = []
        if self._root() is not None and self._own_root(record):
            entries = [(each.key, each.what) for each in record.entries]
            self._batch([render_tc_removal(self._settings.device).strip()])
        self._ledger.drop(KIND, self._settings.device)
        return deletions(self.name, entries)

    def renew(self) -> float | None:
        """A qdisc does not expire."""
        return None

    def _classed(self, rules: Sequence[FlowRule]) -> tuple[tuple[FlowRule, ...], tuple[str, ...]]:
        classed = []
        left_out = []
        for rule in rules:
            if class_of(rule) is None:
                left_out.append(f"{rule.key}: it has no DSCP but DF and no 5QI to queue it by")
            elif rule.dscp is None and self._settings.match is TcMatch.MARK:
                left_out.append(f"{rule.key}: it has no DSCP, and filters look at nothing else")
            else:
                classed.append(rule)
        return tuple(classed), tuple(left_out)

    def _wanted(self, rules: Sequence[FlowRule], record: TargetRecord) -> _Wanted:
        self._probe()
        numbers = {each.key: int(each.id) for each in record.entries}
        described = {rule.key: describe_rule(rule) for rule in rules}
        try:
            return _Wanted(
                qdisc=self._settings.features.qdisc(self._settings.link_kbit),
                fresh=_structure(self._render(rules, with_qdisc=True)),
                there=_structure(self._render(rules, with_qdisc=False)),
                anchors=tuple(each.line for each in anchors(self._settings)),
                filters=tuple(
                    (each, described.get(each.key, ""))
                    for each in tc_filters(rules, self._settings, numbers=numbers)
                ),
            )
        except ValueError as error:
            raise MissingFeatureError(str(error)) from error

    def _render(self, rules: Sequence[FlowRule], *, with_qdisc: bool) -> str:
        return render_tc(
            rules,
            self._settings,
            system=self._system,
            digest=rules_digest(rules),
            with_qdisc=with_qdisc,
        )

    def _probe(self) -> None:
        if not self._probed:
            found = probe_features(self._tool)
            if found is not None:
                self._settings = dataclasses.replace(self._settings, features=found)
            self._probed = True

    def _record(self) -> TargetRecord:
        record = self._ledger.record(KIND, self._settings.device)
        return record or TargetRecord(target=KIND, scope=self._settings.device)

    def _root(self) -> tuple[str, str] | None:
        """(kind, handle) of the device's root qdisc; None if there is no such device."""
        device = self._settings.device
        argv = ["tc", "-j", "qdisc", "show", "dev", device]
        output = self._tool.run(argv)
        if output.returncode != 0:
            if _NO_DEVICE.search(output.stderr):
                return None
            raise failure(output, argv, doing=f"read {self.name}")
        listed = qdiscs_of(output.stdout, argv, doing=f"read {self.name}")
        found = next((each for each in listed if each.root), None)
        return (found.kind, found.handle) if found else ("noqueue", "0:")

    def _own_root(self, record: TargetRecord) -> str:
        """The kind of our root qdisc; empty if the device has only what the kernel gave it."""
        device = self._settings.device
        root = self._root()
        if root is None:
            raise ProgrammingError(
                f"cannot find device {device!r} on this host", hint="see: ip link"
            )
        kind, handle = root
        if handle == "0:":
            return ""
        if handle == OWNED_HANDLE and record.digest:
            return kind
        if handle == OWNED_HANDLE:
            raise NotOursError(
                f"cannot use {self.name}: its root qdisc {handle} was made by lifecycle, but not "
                f"for system {self._system!r} of this user",
                hint=f"if nothing uses it any more: tc qdisc del dev {device} root handle {handle}",
            )
        raise NotOursError(
            f"cannot use {self.name}: it has a root qdisc of another owner, {kind} {handle}",
            hint=f"use another device, or remove it: tc qdisc del dev {device} root",
        )

    def _unexpected(self, record: TargetRecord, wanted: _Wanted | None, root: str) -> str:
        """Why what is there is not what was made; empty if it is."""
        if not record.digest:
            return ""
        if not root:
            return "the qdisc was gone"
        if altered := self._altered(record):
            return altered
        if wanted is not None and record.digest != wanted.digest:
            return "the classes change"
        return ""

    def _altered(self, record: TargetRecord) -> str:
        """Why what is there is not known; empty if it is as it was made."""
        if not record.seen:
            return "an earlier attempt did not finish"
        return "it was changed by others" if record.seen != self._seen() else ""

    def _seen(self) -> str:
        """A digest of our classes, queues and filters, as tc shows them without counters."""
        device = self._settings.device
        qdiscs = self._read(["tc", "qdisc", "show", "dev", device]).splitlines()
        queues = [each for each in qdiscs if f" parent {OWNED_HANDLE}" in each]
        classes = self._read(["tc", "class", "show", "dev", device])
        filters = self._read(["tc", "filter", "show", "dev", device, "parent", OWNED_HANDLE])
        # The kernel lists classes in the order of a hash table.
        return digest_of(*sorted(queues), *sorted(classes.splitlines()), filters)

    def _delete(self, entries: Iterable[Entry]) -> None:
        lines = [each.body for each in entries]
        if lines:
            self._batch(lines)

    def _delete_classes(self, wanted: _Wanted) -> None:
        """Delete the classes that no rule needs any more; only htb has classes that can go."""
        device = self._settings.device
        needed = {match[1] for line in wanted.fresh if (match := _NEW_CLASS.search(line))}
        listed = self._read(["tc", "class", "show", "dev", device])
        unused = [each for each in _CLASS_ID.findall(listed) if each not in needed]
        if unused:
            self._batch([f"class del dev {device} classid {each}" for each in unused])

    def _read(self, argv: Sequence[str]) -> str:
        return demand(self._tool, argv, doing=f"read {self.name}")

    def _batch(self, lines: Sequence[str]) -> None:
        text = "\n".join(lines) + "\n"
        demand(self._tool, _BATCH, doing=f"program {self.name}", stdin=text)


def _structure(text: str) -> tuple[str, ...]:
    """The lines of the qdisc and its classes."""
    return tuple(each for each in text.splitlines() if each.startswith(("qdisc ", "class ")))


def _bodies(entries: Iterable[Entry]) -> set[str]:
    return {each.body for each in entries}


def _without(stale: Iterable[Entry], entries: Iterable[Entry]) -> tuple[Entry, ...]:
    """The entries whose key no new entry has."""
    keys = {each.key for each in entries}
    return tuple(each for each in stale if each.key not in keys)


class TcOptions(TargetOptions):
    """The options of one device.

    Args:
        settings: read from them.
    """

    kind = KIND
    hint = "give --device eth0"
    takes = (
        TargetOption(flag="--device", metavar="DEV", help="tc: the device, eth0."),
        TargetOption(flag="--rate", metavar="RATE", help="tc: rate of the link behind it, 20mbit."),
        TargetOption(
            flag="--guarantee",
            metavar="CLASS=RATE",
            multiple=True,
            help="tc: rate of a class, ef=2mbit; above its burst peak.",
        ),
        TargetOption(
            flag="--queue",
            metavar="TIME",
            needs="rate",
            why="how long it is follows from both",
            help="tc: how long the queue of a class may become at that rate; else 50ms.",
        ),
        TargetOption(
            flag="--match",
            choices=("flow", "mark"),
            default="flow",
            help="tc: look at 5-tuples, or at what is marked.",
        ),
    )

    def __init__(self, settings: TcSettings) -> None:
        self.settings = settings

    @classmethod
    def read(cls, given: Mapping[str, Any]) -> TcOptions:
        """Read rates, times and classes."""
        rate, queue = given.get("rate"), given.get("queue")
        try:
            link_kbit = parse_rate(rate) if rate else None
            queue_ms = parse_queue(queue) if queue else DEFAULT_QUEUE_MS
            guaranteed = map(_guarantee, given.get("guarantee", ()))
            guaranteed_kbit = {name: parse_rate(text) for name, text in guaranteed}
            device = given.get("device")
            if not device:
                raise UsageError(
                    "cannot program tc without a device; only devices that are named are touched",
                    hint=cls.hint,
                )
            settings = TcSettings(
                device=device,
                link_kbit=link_kbit,
                guaranteed_kbit=guaranteed_kbit,
                match=TcMatch(given.get("match", TcMatch.FLOW.value)),
                queue_ms=queue_ms,
            )
        except ValueError as error:
            raise UsageError(str(error)) from error
        return cls(settings)

    @classmethod
    def restore(cls, record: TargetRecord, means: Targets) -> TcTarget:
        """Return the device of a record."""
        return cls(TcSettings(device=record.scope)).open(means)

    def open(self, means: Targets) -> TcTarget:
        """Return the device."""
        return TcTarget(means.ledger.system, self.settings, means.ledger, means.tool)

    def exported(self) -> Mapping[str, Any]:
        """Return the settings of the device."""
        return {self.kind: self.settings}


def _guarantee(text: str) -> tuple[str, str]:
    name, equals, rate = text.partition("=")
    if not (name and equals and rate):
        raise ValueError(f"cannot read guarantee {text!r}; write CLASS=RATE, ef=2mbit")
    return name, rate


TARGET = TcOptions
