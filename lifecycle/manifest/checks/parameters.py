"""Checks of ROS parameters and parameter files (YAML) against the parameters an interface declares.

Owns: check.parameter-undeclared, check.parameter-type, check.parameter-unused, also for values in
files; check.parameter-file, check.parameter-file-unmatched; check.mode for parameters of modes;
whether a value fits a type of rcl_interfaces/ParameterType, and what rcl makes of a scalar in a
parameter file; the layout that rcl_yaml_param_parser reads (namespaces and node names down to
`ros__parameters`, parameters nested with dots) and how rclcpp and rclpy match a section to a node.
Reads the files.

An interface that declares no parameters leaves them open, so nothing is checked then.
"""

from __future__ import annotations

import contextlib
import math
import os
import re
import sys
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

import msgspec
from msgspec.structs import replace

from lifecycle.errors import did_you_mean
from lifecycle.manifest.checks.system import DeclaredSystem
from lifecycle.manifest.diagnostics import Diagnostic, ManifestError, Position, Severity
from lifecycle.manifest.model import ModeParameter, Node, ParameterValue, RunKind
from lifecycle.manifest.nodl import nearest_file
from lifecycle.manifest.yaml.document import Document, Place, Value, error, note, warning
from lifecycle.manifest.yaml.source import read_document
from lifecycle.manifest.yaml.yaml_parser import EMPTY, INT64_MAX, INT64_MIN, not_finite, quote

_SCALARS = {bool: "bool", int: "int", float: "double", str: "string"}
_IMPLICIT = ("use_sim_time", "start_type_description_service")


def _spellings(word: str) -> tuple[str, str, str]:
    return word, word.capitalize(), word.upper()


# rcl_yaml_param_parser's get_value(): YAML 1.1 booleans, strtoll with base 0, then strtod.
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


def is_implicit(name: str) -> bool:
    """Whether ROS declares this parameter itself, in every node or for every topic."""
    return name in _IMPLICIT or name.startswith("qos_overrides.")


def type_of(value: ParameterValue) -> str:
    """Return a value's type, `int`, `string_array`; `array` for an empty array, which fits all."""
    if isinstance(value, tuple):
        return f"{_SCALARS[type(value[0])]}_array" if value else "array"
    return _SCALARS[type(value)]


def misfit(value: ParameterValue, declared: str) -> str:
    """Return how a value fails its declared type, to follow "cannot set … to "; empty if it fits.

    ROS converts nothing: an integer for a double ends the node when it declares the parameter.
    """
    given = type_of(value)
    bytes_given = declared == "byte_array" and given == "int_array"
    if given == declared or (given == "array" and declared.endswith("_array")):
        return ""
    if bytes_given and isinstance(value, tuple):
        if all(isinstance(each, int) and 0 <= each <= 0xFF for each in value):
            return ""
        return f"{_show(value)}: a byte_array holds 0 to 255"
    article = "an" if given[0] in "ai" else "a"
    return f"{_show(value)}: it is {article} {given}, declared is {declared}"


def suggestion(value: ParameterValue, declared: str) -> str:
    """Return how to write the value so that it fits; empty if not known."""
    if declared == "double" and isinstance(value, int) and not isinstance(value, bool):
        return f"write {float(value)}"
    if declared == "string" and not isinstance(value, (str, tuple)):
        return "put it in quotes"
    if declared == "double_array" and type_of(value) == "int_array" and isinstance(value, tuple):
        return f"write [{', '.join(str(float(each)) for each in value)}]"
    if declared.endswith("_array") and not isinstance(value, tuple):
        return f"write [{_show(value)}]"
    return ""


def read_scalar(text: str, *, quoted: bool) -> bool | int | float | str:
    """Return what rcl makes of a scalar in a parameter file.

    Args:
        text: as written, without quotes.
        quoted: it was written in quotes.
    """
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


def _show(value: ParameterValue) -> str:
    if isinstance(value, tuple):
        return f"[{', '.join(quote(each) for each in value[:4])}{', …' if len(value) > 4 else ''}]"
    return quote(value)


