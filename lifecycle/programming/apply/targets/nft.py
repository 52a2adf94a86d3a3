"""Applies an nftables ruleset on this host: one owned table, replaced in one transaction.

Owns: when the table is written, and whose it is. Its contents are `rules.nftables`.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

from lifecycle.errors import UsageError
from lifecycle.programming.apply.ledger import Entry, Ledger, TargetRecord, digest_of
from lifecycle.programming.apply.target import (
    ChangeKind,
    FlowChange,
    NotOursError,
    PrivilegeError,
    ProgrammingError,
    TargetChanges,
    deletions,
    describe_rule,
)
from lifecycle.programming.apply.targets.registry import TargetOptions, Targets
from lifecycle.programming.apply.tool import HostTool, Tool, demand, failure, qdiscs_of
from lifecycle.programming.rules.nftables import (
    FAMILY,
    parse_managed_comment,
    render_nft,
    render_nft_removal,
    table_name,
)
from lifecycle.programming.rules.rules import FlowRule, rules_digest

KIND = "nft"

_COUNTS = re.compile(r"counter packets \d+ bytes \d+")
_NONE_SUCH = re.compile(r"No such file or directory", re.IGNORECASE)

_BAND_QDISCS = ("pfifo_fast", "prio")
"""They sort by the old TOS bits, where EF, CS6 and DF share the middle band and AF*1 the worst."""


class NftTarget:
    """The table of one system.

    Args:
        system: names the table.
        ledger: of the system.
        tool: runs nft.
    """

    def __init__(self, system: str, ledger: Ledger, tool: Tool | None = None) -> None:
        self._system = system
        self._table = table_name(system)
        self._ledger = ledger
        self._tool = tool or HostTool()

    @property
    def name(self) -> str:
        """The table."""
        return f"nft table {FAMILY} {self._table}"

    def plan(self, rules: Sequence[FlowRule]) -> TargetChanges:
        """Compare the table with the rules.

        Raises:
            NotOursError: a table of this name is not ours.
            PrivilegeError: reading needs the same privilege as writing.
        """
        marking, left_out = _marking(rules)
        return TargetChanges(
            target=self.name,
            changes=self._compare(marking),
            left_out=left_out,
            warnings=self._warnings() if marking else (),
        )

    def apply(self, rules: Sequence[FlowRule]) -> TargetChanges:
        """Replace the table if anything differs."""
        marking, _ = _marking(rules)
        if not marking:
            return self._nothing_to_mark(rules)
        planned = self.plan(rules)
        if not planned.pending:
            return planned
        text = self._text(marking)
        before = self._ledger.record(KIND, self._table)
        # Written first: a crash in between leaves an entry without a table, which is harmless.
        self._ledger.put(self._record(marking, seen=""))
        try:
            self._write(text)
        except ProgrammingError:
            # nft takes a ruleset whole or not at all, so all is as it was.
            self._ledger.restore(KIND, self._table, before)
            raise
        self._ledger.put(self._record(marking, seen=digest_of(_steady(self._listing()))))
        return planned

    def dry_run(self, rules: Sequence[FlowRule]) -> str:
        """Return the ruleset, checked by nft itself.

        Where this user may not even check, nft is asked in a user namespace of its own. A kernel
        that allows neither leaves the text unchecked, which is said in its first line.

        Raises:
            ProgrammingError: nft refuses the ruleset.
        """
        text = self._text(_marking(rules)[0])
        check = ["nft", "-c", "-f", "-"]
        output = self._tool.run(check, stdin=text)
        if output.returncode == 0:
            return text
        error = failure(output, check, doing=f"check {self.name}")
        if not isinstance(error, PrivilegeError):
            raise error
        alone = self._tool.run(["unshare", "-Urn", *check], stdin=text)
        if alone.returncode == 0:
            return text
        refused = failure(alone, ["unshare", "-Urn", *check], doing=f"check {self.name}")
        if not isinstance(refused, PrivilegeError):
            raise refused
        return f"# Not checked: this kernel allows no user namespaces.\n{text}"

    def remove(self) -> TargetChanges:
        """Delete the table if it is ours."""
        record = self._ledger.record(KIND, self._table)
        listing = self._listing()
        entries = [] if record is None else [(each.key, each.what) for each in record.entries]
        if listing:
            self._insist_ours(listing)
            self._write(render_nft_removal(self._system))
            entries = entries or [(self._table, "")]
        else:
            entries = []
        self._ledger.drop(KIND, self._table)
        return deletions(self.name, entries)

    def renew(self) -> float | None:
        """A table does not expire."""
        return None

    def _nothing_to_mark(self, rules: Sequence[FlowRule]) -> TargetChanges:
        """No rule, no table."""
        left_out = _marking(rules)[1]
        if self._ledger.record(KIND, self._table) is None and not self._listing():
            return TargetChanges(target=self.name, left_out=left_out)
        removed = self.remove()
        return TargetChanges(target=self.name, changes=removed.changes, left_out=left_out)

    def _compare(self, rules: Sequence[FlowRule]) -> tuple[FlowChange, ...]:
        listing = self._listing()
        if listing:
            self._insist_ours(listing)
        record = self._ledger.record(KIND, self._table)
        detail = ""
        if not listing and record is not None and record.entries:
            detail = "the table was gone"
            record = None
        elif listing and record is not None and not record.seen:
            detail = "an earlier attempt did not finish"
        elif listing and record is not None and record.seen != digest_of(_steady(listing)):
            detail = "the table was changed by others"
        before = {} if record is None else {each.key: each for each in record.entries}
        gone = detail if not listing else ""
        changes = []
        for rule in rules:
            old = before.pop(rule.key, None)
            kind = ChangeKind.CREATE
            if old is not None:
                same = old.digest == rules_digest([rule]) and not detail
                kind = ChangeKind.KEEP if same else ChangeKind.UPDATE
            why = gone if old is None else detail
            changes.append(
                FlowChange(kind=kind, key=rule.key, what=describe_rule(rule), detail=why)
            )
        changes += [
            FlowChange(kind=ChangeKind.DELETE, key=each.key, what=each.what)
            for each in before.values()
        ]
        return tuple(changes)

    def _text(self, rules: Sequence[FlowRule]) -> str:
        return render_nft(rules, system=self._system, digest=rules_digest(rules))

    def _write(self, text: str) -> None:
        demand(self._tool, ["nft", "-f", "-"], doing=f"write {self.name}", stdin=text)

    def _listing(self) -> str:
        """The table as nft shows it; empty if there is none."""
        argv = ["nft", "list", "table", FAMILY, self._table]
        output = self._tool.run(argv)
        if output.returncode == 0:
            return output.stdout
        if _NONE_SUCH.search(output.stderr):
            return ""
        raise failure(output, argv, doing=f"read {self.name}")

    def _insist_ours(self, listing: str) -> None:
        if parse_managed_comment(listing) is None:
            raise NotOursError(
                f"cannot use {self.name}: it exists and is not marked as managed by lifecycle",
                hint=f"look at it: nft list table {FAMILY} {self._table}",
            )

    def _record(self, rules: Sequence[FlowRule], *, seen: str) -> TargetRecord:
        return TargetRecord(
            target=KIND,
            scope=self._table,
            digest=rules_digest(rules),
            seen=seen,
            entries=tuple(
                Entry(
                    key=rule.key,
                    digest=rules_digest([rule]),
                    what=describe_rule(rule),
                    id=self._table,
                )
                for rule in rules
            ),
        )

    def _warnings(self) -> tuple[str, ...]:
        """Say where marks change nothing."""
        return tuple(
            f"marking alone gives no priority on {device}: its queueing discipline {kind} "
            f"{_effect(kind)}; add one that looks at these flows: "
            f"lifecycle flows apply MANIFEST --target tc --device {device} --rate RATE"
            for device, kind in root_qdiscs(self._tool)
            if device != "lo" and kind in (*_BAND_QDISCS, "pfifo", "fq_codel")
        )


def root_qdiscs(tool: Tool) -> tuple[tuple[str, str], ...]:
    """Return (device, kind) of every root queueing discipline; empty where tc fails."""
    argv = ["tc", "-j", "qdisc", "show"]
    try:
        output = tool.run(argv)
        found = qdiscs_of(output.stdout, argv, doing="list queueing disciplines")
    except ProgrammingError:
        return ()
    if output.returncode != 0:
        return ()
    return tuple((each.dev, each.kind) for each in found if each.root)


def _effect(kind: str) -> str:
    if kind in _BAND_QDISCS:
        return "puts EF, CS6 and unmarked packets into one band and AF*1 into the worst"
    return "does not look at DSCP"


def _marking(rules: Sequence[FlowRule]) -> tuple[tuple[FlowRule, ...], tuple[str, ...]]:
    """The rules that set something in packets, and why the others do not."""
    marking = tuple(each for each in rules if each.dscp is not None or each.flow_label)
    left_out = tuple(
        f"{each.key}: it has no DSCP and no flow label to set"
        for each in rules
        if each not in marking
    )
    return marking, left_out


def _steady(listing: str) -> str:
    """A listing without what changes by itself: counters."""
    return _COUNTS.sub("counter", listing)


class NftOptions(TargetOptions):
    """It needs none."""

    kind = KIND

    @classmethod
    def read(cls, given: Mapping[str, Any]) -> NftOptions:  # noqa: ARG003 - TargetOptions
        """Take none."""
        return cls()

    @classmethod
    def restore(cls, record: TargetRecord, means: Targets) -> NftTarget:  # noqa: ARG003 - likewise
        """Return the table of the ledger's system."""
        return cls().open(means)

    def open(self, means: Targets) -> NftTarget:
        """Return the table of the ledger's system."""
        try:
            return NftTarget(means.ledger.system, means.ledger, means.tool)
        except ValueError as error:
            raise UsageError(str(error)) from error


TARGET = NftOptions
