"""Data as YAML text that reads back the same here, in YAML 1.1 and in YAML 1.2.

Owns: when a scalar needs quotes, how comments stand beside what they are about, and that the same
data give the same text. Pure.
"""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Union

Scalar = Union[bool, int, float, str]  # noqa: UP007 - a run-time alias on Python 3.10
Tree = Union[Scalar, "Noted", Sequence["Tree"], Mapping[str, "Tree"]]


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Noted:
    """A value with a comment on its line."""

    value: Tree
    note: str


_PLAIN = re.compile(r"[A-Za-z_/][A-Za-z0-9_/.-]*")
_WORDS = frozenset({"null", "true", "false", "yes", "no", "on", "off", "y", "n"})
"""Words that some version of YAML does not read as strings, in any spelling of case."""

_ESCAPES = {"\\": "\\\\", '"': '\\"', "\n": "\\n", "\t": "\\t", "\r": "\\r"}


def to_yaml(tree: Mapping[str, Tree]) -> str:
    """Return a block style document of `tree`, in its own order."""
    return "\n".join(_mapping(tree, "")) + "\n"


def comment(text: str) -> str:
    """Return one comment line; what would end it is shown as a space."""
    return "# " + "".join(each if each.isprintable() else " " for each in text)


def scalar(value: Scalar) -> str:
    """Return a scalar as YAML.

    Raises:
        ValueError: a number that is not finite; manifests have none.
    """
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int):
        return str(value)
    if isinstance(value, float):
        if not math.isfinite(value):
            raise ValueError(f"cannot write {value!r} as YAML: a number must be finite")
        # YAML 1.1 takes 1e+16 for a string.
        mantissa, e, exponent = repr(value).partition("e")
        return f"{mantissa if '.' in mantissa else mantissa + '.0'}{e}{exponent}"
    if _PLAIN.fullmatch(value) and value.lower() not in _WORDS:
        return value
    return '"' + "".join(map(_character, value)) + '"'


def _character(each: str) -> str:
    if each in _ESCAPES:
        return _ESCAPES[each]
    if each.isprintable():
        return each
    code = ord(each)
    if code == 0 or 0xD800 <= code <= 0xDFFF:  # a manifest can hold neither
        return "\N{REPLACEMENT CHARACTER}"
    return f"\\x{code:02x}" if code < 0x100 else f"\\U{code:08x}"


def _mapping(tree: Mapping[str, Tree], indent: str) -> Iterator[str]:
    for key, value in tree.items():
        yield from _entry(f"{indent}{scalar(key)}:", value, indent + "  ")


def _entry(head: str, value: Tree, indent: str) -> Iterator[str]:
    note = ""
    if isinstance(value, Noted):
        note, value = "  " + comment(value.note), value.value
    if isinstance(value, Mapping):
        yield f"{head}{'' if value else ' {}'}{note}"
        yield from _mapping(value, indent)
    elif isinstance(value, (bool, int, float, str)):
        yield f"{head} {scalar(value)}{note}"
    elif isinstance(value, Noted):
        raise TypeError("cannot comment on one line twice")
    elif all(isinstance(each, (bool, int, float, str)) for each in value):
        yield f"{head} [{', '.join(scalar(each) for each in value)}]{note}"  # type: ignore[arg-type]
    else:
        yield f"{head}{note}"
        for each in value:
            yield from _item(each, indent)


def _item(value: Tree, indent: str) -> Iterator[str]:
    """One item of a list: its first line carries the dash."""
    lines = _mapping(value, "") if isinstance(value, Mapping) else _entry("", value, "  ")
    for index, line in enumerate(lines):
        yield f"{indent}{'  ' if index else '- '}{line.removeprefix(' ') if not index else line}"
