"""What a subscription has counted, as its node reports it: recent windows, quantiles of delays.

Delays are in a histogram of constant size, which divides each doubling of a delay into 64 parts, so
that a quantile that is read from it is at most 1/64 below the exact one. Pure.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Annotated

import msgspec

from lifecycle.codec import LARGEST, Count

_PART_BITS = 6
_PARTS = 1 << _PART_BITS

LONGEST_NS = (1 << 43) - 1
"""Longer delays, more than two hours, count as this one."""

ERROR = 1 / _PARTS
"""A quantile is at most this share below the exact one, and never above it."""

LINEAR_NS = 10_000
"""Width of a bucket where two clocks are apart: less than is known of them."""

_NS_PER_MS = 1e6


def buckets_of(delays_ns: Iterable[int]) -> list[int]:
    """Return the buckets of delays; what seems to arrive before it was sent counts as 0 ns."""
    return [
        ((shift := each.bit_length() - _PART_BITS - 1) << _PART_BITS) + (each >> shift)
        if each >= _PARTS
        else max(each, 0)
        for each in delays_ns
    ]


def linear_buckets_of(delays_ns: Iterable[int]) -> list[int]:
    """Return the buckets of delays by two clocks, negative ones too: all are LINEAR_NS wide."""
    return [each // LINEAR_NS for each in delays_ns]


def least_ns(bucket: int) -> int:
    """Return the shortest delay of a bucket of one clock."""
    shift = max((bucket >> _PART_BITS) - 1, 0)
    return (bucket - (shift << _PART_BITS)) << shift


(LAST_BUCKET,) = buckets_of((LONGEST_NS,))

Bucket = Annotated[int, msgspec.Meta(ge=-LARGEST, le=LARGEST)]


class Delays(msgspec.Struct, frozen=True, kw_only=True):
    """Delays of some messages.

    Attributes:
        seconds: how long it took them all to arrive.
        buckets: those with delays in them, in order, and how many there are in each.
        apart: the publisher is on another host: how far its clock is ahead is not known where they
            are counted, so that all buckets are LINEAR_NS wide.
    """

    seconds: float = 0.0
    buckets: tuple[tuple[Bucket, Count], ...] = ()
    apart: bool = False

    @classmethod
    def of(
        cls, counts: Iterable[dict[int, int]], *, seconds: float = 0.0, apart: bool = False
    ) -> Delays:
        """Add up histograms, each the number of delays by bucket."""
        total: dict[int, int] = {}
        for each in counts:
            for found, number in each.items():
                bucket = found if apart else min(found, LAST_BUCKET)
                total[bucket] = total.get(bucket, 0) + number
        return cls(seconds=seconds, buckets=tuple(sorted(total.items())), apart=apart)

    def _least_ms(self, bucket: int) -> float:
        return (bucket * LINEAR_NS if self.apart else least_ns(bucket)) / _NS_PER_MS

    @property
    def messages(self) -> int:
        """How many messages."""
        return sum(number for _, number in self.buckets)

    def quantile_ms(self, quantile: float) -> float | None:
        """Return the delay, milliseconds, that a share of the messages, 0.99, does not exceed.

        By nearest rank; the largest of several delays is left out, because one late message is no
        quantile. None without messages.
        """
        messages = self.messages
        if messages == 0:
            return None
        rank = min(max(math.ceil(quantile * messages - 1e-9), 1), max(messages - 1, 1))
        for bucket, number in self.buckets:
            rank -= number
            if rank <= 0:
                return self._least_ms(bucket)
        raise AssertionError("the ranks of a histogram end with its messages")

    def later_than(self, ms: float) -> int:
        """Return how many messages were later than this for certain, milliseconds."""
        return sum(number for bucket, number in self.buckets if self._least_ms(bucket) > ms)


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