def check_parameters(system: DeclaredSystem, files: ParameterFiles) -> Iterator[Diagnostic]:
    """Yield findings about the parameters of every node."""
    names: dict[str, set[str]] = {}
    for node in system.manifest.nodes:
        names.setdefault(node.process_name, set()).add(node.name)
    for node in system.manifest.nodes:
        yield from _given(node)
        yield from _no_effect(node)
        yield from _for_no_node(node, names[node.process_name])
        yield from _empty_arrays(node, files)


def _given(node: Node) -> Iterator[Diagnostic]:
    declared = {each.name: each for each in node.interface.parameters}
    for name, value in node.parameters:
        at = node.where(f"parameters.{name}")
        declaration = declared.get(name)
        if declaration is not None:
            if problem := misfit(value, declaration.type):
                message = f"cannot set parameter {name!r} to {problem}"
                yield error(
                    "check.parameter-type", at, message, suggestion(value, declaration.type)
                )
        elif declared and not is_implicit(name) and f"parameters.{name}" not in node.shared:
            message = f"cannot set parameter {name!r}: the interface declares no such parameter"
            hint = did_you_mean(name, declared) or "declare it under 'interface.parameters'"
            yield error("check.parameter-undeclared", at, message, hint)
    at = node.where("run.command")
    for each in command_line_parameters(node):
        declaration = declared.get(each.name)
        read = given_value(each.text)
        if declaration is None or read is None or each.node not in ("", node.name):
            continue
        if problem := misfit(read, declaration.type):
            message = f"cannot set parameter {each.name!r} of {node.key!r} by '-p' to {problem}"
            yield error("check.parameter-type", at, message, suggestion(read, declaration.type))


def _for_no_node(node: Node, names: Collection[str]) -> Iterator[Diagnostic]:
    """Warn of values on a command line for a node that its process is not declared to have."""
    at = node.where("run.command")
    for each in command_line_parameters(node):
        if each.node and each.node not in names:
            message = (
                f"cannot tell what takes '-p {each.node}:{each.name}': no node {each.node!r} is "
                f"declared in the process of {node.key!r}"
            )
            listed = ", ".join(map(repr, sorted(names)))
            hint = did_you_mean(each.node, names) or f"declared there: {listed}"
            yield warning("check.parameter-for-no-node", at, message, hint)


def _empty_arrays(node: Node, files: ParameterFiles) -> Iterator[Diagnostic]:
    """Warn of empty arrays whose type nothing declares: rcl reads none from `[]`."""
    if node.interface.parameters:
        return  # one that those do not declare is reported as such
    given: list[tuple[str, ParameterValue | None, Position]] = [
        (name, value, node.where(f"parameters.{name}")) for name, value in node.parameters
    ]
    given += [
        (each.name, given_value(each.text), node.where("run.command"))
        for each in command_line_parameters(node)
        if each.name and each.node in ("", node.name)
    ]
    given += [
        each
        for path in node.parameter_files
        for section in files.read(path).sections
        if section.matches(node.full_name)
        for each in section.parameters
    ]
    for name, value, at in given:
        if value == ():
            message = f"cannot tell the type of {name!r} of {node.key!r}: [] has none in ROS"
            hint = f"declare it: 'interface: {{parameters: {{{name}: {{type: string_array}}}}}}'"
            yield warning("check.parameter-empty-array", at, message, hint)


