"""What becomes of a running system by another plan: nodes added, removed, restarted, set.

Owns: `PlanChange` and `change_between`: which difference reaches a node's process, so that it has
to be started again, which is a parameter that may be set while it runs, and which is only judged
by. Pure.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from typing import Any

import msgspec
from msgspec.structs import replace

from lifecycle.codec import to_plain
from lifecycle.manifest.model import ParameterValue, RunKind, Supervision, TargetState, Timeouts
from lifecycle.plan.comparison import PlanDifference, changes
from lifecycle.plan.model import ExpectedParameter, Plan, PlannedEndpoint, PlannedNode, in_mode
from lifecycle.plan.parameters import COMMAND

_JUDGED_BY = (
    *("enforce_dscp", "five_qi", "five_qi_reason", "max_delay_ms", "quantities"),
    *("measure", "type_hash", "qos_defaults"),
)
"""Fields of an endpoint that its process does not know: they are for the verdict and networks."""

_ENDPOINT: dict[str, Any] = {
    each.name: each.default
    for each in msgspec.structs.fields(PlannedEndpoint)
    if each.name in _JUDGED_BY
}

_NOT_SET = ("array", "byte_array")
"""Types of which a value alone does not say how it is to be sent."""

Values = Mapping[str, ParameterValue]


class GivenParameters(msgspec.Struct, frozen=True, kw_only=True):
    """Parameters of a node that may be set while it runs: their values, and types."""

    before: Values
    now: Values
    types: Mapping[str, str]


class PlanChange(msgspec.Struct, frozen=True, kw_only=True):
    """What becomes of the nodes of a running system with another plan; all else stays as it is.

    Attributes:
        differences: of what the manifests declare; none: there is nothing to do.
        added: keys of nodes that only the new plan has.
        removed: keys of nodes that only the running plan has.
        restarted: keys of nodes that both have, and whose processes must be started again.
        parameters: by key, of nodes that are only to be given parameters.
    """

    differences: tuple[PlanDifference, ...]
    added: tuple[str, ...] = ()
    removed: tuple[str, ...] = ()
    restarted: tuple[str, ...] = ()
    parameters: Mapping[str, GivenParameters] = msgspec.field(default_factory=dict)

    @property
    def ends_or_starts(self) -> bool:
        """Whether any process ends or is started."""
        return bool(self.added or self.removed or self.restarted)


def change_between(running: Plan, plan: Plan, *, modes: tuple[str, str] = ("", "")) -> PlanChange:
    """Return what has to be done so that a system that runs by one plan runs by the other.

    A process is started again as a whole, and a component with its container. What others run
    (`attach`) is only judged by.

    Args:
        running: of the manifest in force.
        plan: of the other one.
        modes: that the system is in now, and then; empty for a plan without.
    """
    old = {each.key: each for each in in_mode(running, modes[0]).nodes}
    new = {each.key: each for each in in_mode(plan, modes[1]).nodes}
    both = [key for key in old if key in new]
    given = {key: _settable(old[key], new[key]) for key in both}
    again = {key for key in both if given[key] is None or _as_run(old[key]) != _as_run(new[key])}
    again |= {key for key in both if _is_attached(old[key]) != _is_attached(new[key])}
    processes = tuple(_processes(each) for each in (running, plan))
    again |= {
        key
        for key in both
        if processes[0].get(old[key].process) != processes[1].get(new[key].process)
    }
    gone = old.keys() - new.keys()
    again = _whole(again | gone, (running, plan)) & set(both)
    again -= {key for key in again if _is_attached(old[key]) and _is_attached(new[key])}
    parameters = {
        key: each
        for key, each in given.items()
        if each and each.now and key not in again and not _is_attached(new[key])
    }
    return PlanChange(
        differences=changes(running, plan),
        added=tuple(key for key in new if key not in old),
        removed=tuple(key for key in old if key not in new),
        restarted=tuple(key for key in both if key in again),
        parameters=parameters,
    )


def _is_attached(node: PlannedNode) -> bool:
    """Whether others run it; a component is loaded by us."""
    return node.run.kind is RunKind.ATTACH and not node.run.component


def _as_run(node: PlannedNode) -> object:
    """Return what of a node its process depends on, but for parameters."""
    hosted = node.run.kind is RunKind.PYTHON
    unmanaged = node.state is TargetState.UNCONFIGURED
    bare = replace(
        node,
        endpoints=tuple(replace(each, **_ENDPOINT) for each in node.endpoints),
        participants=tuple(replace(each, reason="") for each in node.participants),
        parameters=(),
        mode_parameters=(),
        parameter_files=(),
        expected_parameters=(),
        unread_parameter_files=(),
        has_all_parameters=False,
        files=tuple(each for each in node.files if not each.place.startswith("parameter_files")),
        after=(),
        state=TargetState.UNCONFIGURED if unmanaged else TargetState.ACTIVE,
        may_end=False,
        supervision=Supervision(),
        on_violation=(),
        timeouts=node.timeouts if hosted else Timeouts(),
    )
    return _without_positions(to_plain(bare))


def _without_positions(plain: object) -> object:
    if isinstance(plain, dict):
        return {key: _without_positions(each) for key, each in plain.items() if key != "at"}
    return [*map(_without_positions, plain)] if isinstance(plain, list | tuple) else plain


def _processes(plan: Plan) -> Mapping[str, object]:
    """Return what each process is started with, beside what its nodes have of it."""
    return {
        each.name: (each.machine, frozenset(each.nodes), each.environment)
        for each in plan.processes
    }


def _whole(keys: Collection[str], plans: Iterable[Plan]) -> set[str]:
    """Return the keys with those of all nodes that come and go with them."""
    found = set(keys)
    while True:
        more = set(found)
        for plan in plans:
            for process in plan.processes:
                if process.run.kind is not RunKind.ATTACH and not found.isdisjoint(process.nodes):
                    more.update(process.nodes)
            more.update(each.key for each in plan.nodes if each.run.container in found)
        if more == found:
            return found
        found = more


def _settable(old: PlannedNode, new: PlannedNode) -> GivenParameters | None:
    """Return which parameters of a node differ; None where they cannot be set while it runs."""
    files = [
        [(each.written, each.digest) for each in node.files if each.place.startswith("parameter_")]
        for node in (old, new)
    ]
    if files[0] != files[1] and (old.unread_parameter_files or new.unread_parameter_files):
        return None
    was = {each.name: each for each in old.expected_parameters}
    becomes = {each.name: each for each in new.expected_parameters}
    before: dict[str, ParameterValue] = {}
    now: dict[str, ParameterValue] = {}
    types: dict[str, str] = {}
    for name in dict.fromkeys((*was, *becomes)):
        one, other = was.get(name), becomes.get(name)
        if one is None or other is None:
            return None
        if (one.type, one.value) == (other.type, other.value):
            continue
        if one.type != other.type or not (_may_be_set(one) and _may_be_set(other)):
            return None
        before[name], now[name], types[name] = one.raw, other.raw, other.type
    return GivenParameters(before=before, now=now, types=types)


def _may_be_set(parameter: ExpectedParameter) -> bool:
    known = parameter.value is not None and parameter.type not in _NOT_SET
    return known and not parameter.read_only and parameter.source != COMMAND
