"""Health of a node: its author's `health` method, asked at an interval, and what it last returned.

It is asked from when the node is connected, at once after each change of state, then every
`interval_s`. What must be healthy, and what follows if it is not, is the manifest's matter
(lifecycle.verify).
"""

from __future__ import annotations

import inspect
import time
import traceback
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from lifecycle.manifest.model import Health
from lifecycle.node.lifecycle.machine import NodeState
from lifecycle.verify.observation import HealthReport

if TYPE_CHECKING:
    from lifecycle.node.lifecycle.services import Turns

_LONGEST = 200
"""Characters of an answer that are passed on."""


class HealthCheck:
    """Asks one node how it is.

    Args:
        check: returns None, True or "" if all is well, else what is wrong; may be async.
        turns: has it asked in the node's executor.
        how: interval and deadline.
        changed: called whenever `report` is another one, or the first in another state.
        failed: logs a traceback.

    Attributes:
        report: the last answer; None while the node is not connected.
    """

    def __init__(
        self,
        check: Callable[[], Any],
        turns: Turns,
        how: Health,
        *,
        changed: Callable[[], object],
        failed: Callable[[str], object],
    ) -> None:
        self._check = check
        self._turns = turns
        self._how = how
        self._changed = changed
        self._failed = failed
        self._end: Callable[[], None] | None = None
        self._asked_s: float | None = None
        self._round = 0
        self._is_stale = False
        self.report: HealthReport | None = None

    def follow(self, state: NodeState) -> None:
        """Begin to ask, ask again or stop, as the node's new state says."""
        if not state.steady:
            return
        self._asked_s = None  # what it says of the state before counts no more
        self._round += 1
        if not state.connected:
            if self._end is not None:
                self._end()
            self._end = self.report = None
            return
        if self._end is None:
            self._end = self._turns.call_every(self._how.interval_s, self._ask)
        self._is_stale = True
        self._ask()

    def _ask(self) -> None:
        if self._asked_s is not None:
            waited_s = time.monotonic() - self._asked_s
            if waited_s >= self._how.timeout_s:
                late = f"it has not answered within {self._how.timeout_s:g} s"
                self._take(HealthReport(ok=None, message=late))
            return
        try:
            answer = self._check()
        except Exception as error:  # noqa: BLE001 - the user's code: reported
            self._take(self._raised(error))
            return
        if not inspect.isawaitable(answer):
            self._take(_report(answer))
            return
        self._asked_s = time.monotonic()
        if self._is_stale:
            self._take(HealthReport(ok=None, message="it has not answered since its state changed"))
        round_ = self._round

        async def wait() -> None:
            try:
                report = _report(await answer)
            except Exception as error:  # noqa: BLE001 - the user's code: reported
                report = self._raised(error)
            if round_ == self._round:
                self._asked_s = None
                self._take(report)

        self._turns.call_soon(wait)

    def _raised(self, error: Exception) -> HealthReport:
        said = f"it raised {type(error).__name__}: {error}"[:_LONGEST]
        if self.report is None or self.report.message != said:
            self._failed("".join(traceback.format_exception(error)))
        return HealthReport(ok=False, message=said)

    def _take(self, report: HealthReport) -> None:
        is_stale, self._is_stale = self._is_stale, False
        if is_stale or report != self.report:
            self.report = report
            self._changed()


def _report(answer: object) -> HealthReport:
    if answer is None or answer is True or answer == "":
        return HealthReport(ok=True)
    said = "it is not" if answer is False else str(answer)
    return HealthReport(ok=False, message=said[:_LONGEST])
