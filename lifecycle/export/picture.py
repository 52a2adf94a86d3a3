"""The picture of a system, as declared or as it runs: its types, and how it is made. Pure.

Built from a plan, or from Plan × Observation × Verdict; the matching of plan and observation is
`verify`'s, and nothing here judges again. The schema of its JSON is schemas/graph.v1.schema.json.
Colours are those of Okabe and Ito (*Color Universal Design*, 2008), which colour-blind readers can
distinguish; each also has a symbol.
"""

from __future__ import annotations

import enum
import itertools
from collections.abc import Iterator, Mapping

import msgspec

from lifecycle.codec import DomainId, Positive
from lifecycle.manifest.model import EndpointKind, RunKind, UniqueHow
from lifecycle.network.dscp import describe
from lifecycle.network.nfe import UniqueRequirement
from lifecycle.plan.model import Plan
from lifecycle.verify.matcher import lay_out
from lifecycle.verify.observation import Observation
from lifecycle.verify.outcome import Outcome
from lifecycle.verify.verdict import Finding, Stage, Verdict
from lifecycle.verify.view import FlowView, View, Whose


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


_UNKNOWN = "unknown node"

_PRIMARY_STATES = ("active", "inactive", "unconfigured", "finalized")
_KINDS = (
    (LineKind.TOPIC, EndpointKind.PUBLISHER, EndpointKind.SUBSCRIPTION),
    (LineKind.SERVICE, EndpointKind.SERVICE_CLIENT, EndpointKind.SERVICE_SERVER),
    (LineKind.ACTION, EndpointKind.ACTION_CLIENT, EndpointKind.ACTION_SERVER),
)
_WORST_FIRST = (Presence.MISSING, Presence.UNDECLARED, Presence.PRESENT, Presence.PLANNED)
_WORST_OUTCOME = (Outcome.VIOLATED, Outcome.UNVERIFIABLE, Outcome.OK)


class Supervised(msgspec.Struct, frozen=True, kw_only=True):
    """What only a supervisor knows of a node.

    Attributes:
        pid: 0 if it runs no process for it.
        dead: its process has ended without being asked to.
        silent: it was found silent.
        doing: what it does or waits for; empty when nothing.
    """

    pid: int = 0
    dead: bool = False
    silent: bool = False
    doing: str = ""


def build_picture(
    plan: Plan,
    observation: Observation | None = None,
    verdict: Verdict | None = None,
    *,
    phase: str = "",
    supervised: Mapping[str, Supervised] | None = None,
) -> Picture:
    """Return the picture of a system.

    Args:
        plan: what was declared.
        observation: what is there; empty if nothing runs, None for a plan alone.
        verdict: on the two; its findings are put at what they name. None for a plan alone.
        phase: of the supervisor; empty without one.
        supervised: by full node name, what a supervisor adds.
    """
    view = lay_out(plan, observation or Observation(), Stage.ACTIVE)
    builder = _Builder(view, verdict, supervised or {})
    return Picture(
        system=plan.system,
        domain_id=plan.domain_id,
        phase=phase,
        verdict=verdict.verdict if verdict else None,
        nodes=tuple(builder.nodes()),
        lines=tuple(builder.lines()),
        findings=builder.findings,
    )


