"""ROS parameter files: text → sections, one for each node or pattern that the file names.

Owns: the layout that rcl_yaml_param_parser reads (namespaces and node names down to
`ros__parameters`, parameters nested with dots) and how rclcpp and rclpy match a section to a node.
"""

from __future__ import annotations

import dataclasses
import functools
import re
from collections.abc import Mapping

from lifecycle.manifest.checks.parameters.parameter_types import read_scalar, type_of
from lifecycle.manifest.diagnostics import Diagnostic, ManifestError, Position, Severity
from lifecycle.manifest.model import ParameterValue
from lifecycle.manifest.yaml.document import Document, Place, Value, error
from lifecycle.manifest.yaml.scalars import quote
from lifecycle.manifest.yaml.source import read_document

PARAMETERS_KEY = "ros__parameters"

_LAYOUT = f"write 'NODE: {{{PARAMETERS_KEY}: {{NAME: VALUE}}}}'"


@functools.cache
def _pattern(name: str) -> re.Pattern[str] | None:
    # parameter_map_from() of rclcpp and rclpy: every "/*" becomes "(/\w+)", so "/**" "(/\w+)*".
    try:
        return re.compile(name.replace("/*", r"(/\w+)"), re.ASCII)
    except re.error:
        return None


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Section:
    """What a file sets for the nodes that one name or pattern stands for.

    Attributes:
        pattern: `/robot/camera`, `/**`, `/robot/*`; always with a leading slash.
        parameters: (name, value, position) in the file's order.
    """

    pattern: str
    parameters: tuple[tuple[str, ParameterValue, Position], ...]
    at: Position

    @property
    def is_wildcard(self) -> bool:
        """Whether it may stand for several nodes."""
        return "*" in self.pattern

    def matches(self, node: str) -> bool:
        """Tell whether a node with this fully qualified name takes the section's values."""
        pattern = _pattern(self.pattern)
        return pattern is not None and pattern.fullmatch(node) is not None


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
        return dataclasses.replace(each, severity=Severity.WARNING, message=message, hint="")
    hint = _LAYOUT if "manifest_version" in each.hint else each.hint
    return dataclasses.replace(each, hint=hint, message=each.message.replace("a manifest", "text"))


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
        for key, inner in value.data.items():
            if key != PARAMETERS_KEY:
                self.walk((*place, key), inner)
            elif not place:
                message = f"cannot use {PARAMETERS_KEY!r} without a node above it"
                self._error((key,), message, _LAYOUT)
            elif isinstance(inner.data, Mapping):
                self._section(place, inner)
            elif inner.data is not None:
                self._error((*place, key), f"cannot use {quote(inner.plain())} as parameters")

    def _section(self, place: Place, value: Value) -> None:
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
            if isinstance(inner.data, Mapping):
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

    def _error(self, place: Place, message: str, hint: str = "") -> None:
        at = self._document.key_at(place)
        self.found.append(error("check.parameter-file", at, message, hint))
