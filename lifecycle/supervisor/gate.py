"""The gate: the only way to a permit, and no activate request leaves without one.

Owns: `Gate` and `Permit`. The drivers ask a permit at the very place where the bytes of an
activate request go out, so a mistake elsewhere is a refused request, not an active system. A
permit dies with the gate: once anything goes wrong, nodes not yet activated stay inactive. Pure.
"""

from __future__ import annotations

from lifecycle.errors import BringUpError, ExitCode, LifecycleError
from lifecycle.verify.verdict import Outcome, Verdict


class VerificationError(LifecycleError):
    """The gate stays closed. Exit code 4 when violated, 5 when unverifiable.

    Attributes:
        verdict: why.
    """

    def __init__(self, verdict: Verdict) -> None:
        self.verdict = verdict
        self.exit_code = (
            ExitCode.VIOLATED if verdict.verdict is Outcome.VIOLATED else ExitCode.UNVERIFIABLE
        )
        named = "\n".join(f"  {finding.rule}: {finding.message}" for finding in verdict.findings)
        super().__init__(f"cannot activate: the verdict is {verdict.verdict.value}\n{named}")


def closes(verdict: Verdict, *, strict: bool) -> bool:
    """Whether `verdict` keeps the gate closed; `strict` refuses whatever is unverifiable too."""
    if verdict.verdict is Outcome.VIOLATED or verdict.blocking:
        return True
    return strict and verdict.verdict is Outcome.UNVERIFIABLE


class Permit:
    """The right to send activate requests. Only `Gate.judge` makes one."""

    def __init__(self, gate: Gate, verdict: Verdict) -> None:
        if gate.permit is not None or closes(verdict, strict=gate.strict):
            raise BringUpError("cannot make a permit without an open gate; ask Gate.judge for one")
        self._gate = gate
        self.verdict = verdict

    def check(self) -> None:
        """Confirm that the right still holds.

        Raises:
            BringUpError: the gate was closed after this permit was given.
        """
        if self._gate.permit is not self:
            raise BringUpError("cannot activate: the gate was closed again before this request")


class Gate:
    """Holds a system back until it is verified.

    Attributes:
        strict: refuse an unverifiable verdict even where the manifest's policy lets it pass.
        permit: the one that holds at this moment; None while the gate is closed.
    """

    def __init__(self, *, strict: bool) -> None:
        self.strict = strict
        self.permit: Permit | None = None

    def judge(self, verdict: Verdict) -> Permit:
        """Open on a verdict that allows it.

        Raises:
            VerificationError: the verdict does not allow it; the gate is closed.
        """
        self.permit = None
        if closes(verdict, strict=self.strict):
            raise VerificationError(verdict)
        self.permit = Permit(self, verdict)
        return self.permit

    def close(self) -> None:
        """End the permit: no activate request is sent from now on."""
        self.permit = None
