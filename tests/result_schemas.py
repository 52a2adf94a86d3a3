"""Write the JSON Schemas of what lifecycle prints, from its types: `make schemas`.

Ranges and patterns are on the types, descriptions are those of their docstrings. So is the
schema of a manifest, in which `$(…)` may stand wherever no free text may.
"""

from __future__ import annotations

import dataclasses
import enum
import inspect
import json
import re
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, Literal, get_args, get_origin, get_type_hints

import msgspec

from lifecycle.cli.verbs.apply import ApplyReport
from lifecycle.cli.verbs.check import CheckReport
from lifecycle.export.picture import Picture
from lifecycle.graph.status import NodeStatus
from lifecycle.manifest import written
from lifecycle.manifest.model import Dscp
from lifecycle.network.dscp import MAX_DSCP, code_points
from lifecycle.plan.model import Plan
from lifecycle.supervisor.control.protocol import SystemStatus
from lifecycle.supervisor.run.journal import JournalLine
from lifecycle.verify.observation import NodeConfiguration
from lifecycle.verify.rules import RULES
from lifecycle.verify.verdict import Verdict

FOLDER = Path(__file__).parents[1] / "schemas"

_Schema = dict[str, Any]
_ATTRIBUTE = re.compile(r"^    (\w+(?:, \w+)*): (.*(?:\n {8}.*)*)", re.MULTILINE)


def _verdict(schema: _Schema) -> None:
    """A verdict is written without what is as it mostly is."""
    schema["properties"]["judged"] |= {"const": False}
    run = schema["properties"]["run"]
    run |= run.pop("anyOf")[0]


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Result:
    """One schema.

    Attributes:
        type_: what is written.
        title: of the schema.
        always: fields that have a default in Python and stand in every document, by type.
        edit: makes the schema that of the document where that differs from the type.
    """

    type_: type
    title: str
    always: Mapping[str, tuple[str, ...]] = dataclasses.field(default_factory=dict)
    edit: Callable[[_Schema], None] = lambda _: None


RESULTS = {
    "apply": Result(
        type_=ApplyReport,
        title="Report of lifecycle apply --format json, version 1",
        always={
            "ApplyReport": (
                *("differences", "added", "removed", "restarted", "parameters"),
                "error",
            ),
        },
    ),
    "check": Result(
        type_=CheckReport,
        title="Report of lifecycle check --format json, version 1",
        always={"CheckReport": ("unresolved",), "Diagnostic": ("hint",), "Position": ("path",)},
    ),
    "graph": Result(
        type_=Picture,
        title="Picture of a system (lifecycle graph --format json)",
    ),
    "journal": Result(
        type_=JournalLine,
        title="Line of a run's journal (journal.jsonl beside its logs)",
    ),
    "node_configuration": Result(
        type_=NodeConfiguration, title="Configuration of one node (~/get_configuration)"
    ),
    "node_status": Result(
        type_=NodeStatus,
        title="What a node says of itself to the graph (/lifecycle/graph)",
        always={
            "NodeStatus": (
                *("version", "state", "connected", "checksum", "connections", "mappings"),
                *("left", "reason"),
            ),
            "MappingStatus": ("connection", "matched"),
        },
    ),
    "plan": Result(
        type_=Plan,
        title="Plan of one system (lifecycle plan --format json)",
        always={
            "Plan": ("machines", "policy"),
            "PlannedNode": (
                *("managed", "parameters", "parameter_files", "remap", "after"),
                *("timeouts", "log_level"),
            ),
        },
        edit=lambda schema: schema["$defs"]["Run"]["properties"].pop("attach"),  # it is a kind
    ),
    "status": Result(
        type_=SystemStatus,
        title="Status of a running system (lifecycle status --format json)",
        always={
            "SystemStatus": ("not_ok", "mode", "manifest", "revision", "ends"),
            "NodeStatus": (
                *("unreported", "silent", "died", "connections", "uptime_s", "restarts"),
                *("last_failure", "next_try_s"),
            ),
        },
    ),
    "verdict": Result(
        type_=Verdict,
        title="Verdict of lifecycle verify --format json",
        always={"FlowTuple": ("flow_label", "dscp")},
        edit=_verdict,
    ),
}


def generate(name: str) -> str:
    """Return the text of a schema."""
    result = RESULTS[name]
    _, defs = msgspec.json.schema_components((result.type_,), ref_template="#/$defs/{name}")
    for each in dict.fromkeys(_types(result.type_)):
        defs[each.__name__] = _described(each, defs[each.__name__], result)
    schema: _Schema = {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "$id": f"urn:ros-lifecycle-manifests:{name}:v1",
        "title": result.title,
        **defs.pop(result.type_.__name__),
        "$defs": dict(sorted(defs.items())),
    }
    result.edit(schema)
    return _text(schema)


