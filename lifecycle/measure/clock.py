"""How far the clock of another host is ahead of ours, by NTP's four timestamps. Pure.

Owns: `ClockComparison`, which takes exchanges of messages and returns what they prove. The clock of
the other host is ahead by at most t2 - t1, as a message takes no less than no time to get there,
and by at least t3 - t4, as one takes no less to come back (RFC 5905 §8: their mean is the offset,
half their distance half of the round trip). Every exchange says so, so what several of them allow
is what each of them allows (RFC 5905 §11.2.1), however asymmetric their ways are.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable

import msgspec

from lifecycle.codec import Count
from lifecycle.measure.sample import DELAY_S

KEPT = 8
"""Exchanges that are kept, as in NTP's clock filter (RFC 5905 §10)."""

_DRIFT = 10_000
"""Two clocks drift apart by one part of so many, 100 ppm, at most. RFC 5905 §7.1 allows 15 ppm for
one clock; the quartz of one that nothing disciplines is off by up to 50 ppm."""


_JUDGED_NS = round(DELAY_S * 1e9)


class ClockOffset(msgspec.Struct, frozen=True, kw_only=True):
    """How far the clock of another host is ahead of ours.

    Attributes:
        offset_ns: added to a time of ours it gives the other's; negative if that is behind.
        uncertainty_ns: the offset is this much larger or smaller at most.
    """

    offset_ns: int = 0
    uncertainty_ns: Count = 0

    @property
    def offset_ms(self) -> float:
        """In milliseconds, as `uncertainty_ms`."""
        return self.offset_ns / 1e6

    @property
    def uncertainty_ms(self) -> float:
        """In milliseconds."""
        return self.uncertainty_ns / 1e6

    @classmethod
    def between(cls, low_ns: int, high_ns: int) -> ClockOffset:
        """Return the offset that is between these."""
        return cls(offset_ns=(low_ns + high_ns) // 2, uncertainty_ns=(high_ns - low_ns + 1) // 2)

    @classmethod
    def any_of(cls, offsets: Iterable[ClockOffset]) -> ClockOffset:
        """Return what holds for each of these clocks, at least one."""
        each = tuple(offsets)
        return cls.between(
            min(one.offset_ns - one.uncertainty_ns for one in each),
            max(one.offset_ns + one.uncertainty_ns for one in each),
        )


SAME_CLOCK = ClockOffset()
"""Of two ends on one host."""


class ClockComparison:
    """Compares the clock of one other host with ours, in constant memory."""

    def __init__(self) -> None:
        self._exchanges: deque[tuple[int, int, int]] = deque(maxlen=KEPT)
        self._set_ns: int | None = None

    def add(self, t1_ns: int, t2_ns: int, t3_ns: int, t4_ns: int) -> None:
        """Take an exchange, whose answer may have waited.

        An exchange that contradicts those before it shows that a clock was set: they are forgotten.

        Args:
            t1_ns: a message was sent, on our clock, ...
            t2_ns: ... and received, on the other's.
            t3_ns: later the other sent one, on its clock, ...
            t4_ns: ... and it was received, on ours.
        """
        low_ns, high_ns = t3_ns - t4_ns, t2_ns - t1_ns
        if t4_ns < t1_ns or low_ns > high_ns:
            return  # a clock was set in the middle of it
        self._exchanges.append((t1_ns, low_ns, high_ns))
        if self._within(t4_ns) is None:
            self._exchanges.clear()
            self._exchanges.append((t1_ns, low_ns, high_ns))
            self._set_ns = t4_ns

    def offset(self, now_ns: int) -> ClockOffset | None:
        """Return the offset of delays that are judged at a time of our clock, and so at that time.

        None before the first exchange, and while some of these may be from before a clock was set.
        """
        if self._set_ns is not None and abs(now_ns - self._set_ns) < _JUDGED_NS:
            return None
        now, before = self._within(now_ns), self._within(now_ns - _JUDGED_NS)
        return None if now is None or before is None else ClockOffset.any_of((now, before))

    def _within(self, now_ns: int) -> ClockOffset | None:
        """Return the offset at a time; None if there is none that is possible, or known."""
        if not self._exchanges:
            return None
        # What it says held at some time since its first message was sent.
        drifts = [abs(now_ns - sent_ns) // _DRIFT + 1 for sent_ns, _, _ in self._exchanges]
        low = max(each[1] - drift for each, drift in zip(self._exchanges, drifts, strict=True))
        high = min(each[2] + drift for each, drift in zip(self._exchanges, drifts, strict=True))
        return ClockOffset.between(low, high) if low <= high else None
