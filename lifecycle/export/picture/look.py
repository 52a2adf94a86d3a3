"""How states, presence and outcomes look in every picture, and in its legend.

Owns: colours, symbols and words. Colours are those of Okabe and Ito (*Color Universal Design*,
2008), which colour-blind readers tell apart; each also has a symbol, and the word stands beside it.
Pure.
"""

from __future__ import annotations

import dataclasses

from lifecycle.export.picture.model import NodeState, Presence
from lifecycle.verify.verdict import Outcome


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Look:
    """How one state looks; `ink` is readable on `fill`."""

    symbol: str
    fill: str
    ink: str = "#1b2733"


STATES = {
    NodeState.ACTIVE: Look(symbol="●", fill="#009e73", ink="#ffffff"),
    NodeState.CONNECTED: Look(symbol="◉", fill="#0072b2", ink="#ffffff"),
    NodeState.INACTIVE: Look(symbol="◐", fill="#56b4e9"),
    NodeState.UNCONFIGURED: Look(symbol="○", fill="#f0e442"),
    NodeState.FINALIZED: Look(symbol="■", fill="#8c8c8c", ink="#ffffff"),
    NodeState.CHANGING: Look(symbol="◌", fill="#f7f3b0"),
    NodeState.PLAIN: Look(symbol="◆", fill="#cfe8e0"),
    NodeState.UNKNOWN: Look(symbol="?", fill="#e3e8ee"),
    NodeState.SILENT: Look(symbol="◇", fill="#e69f00"),
    NodeState.DEAD: Look(symbol="✖", fill="#1b2733", ink="#ffffff"),
    NodeState.ABSENT: Look(symbol="∅", fill="#ffffff", ink="#b3261e"),
    NodeState.MANAGED: Look(symbol="▣", fill="#dbe6f3"),
}

LINES = {
    Presence.PRESENT: "#3f6ea8",
    Presence.MISSING: "#b3261e",
    Presence.UNDECLARED: "#c75b00",
    Presence.PLANNED: "#4d5a66",
}
"""Colour of what is drawn as a line or a frame."""

DASHES = {
    Presence.PRESENT: "",
    Presence.MISSING: "7 5",
    Presence.UNDECLARED: "2 4",
    Presence.PLANNED: "",
}
"""SVG's stroke-dasharray: missing is dashed, undeclared is dotted."""

PRESENCE_WORDS = {
    Presence.PRESENT: "declared, and there",
    Presence.MISSING: "declared, but missing",
    Presence.UNDECLARED: "there, but not declared",
    Presence.PLANNED: "declared",
}

OUTCOMES = {
    Outcome.OK: Look(symbol="✓", fill="#009e73", ink="#ffffff"),
    Outcome.VIOLATED: Look(symbol="✗", fill="#b3261e", ink="#ffffff"),
    Outcome.UNVERIFIABLE: Look(symbol="?", fill="#e69f00"),
}


def remark(presence: Presence) -> tuple[str, ...]:
    """What is said of something beside its name: nothing if it is as declared."""
    return () if presence.as_declared else (PRESENCE_WORDS[presence],)


def numbers(findings: tuple[int, ...]) -> str:
    """Spell what points to findings: `⚠1 ⚠4`; empty without any."""
    return " ".join(f"⚠{number}" for number in findings)
