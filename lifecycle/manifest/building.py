"""Validated `nodes:`, `discovery:`, `data_layer:` and `connections:` → frozen types.

Owns: how a node's keys become fields, its parameters flat and its paths absolute; reading
connection URLs out of a document; and the findings about all of them that a schema cannot detect.
Pure but for reading interfaces by reference.
"""

from __future__ import annotations

import ipaddress
import os
import shlex
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import TypeVar

from lifecycle.manifest import written
from lifecycle.manifest.diagnostics import Diagnostic, Position
from lifecycle.manifest.interface import Findings, build_inline, scalar_tuple
from lifecycle.manifest.model import (
    BY_DEFAULT,
    PROCESS_KEYS,
    QUANTILE,
    RATE_SLACK,
    After,
    Condition,
    ConnectionDeclaration,
    Consequence,
    DataLayer,
    EndpointKind,
    Executor,
    FlowNeed,
    Health,
    Interface,
    Limits,
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
    Timeouts,
)
from lifecycle.manifest.nodl import read_interface
from lifecycle.manifest.yaml.document import Cursor, error, note
from lifecycle.manifest.yaml.yaml_parser import YAML_1_1_BOOLEANS, has_leading_zero, quote
from lifecycle.network.connection_url import ConnectionUrl, ConnectionUrlError, parse

_KINDS = {kind.value: kind for kind in EndpointKind}


T = TypeVar("T")


def section(cursor: Cursor, key: str, type_: type[T]) -> T:
    """Return a section that is kept as it is written; the defaults of its keys if it is missing."""
    return written.read(cursor.document.plain((*cursor.place, key)), type_, strict=False)


def build_data_layer(root: Cursor, found: list[Diagnostic]) -> DataLayer:
    """Build the data layer of a document; the defaults where it declares nothing."""
    layer = section(root, "data_layer", DataLayer)
    group = layer.multicast_group
    if not _is_ipv4_group(group):
        at = root.document.at((*root.place, "data_layer", "multicast_group"))
        message = f"cannot use {quote(group)} as a multicast group; it must be IPv4"
        hint = "239.255.0.0 to 239.255.255.255 stay within an organisation (RFC 2365)"
        found.append(error("manifest.multicast-group", at, message, hint))
    return layer


def build_on_violation(cursor: Cursor) -> OnViolation:
    """Build `on_violation` of a document or a node."""
    return tuple(
        Reaction(rule=name, what=Consequence.MODE, mode=each.text("mode"))
        if isinstance(each.value.data, Mapping)
        else Reaction(rule=name, what=Consequence(each.scalar))
        for name, each in _consequences(cursor)
    )


def _consequences(cursor: Cursor) -> Iterator[tuple[str, Cursor]]:
    """Yield the entries of `on_violation`; a single value is for every rule."""
    reactions = cursor.get("on_violation")
    if reactions is None:
        return
    if isinstance(reactions.value.data, Mapping) and [*reactions.value.data] != ["mode"]:
        yield from reactions.entries()
    else:
        yield BY_DEFAULT, reactions


_NAMED_BY_USERS = ("on_violation", "remap", "connections", "parameters")
"""Sections of which an entry is where its key is; of all others, a value is where it begins."""


def positions_of(section: Cursor, keys: Iterable[str]) -> dict[str, Position]:
    """Return where parts of a document are, by path below a section: `run.python`, `remap.scan`.

    Args:
        section: the document, or a node.
        keys: those keys of it whose values are looked at, with all that is inside.
    """
    found = {}
    if (reactions := section.get("on_violation")) is not None:
        found[f"on_violation.{BY_DEFAULT}"] = reactions.key_at
    pending: list[tuple[tuple[str, ...], Cursor]] = [
        ((key,), each) for key in keys if (each := section.get(key)) is not None
    ]
    while pending:
        steps, each = pending.pop()
        is_named = steps[0] in _NAMED_BY_USERS and (len(steps) == 2 or steps[0] == "parameters")
        found[".".join(steps)] = each.key_at if is_named else each.at
        pending += [((*steps, key), inside) for key, inside in each.children()]
    return found


def _is_ipv4_group(text: str) -> bool:
    try:
        return ipaddress.IPv4Address(text).is_multicast
    except ValueError:
        return False


def build_connections(
    node: Cursor, interface: Interface, found: list[Diagnostic]
) -> tuple[ConnectionDeclaration, ...]:
    """Build the connections that a node's section spells out.

    Args:
        node: the node.
        interface: of that node; what `map: all` expands to.
        found: findings are appended here.
    """
    return tuple(
        ConnectionDeclaration(
            name=name,
            urls=_urls(cursor, found),
            map=_map(cursor, interface),
            at=cursor.key_at,
        )
        for name, cursor in node.entries("connections")
    )


