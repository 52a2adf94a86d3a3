"""Hardened YAML 1.2 parser on PyYAML's events: positions, limits, and types of plain scalars.

Owns: every limit on what a document may hold (values, depth, aliases, tags, keys, numbers), and the
one place where text becomes bool, int, float, null or string; used for scalars as written and again
for a scalar that was one whole substitution. Pure.

The limits are checked event by event, before anything is built or expanded, so that a hostile
document costs no more than reading it up to the offence. No constructor of PyYAML ever runs.

Unquoted scalars follow YAML 1.2.2 §10.3.2, the core schema. So `yes`, `on`, `off` and `1:30` are
strings here, and `0o17` is octal. In one thing the rules are narrower, as JSON is: an integer does
not begin with 0. Of `017` YAML 1.1 makes fifteen and 1.2 seventeen, of `018` a string and eighteen,
and writers of 1.1 do write the string '018' bare. A string is what no reader can take for another
number.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, NoReturn

import msgspec
from msgspec.structs import replace

from lifecycle.manifest.diagnostics import Diagnostic, ManifestError, Position
from lifecycle.manifest.yaml.document import Document, Place, Scalar, Value, error, spell_place

if TYPE_CHECKING:
    import yaml

EMPTY = "cannot read an empty file"

INT64_MIN = -(2**63)
INT64_MAX = 2**63 - 1
"""ROS integers are int64 (rcl_interfaces/ParameterValue)."""

YAML_1_1_BOOLEANS = frozenset(
    spelled
    for word in ("y", "yes", "on", "n", "no", "off")
    for spelled in (word, word.capitalize(), word.upper())
)
"""Booleans of YAML 1.1 (and of rcl's parameter files) that YAML 1.2 reads as strings."""

_NULL = frozenset({"", "~", "null", "Null", "NULL"})
_TRUE = frozenset({"true", "True", "TRUE"})
_FALSE = frozenset({"false", "False", "FALSE"})
_DECIMAL = re.compile(r"[-+]?(0|[1-9][0-9]*)\Z")
_LEADING_ZERO = re.compile(r"[-+]?0[0-9]+\Z")
_OCTAL = re.compile(r"0o[0-7]+\Z")
_HEXADECIMAL = re.compile(r"0x[0-9a-fA-F]+\Z")
_FLOAT = re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?\Z")
_INFINITE = re.compile(r"[-+]?\.(inf|Inf|INF)\Z")
_NOT_A_NUMBER = frozenset({".nan", ".NaN", ".NAN"})
_LONGEST_INT = 80  # digits; int() is quadratic in them and refuses 4300, INT64_MIN has 19


def resolve(text: str) -> Scalar:
    """Return what the unquoted scalar `text` means.

    `.inf` and `.nan` are doubles; where they may be written is `may_be_any_double`'s.

    Raises:
        ValueError: a number that is too large for a double or does not fit into 64 bits; the
            message is a phrase that follows "cannot use '…': ".
    """
    if text in _NULL:
        return None
    if text in _TRUE:
        return True
    if text in _FALSE:
        return False
    for pattern, base in ((_DECIMAL, 10), (_OCTAL, 8), (_HEXADECIMAL, 16)):
        if pattern.match(text):
            return _integer(text, base)
    if _FLOAT.match(text) and not has_leading_zero(text):
        number = float(text)
        if math.isfinite(number):
            return number
        raise ValueError(_FINITE)
    special = not_finite(text)
    return text if special is None else special


_FINITE = "a number must be finite"


def not_finite(text: str) -> float | None:
    """Return the double that YAML's `.inf`, `-.INF`, `.NaN` … spell; None of anything else."""
    if text in _NOT_A_NUMBER:
        return math.nan
    return float(text.replace(".", "")) if _INFINITE.match(text) else None


_NAMED = frozenset({"nodes", "groups", "modes", "machines", "arguments"})
"""Sections whose keys users choose: one that is called `parameters` is none."""


def may_be_any_double(place: Place) -> bool:
    """Whether a number there may be infinite or none: values of parameters, and only those."""
    return any(
        each == "extra_arguments"
        or (each == "parameters" and (index == 0 or place[index - 1] not in _NAMED))
        for index, each in enumerate(place)
    )


def check_finite(number: object, place: Place) -> None:
    """Raise the ValueError of `resolve` for a number that must be finite at this place."""
    if isinstance(number, float) and not math.isfinite(number) and not may_be_any_double(place):
        raise ValueError(_FINITE)


def has_leading_zero(text: str) -> bool:
    """Whether this is digits that versions of YAML read as different values."""
    return _LEADING_ZERO.match(text) is not None


def _integer(text: str, base: int) -> int:
    if len(text) <= _LONGEST_INT:
        number = int(text, base)
        if INT64_MIN <= number <= INT64_MAX:
            return number
    raise ValueError("an integer must fit into 64 bits, -2**63 to 2**63-1")


def quote(value: object, *, limit: int = 60) -> str:
    """Spell a value for a message: as YAML would show it, cut to `limit` characters."""
    if value is None:
        return "null"
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, dict):
        return "a mapping"
    if isinstance(value, (list, tuple)):
        return "a list"
    spelled = repr(value)
    return spelled if len(spelled) <= limit else f"{spelled[: limit - 2]}…{spelled[-1]}"


