"""The gate: publishers, subscriptions and timers work only while their node is active.

A gate swaps a method instead of asking a question: while the node is active `publisher.publish`
*is* rclpy's own method, so an open gate costs nothing per call. Entities that tools rely on
(`/rosout`, `/parameter_events`, `~/transition_event`, `/clock`) never pass through here.

The handle of a declared publisher is gated too. It exists from configure until cleanup; the rclpy
publisher behind it is made by connect and destroyed by disconnect.
"""

from __future__ import annotations

import collections
import inspect
import sys
import time
from collections.abc import Callable, Collection, Coroutine, Mapping
from typing import TYPE_CHECKING, Any, Protocol

from lifecycle.errors import LifecycleError
from lifecycle.manifest.qos import Durability, History, QosProfile
from lifecycle.measure.counter import Counter
from lifecycle.measure.sample import Measured, Sample

if TYPE_CHECKING:
    from rclpy.duration import Duration
    from rclpy.publisher import Publisher
    from rclpy.subscription import Subscription
    from rclpy.timer import Timer


Later = Callable[[Callable[[], Coroutine[Any, Any, None] | None]], object]
"""Runs a function, sync or async, in the node's executor, soon; false if the node is not spun."""


Info = Mapping[str, int]
"""Of a message, rmw_message_info_t as rclpy gives it."""


class Gated(Protocol):
    """Something that opens when its node becomes active and closes when it no longer is."""

    def open(self) -> None:
        """Let data through."""

    def close(self) -> None:
        """Stop data."""


class NodeGate:
    """All gated entities of one node; closed until the node is active.

    Attributes:
        counts: callbacks of subscriptions get message info, as `executor: events` has it not.
        is_open: data may flow.
        apart: topics that are published by another host's clock.
    """

    def __init__(self, *, counts: bool = True) -> None:
        self.counts = counts
        self.is_open = False
        self.apart: Collection[str] = ()
        self._entities: dict[int, Gated] = {}
        self._opened_ns = 0

    def add(self, entity: object, gated: Gated) -> None:
        """Put `gated` in charge of `entity`, in the gate's present position."""
        self._entities[id(entity)] = gated
        (gated.open if self.is_open else gated.close)()

    def remove(self, entity: object) -> None:
        """Close and forget an entity that is being destroyed."""
        if (gone := self._entities.pop(id(entity), None)) is not None:
            gone.close()

    def measure(self, apart: Collection[str]) -> None:
        """Count what arrives from now on; `apart`: what is published by another host's clock."""
        self.apart = apart
        for gated in self._counted if self.is_open else ():
            gated.open()

    @property
    def _counted(self) -> list[GatedSubscription]:
        entities = tuple(self._entities.values())
        return [each for each in entities if isinstance(each, GatedSubscription)]

    def measured(self) -> Measured | None:
        """Return what subscriptions have counted; None while it is closed. From any thread."""
        if not self.is_open:
            return None
        now_ns = time.monotonic_ns()
        counts = (each.sample(now_ns) for each in self._counted)
        return Measured(
            active_s=(now_ns - self._opened_ns) / 1e9,
            samples=tuple(each for each in counts if each is not None),
        )

    def open(self) -> None:
        """Open every entity; the node became active."""
        self.is_open, self._opened_ns = True, time.monotonic_ns()
        for gated in tuple(self._entities.values()):
            gated.open()

    def close(self) -> None:
        """Close every entity; the node is no longer active."""
        self.is_open = False
        for gated in tuple(self._entities.values()):
            gated.close()


class GatedPublisher:
    """Drops what is published while closed; says so once per inactive period."""

    _warning = (
        "cannot publish on {!r}: the node is not active, so the message is dropped, and so are "
        "those that follow until it is active"
    )

    def __init__(self, publisher: Publisher, warn: Callable[[str], None]) -> None:
        self._publisher = publisher
        self._warn = warn
        self._warned = False

    def open(self) -> None:
        """Take the override away: `publish` is the class's own method again."""
        vars(self._publisher).pop("publish", None)

    def close(self) -> None:
        """Override `publish` on this one publisher."""
        self._warned = False
        self._publisher.publish = self._drop

    def _drop(self, msg: object) -> None:  # noqa: ARG002 - the signature of Publisher.publish
        if not self._warned:
            self._warned = True
            self._warn(self._warning.format(self._publisher.topic))


