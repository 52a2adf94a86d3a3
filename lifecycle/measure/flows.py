"""What was measured of flows: what status, verdicts, diagnostics and records show. Pure.

Apart from verdicts because `lifecycle status` shows it, which loads no plan and no rule.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Annotated

import msgspec

from lifecycle.codec import Count, says
from lifecycle.measure.bounds import Kind, apart
from lifecycle.measure.clock import ClockOffset
from lifecycle.printable import count

Pair = tuple[str, str, str]
"""Of a flow its topic, and the full names of the nodes that publish and subscribe."""


NUMBERS = ("messages", "lost", "rate_hz", "p50_ms", "p99_ms")


class MeasuredBound(msgspec.Struct, frozen=True, kw_only=True):
    """A number that the manifest declares of a flow, and what was measured of it.

    Attributes:
        name: the manifest's key, `max_delay_ms`.
        kind: what it bounds.
        outcome: "measuring" while what has arrived cannot decide it; "unverifiable" where that is
            because too little is known of the clocks of two hosts.
        text: `delay p99 0.6 ms ≤ 5 ms`.
        share: what was measured, divided by the bound; None while nothing is known.
        decides_in_s: about how long it takes yet to decide; None if it is decided, or where that is
            not known.
    """

    name: str
    kind: Kind
    outcome: Annotated[str, says(enum=["measuring", "ok", "violated", "unverifiable"])]
    text: str
    share: float | None = None
    decides_in_s: float | None = None

    @property
    def badness(self) -> float:
        """How many times worse than the bound it is; of a rate that is too low, too."""
        if self.share is None:
            return 0.0
        return max(self.share, 1 / self.share) if self.share > 0 else float("inf")


class FlowMeasurement(msgspec.Struct, frozen=True, kw_only=True):
    """What has arrived of one publisher → subscription pair, at the subscription.

    Attributes:
        publisher: fully qualified node name.
        subscription: fully qualified node name.
        messages: how many arrived in the last 5 s or a little more.
        lost: how many of those published meanwhile did not, by publication sequence numbers; None
            where they do not show it.
        rate_hz: messages per second of that time.
        p50_ms: delay from publication to the start of the callback, milliseconds, of the last 200
            messages or 5 s; None without a message, or between hosts whose clocks are not compared.
        p99_ms: likewise.
        clock: how far the clock of the publisher's host is ahead of the subscription's, which those
            are corrected by; None on one host, or where it is not known.
        bounds: what the manifest declares of it.
    """

    topic: str
    publisher: str
    subscription: str
    messages: Count
    lost: Count | None
    rate_hz: float
    p50_ms: float | None = None
    p99_ms: float | None = None
    clock: ClockOffset | None = None
    bounds: tuple[MeasuredBound, ...] = ()

    @property
    def pair(self) -> Pair:
        """Topic, publisher and subscription."""
        return self.topic, self.publisher, self.subscription

    @property
    def name(self) -> str:
        """Which flow it is: `/video /camera → /viewer`."""
        return f"{self.topic} {self.publisher} → {self.subscription}"

    def numbers(self) -> dict[str, str]:
        """Return what was counted as text, by the names of NUMBERS; empty where it is not known."""
        known = (
            *(self.messages, self.lost, f"{self.rate_hz:.3f}"),
            *(None if each is None else f"{each:.3f}" for each in (self.p50_ms, self.p99_ms)),
        )
        texts = ("" if each is None else str(each) for each in known)
        return dict(zip(NUMBERS, texts, strict=True))

    @property
    def outcome(self) -> str:
        """Worst of its bounds: "violated", "unverifiable", "measuring", "ok"; empty without any."""
        found = {each.outcome for each in self.bounds}
        return next((each for each in _WORST_FIRST if each in found), "")

    @property
    def violated(self) -> tuple[MeasuredBound, ...]:
        """The bounds that are not kept, the worst first."""
        found = (each for each in self.bounds if each.outcome == "violated")
        return tuple(sorted(found, key=lambda each: -each.badness))

    def describe(self) -> str:
        """Return it in one line: `/video /camera → /viewer: delay p99 0.6 ms ≤ 5 ms, 15.0 Hz`."""
        said = [each.text for each in self.bounds]
        names = {each.name for each in self.bounds}
        if "rate_hz" not in names:
            said.append(f"{self.rate_hz:.1f} Hz")
        if names.isdisjoint(("loss", "five_qi")) and self.lost is not None:
            said.append(f"{self.lost} of {self.messages + self.lost} lost")
        if self.clock is not None:
            said.append(f"clocks {apart(self.clock)} apart")
        return f"{self.name}: {', '.join(said)}"


_WORST_FIRST = ("violated", "unverifiable", "measuring", "ok")
_SAID = ("ok", "violated", "unverifiable", "measuring")
_NAMED = 3


def measured_summary(measured: Iterable[FlowMeasurement]) -> str:
    """Return in one line what came of declared numbers; empty where none is measured.

    `measured: 3 flows ok, 1 violated: /video /camera → /viewer: delay p99 7.2 ms > 5 ms`, the worst
    first.
    """
    flows = [each for each in measured if each.bounds]
    found = [(sum(each.outcome == one for each in flows), one) for one in _SAID]
    (number, outcome), *others = [each for each in found if each[0]] or [(0, "")]
    if not number:
        return ""
    numbers = [f"{count(number, 'flow')} {outcome}", *(f"{each} {one}" for each, one in others)]
    violated = [each for each in flows if each.violated]
    violated.sort(key=lambda each: -each.violated[0].badness)
    named = [f"{each.name}: {', '.join(one.text for one in each.violated)}" for each in violated]
    more = [f"and {len(named) - _NAMED} more"] if len(named) > _NAMED else []
    worst = "; ".join((*named[:_NAMED], *more))
    return f"measured: {', '.join(numbers)}" + (f": {worst}" if worst else "")
