"""Placements: the entities of one endpoint on one connection, and handover (make before break).

Owns: that a placement (its entity, its aliases' entities, their watches) is made whole or not at
all; that a strictly unique flow is not shared; how a new placement takes over from an old one, how
long both live side by side, and that nothing is delivered twice meanwhile.

Both ends of a flow learn of each other at different moments, so a match seen here does not prove
that the other side has seen it: the old placement stays a little longer than that.
"""

from __future__ import annotations

import collections
import inspect
import typing
from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Any

from rclpy.duration import Duration
from rclpy.task import Future

from lifecycle.manifest import EndpointKind
from lifecycle.middleware import ServerWatch
from lifecycle.network import UniqueRequirement
from lifecycle.node.connections.connections import ConnectError, Connection
from lifecycle.node.endpoints.making import CLIENTS
from lifecycle.node.endpoints.mapping import Mapping, MatchWatch, Part, Placement
from lifecycle.node.lifecycle.gate import takes_one

if TYPE_CHECKING:
    from rclpy.callback_groups import CallbackGroup
    from rclpy.node import Node
    from rclpy.subscription import Subscription

    from lifecycle.node.endpoints.making import Maker
    from lifecycle.node.lifecycle.gate import Later, NodeGate


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
        finish: destroys the old placement; called exactly once.
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
    """Delivers each sample once, in order, while two subscriptions of one endpoint receive.

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
        """Deliver what was kept and the old subscription has not received.

        Args:
            give: called with what an async handler returns, to have it awaited; None lets go of
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
    """Take what a subscription has received and was not taken yet, before it is destroyed.

    Args:
        subscription: its callback takes message and info.
        give: called with what an async callback returns, to have it awaited.
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


_STRICT = UniqueRequirement.STRICTLY_REQUIRED
_ACKNOWLEDGED = Duration(seconds=0.1)
"""How long a reliable publisher that is handed over is waited for; on one network a millisecond."""
_DRAINED = 1000  # messages


class Placer:
    """Places the endpoints of one node.

    Args:
        node: whose executor runs the callbacks.
        maker: makes single entities.
        gate: holds subscriptions back.
        event_group: reentrant, of matched events.
        later: runs a function in the node's executor.
        after: calls back once in the node's executor.
    """

    def __init__(
        self,
        node: Node,
        maker: Maker,
        *,
        gate: NodeGate,
        event_group: CallbackGroup,
        later: Later,
        after: After,
    ) -> None:
        self._node = node
        self._maker = maker
        self._gate = gate
        self._event_group = event_group
        self._later = later
        self._after = after

    def place(
        self,
        mapping: Mapping,
        connection: Connection,
        *,
        beside: Iterable[Mapping],
        matched: Callable[[Mapping], None],
    ) -> Placement:
        """Make all entities of an endpoint on a connection, or none.

        Args:
            mapping: the endpoint; where it is now is left alone.
            connection: where it shall be.
            beside: every endpoint of the node.
            matched: called when the peers of this placement, or its server, change.

        Raises:
            LifecycleError: it cannot be made so.
        """
        _refuse_shared_flow(mapping, connection, beside)
        parts: list[Part] = []
        try:
            for name in (mapping.name, *mapping.aliases):
                parts.append(self._part(mapping, connection, name, matched))  # noqa: PERF401
        except BaseException:
            self._unmake(mapping, connection, parts)
            raise
        return Placement(connection=connection, parts=tuple(parts))

    def unplace(self, mapping: Mapping, placement: Placement) -> None:
        """Unmake what `place` returned."""
        self._unmake(mapping, placement.connection, placement.parts)

    def realias(
        self,
        mapping: Mapping,
        placement: Placement,
        aliases: Sequence[str],
        *,
        matched: Callable[[Mapping], None],
    ) -> None:
        """Have one part for each alias; those that stay are left alone. Arguments as `place`."""
        connection = placement.connection
        _refuse_alias(mapping, connection, aliases)
        own, *further = placement.parts
        kept = {part.name: part for part in further}
        made: list[Part] = []
        try:
            for name in aliases:
                if name not in kept:
                    made.append(self._part(mapping, connection, name, matched))  # noqa: PERF401
        except BaseException:
            self._unmake(mapping, connection, made)
            raise
        known = {**kept, **{part.name: part for part in made}}
        placement.parts = (own, *(known.pop(name) for name in aliases))
        self._unmake(mapping, connection, tuple(known.values()))

    def overlap(self, mapping: Mapping, old: Placement, new: Placement) -> Overlap | None:
        """Let the old placement of a subscription deliver and the new one wait for its turn."""
        if mapping.endpoint.kind is not EndpointKind.SUBSCRIPTION:
            return None
        assert mapping.handler is not None
        overlap = Overlap(mapping.handler)
        for entity in old.entities:
            self._gate.hand_to(entity, overlap.from_old)
        for entity in new.entities:
            self._gate.hand_to(entity, overlap.from_new)
        return overlap

    def switch(
        self, mapping: Mapping, old: Placement, new: Placement, overlap: Overlap | None
    ) -> None:
        """Let the new placement do what the old one did until now, which is destroyed next."""
        if mapping.endpoint.kind is EndpointKind.PUBLISHER:
            qos = mapping.endpoint.qos
            if qos is None or qos.reliability.name != "BEST_EFFORT":
                for entity in old.entities:
                    entity.wait_for_all_acked(_ACKNOWLEDGED)
        elif overlap is not None:
            for entity in (*old.entities, *new.entities):
                drain(entity, self._await_later, at_most=_DRAINED)
            overlap.release(self._await_later if self._gate.is_open else None)
            for entity in new.entities:
                self._gate.hand_to(entity, overlap.alone)
            self._after(STRAGGLE_S, lambda: self._hand_back(mapping, new, overlap))

    def _hand_back(self, mapping: Mapping, placement: Placement, overlap: Overlap) -> None:
        """Let rclpy call the handler itself again, unless it was replaced meanwhile."""
        assert mapping.handler is not None
        for entity in placement.entities:
            if self._gate.callback_of(entity) == overlap.alone:
                self._gate.hand_to(entity, mapping.handler)

    def _part(
        self,
        mapping: Mapping,
        connection: Connection,
        name: str,
        matched: Callable[[Mapping], None],
    ) -> Part:
        entity = self._maker.make(
            mapping.endpoint,
            mapping.interface,
            connection,
            handler=mapping.handler,
            name=name,
            options=mapping.options,
        )
        return Part(
            name=name, entity=entity, watch=self._watch(mapping, connection, entity, matched)
        )

    def _watch(
        self,
        mapping: Mapping,
        connection: Connection,
        entity: Any,
        matched: Callable[[Mapping], None],
    ) -> MatchWatch | ServerWatch | None:
        kind = mapping.endpoint.kind
        if kind.is_topic:
            return MatchWatch(self._node, entity, self._event_group, lambda _: matched(mapping))
        if kind not in CLIENTS:
            return None

        def changed() -> None:
            self._later(lambda: matched(mapping))

        hidden = connection.participant
        return ServerWatch(self._node if hidden is None else hidden.node, entity, changed)

    def _unmake(self, mapping: Mapping, connection: Connection, parts: Iterable[Part]) -> None:
        for part in parts:
            if part.watch is not None:
                part.watch.stop()
            self._maker.unmake(mapping.endpoint, part.entity, connection)

    def _await_later(self, awaitable: Any) -> None:
        async def run() -> None:
            await awaitable

        self._later(run)


def _refuse_shared_flow(
    mapping: Mapping, connection: Connection, beside: Iterable[Mapping]
) -> None:
    """Keep a strictly unique publisher alone: a participant's publishers share its sockets.

    On the node's own participant the RMW refuses such a publisher itself.
    """
    publisher = EndpointKind.PUBLISHER
    if connection.participant is None or mapping.endpoint.kind is not publisher:
        return
    _refuse_alias(mapping, connection, mapping.aliases)
    for other in beside:
        if other is mapping or other.endpoint.kind is not publisher:
            continue
        if other.connection is not connection:
            continue
        for one, two in ((mapping, other), (other, mapping)):
            if one.endpoint.unique is _STRICT:
                raise ConnectError(
                    f"publisher {one.endpoint.name!r} must have a network flow for itself "
                    f"(strictly_required), and would share it with publisher "
                    f"{two.endpoint.name!r}",
                    hint="give each a connection of its own",
                )


def _refuse_alias(mapping: Mapping, connection: Connection, aliases: Iterable[str]) -> None:
    """An alias of a publisher is one more publisher beside it."""
    if connection.participant is None or mapping.endpoint.kind is not EndpointKind.PUBLISHER:
        return
    for alias in aliases:
        if mapping.endpoint.unique is _STRICT:
            raise ConnectError(
                f"publisher {mapping.endpoint.name!r} must have a network flow for itself "
                f"(strictly_required), and would share it with its alias {alias!r}"
            )
