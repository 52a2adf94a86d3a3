"""The gate: publishers, subscriptions and timers work only while their node is active.

A gate swaps a method instead of asking a
question: while the node is active `publisher.publish` *is* rclpy's own method, so an open gate
costs nothing per call, and a closed one less than any publish. Entities that tools rely on
(`/rosout`, `/parameter_events`, `~/transition_event`, `/clock`) never pass through here.
"""

from __future__ import annotations

import collections
import inspect
import time
from collections.abc import Callable, Collection, Coroutine, Mapping
from typing import TYPE_CHECKING, Any, Protocol

from lifecycle.errors import LifecycleError
from lifecycle.measure.counter import Counter
from lifecycle.measure.sample import Measured, Sample

if TYPE_CHECKING:
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

    Args:
        counts: callbacks of subscriptions get message info, as `executor: events` has it not.

    Attributes:
        counts: as given.
        is_open: data may flow.
        apart: topics that are published by another host's clock.
    """

    def __init__(self, *, counts: bool = True) -> None:
        self.counts = counts
        self.is_open = False
        self.apart: Collection[str] = ()
        self._entities: dict[int, Gated] = {}
        self._workers: dict[int, Callable[[], None]] = {}
        self._left: dict[str, Counter] = {}  # of subscriptions that are gone, by topic
        self._opened_ns = 0

    def add(self, entity: object, gated: Gated) -> None:
        """Put `gated` in charge of `entity`, in the gate's present position."""
        self._entities[id(entity)] = gated
        (gated.open if self.is_open else gated.close)()

    def add_worker(self, entity: object, stop: Callable[[], None]) -> None:
        """Have `stop` called at removal, and before anything is closed: its last messages pass."""
        self._workers[id(entity)] = stop

    def remove(self, entity: object) -> None:
        """Forget an entity that is being destroyed."""
        gone = self._entities.pop(id(entity), None)
        if isinstance(gone, CountedSubscription) and gone.counter is not None:
            self._left[gone.topic] = gone.counter
        if (stop := self._workers.pop(id(entity), None)) is not None:
            stop()

    def measure(self, apart: Collection[str]) -> None:
        """Count what arrives from now on; `apart`: what is published by another host's clock."""
        self.apart = apart
        for gated in self._counted if self.is_open else ():
            gated.open()

    @property
    def _counted(self) -> list[CountedSubscription]:
        entities = tuple(self._entities.values())
        return [each for each in entities if isinstance(each, CountedSubscription)]

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

    def counter(self, topic: str) -> Counter:
        """Return what is to count a topic: of a subscription made anew, what counted before."""
        is_apart = topic in self.apart
        counter = self._left.pop(topic, None)
        if counter is None or counter.is_apart is not is_apart:
            counter = Counter(time.monotonic_ns(), time.time_ns(), is_apart=is_apart)
        return counter

    def close(self) -> None:
        """Close every entity; the node is no longer active."""
        self.is_open = False
        self._left.clear()
        for stop in tuple(self._workers.values()):
            stop()
        for gated in tuple(self._entities.values()):
            gated.close()


class GatedPublisher:
    """Drops what is published while closed; says so once per inactive period."""

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
            self._warn(
                f"cannot publish on {self._publisher.topic!r}: the node is not active, so the "
                "message is dropped, and so are those that follow until it is active"
            )


class CountedSubscription:
    """Counts what arrives while open: `lifecycle.measure`. Closed it leaves messages alone.

    rclpy decides by the callback's signature, once per message, whether to pass the message info. A
    callback of ours takes it always, so that a swap between take and call changes nothing.

    Attributes:
        topic: fully qualified.
        counter: None while closed.

    Raises:
        LifecycleError: its callback takes message info, and its node's gate counts nothing.
    """

    def __init__(self, subscription: Subscription, gate: NodeGate) -> None:
        self._subscription = subscription
        self.topic = str(subscription.topic_name)
        self._gate = gate
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
        """Count from now on."""
        is_apart = self.topic in self._gate.apart
        if not self._gate.counts:
            self._subscription.callback = self._call
        elif self.counter is None or self.counter.is_apart is not is_apart:
            self.counter = self._gate.counter(self.topic)
            self._subscription.callback = counting(self._call, self.counter)

    def close(self) -> None:
        """Count no more."""
        self.counter = None
        self._subscription.callback = self._call

    def sample(self, now_ns: int) -> tuple[str, Sample] | None:
        """Return the topic and what was counted; None if nothing is."""
        counter = self.counter
        return None if counter is None else (self.topic, counter.sample(now_ns))


class GatedSubscription(CountedSubscription):
    """Takes and drops messages while closed, so that old ones do not wait for activation.

    A TRANSIENT_LOCAL sample is state, not an event: its publisher, activated before us, sends it
    once. So the last `depth` of those are kept while closed and given to the callback when opened.
    """

    def __init__(self, subscription: Subscription, gate: NodeGate, later: Later) -> None:
        super().__init__(subscription, gate)
        self._later = later
        qos = subscription.qos_profile
        self._keeps = qos.durability.name == "TRANSIENT_LOCAL"
        self._kept: collections.deque[tuple[object, ...]] = collections.deque(
            maxlen=qos.depth or None
        )

    def open(self) -> None:
        """Give messages to the user's callback, those first that were kept."""
        super().open()
        if self._kept:
            self._later(self._deliver)

    def close(self) -> None:
        """Drop messages."""
        super().close()
        self._subscription.callback = self._drop if self._gate.counts else self._keep

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
    """Runs while open unless the user cancelled it; calls to cancel and reset keep their meaning.

    A timer starts its period anew when the node becomes active.
    """

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
