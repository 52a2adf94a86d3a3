"""What a subscription has counted, as its node reports it: windows of the recent past. Pure."""

from __future__ import annotations

from collections.abc import Iterable

import msgspec

from lifecycle.codec import Count
from lifecycle.measure.delays import Delays

SLOT_S = 0.5
"""Messages are counted in slots of this length."""

DELAY_MESSAGES = 200
"""Delays are judged over the last slots with so many messages, ..."""

DELAY_S = 5.0
"""... or over so many seconds, if that takes longer."""


class Slot(msgspec.Struct, frozen=True, kw_only=True):
    """What arrived in a span of time.

    Attributes:
        seconds: its length.
        messages: how many arrived.
        lost: how many did not, by the gaps between publication sequence numbers.
    """

    seconds: float
    messages: Count = 0
    lost: Count = 0

    @classmethod
    def of(cls, slots: Iterable[Slot]) -> Slot:
        """Put slots together."""
        each = tuple(slots)
        return cls(
            seconds=sum(one.seconds for one in each),
            messages=sum(one.messages for one in each),
            lost=sum(one.lost for one in each),
        )

    @property
    def published(self) -> int:
        """How many messages were published, as far as that was seen."""
        return self.messages + self.lost

    @property
    def rate_hz(self) -> float:
        """Messages per second."""
        return self.messages / self.seconds if self.seconds > 0 else 0.0


class Sample(msgspec.Struct, frozen=True, kw_only=True):
    """What one subscription has counted since its node was activated.

    Attributes:
        seconds: how long it has counted.
        silent_s: since the last message, or since it counts where none has arrived.
        messages: how many arrived.
        lost: how many did not; None where the RMW gives no publication sequence numbers.
        slots: the last ones, newest first; older ones are put together, ever more of them.
        used: from publication to the start of the callback, of the last 200 messages or 5 s.
        received: likewise from publication to reception by the RMW.
    """

    seconds: float
    silent_s: float = 0.0
    messages: Count = 0
    lost: Count | None = 0
    slots: tuple[Slot, ...] = ()
    used: Delays = Delays()
    received: Delays = Delays()

    def last(self, *, seconds: float = 0.0, published: float = 0.0) -> Slot:
        """Return the shortest recent past that lasts so long and in which so much was published.

        All there is, where that is not enough.
        """
        past = Slot(seconds=0.0)
        for slot in self.slots:
            past = Slot.of((past, slot))
            if past.seconds >= seconds and past.published >= published:
                break
        return past


class Measured(msgspec.Struct, frozen=True, kw_only=True):
    """What a node has counted.

    Attributes:
        active_s: for how long its data have been let through, seconds.
        samples: of its subscriptions, each after its fully qualified topic.
    """

    active_s: float
    samples: tuple[tuple[str, Sample], ...] = ()

    def of(self, topic: str) -> Sample | None:
        """Return what the subscription of a topic has counted; None without one."""
        return next((sample for name, sample in self.samples if name == topic), None)
