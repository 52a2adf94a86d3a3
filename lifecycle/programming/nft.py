"""nftables on this host: one table of ours marks the packets of verified flows.

Owns: the table `inet flowqos_<system>` and everything in it, its text for `nft -f`, and how a table
of ours is read, compared and replaced: tc has one, too. A table is replaced as a whole in one
transaction, so that applying it twice changes nothing and no foreign object is ever touched; its
comment says that it is ours. Needs nftables 1.0.6 or later.

Packets are marked where they leave the host that sends them (postrouting, mangle). Only the six
bits of the DSCP are written: ECN is the transport's (RFC 3168).
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, NamedTuple

from msgspec.structs import replace

from lifecycle.errors import UsageError
from lifecycle.network.dscp import code_points, describe, dscp_name
from lifecycle.network.nfe import InternetProtocol
from lifecycle.programming.ledger import TargetRecord
from lifecycle.programming.rules import FlowRule, RuleSet, named, remarks
from lifecycle.programming.target import (
    ChangeKind,
    FlowChange,
    Means,
    NotOursError,
    PrivilegeError,
    ProgrammingError,
    Target,
    TargetChanges,
    describe_rule,
    usable,
)
from lifecycle.programming.tool import HostTool, demand, failure, qdiscs

MAX_COMMENT_BYTES = 127
"""Longest comment that nftables keeps (NFTNL_UDATA_COMMENT_MAXLEN, with its final zero 128)."""

_FAMILY = "inet"
_SYSTEM = re.compile(r"[A-Za-z][A-Za-z0-9_-]*")
_MANAGED = re.compile(r"managed-by=lifecycle digest=(?P<digest>[0-9a-f]+)")
_ELEMENT = re.compile(
    r'set (?P<set>\w+) \{|(?P<key>[0-9a-f.:]+(?: \. [0-9a-f.:]+)+) comment "(?P<comment>[^"]*)"'
)
_NONE_SUCH = re.compile(r"No such file or directory", re.IGNORECASE)
_NAMED = 100
"""Characters of a flow's name that surely fit into an element's comment."""

_BAND_QDISCS = ("pfifo_fast", "prio")
"""They sort by the old TOS bits, where EF, CS6 and DF share the middle band and AF*1 the worst."""


class Action(NamedTuple):
    """What is set on the packets of a rule.

    Attributes:
        suffix: ends the name of its set, `ef`.
        statement: as nft writes it; `{network}` stands for `ip` or `ip6`.
        comment: for people.
    """

    suffix: str
    statement: str
    comment: str


def table_name(system: str) -> str:
    """Return the name of a system's table, `flowqos_teleop`.

    Raises:
        UsageError: the system's name is not one that a manifest may have.
    """
    if not _SYSTEM.fullmatch(system):
        raise UsageError(
            f"cannot name an nftables table after system {system!r}; "
            f"use letters, digits, '_' and '-', a letter first"
        )
    return f"flowqos_{system}"


def digest_of(text: str) -> str:
    """Return the digest that the comment of a table of ours names; empty if there is none.

    `text` may be the whole output of `nft list table`. A table without this comment is not ours.
    """
    match = _MANAGED.search(text)
    return match["digest"] if match else ""


def render_nft(rules: Iterable[FlowRule], *, system: str, left_out: Sequence[str] = ()) -> str:
    """Return a ruleset for `nft -f` that replaces the system's table in one transaction.

    Flows that ask for neither DSCP nor flow label get no rule and are named in a comment.

    Args:
        rules: of verified flows.
        system: names the table.
        left_out: flows without a rule, named in comments.

    Raises:
        UsageError: the system's name is not one that a manifest may have.
    """
    every = tuple(rules)
    lines = [
        f"# Marks the verified flows of system {system}. Check without privilege:",
        "#   unshare -Urn nft -c -f FILE",
        "# Marking alone gives no priority: each hop must also queue by DSCP.",
        *remarks(every, left_out, _why_unmarked),
    ]
    actions = [(each, _marks(each)) for each in every]
    table = render_table(table_name(system), actions, about=f"system={system}")
    return "\n".join(lines) + "\n" + table


def _why_unmarked(rule: FlowRule) -> str:
    return "" if _marks(rule) else "it has no DSCP and no flow label to set"


def _marks(rule: FlowRule) -> tuple[Action, ...]:
    """What is written into the packets of a rule."""
    found = []
    if rule.dscp is not None:
        name = dscp_name(rule.dscp).lower()
        suffix = f"dscp{name}" if name.isdecimal() else name
        statement = f"{{network}} dscp set {nft_keyword(rule.dscp)}"
        found.append(Action(suffix, statement, describe(rule.dscp)))
    if rule.flow_label:
        text = f"{rule.flow_label:#07x}"
        statement = f"{{network}} flowlabel set {text}"
        found.append(Action(f"label_{rule.flow_label:05x}", statement, f"flow label {text}"))
    return tuple(found)


def nft_keyword(dscp: int) -> str:
    """Return how nft spells a DSCP, as a keyword where nftables 1.0.6 knows one.

    Raises:
        ValueError: not 0–63.
    """
    name = dscp_name(dscp)
    return next((each.nft for each in code_points() if each.name == name), name)


def render_table(
    table: str,
    actions: Iterable[tuple[FlowRule, Sequence[Action]]],
    *,
    about: str,
    priority: str = "mangle",
    device: str = "",
    more: Sequence[str] = (),
) -> str:
    """Return commands for `nft -f` that replace a table in one transaction.

    Args:
        table: its name.
        actions: what is set on the packets of each rule.
        about: what its comment says behind the digest, which is of it, too.
        priority: of its chain in the postrouting hook.
        device: only packets that leave by it; empty for all.
        more: further lines of the chain.
    """
    where = f'oifname "{device}" ' if device else ""
    sets: list[str] = []
    chain: list[str] = []
    for name, selector, statement, comment, members in _groups(actions):
        sets += [f"  set {name} {{", f"    typeof {selector}", "    elements = {"]
        sets += [f'      {key} comment "{flows}",' for key, flows in _elements_of(members)]
        sets += ["    }", "  }"]
        chain.append(f'{selector} @{name} {statement} counter comment "{_comment(comment)}"')
    body = [
        *sets,
        "  chain post {",
        f"    type filter hook postrouting priority {priority}; policy accept;",
        *(f"    {where}{each}" for each in (*chain, *more)),
        "  }",
        "}",
    ]
    digest = hashlib.sha256("\n".join((about, *body)).encode()).hexdigest()[:16]
    # The digest comes first: whatever is cut off of a long comment, it stays.
    managed = _comment(f"managed-by=lifecycle digest={digest} {about}")
    head = [f"table {_FAMILY} {table} {{", f'  comment "{managed}"']
    return render_table_removal(table) + "\n".join((*head, *body)) + "\n"


def render_table_removal(table: str) -> str:
    """Return commands for `nft -f` that remove a table, and do so if there is none."""
    # `destroy` would say it in one line, but nftables 1.0.6 does not know the keyword.
    return f"add table {_FAMILY} {table}\ndelete table {_FAMILY} {table}\n"


def _groups(
    actions: Iterable[tuple[FlowRule, Sequence[Action]]],
) -> Iterator[tuple[str, str, str, str, list[FlowRule]]]:
    """Flows by what is set on them: `ip dscp set … map {}` fails, so each class has its own set.

    Yields:
        Name of the set, what selects its flows, what is set on them, for people, the flows.
    """
    groups: dict[tuple[Action, str, str, bool], list[FlowRule]] = {}
    for rule, those in actions:
        network = "ip6" if rule.internet_protocol is InternetProtocol.IPV6 else "ip"
        for action in those:
            key = (action, network, rule.transport_protocol.value, bool(rule.source_address))
            groups.setdefault(key, []).append(rule)
    for (action, network, transport, sourced), members in groups.items():
        # f: whole flows; p: flows whose source address is not known, matched by port and
        # destination.
        letter, digit = "f" if sourced else "p", "6" if network == "ip6" else "4"
        source = f"{network} saddr . " if sourced else ""
        yield (
            f"{letter}{digit}_{'' if transport == 'udp' else f'{transport}_'}{action.suffix}",
            f"{source}{transport} sport . {network} daddr . {transport} dport",
            action.statement.format(network=network),
            action.comment,
            members,
        )


def _element(rule: FlowRule) -> str:
    """The element of a set that matches a rule: `10.9.0.1 . 17900 . 10.9.0.2 . 17910`."""
    source = f"{rule.source_address} . " if rule.source_address else ""
    return f"{source}{rule.source_port} . {rule.destination_address} . {rule.destination_port}"


def _elements_of(rules: Sequence[FlowRule]) -> Iterator[tuple[str, str]]:
    """Each element once, with its comment: several flows of one class may share a 5-tuple."""
    flows: dict[str, list[str]] = {}
    for rule in rules:
        flows.setdefault(_element(rule), []).append(named(rule))
    for key, names in flows.items():
        yield key, _comment(", ".join(dict.fromkeys(names)))


def _comment(text: str) -> str:
    """Text that fits between quotes and into a comment; what is cut off ends with dots."""
    plain = " ".join(text.replace('"', "'").split())
    encoded = plain.encode()
    if len(encoded) <= MAX_COMMENT_BYTES:
        return plain
    return encoded[: MAX_COMMENT_BYTES - 3].decode(errors="ignore") + "..."


class NftTable:
    """One table, read and replaced as a whole. Its comment says that it is ours.

    Args:
        name: of the table.
        tool: runs nft.
    """

    def __init__(self, name: str, tool: HostTool) -> None:
        self.name = name
        self._tool = tool

    def __str__(self) -> str:
        return f"nft table {_FAMILY} {self.name}"

    def listing(self) -> str:
        """Return the table as nft shows it; empty if there is none.

        Raises:
            NotOursError: a table of this name is not ours.
            PrivilegeError: reading needs the same privilege as writing.
        """
        argv = ["nft", "list", "table", _FAMILY, self.name]
        output = self._tool.run(argv)
        if output.returncode != 0:
            if _NONE_SUCH.search(output.stderr):
                return ""
            raise failure(output, argv, doing=f"read {self}")
        if not digest_of(output.stdout):
            raise NotOursError(
                f"cannot use {self}: it exists and is not marked as managed by lifecycle",
                hint=f"look at it: nft list table {_FAMILY} {self.name}",
            )
        return output.stdout

    def write(self, text: str) -> None:
        """Replace it: nft takes a ruleset whole or not at all."""
        demand(self._tool, ["nft", "-f", "-"], doing=f"write {self}", stdin=text)

    def remove(self) -> tuple[FlowChange, ...]:
        """Remove it, if it is there, and return which flows it had."""
        listing = self.listing()
        if listing:
            self.write(render_table_removal(self.name))
        names = dict.fromkeys(comment for *_, comment in _elements(listing))
        return tuple(FlowChange(kind=ChangeKind.DELETE, key=each) for each in names)


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
    names = dict.fromkeys(comment for *_, comment in there)
    equal = bool(listing) and digest_of(listing) == digest_of(text)
    altered = equal and (there != wanted or listing.count(" counter ") != text.count(" counter "))
    if altered:
        detail = "the table was changed by others"
    # What is set on flows is in no element.
    every = altered or (there == wanted and not equal)
    changes = []
    for rule in rules:
        known = not wanted or any(named(rule)[:_NAMED] in each for each in names)
        kind = ChangeKind.UPDATE if listing and known else ChangeKind.CREATE
        key = _element(rule)
        sets, wants = (
            {name for name, other, _ in each if other == key} for each in (there, wanted)
        )
        if listing and not every and sets == wants:
            kind = ChangeKind.KEEP
        changes.append(FlowChange(kind=kind, key=rule.key, what=describe_rule(rule), detail=detail))
    lasting = {comment for *_, comment in wanted}
    gone = [each for each in names if each not in lasting]
    return (*changes, *(FlowChange(kind=ChangeKind.DELETE, key=each) for each in gone))


def _elements(text: str) -> list[tuple[str, str, str]]:
    """(set, tuple, comment) of each element of a table, as written or as shown."""
    found = []
    name = ""
    for each in _ELEMENT.finditer(text):
        name = each["set"] or name
        if each["key"]:
            found.append((name, each["key"], each["comment"]))
    return sorted(found)


class NftTarget(Target):
    """The table of one system.

    Args:
        settings: None, it takes none.
        means: their ledger says that there is a table, for who removes it later.
        tool: runs nft.
    """

    kind = "nft"

    def __init__(self, settings: None, means: Means, tool: HostTool | None = None) -> None:
        super().__init__(settings, means)
        self._tool = tool or HostTool()
        self._table = NftTable(table_name(means.ledger.system), self._tool)
        self._record = TargetRecord(target=self.kind, scope=self._table.name)
        self.name = str(self._table)

    @classmethod
    def restore(cls, record: TargetRecord) -> None:
        """The ledger's system names the table."""

    @classmethod
    def export(cls, settings: Any, rules: RuleSet, system: str) -> str:  # noqa: ARG003 - Target
        """Return the ruleset."""
        return render_nft(rules.rules, system=system, left_out=rules.left_out)

    def plan(self, rules: Sequence[FlowRule]) -> TargetChanges:
        """Compare the table with the rules.

        Raises:
            NotOursError: a table of this name is not ours.
            PrivilegeError: reading needs the same privilege as writing.
        """
        marking, left_out = usable(rules, _why_unmarked)
        listing = self._table.listing()
        text = render_nft(marking, system=self._ledger.system)
        gone = not listing and self._ledger.has(self._record)
        return TargetChanges(
            target=self.name,
            changes=compare(listing, text, marking, detail="the table was gone" if gone else ""),
            left_out=left_out,
            warnings=self._warnings() if marking else (),
        )

    def apply(self, rules: Sequence[FlowRule]) -> TargetChanges:
        """Replace the table if anything differs."""
        marking, left_out = usable(rules, _why_unmarked)
        if not marking:
            return replace(self.remove(), left_out=left_out)
        planned = self.plan(rules)
        recorded = self._ledger.has(self._record)
        if not planned.pending and recorded:
            return planned
        # Written first: a crash in between leaves an entry without a table, which is harmless.
        self._ledger.put(self._record)
        try:
            self._table.write(render_nft(marking, system=self._ledger.system))
        except ProgrammingError:
            if not recorded:
                self._ledger.drop(self._record)
            raise
        return planned

    def dry_run(self, rules: Sequence[FlowRule]) -> str:
        """Return the ruleset, checked by nft itself.

        Where this user may not even check, nft is asked in a user namespace of its own. A kernel
        that allows neither leaves the text unchecked, which is said in its first line.

        Raises:
            ProgrammingError: nft refuses the ruleset.
        """
        text = super().dry_run(rules)
        check = ("nft", "-c", "-f", "-")
        for argv in (check, ("unshare", "-Urn", *check)):
            output = self._tool.run(argv, stdin=text)
            if output.returncode == 0:
                return text
            error = failure(output, argv, doing=f"check {self.name}")
            if not isinstance(error, PrivilegeError):
                raise error
        return f"# Not checked: this kernel allows no user namespaces.\n{text}"

    def remove(self) -> TargetChanges:
        """Delete the table if it is ours."""
        changes = self._table.remove()
        self._ledger.drop(self._record)
        return TargetChanges(target=self.name, changes=changes)

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


TARGET = NftTarget
