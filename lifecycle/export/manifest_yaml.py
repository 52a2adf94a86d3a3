"""Writes a captured system as a manifest in YAML, and its nodes as NoDL v2 documents.

Owns: how captured facts are spelled in a manifest, with `# gap:` on every line whose value the
graph does not show; and YAML text that reads back the same in YAML 1.1 and 1.2. What is written
passes `lifecycle check`. Pure.
"""

from __future__ import annotations

import math
import re
import textwrap
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Union

import msgspec

from lifecycle.export.captured import (
    TARGETS,
    CapturedEndpoint,
    CapturedNode,
    CapturedParameter,
    CapturedSystem,
    can_be_given,
    is_finite,
)
from lifecycle.export.programs import CapturedRun
from lifecycle.manifest.model import DiscoveryRange, EndpointKind, RosArguments, TargetState
from lifecycle.manifest.names import expand
from lifecycle.manifest.qos import INFINITE_NS, History, QosProfile
from lifecycle.network.dscp import describe
from lifecycle.network.nfe import UniqueRequirement

Scalar = Union[bool, int, float, str]  # noqa: UP007 - a run-time alias on Python 3.10
Tree = Union[Scalar, "Noted", Sequence["Tree"], Mapping[str, "Tree"]]


class Noted(msgspec.Struct, frozen=True, kw_only=True):
    """A value with a comment on its line."""

    value: Tree
    note: str


_PLAIN = re.compile(r"[A-Za-z_/][A-Za-z0-9_/.-]*")
_WORDS = frozenset({"null", "true", "false", "yes", "no", "on", "off", "y", "n"})
"""Scalars that some version of YAML does not read as strings, in any spelling of case."""

_ESCAPES = {"\\": "\\\\", '"': '\\"', "\n": "\\n", "\t": "\\t", "\r": "\\r"}


def to_yaml(tree: Mapping[str, Tree]) -> str:
    """Return a block style document of `tree`, in its own order."""
    return "\n".join(_mapping(tree, "")) + "\n"


def comment(text: str) -> str:
    """Return one comment line; what would end it is shown as a space."""
    return "# " + "".join(each if each.isprintable() else " " for each in text)


def scalar(value: Scalar) -> str:
    """Return a scalar as YAML.

    Raises:
        ValueError: a number that is not finite; manifests have none.
    """
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int):
        return str(value)
    if isinstance(value, float):
        if not math.isfinite(value):
            raise ValueError(f"cannot write {value!r} as YAML: a number must be finite")
        # YAML 1.1 takes 1e+16 for a string.
        mantissa, e, exponent = repr(value).partition("e")
        return f"{mantissa if '.' in mantissa else mantissa + '.0'}{e}{exponent}"
    if _PLAIN.fullmatch(value) and value.lower() not in _WORDS:
        return value
    return '"' + "".join(map(_character, value)) + '"'


def _character(each: str) -> str:
    if each in _ESCAPES:
        return _ESCAPES[each]
    if each.isprintable():
        return each
    code = ord(each)
    if code == 0 or 0xD800 <= code <= 0xDFFF:  # a manifest can hold neither
        return "\N{REPLACEMENT CHARACTER}"
    return f"\\x{code:02x}" if code < 0x100 else f"\\U{code:08x}"


def _mapping(tree: Mapping[str, Tree], indent: str) -> Iterator[str]:
    for key, value in tree.items():
        yield from _entry(f"{indent}{scalar(key)}:", value, indent + "  ")


def _entry(head: str, value: Tree, indent: str) -> Iterator[str]:
    note = ""
    if isinstance(value, Noted):
        note, value = "  " + comment(value.note), value.value
    if isinstance(value, Mapping):
        yield f"{head}{'' if value else ' {}'}{note}"
        yield from _mapping(value, indent)
    elif isinstance(value, (bool, int, float, str)):
        yield f"{head} {scalar(value)}{note}"
    elif isinstance(value, Noted):
        raise TypeError("cannot comment on one line twice")
    elif all(isinstance(each, (bool, int, float, str)) for each in value):
        yield f"{head} [{', '.join(scalar(each) for each in value)}]{note}"  # type: ignore[arg-type]
    else:
        yield f"{head}{note}"
        for each in value:
            yield from _item(each, indent)


def _item(value: Tree, indent: str) -> Iterator[str]:
    """One item of a list: its first line carries the dash."""
    lines = _mapping(value, "") if isinstance(value, Mapping) else _entry("", value, "  ")
    for index, line in enumerate(lines):
        yield f"{indent}{'  ' if index else '- '}{line.removeprefix(' ') if not index else line}"


SUFFIX = ".nodl.yaml"
_Spell = Callable[[Scalar], Scalar]
_WIDTH = 100
_ANNOUNCED = "history and depth are not announced"
_NOW = "its value now; the default is not known"
_SERVICES = "the graph does not show the QoS of services"
_UNKNOWN_POLICY = "SYSTEM_DEFAULT"


