"""Flow rules as an nftables ruleset, a file for `nft -f`.

Owns: the one table of a system, `inet flowqos_<system>`, and everything in it. The table is
replaced as a whole in one transaction, so that applying it twice changes nothing and no foreign
object is ever touched. Needs nftables 1.0.6 or later. Pure.

Packets are marked where they leave the host that sends them (postrouting, mangle). Only the six
bits of the DSCP are written: ECN is the transport's (RFC 3168).
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import msgspec

from lifecycle.network.dscp import code_points, describe, dscp_name
from lifecycle.network.nfe import InternetProtocol
from lifecycle.programming.rules.rules import FlowRule, LeftOut, named, remarks

FAMILY = "inet"
CHAIN = "post"

MAX_COMMENT_BYTES = 127
"""Longest comment that nftables keeps (NFTNL_UDATA_COMMENT_MAXLEN, with its final zero 128)."""

_SYSTEM = re.compile(r"[A-Za-z][A-Za-z0-9_-]*")
_MANAGED = re.compile(r"managed-by=lifecycle digest=(?P<digest>[0-9a-f]+)")


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


class _Group(msgspec.Struct, frozen=True, kw_only=True):
    """Flows that one nft rule treats: their set, what selects them and what is set on them."""

    name: str
    selector: str
    statement: str
    comment: str
    elements: tuple[tuple[str, str], ...]  # (tuple, comment)


def table_name(system: str) -> str:
    """Return the name of a system's table, `flowqos_teleop`.

    Raises:
        ValueError: the system's name is not one that a manifest may have.
    """
    if not _SYSTEM.fullmatch(system):
        raise ValueError(
            f"cannot name an nftables table after system {system!r}; "
            f"use letters, digits, '_' and '-', a letter first"
        )
    return f"flowqos_{system}"


def managed_comment(system: str, digest: str) -> str:
    """Return the comment that says whose a table is and which rules are in it."""
    # The digest comes first: whatever is cut off of a long comment, it stays.
    return f"managed-by=lifecycle digest={digest} system={system}"


def parse_managed_comment(text: str) -> str | None:
    """Return the digest in the first managed-by comment of `text`; None if there is none.

    `text` may be the whole output of `nft list table`. A table without this comment is not ours.
    """
    match = _MANAGED.search(text)
    return match["digest"] if match else None


def render_nft(
    rules: Iterable[FlowRule], *, system: str, digest: str, left_out: Sequence[LeftOut] = ()
) -> str:
    """Return a ruleset for `nft -f` that replaces the system's table in one transaction.

    Flows that ask for neither DSCP nor flow label get no rule and are named in a comment.

    Args:
        rules: of verified flows.
        system: names the table.
        digest: of the rules; kept in the table's comment.
        left_out: flows without a rule, named in comments.

    Raises:
        ValueError: the system's name is not one that a manifest may have.
    """
    every = tuple(rules)
    lines = [
        f"# Marks the verified flows of system {system}. Check without privilege:",
        "#   unshare -Urn nft -c -f FILE",
        "# Marking alone gives no priority: each hop must also queue by DSCP.",
        *remarks(every, left_out, why_unmarked),
    ]
    table = render_table(
        table_name(system), managed_comment(system, digest), [(each, marks(each)) for each in every]
    )
    return "\n".join(lines) + "\n" + table


def why_unmarked(rule: FlowRule) -> str:
    """Return why nothing is written into the packets of a rule; empty if something is."""
    return "" if marks(rule) else "it has no DSCP and no flow label to set"


def marks(rule: FlowRule) -> tuple[Action, ...]:
    """Return what is written into the packets of a rule; empty if nothing is."""
    found = []
    if rule.dscp is not None:
        name = dscp_name(rule.dscp).lower()
        found.append(
            Action(
                suffix=f"dscp{name}" if name.isdecimal() else name,
                statement=f"{{network}} dscp set {nft_keyword(rule.dscp)}",
                comment=describe(rule.dscp),
            )
        )
    if rule.flow_label:
        text = f"{rule.flow_label:#07x}"
        found.append(
            Action(
                suffix=f"label_{rule.flow_label:05x}",
                statement=f"{{network}} flowlabel set {text}",
                comment=f"flow label {text}",
            )
        )
    return tuple(found)


def render_table(
    table: str,
    comment: str,
    actions: Iterable[tuple[FlowRule, Sequence[Action]]],
    *,
    priority: str = "mangle",
    device: str = "",
    more: Sequence[str] = (),
) -> str:
    """Return commands for `nft -f` that replace a table in one transaction.

    Args:
        table: its name.
        comment: of the table.
        actions: what is set on the packets of each rule.
        priority: of its chain in the postrouting hook.
        device: only packets that leave by it; empty for all.
        more: further lines of the chain.
    """
    groups = tuple(_groups(actions))
    where = f'oifname "{device}" ' if device else ""
    lines = [
        render_table_removal(table).rstrip(),
        f"table {FAMILY} {table} {{",
        f'  comment "{_comment(comment)}"',
    ]
    for group in groups:
        lines += [
            f"  set {group.name} {{",
            f"    typeof {group.selector}",
            "    elements = {",
            *(f'      {key} comment "{names}",' for key, names in group.elements),
            "    }",
            "  }",
        ]
    lines += [
        f"  chain {CHAIN} {{",
        f"    type filter hook postrouting priority {priority}; policy accept;",
        *(
            f"    {where}{group.selector} @{group.name} {group.statement}"
            f' counter comment "{_comment(group.comment)}"'
            for group in groups
        ),
        *(f"    {where}{each}" for each in more),
        "  }",
        "}",
    ]
    return "\n".join(lines) + "\n"


def render_table_removal(table: str) -> str:
    """Return commands for `nft -f` that remove a table, and do so if there is none."""
    # `destroy` would say it in one line, but nftables 1.0.6 does not know the keyword.
    return f"add table {FAMILY} {table}\ndelete table {FAMILY} {table}\n"


def nft_keyword(dscp: int) -> str:
    """Return how nft spells a DSCP, as a keyword where nftables 1.0.6 knows one.

    Raises:
        ValueError: not 0–63.
    """
    name = dscp_name(dscp)
    return next((each.nft for each in code_points() if each.name == name), name)


def _groups(actions: Iterable[tuple[FlowRule, Sequence[Action]]]) -> Iterator[_Group]:
    """Flows by what is set on them: `ip dscp set … map {}` fails, so each class has its own set."""
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
        yield _Group(
            name=f"{letter}{digit}_{'' if transport == 'udp' else f'{transport}_'}{action.suffix}",
            selector=f"{source}{transport} sport . {network} daddr . {transport} dport",
            statement=action.statement.format(network=network),
            comment=action.comment,
            elements=tuple(_elements(members)),
        )


def element(rule: FlowRule) -> str:
    """Return the element of a set that matches a rule: `10.9.0.1 . 17900 . 10.9.0.2 . 17910`."""
    source = f"{rule.source_address} . " if rule.source_address else ""
    return f"{source}{rule.source_port} . {rule.destination_address} . {rule.destination_port}"


def _elements(rules: Sequence[FlowRule]) -> Iterator[tuple[str, str]]:
    """Each element once: several flows of one class may share a 5-tuple."""
    flows: dict[str, list[str]] = {}
    for rule in rules:
        flows.setdefault(element(rule), []).append(named(rule))
    for key, names in flows.items():
        yield key, _comment(", ".join(dict.fromkeys(names)))


def _comment(text: str) -> str:
    """Text that fits between quotes and into a comment; what is cut off ends with dots."""
    plain = " ".join(text.replace('"', "'").split())
    encoded = plain.encode()
    if len(encoded) <= MAX_COMMENT_BYTES:
        return plain
    return encoded[: MAX_COMMENT_BYTES - 3].decode(errors="ignore") + "..."