class _Builder:
    def __init__(
        self, view: View, verdict: Verdict | None, supervised: Mapping[str, Supervised]
    ) -> None:
        self._view = view
        self._verdict = verdict
        self._supervised = supervised
        self._absent = Presence.PLANNED if verdict is None else Presence.MISSING
        self.findings = verdict.findings if verdict else ()
        self._numbered = tuple(enumerate(self.findings, start=1))
        self._planned_flows = {(e.planned.topic, *e.ends): e for e in view.flows}
        flows = verdict.flows if verdict else ()
        self._reports = {(each.topic, each.publisher, each.subscription): each for each in flows}

    def nodes(self) -> Iterator[PicturedNode]:
        view = self._view
        others = {*view.observed, *(each.node for each in view.of(Whose.FOREIGN))} - {*view.planned}
        unknown = [""] if view.of(Whose.UNKNOWN) else []
        yield from map(self._node, (*view.planned, *sorted(others), *unknown))

    def _node(self, name: str) -> PicturedNode:
        planned = self._view.planned.get(name)
        configuration = self._view.configurations.get(name)
        supervised = self._supervised.get(name, Supervised())
        presence = Presence.UNDECLARED
        if planned is not None:
            presence = self._absent if self._view.nodes[name].absent else Presence.PRESENT
        pid = supervised.pid or (configuration.identity.process_id if configuration else None)
        addresses = {each.name: each.address for each in self._view.plan.machines}
        address = addresses.get(planned.machine if planned else "", "")
        where = f" ({address})" if address else ""
        numbers = (n for n, each in self._numbered if name and name in (each.node, each.subject))
        return PicturedNode(
            name=name or _UNKNOWN,
            presence=presence,
            state=self._state(name, presence, supervised),
            machine=f"machine {planned.machine}{where}" if planned and planned.machine else "",
            process=planned.process if planned else "",
            pid=pid or None,
            notes=(*self._notes(name), *filter(None, [supervised.doing])),
            findings=tuple(numbers),
        )

    def _state(self, name: str, presence: Presence, supervised: Supervised) -> PicturedNodeState:
        state = PicturedNodeState
        observed, report = self._view.observed.get(name), self._view.configurations.get(name)
        managed = observed.managed if observed else None
        said = (observed.state if observed else None) or (report.state if report else "")
        if supervised.dead or presence is Presence.MISSING:
            return state.DEAD if supervised.dead else state.ABSENT
        if presence is Presence.PLANNED:
            return state.MANAGED if self._view.planned[name].managed else state.PLAIN
        if said and not supervised.silent:
            if said == "inactive" and report is not None and report.connected:
                return state.CONNECTED
            return state(said) if said in _PRIMARY_STATES else state.CHANGING
        if managed is False and not supervised.silent:
            return state.PLAIN
        # A declared node was asked; an undeclared one was not.
        asked = managed and presence is Presence.PRESENT
        return state.SILENT if asked or supervised.silent else state.UNKNOWN

    def _notes(self, name: str) -> Iterator[str]:
        planned, observed = self._view.planned.get(name), self._view.observed.get(name)
        if planned is not None and planned.run.kind is RunKind.ATTACH:
            yield "started by others"
        if planned is not None and self._verdict is None:
            yield from (f"after {each}" for each in planned.after)
        if observed is not None and observed.count > 1:
            yield f"{observed.count} of this name"

    def lines(self) -> Iterator[PicturedLine]:
        rows: dict[tuple[EndpointKind, str], dict[PicturedEnd, str]] = {}
        for kind, name, type_, end in self._ends():
            rows.setdefault((kind, name), {})[end] = type_
        for line_kind, source_kind, target_kind in _KINDS:
            for name in dict.fromkeys(n for kind, n in rows if kind in (source_kind, target_kind)):
                sources = rows.get((source_kind, name), {})
                targets = rows.get((target_kind, name), {})
                yield PicturedLine(
                    kind=line_kind,
                    name=name,
                    types=tuple(dict.fromkeys((*sources.values(), *targets.values()))),
                    sources=tuple(sources),
                    targets=tuple(targets),
                    flows=tuple(self._flows(name, sources, targets)),
                )

    def _ends(self) -> Iterator[tuple[EndpointKind, str, str, PicturedEnd]]:
        """Kind, name and type of every end: several of a node on one name are one."""
        view = self._view
        for each in view.actual:
            planned, type_ = each.planned, each.observed.type if each.observed else ""
            notes = [f"declared as {planned.type}"] if type_ not in ("", planned.type) else []
            notes += [each.report.error] if each.report and each.report.error else []
            presence = Presence.PRESENT if each.observed else self._absent
            end = self._end(each.kind, each.name, each.node, presence, notes)
            yield each.kind, each.name, type_ or planned.type, end
        for other in view.of(Whose.UNDECLARED, Whose.FOREIGN, Whose.UNKNOWN):
            end = self._end(other.kind, other.name, other.node, Presence.UNDECLARED, [])
            yield other.kind, other.name, other.type, end

    def _end(
        self, kind: EndpointKind, name: str, node: str, presence: Presence, notes: list[str]
    ) -> PicturedEnd:
        about = [(n, each) for n, each in self._numbered if each.subject == name]
        about = [(n, each) for n, each in about if each.node in (node, "")]
        return PicturedEnd(
            node=node or _UNKNOWN,
            presence=presence,
            notes=tuple(notes),
            findings=tuple(n for n, each in about if each.endpoint in (kind, None)),
        )

    def _flows(
        self, name: str, sources: Mapping[PicturedEnd, str], targets: Mapping[PicturedEnd, str]
    ) -> Iterator[PicturedFlow]:
        for (source, sent), (target, taken) in itertools.product(sources.items(), targets.items()):
            key = (name, source.node, target.node)
            planned, report = self._planned_flows.get(key), self._reports.get(key)
            subject = f"{name}: {source.node} → {target.node}"
            outcomes = [each.outcome for each in self.findings if each.subject == subject]
            notes = list(_demands(planned)) if planned else []
            label, unique = "", False
            if planned and not self._verdict:
                dscp = planned.writer.planned.dscp if planned.writer else None
                label = _label(planned.planned.medium, dscp)
                unique = planned.planned.unique is not UniqueHow.NOT
            if sent != taken:
                notes.append("types differ")
                outcomes += [Outcome.VIOLATED] if self._verdict else []
            if report is not None:
                outcomes.append(report.outcome)
                notes = [*(each.describe() for each in report.tuples), *notes]
                how = f"{report.unique.value} unique" if report.unique else ""
                label = _label(report.effective_transport, report.dscp, how)
                unique = report.unique in (UniqueHow.WEAKLY, UniqueHow.STRONGLY)
            presence = min(source.presence, target.presence, key=_WORST_FIRST.index)
            yield PicturedFlow(
                source=source.node,
                target=target.node,
                presence=presence,
                outcome=min(outcomes, key=_WORST_OUTCOME.index, default=None),
                label=presence.value if presence in DASHES else label,
                notes=tuple(notes),
                unique=unique,
            )


def _label(medium: str, dscp: int | None, unique: str = "") -> str:
    marked = "" if dscp is None else describe(dscp).partition(" = ")[0]
    return " · ".join(filter(None, (medium, marked, unique)))


def _demands(flow: FlowView) -> Iterator[str]:
    if flow.planned.unique is not UniqueHow.NOT:
        yield f"{flow.planned.unique.value} unique demanded"
    for word, need in zip(("publisher", "subscription"), flow.requirement, strict=True):
        if need is not UniqueRequirement.NOT_REQUIRED:
            yield f"{word} unique {need.value}"
    if flow.planned.max_delay_ms is not None:
        yield f"at most {flow.planned.max_delay_ms:g} ms"
    if flow.five_qi is not None:
        yield f"5QI {flow.five_qi}"
