"""Parameter files of ROS as rcl reads them, and how a section is matched to a node.

Owns: rcl_yaml_param_parser's parse.c (rcl 9.2), event by event, so that a file means here what it
means to a node, whatever else YAML would make of it: both sections of one name count, a key may be
a number, aliases are refused, a file may hold several documents; what is made of a scalar; how
rclcpp and rclpy match the name of a section to a node. Reads the files.
"""

from __future__ import annotations

import bisect
import contextlib
import math
import os
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

import msgspec

from lifecycle.manifest.diagnostics import Diagnostic, ManifestError, Position, error
from lifecycle.manifest.model import Node, ParameterValue
from lifecycle.manifest.names import namespace_problem, node_name_problem
from lifecycle.manifest.parameter_values import SCALARS, type_of
from lifecycle.manifest.yaml.document import INT64_MAX, INT64_MIN, not_finite, quote, spell_place
from lifecycle.manifest.yaml.source import MAX_VALUES, decode, events, read_bytes

if TYPE_CHECKING:
    import yaml


def _spellings(word: str) -> tuple[str, str, str]:
    return word, word.capitalize(), word.upper()


# get_value(): YAML 1.1 booleans, strtoll with base 0, then strtod.
_TRUE = frozenset(("Y", "y", *_spellings("yes"), *_spellings("true"), *_spellings("on")))
_FALSE = frozenset(("N", "n", *_spellings("no"), *_spellings("false"), *_spellings("off")))
_INTEGER = re.compile(r"\s*([-+]?)(0[xX][0-9a-fA-F]+|0[0-7]*|[1-9][0-9]*)\Z", re.ASCII)
_DOUBLE = re.compile(
    r"\s*[-+]?(inf(inity)?|(nan)(\([0-9a-z_]*\))?|([0-9]+\.?[0-9]*|\.[0-9]+)(e[-+]?[0-9]+)?)\Z",
    re.ASCII | re.IGNORECASE,
)
_HEXADECIMAL = re.compile(
    r"\s*[-+]?0x([0-9a-f]+\.?[0-9a-f]*|\.[0-9a-f]+)(p[-+]?[0-9]+)?\Z", re.ASCII | re.IGNORECASE
)
_LONGEST_INTEGER = 80


def read_scalar(text: str, *, quoted: bool) -> bool | int | float | str:
    """Return what rcl makes of a scalar in a parameter file; `quoted`: it was in quotes there."""
    if quoted:
        return text
    if text in _TRUE or text in _FALSE:
        return text in _TRUE
    if (match := _INTEGER.match(text)) and len(text) <= _LONGEST_INTEGER:
        digits = match[2]
        octal = digits.startswith("0") and digits[1:2] not in ("", "x", "X")
        number = int(f"{match[1]}{digits}", 8 if octal else 0)
        if INT64_MIN <= number <= INT64_MAX:
            return number
    double = _double(text)
    return text if double is None else double


def _double(text: str) -> float | None:
    """Return what rcl reads as a double: YAML's words, else strtod() unless it sets ERANGE."""
    if (found := not_finite(text)) is not None:
        return found
    if _HEXADECIMAL.match(text):
        with contextlib.suppress(OverflowError):
            return float.fromhex(text.strip())
    match = _DOUBLE.match(text)
    if match is None:
        return None
    if match[3]:
        return math.nan
    number, digits = float(text), match[1].lower().partition("e")[0].strip("0.")
    overflows = math.isinf(number) and "inf" not in digits
    underflows = bool(digits) and abs(number) < sys.float_info.min
    return None if overflows or underflows else number


PARAMETERS_KEY = "ros__parameters"

_LAYOUT = f"write 'NODE: {{{PARAMETERS_KEY}: {{NAME: VALUE}}}}'"
_STRING_TAG = "tag:yaml.org,2002:str"
_WILDCARDS = ("*", "**")


