"""What a TRANSIENT_LOCAL publisher has said, so that it goes along from connection to connection.

Owns: `Kept`. DDS keeps such a history in the writer, for subscriptions that come later, and each
connection has a writer of its own (DDS 1.4, 2.2.3.4).
"""

from __future__ import annotations

import collections
import time
import typing
import weakref
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

from rclpy.serialization import serialize_message

from lifecycle.manifest.qos import Durability, History, QosProfile

if TYPE_CHECKING:
    from rclpy.publisher import Publisher

_SYSTEM_DEFAULT_DEPTH = 1
"""Fast DDS 2.14's own, for a profile that leaves history to the middleware."""


@typing.final
class Kept:
    """The last messages of one publisher, serialized, and who has them.

    Args:
        depth: how many, > 0.
        lifespan_ns: older ones are not worth anything any more; None for ever.
    """

    def __init__(self, depth: int, lifespan_ns: int | None = None) -> None:
        self._samples: collections.deque[tuple[int, int, bytes]] = collections.deque(maxlen=depth)
        self._lifespan_ns = lifespan_ns
        self._count = 0
        self._had: weakref.WeakKeyDictionary[Publisher, int] = weakref.WeakKeyDictionary()

    @classmethod
    def of(cls, qos: QosProfile | None) -> Kept | None:
        """Return what keeps for a publisher of this QoS; None where nothing is kept.

        KEEP_ALL has no bound, so nothing of it is taken along.
        """
        if qos is None or qos.durability is not Durability.TRANSIENT_LOCAL:
            return None
        if qos.history is History.KEEP_ALL:
            return None
        depth = qos.depth if qos.history is History.KEEP_LAST else 0
        return cls(depth or _SYSTEM_DEFAULT_DEPTH, qos.lifespan_ns)

    def publish(self, msg: Any, publishers: Iterable[Publisher]) -> None:
        """Publish a message, or serialized bytes, on all of `publishers`, and keep it.

        Raises:
            TypeError: it is of another type, as rclpy says it.
        """
        data: Any = msg
        for each in publishers:
            if data is msg and isinstance(msg, each.msg_type):
                # Once for all, and as it is now: its author may change the message later.
                data = serialize_message(msg)
            each.publish(data)
            self._had[each] = self._count + 1
        self._count += 1
        self._samples.append((self._count, time.monotonic_ns(), data))

    def catch_up(self, publishers: Iterable[Publisher]) -> None:
        """Publish on each of `publishers` what it has not published yet."""
        oldest_ns = 0
        if self._lifespan_ns:
            oldest_ns = time.monotonic_ns() - self._lifespan_ns
        for each in publishers:
            had = self._had.get(each, 0)
            for number, said_ns, data in tuple(self._samples):
                if number > had and said_ns >= oldest_ns:
                    each.publish(data)
            self._had[each] = self._count

    def forget(self) -> None:
        """Nothing was said."""
        self._samples.clear()
