"""Compare two plans of one system: differences, checksum, notice, and what a change does.

Compared is what manifests declare, after includes and arguments: not where it is written, nor what
follows from the host that planned it (folders, environment, installed types and executables), so
that every host of a system computes the same checksum from the same manifest. The order of entries
counts where the manifest gives it a meaning: in a command line and among parameter files, and for
nodes where ports are given out in their order. Pure.
"""

from __future__ import annotations

import hashlib
import itertools
import json
from collections.abc import Collection, Iterable, Iterator, Mapping
from typing import Any

import msgspec
from msgspec.structs import replace

from lifecycle.codec import from_json, to_json, to_plain
from lifecycle.manifest.diagnostics import Position
from lifecycle.manifest.model import (
    NodeDeclaration,
    ParameterValue,
    Quantity,
    RunKind,
    Supervision,
    SystemDeclaration,
    TargetState,
    Timeouts,
)
from lifecycle.plan.model import (
    ExpectedParameter,
    Plan,
    PlannedNode,
    declared,
    in_mode,
)
from lifecycle.plan.parameters import COMMAND
from lifecycle.plan.processes import shown, without_secrets

_VALUE_CHARACTERS = 80


class PlanDifference(msgspec.Struct, frozen=True, kw_only=True):
    """One difference between two plans.

    Attributes:
        path: place in the manifest, `nodes.talker.run.python`.
        node: key of the node that it belongs to; empty where it belongs to the whole system.
        old: the value as text, "not set" or "not declared" without one; cut to 80 characters.
        at: the position of the node or endpoint in the new plan; None where it has none.
    """

    path: str
    node: str
    old: str
    new: str
    at: Position | None = None


def changes(old: Plan, new: Plan) -> tuple[PlanDifference, ...]:
    """Return every difference between what two plans declare, the system's first, then by node."""
    before, after = _document(old), _document(new)
    return tuple(
        PlanDifference(
            path=".".join(path),
            node=path[1] if path[0] == "nodes" else "",
            old=was,
            new=now,
            at=_at(path, new),
        )
        for path, was, now in sorted(
            _compared((), before, after), key=lambda each: (each[0][0] == "nodes", each[0])
        )
    )


