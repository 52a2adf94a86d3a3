"""The publisher handle of a declared endpoint, and its TRANSIENT_LOCAL history across connections.

The handle exists from configure until cleanup; the rclpy publisher behind it is made by connect and
destroyed by disconnect. DDS keeps a TRANSIENT_LOCAL history in the writer, for late-joining
subscriptions, and each connection has a writer of its own (DDS 1.4, 2.2.3.4).
"""

from __future__ import annotations

import collections
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from rclpy.duration import Duration
from rclpy.serialization import serialize_message

from lifecycle.errors import LifecycleError
from lifecycle.manifest.qos import Durability, History, QosProfile

if TYPE_CHECKING:
    from rclpy.publisher import Publisher


_SYSTEM_DEFAULT_DEPTH = 1
"""Fast DDS 2.14's own, for a profile that leaves history to the middleware."""


class Kept:
    """The last messages of one publisher, serialized.

    Args:
        depth: how many, > 0.
        lifespan_ns: older ones are not worth anything any more; None for ever.
    """

    def __init__(self, depth: int, lifespan_ns: int | None = None) -> None:
        self._samples: collections.deque[tuple[int, bytes]] = collections.deque(maxlen=depth)
        self._lifespan_ns = lifespan_ns

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

    def publish(self, msg: Any, publisher: Publisher) -> None:
        """Publish a message, or serialized bytes, and keep it as it is now.

        Raises:
            TypeError: it is of another type, as rclpy says it.
        """
        data = serialize_message(msg) if isinstance(msg, publisher.msg_type) else msg
        publisher.publish(data)
        self._samples.append((time.monotonic_ns(), data))

    def send_again(self, publisher: Publisher) -> None:
        """Publish what is kept by another publisher."""
        oldest_ns = 0
        if self._lifespan_ns:
            oldest_ns = time.monotonic_ns() - self._lifespan_ns
        for said_ns, data in self._samples:
            if said_ns >= oldest_ns:
                publisher.publish(data)

    def forget(self) -> None:
        """Nothing was said."""
        self._samples.clear()


class DeclaredPublisher:
    """Publishes on a declared topic while the node is active; drops otherwise.

    While the node is active `publish` is rclpy's own bound method: an open gate costs nothing. Only
    a TRANSIENT_LOCAL publisher keeps what it sends, to take it along to another connection.

    Example:
        >>> def on_configure(self):
        ...     self.video = self.publisher("video")
        >>> @on_timer(period_s=0.05)
        ... def tick(self):
        ...     self.video.publish(self.camera.read())

    Args:
        name: as declared.
        warn: called with what is dropped.
        kept: keeps what is sent; None where nothing is kept.

    Attributes:
        name: as declared.
        publish: takes a message of the declared type, or serialized bytes.
    """

    publish: Callable[[Any], None]

    def __init__(self, name: str, warn: Callable[[str], None], kept: Kept | None = None) -> None:
        self.name = name
        self._warn = warn
        self._kept = kept
        self._warned = False
        self._is_open = False
        self._entity: Publisher | None = None
        self._owes = False  # it has not sent what is kept
        self.publish = self._drop

    @property
    def entity(self) -> Publisher:
        """The rclpy publisher, for everything beside `publish`.

        Raises:
            LifecycleError: the node is not connected.
        """
        if self._entity is None:
            raise LifecycleError(
                f"cannot reach publisher {self.name!r}: the node is not connected; "
                "endpoints exist from connect until disconnect"
            )
        return self._entity

    def get_subscription_count(self) -> int:
        """Return how many subscriptions are matched; 0 while not connected."""
        return self._entity.get_subscription_count() if self._entity is not None else 0

    @property
    def topic_name(self) -> str:
        """Fully qualified; empty while not connected."""
        return str(self._entity.topic_name) if self._entity is not None else ""

    def assert_liveliness(self) -> None:
        """Say that the author is alive, where its QoS has MANUAL_BY_TOPIC; nothing else."""
        if self._entity is not None:
            self._entity.assert_liveliness()

    def wait_for_all_acked(self, timeout: Duration | None = None) -> bool:
        """Return whether all that was published is acknowledged, at the latest after `timeout`.

        It blocks; None waits for ever. Nothing is awaited while not connected.
        """
        if self._entity is None:
            return True
        limit = Duration(seconds=-1) if timeout is None else timeout
        return bool(self._entity.wait_for_all_acked(limit))

    def attach(self, entity: Publisher) -> None:
        """Publish by `entity` from now on; it is another one than before."""
        self._entity = entity
        self._owes = True
        self._warned = False
        if self._is_open:
            self.open()

    def detach(self) -> None:
        """The rclpy publisher is being destroyed."""
        self._entity = None
        self.publish = self._drop

    def forget(self) -> None:
        """Later subscriptions do not receive what was sent so far."""
        if self._kept is not None:
            self._kept.forget()

    def open(self) -> None:
        """Let `publish` be rclpy's own method, as far as there is one."""
        self._is_open = True
        self._warned = False
        if self._entity is None:
            return
        if self._kept is None:
            self.publish = self._entity.publish
            return
        if self._owes:
            self._owes = False
            self._kept.send_again(self._entity)
        self.publish = self._publish_and_keep

    def close(self) -> None:
        """Drop what is published; say so once until the gate has been open again."""
        self._is_open = False
        self._warned = False
        self.publish = self._drop

    def _publish_and_keep(self, msg: Any) -> None:
        assert self._entity is not None
        assert self._kept is not None
        self._kept.publish(msg, self._entity)

    def _drop(self, msg: Any) -> None:  # noqa: ARG002 - the signature of Publisher.publish
        if not self._warned:
            self._warned = True
            why, until = "the node is not active", "active"
            if self._is_open:
                why, until = "it is mapped onto no connection", "mapped onto one"
            self._warn(
                f"cannot publish on {self.name!r}: {why}, so the message is dropped, and so are "
                f"those that follow until it is {until}"
            )
