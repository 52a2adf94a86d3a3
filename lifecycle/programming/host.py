"""What targets on this host have in common: nft and tc are run, and nftables tables of ours kept.

A table is replaced as a whole in one transaction, so no foreign object is ever touched; its comment
says that it is ours. The ledger has what was written for each flow. Needs nftables 1.0.6 or later.
"""

from __future__ import annotations

import abc
import asyncio
import os
import re
import shlex
import subprocess
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

from msgspec.structs import replace

from lifecycle.errors import UsageError
from lifecycle.network.nfe import InternetProtocol
from lifecycle.programming.ledger import Entry, TargetRecord
from lifecycle.programming.rules import FlowRule, RuleSet, expressed
from lifecycle.programming.target import (
    ChangeKind,
    FlowChange,
    Means,
    ProgrammingError,
    Target,
    TargetChanges,
)
from lifecycle.run_directory import OWN_CHILD

_TIMEOUT_S = 10.0
"""They talk to the kernel only; a busy machine needs tenths of a second."""

_PACKAGES = {"nft": "nftables", "tc": "iproute2"}

HOW_PRIVILEGED = (
    "run this command as root, or give it that capability: in a container --cap-add NET_ADMIN, in "
    "a systemd unit AmbientCapabilities=CAP_NET_ADMIN"
)
"""Root is not enough where the capability was taken away: capabilities(7)."""

_NO_PRIVILEGE = re.compile(r"operation not permitted|permission denied|must be root", re.IGNORECASE)

Output = subprocess.CompletedProcess[str]
"""What a program left."""

_THREAD = ThreadPoolExecutor(1, thread_name_prefix="networks")
"""One program after the other: what was cancelled has ended before the next begins."""


class HostTool:
    """Programs of this host, which hold up no loop.

    Args:
        prefix: arguments before each command line, such as `ip netns exec robot`.
    """

    def __init__(self, prefix: Sequence[str] = ()) -> None:
        self._prefix = tuple(prefix)

    async def run(self, argv: Sequence[str], *, stdin: str = "") -> Output:
        """Run a program to its end and return what it left, whatever its exit code.

        Raises:
            ProgrammingError: it is not installed, or does not end.
        """
        try:
            running = _THREAD.submit(self._run, argv, stdin)
        except RuntimeError:  # there is no room for a thread any more
            return self._run(argv, stdin)
        return await asyncio.wrap_future(running)

    def _run(self, argv: Sequence[str], stdin: str) -> Output:
        # Distributions keep these in sbin, which is not on every user's path.
        path = f"{os.environ.get('PATH', '')}:/usr/sbin:/sbin"
        try:
            with OWN_CHILD:
                return subprocess.run(
                    [*self._prefix, *argv],
                    input=stdin,
                    capture_output=True,
                    text=True,
                    errors="backslashreplace",
                    timeout=_TIMEOUT_S,
                    check=False,
                    env={**os.environ, "LC_ALL": "C", "PATH": path},
                )
        except FileNotFoundError as error:
            program = str(error.filename or argv[0])
            package = _PACKAGES.get(program, program)
            raise ProgrammingError(
                f"cannot run {program!r}: it is not installed",
                hint=f"install it: apt-get install {package}",
            ) from error
        except subprocess.TimeoutExpired as error:
            raise ProgrammingError(
                f"cannot finish {shlex.join(argv)!r}: it still ran after {_TIMEOUT_S:g} s"
            ) from error
        except OSError as error:
            raise ProgrammingError(f"cannot run {shlex.join(argv)!r}: {error.strerror}") from error


async def demand(tool: HostTool, argv: Sequence[str], *, doing: str, stdin: str = "") -> str:
    """Run a program that has to succeed and return what it printed; else it cannot do `doing`.

    Raises:
        ProgrammingError: see `failure`.
    """
    output = await tool.run(argv, stdin=stdin)
    if output.returncode == 0:
        return output.stdout
    raise failure(output, argv, doing=doing)


def failure(output: Output, argv: Sequence[str], *, doing: str) -> ProgrammingError:
    """Return the error that a failed program means: a missing privilege, or what it says itself."""
    command = shlex.join(argv)
    printed = filter(None, map(str.strip, output.stderr.splitlines()))
    said = next(printed, f"exit code {output.returncode}")
    if _NO_PRIVILEGE.search(output.stderr):
        return ProgrammingError(
            f"cannot {doing}: {command!r} needs CAP_NET_ADMIN in this network namespace",
            hint=HOW_PRIVILEGED,
        )
    return ProgrammingError(f"cannot {doing}: {command!r} says {said!r}")