def _urls(connection: Cursor, found: list[Diagnostic]) -> tuple[ConnectionUrl, ...]:
    urls = []
    for cursor in connection.items("urls"):
        url = _url(cursor, found)
        if url is not None:
            urls.append(url)
    return tuple(urls)


def _url(cursor: Cursor, found: list[Diagnostic]) -> ConnectionUrl | None:
    try:
        return parse(cursor.value.text)
    except ConnectionUrlError as problem:
        found.append(error("manifest.connection-url", cursor.at, problem.message, problem.hint))
        return None


def _map(connection: Cursor, interface: Interface) -> tuple[tuple[EndpointKind, str], ...]:
    if connection.text("map") == "all":
        return tuple((each.kind, each.name) for each in interface.endpoints)
    return tuple(
        (_KINDS[kind], each.value.text)
        for kind, names in connection.entries("map")
        for each in names.items()
    )


def build_interface(
    node: Cursor, *, base: Path, environment: Mapping[str, str], found: Findings
) -> Interface:
    """Build the interface of a node, inline or by reference; empty if it has none.

    Args:
        node: the node.
        base: folder that `local://` starts from.
        environment: for AMENT_PREFIX_PATH, where `nodl://` is searched.
        found: findings are appended here.
    """
    cursor = node.get("interface")
    if cursor is None:
        return Interface()
    if isinstance(cursor.value.data, Mapping):
        return build_inline(cursor, found)
    reference = cursor.value.text
    try:
        interface, findings = read_interface(
            reference, base=base, at=cursor.at, environment=environment
        )
    except OSError as problem:  # a name that is too long, a folder that is not ours to search
        message = f"cannot follow {quote(reference)}: {problem.strerror}"
        found.append(error("nodl.not-found", cursor.at, message))
        return Interface(source=reference)
    found.extend(findings)
    return interface


def build_node(
    key: str,
    cursor: Cursor,
    *,
    base: Path,
    machine: str,
    environment: Mapping[str, str],
    found: Findings,
) -> Node:
    """Build one node.

    Args:
        key: its key in the document.
        cursor: its value.
        base: folder that relative paths start from.
        machine: the machine of a node that names none.
        environment: for AMENT_PREFIX_PATH.
        found: findings are appended here.
    """
    namespace = cursor.text("namespace").strip("/")
    health = cursor.get("health")
    parameters = build_parameters(cursor, found)
    interface = build_interface(cursor, base=base, environment=environment, found=found)
    return cursor.build(
        Node,
        key=key,
        name=cursor.text("name", key),
        namespace=f"/{namespace}",
        machine=cursor.text("machine", machine),
        run=_run(cursor, base, found),
        parameters=tuple((name, value) for name, (value, _) in parameters.items()),
        parameter_files=tuple(
            absolute(base, each.value.text) for each in cursor.items("parameter_files")
        ),
        remap=tuple((name, each.value.text) for name, each in cursor.entries("remap")),
        after=tuple(_after(cursor, found)),
        timeouts=section(cursor, "timeouts", Timeouts),
        supervision=cursor.build(Supervision),
        on_violation=build_on_violation(cursor),
        health=None if health is None else _health(health),
        interface=interface,
        flows=tuple(_flows(cursor)),
        connections=build_connections(cursor, interface, found),
        positions=positions_of(cursor, {key for key, _ in cursor.entries()} - {"interface"}),
        written_paths=tuple(_written_paths(cursor)),
        at=cursor.key_at,
    )


def _after(node: Cursor, found: Findings) -> Iterator[After]:
    for key, each in node.entries("after"):
        if not isinstance(each.value.data, Mapping):
            yield After(node=key, condition=Condition(each.scalar), at=each.key_at)
            continue
        for word, cursor in each.entries():
            by, names = ReadyBy(word), list[tuple[str, ParameterValue | None, Position]]()
            if isinstance(cursor.value.data, Mapping):
                values = _flat(cursor.entries(), found)
                names += [(name, value, at) for name, (value, at) in values.items()]
            else:
                so = True if by is ReadyBy.PARAMETER else None
                items = cursor.items() if isinstance(cursor.value.data, tuple) else (cursor,)
                names += [(each.value.text, so, each.at) for each in items]
            for name, value, at in names:
                yield After(node=key, condition=Readiness(by=by, name=name, value=value), at=at)


def absolute(base: Path, path: str) -> str:
    """Return a path of a manifest so that it holds whatever folder a process starts in."""
    # Not Path.resolve(): a link stays the path that its user knows.
    return os.path.abspath(base / path)  # noqa: PTH100