class Section(msgspec.Struct, frozen=True, kw_only=True):
    """What a file sets for the nodes that match one name or pattern.

    Attributes:
        pattern: `/robot/camera`, `/**`, `/robot/*`; always with a leading slash.
        parameters: (name, value, position) in the file's order.
    """

    pattern: str
    parameters: tuple[tuple[str, ParameterValue, Position], ...]
    at: Position

    @property
    def is_wildcard(self) -> bool:
        """Whether it may match several nodes."""
        return "*" in self.pattern

    def matches(self, node: str) -> bool:
        """Whether a node with this fully qualified name takes the section's values.

        As parameter_map_from() of rclcpp and rclpy have it: `*` is one part of a name, `**` any
        number of them.
        """
        parts = node.split("/")[1:]
        reached = {0}  # how many of the parts may be matched so far
        for wanted in self.pattern.split("/")[1:]:
            if wanted == "**":
                reached = set(range(min(reached, default=len(parts) + 1), len(parts) + 1))
            else:
                reached = {
                    count + 1
                    for count in reached
                    if count < len(parts) and wanted in ("*", parts[count])
                }
        return len(parts) in reached


class ParameterFile(msgspec.Struct, frozen=True, kw_only=True):
    """What is known of a parameter file.

    Attributes:
        shown: how messages name it.
        sections: in the file's order, each name once; none where it cannot be read.
        flaws: what is wrong with it.
    """

    shown: str
    sections: tuple[Section, ...] = ()
    flaws: tuple[Diagnostic, ...] = ()


def read_parameter_file(path: str, *, shown: str) -> ParameterFile:
    """Read a parameter file, which exists; messages name it as `shown`."""
    reader = _Reader(shown)
    try:
        text = decode(read_bytes(path, file=shown), file=shown)
        for event in events(text, file=shown):
            reader.take(event)
    except ManifestError as problem:
        said = tuple(
            msgspec.structs.replace(each, message=each.message.replace("a manifest", "text"))
            for each in problem.diagnostics
        )
        return ParameterFile(shown=shown, flaws=(*reader.found, *said))
    if reader.found:
        return ParameterFile(shown=shown, flaws=tuple(reader.found))
    return ParameterFile(shown=shown, sections=tuple(reader.sections()))


class _Name(msgspec.Struct):
    """A name that keys inside each other add up to (namespace.c)."""

    separator: str
    text: str = ""
    count: int = 0

    def add(self, key: str) -> None:
        joint = "" if not self.count or self.text.endswith(self.separator) else self.separator
        self.text, self.count = f"{self.text}{joint}{key}", self.count + 1

    def remove(self) -> None:
        """Take the last part away; of a key with separators in it, no more than that."""
        if self.count == 1:
            self.text = ""
        elif self.count and self.separator in self.text:
            self.text = self.text.rpartition(self.separator)[0]
        self.count -= self.count > 0


class _Parameters(msgspec.Struct):
    """Parameters of one section (rcl_node_params_t): names by index, values by index and type."""

    at: Position
    names: list[str] = msgspec.field(default_factory=list)
    places: list[Position] = msgspec.field(default_factory=list)
    values: dict[int, dict[str, ParameterValue]] = msgspec.field(default_factory=dict)
    index: dict[str, list[int]] = msgspec.field(default_factory=dict)

    def find(self, name: str, at: Position) -> int:
        """Return the index of the first parameter of this name, which is added if there is none."""
        known = self.index.setdefault(name, [])
        if not known:
            known.append(len(self.names))
            self.names.append(name)
            self.places.append(at)
        return known[0]

    def rename(self, index: int, name: str, at: Position) -> None:
        self.index[self.names[index]].remove(index)
        bisect.insort(self.index.setdefault(name, []), index)
        self.names[index], self.places[index] = name, at


_BY_TYPE = tuple(f"{each}{array}" for array in ("", "_array") for each in SCALARS.values())
"""A parameter that is given values of several types has the first of these."""


_Keys = list[tuple[str, tuple[int, int]]]


