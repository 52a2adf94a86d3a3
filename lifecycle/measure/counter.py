"""Counts what arrives at one subscription: constant memory, some microseconds a message.

Owns: what is noted as a message arrives, the slots in which it is counted later, in another thread,
and for how long they are kept. What is noted costs the callback's thread as little as possible. The
clock is the caller's.
"""

from __future__ import annotations

import threading
from collections import Counter as Counts
from collections import deque
from collections.abc import Iterable, Mapping

from lifecycle.measure.sample import (
    DELAY_MESSAGES,
    DELAY_S,
    SLOT_S,
    Delays,
    Sample,
    Slot,
    buckets_of,
    linear_buckets_of,
)

WARM_UP_S = 0.5
"""What arrives so soon after activation is not counted: others are being activated meanwhile."""

_EACH_LEVEL = 6
"""Slots of one length; when there are more, the two oldest become one of the next length."""

_LEVELS = 14
"""The oldest slots are those of half a second times 2**13: more than an hour each."""

_MOST_NOTED = 64
"""More messages than this are counted at once, in the callback's thread."""

_UNNUMBERED = 1 << 63
"""RMW_MESSAGE_INFO_SEQUENCE_NUMBER_UNSUPPORTED is larger, no sequence number is."""

_MOST_BUCKETS = 4096
"""Of one slot; longer delays count as the longest of those."""

_NS = 1e9
_SLOT_NS = int(SLOT_S * _NS)

_Noted = tuple[int, int, Mapping[str, int]]


class Counter:
    """Counts the messages of one subscription of one publisher.

    Args:
        now_ns: on a clock that only goes forward; counting begins WARM_UP_S later.
        wall_ns: then, on the clock of the source timestamps; what was published before does not
            count.
        is_apart: the source timestamps are of another host's clock, or of several: delays are
            counted as the two clocks show them.
    """

    def __init__(self, now_ns: int, wall_ns: int, *, is_apart: bool = False) -> None:
        self.is_apart = is_apart
        self._buckets_of = linear_buckets_of if is_apart else buckets_of
        self._lock = threading.Lock()
        self._noted: deque[_Noted] = deque()
        self._published_ns = wall_ns + int(WARM_UP_S * _NS)
        self._last_number = 0
        self._since_ns = self._slot_ns = self._last_ns = now_ns + int(WARM_UP_S * _NS)
        self._messages = 0
        self._lost: int | None = 0
        self._levels: list[deque[Slot]] = [deque() for _ in range(_LEVELS)]
        self._delays: deque[tuple[Counts[int], Counts[int]]] = deque(maxlen=round(DELAY_S / SLOT_S))
        self._open()

    def _open(self) -> None:
        self._slot_messages = self._slot_lost = 0
        self._used: Counts[int] = Counts()
        self._received: Counts[int] = Counts()

    def arrived(self, now_ns: int, wall_ns: int, info: Mapping[str, int]) -> None:
        """Note a message, at the start of its callback, with its rmw_message_info_t."""
        self._noted.append((now_ns, wall_ns, info))
        if len(self._noted) > _MOST_NOTED:
            self.count()

    def count(self) -> None:
        """Count what was noted; from any thread."""
        with self._lock:
            self._count([self._noted.popleft() for _ in range(len(self._noted))])

    def sample(self, now_ns: int) -> Sample:
        """Count what was noted, and return what is known now; from any thread."""
        self.count()
        with self._lock:
            self._close_slots(now_ns)
            slots = tuple(each for level in self._levels for each in level)
            used, received = self._recent()
            return Sample(
                seconds=max(0.0, (now_ns - self._since_ns) / _NS),
                silent_s=max(0.0, (now_ns - self._last_ns) / _NS),
                messages=self._messages,
                lost=self._lost,
                slots=slots,
                used=used,
                received=received,
            )

    def _recent(self) -> tuple[Delays, Delays]:
        chosen: list[tuple[Counts[int], Counts[int]]] = []
        messages = 0
        for each in reversed(self._delays):
            chosen.append(each)
            messages += sum(each[0].values())
            if messages >= DELAY_MESSAGES:
                break
        seconds = len(chosen) * SLOT_S
        return (
            Delays.of((each[0] for each in chosen), seconds=seconds, apart=self.is_apart),
            Delays.of((each[1] for each in chosen), seconds=seconds, apart=self.is_apart),
        )

    def _count(self, noted: Iterable[_Noted]) -> None:
        used, received = list[int](), list[int]()
        last, last_ns = self._last_number, self._last_ns
        for now_ns, wall_ns, info in noted:
            source_ns, received_ns = info["source_timestamp"], info["received_timestamp"]
            before, last = last, info["publication_sequence_number"]
            # When it was published is not known by another clock, but when it was received.
            at_ns = (received_ns or wall_ns) if self.is_apart else source_ns
            # Its own clock may have been set back since.
            if at_ns < self._published_ns <= wall_ns or now_ns < self._since_ns:
                continue
            if now_ns >= self._slot_ns + _SLOT_NS:
                self._add(used, received)
                used, received = [], []
                self._close_slots(now_ns)
            if last != before + 1:
                self._skip(before, last)
            used.append(wall_ns - source_ns)
            if received_ns > 0:
                received.append(received_ns - source_ns)
            last_ns = now_ns
        self._last_number, self._last_ns = last, last_ns
        self._add(used, received)

    def _skip(self, before: int, number: int) -> None:
        if not 0 < number < _UNNUMBERED:
            self._lost = None
        elif 0 < before < number and self._lost is not None:  # else its publisher is a new one
            self._lost += number - before - 1
            self._slot_lost += number - before - 1

    def _add(self, used: list[int], received: list[int]) -> None:
        if not used:
            return
        self._messages += len(used)
        self._slot_messages += len(used)
        for counts, delays in ((self._used, used), (self._received, received)):
            counts.update(self._buckets_of(delays))
            while len(counts) > _MOST_BUCKETS:
                longest = counts.pop(max(counts))
                counts[max(counts)] += longest

    def _close_slots(self, now_ns: int) -> None:
        while now_ns - self._slot_ns >= _SLOT_NS:
            self._slot_ns += _SLOT_NS
            self._delays.append((self._used, self._received))
            self._keep(Slot(seconds=SLOT_S, messages=self._slot_messages, lost=self._slot_lost))
            self._open()

    def _keep(self, slot: Slot) -> None:
        for level in self._levels:
            level.appendleft(slot)
            if len(level) <= _EACH_LEVEL:
                return
            slot = Slot.of((level.pop(), level.pop()))
