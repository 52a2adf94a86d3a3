"""Expected parameter values of a node: declared parameters with the values that override them.

Values are taken, weakest first, from a declaration's default, what a `command:` itself sets after
`--ros-args`, the parameter files, and `parameters:`. Among the sections of files rcl has an order
of its own (measured, rclpy 7.1): sections of one name are one, at the place of the first of them,
and of those that match a node the later wins. `-p` goes into the section `/**`.
"""

from __future__ import annotations

from typing import NamedTuple

from msgspec.structs import replace

from lifecycle.manifest.checks.parameters import (
    CommandParameter,
    command_line_parameters,
    given_value,
)
from lifecycle.manifest.diagnostics import Position
from lifecycle.manifest.model import Mode, Node, ParameterDeclaration, ParameterValue
from lifecycle.manifest.parameter_files import ParameterFiles
from lifecycle.manifest.parameter_values import as_type, misfit, portable, type_of
from lifecycle.plan.model import ExpectedParameter

GIVEN = "parameters"
COMMAND = "command"
DEFAULT = "default_value"
"""Sources of a value, as the manifest spells them; the fourth kind is a file's name."""


class _Given(NamedTuple):
    value: ParameterValue | None  # None: it is given, and what it is is not known here
    source: str
    optional: bool
    at: Position


class NodeParameters:
    """What parameters the nodes of one manifest must have, by its files and in its modes."""

    def __init__(self, files: ParameterFiles, modes: tuple[Mode, ...] = ()) -> None:
        self._files = files
        self._modes = modes

    def expected(self, node: Node) -> tuple[ExpectedParameter, ...]:
        """Return what a node's parameters must be: the declared ones first, then the given ones."""
        given = self._given(node)
        declared = tuple(
            _declared(each, given.pop(each.name, None)) for each in node.interface.parameters
        )
        undeclared = (
            _expected(name, type_of(each.value), each)
            for name, each in given.items()
            if each.value is not None
        )
        return (*declared, *undeclared)

    def in_modes(
        self, node: Node, expected: tuple[ExpectedParameter, ...]
    ) -> dict[str, tuple[ExpectedParameter, ...]]:
        """Return, by mode, what the parameters are that some mode sets; empty if none does."""
        known = {each.name: each for each in expected}
        types = {each.name: each.type for each in node.interface.parameters}
        found: dict[str, dict[str, ExpectedParameter]] = {}
        for mode in self._modes:
            found[mode.name] = {}
            for each in mode.parameters:
                if each.node == node.key:
                    type_ = types.get(each.name) or type_of(each.value)
                    given = _Given(each.value, f"mode {mode.name}", optional=False, at=each.at)
                    found[mode.name][each.name] = _expected(each.name, type_, given)
        names = dict.fromkeys(name for values in found.values() for name in values)
        return {
            mode: tuple({**known, **values}[name] for name in names if name in {*known, *values})
            for mode, values in found.items()
            if names
        }

    def unread(self, node: Node) -> tuple[str, ...]:
        """Return the files of a node whose values are not known here."""
        named = [each.file for each in command_line_parameters(node) if each.file]
        files = map(self._files.read, (*named, *node.parameter_files))
        return tuple(each.shown for each in files if each.flaws)

    def _given(self, node: Node) -> dict[str, _Given]:
        name_of_node = node.full_name
        sections: dict[str, dict[str, _Given]] = {}
        own = [each for each in command_line_parameters(node) if each.node in ("", node.name)]
        files = [CommandParameter(file=each) for each in node.parameter_files]
        for path, base, name, text in (*own, *files):
            if not path:
                value = given_value(text)
                # What all nodes of a process are given only some of them need have.
                optional = bool(node.process) and not base
                given = _Given(value, COMMAND, optional=optional, at=node.at)
                sections.setdefault("/**", {})[name] = given
                continue
            file = self._files.read(path)
            for section in file.sections:
                if section.matches(name_of_node):
                    sections.setdefault(section.pattern, {}).update(
                        (name, _Given(value, file.shown, section.is_wildcard, at))
                        for name, value, at in section.parameters
                    )
        found: dict[str, _Given] = {}
        for section_values in sections.values():
            for name, given in section_values.items():
                optional = given.optional and (name not in found or found[name].optional)
                found[name] = given._replace(optional=optional)
        for name, value in node.parameters:
            place = f"parameters.{name}"
            found[name] = _Given(value, GIVEN, place in node.shared, node.where(place))
        return found


def _declared(declaration: ParameterDeclaration, given: _Given | None) -> ExpectedParameter:
    type_ = declaration.type
    if given is None and declaration.default is not None:
        default = as_type(declaration.default, type_)
        if not misfit(default, type_):
            given = _Given(default, DEFAULT, optional=False, at=declaration.at)
    if given is None:
        given = _Given(None, "", optional=False, at=declaration.at)
    found = _expected(declaration.name, type_, given)
    return replace(found, read_only=declaration.read_only, optional=False)


def _expected(name: str, type_: str, given: _Given) -> ExpectedParameter:
    return ExpectedParameter(
        name=name,
        type=type_,
        value=None if given.value is None else portable(as_type(given.value, type_)),
        source="" if given.value is None else given.source,
        optional=given.optional,
        at=given.at,
    )
