"""The picture of a system, as declared or as it runs: its types, colours and symbols. Pure.

The schema of its JSON is schemas/graph.v1.schema.json. Colours are those of Okabe and Ito (*Color
Universal Design*, 2008), which colour-blind readers can distinguish; each also has a symbol.
"""

from __future__ import annotations

import enum

import msgspec

from lifecycle.codec import DomainId, Positive
from lifecycle.verify.outcome import Outcome
from lifecycle.verify.verdict import Finding


class LineKind(enum.Enum):
    """What a row represents; services and actions run from client to server."""

    TOPIC = "topic"
    SERVICE = "service"
    ACTION = "action"


class Presence(enum.Enum):
    """How something that is drawn compares with the declaration."""

    PRESENT = "present"  # declared, and there
    MISSING = "missing"  # declared, and not there
    UNDECLARED = "undeclared"  # there, and not declared
    PLANNED = "planned"  # declared, and not observed: the picture of a plan


class PicturedNodeState(enum.Enum):
    """What a node is doing, as far as it is known."""

    ACTIVE = "active"
    CONNECTED = "inactive, connected"
    INACTIVE = "inactive"
    UNCONFIGURED = "unconfigured"
    FINALIZED = "finalized"
    CHANGING = "in transition"
    PLAIN = "not managed"
    UNKNOWN = "state unknown"
    SILENT = "silent"  # in the graph, and its services do not answer
    DEAD = "dead"  # its process has ended
    ABSENT = "not there"
    MANAGED = "managed"  # in the picture of a plan, where no node has a state yet


class PicturedNode(msgspec.Struct, frozen=True, kw_only=True):
    """One node.

    Attributes:
        name: fully qualified.
        machine: `machine robot (10.0.0.1)`; empty if it is not known, or there is only this host.
        process: as planned; empty if it is not known.
        pid: as the node or its supervisor reports; None if neither does.
        notes: what is not ordinary about it.
        findings: numbers of those that concern it.
    """

    name: str
    presence: Presence
    state: PicturedNodeState
    machine: str
    process: str
    pid: int | None
    notes: tuple[str, ...]
    findings: tuple[Positive, ...]


class PicturedEnd(msgspec.Struct, frozen=True, kw_only=True):
    """A node's end of a topic, service or action."""

    node: str
    presence: Presence
    notes: tuple[str, ...]
    findings: tuple[Positive, ...]


class PicturedFlow(msgspec.Struct, frozen=True, kw_only=True):
    """Two nodes' ends that belong together.

    Attributes:
        outcome: None in the picture of a plan, and of what no verdict is about.
        label: of a topic: what carries it, DSCP, uniqueness; in a plan what is to.
        notes: 5-tuples, what is asked of it, why it is not ordinary.
        unique: it is, or in a plan is to be, distinguishable to a network.
    """

    source: str
    target: str
    presence: Presence
    outcome: Outcome | None
    label: str
    notes: tuple[str, ...]
    unique: bool


class PicturedLine(msgspec.Struct, frozen=True, kw_only=True):
    """One topic, service or action: a row.

    Attributes:
        sources: publishers or clients.
        targets: subscriptions or servers.
        flows: from each source to each target.
    """

    kind: LineKind
    name: str
    types: tuple[str, ...]
    sources: tuple[PicturedEnd, ...]
    targets: tuple[PicturedEnd, ...]
    flows: tuple[PicturedFlow, ...]


class Picture(msgspec.Struct, frozen=True, kw_only=True):
    """A whole picture.

    Attributes:
        phase: of the supervisor; empty without one.
        verdict: of the last judgement; None in the picture of a plan, where there is none.
        nodes: declared ones in plan order, then others by name.
        lines: topics, then services, then actions.
        findings: elements call them by their place, from 1.
    """

    system: str
    domain_id: DomainId
    phase: str
    verdict: Outcome | None
    nodes: tuple[PicturedNode, ...]
    lines: tuple[PicturedLine, ...]
    findings: tuple[Finding, ...]

    @property
    def title(self) -> str:
        """One line for the head of it."""
        phase = f", {self.phase}" if self.phase else ""
        verdict = f": verdict {self.verdict.value}" if self.verdict else ""
        return f"system {self.system}, domain {self.domain_id}{phase}{verdict}"


class Appearance(msgspec.Struct, frozen=True, kw_only=True):
    """How one state looks; `ink` is readable on `fill`."""

    symbol: str
    fill: str
    ink: str = "#1b2733"


STATES = {
    PicturedNodeState.ACTIVE: Appearance(symbol="●", fill="#009e73", ink="#ffffff"),
    PicturedNodeState.CONNECTED: Appearance(symbol="◉", fill="#0072b2", ink="#ffffff"),
    PicturedNodeState.INACTIVE: Appearance(symbol="◐", fill="#56b4e9"),
    PicturedNodeState.UNCONFIGURED: Appearance(symbol="○", fill="#f0e442"),
    PicturedNodeState.FINALIZED: Appearance(symbol="■", fill="#8c8c8c", ink="#ffffff"),
    PicturedNodeState.CHANGING: Appearance(symbol="◌", fill="#f7f3b0"),
    PicturedNodeState.PLAIN: Appearance(symbol="◆", fill="#cfe8e0"),
    PicturedNodeState.UNKNOWN: Appearance(symbol="?", fill="#e3e8ee"),
    PicturedNodeState.SILENT: Appearance(symbol="◇", fill="#e69f00"),
    PicturedNodeState.DEAD: Appearance(symbol="✖", fill="#1b2733", ink="#ffffff"),
    PicturedNodeState.ABSENT: Appearance(symbol="∅", fill="#ffffff", ink="#b3261e"),
    PicturedNodeState.MANAGED: Appearance(symbol="▣", fill="#dbe6f3"),
}

LINES = {
    Presence.PRESENT: "#3f6ea8",
    Presence.MISSING: "#b3261e",
    Presence.UNDECLARED: "#c75b00",
    Presence.PLANNED: "#4d5a66",
}
"""Colour of what is drawn as a line or a frame."""

DASHES = {Presence.MISSING: "7 5", Presence.UNDECLARED: "2 4"}
"""SVG's stroke-dasharray: missing is dashed, undeclared is dotted."""
