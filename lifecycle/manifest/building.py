"""Validated sections of a document → frozen types; what nodes share, by nearness.

Owns: how a node's keys become fields, its paths absolute and its parameters flat; how values that
are written for many nodes (`parameters:`, `remap:`, `restart:` … of documents and groups) reach
each; and the findings about all of them that a schema cannot detect. Reads interfaces by reference.

What is nearer to a node wins: the node itself, its parameter files, its group, the groups around
it, its document, the documents that include that. A shared parameter is for the nodes that have it,
as under `/**` in a parameter file: an interface without it is not given it. What is done when a
process fails (`restart:` …) all nodes of the process share, whichever of them says it.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import msgspec
from msgspec.structs import replace

from lifecycle.manifest import written
from lifecycle.manifest.diagnostics import Diagnostic, Findings, Position, error, note, warning
from lifecycle.manifest.interface import build_inline, read_interface
from lifecycle.manifest.model import (
    BY_DEFAULT,
    PROCESS_KEYS,
    QUANTILE,
    RATE_SLACK,
    SIM_TIME,
    SUPERVISION_KEYS,
    THIS_HOST,
    After,
    Condition,
    ConnectionDeclaration,
    EndpointKind,
    Executor,
    FlowNeed,
    Interface,
    Manifest,
    MeasuredKeys,
    Mode,
    ModeParameter,
    Node,
    ParameterValue,
    PublisherFlow,
    Quantity,
    Rate,
    Readiness,
    ReadyBy,
    Resources,
    Run,
    RunKeys,
    RunKind,
    Supervision,
)
from lifecycle.manifest.parameter_files import ParameterFiles
from lifecycle.manifest.parameter_values import is_implicit
from lifecycle.manifest.written import build, read, read_part
from lifecycle.manifest.yaml.document import YAML_1_1_BOOLEANS, Document, has_leading_zero, quote
from lifecycle.network.connection_url import ConnectionUrlError, parse


class Shared(msgspec.Struct, frozen=True, kw_only=True):
    """What all nodes of a document or group get from it and from what is around it.

    Attributes:
        prefix: of their keys, `left/arm`; empty for none.
        namespace: before their own, `left/arm`; empty for none.
        machine: where a node runs that names no machine.
        values: value and place of what nodes share, by path as in `Node.positions`: `remap.scan`.
    """

    prefix: str = ""
    namespace: str = ""
    machine: str = THIS_HOST
    values: Mapping[str, tuple[Any, Position]] = msgspec.field(default_factory=dict)

    def inner(self, root: Document, found: Findings) -> Shared:
        """Return what holds inside a document or group, or in what an include names."""
        parameters = flat_parameters(root.entries("parameters"), found)
        sim_time = root.get(SIM_TIME)
        if sim_time is not None and SIM_TIME in parameters:
            message = f"cannot set {SIM_TIME} twice"
            found.append(
                error("manifest.duplicate-parameter", sim_time.key_at(), message, "remove one")
            )
        elif sim_time is not None and isinstance(sim_time.scalar, bool):
            parameters[SIM_TIME] = (sim_time.scalar, sim_time.key_at())
        keys = {key: value for key, value in root.plain().items() if key in SUPERVISION_KEYS}
        written = read(keys, Supervision, strict=False)
        return Shared(
            prefix=self.key(root.text("prefix")) if "prefix" in root else self.prefix,
            namespace=self.within(root.text("namespace")),
            machine=root.text("machine", self.machine),
            values={
                **self.values,
                **{f"parameters.{name}": each for name, each in parameters.items()},
                **{
                    f"remap.{name}": (each.root.text, each.key_at())
                    for name, each in root.entries("remap")
                },
                **{key: (getattr(written, key), root.at((key,))) for key in keys},
            },
        )

    def key(self, key: str) -> str:
        """Return what a key of a node here is called in the system."""
        return f"{self.prefix}/{key}" if self.prefix else key

    def within(self, namespace: str) -> str:
        """Return a namespace below the one here, without slashes at its ends."""
        return "/".join(each for each in (self.namespace, namespace.strip("/")) if each)

    def given_to(self, node: Node) -> Node:
        """Return a node with what it does not set itself; who starts it otherwise restarts it."""
        is_attached = node.run.kind is RunKind.ATTACH
        given = {
            path: each
            for path, each in self.values.items()
            if path not in node.positions and not (is_attached and path in SUPERVISION_KEYS)
        }

        def those(section: str) -> tuple[tuple[str, Any], ...]:
            found = ((path.partition(".")[::2], value) for path, (value, _) in given.items())
            return tuple((name, value) for (of, name), value in found if of == section)

        supervision = {path: value for path, (value, _) in given.items() if "." not in path}
        return replace(
            node,
            parameters=(*those("parameters"), *node.parameters),
            # rcl takes the first rule that matches: the node's own.
            remap=(*node.remap, *those("remap")),
            supervision=replace(node.supervision, **supervision),
            shared=node.shared | given.keys(),
            positions={**node.positions, **{path: at for path, (_, at) in given.items()}},
        )


def settle(manifest: Manifest, files: ParameterFiles, found: Findings) -> Manifest:
    """Take from nodes the shared parameters that their files set, and those they do not declare.

    Nodes of one process get what any of them says of its supervision. Each node of the manifest
    has its full name.
    """
    found.extend(_for_no_node(manifest.nodes))
    own: dict[str, dict[str, object]] = {}
    for node in reversed(manifest.nodes):  # what the first of a process says is kept
        own.setdefault(node.process_name, {}).update(_own_supervision(node))
    nodes = []
    for node in manifest.nodes:
        said = {**own[node.process_name], **_own_supervision(node)}
        shared = {name for name, _ in node.parameters if f"parameters.{name}" in node.shared}
        declared = {each.name for each in node.interface.parameters}
        gone = {each for each in shared if declared and not is_implicit(each)} - declared
        if shared:
            gone |= shared & {name for name, _, _ in files.given(node)}
        settled = replace(
            node,
            supervision=replace(node.supervision, **said),
            parameters=tuple(each for each in node.parameters if each[0] not in gone),
            shared=node.shared - {f"parameters.{name}" for name in gone},
        )
        nodes.append(settled)
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


def flat_parameters(
    entries: Iterable[tuple[str, Document]], found: Findings
) -> dict[str, tuple[ParameterValue, Position]]:
    """Return values by dotted name, as rcl's files have them, and where each is written."""
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
        values = part.plain()
        types = {type(each).__name__: each for each in values}
        if len(types) <= 1:
            return tuple(values)
        names = {"str": "string", "float": "double"}
        mixed = " and ".join(f"{names.get(type_, type_)} {quote(types[type_])}" for type_ in types)
        message = f"cannot mix {mixed} in one array; a ROS array holds one type"
        hint = "write the integers as 1.0" if set(types) == {"int", "float"} else ""
        found.append(error("manifest.parameter-array", part.at(), message, hint))
        return None
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


