"""The picture of a system, as declared or as it runs: its types, colours and symbols.

Owns: the types, JSON-able through `lifecycle.codec` (schema: schemas/graph.v1.schema.json), which
build.py fills; the colours, symbols and labels of states, presence and outcomes in every picture
and its legend; and `Basis`, what a picture is drawn from: plan and observation side by side and the
verdict on them, what a plan alone changes, and where findings are shown. Pure.

Colours are those of Okabe and Ito (*Color Universal Design*, 2008), which colour-blind readers can
distinguish; each also has a symbol, and its label is written beside it.
"""

from __future__ import annotations

import enum
from collections.abc import Callable, Mapping, Sequence

from lifecycle import dataclasses
from lifecycle.codec import DomainId, Positive
from lifecycle.verify import Finding, FlowReport, Outcome, Verdict, View


class LineKind(enum.Enum):
    """What a line represents; services and actions run from client to server."""

    TOPIC = "topic"
    SERVICE = "service"
    ACTION = "action"


class Presence(enum.Enum):
    """How something that is drawn compares with the declaration."""

    PRESENT = "present"  # declared, and there
    MISSING = "missing"  # declared, and not there
    UNDECLARED = "undeclared"  # there, and not declared
    PLANNED = "planned"  # declared, and not observed: the picture of a plan

    @property
    def as_declared(self) -> bool:
        """Whether it needs no remark."""
        return self in (Presence.PRESENT, Presence.PLANNED)


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


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class PicturedParticipant:
    """One DDS participant of a node: a connection, or what makes a publisher's flow unique.

    Attributes:
        id: unique in the picture.
        name: `own participant`, or the connection's or the hidden node's name.
        notes: URLs, DSCP, what it is for, why it failed.
    """

    id: str
    node: str
    name: str
    presence: Presence
    notes: tuple[str, ...]


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class PicturedNode:
    """One node.

    Attributes:
        id: unique in the picture.
        name: fully qualified.
        machine: empty if it is not known, or there is only this host.
        process: as planned; empty if it is not known.
        pid: as the node or its supervisor reports; None if neither does.
        notes: what is not ordinary about it.
        findings: numbers of those that concern it.
    """

    id: str
    name: str
    presence: Presence
    state: PicturedNodeState
    machine: str
    process: str
    pid: int | None
    notes: tuple[str, ...]
    participants: tuple[PicturedParticipant, ...]
    findings: tuple[Positive, ...]


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class PicturedProcess:
    """One process; `title` is empty for one that is just its one node."""

    title: str
    nodes: tuple[PicturedNode, ...]


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class PicturedMachine:
    """One machine, or what runs on an unknown one."""

    title: str
    processes: tuple[PicturedProcess, ...]


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class PicturedEnd:
    """A node's end of a topic, service or action."""

    node: str
    presence: Presence
    notes: tuple[str, ...]
    findings: tuple[Positive, ...]


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class PicturedArrow:
    """Two ends that belong together; `source` and `target` are node ids.

    Attributes:
        outcome: None in the picture of a plan.
    """

    source: str
    target: str
    presence: Presence
    outcome: Outcome | None
    notes: tuple[str, ...] = ()


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class PicturedLine:
    """One topic, service or action, and everybody on it.

    Attributes:
        sources: publishers or clients.
        targets: subscriptions or servers.
    """

    id: str
    kind: LineKind
    name: str
    types: tuple[str, ...]
    sources: tuple[PicturedEnd, ...]
    targets: tuple[PicturedEnd, ...]
    arrows: tuple[PicturedArrow, ...]

    @property
    def presence(self) -> Presence:
        """Present as soon as one declared end is."""
        found = {end.presence for end in (*self.sources, *self.targets)}
        for presence in (Presence.PLANNED, Presence.PRESENT, Presence.MISSING):
            if presence in found:
                return presence
        return Presence.UNDECLARED

    @property
    def alone(self) -> tuple[PicturedEnd, ...]:
        """Ends that no arrow leads to or from."""
        joined = {end for arrow in self.arrows for end in (arrow.source, arrow.target)}
        return tuple(end for end in (*self.sources, *self.targets) if end.node not in joined)


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class PicturedFlow:
    """One publisher → subscription pair in the data layer.

    Attributes:
        publisher: participant id.
        subscription: participant id.
        names: of the two nodes.
        outcome: None in the picture of a plan.
        medium: what carries it; "unknown" where not shown. In the picture of a plan what is to.
        planned: what was to carry it; empty if that was left open.
        tuples: network flow endpoints, `udp 10.0.0.1:7412 → 10.0.0.2:7413`.
        dscp: spelled out; empty if none was read back. In the picture of a plan what is asked for.
        unique: "strongly unique", "weakly unique", "not unique" or "uniqueness unknown". In the
            picture of a plan what a link demands; empty if none does.
        demands: what is asked of it.
    """

    id: str
    topic: str
    publisher: str
    subscription: str
    names: tuple[str, str]
    presence: Presence
    outcome: Outcome | None
    medium: str
    planned: str
    tuples: tuple[str, ...]
    dscp: str
    unique: str
    demands: tuple[str, ...]
    findings: tuple[Positive, ...]


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class PicturedFinding:
    """One finding of the verdict; `number` is what elements call it by, from 1."""

    number: Positive
    rule: str
    outcome: Outcome
    subject: str
    message: str
    hint: str
    at: str


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Picture:
    """A whole picture.

    Attributes:
        phase: of the supervisor; empty without one.
        verdict: of the last judgement; None in the picture of a plan, where there is none.
    """

    system: str
    domain_id: DomainId
    phase: str
    verdict: Outcome | None
    machines: tuple[PicturedMachine, ...]
    lines: tuple[PicturedLine, ...]
    flows: tuple[PicturedFlow, ...]
    findings: tuple[PicturedFinding, ...]

    @property
    def title(self) -> str:
        """One line for the head of it."""
        phase = f", {self.phase}" if self.phase else ""
        verdict = f": verdict {self.verdict.value}" if self.verdict else ""
        return f"system {self.system}, domain {self.domain_id}{phase}{verdict}"

    def nodes(self) -> tuple[PicturedNode, ...]:
        """Every node, machine by machine and process by process."""
        return tuple(
            node
            for machine in self.machines
            for process in machine.processes
            for node in process.nodes
        )


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Appearance:
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
    Outcome.OK: Appearance(symbol="✓", fill="#009e73", ink="#ffffff"),
    Outcome.VIOLATED: Appearance(symbol="✗", fill="#b3261e", ink="#ffffff"),
    Outcome.UNVERIFIABLE: Appearance(symbol="?", fill="#e69f00"),
}


