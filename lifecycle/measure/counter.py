"""Counts what arrives at one subscription: some microseconds a message.

Owns: what is noted as a message arrives, the slots in which it is counted later, in another thread,
and for how long they are kept. What is noted costs the callback's thread as little as possible. The
clock is the caller's.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Mapping

from lifecycle.measure.sample import DELAY_MESSAGES, DELAY_S, SLOT_S, Delays, Sample, Slot

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

_NS = 1e9
_SLOT_NS = int(SLOT_S * _NS)

_Noted = tuple[int, int, Mapping[str, int]]


class Counter:
    """Counts the messages of one subscription of one publisher.

    Args:
        now_ns: on a clock that only goes forward; counting begins WARM_UP_S later.
        wall_ns: then, on the clock of the source timestamps; what was published before does not
            count.
        is_apart: the source timestamps are of another host's clock, or of several.
    """

    def __init__(self, now_ns: int, wall_ns: int, *, is_apart: bool = False) -> None:
        self.is_apart = is_apart
        self._lock = threading.Lock()
        self._noted: deque[_Noted] = deque()
        self._published_ns = wall_ns + int(WARM_UP_S * _NS)
        self._last_number = 0
        self._since_ns = self._slot_ns = self._last_ns = now_ns + int(WARM_UP_S * _NS)
        self._messages = 0
        self._lost: int | None = 0
        self._levels: list[deque[Slot]] = [deque() for _ in range(_LEVELS)]
        # Of the last slots, nanoseconds: until the callback, and where it is known until reception.
        self._delays: deque[tuple[list[int], list[int]]] = deque(maxlen=round(DELAY_S / SLOT_S))
        self._used: list[int] = []
        self._received: list[int] = []
        self._slot_lost = 0

    def arrived(self, now_ns: int, wall_ns: int, info: Mapping[str, int]) -> None:
        """Note a message, at the start of its callback, with its rmw_message_info_t."""
        self._noted.append((now_ns, wall_ns, info))
        if len(self._noted) > _MOST_NOTED:
            self.count()

    def count(self) -> None:
        """Count what was noted; from any thread."""
        with self._lock:
            last, last_ns = self._last_number, self._last_ns
            for _ in range(len(self._noted)):
                now_ns, wall_ns, info = self._noted.popleft()
                source_ns, received_ns = info["source_timestamp"], info["received_timestamp"]
                before, last = last, info["publication_sequence_number"]
                # When it was published is not known by another clock, but when it was received.
                at_ns = (received_ns or wall_ns) if self.is_apart else source_ns
                # Its own clock may have been set back since.
                if at_ns < self._published_ns <= wall_ns or now_ns < self._since_ns:
                    continue
                self._close_slots(now_ns)
                if not 0 < last < _UNNUMBERED:
                    self._lost = None
                elif (
                    0 < before < last and self._lost is not None
                ):  # else its publisher is a new one
                    self._lost += last - before - 1
                    self._slot_lost += last - before - 1
                self._messages += 1
                self._used.append(wall_ns - source_ns)
                if received_ns > 0:
                    self._received.append(received_ns - source_ns)
                last_ns = now_ns
            self._last_number, self._last_ns = last, last_ns

    def sample(self, now_ns: int) -> Sample:
        """Count what was noted, and return what is known now; from any thread."""
        self.count()
        with self._lock:
            self._close_slots(now_ns)
            used, received = (
                Delays.of(
                    (delay for slot in self._delays for delay in slot[which]),
                    seconds=len(self._delays) * SLOT_S,
                    is_apart=self.is_apart,
                )
                for which in (0, 1)
            )
            return Sample(
                seconds=max(0.0, (now_ns - self._since_ns) / _NS),
                silent_s=max(0.0, (now_ns - self._last_ns) / _NS),
                messages=self._messages,
                lost=self._lost,
                slots=tuple(each for level in self._levels for each in level),
                used=used,
                received=received,
            )

    def _close_slots(self, now_ns: int) -> None:
        while now_ns - self._slot_ns >= _SLOT_NS:
            self._slot_ns += _SLOT_NS
            self._delays.append((self._used, self._received))
            self._keep(Slot(seconds=SLOT_S, messages=len(self._used), lost=self._slot_lost))
            self._used, self._received, self._slot_lost = [], [], 0
            # What is judged are the last so many.
            while sum(len(used) for used, _ in list(self._delays)[1:]) >= DELAY_MESSAGES:
                self._delays.popleft()

    def _keep(self, slot: Slot) -> None:
        for level in self._levels:
            level.appendleft(slot)
            if len(level) <= _EACH_LEVEL:
                return
            slot = Slot.of((level.pop(), level.pop()))
