"""Layer 1 of the graph interface: sending to the graph and receiving from it.

Owns: the Protocol that every graph transport fulfils. All participants of one graph must use the
same one; a program may bridge two by receiving from one and sending to the other. Pure.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

Remove = Callable[[], None]
"""Takes a callback away again; a second call does nothing."""


class GraphTransport(Protocol):
    """Carries messages to everybody in the graph.

    Nothing is promised about delivery: a message may be lost, doubled, late or out of order, and a
    sender may receive its own. Whoever is on top (`GraphEvents`) copes with that.
    """

    def send(self, message: bytes) -> None:
        """Send one message to everybody who receives; any thread, never waits for a receiver.

        Raises:
            LifecycleError: it could not be handed over.
        """

    def receive(self, callback: Callable[[bytes], None]) -> Remove:
        """Have `callback` called with each message from now on, in a thread of the transport."""

    def on_peer(self, callback: Callable[[], None]) -> Remove:
        """Have `callback` called when somebody can hear us who could not before.

        The moment to say again who we are: after a late joiner came, or a partition healed.
        """

    def close(self) -> None:
        """Leave; again is harmless. Nothing is received after it."""
