"""The publisher handle of a declared endpoint, and its TRANSIENT_LOCAL history across connections.

Owns: the handle that `self.publisher("video")` returns, one object per declared name. It exists
from configure until cleanup; the rclpy publisher behind it is made by connect and destroyed by
disconnect. And `Kept`, the messages of a TRANSIENT_LOCAL publisher: DDS keeps such a history in the
writer, for late-joining subscriptions, and each connection has a writer of its own (DDS 1.4,
2.2.3.4).
"""

from __future__ import annotations

import collections
import time
import typing
import weakref
from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Any

from rclpy.duration import Duration
from rclpy.serialization import serialize_message

from lifecycle.errors import LifecycleError
from lifecycle.manifest import Durability, History, QosProfile

if TYPE_CHECKING:
    from rclpy.publisher import Publisher


_SYSTEM_DEFAULT_DEPTH = 1
"""Fast DDS 2.14's own, for a profile that leaves history to the middleware."""


@typing.final
class Kept:
    """The last messages of one publisher, serialized, and which writers have them.

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
        self._further: tuple[Publisher, ...] = ()
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

    @property
    def is_activated(self) -> bool:
        """What is published goes out, as rclpy's lifecycle publishers say it."""
        return self._is_open and self._entity is not None

    def assert_liveliness(self) -> None:
        """Say that the author is alive, where its QoS has MANUAL_BY_TOPIC; nothing else."""
        if self._entity is not None:
            for each in (self._entity, *self._further):
                each.assert_liveliness()

    def wait_for_all_acked(self, timeout: Duration | None = None) -> bool:
        """Return whether all that was published is acknowledged, at the latest after `timeout`.

        It blocks; None waits for ever. Nothing is awaited while not connected.
        """
        if self._entity is None:
            return True
        limit = Duration(seconds=-1) if timeout is None else timeout
        return all(each.wait_for_all_acked(limit) for each in (self._entity, *self._further))

    def prepare(self, entities: Sequence[Publisher]) -> None:
        """Give entities that this will publish by what was sent, before any peer is matched.

        Not while the gate is closed: what is inactive stays silent until it is opened.
        """
        if self._kept is not None and self._is_open:
            self._kept.catch_up(entities)

    def attach(self, entity: Publisher, further: Sequence[Publisher] = ()) -> None:
        """Publish by `entity`, and by those of its aliases, from now on."""
        self._entity = entity
        self._further = tuple(further)
        self._warned = False
        if self._is_open:
            self.open()

    def detach(self) -> None:
        """The rclpy publisher is being destroyed."""
        self._entity = None
        self._further = ()
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
        if self._kept is not None:
            self._kept.catch_up((self._entity, *self._further))
            self.publish = self._publish_and_keep
        else:
            self.publish = self._publish_all if self._further else self._entity.publish

    def close(self) -> None:
        """Drop what is published; say so once until the gate has been open again."""
        self._is_open = False
        self._warned = False
        self.publish = self._drop

    def _publish_all(self, msg: Any) -> None:
        assert self._entity is not None
        self._entity.publish(msg)
        for each in self._further:
            each.publish(msg)

    def _publish_and_keep(self, msg: Any) -> None:
        assert self._entity is not None
        assert self._kept is not None
        self._kept.publish(msg, (self._entity, *self._further))

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
