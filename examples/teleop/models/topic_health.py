"""Whether a topic flows as often as it should.

Owns: rates over a sliding window and what counts as slow or stale. Times are seconds of one
monotonic clock. Pure.
"""

from __future__ import annotations

import collections
import dataclasses
import enum


class Health(enum.IntEnum):
    """Values are those of diagnostic_msgs/DiagnosticStatus."""

    OK = 0
    WARN = 1
    ERROR = 2
    STALE = 3


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class TopicHealth:
    """One topic, judged.

    Attributes:
        rate_hz: over the window, 0 when fewer than two messages are in it.
        age_s: since the last message; None before the first.
        message: one phrase for people.
    """

    topic: str
    health: Health
    rate_hz: float
    age_s: float | None
    message: str


class TopicMeter:
    """Counts one topic's arrivals.

    Args:
        topic: name for people.
        expected_hz: the least rate that is healthy, > 0.
        window: how many arrivals a rate is taken over, >= 2.
        stale_periods: without a message for this many expected periods, a topic is stale.
    """

    def __init__(
        self, topic: str, expected_hz: float, *, window: int = 20, stale_periods: float = 5.0
    ) -> None:
        self.topic = topic
        self._expected_hz = expected_hz
        self._stale_after_s = stale_periods / expected_hz
        self._arrivals_s: collections.deque[float] = collections.deque(maxlen=window)
        self.count = 0

    def arrived(self, now_s: float) -> None:
        """Note one message."""
        self._arrivals_s.append(now_s)
        self.count += 1

    def forget(self) -> None:
        """Start again, as after a pause that nobody should be blamed for."""
        self._arrivals_s.clear()
        self.count = 0

    def judged(self, now_s: float) -> TopicHealth:
        """Return the topic's health at this moment."""
        if not self._arrivals_s:
            return self._result(Health.STALE, 0.0, None, "no message yet")
        age_s = now_s - self._arrivals_s[-1]
        span_s = self._arrivals_s[-1] - self._arrivals_s[0]
        rate_hz = (len(self._arrivals_s) - 1) / span_s if span_s > 0 else 0.0
        if age_s > self._stale_after_s:
            return self._result(Health.STALE, rate_hz, age_s, f"silent for {age_s:.1f} s")
        if 0 < rate_hz < self._expected_hz:
            text = f"{rate_hz:.1f} Hz, expected at least {self._expected_hz:.1f} Hz"
            return self._result(Health.WARN, rate_hz, age_s, text)
        return self._result(Health.OK, rate_hz, age_s, f"{rate_hz:.1f} Hz")

    def _result(
        self, health: Health, rate_hz: float, age_s: float | None, message: str
    ) -> TopicHealth:
        return TopicHealth(
            topic=self.topic, health=health, rate_hz=rate_hz, age_s=age_s, message=message
        )
