"""Graph transports, layer 1 of the graph interface: sending to the graph and receiving from it.

Owns: the Protocol that every graph transport fulfils, and the one inside a process: a network that
can lose, double, delay, reorder and part, all from one seed, so that a run repeats exactly. All
participants of one graph must use the same one; a program may bridge two by receiving from one and
sending to the other. Pure.
"""

from __future__ import annotations

import random
import typing
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:  # it imports asyncio, which a node that only reports has no use for
    from lifecycle.graph.scheduler import Remove, Scheduler


class GraphTransport(Protocol):
    """Carries messages to all in the graph.

    Nothing is promised about delivery: a message may be lost, doubled, late or out of order, and a
    sender may receive its own. `GraphEvents` on top copes with that.
    """

    def send(self, message: bytes) -> None:
        """Send one message to all who receive; any thread, never waits for a receiver.

        Raises:
            LifecycleError: it could not be handed over.
        """

    def receive(self, callback: Callable[[bytes], None]) -> Remove:
        """Have `callback` called with each message from now on, in a thread of the transport."""

    def on_peer(self, callback: Callable[[], None]) -> Remove:
        """Have `callback` called when a receiver is reached that was not before.

        The moment to say again who we are: after a late joiner came, or a partition healed.
        """

    def close(self) -> None:
        """Leave; again is harmless. Nothing is received after it."""


@typing.final
class InMemoryNetwork:
    """Carries messages between its transports, as badly as is asked.

    Args:
        scheduler: whose time passes while messages are under way.
        seed: of every accident; the same calls with the same seed end in the same way.
        loss: share of deliveries that never arrive, 0–1. Each receiver loses its own.
        duplication: share of deliveries that arrive twice, 0–1.
        delay_s: shortest and longest delay. Unequal ones reorder what is sent close together.
    """

    def __init__(
        self,
        scheduler: Scheduler,
        *,
        seed: int = 0,
        loss: float = 0.0,
        duplication: float = 0.0,
        delay_s: tuple[float, float] = (0.0, 0.0),
    ) -> None:
        self.loss = loss
        self.duplication = duplication
        self.delay_s = delay_s
        self._scheduler = scheduler
        self._random = random.Random(seed)  # noqa: S311 - accidents, not secrets
        self._transports: dict[InMemoryTransport, None] = {}
        self._receivers: dict[InMemoryTransport, None] = {}
        self._islands: dict[InMemoryTransport, int] = {}

    def transport(self) -> InMemoryTransport:
        """Return a new way into this network."""
        return InMemoryTransport(self)

    def partition(self, *groups: Iterable[InMemoryTransport]) -> None:
        """Part the network: only transports of one group reach each other.

        Transports that no group names form one more group. What is under way still arrives.
        """
        self._islands = {
            transport: number for number, group in enumerate(groups, 1) for transport in group
        }

    def heal(self) -> None:
        """End every partition, and notify those who reach a receiver again (`on_peer`)."""
        parted, self._islands = self._islands, {}
        if parted:
            for transport in tuple(self._transports):
                self._scheduler.post(transport.peer_joined)

    def carry(self, sender: InMemoryTransport, message: bytes) -> None:
        """Deliver a message to every receiver on its sender's island, with accidents."""
        island = self._islands.get(sender, 0)
        for receiver in tuple(self._receivers):
            if self._islands.get(receiver, 0) != island:
                continue
            copies = 1 + (self._random.random() < self.duplication)
            for _ in range(copies):
                if self._random.random() >= self.loss:
                    self._deliver(receiver, message)

    def enter(self, transport: InMemoryTransport) -> None:
        """Let a transport send."""
        self._transports[transport] = None

    def listen(self, receiver: InMemoryTransport) -> None:
        """Let a transport receive, and notify all others on its island (`on_peer`)."""
        self._receivers[receiver] = None
        island = self._islands.get(receiver, 0)
        for transport in tuple(self._transports):
            if transport is not receiver and self._islands.get(transport, 0) == island:
                self._scheduler.post(transport.peer_joined)

    def leave(self, transport: InMemoryTransport) -> None:
        """Forget a transport."""
        self._transports.pop(transport, None)
        self._receivers.pop(transport, None)
        self._islands.pop(transport, None)

    def _deliver(self, receiver: InMemoryTransport, message: bytes) -> None:
        shortest_s, longest_s = self.delay_s
        if longest_s <= 0:
            self._scheduler.post(lambda: receiver.arrive(message))
            return
        when_s = self._scheduler.now_s() + self._random.uniform(shortest_s, longest_s)
        self._scheduler.call_at(when_s, lambda: receiver.arrive(message))


@typing.final
class InMemoryTransport:
    """One participant's way into an InMemoryNetwork (a `GraphTransport`)."""

    def __init__(self, network: InMemoryNetwork) -> None:
        self._network = network
        self._callbacks: dict[object, Callable[[bytes], None]] = {}
        self._peer_callbacks: dict[object, Callable[[], None]] = {}
        self._closed = False
        network.enter(self)

    def send(self, message: bytes) -> None:
        """Send to all on the same island, ourselves included."""
        if not self._closed:
            self._network.carry(self, message)

    def receive(self, callback: Callable[[bytes], None]) -> Remove:
        """Have `callback` called in the scheduler's time with each message that arrives."""
        first = not self._callbacks
        remove = _keep(self._callbacks, callback)
        if first and not self._closed:
            self._network.listen(self)
        return remove

    def on_peer(self, callback: Callable[[], None]) -> Remove:
        """Have `callback` called when a receiver begins, or a partition healed."""
        return _keep(self._peer_callbacks, callback)

    def close(self) -> None:
        """Leave the network; what is under way to here is lost."""
        self._closed = True
        self._network.leave(self)

    def arrive(self, message: bytes) -> None:
        """Pass a message to who receives here; called by the network."""
        if not self._closed:
            for callback in tuple(self._callbacks.values()):
                callback(message)

    def peer_joined(self) -> None:
        """Notify that a receiver is reached; called by the network."""
        if not self._closed:
            for callback in tuple(self._peer_callbacks.values()):
                callback()


_Callback = typing.TypeVar("_Callback")


def _keep(callbacks: dict[object, _Callback], callback: _Callback) -> Remove:
    key = object()
    callbacks[key] = callback

    def remove() -> None:
        callbacks.pop(key, None)

    return remove