def plan_checksum(plan: Plan) -> str:
    """Return 16 hexadecimal digits (SHA-256) that are the same for plans without differences.

    Values of environment variables that are secret by their names do not count.
    """
    # It is announced to the network: short secrets could be found out by it.
    text = json.dumps(_document(without_secrets(plan)), sort_keys=True, ensure_ascii=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


_Path = tuple[str, ...]


def _document(plan: Plan) -> dict[str, Any]:
    """Return what is declared, as mappings by the manifest's keys."""
    document: dict[str, Any] = {
        **_tree(to_plain(declared(SystemDeclaration, plan))),
        "links": {
            f"{flow.topic} from {flow.publisher} to {flow.subscription}": {
                "unique": flow.unique.value,
                "transport": flow.transport.value,
                "measure": flow.measure,
                **_numbers(flow.quantities),
            }
            for flow in plan.flows
            if flow.linked
        },
        "nodes": {node.key: _node(node) for node in plan.nodes},
    }
    document["policy"]["ros_interface"] = plan.policy.access.value
    if any(node.connections.urls for node in plan.nodes):
        document["order of nodes"] = [node.key for node in plan.nodes]
    return document


_NOT_COMPARED = ("at", "positions", "unproven", "key", "description")
_NAMES = ("rule", "kind", "node", "name")
"""Fields that tell the entries of a list apart."""


def _tree(value: Any) -> Any:
    """Return a plain value without positions; of lists of what has a name, mappings by it."""
    if isinstance(value, dict):
        return {key: _tree(each) for key, each in value.items() if key not in _NOT_COMPARED}
    if not isinstance(value, list | tuple):
        return value
    if value and all(isinstance(each, list | tuple) and len(each) == 2 for each in value):
        return {str(key): _tree(each) for key, each in value}
    if value and all(isinstance(each, dict) and "at" in each for each in value):
        return {
            ": ".join(str(each.pop(key)) for key in _NAMES if key in each): _tree(each)
            for each in value
        }
    return [*map(_tree, value)]


def _node(node: PlannedNode) -> dict[str, Any]:
    written = {each.place: each for each in node.files}
    files = [written.get(f"parameter_files.{index}") for index in range(len(node.parameter_files))]
    document: dict[str, Any] = _tree(to_plain(declared(NodeDeclaration, node)))
    interface: dict[str, dict[str, Any]] = {"parameters": _tree(to_plain(node.declared_parameters))}
    flows: dict[str, dict[str, Any]] = {}
    waiting = {each.name for each in node.participants if each.non_blocking_send}
    for each in node.endpoints:
        qos = _tree(to_plain(each.qos)) or {}
        of = interface.setdefault(each.kind.value, {}), flows.setdefault(each.kind.value, {})
        of[0][each.name] = {
            "type": each.type,
            "qos": {key: value for key, value in qos.items() if key not in each.qos_defaults},
        }
        of[1][each.name] = {
            **{name: to_plain(getattr(each, name)) for name in _FLOW},
            "five_qi": "auto" if each.five_qi_reason else None,
            "non_blocking_send": each.participant in waiting,
            **_numbers(each.quantities),
        }
    named = ("arguments", "environment", "extra_arguments")  # users choose these keys
    document["run"] |= {name: to_plain(getattr(node.run, name)) for name in named}
    if folder := written.get("run.working_directory"):
        document["run"]["working_directory"] = folder.written
    return {
        **document,
        **document.pop("supervision"),
        "interface.parameters": node.has_all_parameters,
        "process": node.process,
        "endpoints": node.endpoint_policy.value,
        "parameter_files": [
            f"{each.written} {each.digest}" if each else path
            for path, each in zip(node.parameter_files, files, strict=True)
        ],
        "after": {
            key: " and ".join(str(each.condition) for each in group)
            for key, group in itertools.groupby(node.after, key=lambda each: each.node)
        },
        "interface": interface,
        "flows": flows,
        "connections": {
            each.connection: {
                "urls": [*each.connections.urls],
                "map": sorted(
                    f"{endpoint.kind.value} {endpoint.name}"
                    for endpoint in node.endpoints
                    if endpoint.participant == each.name
                ),
            }
            for each in node.participants
            if each.declared
        },
    }


_FLOW = ("unique", "dscp", "enforce_dscp", "transport", "lossy", "measure")
"""Fields of an endpoint that say what it asks of its flow, beside numbers."""


def _numbers(quantities: Iterable[Quantity]) -> dict[str, str]:
    """Return numbers by their keys, those of several links on one pair together."""
    found: dict[str, str] = {}
    for each in quantities:
        before = f"{found[each.name]}, " if each.name in found else ""
        found[each.name] = before + str(each).removeprefix(f"{each.name} ")
    return found


def _compared(path: _Path, old: object, new: object) -> Iterator[tuple[_Path, str, str]]:
    """Yield (path, old value, new value) of what differs, as far down as both have it."""
    if old == new:
        return
    if isinstance(old, Mapping) and isinstance(new, Mapping):
        for key in {**old, **new}:
            yield from _compared((*path, key), old.get(key), new.get(key))
    else:
        if path[-2:-1] == ("environment",):
            old, new = (
                shown(path[-1], each) if isinstance(each, str) else each for each in (old, new)
            )
        absent = "not declared" if isinstance(old or new, Mapping) else "not set"
        yield path, _shown(old, absent), _shown(new, absent)


def _shown(value: object, absent: str) -> str:
    if value is None or value == "":
        return absent
    if isinstance(value, Mapping):
        return "declared"
    text = json.dumps(value, ensure_ascii=False)
    return text if len(text) <= _VALUE_CHARACTERS else f"{text[: _VALUE_CHARACTERS - 1]}…"


def _at(path: _Path, plan: Plan) -> Position | None:
    """Return the position of the endpoint, else the node, that a path leads to."""
    for node in plan.nodes if path[0] == "nodes" else ():
        if node.key == path[1]:
            ends = (each.at for each in node.endpoints if path[3:5] == (each.kind.value, each.name))
            return next(ends, node.at)
    return None


MAX_TEXT = 1 << 20
"""Characters of a notice: what the network delivers must not fill our memory."""


class PlanNoticeError(ValueError):
    """A text that is no notice."""


class PlanNotice(msgspec.Struct, frozen=True, kw_only=True):
    """What one supervisor announces of its plan.

    Attributes:
        run: one run of it, unique.
        host: its machine id.
        machines: those whose nodes it brings up.
        nodes: fully qualified names of all nodes of the plan.
        left: it is being shut down, or has been, for this reason.
    """

    run: str
    host: str
    system: str
    machines: tuple[str, ...]
    nodes: tuple[str, ...]
    checksum: str
    left: bool = False
    reason: str = ""

    def replaces(self, other: PlanNotice) -> bool:
        """Whether it replaces `other`: from the same supervisor, or its successor.

        Supervisors of two machines of one system run beside each other, on one host too, and have
        the same nodes in their plans.
        """
        if self.run == other.run:
            return True
        same = not {*self.machines}.isdisjoint(other.machines)
        if self.system == other.system and self.machines and other.machines:
            return same
        gone = other.left or self.host == other.host
        return gone and (same or not {*self.nodes}.isdisjoint(other.nodes))


def notice_of(plan: Plan, *, run: str, host: str, machines: tuple[str, ...]) -> PlanNotice:
    """Return what the supervisor of `machines` announces."""
    return PlanNotice(
        run=run,
        host=host,
        system=plan.system,
        machines=machines,
        nodes=tuple(each.full_name for each in plan.nodes),
        checksum=plan_checksum(plan),
    )


def encode(notice: PlanNotice) -> str:
    """Return the text of a notice."""
    return to_json(notice).decode()


def decode(text: str) -> PlanNotice:
    """Return the notice of a text.

    Raises:
        PlanNoticeError: it is none, longer than 1 MiB, or not fit to be shown.
    """
    try:
        notice = from_json(text, PlanNotice, longest=MAX_TEXT)
    except ValueError as error:
        raise PlanNoticeError(f"cannot read a plan notice: {error}") from error
    # They are shown to people as they are.
    if not (notice.checksum.isalnum() and (notice.reason or " ").isprintable()):
        raise PlanNoticeError("cannot read a plan notice: it has characters that cannot be shown")
    return notice


def concerns(plan: Plan, own: frozenset[str], notice: PlanNotice) -> bool:
    """Whether the supervisor of a notice must have planned the same as we.

    It runs another machine of our system, or plans a node that we plan: a domain has one node of a
    name. Other systems may share the domain, the hosts, and even the name. `own` are the machines
    whose nodes we bring up.
    """
    theirs = {each.machine for each in plan.nodes} - own - {""}
    if notice.system == plan.system and not theirs.isdisjoint(notice.machines):
        return True
    return not {each.full_name for each in plan.nodes}.isdisjoint(notice.nodes)


_MOST_LINES = 20


def difference_lines(found: Iterable[PlanDifference]) -> tuple[str, ...]:
    """Phrase differences with their places in the new manifest, at most 20 of them."""
    lines = [
        f"{f'{each.at.spelled}: ' if each.at else ''}{each.path}: was {each.old}, is {each.new}"
        for each in found
    ]
    more = len(lines) - _MOST_LINES
    return (*lines[:_MOST_LINES], *([f"and {more} more"] if more > 0 else []))


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
    (`attach`) is only judged by. `modes`: that the system is in now, and then; empty without.
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
        # What is for the verdict and for networks alone.
        endpoints=tuple(
            replace(
                each,
                enforce_dscp=True,
                five_qi=None,
                five_qi_reason="",
                max_delay_ms=None,
                quantities=(),
                measure=False,
                type_hash="",
                qos_defaults=(),
            )
            for each in node.endpoints
        ),
        participants=tuple(replace(each, reason="") for each in node.participants),
        parameters=(),
        mode_parameters={},
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
    return _tree(to_plain(bare))


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