def check_mode_parameters(system: DeclaredSystem, files: ParameterFiles) -> Iterator[Diagnostic]:
    """Yield findings about parameters that modes cannot set, or not set back."""
    modes = system.manifest.modes
    for mode in modes:
        for each in mode.parameters:
            what = f"cannot set parameter {each.name!r} of {each.node!r} in mode {mode.name!r}"
            node = system.nodes.get(each.node)
            if node is None:
                hint = did_you_mean(each.node, system.nodes)
                yield error("check.mode", each.at, f"{what}: no such node", hint)
            elif why := _never_set(node, each):
                yield error("check.mode", each.at, f"{what}{why[0]}", why[1])
            elif not _is_given(node, each.name, files):
                others = [
                    other.name
                    for other in modes
                    if all(
                        (one.node, one.name) != (each.node, each.name) for one in other.parameters
                    )
                ]
                if others:
                    why_not = f"what it is in mode {others[0]!r} is not known"
                    hint = f"give it there, or in 'nodes.{each.node}.parameters'"
                    yield error("check.mode", each.at, f"{what}: {why_not}", hint)


def _never_set(node: Node, given: ModeParameter) -> tuple[str, str] | None:
    """Say why a mode cannot set a parameter, and what to do; None if it may."""
    if node.run.kind is RunKind.ATTACH and not node.run.component:
        return ": it is attached, and its parameters are only verified", "remove it from the mode"
    declared = {each.name: each for each in node.interface.parameters}
    declaration = declared.get(given.name)
    if declaration is None:
        if not declared or is_implicit(given.name):
            return None
        hint = did_you_mean(given.name, declared) or "declare it under 'interface.parameters'"
        return ": its interface declares no such parameter", hint
    if declaration.read_only:
        return ": it is read-only", "remove it from the mode"
    if problem := misfit(given.value, declaration.type):
        return f" to {problem}", suggestion(given.value, declaration.type)
    return None


def _is_given(node: Node, name: str, files: ParameterFiles) -> bool:
    """Return whether it is known what a parameter is in a mode that says nothing of it."""
    if name in dict(node.parameters):
        return True
    if any(each.name == name and each.default is not None for each in node.interface.parameters):
        return True
    return any(
        name == found
        for path in node.parameter_files
        for section in files.read(path).sections
        if section.matches(node.full_name)
        for found, _, _ in section.parameters
    )


def _no_effect(node: Node) -> Iterator[Diagnostic]:
    """Warn of values that an attached node is judged by but never given."""
    if node.run.kind is not RunKind.ATTACH or node.run.component:
        return
    own = [f"parameters.{name}" for name, _ in node.parameters]
    places = [(place, "parameters") for place in own if place not in node.shared]
    places += [
        (f"parameter_files.{i}", "parameter files") for i in range(len(node.parameter_files))
    ]
    for place, what in places[:1]:
        message = f"cannot give {what} to {node.key!r}, which is attached: they are only verified"
        hint = "give them where it is started"
        yield note("check.parameter-unused", node.where(place), message, hint)


class CommandParameter(NamedTuple):
    """What a command line sets of parameters: a file, or one parameter.

    Attributes:
        file: absolute path; else empty.
        node: the base name of the only node that takes it; empty for all of the process.
        name: of the parameter, and `text` its value as written.
    """

    file: str = ""
    node: str = ""
    name: str = ""
    text: str = ""


def command_line_parameters(node: Node) -> Iterator[CommandParameter]:
    """Yield what a node's own `command:` sets of parameters, as rcl's parser reads it.

    That is between `--ros-args` and `--`: `-p name:=value`, which may begin with the name of a
    node, and `--params-file`.
    """
    words = iter(node.run.command)
    for word in words:
        if word != "--ros-args":
            continue
        for option in words:
            if option == "--":
                break
            if option in ("-p", "--param"):
                name, separator, text = next(words, "").partition(":=")
                base, _, alone = name.rpartition(":")
                if separator:
                    yield CommandParameter(node=base, name=alone, text=text)
            elif option == "--params-file":
                folder = node.run.working_directory or os.curdir
                path = os.path.abspath(os.path.join(folder, next(words, "")))  # noqa: PTH100, PTH118
                yield CommandParameter(file=path)