def _text(schema: _Schema) -> str:
    """Return the text of a schema, with the rules of `lifecycle.verify` where they are meant."""
    ids = [each.id for each in RULES]
    families = dict.fromkeys(each.partition(".")[0] for each in ids)
    lists = {"rules": ids, "rules and families": ["default", *families, *ids]}

    def listed(part: Any) -> Any:
        if isinstance(part, list):
            return [*map(listed, part)]
        if not isinstance(part, dict):
            return part
        found = {key: listed(each) for key, each in part.items()}
        if isinstance(enum := part.get("enum"), str):
            found["enum"] = lists[enum]
        return found

    return json.dumps(listed(schema), indent=2, ensure_ascii=False) + "\n"


def _types(hint: Any) -> Iterator[type]:
    """Yield the structs, dataclasses and enums that a type is made of, itself among them."""
    for each in _parts(hint, set()):
        if isinstance(each, type) and (issubclass(each, enum.Enum) or _is_section(each)):
            yield each


def _parts(hint: Any, seen: set[Any]) -> Iterator[Any]:
    """Yield all that a type is made of; a struct or dataclass once, before its fields."""
    if _is_section(hint):
        if hint in seen:
            return
        seen.add(hint)
    yield hint
    for each in get_args(hint) if get_origin(hint) is not Literal else ():
        yield from _parts(each, seen)
    for each in get_type_hints(hint).values() if _is_section(hint) else ():
        yield from _parts(each, seen)


def _is_section(hint: Any) -> bool:
    return isinstance(hint, type) and issubclass(hint, msgspec.Struct)


def _described(type_: type, schema: _Schema, result: Result) -> _Schema:
    found = {"description": " ".join(_summary(type_).split())}
    if issubclass(type_, enum.Enum):
        return {**found, "enum": [each.value for each in type_]}
    words = {
        name: " ".join(text.split())
        for base in reversed(type_.__mro__)
        for names, text in _ATTRIBUTE.findall(inspect.cleandoc(base.__doc__ or ""))
        for name in names.split(", ")
    }
    properties = {
        name: ({"description": words[name]} if name in words else {})
        | {key: value for key, value in each.items() if key != "default"}
        for name, each in schema["properties"].items()
    }
    always = {*schema["required"], *result.always.get(type_.__name__, ())}
    return {
        **found,
        "type": "object",
        "properties": properties,
        "required": [each for each in properties if each in always],
        "additionalProperties": False,
    }


def _summary(type_: type) -> str:
    return inspect.cleandoc(type_.__doc__ or "").partition("\n\n")[0]


_SUBSTITUTION = {"$ref": "#/$defs/substitution"}


def generate_manifest() -> str:
    """Return the text of the schema of what users write."""
    types = (written.Manifest, written.TREE, written.ForRules, written.EnterMode)
    (_, tree, for_rules, _), defs = msgspec.json.schema_components(
        types,
        schema_hook=lambda type_: {"$ref": f"#/$defs/{type_.__name__}"},
        ref_template="#/$defs/{name}",
    )
    found = {each.__name__: each for type_ in types for each in _types(type_)}
    words = {
        each: [each.value for each in type_ if each.value != "UNKNOWN"]  # that is only observed
        for each, type_ in found.items()
        if _is_enum(type_)
    }
    for name, type_ in found.items():
        if name not in words:
            defs[name] = _section(type_, defs[name])
    for each in defs["Qos"]["properties"].values():
        each.pop("default", None)  # of the endpoint's kind
    reaction = {"enum": list(get_args(written.Word))}
    for_rules["not"] = {"required": ["mode"]}
    names = [name for each in code_points() for name in (each.name, *each.aliases)]
    special = {
        written.ParameterTree: tree["anyOf"],
        written.OnViolation: [reaction, for_rules, {"$ref": "#/$defs/EnterMode"}],
        Dscp: [{"enum": names}, {"type": "integer", "minimum": 0, "maximum": MAX_DSCP}],
    }
    for type_, branches in special.items():
        defs[type_.__name__] = {"description": _about(type_), "anyOf": branches}
    parts = [part for each in types for part in _parts(each, set())]
    order = {
        frozenset(get_args(each)): get_args(each) for each in parts if get_origin(each) is Literal
    }
    opening = _Opening(words=words, order=order)
    whole = {name: opening.section(each) for name, each in defs.items() if name not in words}
    schema: _Schema = {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "$id": "urn:ros-lifecycle-manifests:manifest:v1",
        **whole.pop("Manifest"),
        "title": "Manifest of a ROS 2 system, version 1",
        "$defs": {**dict(sorted(whole.items())), "substitution": _A_SUBSTITUTION},
    }
    return _text(schema)


def _is_enum(type_: type) -> bool:
    return issubclass(type_, enum.Enum)


_A_SUBSTITUTION = {
    "title": "Substitution",
    "description": "$(arg NAME), $(env NAME [DEFAULT]), $(find-pkg-share PACKAGE), $(file PATH), "
    "$(command PROGRAM …), $(equals A B), $(not-equals A B), $(not A), $(and A B) or $(or A B), "
    "also inside other text and each other. Resolved before values are checked.",
    "type": "string",
    "pattern": r"\$\(",
}


def _about(type_: type) -> str:
    """Return all that a type's docstring says before its attributes."""
    text = inspect.cleandoc(type_.__doc__ or "").partition("\n\nAttributes:")[0]
    return " ".join(text.split())