def _run(node: Cursor, base: Path, found: Findings) -> Run:
    cursor = node.get("run")
    if cursor is None:
        return Run(kind=RunKind.ATTACH)
    kind = RunKind.COMMAND
    if "python" in cursor:
        kind = RunKind.PYTHON
        _refuse(cursor, ("ros_args",), "a Python class: our host gives it no command line", found)
    elif "component" in cursor:
        kind = RunKind.ATTACH
        _refuse(cursor, PROCESS_KEYS, "a component: its container's process has that", found)
    elif "attach" in cursor:
        kind = RunKind.ATTACH
        _refuse(cursor, PROCESS_KEYS, "an attached node", found)
    if "component" not in cursor:
        _refuse(cursor, ("extra_arguments",), "what is no component", found)
    _check_python_keys(cursor, kind, found)
    folder = cursor.text("working_directory")
    return cursor.build(
        Run,
        kind=kind,
        arguments=_values(cursor, "arguments", found),
        extra_arguments=_values(cursor, "extra_arguments", found),
        environment=tuple((name, each.value.text) for name, each in cursor.entries("environment")),
        working_directory=absolute(base, folder) if folder else "",
        prefix=_words(cursor, "prefix", found),
        limits=section(cursor, "limits", Limits) if "limits" in cursor else None,
        resources=_resources(cursor, found),
    )


def _resources(run: Cursor, found: Findings) -> Resources | None:
    cursor = run.get("resources")
    if cursor is None:
        return None
    built = cursor.build(Resources, at=cursor.key_at)
    high, most = built.memory_high_mib, built.memory_max_mib
    if high is not None and most is not None and high >= most:
        at = cursor.document.key_at((*cursor.place, "memory_high_mib"))
        message = f"cannot use memory_high_mib {high} with memory_max_mib {most}: it is not reached"
        found.append(error("manifest.resources", at, message, "set it lower, or leave it out"))
    return built


def _values(run: Cursor, key: str, found: Findings) -> tuple[tuple[str, ParameterValue], ...]:
    values = ((name, _parameter(name, each, found)) for name, each in run.entries(key))
    return tuple((name, value) for name, value in values if value is not None)


def _refuse(run: Cursor, names: tuple[str, ...], what: str, found: Findings) -> None:
    """Report keys of `run` that have no meaning for this way to run a node."""
    for name in names:
        if name in run:
            at = run.document.key_at((*run.place, name))
            message = f"cannot set {name} of {what}"
            found.append(error("manifest.attach", at, message, "remove it"))


def _words(run: Cursor, key: str, found: Findings) -> tuple[str, ...]:
    """Return the words of a list, or of a text as a shell splits it."""
    cursor = run.get(key)
    if cursor is None:
        return ()
    if isinstance(cursor.value.data, tuple):
        return tuple(each.value.text for each in cursor.items())
    try:
        return tuple(shlex.split(cursor.value.text))
    except ValueError as problem:
        message = f"cannot split {key} {quote(cursor.value.text)} into words: {problem}"
        hint = "close the quotation, or write a list of words"
        found.append(error("manifest.words", cursor.at, message, hint))
        return ()


_OF_PYTHON = ("arguments", "executor", "threads")


def _check_python_keys(cursor: Cursor, kind: RunKind, found: Findings) -> None:
    for name in _OF_PYTHON:
        if name not in cursor:
            continue
        at = cursor.document.key_at((*cursor.place, name))
        if kind is not RunKind.PYTHON:
            message = f"cannot set {name} of what is not 'run: {{python: …}}'"
            found.append(error("manifest.python-only", at, message, "remove it"))
        elif name == "threads" and cursor.text("executor") != Executor.MULTI.value:
            message = "cannot give threads to an executor that has one"
            hint = "write 'executor: multi', or remove it"
            found.append(error("manifest.threads", at, message, hint))


def build_modes(root: Cursor, found: Findings) -> tuple[Mode, ...]:
    """Build the modes of a document."""
    return tuple(
        Mode(
            name=name,
            inactive=tuple(each.value.text for each in cursor.items("inactive")),
            parameters=tuple(
                ModeParameter(node=key, name=parameter, value=value, at=at)
                for key, node in cursor.entries("parameters")
                for parameter, (value, at) in _flat(node.entries(), found).items()
            ),
            at=cursor.key_at,
        )
        for name, cursor in root.entries("modes")
    )


def build_parameters(node: Cursor, found: Findings) -> dict[str, tuple[ParameterValue, Position]]:
    """Flatten `parameters:` of a node, group or document into dotted names, as rcl's files do."""
    return _flat(node.entries("parameters"), found)


