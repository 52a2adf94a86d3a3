"""Exceptions and process exit codes: the root exception, its kinds, and the exit code of each.

Owns: every exit code of the command line and the exceptions that cross package borders. One
boundary (`lifecycle.cli.main`) turns exceptions into exit codes. Imports nothing of the package.
"""

from __future__ import annotations

import enum


class ExitCode(enum.IntEnum):
    """Exit codes of every `lifecycle` verb.

    Those of signals are 128 + the signal's number, as shells have it.
    """

    OK = 0
    USAGE = 2
    MANIFEST_INVALID = 3
    VIOLATED = 4
    UNVERIFIABLE = 5
    BRING_UP_FAILED = 6
    SUPERVISION_GAVE_UP = 7
    INTERNAL = 70
    HUNG_UP = 129
    INTERRUPTED = 130
    TERMINATED = 143


class LifecycleError(Exception):
    """Root of every exception that this package raises on purpose.

    Attributes:
        message: one sentence that starts with "cannot", quotes the value, states what is allowed.
        hint: the next thing to do, often a command; empty where there is none.
        exit_code: what the command line exits with when nothing handled it.
    """

    exit_code: ExitCode = ExitCode.INTERNAL

    def __init__(self, message: str, *, hint: str = "") -> None:
        super().__init__(message)
        self.message = message
        self.hint = hint

    def __str__(self) -> str:
        return f"{self.message}; {self.hint}" if self.hint else self.message


class UsageError(LifecycleError):
    """The command line was used wrongly: unknown node name, bad `name:=value`, missing file."""

    exit_code = ExitCode.USAGE


class MiddlewareError(LifecycleError):
    """The middleware refused or failed; carries the RMW's own reason."""

    exit_code = ExitCode.BRING_UP_FAILED


class BringUpError(LifecycleError):
    """A process died, a transition failed or a deadline passed while bringing a system up."""

    exit_code = ExitCode.BRING_UP_FAILED