def to_manifest(
    system: CapturedSystem,
    *,
    references: Mapping[str, str] | None = None,
    schema: str = "manifest.v1.schema.json",
) -> str:
    """Return the manifest of a captured system.

    Args:
        system: what was captured.
        references: by node key, the reference to the node's interface, `local://camera.nodl.yaml`;
            interfaces are written out without it.
        schema: where editors find the manifest's schema, a path or URL.
    """
    head = [
        f"# yaml-language-server: $schema={schema}",
        *_comments(
            f"Captured from domain {system.domain_id}, discovery range "
            f"{system.discovery_range.value}. What a graph does not show is marked: gap."
        ),
        *(line for each in _gaps(system) for line in _comments(f"gap: {each}")),
    ]
    return "\n".join(head) + "\n" + to_yaml(_manifest(system, references or {}))


def to_nodl(node: CapturedNode) -> str:
    """Return the interface of one node as a NoDL v2 document."""
    gaps = [line for each in node.gaps for line in _comments(f"gap: {each}")]
    tree: dict[str, Tree] = {
        "nodl_version": 2,
        "description": f"Captured from {node.full_name}",
        **_interface(node, spell=lambda value: value),
    }
    return "\n".join([*gaps, to_yaml(tree)])


def _comments(text: str) -> Iterable[str]:
    return map(comment, textwrap.wrap(text, _WIDTH - 2, break_on_hyphens=False))


def _gaps(system: CapturedSystem) -> Iterable[str]:
    yield from system.gaps
    foreign = [each.full_name for each in system.nodes if not each.has_configuration]
    if foreign:
        yield (
            "not ours, so that machine, process, flows, DSCP, history and depth are unknown: "
            + ", ".join(foreign)
        )
        yield "remaps cannot be seen: names are those in the graph, not those in the nodes' code"


def kept(keys: Mapping[str, Tree | None]) -> dict[str, Tree]:
    """Return the keys that say something: whose values are neither None nor empty."""
    return {key: each for key, each in keys.items() if each not in (None, "", {}, [], ())}


def _manifest(system: CapturedSystem, references: Mapping[str, str]) -> dict[str, Tree]:
    ends = {(each.kind, each.name) for node in system.nodes for each in node.endpoints}
    waiting = {
        name for kind, name in ends if not kind.offers and (kind.other_end, name) not in ends
    }
    policy = {
        "undeclared_nodes": Noted(value="open", note="gap: nodes were left out")
        if system.partial
        else None,
        "unpublished": Noted(
            value="warning", note=f"gap: nobody offers {', '.join(sorted(waiting))}"
        )
        if waiting
        else None,
    }
    is_default = system.discovery_range is DiscoveryRange.SYSTEM_DEFAULT
    discovery_range = "" if is_default else system.discovery_range.value
    return kept(
        {
            "manifest_version": 1,
            "system": system.system,
            "discovery": kept({"domain_id": system.domain_id, "range": discovery_range}),
            "policy": kept(policy),
            "nodes": {each.key: _node(each, references.get(each.key, "")) for each in system.nodes},
        }
    )


def _node(node: CapturedNode, reference: str) -> Tree:
    run = node.run
    is_active = node.state not in TARGETS or node.state == TargetState.ACTIVE.value
    ended = run is not None and run.program.has_ended
    why = (
        "it ended while it was captured; its exit status is not seen"
        if ended
        else "it only asks others; whether it ends by itself is not seen"
    )
    several = ", ".join(f"{each.kind.value} {each.name}" for each in node.repeated)
    remap = {
        each.declared: each.name
        for each in node.endpoints
        if expand(each.declared, node.name, node.namespace) != each.name
    }
    values = {
        each.name: _value(each, literal) for each in node.parameters or () if can_be_given(each)
    }
    needs = {
        kind.value: kept(
            {each.declared: _need(each) for each in node.endpoints if each.kind is kind}
        )
        for kind in (EndpointKind.PUBLISHER, EndpointKind.SUBSCRIPTION)
    }
    tree = kept(
        {
            "run": _run(run) if run else {"attach": True},
            "process": run.process if run else "",
            "name": node.name if node.key != node.name or (run and run.names) else "",
            "namespace": "" if node.namespace == "/" else node.namespace,
            "managed": node.managed,
            "state": node.state if node.managed and not is_active else "",
            "may_end": Noted(value=True, note=f"gap: {why}") if node.may_end else None,
            "endpoints": Noted(
                value="open", note=f"gap: it has several {several}; a manifest names each once"
            )
            if several
            else None,
            "remap": remap | dict(run.remap if run else ()),
            "parameter_files": run.parameter_files if run else (),
            "parameters": values if run else {},
            "log_level": run.log_level if run else "",
            "interface": reference or _interface(node, spell=literal),
            "flows": kept(needs),
        }
    )
    notes = [f"gap: {each}" for each in node.gaps]
    if node.process_id is not None:
        notes.insert(0, f"pid {node.process_id} when it was captured")
    return Noted(value=tree, note="; ".join(notes)) if notes else tree


