"""Checks of parameter files: there, readable, for a node of this system, and fitting its interface.

Owns: check.parameter-file, check.parameter-file-unmatched, and the parameter rules for values that
stand in files. How such a file is laid out is `parameter_sections`'. Reads the files.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Iterator
from pathlib import Path

from lifecycle.manifest.checks.parameters.parameter_sections import Section, read_sections
from lifecycle.manifest.checks.parameters.parameter_types import is_implicit, misfit, suggestion
from lifecycle.manifest.checks.system import System, full_name
from lifecycle.manifest.diagnostics import Diagnostic
from lifecycle.manifest.model import Node
from lifecycle.manifest.nodl.document import nearest_file
from lifecycle.manifest.schema.message_text import did_you_mean
from lifecycle.manifest.yaml.document import error, warning
from lifecycle.manifest.yaml.source import is_outside


@dataclasses.dataclass(slots=True, kw_only=True)
class _File:
    """A file, read once for all nodes that name it."""

    shown: str
    sections: tuple[Section, ...] = ()
    readers: list[Node] = dataclasses.field(default_factory=list)
    readable: bool = True


def check(system: System) -> Iterator[Diagnostic]:
    """Yield findings about every parameter file that a node names."""
    files: dict[str, _File] = {}
    for node in system.manifest.nodes:
        for index, path in enumerate(node.parameter_files):
            if path not in files:
                files[path] = _File(shown=shown_path(path, system.manifest.path))
                yield from _read(path, files[path], node, index)
            files[path].readers.append(node)
    for path, file in files.items():
        for node in file.readers:
            if file.readable:
                yield from _unmatched_node(path, file, node, system.manifest.path)
                yield from _values(file, node)
        yield from _unmatched_sections(file, system)
        yield from _unknown_to_all(file)


def shown_path(path: str, manifest: str) -> str:
    """Return a file's path as the user would write it beside the manifest's."""
    folder = Path(manifest).parent
    # relpath, not relative_to: a file may well lie beside the manifest's folder.
    return os.path.normpath(folder / os.path.relpath(path, folder))


def _read(path: str, file: _File, node: Node, index: int) -> Iterator[Diagnostic]:
    at = node.where(f"parameter_files.{index}")
    if not os.path.lexists(path):
        message = f"cannot find the parameter file {file.shown!r}"
        file.readable = False
        yield error("check.parameter-file", at, message, nearest_file(Path(path)))
        return
    file.sections, found = read_sections(path, shown=file.shown)
    file.readable = not found
    yield from found


def _unmatched_node(path: str, file: _File, node: Node, manifest: str) -> Iterator[Diagnostic]:
    name = full_name(node)
    if any(section.matches(name) for section in file.sections):
        return
    at = node.where(f"parameter_files.{node.parameter_files.index(path)}")
    patterns = [section.pattern for section in file.sections]
    listed = ", ".join(repr(each) for each in patterns) or "no node"
    if is_outside(path, manifest, os.environ):
        listed = "others" if patterns else "no node"
    message = f"cannot find node {name!r} in {file.shown!r}: it is for {listed}"
    hint = f"name the section {name}, or /** for every node"
    yield warning("check.parameter-file-unmatched", at, message, hint)


def _unmatched_sections(file: _File, system: System) -> Iterator[Diagnostic]:
    """Warn of sections for nobody in a file that is of use otherwise: most are misspelt."""
    names = [full_name(node) for node in system.manifest.nodes]
    dead = [each for each in file.sections if not any(each.matches(name) for name in names)]
    if len(dead) == len(file.sections):
        return  # reported where the file is named
    for section in dead:
        message = f"cannot use the parameters of {section.pattern!r}: no node has that name"
        hint = did_you_mean(section.pattern, names)
        yield warning("check.parameter-file-unmatched", section.at, message, hint)


def _values(file: _File, node: Node) -> Iterator[Diagnostic]:
    declared = {each.name: each for each in node.interface.parameters}
    for section in file.sections:
        if not section.matches(full_name(node)):
            continue
        for name, value, at in section.parameters:
            declaration = declared.get(name)
            if declaration is not None:
                if problem := misfit(value, declaration.type):
                    message = f"cannot set parameter {name!r} of {full_name(node)!r} to {problem}"
                    hint = suggestion(value, declaration.type)
                    yield error("check.parameter-type", at, message, hint)
            elif declared and not section.is_wildcard and not is_implicit(name):
                message = (
                    f"cannot set parameter {name!r} of {full_name(node)!r}: "
                    f"its interface declares no such parameter"
                )
                hint = did_you_mean(name, declared)
                yield error("check.parameter-undeclared", at, message, hint)


def _unknown_to_all(file: _File) -> Iterator[Diagnostic]:
    """Warn of a value for many nodes that none of them declares; some not declaring it is usual."""
    for section in file.sections:
        nodes = [node for node in file.readers if section.matches(full_name(node))]
        if not section.is_wildcard or not nodes:
            continue
        if not all(node.interface.parameters for node in nodes):
            continue
        known = {each.name for node in nodes for each in node.interface.parameters}
        for name, _, at in section.parameters:
            if name not in known and not is_implicit(name):
                message = f"cannot set parameter {name!r}: no node that reads it declares it"
                yield warning("check.parameter-undeclared", at, message, did_you_mean(name, known))