def _flat(
    entries: Iterable[tuple[str, Cursor]], found: Findings
) -> dict[str, tuple[ParameterValue, Position]]:
    flat: dict[str, tuple[ParameterValue, Position]] = {}
    pending = list(reversed(list(entries)))
    while pending:
        name, cursor = pending.pop()
        if isinstance(cursor.value.data, Mapping):
            inner = [(f"{name}.{key}", each) for key, each in cursor.entries()]
            pending.extend(reversed(inner))
            continue
        if name in flat:
            message = f"cannot set the parameter {name!r} twice"
            first = flat[name][1]
            hint = f"the first value stands at {first.spelled}"
            found.append(error("manifest.duplicate-parameter", cursor.at, message, hint))
            continue
        value = _parameter(name, cursor, found)
        if value is not None:
            flat[name] = (value, cursor.key_at)
    return flat


def _parameter(name: str, cursor: Cursor, found: Findings) -> ParameterValue | None:
    if isinstance(cursor.value.data, tuple):
        return scalar_tuple(cursor, found)
    text = cursor.value.text
    if not cursor.value.quoted and len(text) > 1 and text in YAML_1_1_BOOLEANS:
        message = f"cannot tell whether {text} is meant as a boolean; it is read as a string"
        hint = f'write {name}: true or false, or {name}: "{text}"'
        found.append(note("manifest.yaml-1.1-boolean", cursor.at, message, hint))
    if not cursor.value.quoted and has_leading_zero(text):
        message = f"cannot tell which number {text} is meant as; it is read as a string"
        hint = f'write {name}: {text.lstrip("+0") or "0"}, or {name}: "{text}"'
        found.append(note("manifest.leading-zero", cursor.at, message, hint))
    return cursor.scalar


def _health(cursor: Cursor) -> Health:
    patterns = cursor.get("diagnostics")
    if patterns is None or isinstance(patterns.value.data, tuple):
        return cursor.build(Health)
    return cursor.build(Health, diagnostics=(patterns.value.text,))


def _flows(node: Cursor) -> list[FlowNeed]:
    needs = []
    for kind in (EndpointKind.PUBLISHER, EndpointKind.SUBSCRIPTION):
        for name, cursor in node.entries("flows", kind.value):
            wanted = written.read(cursor.value.plain(), PublisherFlow, strict=False)
            five_qi = wanted.five_qi
            needs.append(
                cursor.build(
                    FlowNeed,
                    kind=kind,
                    name=name,
                    dscp=None if wanted.dscp is None else wanted.dscp.value,
                    five_qi=None if five_qi == "auto" else five_qi,
                    five_qi_auto=five_qi == "auto",
                    rate_hz=_carried_hz(wanted.rate_hz),
                    quantities=quantities(cursor),
                    at=cursor.key_at,
                )
            )
    return needs


def _carried_hz(rate: float | Rate | None) -> float | None:
    """Return the messages per second that a network must carry."""
    return rate.max or rate.min if isinstance(rate, Rate) else rate


_QUANTITIES = ("max_delay_ms", "loss", "max_silence_s", "max_message_size", "five_qi")
"""Numbers of a flow or a link that nothing but a measurement could prove; and its rate."""


def quantities(cursor: Cursor) -> tuple[Quantity, ...]:
    """Return the numbers of a flow or a link that only a measurement could prove.

    `five_qi: auto` is none: it follows from the others.
    """
    found = []
    share = cursor.get("quantile")
    quantile = QUANTILE if share is None else float(share.value.text)
    for name in _QUANTITIES:
        value = cursor.get(name)
        if value is not None and isinstance(value.scalar, (int, float)):
            of = quantile if name == "max_delay_ms" else QUANTILE
            found.append(Quantity(name=name, value=value.scalar, at=value.at, quantile=of))
    rate = cursor.get("rate_hz")
    if rate is not None and isinstance(rate.value.data, Mapping):
        both = rate.build(Rate)
        found.append(Quantity(name="rate_hz", value=both.min or 0.0, most=both.max, at=rate.at))
    elif rate is not None:
        hertz = float(rate.value.text)
        found.append(Quantity(name="rate_hz", value=hertz, slack=RATE_SLACK, at=rate.at))
    return tuple(found)


def _written_paths(node: Cursor) -> Iterator[tuple[str, str]]:
    """Yield the paths of a node as they are written, by place."""
    for index, each in enumerate(node.items("parameter_files")):
        yield f"parameter_files.{index}", each.value.text
    run = node.get("run")
    if run is not None and "working_directory" in run:
        yield "run.working_directory", run.text("working_directory")
