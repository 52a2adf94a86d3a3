"""Read a YAML file safely: what a path and a text may hold, and values with positions from it.

Owns: every way in which a path may be no readable text, and every limit on what a document may hold
(values, depth, aliases, tags, keys). Nothing but a regular file is read, and of that at most one
byte over the limit. Limits are checked event by event of PyYAML, before anything is built or
expanded; none of its constructors ever runs.
"""

from __future__ import annotations

import contextlib
import os
import re
import stat
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import NoReturn

import yaml
from msgspec.structs import replace

from lifecycle.manifest.diagnostics import Diagnostic, ManifestError, Position, error
from lifecycle.manifest.yaml.document import (
    Document,
    Place,
    Scalar,
    Value,
    quote,
    resolve,
    spell_place,
)

MAX_BYTES = 1 << 20
"""Size limit of one file, 1 MiB."""

_NOT_TEXT = re.compile(
    "[\0-\x08\x0b\x0c\x0e-\x1f\x7f-\x84\x86-\x9f]|[\ud800-\udfff]|[\ufffe\uffff]"
)
"""Characters that YAML 1.2.2 §5.1 does not allow in a document; one set of all takes 3 ms."""


def read_document(path: str | Path, *, shown: str = "") -> Document:
    """Read one file as a YAML document whose root is a mapping; `shown` names it in messages.

    Raises:
        ManifestError: with the one reason why it cannot be read, or all doubled keys, tags and
            impossible numbers at once.
    """
    file = shown or str(path)
    text = decode(read_bytes(path, file=file), file=file)
    return parse(text, file=file)


def parse(text: str, *, file: str) -> Document:
    """Parse text as `read_document` does."""
    document, findings = compose(text, file=file)
    if findings:
        raise ManifestError(findings)
    plain = document.root.data
    if not isinstance(plain, Mapping):
        at = document.at()
        if plain is None:
            raise ManifestError([error("yaml.empty", at, EMPTY, _START)])
        message = f"cannot use {quote(plain)} as a whole document; it must be a mapping of keys"
        is_launch = quote(plain).startswith("'<launch")
        hint = f"write a manifest from it: lifecycle import {file}" if is_launch else _START
        raise ManifestError([error("yaml.root", at, message, hint)])
    return document


_READ = os.O_RDONLY
for _flag in ("O_NONBLOCK", "O_CLOEXEC", "O_BINARY"):  # a platform has those that it needs
    # O_NONBLOCK: opening a FIFO without a writer must not wait for one.
    _READ |= getattr(os, _flag, 0)

_START = "start with 'manifest_version: 1'"


def read_bytes(path: str | Path, *, file: str) -> bytes:
    """Read a regular file of at most `MAX_BYTES`.

    Raises:
        ManifestError: missing, unreadable, not a regular file, or too large.
    """
    try:
        descriptor = os.open(path, _READ)
    except (OSError, ValueError) as problem:
        reason = problem.strerror if isinstance(problem, OSError) else str(problem)
        raise _refuse(file, f"cannot open {quote(str(path), limit=200)}: {reason}") from problem
    status = os.fstat(descriptor)
    kind = "" if stat.S_ISREG(status.st_mode) else "a special file"
    kind = "a directory" if stat.S_ISDIR(status.st_mode) else kind
    for each in ("/proc", "/sys"):
        # Every file there claims to be a regular one; reading /proc/kmsg waits, and takes away.
        with contextlib.suppress(OSError):
            if os.stat(each).st_dev == status.st_dev:  # noqa: PTH116 - of a text
                kind = kind or "a file that the kernel makes up (/proc, /sys)"
    if kind:
        os.close(descriptor)
        raise _refuse(file, f"cannot read {kind} as a manifest", "name a regular file")
    with os.fdopen(descriptor, "rb") as stream:
        try:
            data: bytes | None = stream.read(MAX_BYTES + 1)
        except OSError as problem:  # a network file system, a broken disk, much of /proc
            raise _refuse(file, f"cannot read this file: {problem.strerror}") from problem
        if data is None:  # O_NONBLOCK: /proc/kmsg and its like never end, they wait
            message = "cannot read a file that has no end and nothing to read"
            raise _refuse(file, message, "name a regular file")
        if len(data) > MAX_BYTES:
            size = max(status.st_size, len(data))
            message = f"cannot read a file of {size} bytes; at most {MAX_BYTES} are allowed"
            raise _refuse(file, message, "split it with 'include:'")
    return data


