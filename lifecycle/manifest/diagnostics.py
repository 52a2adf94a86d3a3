"""Diagnostics of a manifest: file, line and column, rule, severity, message and hint. Pure.

Every check appends diagnostics and continues, so that a user sees all findings at once.
"""

from __future__ import annotations

import enum
from collections.abc import Iterable
from typing import Annotated

import msgspec

from lifecycle.codec import Positive, says
from lifecycle.errors import ExitCode, LifecycleError


class Severity(enum.Enum):
    """How bad a diagnostic is; only ERROR stops a manifest from loading."""

    ERROR = "error"
    WARNING = "warning"  # something declared is not proven, or not in force: `--strict` refuses it
    NOTE = "note"  # advice: nothing that is declared is in doubt


BY_POLICY = frozenset({"check.unheard", "check.unpublished", "check.no-server"})
"""Rules whose severity `policy:` decides: a warning of them is what was asked for."""


class Position(msgspec.Struct, frozen=True, kw_only=True):
    """A place in a document; lines and columns count from 1.

    Attributes:
        file: path as the user wrote it.
        path: place in the document, `nodes.camera.interface.publishers[0].qos.depth`.
    """

    file: str
    line: Positive
    column: Positive
    path: str = ""

    @property
    def spelled(self) -> str:
        """As messages have it: `robot.lifecycle.yaml:14:7`."""
        return f"{self.file}:{self.line}:{self.column}"


class Diagnostic(msgspec.Struct, frozen=True, kw_only=True):
    """One finding of a static check.

    Attributes:
        rule: stable id, `manifest.unknown-key`, `check.qos-incompatible`.
        message: starts with "cannot", quotes the value, says what is allowed.
        hint: the fix or the command that fixes it; may be empty.
    """

    rule: Annotated[str, says(pattern=r"^[a-z]+\.[a-z0-9.-]+$")]
    severity: Severity
    at: Position
    message: str
    hint: str = ""

    @property
    def is_unproven(self) -> bool:
        """Whether `--strict` refuses it: it is a warning, and none that the policy asks for."""
        return self.severity is Severity.WARNING and self.rule not in BY_POLICY

    def __str__(self) -> str:
        place = f"{self.at.spelled}: "
        path = f"{self.at.path}: " if self.at.path else ""
        word = "" if self.severity is Severity.ERROR else f"{self.severity.value}: "
        return f"{place}{word}{path}{self.message}" + (f"; {self.hint}" if self.hint else "")


Findings = list[Diagnostic]
"""Findings in the order of detection; every builder appends and continues."""


def error(rule: str, at: Position, message: str, hint: str = "") -> Diagnostic:
    """Make an error; `message` starts with "cannot"."""
    return Diagnostic(rule=rule, severity=Severity.ERROR, at=at, message=message, hint=hint)


def warning(rule: str, at: Position, message: str, hint: str = "") -> Diagnostic:
    """Make a warning: something that is declared is in doubt; `message` starts with "cannot"."""
    return Diagnostic(rule=rule, severity=Severity.WARNING, at=at, message=message, hint=hint)


def note(rule: str, at: Position, message: str, hint: str = "") -> Diagnostic:
    """Make a note: advice, with nothing in doubt that is declared; `message` as of a warning."""
    return Diagnostic(rule=rule, severity=Severity.NOTE, at=at, message=message, hint=hint)


def in_order(found: Iterable[Diagnostic], files: Iterable[str]) -> tuple[Diagnostic, ...]:
    """Return findings once each, by file as they were read, others last, then by position."""
    unique = list(dict.fromkeys(found))
    read = dict.fromkeys([*files, *(each.at.file for each in unique)])
    rank = {file: index for index, file in enumerate(read)}
    unique.sort(key=lambda each: (rank[each.at.file], each.at.line, each.at.column))
    return tuple(unique)


class ManifestError(LifecycleError):
    """A manifest that cannot be used; carries every diagnostic, errors and warnings."""

    exit_code = ExitCode.MANIFEST_INVALID

    def __init__(self, diagnostics: Iterable[Diagnostic]) -> None:
        self.diagnostics = tuple(diagnostics)
        super().__init__("\n".join(str(each) for each in self.diagnostics))
