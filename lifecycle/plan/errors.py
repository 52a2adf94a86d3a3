"""The one way planning fails. Owns: `PlanError`. Pure."""

from __future__ import annotations

from lifecycle.errors import ExitCode, LifecycleError
from lifecycle.manifest.diagnostics import Diagnostic, Position


class PlanError(LifecycleError):
    """A valid manifest that cannot be planned here: no such executable, processes that disagree.

    Attributes:
        at: the declaration that cannot be planned; None when no single one is to blame.
        diagnostics: everything that is wrong, one by one; empty where the message says it all.
    """

    exit_code = ExitCode.MANIFEST_INVALID

    def __init__(
        self,
        message: str,
        *,
        hint: str = "",
        at: Position | None = None,
        diagnostics: tuple[Diagnostic, ...] = (),
    ) -> None:
        super().__init__(message, hint=hint)
        self.at = at
        self.diagnostics = diagnostics

    @classmethod
    def of(cls, diagnostics: tuple[Diagnostic, ...]) -> PlanError:
        """Return the error that says all of these, at least one, at the place of the first."""
        first = diagnostics[0]
        rest = [
            f"{each.message}; {each.hint}" if each.hint else each.message
            for each in diagnostics[1:]
        ]
        return cls(
            "\n".join((first.message, *rest)),
            hint=first.hint,
            at=first.at,
            diagnostics=diagnostics,
        )

    def __str__(self) -> str:
        place = f"{self.at.file}:{self.at.line}:{self.at.column}: " if self.at else ""
        return place + super().__str__()