def given_value(text: str) -> ParameterValue | None:
    """Return what rcl makes of a value on a command line; None of anything but plain scalars.

    `[]` is an empty array, although rcl itself takes nothing from it.
    """
    if len(text) > 1 and text[0] == text[-1] in "'\"" and not {text[0], "\\"} & set(text[1:-1]):
        return read_scalar(text[1:-1], quoted=True)
    if re.fullmatch(r"\s*\[\s*\]\s*", text):
        return ()
    if not text or text[0] in "[{'\"!&*|>%@`,#?" or ": " in text or " #" in text:
        return None
    return read_scalar(text, quoted=False)


PARAMETERS_KEY = "ros__parameters"

_LAYOUT = f"write 'NODE: {{{PARAMETERS_KEY}: {{NAME: VALUE}}}}'"


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

        As parameter_map_from() of rclcpp and rclpy have it for names: `*` is one part of a name,
        `**` any number of them. What else a regular expression could say there is taken literally.
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


def read_sections(path: str, *, shown: str) -> tuple[tuple[Section, ...], tuple[Diagnostic, ...]]:
    """Read a parameter file.

    Args:
        path: the file, which exists.
        shown: how messages name it.

    Returns:
        Sections in the file's order, and what is wrong with the file.
    """
    flaws: list[Diagnostic] = []
    try:
        document = read_document(path, shown=shown, found=flaws)
    except ManifestError as problem:
        if [each.message for each in problem.diagnostics] == [EMPTY]:
            return (), ()
        return (), tuple(_reworded(each) for each in problem.diagnostics)
    # Infinite doubles, and integers that are too long and become doubles, are legal for rcl.
    broken = [_reworded(each) for each in flaws if each.rule != "yaml.number"]
    if broken:
        return (), tuple(broken)
    reading = _Reading(document)
    reading.walk((), document.root)
    return tuple(reading.sections), tuple(reading.found)


def _reworded(each: Diagnostic) -> Diagnostic:
    """Make a finding about a manifest's text one about a parameter file's."""
    if each.rule == "yaml.tag":
        # rcl reads `!!str`; the reader that is shared with manifests reads no tags at all.
        message = "cannot check the parameters of this file: it holds a YAML tag"
        return replace(each, severity=Severity.WARNING, message=message, hint="")
    hint = _LAYOUT if "manifest_version" in each.hint else each.hint
    return replace(each, hint=hint, message=each.message.replace("a manifest", "text"))


class _Reading:
    def __init__(self, document: Document) -> None:
        self._document = document
        self.sections: list[Section] = []
        self.found: list[Diagnostic] = []

    def walk(self, place: Place, value: Value) -> None:
        """Go down namespaces and node names until `ros__parameters`."""
        if not isinstance(value.data, Mapping):
            message = f"cannot use {quote(value.plain())} before {PARAMETERS_KEY!r}"
            self._error(place, message, _LAYOUT)
            return
        if value.alias:
            self._alias(place)
        above = False
        for key, inner in value.data.items():
            if key != PARAMETERS_KEY:
                if above and _has_section(inner):
                    message = f"cannot use a node below the {PARAMETERS_KEY!r} of another"
                    self._error((*place, key), message, "move it above them, or write it in full")
                self.walk((*place, key), inner)
            elif not place:
                message = f"cannot use {PARAMETERS_KEY!r} without a node above it"
                self._error((key,), message, _LAYOUT)
            elif isinstance(inner.data, Mapping):
                above = True
                self._section(place, inner)
            else:
                self._error((*place, key), f"cannot use {quote(inner.plain())} as parameters")

    def _section(self, place: Place, value: Value) -> None:
        if value.alias:
            self._alias((*place, PARAMETERS_KEY))
        pattern = re.sub("/+", "/", "/" + "/".join(str(each) for each in place))
        parameters: list[tuple[str, ParameterValue, Position]] = []
        self._flatten((*place, PARAMETERS_KEY), "", value, parameters)
        at = self._document.key_at(place)
        self.sections.append(Section(pattern=pattern, parameters=tuple(parameters), at=at))

    def _flatten(
        self,
        place: Place,
        prefix: str,
        value: Value,
        parameters: list[tuple[str, ParameterValue, Position]],
    ) -> None:
        assert isinstance(value.data, Mapping)
        for key, inner in value.data.items():
            where: Place = (*place, key)
            name = f"{prefix}{key}"
            if inner.alias:
                self._alias(where)
            elif isinstance(inner.data, Mapping):
                self._flatten(where, f"{name}.", inner, parameters)
            elif isinstance(inner.data, tuple):
                if (array := self._array(where, inner.data)) is not None:
                    parameters.append((name, array, self._document.key_at(where)))
            elif inner.text or inner.quoted:
                scalar = read_scalar(inner.text, quoted=inner.quoted)
                parameters.append((name, scalar, self._document.key_at(where)))
            else:
                self._error(where, f"cannot leave parameter {name!r} without a value")

    def _array(self, place: Place, items: tuple[Value, ...]) -> ParameterValue | None:
        if any(each.alias for each in items):
            self._alias(place)
            return None
        if any(isinstance(each.data, (tuple, Mapping)) for each in items):
            self._error(place, "cannot nest in an array; a ROS array holds scalars of one type")
            return None
        values = tuple(read_scalar(each.text, quoted=each.quoted) for each in items)
        types = list(dict.fromkeys(type_of(each) for each in values))
        if len(types) > 1:
            hint = "write the integers as 1.0" if set(types) == {"int", "double"} else ""
            message = f"cannot mix {' and '.join(types)} in one array; a ROS array holds one type"
            self._error(place, message, hint)
            return None
        return values

    def _alias(self, place: Place) -> None:
        self._error(place, "cannot use an alias: ROS reads none in parameter files", "write it out")

    def _error(self, place: Place, message: str, hint: str = "") -> None:
        at = self._document.key_at(place)
        self.found.append(error("check.parameter-file", at, message, hint))