class HeldPublisher(GatedPublisher):
    """A publisher of a node that does not know of the gate, and may publish in its constructor.

    What TRANSIENT_LOCAL would keep for late subscriptions is kept, and sent once the gate opens.
    """

    _warning = (
        "the gate is closed: what is published on {!r} is dropped until the system is verified"
    )

    def __init__(self, publisher: Publisher, warn: Callable[[str], None]) -> None:
        super().__init__(publisher, warn)
        qos = publisher.qos_profile
        self._kept: Kept | None = None
        if qos.durability.name == "TRANSIENT_LOCAL":
            self._kept = Kept(None if qos.history.name == "KEEP_ALL" else qos.depth or 1)

    def open(self) -> None:
        """Publish as rclpy does, first what was kept."""
        super().open()
        if self._kept is not None:
            self._kept.send_again(self._publisher)
            self._kept.forget()

    def _drop(self, msg: object) -> None:
        if self._kept is None:
            super()._drop(msg)
        else:
            self._kept.add(msg)


class GatedSubscription:
    """Counts what arrives while open (`lifecycle.measure`); takes and drops messages while closed.

    So old ones do not wait for activation. A TRANSIENT_LOCAL sample is state, not an event, and
    sent once: the last `depth` of those are kept while closed and given to the callback when
    opened. A callback of ours takes message info always: rclpy decides that for each message
    before the gate may swap the callback.

    Args:
        subscription: rclpy's.
        gate: of its node.
        later: of its node; None for one whose executor the gate holds: then messages are left
            alone while it is closed.

    Attributes:
        topic: fully qualified.
        counter: None while closed.

    Raises:
        LifecycleError: its callback takes message info, and its node's gate counts nothing.
    """

    def __init__(
        self, subscription: Subscription, gate: NodeGate, later: Later | None = None
    ) -> None:
        self._subscription = subscription
        self.topic = str(subscription.topic_name)
        self._gate = gate
        self._later = later
        qos = subscription.qos_profile
        self._keeps = qos.durability.name == "TRANSIENT_LOCAL"
        self._kept: collections.deque[tuple[object, ...]] = collections.deque(
            maxlen=qos.depth or None
        )
        self._call = subscription.callback
        self.counter: Counter | None = None
        takes_one = _takes_one(self._call)
        if not gate.counts and not takes_one:
            raise LifecycleError(
                f"cannot give the callback of {self.topic!r} message info with 'executor: events'",
                hint="have it take the message alone, or choose another executor",
            )
        if gate.counts and takes_one:
            self._call = _taking_info(self._call)

    def open(self) -> None:
        """Give messages to the user's callback, those first that were kept."""
        is_apart = self.topic in self._gate.apart
        if not self._gate.counts:
            self._subscription.callback = self._call
        elif self.counter is None or self.counter.is_apart is not is_apart:
            self.counter = Counter(time.monotonic_ns(), time.time_ns(), is_apart=is_apart)
            self._subscription.callback = counting(self._call, self.counter)
        if self._kept and self._later is not None:
            self._later(self._deliver)

    def close(self) -> None:
        """Count no more, and drop messages."""
        self.counter = None
        self._subscription.callback = self._call
        if self._later is not None:
            self._subscription.callback = self._drop if self._gate.counts else self._keep

    def sample(self, now_ns: int) -> tuple[str, Sample] | None:
        """Return the topic and what was counted; None if nothing is."""
        counter = self.counter
        return None if counter is None else (self.topic, counter.sample(now_ns))

    def _drop(self, message: object, info: Info) -> None:
        self._keep(message, info)

    def _keep(self, message: object, *info: Info) -> None:
        if self._keeps:
            self._kept.append((message, *info))

    async def _deliver(self) -> None:
        # Closed again before this ran: then what was kept stays kept.
        while self._kept and self._gate.is_open:
            returned = self._call(*self._kept.popleft())
            if inspect.isawaitable(returned):
                await returned


def _taking_info(callback: Callable[..., Any]) -> Callable[[Any, Info], Any]:
    """Return a callback that takes message and info of one that takes the message alone."""
    if inspect.iscoroutinefunction(callback):

        async def awaited(message: object, _: Info) -> None:
            await callback(message)

        return awaited
    return lambda message, _: callback(message)