MAX_VALUES = 100_000
"""Values in one document, aliases expanded; 10,000 endpoints take about half of it."""

MAX_DEPTH = 64
"""Mappings and sequences inside each other, aliases expanded."""

MAX_ALIASES = 1_000
"""Aliases in one document."""

_UNFIT = re.compile("[\0\ud800-\udfff]")
# Escapes may spell what no file name, argument or message can hold.

MAX_FINDINGS = 200
"""Findings of one document; a document with more is given up."""

_SHOWN_DEPTH = 8  # steps of a document path in a message that ends the reading


class _Frame(msgspec.Struct):
    """A collection that is still open."""

    place: Place
    line: int
    column: int
    anchor: str | None
    mapping: dict[str, Value] | None  # None for a sequence
    items: list[Value]
    key: str | None = None
    key_mark: tuple[int, int] = (1, 1)
    skip: bool = False  # the key was refused: its value is read and dropped
    values: int = 1  # with everything inside, aliases expanded
    height: int = 1


class _Anchored(msgspec.Struct, frozen=True):
    value: Value
    values: int
    height: int


def events(text: str, *, file: str) -> Iterator[yaml.Event]:
    """Yield the parser's events.

    Raises:
        ManifestError: the text is no YAML.
    """
    import yaml  # others need no more of this module than how a value is spelled

    try:
        yield from yaml.parse(text, Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader))
    except yaml.YAMLError as problem:
        mark = getattr(problem, "problem_mark", None) or getattr(problem, "context_mark", None)
        line, column = (mark.line + 1, mark.column + 1) if mark else (1, 1)
        why = getattr(problem, "problem", None) or str(problem)
        at = Position(file=file, line=line, column=column)
        said = error("yaml.syntax", at, *_explain(why, text, line, column))
        raise ManifestError([said]) from problem


def compose(text: str, *, file: str) -> tuple[Document, tuple[Diagnostic, ...]]:
    """Read one YAML document.

    Args:
        text: decoded, without byte order mark.
        file: path for messages.

    Returns:
        The document, and what is wrong with single values and keys: tags, merge keys, keys that
        are doubled or no strings, numbers out of range. Refused keys are left out.

    Raises:
        ManifestError: not YAML, over a limit, or more or less than one document; with what was
            found up to there.
    """
    return _Composer(file).run(text)


