"""Remap rules as `ros2 run … --ros-args -r RULE` takes them: what each one matches.

Owns: the grammar of one rule, as rcl's argument parser has it (rcl/arguments.c, rcl/lexer.c):
`[node:][rostopic://|rosservice://]from:=to`, `[node:]__node:=name`, `[node:]__ns:=/namespace`.
Applying rules to names is `names`'. Pure.
"""

from __future__ import annotations

import dataclasses
import enum
import functools
import re

from lifecycle.errors import ExitCode, LifecycleError

# rcl's lexer: a token has no two underscores in a row and does not start with a digit.
_WORD = r"(?![0-9])(?:(?!__)[A-Za-z0-9_])+"
_NAME = re.compile(rf"(?:~/|/)?{_WORD}(?:/{_WORD})*", re.ASCII)
_NODE_PREFIX = re.compile(rf"({_WORD}):(?!//)(.*)", re.ASCII | re.DOTALL)
_ONE_WORD = re.compile(_WORD, re.ASCII)
_NAMESPACE = re.compile(rf"/|(?:/{_WORD})+", re.ASCII)


class RemapKind(enum.Flag):
    """What a rule may rename; a plain `from:=to` renames topics and services alike."""

    TOPIC = enum.auto()
    SERVICE = enum.auto()
    NODE_NAME = enum.auto()
    NAMESPACE = enum.auto()


class RemapRuleError(LifecycleError):
    """A remap rule that rcl refuses; a process that is given one does not start."""

    exit_code = ExitCode.MANIFEST_INVALID


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class RemapRule:
    """One rule.

    Attributes:
        node: base name of the only node it is for; empty for every node.
        match: name it replaces, not yet expanded; empty for node name and namespace rules.
        replacement: what takes its place, not yet expanded.
    """

    kind: RemapKind
    node: str
    match: str
    replacement: str

    def applies_to(self, kind: RemapKind, node_name: str) -> bool:
        """Tell whether rcl looks at this rule at all for a name of `kind` in node `node_name`."""
        return bool(self.kind & kind) and self.node in ("", node_name)


@functools.lru_cache(maxsize=1 << 12)
def parse_rule(match: str, replacement: str) -> RemapRule:
    """Read the two sides of `match:=replacement`.

    Raises:
        RemapRuleError: rcl would refuse it.
    """
    node, rest = "", match
    if prefix := _NODE_PREFIX.fullmatch(match):
        node, rest = prefix[1], prefix[2]
    if rest in ("__node", "__name"):
        _require(_ONE_WORD, replacement, "a node name, as in '__node:=camera'")
        return RemapRule(kind=RemapKind.NODE_NAME, node=node, match="", replacement=replacement)
    if rest == "__ns":
        _require(_NAMESPACE, replacement, "an absolute namespace, as in '__ns:=/robot'")
        return RemapRule(kind=RemapKind.NAMESPACE, node=node, match="", replacement=replacement)
    kind = RemapKind.TOPIC | RemapKind.SERVICE
    for scheme, only in (("rostopic://", RemapKind.TOPIC), ("rosservice://", RemapKind.SERVICE)):
        if rest.startswith(scheme):
            kind, rest = only, rest[len(scheme) :]
    if "*" in rest:
        raise RemapRuleError(f"cannot remap {match!r}: rcl has no wildcards in remap rules")
    _require(_NAME, rest, "a name, as in 'scan', '~/scan' or '/robot/scan'")
    _require(_NAME, replacement, "a name, as in 'scan', '~/scan' or '/robot/scan'")
    return RemapRule(kind=kind, node=node, match=rest, replacement=replacement)


def _require(pattern: re.Pattern[str], text: str, what: str) -> None:
    if pattern.fullmatch(text):
        return
    why = "rcl allows no '__' there" if "__" in text else f"it must be {what}"
    raise RemapRuleError(f"cannot use {text!r} in a remap rule: {why}")
