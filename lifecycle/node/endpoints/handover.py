"""The time in which an endpoint is on two connections: make before break.

Both ends of a flow learn of each other at different moments, so a match seen here does not prove
that the other side has seen it: the old one stays a little longer than that. Meanwhile a publisher
publishes by the old one, and a subscription receives by both: what reaches it both ways is
delivered twice.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from rclpy.task import Future

if TYPE_CHECKING:
    from lifecycle.node.endpoints.endpoint import Placement
    from lifecycle.node.lifecycle.services import Turns

SETTLE_S = 0.25
"""The old one lives on after the new one has matched as many peers as it had."""

PATIENCE_S = 4.0
"""Both live at most so long, if the new one never matches as many.

A participant that others have not noticed at once is announced again after 3 s.
"""


class Handover:
    """One endpoint that is handed over.

    Args:
        old: where it is until then.
        peers_before: how many peers it had there.
        turns: of its node.
        finish: destroys the old one; called exactly once.

    Attributes:
        old: as given.
        done: the old one is destroyed.
    """

    def __init__(
        self, old: Placement, peers_before: int, turns: Turns, finish: Callable[[], None]
    ) -> None:
        self.old = old
        self.done: Future = Future()
        self._peers_before = peers_before
        self._turns = turns
        self._finish = finish
        self._settles = False
        self._call_off = turns.call_after(PATIENCE_S, self.end)

    def peers_changed(self, peers: int) -> None:
        """The new one has so many peers now."""
        if peers >= self._peers_before and not self._settles and not self.done.done():
            self._settles = True
            self._call_off()
            self._call_off = self._turns.call_after(SETTLE_S, self.end)

    def end(self) -> None:
        """Break now; again is harmless."""
        if self.done.done():
            return
        self._call_off()
        self.done.set_result(None)
        self._finish()
