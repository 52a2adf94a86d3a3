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

_SLEW = 1_600
"""While one is slewed, by one part of so many, 625 ppm: adjtime(3) and what the kernel does for
adjtimex(2) make it 500 ppm faster or slower."""

_SLEWED_NS = 60_000_000_000
"""A clock may be slewed for so long since an exchange has shown that."""

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
        # Between which two the offset was, and when, if clocks drift apart by one part of the key.
        self._known: dict[int, tuple[int, int, int]] = {}
        self._set_ns: int | None = None
        self._slewed_ns: int | None = None

    def add(self, t1_ns: int, t2_ns: int, t3_ns: int, t4_ns: int) -> None:
        """Take an exchange, whose answer may have waited.

        An exchange that contradicts itself or those before it shows that a clock is slewed; or, by
        more than that explains, that one was set: they are forgotten.

        Args:
            t1_ns: a message was sent, on our clock, ...
            t2_ns: ... and received, on the other's.
            t3_ns: later the other sent one, on its clock, ...
            t4_ns: ... and it was received, on ours.
        """
        took_ns, back_ns, there_ns = t4_ns - t1_ns, t3_ns - t4_ns, t2_ns - t1_ns
        if took_ns < 0 or back_ns - there_ns > 2 * _drift_ns(took_ns, _SLEW):
            self._set_ns = t4_ns  # in the middle of it: nothing else is known of it
            return
        *_, at_ns = self._known.get(_SLEW, (t4_ns,))
        fits = {
            rate: self._take(rate, took_ns, back_ns, there_ns, t4_ns) for rate in (_DRIFT, _SLEW)
        }
        if not fits[_SLEW] or (not fits[_DRIFT] and abs(t4_ns - at_ns) > _JUDGED_NS):
            self._set_ns = t4_ns
        elif not fits[_DRIFT]:
            self._slewed_ns = t4_ns

    def _take(self, rate: int, took_ns: int, back_ns: int, there_ns: int, now_ns: int) -> bool:
        """Return whether an exchange contradicts nothing that is known, where clocks drift so."""
        # It was so at some time between.
        low, high = back_ns - _drift_ns(took_ns, rate), there_ns + _drift_ns(took_ns, rate)
        if low > high:
            return False
        least, most, at_ns = self._known.get(rate, (low, high, now_ns))
        drift = _drift_ns(now_ns - at_ns, rate)
        best = max(low, least - drift), min(high, most + drift)
        fits = best[0] <= best[1]
        self._known[rate] = (*(best if fits else (low, high)), now_ns)
        return fits

    def offset(self, now_ns: int) -> ClockOffset | None:
        """Return the offset of delays that are judged at a time of our clock, and so at that time.

        None before the first exchange, and while some of these may be from before a clock was set.
        """
        if self._is_since(self._set_ns, now_ns, _JUDGED_NS):
            return None
        rate = _SLEW if self._is_since(self._slewed_ns, now_ns, _SLEWED_NS) else _DRIFT
        if rate not in self._known:
            return None
        low, high, at_ns = self._known[rate]
        drift = max(_drift_ns(each - at_ns, rate) for each in (now_ns, now_ns - _JUDGED_NS))
        low, high = low - drift, high + drift
        return ClockOffset(offset_ms=(low + high) / 2e6, uncertainty_ms=(high - low + 1) / 2e6)

    @staticmethod
    def _is_since(at_ns: int | None, now_ns: int, within_ns: int) -> bool:
        return at_ns is not None and abs(now_ns - at_ns) < within_ns


def _drift_ns(duration_ns: int, rate: int) -> int:
    """Return by how much clocks drift apart at most, at one part of `rate`."""
    return abs(duration_ns) // rate + 1