_NAMED_BY_USERS = ("on_violation", "remap", "connections", "parameters")
"""Sections of which an entry is where its key is; of all others, a value is where it begins."""


def positions_of(section: Document, keys: Iterable[str]) -> dict[str, Position]:
    """Return where the values of `keys`, and all inside them, are by path: `remap.scan`."""
    found = {}
    if "on_violation" in section:
        found[f"on_violation.{BY_DEFAULT}"] = section.key_at(("on_violation",))
    pending: list[tuple[tuple[str, ...], Document]] = [
        ((key,), each) for key in keys if (each := section.get(key)) is not None
    ]
    while pending:
        steps, each = pending.pop()
        is_named = steps[0] in _NAMED_BY_USERS and (len(steps) == 2 or steps[0] == "parameters")
        found[".".join(steps)] = each.key_at() if is_named else each.at()
        pending += [((*steps, key), inside) for key, inside in each.children()]
    return found


def _connections(
    node: Document, interface: Interface, found: Findings
) -> Iterator[ConnectionDeclaration]:
    """Yield the connections of a node; `map: all` expands to its interface."""
    for name, each in node.entries("connections"):
        urls = []
        for url in each.items("urls"):
            try:
                urls.append(parse(url.root.text))
            except ConnectionUrlError as problem:  # noqa: PERF203 - each is reported
                rule = "manifest.connection-url"
                found.append(error(rule, url.at(), problem.message, problem.hint))
        if each.text("map") == "all":
            carried = [(endpoint.kind, endpoint.name) for endpoint in interface.endpoints]
        else:
            kinds = ((EndpointKind(kind), names) for kind, names in each.entries("map"))
            carried = [(kind, one.root.text) for kind, names in kinds for one in names.items()]
        yield ConnectionDeclaration(
            name=name, urls=tuple(urls), map=tuple(carried), at=each.key_at()
        )


