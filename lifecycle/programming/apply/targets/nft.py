"""Applies an nftables ruleset on this host: one owned table, replaced in one transaction.

Owns: when the table is written, and whose it is. Its contents are `rules.nftables`.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

from msgspec.structs import replace

from lifecycle.errors import UsageError
from lifecycle.programming.apply.ledger import Ledger, TargetRecord
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
from lifecycle.programming.apply.tool import HostTool, demand, failure, qdiscs
from lifecycle.programming.rules.nftables import (
    FAMILY,
    element,
    parse_managed_comment,
    render_nft,
    render_table_removal,
    table_name,
    why_unmarked,
)
from lifecycle.programming.rules.rules import FlowRule, RuleSet, named, rules_digest

KIND = "nft"

_ELEMENT = re.compile(
    r'set (?P<set>\w+) \{|(?P<key>[0-9a-f.:]+(?: \. [0-9a-f.:]+)+) comment "(?P<comment>[^"]*)"'
)
_NAMED = 100
"""Characters of a flow's name that surely fit into an element's comment."""

_NONE_SUCH = re.compile(r"No such file or directory", re.IGNORECASE)

_BAND_QDISCS = ("pfifo_fast", "prio")
"""They sort by the old TOS bits, where EF, CS6 and DF share the middle band and AF*1 the worst."""


class NftTable:
    """One table, read and replaced as a whole. Its comment says that it is ours.

    Args:
        name: of the table.
        tool: runs nft.
    """

    def __init__(self, name: str, tool: HostTool) -> None:
        self._name = name
        self._tool = tool

    def __str__(self) -> str:
        return f"nft table {FAMILY} {self._name}"

    def listing(self) -> str:
        """Return the table as nft shows it; empty if there is none.

        Raises:
            NotOursError: a table of this name is not ours.
            PrivilegeError: reading needs the same privilege as writing.
        """
        argv = ["nft", "list", "table", FAMILY, self._name]
        output = self._tool.run(argv)
        if output.returncode != 0:
            if _NONE_SUCH.search(output.stderr):
                return ""
            raise failure(output, argv, doing=f"read {self}")
        if parse_managed_comment(output.stdout) is None:
            raise NotOursError(
                f"cannot use {self}: it exists and is not marked as managed by lifecycle",
                hint=f"look at it: nft list table {FAMILY} {self._name}",
            )
        return output.stdout

    def write(self, text: str) -> None:
        """Replace it: nft takes a ruleset whole or not at all."""
        demand(self._tool, ["nft", "-f", "-"], doing=f"write {self}", stdin=text)

    def remove(self) -> None:
        """Remove it."""
        self.write(render_table_removal(self._name))


def compare(
    listing: str, text: str, rules: Sequence[FlowRule], *, detail: str = ""
) -> tuple[FlowChange, ...]:
    """Return what replacing a table changes, flow by flow.

    Args:
        listing: the table as nft shows it; empty if there is none.
        text: what would be written.
        rules: that it was made from.
        detail: why all of them change; empty to find that out.
    """
    there, wanted = _elements(listing), _elements(text)
    names = [comment for *_, comment in there]
    equal = bool(listing) and parse_managed_comment(listing) == parse_managed_comment(text)
    altered = equal and (there != wanted or listing.count(" counter ") != text.count(" counter "))
    if altered:
        detail = "the table was changed by others"
    # The digest is also of what no element shows, such as a 5QI.
    unseen = there == wanted and not equal
    changes = []
    for rule in rules:
        known = not wanted or any(named(rule)[:_NAMED] in each for each in names)
        kind = ChangeKind.UPDATE if listing and known else ChangeKind.CREATE
        key = element(rule)
        if listing and not (altered or unseen) and _sets(there, key) == _sets(wanted, key):
            kind = ChangeKind.KEEP
        changes.append(FlowChange(kind=kind, key=rule.key, what=describe_rule(rule), detail=detail))
    lasting = {comment for *_, comment in wanted}
    changes += [
        FlowChange(kind=ChangeKind.DELETE, key=each, what="")
        for each in dict.fromkeys(names)
        if each not in lasting
    ]
    return tuple(changes)


def _elements(text: str) -> list[tuple[str, str, str]]:
    """(set, tuple, comment) of each element of a table, as written or as shown."""
    found = []
    name = ""
    for each in _ELEMENT.finditer(text):
        name = each["set"] or name
        if each["key"]:
            found.append((name, each["key"], each["comment"]))
    return sorted(found)


def _sets(elements: Sequence[tuple[str, str, str]], key: str) -> set[str]:
    return {name for name, other, _ in elements if other == key}


class NftTarget:
    """The table of one system.

    Args:
        system: names the table.
        ledger: of the system; says that there is a table, for who removes it later.
        tool: runs nft.
    """

    def __init__(self, system: str, ledger: Ledger, tool: HostTool | None = None) -> None:
        self._system = system
        self._scope = table_name(system)
        self._ledger = ledger
        self._tool = tool or HostTool()
        self._table = NftTable(self._scope, self._tool)

    @property
    def name(self) -> str:
        """The table."""
        return str(self._table)

    def plan(self, rules: Sequence[FlowRule]) -> TargetChanges:
        """Compare the table with the rules.

        Raises:
            NotOursError: a table of this name is not ours.
            PrivilegeError: reading needs the same privilege as writing.
        """
        marking, left_out = usable(rules, why_unmarked)
        listing = self._table.listing()
        detail = ""
        if not listing and self._ledger.record(KIND, self._scope) is not None:
            detail = "the table was gone"
        return TargetChanges(
            target=self.name,
            changes=compare(listing, self._text(marking), marking, detail=detail),
            left_out=left_out,
            warnings=self._warnings() if marking else (),
        )

    def apply(self, rules: Sequence[FlowRule]) -> TargetChanges:
        """Replace the table if anything differs."""
        marking, left_out = usable(rules, why_unmarked)
        if not marking:
            return replace(self.remove(), left_out=left_out)
        planned = self.plan(rules)
        recorded = self._ledger.record(KIND, self._scope) is not None
        if not planned.pending and recorded:
            return planned
        # Written first: a crash in between leaves an entry without a table, which is harmless.
        self._ledger.put(TargetRecord(target=KIND, scope=self._scope))
        try:
            self._table.write(self._text(marking))
        except ProgrammingError:
            if not recorded:
                self._ledger.drop(KIND, self._scope)
            raise
        return planned

    def dry_run(self, rules: Sequence[FlowRule]) -> str:
        """Return the ruleset, checked by nft itself.

        Where this user may not even check, nft is asked in a user namespace of its own. A kernel
        that allows neither leaves the text unchecked, which is said in its first line.

        Raises:
            ProgrammingError: nft refuses the ruleset.
        """
        text = self._text(usable(rules, why_unmarked)[0])
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
        if self._ledger.record(KIND, self._scope) is None and not self._table.listing():
            return TargetChanges(target=self.name)
        listing = self._table.listing()
        names = list(dict.fromkeys(comment for *_, comment in _elements(listing)))
        if listing:
            self._table.remove()
        self._ledger.drop(KIND, self._scope)
        return deletions(self.name, [(each, "") for each in names])

    def renew(self) -> float | None:
        """A table does not expire."""
        return None

    def _text(self, rules: Sequence[FlowRule]) -> str:
        return render_nft(rules, system=self._system, digest=rules_digest(rules))

    def _warnings(self) -> tuple[str, ...]:
        """Say where marks change nothing."""
        return tuple(
            f"marking alone gives no priority on {device}: its queueing discipline {kind} "
            f"{_effect(kind)}; add one that looks at these flows: "
            f"lifecycle flows apply MANIFEST --target tc --device {device} --rate RATE"
            for device, kind in root_qdiscs(self._tool)
            if device != "lo" and kind in (*_BAND_QDISCS, "pfifo", "fq_codel")
        )


def root_qdiscs(tool: HostTool) -> tuple[tuple[str, str], ...]:
    """Return (device, kind) of every root queueing discipline; empty where tc fails."""
    try:
        found = qdiscs(tool, doing="list queueing disciplines")
    except ProgrammingError:
        return ()
    return tuple((each.dev, each.kind) for each in found if each.root)


def _effect(kind: str) -> str:
    if kind in _BAND_QDISCS:
        return "puts EF, CS6 and unmarked packets into one band and AF*1 into the worst"
    return "does not look at DSCP"


def usable(
    rules: Iterable[FlowRule], why_not: Callable[[FlowRule], str]
) -> tuple[tuple[FlowRule, ...], tuple[str, ...]]:
    """Return the rules that `why_not` has no reason against, and the others with their reasons."""
    reasons = [(each, why_not(each)) for each in rules]
    return (
        tuple(each for each, why in reasons if not why),
        tuple(f"{each.key}: {why}" for each, why in reasons if why),
    )


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
            return NftTarget(means.ledger.system, means.ledger)
        except ValueError as error:
            raise UsageError(str(error)) from error

    def export(self, rules: RuleSet, system: str) -> str:
        """Return the ruleset."""
        digest = rules_digest(rules.rules)
        return render_nft(rules.rules, system=system, digest=digest, left_out=rules.left_out)


TARGET = NftOptions
