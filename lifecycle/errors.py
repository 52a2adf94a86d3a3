"""Exceptions and process exit codes: the root exception, its kinds, and the exit code of each.

Owns: every exit code of the command line and the exceptions that cross package borders. One
boundary (`lifecycle.cli.main`) turns exceptions into exit codes. Imports nothing of the package.
"""

from __future__ import annotations

import enum
import errno
import os
from collections.abc import Collection


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


class ExhaustedError(LifecycleError):
    """The machine, or a limit of this process, has no more of something that this needs."""

    exit_code = ExitCode.BRING_UP_FAILED


_USED_UP = (
    *map(os.strerror, (errno.EMFILE, errno.ENFILE, errno.ENOMEM, errno.ENOSPC)),
    *map(os.strerror, (errno.EDQUOT, errno.EFBIG)),
    *("can't start new thread", "failed to map segment", "bad_alloc"),
)
"""What says, also in what a library said, that a resource is used up."""


def exhausted(error: BaseException) -> ExhaustedError | None:
    """Return what an exception says where it only means that there is no more of a resource."""
    said = " ".join(str(error).split()) or type(error).__name__
    if not isinstance(error, MemoryError) and not any(each in said for each in _USED_UP):
        return None
    return ExhaustedError(
        f"cannot go on, a resource is used up: {said}",
        hint="raise its limit (ulimit -a; Limit…= and TasksMax= of systemd), or make room (df)",
    )


MAX_WORDS = 500
"""Names among which a nearest one is looked for; among more it would take longer than it helps."""


def nearest(word: str, known: Collection[str]) -> str:
    """Return the known name that `word` was most probably meant to be; empty if none is near."""
    if len(known) > MAX_WORDS:
        return ""
    spelled = {each.lower(): each for each in known}
    import difflib  # only a mistake needs it

    close = difflib.get_close_matches(word.lower(), spelled, n=1, cutoff=0.6)
    return spelled[close[0]] if close else ""


def did_you_mean(word: str, known: Collection[str]) -> str:
    """Return a question for a hint; empty if no known name is near."""
    found = nearest(word, known)
    return f"did you mean {found!r}?" if found else ""
