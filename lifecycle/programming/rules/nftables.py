"""Flow rules as an nftables ruleset, as a file for `nft -f` and as JSON for libnftables.

Owns: the one table of a system, `inet flowqos_<system>`, and everything in it. The table is
replaced as a whole in one transaction, so that applying it twice changes nothing and no foreign
object is ever touched. Needs nftables 1.0.6 or later. Pure.

Packets are marked where they leave the host that sends them (postrouting, mangle). Only the six
bits of the DSCP are written: ECN is the transport's (RFC 3168).
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence

from lifecycle import dataclasses
from lifecycle.network import InternetProtocol, code_points, describe, dscp_name
from lifecycle.programming.rules.rules import FlowRule, LeftOut, asks, named

FAMILY = "inet"
CHAIN = "post"
PRIORITY_MANGLE = -150
"""The value of `priority mangle` in the postrouting hook (NF_IP_PRI_MANGLE)."""

MAX_COMMENT_BYTES = 127
"""Longest comment that nftables keeps (NFTNL_UDATA_COMMENT_MAXLEN, with its final zero 128)."""

_SYSTEM = re.compile(r"[A-Za-z][A-Za-z0-9_-]*")
_MANAGED = re.compile(r"managed-by=lifecycle digest=(?P<digest>[0-9a-f]+)")


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class _Part:
    """One selector of a concatenation: as nft writes it, and its type in a JSON set."""

    protocol: str
    field: str
    type: str

    def __str__(self) -> str:
        return f"{self.protocol} {self.field}"


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class _Group:
    """Flows that one nft rule treats: their set, what selects them and what is set on them."""

    name: str
    parts: tuple[_Part, ...]
    network: str
    field: str
    value: str
    comment: str
    elements: tuple[_Element, ...]

    @property
    def selector(self) -> str:
        return " . ".join(map(str, self.parts))


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class _Element:
    values: tuple[str | int, ...]
    comment: str


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
    table = table_name(system)
    lines = [
        f"# Marks the verified flows of system {system}. Check without privilege:",
        "#   unshare -Urn nft -c -f FILE",
        "# Marking alone gives no priority: each hop must also queue by DSCP.",
        *(f"# {line}" for line in _remarks(every, left_out)),
        f"add table {FAMILY} {table}",
        f"delete table {FAMILY} {table}",
        f"table {FAMILY} {table} {{",
        f'  comment "{_comment(managed_comment(system, digest))}"',
    ]
    groups = tuple(_groups(every))
    for group in groups:
        lines += [
            f"  set {group.name} {{",
            f"    typeof {group.selector}",
            "    elements = {",
            *(
                f'      {" . ".join(map(str, each.values))} comment "{each.comment}",'
                for each in group.elements
            ),
            "    }",
            "  }",
        ]
    lines += [
        f"  chain {CHAIN} {{",
        "    type filter hook postrouting priority mangle; policy accept;",
        *(
            f"    {group.selector} @{group.name} {group.network} {group.field} set {group.value}"
            f' counter comment "{group.comment}"'
            for group in groups
        ),
        "  }",
        "}",
    ]
    return "\n".join(lines) + "\n"


def render_nft_removal(system: str) -> str:
    """Return commands for `nft -f` that remove the system's table, and do so if there is none.

    Raises:
        ValueError: the system's name is not one that a manifest may have.
    """
    # `destroy` would say it in one line, but nftables 1.0.6 does not know the keyword.
    table = table_name(system)
    return f"add table {FAMILY} {table}\ndelete table {FAMILY} {table}\n"


def nft_keyword(dscp: int) -> str:
    """Return how nft spells a DSCP, as a keyword where nftables 1.0.6 knows one.

    Raises:
        ValueError: not 0–63.
    """
    name = dscp_name(dscp)
    return next((each.nft for each in code_points() if each.name == name), name)


def _remarks(rules: Sequence[FlowRule], left_out: Sequence[LeftOut]) -> Iterator[str]:
    for rule in rules:
        yield f"{named(rule)}: {rule.describe()}: {asks(rule)}"
    for each in left_out:
        yield f"left out: {each}"
    for rule in rules:
        if rule.dscp is None and not rule.flow_label:
            yield f"left out: {named(rule)}: it has no DSCP and no flow label to set"


def _groups(rules: Sequence[FlowRule]) -> Iterator[_Group]:
    """Flows by what is set on them: `ip dscp set … map {}` fails, so each class has its own set."""
    marked: dict[tuple[int, str, str, bool], list[FlowRule]] = {}
    labelled: dict[tuple[int, str, str, bool], list[FlowRule]] = {}
    for rule in rules:
        network = "ip6" if rule.internet_protocol is InternetProtocol.IPV6 else "ip"
        kind = (network, rule.transport_protocol.value, bool(rule.source_address))
        if rule.dscp is not None:
            marked.setdefault((rule.dscp, *kind), []).append(rule)
        if rule.flow_label:
            labelled.setdefault((rule.flow_label, *kind), []).append(rule)
    for (dscp, network, transport, sourced), members in marked.items():
        name = dscp_name(dscp).lower()
        yield _group(
            members,
            suffix=f"dscp{name}" if name.isdecimal() else name,
            network=network,
            transport=transport,
            sourced=sourced,
            change=("dscp", nft_keyword(dscp), describe(dscp)),
        )
    for (label, network, transport, sourced), members in labelled.items():
        text = f"{label:#07x}"
        yield _group(
            members,
            suffix=f"label_{label:05x}",
            network=network,
            transport=transport,
            sourced=sourced,
            change=("flowlabel", text, f"flow label {text}"),
        )


def _group(
    rules: Sequence[FlowRule],
    *,
    suffix: str,
    network: str,
    transport: str,
    sourced: bool,
    change: tuple[str, str, str],
) -> _Group:
    address = "ipv6_addr" if network == "ip6" else "ipv4_addr"
    parts = (
        _Part(protocol=network, field="saddr", type=address),
        _Part(protocol=transport, field="sport", type="inet_service"),
        _Part(protocol=network, field="daddr", type=address),
        _Part(protocol=transport, field="dport", type="inet_service"),
    )
    # f: whole flows; p: flows whose source address is not known, matched by port and destination.
    letter, digit = "f" if sourced else "p", "6" if network == "ip6" else "4"
    field, value, comment = change
    return _Group(
        name=f"{letter}{digit}_{'' if transport == 'udp' else f'{transport}_'}{suffix}",
        parts=parts if sourced else parts[1:],
        network=network,
        field=field,
        value=value,
        comment=_comment(comment),
        elements=tuple(_elements(rules)),
    )


def _elements(rules: Sequence[FlowRule]) -> Iterator[_Element]:
    """Each element once: several flows of one class may share a 5-tuple."""

    def values(rule: FlowRule) -> tuple[str | int, ...]:
        source = (rule.source_address,) if rule.source_address else ()
        return (*source, rule.source_port, rule.destination_address, rule.destination_port)

    flows: dict[tuple[str | int, ...], list[str]] = {}
    for rule in rules:
        flows.setdefault(values(rule), []).append(named(rule))
    for key, names in flows.items():
        yield _Element(values=key, comment=_comment(", ".join(dict.fromkeys(names))))


def _comment(text: str) -> str:
    """Text that fits between quotes and into a comment; what is cut off ends with dots."""
    plain = " ".join(text.replace('"', "'").split())
    encoded = plain.encode()
    if len(encoded) <= MAX_COMMENT_BYTES:
        return plain
    return encoded[: MAX_COMMENT_BYTES - 3].decode(errors="ignore") + "..."
