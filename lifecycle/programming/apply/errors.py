"""What can go wrong while a network is programmed. Owns: the errors of this package."""

from __future__ import annotations

from collections.abc import Sequence

from lifecycle.errors import ExitCode, LifecycleError, UsageError


class ProgrammingError(LifecycleError):
    """A network refused, or could not be reached or read."""

    exit_code = ExitCode.BRING_UP_FAILED


class PrivilegeError(ProgrammingError):
    """A command needs a privilege that this process lacks."""


class MissingFeatureError(ProgrammingError):
    """The kernel or the machine lacks something: a queueing discipline, a classifier, a program."""


class NotOursError(ProgrammingError):
    """An object that is not ours is in the way; it is never touched."""


class SettingsError(UsageError):
    """The settings file of the HTTP targets cannot be read, or what it points to."""


class HttpError(ProgrammingError):
    """An HTTP interface refused or failed.

    Attributes:
        status: HTTP status; 0 if there was no answer.
        cause: `cause` of problem+json (TS 29.122) or `code` of CAMARA; empty if none.
        uncertain: the request may have taken effect all the same.
    """

    def __init__(
        self,
        message: str,
        *,
        status: int = 0,
        cause: str = "",
        uncertain: bool = False,
        hint: str = "",
    ) -> None:
        super().__init__(message, hint=hint)
        self.status = status
        self.cause = cause
        self.uncertain = uncertain


class PartlyError(ProgrammingError):
    """Some flows or targets could not be programmed; the others are.

    Attributes:
        errors: one per flow or target.
        done: what was done all the same and is there now, as text for people, one per target.
    """

    def __init__(
        self,
        target: str,
        total: int,
        errors: Sequence[tuple[str, LifecycleError]],
        *,
        done: Sequence[str] = (),
    ) -> None:
        lines = "".join(f"\n  {key}{': ' if key else ''}{error}" for key, error in errors)
        made = "\n".join(("\ndone all the same:", *done)) if done else ""
        super().__init__(f"cannot make {len(errors)} of {total} changes to {target}:{lines}{made}")
        self.errors = tuple(errors)
        self.done = tuple(done)

    def __str__(self) -> str:
        """The message ends with lists, so a hint has a line of its own."""
        return f"{self.message}\n{self.hint}" if self.hint else self.message
