"""What nodes share: `parameters:`, `remap:`, `restart:` … of documents and groups, by nearness.

Owns: values of parameters, flat; how values that are written for many nodes reach each of them.
What is nearer to a node wins: the node itself, its parameter files, its group, the groups around
it, its document, the documents that include that. A shared parameter is for the nodes that have it,
as under `/**` in a parameter file: an interface without it is not given it. What is done when a
process fails (`restart:` …) all nodes of the process share, whichever of them says it.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping

import msgspec
from msgspec.structs import replace

from lifecycle.manifest.diagnostics import Diagnostic, Findings, Position, error, note, warning
from lifecycle.manifest.model import (
    SIM_TIME,
    SUPERVISION_KEYS,
    Manifest,
    Node,
    ParameterValue,
    RunKind,
    Supervision,
)
from lifecycle.manifest.parameter_files import ParameterFiles
from lifecycle.manifest.parameter_values import is_implicit
from lifecycle.manifest.written import read
from lifecycle.manifest.yaml.document import YAML_1_1_BOOLEANS, Document, has_leading_zero, quote

THIS_HOST = "local"
"""Name of the machine of nodes that name none; declared implicitly, without address."""


class Shared(msgspec.Struct, frozen=True, kw_only=True):
    """What all nodes of a document or group get from it and from what is around it.

    Attributes:
        prefix: of their keys, `left/arm`; empty for none.
        namespace: before their own, `left/arm`; empty for none.
        parameters: value and place, by name.
        remap: new name and place, by the name in the node's code.
        machine: where a node runs that names no machine.
        supervision: value and place, by key of `Supervision`.
    """

    prefix: str = ""
    namespace: str = ""
    machine: str = THIS_HOST
    parameters: Mapping[str, tuple[ParameterValue, Position]] = msgspec.field(default_factory=dict)
    remap: Mapping[str, tuple[str, Position]] = msgspec.field(default_factory=dict)
    supervision: Mapping[str, tuple[object, Position]] = msgspec.field(default_factory=dict)

    def inner(self, root: Document, found: Findings) -> Shared:
        """Return what holds inside a document or group, or in what an include names."""
        parameters = build_parameters(root, found)
        sim_time = root.get(SIM_TIME)
        if sim_time is not None and SIM_TIME in parameters:
            message = f"cannot set {SIM_TIME} twice"
            found.append(
                error("manifest.duplicate-parameter", sim_time.key_at(), message, "remove one")
            )
        elif sim_time is not None and isinstance(sim_time.scalar, bool):
            parameters[SIM_TIME] = (sim_time.scalar, sim_time.key_at())
        remap = {name: (each.root.text, each.key_at()) for name, each in root.entries("remap")}
        keys = {key: value for key, value in root.plain().items() if key in SUPERVISION_KEYS}
        written = read(keys, Supervision, strict=False)
        supervision = {key: (getattr(written, key), root.at((key,))) for key in keys}
        return Shared(
            prefix=self.key(root.text("prefix")) if "prefix" in root else self.prefix,
            namespace=self.within(root.text("namespace")),
            machine=root.text("machine", self.machine),
            parameters={**self.parameters, **parameters},
            remap={**self.remap, **remap},
            supervision={**self.supervision, **supervision},
        )

    def key(self, key: str) -> str:
        """Return what a key of a node here is called in the system."""
        return f"{self.prefix}/{key}" if self.prefix else key

    def within(self, namespace: str) -> str:
        """Return a namespace below the one here, without slashes at its ends."""
        return "/".join(each for each in (self.namespace, namespace.strip("/")) if each)

    def given_to(self, node: Node) -> Node:
        """Return a node with what it does not set itself; who starts it otherwise restarts it."""
        own, rules = dict(node.parameters), dict(node.remap)
        parameters = {name: each for name, each in self.parameters.items() if name not in own}
        remap = {name: each for name, each in self.remap.items() if name not in rules}
        supervision = {
            key: each
            for key, each in self.supervision.items()
            if key not in node.positions and node.run.kind is not RunKind.ATTACH
        }
        positions = {
            **{f"parameters.{name}": at for name, (_, at) in parameters.items()},
            **{f"remap.{name}": at for name, (_, at) in remap.items()},
            **{key: at for key, (_, at) in supervision.items()},
        }
        given = {key: value for key, (value, _) in supervision.items()}
        return replace(
            node,
            parameters=(
                *((name, value) for name, (value, _) in parameters.items()),
                *node.parameters,
            ),
            # rcl takes the first rule that matches: the node's own.
            remap=(*node.remap, *((name, target) for name, (target, _) in remap.items())),
            supervision=replace(node.supervision, **given),
            shared=node.shared | positions.keys(),
            positions={**node.positions, **positions},
        )


def settle(manifest: Manifest, files: ParameterFiles, found: Findings) -> Manifest:
    """Take from nodes the shared parameters that their files set, and those they do not declare.

    Nodes of one process get what any of them says of its supervision. Each node of the manifest
    has its full name.
    """
    found.extend(_for_no_node(manifest.nodes))
    own: dict[str, dict[str, object]] = {}
    for node in manifest.nodes:
        if node.process:
            for key, value in _own_supervision(node).items():
                own.setdefault(node.process, {}).setdefault(key, value)
    nodes = []
    for node in manifest.nodes:
        said = {**own.get(node.process, {}), **_own_supervision(node)}
        supervised = replace(node, supervision=replace(node.supervision, **said))
        nodes.append(_settled(supervised, files))
    return replace(manifest, nodes=tuple(nodes))


def _for_no_node(nodes: Iterable[Node]) -> Iterator[Diagnostic]:
    """Warn of each shared parameter that none of the nodes declares which it is for."""
    taken: set[Position] = set()
    unknown: dict[Position, str] = {}
    for node in nodes:
        declared = {each.name for each in node.interface.parameters}
        for name, _ in node.parameters:
            place = f"parameters.{name}"
            if place in node.shared and (not declared or name in declared or is_implicit(name)):
                taken.add(node.where(place))
            elif place in node.shared:
                unknown[node.where(place)] = name
    for at, name in unknown.items():
        if at not in taken:
            message = f"cannot set parameter {name!r}: no node that it is for declares it"
            yield warning("check.parameter-undeclared", at, message)


def _own_supervision(node: Node) -> dict[str, object]:
    """Return what is written at the node itself."""
    written = node.positions.keys() - node.shared
    return {key: getattr(node.supervision, key) for key in SUPERVISION_KEYS if key in written}


def _settled(node: Node, files: ParameterFiles) -> Node:
    shared = {name for name, _ in node.parameters if f"parameters.{name}" in node.shared}
    if not shared:
        return node
    declared = {each.name for each in node.interface.parameters}
    gone = {name for name in shared if declared and name not in declared and not is_implicit(name)}
    if gone != shared:
        gone |= shared & {name for name, _, _ in files.given(node)}
    return replace(
        node,
        parameters=tuple(each for each in node.parameters if each[0] not in gone),
        shared=node.shared - {f"parameters.{name}" for name in gone},
    )


def build_parameters(node: Document, found: Findings) -> dict[str, tuple[ParameterValue, Position]]:
    """Flatten `parameters:` of a node, group or document into dotted names, as rcl's files do."""
    return flat_parameters(node.entries("parameters"), found)


