"""What was measured of flows as cells of a table, with small bars.

Owns: how a number and its bound look, with `!` for a bound that is not kept and `?` for one that is
not decided, so that no colour is needed to read it.
"""

from __future__ import annotations

from lifecycle.measure.bounds import Kind
from lifecycle.measure.flows import FlowMeasurement

_MARKS = {
    "violated": ("!", "\x1b[31m"),
    "unverifiable": ("?", "\x1b[33m"),
    "measuring": ("?", "\x1b[33m"),
    "ok": (" ", ""),
}
"""Of an outcome, the worst first: what follows the number, and the colour of the cell."""

_EIGHTHS = " ▏▎▍▌▋▊▉█"
_BAR = 3
_DIGITS = 5


def cells(flow: FlowMeasurement | None, *, colour: bool) -> tuple[str, str, str, str]:
    """Return rate in hertz, p50 and p99 of the delay in milliseconds, and what was lost.

    Args:
        flow: None where nothing is measured.
        colour: mark outcomes with ANSI colours.
    """
    if flow is None:
        return ("–", "–", "–", "–")
    lost = "–" if flow.lost is None else f"{flow.lost}/{flow.messages + flow.lost}"
    delays = (Kind.DELAY, Kind.NETWORK_DELAY)
    return (
        _cell(f"{flow.rate_hz:.1f}", flow, (Kind.RATE, Kind.SILENCE), colour=colour),
        _ms(flow.p50_ms).rjust(_DIGITS),
        _cell(_ms(flow.p99_ms), flow, delays, colour=colour),
        _cell(lost, flow, (Kind.LOSS,), colour=colour),
    )


def _ms(value: float | None) -> str:
    if value is None:
        return "–"
    return f"{value:.{2 if value < 10 else 1 if value < 100 else 0}f}"


def _cell(number: str, flow: FlowMeasurement, kinds: tuple[Kind, ...], *, colour: bool) -> str:
    """Write a number, and beside it how much of its bound it is."""
    text = number.rjust(_DIGITS)
    bounds = [each for kind in kinds for each in flow.bounds if each.kind is kind]
    if not bounds:
        return text
    worst = min(bounds, key=lambda each: [*_MARKS].index(each.outcome))
    mark, style = _MARKS[worst.outcome]
    text = f"{text}{mark}{bar(worst.share or 0.0)}".rstrip()
    return f"{style}{text}\x1b[0m" if colour and style else text


def bar(share: float) -> str:
    """Return a bar of three columns: empty for 0, full from 1 on, and never empty in between."""
    eighths = min(round(share * _BAR * 8), _BAR * 8) or (1 if share > 0 else 0)
    full, part = divmod(eighths, 8)
    return ("█" * full + _EIGHTHS[part] * (part > 0)).ljust(_BAR)
