"""Builds the picture of a ROS graph from a plan, or from Plan × Observation × Verdict.

Owns: the picture as a whole, its nodes and where they are. The matching of plan and observation is
`verify.matcher`'s; nothing here judges again. Pure.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from lifecycle import dataclasses
from lifecycle.export.picture.lines import pictured_flows, pictured_lines, pictured_participants
from lifecycle.export.picture.model import (
    Basis,
    Picture,
    PicturedFinding,
    PicturedMachine,
    PicturedNode,
    PicturedNodeState,
    PicturedProcess,
    Presence,
)
from lifecycle.manifest import RunKind
from lifecycle.plan import Plan
from lifecycle.verify import Observation, Stage, Verdict, View, lay_out

UNKNOWN_NODE = ""
"""Name of the node of endpoints whose node is not known."""

_STATES = {
    "active": PicturedNodeState.ACTIVE,
    "inactive": PicturedNodeState.INACTIVE,
    "unconfigured": PicturedNodeState.UNCONFIGURED,
    "finalized": PicturedNodeState.FINALIZED,
}


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Supervised:
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
    observation: Observation,
    verdict: Verdict,
    *,
    phase: str = "",
    supervised: Mapping[str, Supervised] | None = None,
) -> Picture:
    """Return the picture of a system.

    Args:
        plan: what was declared.
        observation: what is there; empty if nothing runs.
        verdict: on the two; its findings are put at what they name.
        phase: of the supervisor; empty without one.
        supervised: by full node name, what a supervisor adds.
    """
    basis = Basis.of(lay_out(plan, observation, Stage.ACTIVE), verdict)
    return _picture(basis, phase, supervised or {})


def planned_picture(plan: Plan) -> Picture:
    """Return the picture of a plan: everything that is declared, and nothing about what runs."""
    return _picture(Basis.of(lay_out(plan, Observation(), Stage.ACTIVE), None), "", {})


def _picture(basis: Basis, phase: str, supervised: Mapping[str, Supervised]) -> Picture:
    plan = basis.view.plan
    nodes = _nodes(basis, supervised)
    return Picture(
        system=plan.system,
        domain_id=plan.domain_id,
        phase=phase,
        verdict=basis.verdict.verdict if basis.verdict else None,
        machines=tuple(_machines(plan, nodes)),
        lines=tuple(pictured_lines(basis, nodes)),
        flows=pictured_flows(basis, nodes),
        findings=tuple(
            PicturedFinding(
                number=number,
                rule=each.rule,
                outcome=each.outcome,
                subject=each.subject,
                message=each.message,
                hint=each.hint,
                at=each.at,
            )
            for number, each in enumerate(basis.findings, start=1)
        ),
    )


def _nodes(basis: Basis, supervised: Mapping[str, Supervised]) -> dict[str, PicturedNode]:
    """Every node by full name: declared ones in plan order, then others by name."""
    view = basis.view
    others = {name for name in view.observed if name not in view.planned}
    others |= {each.node for each in view.foreign}
    names = [*view.planned, *sorted(others)]
    if view.unattributed:
        names.append(UNKNOWN_NODE)
    return {
        name: _node(f"n{number}", name, basis, supervised.get(name, Supervised()))
        for number, name in enumerate(names)
    }


def _node(id_: str, name: str, basis: Basis, supervised: Supervised) -> PicturedNode:
    view = basis.view
    planned = view.planned.get(name)
    configuration = view.configurations.get(name)
    presence = Presence.UNDECLARED
    if planned is not None:
        presence = basis.absent if view.is_absent(planned) else Presence.PRESENT
    pid = supervised.pid or (configuration.identity.process_id if configuration else None)
    return PicturedNode(
        id=id_,
        name=name or "unknown node",
        presence=presence,
        state=_state(name, view, presence, supervised),
        machine=planned.machine if planned else "",
        process=planned.process if planned else "",
        pid=pid or None,
        notes=tuple(_notes(name, basis, supervised)),
        participants=pictured_participants(basis, id_, name, presence),
        findings=basis.numbers(
            name, concerns=lambda each: bool(name) and name in (each.node, each.subject)
        ),
    )


def _state(name: str, view: View, presence: Presence, supervised: Supervised) -> PicturedNodeState:
    observed = view.observed.get(name)
    configuration = view.configurations.get(name)
    if supervised.dead:
        return PicturedNodeState.DEAD
    if presence is Presence.MISSING:
        return PicturedNodeState.ABSENT
    if presence is Presence.PLANNED:
        return PicturedNodeState.MANAGED if view.planned[name].managed else PicturedNodeState.PLAIN
    if supervised.silent:
        return PicturedNodeState.SILENT
    reported = (observed.state if observed else None) or (
        configuration.state if configuration else ""
    )
    if reported:
        state = _STATES.get(reported, PicturedNodeState.CHANGING)
        connected = configuration is not None and configuration.connected
        return (
            PicturedNodeState.CONNECTED
            if connected and state is PicturedNodeState.INACTIVE
            else state
        )
    return _unreported_state(None if observed is None else observed.managed, presence)


def _unreported_state(managed: bool | None, presence: Presence) -> PicturedNodeState:
    """The state of a node that reports none."""
    if managed is False:
        return PicturedNodeState.PLAIN
    # A declared node was asked; an undeclared one was not.
    asked = managed and presence is Presence.PRESENT
    return PicturedNodeState.SILENT if asked else PicturedNodeState.UNKNOWN


def _notes(name: str, basis: Basis, supervised: Supervised) -> Iterable[str]:
    planned = basis.view.planned.get(name)
    observed = basis.view.observed.get(name)
    if planned is None:
        yield "not declared"
    elif planned.run.kind is RunKind.ATTACH:
        yield "started by others"
    if planned is not None and basis.verdict is None:
        yield from (f"after {each.node} {each.condition.value}" for each in planned.after)
    if observed is not None and observed.count > 1:
        yield f"{observed.count} of this name"
    if supervised.doing:
        yield supervised.doing


def _machines(plan: Plan, nodes: Mapping[str, PicturedNode]) -> Iterable[PicturedMachine]:
    addresses = {machine.name: machine.address for machine in plan.machines}
    declared = {node.key: nodes[node.full_name] for node in plan.nodes}
    names = dict.fromkeys(process.machine for process in plan.processes)
    for name in names:
        address = addresses.get(name, "")
        title = f"machine {name}{f' ({address})' if address else ''}" if name else "this host"
        yield PicturedMachine(
            title=title,
            processes=tuple(
                PicturedProcess(
                    title="" if process.nodes == (process.name,) else f"process {process.name}",
                    nodes=tuple(declared[key] for key in process.nodes),
                )
                for process in plan.processes
                if process.machine == name
            ),
        )
    others = [node for node in nodes.values() if node.presence is Presence.UNDECLARED]
    if others:
        yield PicturedMachine(
            title="not declared",
            processes=tuple(PicturedProcess(title="", nodes=(node,)) for node in others),
        )
