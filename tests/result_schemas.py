"""Write the JSON Schemas of what lifecycle prints, from its types: `make schemas`.

Ranges and patterns are on the types, descriptions are those of their docstrings. `BY_HAND` says
which schemas are not generated, and why.
"""

from __future__ import annotations

import dataclasses
import enum
import inspect
import json
import re
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, get_args, get_type_hints

import msgspec

from lifecycle.cli.verbs.apply import ApplyReport
from lifecycle.cli.verbs.check import CheckReport
from lifecycle.export.picture.model import Picture
from lifecycle.graph.status import NodeStatus
from lifecycle.plan.model import Plan
from lifecycle.supervisor.run.journal import JournalLine
from lifecycle.verify.observation import NodeConfiguration
from lifecycle.verify.verdict import Verdict

FOLDER = Path(__file__).parents[1] / "schemas"
BY_HAND = {
    "manifest": "it is what users write; the types are made from it",
}

_Schema = dict[str, Any]
_ATTRIBUTE = re.compile(r"^    (\w+(?:, \w+)*): (.*(?:\n {8}.*)*)", re.MULTILINE)


def _verdict(schema: _Schema) -> None:
    """A verdict is written without what is empty, see `lifecycle.verify.report.to_json`."""
    del schema["properties"]["blocking"], schema["$defs"]["Finding"]["properties"]["ends"]
    schema["properties"]["judged"] |= {"const": False}
    run = schema["properties"]["run"]
    run |= run.pop("anyOf")[0]
    schema["required"].remove("blocking")


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
    return json.dumps(schema, indent=2, ensure_ascii=False) + "\n"


def _types(hint: Any) -> Iterator[type]:
    """Yield the structs, dataclasses and enums that a type is made of, itself among them."""
    for each in get_args(hint):
        yield from _types(each)
    if isinstance(hint, type) and issubclass(hint, enum.Enum):
        yield hint
    elif isinstance(hint, type) and (
        dataclasses.is_dataclass(hint) or issubclass(hint, msgspec.Struct)
    ):
        yield hint
        for each in get_type_hints(hint).values():
            yield from _types(each)


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


if __name__ == "__main__":
    for each in RESULTS:
        (FOLDER / f"{each}.v1.schema.json").write_text(generate(each), encoding="utf-8")