def _has_section(value: Value) -> bool:
    data = value.data if isinstance(value.data, Mapping) else {}
    return PARAMETERS_KEY in data or any(map(_has_section, data.values()))


class ParameterFile(msgspec.Struct, frozen=True, kw_only=True):
    """What is known of a parameter file.

    Attributes:
        shown: how messages name it.
        sections: in the file's order; none where it cannot be read.
        flaws: what is wrong with it.
    """

    shown: str
    sections: tuple[Section, ...]
    flaws: tuple[Diagnostic, ...]


class ParameterFiles:
    """The parameter files of one system, each read once.

    Args:
        manifest: path of the manifest, beside which files are named in messages.
    """

    def __init__(self, manifest: str) -> None:
        self._folder = Path(manifest).parent
        self._files: dict[str, ParameterFile] = {}

    def read(self, path: str) -> ParameterFile:
        """Return what an absolute path holds."""
        if path not in self._files:
            # relpath, not relative_to: a file may well lie beside the manifest's folder.
            shown = os.path.normpath(self._folder / os.path.relpath(path, self._folder))
            sections, flaws = read_sections(path, shown=shown)
            self._files[path] = ParameterFile(shown=shown, sections=sections, flaws=flaws)
        return self._files[path]


def check_parameter_files(system: DeclaredSystem, files: ParameterFiles) -> Iterator[Diagnostic]:
    """Yield findings about every parameter file that a node names."""
    readers: dict[str, list[Node]] = {}
    for node in system.manifest.nodes:
        for index, path in enumerate(node.parameter_files):
            if path not in readers:
                yield from _flaws(path, files.read(path), node.where(f"parameter_files.{index}"))
            readers.setdefault(path, []).append(node)
    for node in system.manifest.nodes:
        yield from _unmatched_file_of_command(node, system, files)
    for path, nodes in readers.items():
        file = files.read(path)
        for node in () if file.flaws else nodes:
            yield from _unmatched_node(path, file, node)
            yield from _values(file, node)
        yield from _unmatched_sections(file, system)
        yield from _unknown_to_all(file, nodes)