class _Reader:
    """parse_file_events(): what rcl does with each event of libyaml.

    Attributes:
        found: what it refuses.
    """

    def __init__(self, file: str) -> None:
        self.found: list[Diagnostic] = []
        self._file = file
        self._nodes: dict[str, _Parameters] = {}
        self._node: _Parameters | None = None
        self._parameter = 0
        self._of_node = _Name("/")
        self._of_parameter = _Name(".")
        self._in_parameters = False
        self._is_key = True
        self._is_new_map = False
        self._array: list[bool | int | float | str] | None = None
        self._depth = 0
        self._keys: _Keys = []  # the last key of each open mapping
        self._count = 0

    def sections(self) -> Iterator[Section]:
        """Yield what was read."""
        for name, each in self._nodes.items():
            parameters = []
            for index, (parameter, at) in enumerate(zip(each.names, each.places, strict=True)):
                values = each.values.get(index, {})
                types = [type_ for type_ in (*_BY_TYPE, "array") if type_ in values]
                parameters += [(parameter, values[type_], at) for type_ in types[:1]]
            pattern = name if name.startswith("/") else f"/{name}"
            yield Section(pattern=pattern, parameters=tuple(parameters), at=each.at)

    def take(self, event: yaml.Event) -> None:
        """Take one event.

        Raises:
            ManifestError: nothing after it can be read; `found` is what was wrong before.
        """
        import yaml

        start = event.start_mark
        mark = (start.line + 1, start.column + 1) if start else (1, 1)
        if isinstance(event, yaml.NodeEvent):
            self._count += 1
            if self._count > MAX_VALUES:
                self._stop(mark, f"cannot read more than {MAX_VALUES} values")
        if isinstance(event, yaml.ScalarEvent):
            (self._key if self._is_key else self._value)(event, mark)
        elif isinstance(event, yaml.AliasEvent):
            hint = "write it out"
            self._error(mark, "cannot use an alias: ROS reads none in parameter files", hint)
            self._is_key = self._array is None
        elif isinstance(event, yaml.SequenceStartEvent):
            if self._is_key:
                self._stop(
                    mark, "cannot use a list here: it is no key, and holds no lists", _LAYOUT
                )
            if not self._in_parameters:
                self._stop(mark, f"cannot use a list before {PARAMETERS_KEY!r}", _LAYOUT)
            self._array = []
        elif isinstance(event, yaml.SequenceEndEvent):
            self._end_array(mark)
        elif isinstance(event, yaml.MappingStartEvent):
            self._depth += 1
            self._keys.append(("", mark))
            of_node = self._in_parameters and self._depth - self._of_node.count == 3
            self._is_key, self._is_new_map = True, not of_node
        elif isinstance(event, yaml.MappingEndEvent):
            self._end_mapping()

    def _key(self, event: yaml.ScalarEvent, mark: tuple[int, int]) -> None:
        key = event.value
        if self._keys:
            self._keys[-1] = (key, mark)
        if not key:
            self._stop(mark, "cannot use a key without text", "write a name before the colon")
        if self._in_parameters:
            self._parameter_key(key, mark)
        elif key.startswith(PARAMETERS_KEY):
            self._section(mark)
        else:
            self._of_node.add(key)
        self._is_key = False

    def _section(self, mark: tuple[int, int]) -> None:
        if not self._of_node.count:
            message = f"cannot use {PARAMETERS_KEY!r} without a node above it"
            self._stop(mark, message, _LAYOUT)
        name = self._of_node.text
        at = self._position(mark, self._keys[:-1])
        if problem := _name_problem(name):
            self._stop(mark, f"cannot use {quote(name)} as the name of a node: {problem}")
        self._node = self._nodes.setdefault(name, _Parameters(at))
        self._of_node.remove()
        self._in_parameters = True

    def _parameter_key(self, key: str, mark: tuple[int, int]) -> None:
        assert self._node is not None  # a section was begun
        at = self._position(mark, self._keys)
        if self._is_new_map:
            if self._parameter >= len(self._node.names):
                message = f"cannot use a node below the {PARAMETERS_KEY!r} of another"
                self._stop(mark, message, "move it above them, or write it in full")
            self._of_parameter.text = self._node.names[self._parameter]
            self._of_parameter.count += 1
            self._is_new_map = False
        if not self._of_parameter.count:
            self._parameter = self._node.find(key, at)
        else:
            self._parameter = self._node.find(self._of_parameter.text, at)
            self._node.rename(self._parameter, f"{self._of_parameter.text}.{key}", at)

    def _value(self, event: yaml.ScalarEvent, mark: tuple[int, int]) -> None:
        quoted = event.style in ("'", '"')
        value = read_scalar(event.value, quoted=quoted or event.tag == _STRING_TAG)
        if not self._in_parameters:
            self._error(mark, f"cannot use {quote(value)} before {PARAMETERS_KEY!r}", _LAYOUT)
            self._of_node.remove()
            self._is_key = True
            return
        if self._node is None or not self._node.names:
            self._stop(mark, f"cannot use {quote(value)} as parameters", _LAYOUT)
        if not quoted and not event.value:
            name = self._node.names[min(self._parameter, len(self._node.names) - 1)]
            self._error(mark, f"cannot leave parameter {name!r} without a value")
        if self._array is None:
            self._set(value)
            self._is_key = True
        else:
            self._array.append(value)

    def _set(self, value: ParameterValue) -> None:
        assert self._node is not None
        self._node.values.setdefault(self._parameter, {})[type_of(value)] = value

    def _end_array(self, mark: tuple[int, int]) -> None:
        values, self._array = self._array, None
        self._is_key = True
        if values is None:
            return  # the end of a list around another
        types = list(dict.fromkeys(map(type_of, values)))
        if len(types) > 1:
            hint = "write the integers as 1.0" if {*types} == {"int", "double"} else ""
            message = f"cannot mix {' and '.join(types)} in one array; a ROS array holds one type"
            self._error(mark, message, hint)
        else:
            self._set(tuple(values))

    def _end_mapping(self) -> None:
        if self._in_parameters and self._of_parameter.count:
            self._of_parameter.remove()
        elif self._in_parameters:
            self._in_parameters = False
        elif self._depth == self._of_node.count + 1:
            self._of_node.remove()
        self._depth -= 1
        self._keys.pop()

    def _position(self, mark: tuple[int, int], keys: _Keys) -> Position:
        line, column = keys[-1][1] if keys else mark
        path = spell_place([key for key, _ in keys if key])
        return Position(file=self._file, line=line, column=column, path=path)

    def _error(self, mark: tuple[int, int], message: str, hint: str = "") -> None:
        """Note what rcl refuses, and go on to find more."""
        at = self._position(mark, self._keys)
        self.found.append(error("check.parameter-file", at, message, hint))

    def _stop(self, mark: tuple[int, int], message: str, hint: str = "") -> NoReturn:
        self._error(mark, message, hint)
        raise ManifestError(())