class _Composer:
    """Builds values bottom-up from events; holds the open collections on a stack."""

    def __init__(self, file: str) -> None:
        self._file = file
        self._stack: list[_Frame] = []
        self._anchors: dict[str, _Anchored | None] = {}  # None while still open
        self._found: list[Diagnostic] = []
        self._values = 0
        self._aliases = 0
        self._root: Value | None = None

    def run(self, text: str) -> tuple[Document, tuple[Diagnostic, ...]]:
        import yaml

        for event in self._events(text):
            start = event.start_mark
            mark = (start.line + 1, start.column + 1) if start else (1, 1)
            if isinstance(event, yaml.DocumentStartEvent) and self._root is not None:
                self._stop(
                    mark, "cannot read more than one document in a file", "remove this '---'"
                )
            elif isinstance(event, yaml.AliasEvent):
                self._alias(event.anchor, mark)
            elif isinstance(event, (yaml.MappingStartEvent, yaml.SequenceStartEvent)):
                self._open(event, mark, mapping=isinstance(event, yaml.MappingStartEvent))
            elif isinstance(event, (yaml.MappingEndEvent, yaml.SequenceEndEvent)):
                self._close()
            elif isinstance(event, yaml.ScalarEvent):
                self._scalar(event, mark)
        if self._root is None:
            self._stop((1, 1), EMPTY, "start with 'manifest_version: 1'")
        return Document(file=self._file, root=self._root), tuple(self._found)

    def _events(self, text: str) -> Iterator[yaml.Event]:
        try:
            yield from events(text, file=self._file)
        except ManifestError as problem:
            raise ManifestError([*self._found, *problem.diagnostics]) from problem

    # -- events

    def _open(
        self, event: yaml.CollectionStartEvent, mark: tuple[int, int], *, mapping: bool
    ) -> None:
        self._refuse_tag(event.tag, mark)
        if self._wants_key():
            self._stop(
                mark, f"cannot use a {'mapping' if mapping else 'list'} as a key", "use a string"
            )
        if len(self._stack) >= MAX_DEPTH:
            self._stop(mark, f"cannot read values nested deeper than {MAX_DEPTH} levels")
        self._count(1, mark)
        self._reserve(event.anchor)
        frame = _Frame(
            place=self._next_place(),
            line=mark[0],
            column=mark[1],
            anchor=event.anchor,
            mapping={} if mapping else None,
            items=[],
        )
        self._stack.append(frame)

    def _close(self) -> None:
        frame = self._stack.pop()
        data: tuple[Value, ...] | Mapping[str, Value] = (
            tuple(frame.items) if frame.mapping is None else frame.mapping
        )
        value = Value(data=data, line=frame.line, column=frame.column)
        self._finish(value, frame.anchor, frame.values, frame.height)

    def _scalar(self, event: yaml.ScalarEvent, mark: tuple[int, int]) -> None:
        self._refuse_tag(event.tag, mark)
        self._count(1, mark)
        self._reserve(event.anchor)
        if _UNFIT.search(event.value):
            message = f"cannot use {_cut(event.value)}: it holds a NUL or half a character"
            self._note("yaml.character", mark, message, "remove the escape")
        # libyaml has "" for a plain scalar, PyYAML None; '!' makes a string (YAML 1.2.2 §6.9.1).
        quoted = bool(event.style) or event.tag == "!"
        data: Scalar = event.value
        if not quoted:
            try:
                data = resolve(event.value)
                check_finite(data, self._next_place())
            except ValueError as problem:
                self._note("yaml.number", mark, f"cannot use {_cut(event.value)}: {problem}")
        if self._wants_key():
            self._key(data, event, mark)
            return
        value = Value(data=data, line=mark[0], column=mark[1], text=event.value, quoted=quoted)
        self._finish(value, event.anchor, 1, 0)

    def _alias(self, anchor: str | None, mark: tuple[int, int]) -> None:
        if self._wants_key():
            self._stop(mark, f"cannot use the alias '*{anchor}' as a key", "write the key out")
        self._aliases += 1
        if self._aliases > MAX_ALIASES:
            self._stop(mark, f"cannot read more than {MAX_ALIASES} aliases")
        if anchor is None or anchor not in self._anchors:
            self._stop(mark, f"cannot find the anchor '&{anchor}' above this alias")
        anchored = self._anchors[anchor]
        if anchored is None:
            self._stop(mark, f"cannot use the alias '*{anchor}' inside its own anchor")
        self._count(anchored.values, mark)
        if len(self._stack) + anchored.height > MAX_DEPTH:
            self._stop(mark, f"cannot read values nested deeper than {MAX_DEPTH} levels")
        value = replace(anchored.value, line=mark[0], column=mark[1])
        self._finish(value, None, anchored.values, anchored.height)

    def _key(self, data: Scalar, event: yaml.ScalarEvent, mark: tuple[int, int]) -> None:
        frame = self._stack[-1]
        assert frame.mapping is not None
        frame.key, frame.key_mark, frame.skip = event.value, mark, True
        if event.value == "<<" and not event.style:
            self._note(
                "yaml.merge-key",
                mark,
                "cannot use the merge key '<<': YAML 1.2 has none",
                "write the keys out, or use an alias for a whole value",
            )
        elif not isinstance(data, str):
            hint = f'write "{event.value}"' if event.value else "write the key before the colon"
            self._note("yaml.key", mark, f"cannot use {_cut(event.value)} as a key", hint)
        elif event.value in frame.mapping:
            first = frame.mapping[event.value].key
            assert first is not None
            self._note(
                "yaml.duplicate-key",
                mark,
                f"cannot use the key {_cut(event.value)} twice",
                f"remove one; the first stands at {self._file}:{first[0]}:{first[1]}",
                (*frame.place, event.value),
            )
        else:
            frame.skip = False

    # -- the stack

    def _finish(self, value: Value, anchor: str | None, values: int, height: int) -> None:
        """Put a complete value where it belongs."""
        if anchor is not None:
            self._anchors[anchor] = _Anchored(value, values, height)
        if not self._stack:
            self._root = value
            return
        frame = self._stack[-1]
        frame.values += values
        frame.height = max(frame.height, height + 1)
        if frame.mapping is None:
            frame.items.append(value)
            return
        assert frame.key is not None
        if not frame.skip:
            frame.mapping[frame.key] = replace(value, key=frame.key_mark)
        frame.key = None

    def _wants_key(self) -> bool:
        return (
            bool(self._stack)
            and self._stack[-1].mapping is not None
            and self._stack[-1].key is None
        )

    def _next_place(self) -> Place:
        if not self._stack:
            return ()
        frame = self._stack[-1]
        if frame.mapping is None:
            return (*frame.place, len(frame.items))
        return frame.place if frame.key is None else (*frame.place, frame.key)

    def _reserve(self, anchor: str | None) -> None:
        if anchor is not None:
            self._anchors[anchor] = None

    def _count(self, values: int, mark: tuple[int, int]) -> None:
        self._values += values
        if self._values > MAX_VALUES:
            self._stop(mark, f"cannot read more than {MAX_VALUES} values, aliases expanded")

    # -- findings

    def _refuse_tag(self, tag: str | None, mark: tuple[int, int]) -> None:
        if tag is not None and tag != "!":
            spelled = tag.replace("tag:yaml.org,2002:", "!!")
            self._note(
                "yaml.tag",
                mark,
                f"cannot use the tag {_cut(spelled)}: a manifest is data only",
                "remove the tag; quotes make a string",
            )

    def _position(self, mark: tuple[int, int], place: Place | None = None) -> Position:
        where = self._next_place() if place is None else place
        return Position(file=self._file, line=mark[0], column=mark[1], path=spell_place(where))

    def _note(
        self,
        rule: str,
        mark: tuple[int, int],
        message: str,
        hint: str = "",
        place: Place | None = None,
    ) -> None:
        """Record a finding and go on, unless there are too many."""
        if len(self._found) == MAX_FINDINGS:
            self._stop(mark, f"cannot list more than {MAX_FINDINGS} findings", "fix these first")
        self._found.append(error(rule, self._position(mark, place), message, hint))

    def _stop(self, mark: tuple[int, int], message: str, hint: str = "") -> NoReturn:
        """Give up at once, with everything found so far."""
        at = self._position(mark, self._next_place()[:_SHOWN_DEPTH])
        raise ManifestError([*self._found, error("yaml.limit", at, message, hint)])


def _cut(text: str) -> str:
    return quote(text)


def _explain(why: str, text: str, line: int, column: int) -> tuple[str, str]:
    """Return a parser's reason as a phrase and a hint; libyaml's and PyYAML's wordings differ."""
    if "mapping values are not allowed" in why:
        return "cannot read a second ': ' in this value", "put the value in quotes"
    if "cannot start any token" in why:
        rows = text.splitlines()
        row = rows[line - 1] if line <= len(rows) else ""
        character = row[column - 1] if column <= len(row) else ""
        if character == "\t":
            return "cannot use a tab for indentation", "indent with spaces"
        return f"cannot start a value with {character!r}", "put the value in quotes"
    hint = "look for a missing quote, bracket, colon or a wrong indentation here or just above"
    return f"cannot read this as YAML: {why}", hint