def counting(call: Callable[[Any, Info], Any], counter: Counter) -> Callable[[Any, Info], Any]:
    """Return a callback that notes each message before the user's is called."""
    arrived, now_ns, wall_ns = counter.arrived, time.monotonic_ns, time.time_ns
    if inspect.iscoroutinefunction(call):

        async def awaited(message: object, info: Info) -> None:
            arrived(now_ns(), wall_ns(), info)
            await call(message, info)

        return awaited

    def counted(message: object, info: Info) -> Any:
        arrived(now_ns(), wall_ns(), info)
        return call(message, info)

    return counted


class GatedTimer:
    """Runs while open, from then on, unless the user cancelled it; reset keeps its meaning."""

    def __init__(self, timer: Timer, *, wanted: bool) -> None:
        self._timer = timer
        self._wanted = wanted
        self._is_open = False
        self._cancel = timer.cancel
        self._reset = timer.reset
        timer.cancel = self._user_cancel
        timer.reset = self._user_reset

    def open(self) -> None:
        """Start the period now, if the timer is wanted."""
        self._is_open = True
        if self._wanted:
            self._reset()

    def close(self) -> None:
        """Stop; the executor does not wake for it any more."""
        self._is_open = False
        self._cancel()

    def _user_cancel(self) -> None:
        self._wanted = False
        self._cancel()

    def _user_reset(self) -> None:
        self._wanted = True
        if self._is_open:
            self._reset()


def _takes_one(callback: Callable[..., Any]) -> bool:
    """Return whether rclpy gives a subscription's callback the message alone."""
    try:
        inspect.signature(callback).bind(object())
    except TypeError:
        return False
    return True


class Kept:
    """The last messages of one publisher, serialized: its TRANSIENT_LOCAL history.

    DDS keeps it in the writer, and each connection has a writer of its own (DDS 1.4, 2.2.3.4).

    Args:
        depth: how many, > 0; None for all.
        lifespan_ns: older ones are not worth anything any more; None for ever.
    """

    def __init__(self, depth: int | None, lifespan_ns: int | None = None) -> None:
        self._messages: collections.deque[tuple[int, bytes]] = collections.deque(maxlen=depth)
        self._lifespan_ns = lifespan_ns or sys.maxsize

    @classmethod
    def of(cls, qos: QosProfile | None) -> Kept | None:
        """Return what keeps for a publisher of this QoS; None where nothing, or all, is kept."""
        if qos is None or qos.durability is not Durability.TRANSIENT_LOCAL:
            return None
        if qos.history is History.KEEP_ALL:
            return None
        # A profile may leave the depth to the middleware: 1 with Fast DDS 2.14.
        depth = qos.depth if qos.history is History.KEEP_LAST and qos.depth else 1
        return cls(depth, qos.lifespan_ns)

    def add(self, msg: Any) -> None:
        """Keep a message, or serialized bytes, as it is now: its author may change it later."""
        from rclpy.serialization import serialize_message

        data = msg if isinstance(msg, bytes) else serialize_message(msg)
        self._messages.append((time.monotonic_ns(), data))

    def send_again(self, publisher: Publisher) -> None:
        """Publish what is kept by another publisher."""
        for sent_ns, data in self._messages:
            if time.monotonic_ns() - sent_ns <= self._lifespan_ns:
                publisher.publish(data)

    def forget(self) -> None:
        """Nothing was said."""
        self._messages.clear()


class DeclaredPublisher:
    """Publishes on a declared topic while the node is active; drops otherwise.

    While the node is active `publish` is rclpy's own bound method. Only a TRANSIENT_LOCAL publisher
    keeps what it sends, to take it along to another connection.

    Example:
        >>> @on_timer(period_s=0.05)
        ... def tick(self):
        ...     self.publisher("video").publish(self.camera.read())

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
        """As rclpy's, which blocks: whether all was acknowledged; true while not connected."""
        if self._entity is None:
            return True
        return bool(self._entity.wait_for_all_acked(*(() if timeout is None else (timeout,))))

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
        self._entity.publish(msg)  # refuses what is of another type
        self._kept.add(msg)

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