def _name_problem(name: str) -> str:
    """Return why rcl takes this for no name of nodes (_validate_name()); empty if it does."""
    *spaces, base = name.removeprefix("/").split("/")
    for each in spaces:
        if not each:
            return "it has two '/' in a row"
        if each not in _WILDCARDS and (problem := namespace_problem(f"/{each}")):
            return problem
    return "" if base in _WILDCARDS else node_name_problem(base)


class ParameterFiles:
    """The parameter files of one system, each read once.

    Args:
        manifest: path of the manifest, beside which files are named in messages.
    """

    def __init__(self, manifest: str) -> None:
        self._folder = Path(manifest).parent
        self._files: dict[str, ParameterFile] = {}

    def given(self, node: Node) -> Iterator[tuple[str, ParameterValue, Position]]:
        """Yield what a node's files set for it: name, value and place, later ones last."""
        for path in node.parameter_files:
            for section in self.read(path).sections:
                if section.matches(node.full_name):
                    yield from section.parameters

    def read(self, path: str) -> ParameterFile:
        """Return what an absolute path holds."""
        if path not in self._files:
            # relpath, not relative_to: a file may well lie beside the manifest's folder.
            shown = os.path.normpath(self._folder / os.path.relpath(path, self._folder))
            self._files[path] = read_parameter_file(path, shown=shown)
        return self._files[path]