def flat_parameters(
    entries: Iterable[tuple[str, Document]], found: Findings
) -> dict[str, tuple[ParameterValue, Position]]:
    """Return values by dotted name, and where each is written."""
    flat: dict[str, tuple[ParameterValue, Position]] = {}
    pending = list(reversed(list(entries)))
    while pending:
        name, part = pending.pop()
        if isinstance(part.root.data, dict):
            inner = [(f"{name}.{key}", each) for key, each in part.entries()]
            pending.extend(reversed(inner))
            continue
        if name in flat:
            message = f"cannot set the parameter {name!r} twice"
            first = flat[name][1]
            hint = f"the first value stands at {first.spelled}"
            found.append(error("manifest.duplicate-parameter", part.at(), message, hint))
            continue
        value = parameter_value(name, part, found)
        if value is not None:
            flat[name] = (value, part.key_at())
    return flat


def parameter_value(name: str, part: Document, found: Findings) -> ParameterValue | None:
    """Return the value of a parameter or argument; None after reporting that it cannot be one."""
    if isinstance(part.root.data, tuple):
        return _scalar_tuple(part, found)
    text = part.root.text
    if not part.root.quoted and len(text) > 1 and text in YAML_1_1_BOOLEANS:
        message = f"cannot tell whether {text} is meant as a boolean; it is read as a string"
        hint = f'write {name}: true or false, or {name}: "{text}"'
        found.append(note("manifest.yaml-1.1-boolean", part.at(), message, hint))
    if not part.root.quoted and has_leading_zero(text):
        message = f"cannot tell which number {text} is meant as; it is read as a string"
        hint = f'write {name}: {text.lstrip("+0") or "0"}, or {name}: "{text}"'
        found.append(note("manifest.leading-zero", part.at(), message, hint))
    return part.scalar


def _scalar_tuple(part: Document, found: Findings) -> tuple[bool | int | float | str, ...] | None:
    """Return a ROS array; None after reporting that its items differ in type."""
    values = part.plain()
    types = {type(each).__name__: each for each in values}
    if len(types) == 1 or not values:
        return tuple(values)
    names = {"str": "string", "float": "double"}
    spelled = " and ".join(f"{names.get(name, name)} {quote(each)}" for name, each in types.items())
    message = f"cannot mix {spelled} in one array; a ROS array holds one type"
    hint = "write the integers as 1.0" if set(types) == {"int", "float"} else ""
    found.append(error("manifest.parameter-array", part.at(), message, hint))
    return None
