"""From one connection to another without a gap: make before break.

Owns: how long both placements of an endpoint live side by side, and that nothing is delivered twice
meanwhile. Both ends of a flow learn of each other at different moments, so a match seen here does
not prove that the other side has seen it: the old placement stays a little longer than that.
"""

from __future__ import annotations

import collections
import inspect
import typing
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from rclpy.task import Future

from lifecycle.node.lifecycle.gate import takes_one

if TYPE_CHECKING:
    from rclpy.subscription import Subscription

SETTLE_S = 0.25
"""Both live on after the new placement has matched as many peers as the old one had."""

PATIENCE_S = 4.0
"""Both live side by side at most so long, if the new placement never matches as many.

A participant that others have not noticed at once is announced again after 3 s.
"""

STRAGGLE_S = 1.0
"""What the old placement has delivered may reach the new one so much later."""

_REMEMBERED = 4096  # samples

After = Callable[[float, Callable[[], None]], Callable[[], None]]
"""Calls back once, so many seconds later, in the executor; returns what calls that off."""


@typing.final
class Handover:
    """The time in which an endpoint is on two connections.

    Args:
        peers_before: how many peers the old placement had.
        after: the timer.
        finish: unmakes the old placement; called exactly once.
    """

    def __init__(self, *, peers_before: int, after: After, finish: Callable[[], None]) -> None:
        self.done: Future = Future()
        self._peers_before = peers_before
        self._after = after
        self._finish = finish
        self._grace_period = False
        self._call_off = after(PATIENCE_S, self.end)

    def peers_changed(self, peers: int) -> None:
        """The new placement has so many peers now."""
        if peers >= self._peers_before and not self._grace_period and not self.done.done():
            self._grace_period = True
            self._call_off()
            self._call_off = self._after(SETTLE_S, self.end)

    def end(self) -> None:
        """Break now; again is harmless."""
        if self.done.done():
            return
        self._call_off()
        self.done.set_result(None)
        self._finish()


@typing.final
class Overlap:
    """Hands each sample on once, in order, while two subscriptions of one endpoint receive.

    The new one may be faster than the old one, so what it receives waits until the old one has
    given everything. A sample is known by its writer's time stamp and sequence number
    (rmw_message_info_t).

    Args:
        handler: takes messages, or messages and their info.

    Attributes:
        from_old: what the old subscription calls, with message and message info.
        alone: what the new subscription calls once the old one is gone: what the old one has
            handed on may still arrive.
    """

    def __init__(self, handler: Callable[..., Any]) -> None:
        self._handler = handler
        self._takes = 1 if takes_one(handler) else 2
        self._seen: collections.deque[tuple[int, int]] = collections.deque(maxlen=_REMEMBERED)
        self._waiting: collections.deque[tuple[Any, Any]] = collections.deque(maxlen=_REMEMBERED)
        self._known: frozenset[tuple[int, int]] = frozenset()
        is_async = inspect.iscoroutinefunction(handler)
        self.from_old = self._hand_on_async if is_async else self._hand_on
        self.alone = self._if_new_async if is_async else self._if_new

    def from_new(self, message: Any, info: Any) -> None:
        """Keep what the new subscription receives."""
        self._waiting.append((message, info))

    def release(self, give: Callable[[Any], Any] | None) -> None:
        """Hand on what was kept and the old subscription has not received.

        Args:
            give: given what an async handler returns, to be awaited by somebody; None lets go of
                what was kept, because the gate is closed.
        """
        self._known = frozenset(self._seen)
        while self._waiting:
            message, info = self._waiting.popleft()
            if give is None or _sample(info) in self._known:
                continue
            returned = self._handler(*(message, info)[: self._takes])
            if inspect.isawaitable(returned):
                give(returned)

    def _hand_on(self, message: Any, info: Any) -> Any:
        self._seen.append(_sample(info))
        return self._handler(*(message, info)[: self._takes])

    def _if_new(self, message: Any, info: Any) -> Any:
        known = _sample(info) in self._known
        return None if known else self._handler(*(message, info)[: self._takes])

    async def _if_new_async(self, message: Any, info: Any) -> None:
        if _sample(info) not in self._known:
            await self._handler(*(message, info)[: self._takes])

    async def _hand_on_async(self, message: Any, info: Any) -> None:
        await self._hand_on(message, info)


def drain(subscription: Subscription, give: Callable[[Any], Any], *, at_most: int) -> None:
    """Take what a subscription has received and nobody has taken, before it is destroyed.

    Args:
        subscription: its callback takes message and info.
        give: given what an async callback returns, to be awaited by somebody.
        at_most: bound, so that a fast publisher cannot hold us here.
    """
    for _ in range(at_most):
        with subscription.handle:
            taken = subscription.handle.take_message(subscription.msg_type, subscription.raw)
        if taken is None:
            return
        returned = subscription.callback(*taken)
        if inspect.isawaitable(returned):
            give(returned)


def _sample(info: Any) -> tuple[int, int]:
    return info["source_timestamp"], info["publication_sequence_number"]
