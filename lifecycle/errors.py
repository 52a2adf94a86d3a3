"""Exceptions and process exit codes: the root exception, its kinds, and the exit code of each.

Owns: every exit code of the command line and the exceptions that cross package borders. One
boundary (`lifecycle.cli.main`) turns exceptions into exit codes. Imports nothing of the package.
"""

from __future__ import annotations

import contextlib
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


_EXHAUSTED = (
    (errno.EMFILE, "file descriptors", "RLIMIT_NOFILE", "raise it (ulimit -n, LimitNOFILE=)"),
    (errno.ENFILE, "file descriptors of the machine", "", "raise fs.file-max (sysctl)"),
    (errno.ENOMEM, "memory", "RLIMIT_AS", "raise it (ulimit -v, LimitAS=), or end other programs"),
    (errno.ENOSPC, "room on a disk", "", "make room there (df)"),
    (errno.EDQUOT, "room on a disk: its quota is reached", "", "make room there (quota)"),
    (errno.EFBIG, "room in a file", "RLIMIT_FSIZE", "raise it (ulimit -f, LimitFSIZE=)"),
)
_OF_MEMORY = ("failed to map segment", "bad_alloc")
_OF_THREADS = "can't start new thread"


def exhausted(error: BaseException) -> ExhaustedError | None:
    """Return what an exception says where it only means that there is no more of a resource.

    Args:
        error: any exception, also one whose text quotes what a library said.
    """
    text = str(error)
    number = error.errno if isinstance(error, OSError) else None
    if isinstance(error, MemoryError) or any(each in text for each in _OF_MEMORY):
        number = errno.ENOMEM
    if _OF_THREADS in text:
        return ExhaustedError(
            f"cannot go on without more threads, or memory for them{_limit('RLIMIT_AS')}: {text}",
            hint="raise the limit (ulimit -u, TasksMax= or pids.max; ulimit -v)",
        )
    for known, what, limit, hint in _EXHAUSTED:
        if number != known and os.strerror(known) not in text:
            continue
        said = " ".join(text.split()) or type(error).__name__
        return ExhaustedError(f"cannot go on without more {what}{_limit(limit)}: {said}", hint=hint)
    return None


def _limit(name: str) -> str:
    """Return the value of a limit as getrlimit(2) has it; empty where there is none."""
    if not name:
        return ""
    with contextlib.suppress(ImportError, AttributeError, OSError):
        import resource  # only Unix has it

        soft, _ = resource.getrlimit(getattr(resource, name))
        if soft != resource.RLIM_INFINITY:
            return f" ({name} allows {soft})"
    return ""


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