def _section(type_: type, schema: _Schema) -> _Schema:
    """Return the schema of a mapping with the texts of its type and its rules across keys."""
    words: dict[str, str] = {}
    order: list[str] = []
    for base in type_.__mro__:
        if not (issubclass(base, msgspec.Struct) and base is not msgspec.Struct):
            continue
        for names, text in _ATTRIBUTE.findall(inspect.cleandoc(base.__doc__ or "")):
            for name in names.split(", "):
                words.setdefault(name, " ".join(text.split()))
        own = {each.name: each.encode_name for each in msgspec.structs.fields(base)}
        order += [own[name] for name in vars(base).get("__annotations__", {}) if name in own]
    properties = {}
    for name in dict.fromkeys(order):
        each = {"title": name.replace("_", " ").capitalize(), "description": words.get(name)}
        each |= schema["properties"][name]
        properties[name] = {key: value for key, value in each.items() if value is not None}
    ways = {"oneOf": getattr(type_, "ONE_OF", ()), "anyOf": getattr(type_, "ANY_OF", ())}
    return {
        "title": schema["title"],
        "description": _about(type_),
        "type": "object",
        "properties": properties,
        "additionalProperties": False,
        **({"required": schema["required"]} if schema["required"] else {}),
        **{key: [{"required": list(way)} for way in each] for key, each in ways.items() if each},
    }


_NOTES = ("title", "description", "default", "examples")
_MERGED = ("string", "integer", "number", "boolean")


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class _Opening:
    """Makes of a type's schema what editors need: `$(…)` where no free text may be, and no null.

    Attributes:
        words: of each enum, by its name.
        order: of the words of each `Literal`.
    """

    words: Mapping[str, list[str]]
    order: Mapping[frozenset[Any], tuple[Any, ...]]

    def section(self, schema: _Schema) -> _Schema:
        """Return the schema of a mapping with known keys; of anything else, as `value` does."""
        if "properties" not in schema:
            return self.value(schema)
        properties = {key: self.value(each) for key, each in schema["properties"].items()}
        return {**schema, "properties": properties}

    def value(self, schema: _Schema) -> _Schema:
        """Return the schema of one value."""
        notes = {key: schema[key] for key in _NOTES if key in schema}
        if notes.get("default") in (None, "", (), []) or isinstance(notes["default"], dict):
            notes.pop("default", None)
        rest = {key: each for key, each in schema.items() if key not in _NOTES}
        written = rest.get("anyOf", [rest])
        branches = [self._branch(each) for each in written if each != {"type": "null"}]
        branches = _merged(branches)
        if any(_is_closed(each) for each in branches) and not any(map(_is_text, branches)):
            branches.append(_SUBSTITUTION)
        return notes | (branches[0] if len(branches) == 1 else {"anyOf": branches})

    def _branch(self, schema: _Schema) -> _Schema:
        schema = dict(schema)
        name = str(schema.get("$ref", "")).rpartition("/")[2]
        if name in self.words:
            schema.setdefault("enum", self.words[name])
            del schema["$ref"]
        for key in ("items", "additionalProperties"):
            if isinstance(schema.get(key), dict):
                schema[key] = self.value(schema[key])
        if "propertyNames" in schema:
            schema["propertyNames"] = self._branch(schema["propertyNames"])
        if "enum" in schema:
            words = self.order.get(frozenset(schema["enum"]), schema["enum"])
            schema["enum"] = words if isinstance(words, str) else list(words)
            if all(isinstance(each, str) for each in words):
                schema = {"type": "string", **schema}
            if len(words) == 1 and not isinstance(words[0], str):
                schema["const"] = schema.pop("enum")[0]
        if "pattern" in schema:  # \Z is Python's, and $ ECMA 262's
            schema["pattern"] = schema["pattern"].replace(r"\Z", "$")
        return schema


def _merged(branches: list[_Schema]) -> list[_Schema]:
    """Return a choice in which the types of scalars are one branch."""
    types = [each["type"] for each in branches if each.keys() == {"type"}]
    scalars = [each for each in _MERGED if each in types]
    if len(scalars) < 2:
        return branches
    rest = [each for each in branches if each.keys() != {"type"} or each["type"] not in scalars]
    return [{"type": scalars}, *rest]


def _is_closed(branch: _Schema) -> bool:
    """Whether it is a scalar that text cannot be, whatever the text is."""
    kinds = {"enum", "const", "pattern"} & branch.keys()
    return bool(kinds) or branch.get("type") in ("integer", "number", "boolean")


def _is_text(branch: _Schema) -> bool:
    types = branch.get("type", ())
    return (types == "string" or "string" in types) and not _is_closed(branch)


def texts() -> dict[str, str]:
    """Return the text of each schema by its name."""
    return {name: generate(name) for name in RESULTS} | {"manifest": generate_manifest()}


if __name__ == "__main__":
    for name, text in texts().items():
        (FOLDER / f"{name}.v1.schema.json").write_text(text, encoding="utf-8")
