"""Checks of ROS parameters and parameter files (YAML) against the parameters an interface declares.

Owns: what a command line sets of parameters. An interface that declares no parameters leaves them
open: nothing is checked then.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from lifecycle.errors import did_you_mean
from lifecycle.manifest.checks.system import DeclaredSystem
from lifecycle.manifest.diagnostics import Diagnostic, Position, error, warning
from lifecycle.manifest.interface import nearest_file
from lifecycle.manifest.model import ModeParameter, Node, ParameterValue, RunKind
from lifecycle.manifest.parameter_files import (
    ParameterFile,
    read_scalar,
)
from lifecycle.manifest.parameter_values import is_implicit, misfit, suggestion


def check_parameters(system: DeclaredSystem, node: Node) -> Iterator[Diagnostic]:
    """Yield findings about the parameters of a node, on its command line too."""
    declared = {each.name: each for each in node.interface.parameters}
    given = [
        (name, value, repr(name), node.where(f"parameters.{name}"))
        for name, value in node.parameters
    ]
    for name, _, _, at in given:
        is_known = not declared or name in declared or is_implicit(name)
        if not is_known and f"parameters.{name}" not in node.shared:
            message = f"cannot set parameter {name!r}: the interface declares no such parameter"
            hint = did_you_mean(name, declared) or "declare it under 'interface.parameters'"
            yield error("check.parameter-undeclared", at, message, hint)
    at = node.where("run.command")
    process = [each.name for each in system.processes[node.process_name]]
    for each in command_line_parameters(node):
        value = given_value(each.text)
        if each.node in ("", node.name):
            if value is not None:
                what = f"{each.name!r} of {node.key!r} by '-p'"
                given.append((each.name, value, what, at))
        elif each.node not in process:
            message = (
                f"cannot tell what takes '-p {each.node}:{each.name}': no node {each.node!r} is "
                f"declared in the process of {node.key!r}"
            )
            hint = did_you_mean(each.node, process)
            hint = hint or f"declared there: {', '.join(map(repr, sorted(process)))}"
            yield warning("check.parameter-for-no-node", at, message, hint)
    for name, value, what, at in given:
        if name in declared:
            yield from _judge(value, declared[name].type, what, at)
    if declared:
        return  # an array that none declares is reported as such
    of_files = system.files.given(node)
    for name, value, at in (*((name, value, at) for name, value, _, at in given), *of_files):
        if value == ():
            message = f"cannot tell the type of {name!r} of {node.key!r}: [] has none in ROS"
            hint = f"declare it: 'interface: {{parameters: {{{name}: {{type: string_array}}}}}}'"
            yield warning("check.parameter-empty-array", at, message, hint)


def _judge(value: ParameterValue, declared: str, what: str, at: Position) -> Iterator[Diagnostic]:
    if problem := misfit(value, declared):
        message = f"cannot set parameter {what} to {problem}"
        yield error("check.parameter-type", at, message, suggestion(value, declared))


def check_mode_parameters(system: DeclaredSystem) -> Iterator[Diagnostic]:
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
            elif not _is_given(node, each.name, system):
                of_mode = ({(one.node, one.name) for one in other.parameters} for other in modes)
                for other, said in zip(modes, of_mode, strict=True):
                    if (each.node, each.name) not in said:
                        why_not = f"what it is in mode {other.name!r} is not known"
                        hint = f"give it there, or in 'nodes.{each.node}.parameters'"
                        yield error("check.mode", each.at, f"{what}: {why_not}", hint)
                        break


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


def _is_given(node: Node, name: str, system: DeclaredSystem) -> bool:
    """Return whether it is known what a parameter is in a mode that says nothing of it."""
    if name in dict(node.parameters):
        return True
    if any(each.name == name and each.default is not None for each in node.interface.parameters):
        return True
    return any(name == found for found, _, _ in system.files.given(node))


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


def check_parameter_files(system: DeclaredSystem) -> Iterator[Diagnostic]:
    """Yield findings about every parameter file that a node names, on its command line too."""
    readers: dict[str, list[tuple[Node, Position, list[str]]]] = {}
    for node in system.manifest.nodes:
        for index, path in enumerate(node.parameter_files):
            at = node.where(f"parameter_files.{index}")
            readers.setdefault(path, []).append((node, at, [node.full_name]))
        process = [each.full_name for each in system.processes[node.process_name]]
        for each in command_line_parameters(node):
            if os.path.exists(each.file):  # where the program will run it may be another one
                at = node.where("run.command")
                readers.setdefault(each.file, []).append((node, at, process))
    names = [node.full_name for node in system.manifest.nodes]
    for path, named in readers.items():
        file = system.files.read(path)
        if not os.path.lexists(path):
            message = f"cannot find the parameter file {file.shown!r}"
            yield error("check.parameter-file", named[0][1], message, nearest_file(Path(path)))
            continue
        yield from file.flaws
        for node, at, takers in () if file.flaws else named:
            if not any(section.matches(name) for section in file.sections for name in takers):
                listed = ", ".join(repr(each.pattern) for each in file.sections) or "no node"
                message = (
                    f"cannot find node {node.full_name!r} in {file.shown!r}: it is for {listed}"
                )
                hint = f"name the section {node.full_name}, or /** for every node"
                yield warning("check.parameter-file-unmatched", at, message, hint)
            yield from _values(file, node)
        dead = [each for each in file.sections if not any(map(each.matches, names))]
        for section in dead if len(dead) < len(file.sections) else ():  # else reported above
            message = f"cannot use the parameters of {section.pattern!r}: no node has that name"
            hint = did_you_mean(section.pattern, names)
            yield warning("check.parameter-file-unmatched", section.at, message, hint)
        yield from _unknown_to_all(file, [node for node, _, _ in named])


def _values(file: ParameterFile, node: Node) -> Iterator[Diagnostic]:
    declared = {each.name: each for each in node.interface.parameters}
    for section in file.sections:
        if not section.matches(node.full_name):
            continue
        for name, value, at in section.parameters:
            declaration = declared.get(name)
            if declaration is not None:
                yield from _judge(value, declaration.type, f"{name!r} of {node.full_name!r}", at)
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


CHECKS = (check_parameter_files, check_mode_parameters)
OF_A_NODE = (check_parameters,)
