"""How far the clock of another host is ahead of ours, by NTP's four timestamps. Pure.

Owns: `ClockComparison`, which takes exchanges of messages and returns what they prove. The clock of
the other host is ahead by at most t2 - t1, as a message takes no less than no time to get there,
and by at least t3 - t4, as one takes no less to come back (RFC 5905 §8: their mean is the offset,
half their distance half of the round trip). Every exchange says so, so what several of them allow
is what each of them allows (RFC 5905 §11.2.1), however asymmetric their ways are.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Iterable

import msgspec

from lifecycle.measure.sample import DELAY_S

KEPT = 8
"""Exchanges that are kept, as in NTP's clock filter (RFC 5905 §10)."""

_DRIFT = 10_000
"""Two clocks drift apart by one part of so many, 100 ppm, at most. RFC 5905 §7.2 allows 15 ppm for
one clock; the quartz of one that nothing disciplines is off by up to 50 ppm."""

_JUDGED_NS = round(DELAY_S * 1e9)

_Exchange = tuple[int, int, int, int]
"""When it began and ended on our clock, and between what the offset was meanwhile."""


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
    """Compares the clock of one other host with ours, in constant memory."""

    def __init__(self) -> None:
        self._exchanges: deque[_Exchange] = deque(maxlen=KEPT)
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
        exchange = (t1_ns, t4_ns, t3_ns - t4_ns, t2_ns - t1_ns)
        if t4_ns < t1_ns or _within([exchange], t4_ns) is None:
            return  # a clock was set in the middle of it
        self._exchanges.append(exchange)
        if _within(self._exchanges, t4_ns) is None:
            self._exchanges.clear()
            self._exchanges.append(exchange)
            self._set_ns = t4_ns

    def offset(self, now_ns: int) -> ClockOffset | None:
        """Return the offset of delays that are judged at a time of our clock, and so at that time.

        None before the first exchange, and while some of these may be from before a clock was set.
        """
        if self._set_ns is not None and abs(now_ns - self._set_ns) < _JUDGED_NS:
            return None
        now = _within(self._exchanges, now_ns)
        before = _within(self._exchanges, now_ns - _JUDGED_NS)
        return None if now is None or before is None else ClockOffset.any_of((now, before))


def _within(exchanges: Collection[_Exchange], now_ns: int) -> ClockOffset | None:
    """Return what all exchanges allow at a time; None if that is nothing, or there are none."""
    # What each says was so at some time between its begin and its end.
    drifts = [max(abs(now_ns - t1), abs(now_ns - t4)) // _DRIFT + 1 for t1, t4, _, _ in exchanges]
    least = (low - drift for (_, _, low, _), drift in zip(exchanges, drifts, strict=True))
    most = (high + drift for (_, _, _, high), drift in zip(exchanges, drifts, strict=True))
    if not exchanges or (low := max(least)) > (high := min(most)):
        return None
    return ClockOffset(offset_ms=(low + high) / 2e6, uncertainty_ms=(high - low + 1) / 2e6)