def decode(data: bytes, *, file: str) -> str:
    """Decode UTF-8, with or without byte order mark, and refuse what is no text.

    Raises:
        ManifestError: not UTF-8, a NUL byte, or a control character.
    """
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as problem:
        before = data[: problem.start].decode("utf-8-sig", errors="replace")
        byte = f"0x{data[problem.start]:02x}"
        message = f"cannot read byte {byte} as UTF-8: {problem.reason}"
        raise _refuse(file, message, "save the file as UTF-8", before) from problem
    match = _NOT_TEXT.search(text)
    if match:
        name = "a NUL byte" if match[0] == "\0" else f"the control character U+{ord(match[0]):04X}"
        raise _refuse(file, f"cannot read {name}", "remove it", text[: match.start()])
    return text


def _refuse(file: str, message: str, hint: str = "", before: str = "") -> ManifestError:
    line = before.count("\n") + 1
    column = len(before) - (before.rfind("\n") + 1) + 1
    at = Position(file=file, line=line, column=column)
    return ManifestError([error("yaml.file", at, message, hint)])


EMPTY = "cannot read an empty file"

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
    """Yield the parser's events; ManifestError where the text is no YAML."""
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
    """Read one YAML document; messages name it `file`.

    Returns:
        The document, and what is wrong with single values and keys: tags, merge keys, keys that
        are doubled or no strings, numbers out of range. Refused keys are left out.

    Raises:
        ManifestError: not YAML, over a limit, or more or less than one document.
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
        self._events = events(text, file=file)
        self._anchors: dict[str, Value | None] = {}  # None while still open
        self._found: list[Diagnostic] = []
        self._values = 0
        self._aliases = 0

    def run(self) -> tuple[Document, tuple[Diagnostic, ...]]:
        root = None
        try:
            for event in self._events:
                if isinstance(event, yaml.DocumentStartEvent) and root is not None:
                    message = "cannot read more than one document in a file"
                    self._stop(_mark(event), (), message, "remove this '---'")
                elif isinstance(event, yaml.NodeEvent):
                    root = self._node(event, ())
            if root is None:
                self._stop((1, 1), (), EMPTY, _START)
        except ManifestError as problem:
            raise ManifestError([*self._found, *problem.diagnostics]) from problem
        return Document(file=self._file, root=root), tuple(self._found)

    def _node(self, event: yaml.Event, place: Place) -> Value:
        """Return what begins with an event; its place has a step for each collection around it."""
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
            self._count(mark, place)
            if event.anchor is not None:
                self._anchors[event.anchor] = None
            data: tuple[Value, ...] | dict[str, Value]
            if isinstance(event, yaml.MappingStartEvent):
                data = self._mapping(place)
            else:
                inside: list[Value] = []
                while not isinstance(each := next(self._events), yaml.SequenceEndEvent):
                    inside.append(self._node(each, (*place, len(inside))))
                data = tuple(inside)
            value = Value(data=data, line=mark[0], column=mark[1])
        if event.anchor is not None:
            self._anchors[event.anchor] = value
        return value

    def _mapping(self, place: Place) -> dict[str, Value]:
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
        self._count(mark, place)
        if _UNFIT.search(event.value):
            message = f"cannot use {quote(event.value)}: it holds a NUL or half a character"
            self._note("yaml.character", mark, place, message, "remove the escape")
        # libyaml has "" for a plain scalar, PyYAML None; '!' makes a string (YAML 1.2.2 §6.9.1).
        quoted = bool(event.style) or event.tag == "!"
        data: Scalar = event.value
        if not quoted:
            try:
                data = resolve(event.value, place)
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
            hint = f"remove one; the first is at {self._file}:{line}:{column}"
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
        """Give up at once."""
        at = self._position(mark, place[:_SHOWN_DEPTH])
        raise ManifestError([error("yaml.limit", at, message, hint)])


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
