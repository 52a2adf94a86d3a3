"""A picture of a system as declared, or as it runs beside that, in no language yet.

Owns: the types; JSON-able through `lifecycle.codec` (schema: schemas/graph.v1.schema.json). How
they are filled is build.py's. Pure.
"""

from __future__ import annotations

import dataclasses
import enum

from lifecycle.verify.verdict import Outcome


class LineKind(enum.Enum):
    """What a line stands for; services and actions run from client to server."""

    TOPIC = "topic"
    SERVICE = "service"
    ACTION = "action"


class Presence(enum.Enum):
    """How something that is drawn stands to the declaration."""

    PRESENT = "present"  # declared, and there
    MISSING = "missing"  # declared, and not there
    UNDECLARED = "undeclared"  # there, and not declared
    PLANNED = "planned"  # declared, and nobody looked: the picture of a plan

    @property
    def as_declared(self) -> bool:
        """Whether nothing is to be said of it."""
        return self in (Presence.PRESENT, Presence.PLANNED)


class NodeState(enum.Enum):
    """What a node is doing, as far as anybody tells."""

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
    """One DDS participant of a node: a connection, or what tells a publisher's flow apart.

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
        pid: as the node or its supervisor tells; None if nobody does.
        notes: what is not ordinary about it.
        findings: numbers of those that concern it.
    """

    id: str
    name: str
    presence: Presence
    state: NodeState
    machine: str
    process: str
    pid: int | None
    notes: tuple[str, ...]
    participants: tuple[PicturedParticipant, ...]
    findings: tuple[int, ...]


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class PicturedProcess:
    """One process; `title` is empty for one that is just its one node."""

    title: str
    nodes: tuple[PicturedNode, ...]


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class PicturedMachine:
    """One machine, or what runs nobody knows where."""

    title: str
    processes: tuple[PicturedProcess, ...]


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class PicturedEnd:
    """A node's end of a topic, service or action."""

    node: str
    presence: Presence
    notes: tuple[str, ...]
    findings: tuple[int, ...]


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
        medium: what carries it; "unknown" where nobody tells. In the picture of a plan what is to.
        planned: what was to carry it; empty if that was left open.
        tuples: network flow endpoints, `udp 10.0.0.1:7412 → 10.0.0.2:7413`.
        dscp: in words; empty if none was read back. In the picture of a plan what is asked for.
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
    findings: tuple[int, ...]


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class PicturedFinding:
    """One finding of the verdict; `number` is what elements call it by, from 1."""

    number: int
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
    domain_id: int
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
