"""The gate: the only way to a permit, and no activate request leaves without one.

Owns: `Gate` and `Permit`. The drivers ask a permit at the very place where the bytes of an
activate request go out, so a mistake elsewhere is a refused request, not an active system. A
permit belongs to one verdict: whatever changed since is judged again before another request leaves.
It dies with the gate: once anything goes wrong, nodes not yet activated stay inactive. Pure.
"""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from lifecycle.errors import BringUpError, ExitCode, LifecycleError
from lifecycle.verify.outcome import Outcome
from lifecycle.verify.verdict import Verdict

if TYPE_CHECKING:
    from lifecycle.supervisor.gate.verification_loop import VerificationLoop


class VerificationError(LifecycleError):
    """The gate stays closed. Exit code 4 when violated, 5 when unverifiable.

    Attributes:
        verdict: why.
        again: the gate was open, and what changed since had it judged again.
    """

    def __init__(self, verdict: Verdict, *, again: bool = False) -> None:
        self.verdict = verdict
        self.again = again
        self.exit_code = (
            ExitCode.VIOLATED if verdict.verdict is Outcome.VIOLATED else ExitCode.UNVERIFIABLE
        )
        named = "\n".join(f"  {finding.rule}: {finding.message}" for finding in verdict.findings)
        is_now = "the verdict is"
        if again:
            is_now = "the system changed before every node was activated, and its verdict now is"
        super().__init__(f"cannot activate: {is_now} {verdict.verdict.value}\n{named}")


_LEAST_S = 2.0


def behind_s(deadline: float) -> float:
    """Return the seconds that are left once the gate has opened.

    A verdict that comes in the last moment, or in a look that ended after it, is not worth less:
    programming and activating have 2 s all the same.

    Args:
        deadline: of everything, by the running loop's clock.
    """
    return max(_LEAST_S, deadline - asyncio.get_running_loop().time())


def closes(verdict: Verdict, *, strict: bool) -> bool:
    """Whether `verdict` keeps the gate closed; `strict` refuses whatever is unverifiable too."""
    if verdict.verdict is Outcome.VIOLATED or verdict.blocking:
        return True
    return strict and verdict.verdict is Outcome.UNVERIFIABLE


class Permit:
    """The right to send activate requests. Only `Gate.judge` makes one.

    Args:
        gate: open.
        verdict: that it rests on.
        deadline: of what it is for, see `Judging.again`.

    Attributes:
        verdict: the one that it rests on; a newer one, once it was renewed.
        sent: names of the nodes that were sent their requests.
    """

    def __init__(self, gate: Gate, verdict: Verdict, deadline: float | None = None) -> None:
        if gate.permit is not None or gate.closes(verdict):
            raise BringUpError("cannot make a permit without an open gate; ask Gate.judge for one")
        self._gate = gate
        self._deadline = deadline
        self.sent: set[str] = set()
        self._refused: Verdict | None = None
        self._renewal: asyncio.Future[None] | None = None
        self.verdict = verdict

    def check(self) -> None:
        """Confirm that the right still holds, whatever may have changed.

        Raises:
            VerificationError: what changed since does not allow it.
            BringUpError: the gate was closed after this permit was given.
        """
        if self._refused is not None:
            raise VerificationError(self._refused, again=True)
        if self._gate.permit is not self:
            raise BringUpError("cannot activate: the gate was closed again before this request")

    async def use(self, node: str) -> None:
        """Confirm that `node` may be sent its activate request now; nothing is awaited after it.

        Raises:
            VerificationError: as for `check`.
            BringUpError: likewise.
        """
        await self.renewed()
        self.sent.add(node)

    def unused(self, node: str) -> None:
        """Note that `node` was not activated by its request, and is to be sent another one."""
        self.sent.discard(node)

    async def renewed(self) -> None:
        """Return once the verdict is that of the present moment.

        All who wait for it share one judgement. It does not wait where nothing changed.

        Raises:
            VerificationError: as for `check`; the gate is closed for all that were not sent.
            BringUpError: likewise.
        """
        self.check()
        while not self._gate.is_current(self.verdict):
            if self._renewal is None or self._renewal.done():
                self._renewal = asyncio.ensure_future(self._renew())
                # Its waiters may be gone.
                self._renewal.add_done_callback(lambda done: done.cancelled() or done.exception())
            renewal = self._renewal
            await asyncio.wait({renewal})
            self.check()
            renewal.result()

    def expire(self) -> None:
        """Say why, if nodes were not sent their requests in time because of what changed.

        Raises:
            VerificationError: as for `check`; or somebody waits for a verdict that opens the gate
                again, and the latest does not.
        """
        refused = self._refused
        if refused is None and self._renewal is not None and not self._renewal.done():
            refused = self._gate.latest
        if refused is not None and self._gate.closes(refused):
            raise VerificationError(refused, again=True)

    async def _renew(self) -> None:
        verdict = await self._gate.judged_again(frozenset(self.sent), self._deadline)
        if self._gate.permit is not self:
            return
        if self._gate.closes(verdict):
            self._refused = verdict
            self._gate.close()
        else:
            self.verdict = verdict

    def end(self) -> None:
        """Stop judging again: the gate is closed."""
        # Not from inside of it: it ends by itself.
        if self._renewal is not None and self._refused is None:
            self._renewal.cancel()


class Gate:
    """Holds a system back until it is verified.

    Args:
        strict: see below.
        judging: has what changed judged again; without it a verdict stays true.

    Attributes:
        strict: refuse an unverifiable verdict even where the manifest's policy lets it pass.
        permit: the one that holds at this moment; None while the gate is closed.
    """

    def __init__(self, *, strict: bool, judging: VerificationLoop | None = None) -> None:
        self.strict = strict
        self.permit: Permit | None = None
        self._judging = judging

    def closes(self, verdict: Verdict) -> bool:
        """Whether a verdict keeps this gate closed."""
        return closes(verdict, strict=self.strict)

    @property
    def latest(self) -> Verdict | None:
        """The verdict that holds now."""
        return None if self._judging is None else self._judging.latest

    def judge(self, verdict: Verdict, *, deadline: float | None = None) -> Permit:
        """Open on a verdict that allows it.

        Args:
            verdict: of the moment.
            deadline: until which what changes behind the open gate may heal, see `Judging.again`.

        Raises:
            VerificationError: the verdict does not allow it; the gate is closed.
        """
        self.permit = None
        if self.closes(verdict):
            raise VerificationError(verdict)
        self.permit = Permit(self, verdict, deadline)
        return self.permit

    def close(self) -> None:
        """End the permit: no activate request is sent from now on."""
        permit, self.permit = self.permit, None
        if permit is not None:
            permit.end()

    def is_current(self, verdict: Verdict) -> bool:
        """Whether nothing changed since the look that `verdict` came from."""
        return self._judging is None or self._judging.is_current(verdict)

    async def judged_again(self, ahead: frozenset[str], deadline: float | None) -> Verdict:
        """Judge the system as it is now, see `Judging.again`."""
        assert self._judging is not None
        return await self._judging.again(ahead, deadline)