def remark(presence: Presence) -> tuple[str, ...]:
    """The remark beside something's name: none if it is as declared."""
    return () if presence.as_declared else (PRESENCE_WORDS[presence],)


def numbers(findings: tuple[int, ...]) -> str:
    """Spell what points to findings: `⚠1 ⚠4`; empty without any."""
    return " ".join(f"⚠{number}" for number in findings)


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Basis:
    """The two sides of a picture.

    Attributes:
        view: plan and observation; the observation is empty for the picture of a plan.
        verdict: on the two; None without an observation, which makes it the picture of a plan.
        reports: the verdict's, by topic, publisher and subscription.
        numbered: numbers of the findings, by what they are about and by their node.
    """

    view: View
    verdict: Verdict | None
    reports: Mapping[tuple[str, str, str], FlowReport]
    numbered: Mapping[str, Sequence[int]]

    @classmethod
    def of(cls, view: View, verdict: Verdict | None) -> Basis:
        """Return the basis of the picture of a view."""
        flows = verdict.flows if verdict else ()
        reports = {(each.topic, each.publisher, each.subscription): each for each in flows}
        numbered: dict[str, list[int]] = {}
        for number, finding in enumerate(verdict.findings if verdict else (), start=1):
            for name in {finding.subject, finding.node}:
                numbered.setdefault(name, []).append(number)
        return cls(view=view, verdict=verdict, reports=reports, numbered=numbered)

    @property
    def absent(self) -> Presence:
        """What everything declared is that is not in the observation."""
        return Presence.PLANNED if self.verdict is None else Presence.MISSING

    @property
    def findings(self) -> tuple[Finding, ...]:
        """All findings; elements call them by their place here, from 1."""
        return () if self.verdict is None else self.verdict.findings

    def numbers(self, *names: str, concerns: Callable[[Finding], bool]) -> tuple[int, ...]:
        """Return the numbers of the findings that concern something.

        Args:
            names: subjects and nodes; a finding about none of them does not concern it.
            concerns: whether one of these findings does.
        """
        found = {number for name in names for number in self.numbered.get(name, ())}
        return tuple(each for each in sorted(found) if concerns(self.findings[each - 1]))

    def outcome(self, name: str, source: str, target: str) -> Outcome | None:
        """What the verdict is on two ends that belong together; None in the picture of a plan."""
        if self.verdict is None:
            return None
        report = self.reports.get((name, source, target))
        subject = f"{name}: {source} → {target}"
        numbers = self.numbers(subject, concerns=lambda each: each.subject == subject)
        found = [self.findings[each - 1].outcome for each in numbers]
        return Outcome.worst([*found, *([report.outcome] if report else [])])
