"""Checks of parameters given in the manifest against those that the interface declares.

Owns: check.parameter-undeclared, check.parameter-type, check.parameter-unused. An interface that
declares no parameters says nothing about them, so nothing is checked then. Pure.
"""

from __future__ import annotations

from collections.abc import Iterator

from lifecycle.manifest.checks.parameters.parameter_types import is_implicit, misfit, suggestion
from lifecycle.manifest.checks.system import System
from lifecycle.manifest.diagnostics import Diagnostic
from lifecycle.manifest.model import Node, RunKind
from lifecycle.manifest.schema.message_text import did_you_mean
from lifecycle.manifest.yaml.document import error, warning


def check(system: System) -> Iterator[Diagnostic]:
    """Yield findings about the parameters of every node."""
    for node in system.manifest.nodes:
        yield from _given(node)
        yield from _no_effect(node)


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
        elif declared and not is_implicit(name):
            message = f"cannot set parameter {name!r}: the interface declares no such parameter"
            hint = did_you_mean(name, declared) or "declare it under 'interface.parameters'"
            yield error("check.parameter-undeclared", at, message, hint)


def _no_effect(node: Node) -> Iterator[Diagnostic]:
    """Warn of what a node that somebody else starts will never be given, only judged by."""
    if node.run.kind is not RunKind.ATTACH:
        return
    places = [(f"parameters.{name}", "parameters") for name, _ in node.parameters[:1]]
    places += [
        (f"parameter_files.{i}", "parameter files") for i in range(len(node.parameter_files))
    ]
    for place, what in places[:1]:
        message = f"cannot give {what} to {node.key!r}, which is attached: they are only verified"
        hint = "give them where it is started"
        yield warning("check.parameter-unused", node.where(place), message, hint)
