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
    return _Composer(text, file).run()


_Mark = tuple[int, int]
"""Line and column, from 1."""


def _mark(event: yaml.Event) -> _Mark:
    start = event.start_mark
    return (start.line + 1, start.column + 1) if start else (1, 1)


class _Composer:
    """Builds values from events; `MAX_DEPTH` bounds how deep it calls itself."""

    def __init__(self, text: str, file: str) -> None:
        self._file = file
        self._events = self._parse(text)
        self._anchors: dict[str, Value | None] = {}  # None while still open
        self._found: list[Diagnostic] = []
        self._values = 0
        self._aliases = 0

    def _parse(self, text: str) -> Iterator[yaml.Event]:
        try:
            yield from events(text, file=self._file)
        except ManifestError as problem:
            raise ManifestError([*self._found, *problem.diagnostics]) from problem

    def run(self) -> tuple[Document, tuple[Diagnostic, ...]]:
        import yaml

        root = None
        for event in self._events:
            if isinstance(event, yaml.DocumentStartEvent) and root is not None:
                message = "cannot read more than one document in a file"
                self._stop(_mark(event), (), message, "remove this '---'")
            elif isinstance(event, yaml.NodeEvent):
                root = self._node(event, ())
        if root is None:
            self._stop((1, 1), (), EMPTY, "start with 'manifest_version: 1'")
        return Document(file=self._file, root=root), tuple(self._found)

    def _node(self, event: yaml.Event, place: Place) -> Value:
        """Return what begins with an event; its place has a step for each collection around it."""
        import yaml

        mark = _mark(event)
        if isinstance(event, yaml.AliasEvent):
            return self._alias(event.anchor, mark, place)
        if isinstance(event, yaml.ScalarEvent):
            value = self._scalar(event, place)
        else:
            assert isinstance(event, yaml.CollectionStartEvent)
            self._refuse_tag(event.tag, mark, place)
            if len(place) >= MAX_DEPTH:
                self._stop(mark, place, _TOO_DEEP)
            self._begin(event, place)
            is_mapping = isinstance(event, yaml.MappingStartEvent)
            data = self._mapping(place) if is_mapping else self._sequence(place)
            value = Value(data=data, line=mark[0], column=mark[1])
        if event.anchor is not None:
            self._anchors[event.anchor] = value
        return value

    def _begin(self, event: yaml.NodeEvent, place: Place) -> None:
        self._count(_mark(event), place)
        if event.anchor is not None:
            self._anchors[event.anchor] = None

    def _sequence(self, place: Place) -> tuple[Value, ...]:
        import yaml

        inside: list[Value] = []
        while not isinstance(event := next(self._events), yaml.SequenceEndEvent):
            inside.append(self._node(event, (*place, len(inside))))
        return tuple(inside)

    def _mapping(self, place: Place) -> dict[str, Value]:
        import yaml

        data: dict[str, Value] = {}
        while not isinstance(event := next(self._events), yaml.MappingEndEvent):
            key, is_kept = self._key(event, data, place)
            value = self._node(next(self._events), (*place, key))
            if is_kept:
                data[key] = replace(value, key=_mark(event))
        return data

    def _scalar(self, event: yaml.ScalarEvent, place: Place) -> Value:
        mark = _mark(event)
        self._refuse_tag(event.tag, mark, place)
        self._begin(event, place)
        if _UNFIT.search(event.value):
            message = f"cannot use {quote(event.value)}: it holds a NUL or half a character"
            self._note("yaml.character", mark, place, message, "remove the escape")
        # libyaml has "" for a plain scalar, PyYAML None; '!' makes a string (YAML 1.2.2 §6.9.1).
        quoted = bool(event.style) or event.tag == "!"
        data: Scalar = event.value
        if not quoted:
            try:
                data = resolve(event.value)
                check_finite(data, place)
            except ValueError as problem:
                message = f"cannot use {quote(event.value)}: {problem}"
                self._note("yaml.number", mark, place, message)
        return Value(data=data, line=mark[0], column=mark[1], text=event.value, quoted=quoted)

    def _alias(self, anchor: str | None, mark: _Mark, place: Place) -> Value:
        self._aliases += 1
        if self._aliases > MAX_ALIASES:
            self._stop(mark, place, f"cannot read more than {MAX_ALIASES} aliases")
        if anchor is None or anchor not in self._anchors:
            self._stop(mark, place, f"cannot find the anchor '&{anchor}' above this alias")
        anchored = self._anchors[anchor]
        if anchored is None:
            self._stop(mark, place, f"cannot use the alias '*{anchor}' inside its own anchor")
        self._expand(anchored, len(place), mark, place)
        return replace(anchored, line=mark[0], column=mark[1])

    def _expand(self, value: Value, depth: int, mark: _Mark, place: Place) -> None:
        """Count what an alias stands for, as if it was written out at a place."""
        self._count(mark, place)
        if isinstance(value.data, (tuple, dict)):
            if depth >= MAX_DEPTH:
                self._stop(mark, place, _TOO_DEEP)
            for each in value.data.values() if isinstance(value.data, dict) else value.data:
                self._expand(each, depth + 1, mark, place)

    def _key(self, event: yaml.Event, known: Mapping[str, Value], place: Place) -> tuple[str, bool]:
        """Return a key of the mapping at a place, and whether its value is kept."""
        import yaml

        mark = _mark(event)
        if isinstance(event, yaml.AliasEvent):
            message = f"cannot use the alias '*{event.anchor}' as a key"
            self._stop(mark, place, message, "write the key out")
        if isinstance(event, yaml.CollectionStartEvent):
            self._refuse_tag(event.tag, mark, place)
            what = "mapping" if isinstance(event, yaml.MappingStartEvent) else "list"
            self._stop(mark, place, f"cannot use a {what} as a key", "use a string")
        assert isinstance(event, yaml.ScalarEvent)
        key, value = event.value, self._scalar(event, place)
        if key == "<<" and not event.style:
            message = "cannot use the merge key '<<': YAML 1.2 has none"
            hint = "write the keys out, or use an alias for a whole value"
            self._note("yaml.merge-key", mark, (*place, key), message, hint)
        elif not isinstance(value.data, str):
            hint = f'write "{key}"' if key else "write the key before the colon"
            self._note("yaml.key", mark, (*place, key), f"cannot use {quote(key)} as a key", hint)
        elif key in known:
            line, column = known[key].key or mark
            message = f"cannot use the key {quote(key)} twice"
            hint = f"remove one; the first stands at {self._file}:{line}:{column}"
            self._note("yaml.duplicate-key", mark, (*place, key), message, hint)
        else:
            return key, True
        return key, False

    def _count(self, mark: _Mark, place: Place) -> None:
        self._values += 1
        if self._values > MAX_VALUES:
            self._stop(mark, place, f"cannot read more than {MAX_VALUES} values, aliases expanded")

    def _refuse_tag(self, tag: str | None, mark: _Mark, place: Place) -> None:
        if tag is not None and tag != "!":
            spelled = tag.replace("tag:yaml.org,2002:", "!!")
            message = f"cannot use the tag {quote(spelled)}: a manifest is data only"
            self._note("yaml.tag", mark, place, message, "remove the tag; quotes make a string")

    def _position(self, mark: _Mark, place: Place) -> Position:
        return Position(file=self._file, line=mark[0], column=mark[1], path=spell_place(place))

    def _note(self, rule: str, mark: _Mark, place: Place, message: str, hint: str = "") -> None:
        """Record a finding and go on, unless there are too many."""
        if len(self._found) == MAX_FINDINGS:
            what = f"cannot list more than {MAX_FINDINGS} findings"
            self._stop(mark, place, what, "fix these first")
        self._found.append(error(rule, self._position(mark, place), message, hint))

    def _stop(self, mark: _Mark, place: Place, message: str, hint: str = "") -> NoReturn:
        """Give up at once, with everything found so far."""
        at = self._position(mark, place[:_SHOWN_DEPTH])
        raise ManifestError([*self._found, error("yaml.limit", at, message, hint)])


_TOO_DEEP = f"cannot read values nested deeper than {MAX_DEPTH} levels"


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