def _flaws(path: str, file: ParameterFile, at: Position) -> Iterator[Diagnostic]:
    if os.path.lexists(path):
        yield from file.flaws
        return
    message = f"cannot find the parameter file {file.shown!r}"
    yield error("check.parameter-file", at, message, nearest_file(Path(path)))


def _unmatched_node(path: str, file: ParameterFile, node: Node) -> Iterator[Diagnostic]:
    name = node.full_name
    if any(section.matches(name) for section in file.sections):
        return
    at = node.where(f"parameter_files.{node.parameter_files.index(path)}")
    patterns = [section.pattern for section in file.sections]
    listed = ", ".join(repr(each) for each in patterns) or "no node"
    message = f"cannot find node {name!r} in {file.shown!r}: it is for {listed}"
    hint = f"name the section {name}, or /** for every node"
    yield warning("check.parameter-file-unmatched", at, message, hint)


def _unmatched_file_of_command(
    node: Node, system: DeclaredSystem, files: ParameterFiles
) -> Iterator[Diagnostic]:
    """Warn of sections of a command's `--params-file` that are for no node, or not for its own."""
    paths = [each.file for each in command_line_parameters(node) if each.file]
    if not paths:
        return
    process = node.process_name
    every = [each.full_name for each in system.manifest.nodes]
    names = [e.full_name for e in system.manifest.nodes if process == e.process_name]
    for file in map(files.read, paths):
        at = node.where("run.command")
        mine = [each for each in file.sections if any(map(each.matches, names))]
        # One file for many processes has sections for the nodes of others.
        for section in file.sections:
            if not mine or not any(map(section.matches, every)):
                message = (
                    f"cannot use the parameters of {section.pattern!r} in {file.shown!r}: no node "
                    f"of the process of {node.key!r} has that name"
                )
                hint = did_you_mean(section.pattern, names)
                yield warning("check.parameter-file-unmatched", at, message, hint)


def _unmatched_sections(file: ParameterFile, system: DeclaredSystem) -> Iterator[Diagnostic]:
    """Warn of sections that match no node in a file of which others do: most are misspelt."""
    names = [node.full_name for node in system.manifest.nodes]
    dead = [each for each in file.sections if not any(each.matches(name) for name in names)]
    if len(dead) == len(file.sections):
        return  # reported where the file is named
    for section in dead:
        message = f"cannot use the parameters of {section.pattern!r}: no node has that name"
        hint = did_you_mean(section.pattern, names)
        yield warning("check.parameter-file-unmatched", section.at, message, hint)


def _values(file: ParameterFile, node: Node) -> Iterator[Diagnostic]:
    declared = {each.name: each for each in node.interface.parameters}
    for section in file.sections:
        if not section.matches(node.full_name):
            continue
        for name, value, at in section.parameters:
            declaration = declared.get(name)
            if declaration is not None:
                if problem := misfit(value, declaration.type):
                    message = f"cannot set parameter {name!r} of {node.full_name!r} to {problem}"
                    hint = suggestion(value, declaration.type)
                    yield error("check.parameter-type", at, message, hint)
            elif declared and not section.is_wildcard and not is_implicit(name):
                message = (
                    f"cannot set parameter {name!r} of {node.full_name!r}: "
                    f"its interface declares no such parameter"
                )
                hint = did_you_mean(name, declared)
                yield error("check.parameter-undeclared", at, message, hint)


def _unknown_to_all(file: ParameterFile, readers: list[Node]) -> Iterator[Diagnostic]:
    """Warn of a value for many nodes that none of them declares; some not declaring it is usual."""
    for section in file.sections:
        nodes = [node for node in readers if section.matches(node.full_name)]
        if not section.is_wildcard or not nodes:
            continue
        if not all(node.interface.parameters for node in nodes):
            continue
        known = {each.name for node in nodes for each in node.interface.parameters}
        for name, _, at in section.parameters:
            if name not in known and not is_implicit(name):
                message = f"cannot set parameter {name!r}: no node that reads it declares it"
                yield warning("check.parameter-undeclared", at, message, did_you_mean(name, known))