def _interface(
    node: Document, *, base: Path, environment: Mapping[str, str], found: Findings
) -> Interface:
    """Build the interface of a node, inline or by reference; empty if it has none."""
    part = node.get("interface")
    if part is None:
        return Interface()
    if isinstance(part.root.data, dict):
        return build_inline(part, found)
    return read_interface(
        part.root.text, base=base, at=part.at(), environment=environment, found=found
    )


def build_node(
    key: str,
    part: Document,
    *,
    base: Path,
    shared: Shared,
    environment: Mapping[str, str],
    found: Findings,
) -> Node:
    """Build one node.

    Args:
        key: its key in the document.
        part: its value.
        base: folder that relative paths start from.
        shared: what it gets from the document and groups around it.
        environment: for AMENT_PREFIX_PATH.
        found: where findings go.
    """
    node = read_part(part, written.Node)
    parameters = flat_parameters(part.entries("parameters"), found)
    folder = node.run.working_directory if node.run else None
    interface = _interface(part, base=base, environment=environment, found=found)
    built = build(
        Node,
        node,
        key=shared.key(key),
        name=node.name or key,
        namespace=f"/{shared.within(node.namespace)}",
        machine=node.machine or shared.machine,
        process=shared.key(node.process) if node.process else "",
        run=_run(node.run, part, base, shared, found),
        parameters=tuple((name, value) for name, (value, _) in parameters.items()),
        parameter_files=tuple(absolute(base, each) for each in node.parameter_files),
        remap=tuple(node.remap.items()),
        after=tuple(_after(part, shared)),
        supervision=build(Supervision, node),
        on_violation=node.on_violation.value if node.on_violation else (),
        interface=interface,
        flows=tuple(_flows(part)),
        connections=tuple(_connections(part, interface, found)),
        positions=positions_of(part, {key for key, _ in part.entries()} - {"interface"}),
        written_paths=(
            *((f"parameter_files.{i}", each) for i, each in enumerate(node.parameter_files)),
            *((("run.working_directory", folder),) if folder else ()),
        ),
        at=part.key_at(),
    )
    return shared.given_to(built)


def _after(node: Document, shared: Shared) -> Iterator[After]:
    for name, each in node.entries("after"):
        key = shared.key(name)
        if not isinstance(each.root.data, dict):
            yield After(node=key, condition=Condition(each.scalar), at=each.key_at())
            continue
        for word, shown in each.entries():
            for one in shown.items() if isinstance(shown.root.data, tuple) else (shown,):
                condition = Readiness(by=ReadyBy(word), name=one.root.text)
                yield After(node=key, condition=condition, at=one.at())


def absolute(base: Path, path: str) -> str:
    """Return a path of a manifest so that it holds whatever folder a process starts in."""
    # Not Path.resolve(): a link stays the path that its user knows.
    return os.path.abspath(base / path)  # noqa: PTH100


_OF_PYTHON = ("arguments", "executor", "threads")