def _run(run: CapturedRun) -> dict[str, Tree]:
    return kept(
        {
            "command": list(map(literal, run.command)),
            "working_directory": literal(run.program.working_directory),
            "environment": {name: str(literal(value)) for name, value in run.program.environment},
            "ros_args": "" if run.ros_args is RosArguments.AUTO else run.ros_args.value,
        }
    )


def _value(parameter: CapturedParameter, spell: _Spell) -> Tree:
    value = parameter.value
    assert value is not None
    return list(map(spell, value)) if isinstance(value, tuple) else spell(value)


def _interface(node: CapturedNode, *, spell: _Spell) -> dict[str, Tree]:
    parameters: dict[str, Tree] = {
        each.name: _parameter(each, spell, given=node.run is not None and can_be_given(each))
        for each in node.parameters or ()
        if each.type
    }
    of_kind: dict[str, Tree] = {
        kind.value: [_endpoint(each) for each in node.endpoints if each.kind is kind]
        for kind in EndpointKind
    }
    return kept(of_kind | {"parameters": parameters})


def _endpoint(endpoint: CapturedEndpoint) -> Tree:
    tree: dict[str, Tree] = {"name": endpoint.declared, "type": endpoint.type}
    if endpoint.qos is not None:
        tree["qos"] = _qos(endpoint.qos, endpoint.kind)
    elif endpoint.kind in (EndpointKind.SERVICE_SERVER, EndpointKind.SERVICE_CLIENT):
        policies = ("history", "reliability", "durability", "liveliness")
        tree["qos"] = Noted(
            value=dict.fromkeys(policies, _UNKNOWN_POLICY), note=f"gap: {_SERVICES}"
        )
    return tree


def _qos(qos: QosProfile, kind: EndpointKind) -> dict[str, Tree]:
    def duration_ns(value: int | None) -> int | None:
        return None if value in (0, INFINITE_NS) else value

    is_reader = kind is EndpointKind.SUBSCRIPTION
    unknown = Noted(value=_UNKNOWN_POLICY, note=f"gap: {_ANNOUNCED}")
    return kept(
        {
            "history": unknown if qos.history is History.UNKNOWN else qos.history.value,
            "depth": qos.depth if qos.history is History.KEEP_LAST else None,
            "reliability": _policy_value(qos.reliability.value),
            "durability": _policy_value(qos.durability.value),
            "deadline_ns": duration_ns(qos.deadline_ns),
            # A DataReader has no lifespan (DDS 1.4 §2.2.3.16).
            "lifespan_ns": None if is_reader else duration_ns(qos.lifespan_ns),
            "liveliness": _policy_value(qos.liveliness.value),
            "liveliness_lease_duration_ns": duration_ns(qos.liveliness_lease_duration_ns),
        }
    )


def _policy_value(value: str) -> Tree:
    unknown = Noted(value=_UNKNOWN_POLICY, note="gap: not announced")
    return unknown if value == "UNKNOWN" else value


def _parameter(parameter: CapturedParameter, spell: _Spell, *, given: bool) -> Tree:
    tree: dict[str, Tree] = {"type": parameter.type}
    value = parameter.value
    if given:
        pass  # beside the interface, where the node is given it
    elif value is not None and is_finite(value):
        tree["default_value"] = Noted(value=_value(parameter, spell), note=f"gap: {_NOW}")
    elif value is not None:
        tree["type"] = Noted(value=parameter.type, note="gap: its value is not finite")
    if parameter.description:
        tree["description"] = str(spell(parameter.description))
    if parameter.read_only:
        tree["read_only"] = True
    return tree


def literal(value: Scalar) -> Scalar:
    """Spell a text so that a manifest takes nothing in it for a substitution."""
    return value.replace("$(", "$$(") if isinstance(value, str) else value


def _need(endpoint: CapturedEndpoint) -> dict[str, Tree]:
    unique: Tree = endpoint.unique.value
    strict = endpoint.unique is UniqueRequirement.STRICTLY_REQUIRED
    if strict and endpoint.kind is EndpointKind.PUBLISHER:
        # A manifest may not ask that of a node that it only attaches to.
        unique = Noted(
            value=UniqueRequirement.OPTIONALLY_REQUIRED.value,
            note="gap: it is strictly_required; only a node with run: python can be asked that",
        )
    elif endpoint.unique is UniqueRequirement.NOT_REQUIRED:
        unique = ""
    dscp = endpoint.dscp
    marked = None if dscp is None else Noted(value=dscp, note=describe(dscp))
    return kept({"unique": unique, "dscp": marked})
