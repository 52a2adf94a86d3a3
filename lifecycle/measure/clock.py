"""How far the clock of another host is ahead of ours, by NTP's four timestamps. Pure.

Owns: `ClockComparison`, which takes exchanges of messages and returns what they prove. The clock of
the other host is ahead by at most t2 - t1, as a message takes no less than no time to get there,
and by at least t3 - t4, as one takes no less to come back (RFC 5905 §8: their mean is the offset,
half their distance half of the round trip). Every exchange says so, so what several of them allow
is what each of them allows (RFC 5905 §11.2.1), however asymmetric their ways are.
"""

from __future__ import annotations

from collections.abc import Iterable

import msgspec

from lifecycle.measure.sample import DELAY_S, SLOT_S

_DRIFT = 10_000
"""Two clocks drift apart by one part of so many, 100 ppm, at most. RFC 5905 §7.2 allows 15 ppm for
one clock; the quartz of one that nothing disciplines is off by up to 50 ppm."""

JUDGED_S = DELAY_S + 3 * SLOT_S
"""Messages that are judged are this old at most: a slot is closed and reported within two more, and
a busy host has another one."""

_JUDGED_NS = round(JUDGED_S * 1e9)


class ClockOffset(msgspec.Struct, frozen=True, kw_only=True):
    """How far the clock of another host is ahead of ours.

    Attributes:
        offset_ms: added to a time of ours it gives the other's; negative if that is behind.
        uncertainty_ms: the offset is this much larger or smaller at most; 0 of one clock alone.
    """

    offset_ms: float = 0.0
    uncertainty_ms: float = 0.0

    @classmethod
    def any_of(cls, offsets: Iterable[ClockOffset]) -> ClockOffset:
        """Return what holds for each of these clocks, at least one."""
        ends = [
            (each.offset_ms - each.uncertainty_ms, each.offset_ms + each.uncertainty_ms)
            for each in offsets
        ]
        low, high = min(low for low, _ in ends), max(high for _, high in ends)
        return cls(offset_ms=(low + high) / 2, uncertainty_ms=(high - low) / 2)


SAME_CLOCK = ClockOffset()
"""Of two ends on one host."""


class ClockComparison:
    """Compares the clock of one other host with ours, in constant memory.

    What the best exchanges have proven is kept, ever wider as clocks drift: messages that queue,
    once data congest the network, prove little.
    """

    def __init__(self) -> None:
        # Between which two the offset was, and when.
        self._known: tuple[int, int, int] | None = None
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
        # It was so at some time between.
        drift = _drift_ns(t4_ns - t1_ns)
        low, high = t3_ns - t4_ns - drift, t2_ns - t1_ns + drift
        if t4_ns < t1_ns or low > high:
            return  # a clock was set in the middle of it
        if self._known is not None:
            least, most, at_ns = self._known
            drift = _drift_ns(t4_ns - at_ns)
            best = max(low, least - drift), min(high, most + drift)
            if best[0] <= best[1]:
                low, high = best
            else:
                self._set_ns = t4_ns
        self._known = low, high, t4_ns

    def offset(self, now_ns: int) -> ClockOffset | None:
        """Return the offset of delays that are judged at a time of our clock, and so at that time.

        None before the first exchange, and while some of these may be from before a clock was set.
        """
        is_new = self._set_ns is not None and abs(now_ns - self._set_ns) < _JUDGED_NS
        if self._known is None or is_new:
            return None
        low, high, at_ns = self._known
        drift = max(_drift_ns(each - at_ns) for each in (now_ns, now_ns - _JUDGED_NS))
        low, high = low - drift, high + drift
        return ClockOffset(offset_ms=(low + high) / 2e6, uncertainty_ms=(high - low + 1) / 2e6)


def _drift_ns(duration_ns: int) -> int:
    return abs(duration_ns) // _DRIFT + 1
