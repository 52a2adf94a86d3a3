"""Validated `nodes:`, `data_layer:`, `modes:` and `connections:` → frozen types.

Owns: how a node's keys become fields and its paths absolute; and the findings about all of them
that a schema cannot detect. Pure but for reading interfaces by reference.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

from lifecycle.manifest import written
from lifecycle.manifest.diagnostics import Diagnostic, Findings, Position, error
from lifecycle.manifest.interface import build_inline, read_interface
from lifecycle.manifest.model import (
    BY_DEFAULT,
    PROCESS_KEYS,
    QUANTILE,
    RATE_SLACK,
    After,
    Condition,
    ConnectionDeclaration,
    Consequence,
    EndpointKind,
    Executor,
    FlowNeed,
    Interface,
    MeasuredKeys,
    Mode,
    ModeParameter,
    Node,
    OnViolation,
    ParameterValue,
    PublisherFlow,
    Quantity,
    Rate,
    Reaction,
    Readiness,
    ReadyBy,
    Resources,
    Run,
    RunKind,
    Supervision,
)
from lifecycle.manifest.shared import Shared, build_parameters, flat_parameters, parameter_value
from lifecycle.manifest.written import build, read_part
from lifecycle.manifest.yaml.document import Document
from lifecycle.network.connection_url import ConnectionUrl, ConnectionUrlError, parse


def build_on_violation(section: Document) -> OnViolation:
    """Build `on_violation` of a document or a node; a single value is for every rule."""
    reactions = section.get("on_violation")
    if reactions is None:
        return ()
    data = reactions.root.data
    if isinstance(data, dict) and [*data] != ["mode"]:
        return tuple(_reaction(rule, each) for rule, each in reactions.entries())
    return (_reaction(BY_DEFAULT, reactions),)


def _reaction(rule: str, what: Document) -> Reaction:
    if isinstance(what.root.data, dict):
        return Reaction(rule=rule, what=Consequence.MODE, mode=what.text("mode"))
    return Reaction(rule=rule, what=Consequence(what.scalar))


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


def build_connections(
    node: Document, interface: Interface, found: list[Diagnostic]
) -> tuple[ConnectionDeclaration, ...]:
    """Build the connections of a node; `map: all` expands to its interface."""
    return tuple(
        ConnectionDeclaration(
            name=name,
            urls=tuple(url for part in each.items("urls") if (url := _url(part, found))),
            map=_map(each, interface),
            at=each.key_at(),
        )
        for name, each in node.entries("connections")
    )


def _url(part: Document, found: list[Diagnostic]) -> ConnectionUrl | None:
    try:
        return parse(part.root.text)
    except ConnectionUrlError as problem:
        found.append(error("manifest.connection-url", part.at(), problem.message, problem.hint))
        return None


def _map(connection: Document, interface: Interface) -> tuple[tuple[EndpointKind, str], ...]:
    if connection.text("map") == "all":
        return tuple((each.kind, each.name) for each in interface.endpoints)
    return tuple(
        (EndpointKind(kind), each.root.text)
        for kind, names in connection.entries("map")
        for each in names.items()
    )


def build_interface(
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
    parameters = build_parameters(part, found)
    interface = build_interface(part, base=base, environment=environment, found=found)
    built = build(
        Node,
        node,
        key=shared.key(key),
        name=node.name or key,
        namespace=f"/{shared.within(node.namespace)}",
        machine=node.machine or shared.machine,
        process=shared.key(node.process) if node.process else "",
        run=_run(part, base, shared, found),
        parameters=tuple((name, value) for name, (value, _) in parameters.items()),
        parameter_files=tuple(absolute(base, each) for each in node.parameter_files),
        remap=tuple(node.remap.items()),
        after=tuple(_after(part, shared, found)),
        supervision=build(Supervision, node),
        on_violation=build_on_violation(part),
        interface=interface,
        flows=tuple(_flows(part)),
        connections=build_connections(part, interface, found),
        positions=positions_of(part, {key for key, _ in part.entries()} - {"interface"}),
        written_paths=tuple(_written_paths(node)),
        at=part.key_at(),
    )
    return shared.given_to(built)


def _after(node: Document, shared: Shared, found: Findings) -> Iterator[After]:
    for name, each in node.entries("after"):
        key = shared.key(name)
        if not isinstance(each.root.data, dict):
            yield After(node=key, condition=Condition(each.scalar), at=each.key_at())
            continue
        for word, shown in each.entries():
            by, names = ReadyBy(word), list[tuple[str, ParameterValue | None, Position]]()
            if isinstance(shown.root.data, dict):
                values = flat_parameters(shown.entries(), found)
                names += [(name, value, at) for name, (value, at) in values.items()]
            else:
                so = True if by is ReadyBy.PARAMETER else None
                items = shown.items() if isinstance(shown.root.data, tuple) else (shown,)
                names += [(each.root.text, so, each.at()) for each in items]
            for named, value, at in names:
                yield After(node=key, condition=Readiness(by=by, name=named, value=value), at=at)


def absolute(base: Path, path: str) -> str:
    """Return a path of a manifest so that it holds whatever folder a process starts in."""
    # Not Path.resolve(): a link stays the path that its user knows.
    return os.path.abspath(base / path)  # noqa: PTH100


_OF_PYTHON = ("arguments", "executor", "threads")


def _run(node: Document, base: Path, shared: Shared, found: Findings) -> Run:
    part = node.get("run")
    if part is None:
        return Run(kind=RunKind.ATTACH)
    run = read_part(part, written.Run)
    kind = RunKind.COMMAND
    if run.python:
        kind = RunKind.PYTHON
        _refuse(part, ("ros_args",), "a Python class: our host gives it no command line", found)
    elif run.component:
        kind = RunKind.ATTACH
        _refuse(part, PROCESS_KEYS, "a component: its container's process has that", found)
    elif run.attach:
        kind = RunKind.ATTACH
        _refuse(part, PROCESS_KEYS, "an attached node", found)
    if not run.component:
        _refuse(part, ("extra_arguments",), "what is no component", found)
    if kind is not RunKind.PYTHON:
        rule = "manifest.python-only"
        _refuse(part, _OF_PYTHON, "what is not 'run: {python: …}'", found, rule=rule)
    elif run.threads and run.executor is not Executor.MULTI:
        message = "cannot give threads to an executor that has one"
        hint = "write 'executor: multi', or remove it"
        found.append(error("manifest.threads", part.key_at(("threads",)), message, hint))
    return build(
        Run,
        run,
        kind=kind,
        command=tuple(each.root.text for each in part.items("command")),
        arguments=_values(part, "arguments", found),
        extra_arguments=_values(part, "extra_arguments", found),
        environment=tuple((name, each.root.text) for name, each in part.entries("environment")),
        working_directory=absolute(base, run.working_directory) if run.working_directory else "",
        prefix=tuple(each.root.text for each in part.items("prefix")),
        resources=_resources(part, run, found),
        container=_container(run.container or "", shared),
    )


def _container(name: str, shared: Shared) -> str:
    """Return the container of a component: a full name, or the key of a node of the system."""
    return name if not name or name.startswith("/") else shared.key(name)


def _resources(part: Document, run: written.Run, found: Findings) -> Resources | None:
    if run.resources is None:
        return None
    high, most = run.resources.memory_high_mib, run.resources.memory_max_mib
    if high is not None and most is not None and high >= most:
        at = part.key_at(("resources", "memory_high_mib"))
        message = f"cannot use memory_high_mib {high} with memory_max_mib {most}: it is not reached"
        found.append(error("manifest.resources", at, message, "set it lower, or leave it out"))
    return build(Resources, run.resources, at=part.key_at(("resources",)))


def _values(run: Document, key: str, found: Findings) -> tuple[tuple[str, ParameterValue], ...]:
    values = ((name, parameter_value(name, each, found)) for name, each in run.entries(key))
    return tuple((name, value) for name, value in values if value is not None)


def _refuse(
    run: Document,
    names: tuple[str, ...],
    what: str,
    found: Findings,
    *,
    rule: str = "manifest.attach",
) -> None:
    """Report keys of `run` that have no meaning for this way to run a node."""
    for name in names:
        if name in run:
            message = f"cannot set {name} of {what}"
            found.append(error(rule, run.key_at((name,)), message, "remove it"))


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
                dscp=None if flow.dscp is None else flow.dscp.value,
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


def _written_paths(node: written.Node) -> Iterator[tuple[str, str]]:
    """Yield the paths of a node as they are written, by place."""
    for index, each in enumerate(node.parameter_files):
        yield f"parameter_files.{index}", each
    if node.run is not None and node.run.working_directory:
        yield "run.working_directory", node.run.working_directory