MAX_COMMENT_BYTES = 127
"""Longest comment that nftables keeps (NFTNL_UDATA_COMMENT_MAXLEN, with its final zero 128)."""

_MANAGED = "managed-by=lifecycle"
_SYSTEM = re.compile(r"[A-Za-z][A-Za-z0-9_-]*")
_NONE_SUCH = re.compile(r"No such file or directory", re.IGNORECASE)


def table_name(system: str, prefix: str = "flowqos") -> str:
    """Return the name of a system's table, `flowqos_teleop`.

    Raises:
        UsageError: the system's name is not one that a manifest may have.
    """
    if not _SYSTEM.fullmatch(system):
        raise UsageError(
            f"cannot name an nftables table after system {system!r}; "
            f"use letters, digits, '_' and '-', a letter first"
        )
    return f"{prefix}_{system}"


def network_of(rule: FlowRule) -> str:
    """Return how nft calls the family of a rule."""
    return "ip6" if rule.internet_protocol is InternetProtocol.IPV6 else "ip"


def flow_match(rule: FlowRule) -> str:
    """Return what matches the packets of a rule; without its source address where none is known."""
    network, transport = network_of(rule), rule.transport_protocol.value
    source = f"{network} saddr {rule.source_address} " if rule.source_address else ""
    return (
        f"{source}{transport} sport {rule.source_port} "
        f"{network} daddr {rule.destination_address} {transport} dport {rule.destination_port}"
    )


def chain_line(match: str, statement: str, comment: str) -> str:
    """Return one line of a chain, which counts the packets that it matches.

    Of a comment that is too long the end is cut off, which dots say.
    """
    plain = " ".join(comment.replace('"', "'").split())
    if len(encoded := plain.encode()) > MAX_COMMENT_BYTES:
        plain = encoded[: MAX_COMMENT_BYTES - 3].decode(errors="ignore") + "..."
    return f'{match} {statement} counter comment "{plain}"'


def render_table(table: str, lines: Iterable[str], *, priority: str = "mangle") -> str:
    """Return commands for `nft -f` that replace a table in one transaction."""
    text = [
        f"table inet {table} {{",
        f'  comment "{_MANAGED}"',
        "  chain post {",
        f"    type filter hook postrouting priority {priority}; policy accept;",
        *(f"    {each}" for each in dict.fromkeys(lines)),
        "  }",
        "}",
    ]
    return render_table_removal(table) + "\n".join(text) + "\n"


def render_table_removal(table: str) -> str:
    """Return commands for `nft -f` that remove a table, and do so if there is none."""
    # `destroy` would say it in one line, but nftables 1.0.6 does not know the keyword.
    return f"add table inet {table}\ndelete table inet {table}\n"


Placed = Sequence[tuple[FlowRule, Sequence[str]]]
"""Rules, each with its lines of a chain."""


class Wanted(NamedTuple):
    """What the host is to have for some rules.

    Attributes:
        table: for `nft -f`.
        beside: for `tc -batch`, what is made before the table; empty if nothing is.
    """

    table: str
    beside: str = ""