def _run(run: RunKeys | None, node: Document, base: Path, shared: Shared, found: Findings) -> Run:
    part = node.get("run")
    if run is None or part is None:
        return Run(kind=RunKind.ATTACH)
    kind = RunKind.ATTACH if run.component or run.attach else RunKind.COMMAND
    meaningless: list[tuple[str, tuple[str, ...], str]] = []
    if run.python:
        kind, what = RunKind.PYTHON, "a Python class: our host gives it no command line"
        meaningless.append(("manifest.attach", ("ros_args",), what))
    elif kind is RunKind.ATTACH:
        what = "an attached node"
        if run.component:
            what = "a component: its container's process has that"
        meaningless.append(("manifest.attach", PROCESS_KEYS, what))
    if not run.component:
        meaningless.append(("manifest.attach", ("extra_arguments",), "what is no component"))
    if kind is not RunKind.PYTHON:
        what = "what is not 'run: {python: …}'"
        meaningless.append(("manifest.python-only", _OF_PYTHON, what))
    elif run.threads and run.executor is not Executor.MULTI:
        message = "cannot give threads to an executor that has one"
        hint = "write 'executor: multi', or remove it"
        found.append(error("manifest.threads", part.key_at(("threads",)), message, hint))
    for rule, keys, what in meaningless:
        at = {key: part.key_at((key,)) for key in keys if key in part}
        found += [error(rule, at[key], f"cannot set {key} of {what}", "remove it") for key in at]
    resources = run.resources
    container = run.container
    return build(
        Run,
        run,
        kind=kind,
        attach=None,  # it is a kind
        command=tuple(each.root.text for each in part.items("command")),
        arguments=_values(part, "arguments", found),
        extra_arguments=_values(part, "extra_arguments", found),
        environment={name: each.root.text for name, each in part.entries("environment")},
        working_directory=run.working_directory and absolute(base, run.working_directory),
        prefix=tuple(each.root.text for each in part.items("prefix")),
        resources=resources and build(Resources, resources, at=part.key_at(("resources",))),
        # A full name, or the key of a node of the system.
        container=container if container[:1] in ("", "/") else shared.key(container),
    )


def _values(run: Document, key: str, found: Findings) -> dict[str, ParameterValue]:
    values = {name: parameter_value(name, each, found) for name, each in run.entries(key)}
    return {name: value for name, value in values.items() if value is not None}


def build_modes(root: Document, found: Findings) -> tuple[Mode, ...]:
    """Build the modes of a document."""
    return tuple(
        Mode(
            name=name,
            inactive=tuple(each.root.text for each in mode.items("inactive")),
            parameters=tuple(
                ModeParameter(node=key, name=parameter, value=value, at=at)
                for key, node in mode.entries("parameters")
                for parameter, (value, at) in flat_parameters(node.entries(), found).items()
            ),
            at=mode.key_at(),
        )
        for name, mode in root.entries("modes")
    )


def _flows(node: Document) -> Iterator[FlowNeed]:
    for kind in (EndpointKind.PUBLISHER, EndpointKind.SUBSCRIPTION):
        for name, part in node.entries("flows", kind.value):
            flow = read_part(part, PublisherFlow)
            rate, five_qi = flow.rate_hz, flow.five_qi
            yield build(
                FlowNeed,
                flow,
                kind=kind,
                name=name,
                five_qi=None if five_qi == "auto" else five_qi,
                five_qi_auto=five_qi == "auto",
                rate_hz=rate.max or rate.min if isinstance(rate, Rate) else rate,
                quantities=tuple(quantities(part, flow)),
                at=part.key_at(),
            )


_QUANTITIES = ("max_delay_ms", "loss", "max_silence_s", "max_message_size", "five_qi")
"""Numbers of a flow or a link that nothing but a measurement could prove; and its rate."""


def quantities(part: Document, keys: MeasuredKeys) -> Iterator[Quantity]:
    """Yield the numbers of a flow or a link that only a measurement could prove."""
    for name in _QUANTITIES:
        value = getattr(keys, name, None)
        if isinstance(value, (int, float)):
            of = keys.quantile if name == "max_delay_ms" else QUANTILE
            yield Quantity(name=name, value=value, at=part.at((name,)), quantile=of)
    rate, at = keys.rate_hz, part.at(("rate_hz",))
    if isinstance(rate, Rate):
        yield Quantity(name="rate_hz", value=rate.min or 0.0, most=rate.max, at=at)
    elif rate is not None:
        yield Quantity(name="rate_hz", value=rate, slack=RATE_SLACK, at=at)