class TableTarget(Target):
    """A table of one system, and what is beside it; both are written and removed as a whole.

    Args:
        means: their ledger says what was written, for who compares or removes it later.
        scope: names it in the ledger.
    """

    def __init__(
        self, settings: Any, means: Means, tool: HostTool | None, *, table: str, scope: str
    ) -> None:
        super().__init__(settings, means)
        self._tool = tool or HostTool()
        self._table = table
        self._record = TargetRecord(target=self.kind, scope=scope)

    @abc.abstractmethod
    def lines(self, rule: FlowRule) -> Sequence[str]:
        """Return the lines of a chain for a rule.

        Raises:
            ValueError: there are none, with the reason.
        """

    @abc.abstractmethod
    def wanted(self, placed: Placed) -> Wanted:
        """Return what the host is to have.

        Raises:
            ValueError: it cannot be had.
        """

    @abc.abstractmethod
    def script(self, wanted: Wanted, remarks: Sequence[str]) -> str:
        """Return the same as a file for people, with these lines of comments."""

    async def found(self) -> bool:
        """Whether what was written is there.

        Raises:
            ProgrammingError: an object of this name is not ours, or may not be read.
        """
        return await self.has_table()

    async def has_begun(self) -> bool:
        """Whether the first of what is written is there."""
        return await self.has_table()

    async def write(self, wanted: Wanted, *, anew: bool) -> None:  # noqa: ARG002 - for what is beside it
        """Write it; `anew` if nothing of it is there, or what is beside the table changes."""
        await self.write_table(wanted.table)

    async def clear(self) -> bool:
        """Remove what is there of ours; return whether there was anything."""
        there = await self.has_table()
        if there:
            await self.write_table(render_table_removal(self._table))
        return there

    async def has_table(self) -> bool:
        """Whether there is our table.

        Raises:
            ProgrammingError: a table of this name is not ours, or may not be read.
        """
        argv = ["nft", "list", "table", "inet", self._table]
        table = f"nft table inet {self._table}"
        output = await self._tool.run(argv)
        if output.returncode != 0:
            if _NONE_SUCH.search(output.stderr):
                return False
            raise failure(output, argv, doing=f"read {table}")
        if _MANAGED not in output.stdout:
            raise ProgrammingError(
                f"cannot use {table}: it exists and is not marked as managed by lifecycle",
                hint=f"look at it: nft list table inet {self._table}",
            )
        return True

    async def write_table(self, text: str) -> None:
        """Have nft take a ruleset, whole or not at all."""
        doing = f"write nft table inet {self._table}"
        await demand(self._tool, ["nft", "-f", "-"], doing=doing, stdin=text)

    def export(self, rules: RuleSet) -> str:
        """Return a file that programs a host, and says in comments what is left out of it."""
        placed, left_out = expressed(rules.rules, self.lines)
        remarks = [f"# {each.named}: {each.describe()}: {each.asks}" for each in rules.rules]
        remarks += [f"# left out: {each}" for each in (*rules.left_out, *left_out)]
        return self.script(self.wanted(placed), remarks)

    async def plan(self, rules: Sequence[FlowRule]) -> TargetChanges:
        """Compare what was written, and whether it is there, with the rules.

        Raises:
            ProgrammingError: what is there is not ours, or may not be read.
        """
        return await self.apply(rules, write=False)

    async def apply(self, rules: Sequence[FlowRule], *, write: bool = True) -> TargetChanges:
        """Write it if anything differs, unless it is only to be compared.

        Raises:
            ProgrammingError: it could not be written; then nothing of ours is left.
        """
        placed, left_out = expressed(rules, self.lines)
        try:
            wanted = self.wanted(placed)
        except ValueError as error:
            raise ProgrammingError(str(error)) from error
        entries = tuple(
            Entry(key=rule.key, what=f"{rule.describe()}, {rule.asks}", body="\n".join(lines))
            for rule, lines in placed
        )
        if write and not entries:
            return replace(await self.remove(), left_out=left_out)
        known, is_there = self._ledger.find(self._record), await self.found()
        anew = known is None or not is_there or known.beside != wanted.beside
        detail = ""
        if known is not None and anew:
            detail = "the classes change" if is_there else "it was gone"
        before = {each.key: each for each in known.entries} if known and is_there else {}
        changes = [_change(each, before.pop(each.key, None), detail) for each in entries]
        changes += [FlowChange(kind=ChangeKind.DELETE, key=key) for key in before]
        done = TargetChanges(target=self.name, changes=tuple(changes), left_out=left_out)
        if write and done.pending:
            await self._write_down(entries, wanted, anew=anew)
        return done

    async def remove(self) -> TargetChanges:
        """Delete what the ledger says is there, if it still is."""
        known = self._ledger.find(self._record)
        if known is None:
            return TargetChanges(target=self.name)
        there = await self.clear()
        self._ledger.put(self._record)
        gone = [FlowChange(kind=ChangeKind.DELETE, key=each.key) for each in known.entries]
        return TargetChanges(target=self.name, changes=tuple(gone) if there else ())

    async def _write_down(self, entries: tuple[Entry, ...], wanted: Wanted, *, anew: bool) -> None:
        """Write it, and in the ledger before and after."""
        nothing_before = self._ledger.find(self._record) is None
        # First without what is written: what a crash in between leaves is written anew.
        begun = tuple(replace(each, body="") for each in entries)
        self._ledger.put(replace(self._record, entries=begun))
        try:
            await self.write(wanted, anew=anew)
        except ProgrammingError as error:
            try:
                if not nothing_before or await self.has_begun():
                    await self.clear()
            except ProgrammingError as left:
                message = f"{error.message}; what was made is left: {left}"
                raise ProgrammingError(message, hint=error.hint) from error
            self._ledger.put(self._record)
            raise
        self._ledger.put(replace(self._record, entries=entries, beside=wanted.beside))


def _change(wanted: Entry, before: Entry | None, detail: str) -> FlowChange:
    kind = ChangeKind.CREATE if before is None else ChangeKind.UPDATE
    if before is not None and before.body == wanted.body and not detail:
        kind = ChangeKind.KEEP
    return FlowChange(kind=kind, key=wanted.key, what=wanted.what, detail=detail)
