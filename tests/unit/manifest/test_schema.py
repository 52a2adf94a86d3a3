"""The shipped schema: for editors, for the loader, and in step with the types."""

from __future__ import annotations

import enum
import json
from importlib import resources
from pathlib import Path
from typing import Any

import jsonschema
import pytest
import yaml

from lifecycle.manifest.model import (
    Authority,
    Condition,
    DataLayerSource,
    DiscoveryMode,
    DiscoveryRange,
    EndpointKind,
    EndpointPolicy,
    FlowTransport,
    UniqueHow,
)
from lifecycle.manifest.qos import PRESETS, Durability, History, Liveliness, Reliability
from lifecycle.manifest.schema import MANIFEST, read_schema, validate
from lifecycle.manifest.yaml.source import parse
from lifecycle.network.dscp import code_points
from lifecycle.network.nfe import UniqueRequirement

ROOT = Path(__file__).parents[3]
SCHEMA: Any = read_schema(MANIFEST)
DEFS = SCHEMA["$defs"]


def _enum_of(schema: dict[str, Any]) -> list[str]:
    """Return the words of a property, with or without the branch for substitutions."""
    branches = [schema, *schema.get("anyOf", [])]
    return next(branch["enum"] for branch in branches if "enum" in branch)


def _words(type_: type[enum.Enum], *, without: str = "") -> list[str]:
    return [each.value for each in type_ if each.value != without]


@pytest.mark.parametrize("path", sorted((ROOT / "schemas").glob("*.json")), ids=lambda p: p.name)
def test_every_schema_is_valid_and_described(path: Path) -> None:
    schema = json.loads(path.read_text(encoding="utf-8"))
    jsonschema.Draft202012Validator.check_schema(schema)
    assert schema["title"]


def test_the_package_ships_exactly_the_schemas_of_the_repository() -> None:
    shipped = {
        each.name: each.read_bytes()
        for each in (resources.files("lifecycle") / "_schemas").iterdir()
    }
    assert shipped == {each.name: each.read_bytes() for each in (ROOT / "schemas").iterdir()}
    assert MANIFEST in shipped


@pytest.mark.parametrize(
    ("schema", "words"),
    [
        (DEFS["qos_preset"], list(PRESETS)),
        (DEFS["qos_profile"]["properties"]["history"], _words(History, without="UNKNOWN")),
        (DEFS["qos_profile"]["properties"]["reliability"], _words(Reliability, without="UNKNOWN")),
        (DEFS["qos_profile"]["properties"]["durability"], _words(Durability, without="UNKNOWN")),
        (DEFS["qos_profile"]["properties"]["liveliness"], _words(Liveliness, without="UNKNOWN")),
        (DEFS["unique"], _words(UniqueRequirement)),
        (DEFS["link"]["properties"]["unique"], _words(UniqueHow)),
        (DEFS["discovery"]["properties"]["range"], _words(DiscoveryRange)),
        (DEFS["discovery"]["properties"]["mode"], _words(DiscoveryMode)),
        (
            DEFS["discovery"]["properties"]["transport"],
            [each for each in _words(FlowTransport) if each not in {"network", "multicast"}],
        ),
        (DEFS["flow_transport"], _words(FlowTransport)),
        (DEFS["data_layer"]["properties"]["authority"], _words(Authority)),
        (DEFS["data_layer"]["properties"]["source"], _words(DataLayerSource)),
        (DEFS["node"]["properties"]["endpoints"], _words(EndpointPolicy)),
        (DEFS["node"]["properties"]["after"]["additionalProperties"], _words(Condition)),
        (
            DEFS["flows"]["properties"]["publishers"]["additionalProperties"]["properties"]["dscp"],
            [name for each in code_points() for name in (each.name, *each.aliases)],
        ),
    ],
)
def test_the_words_of_the_schema_are_those_of_the_types(
    schema: dict[str, Any], words: list[str]
) -> None:
    assert sorted(_enum_of(schema)) == sorted(words)


def test_the_lists_of_an_interface_are_the_kinds_of_endpoint() -> None:
    lists = list(DEFS["interface"]["properties"])
    assert lists == [*_words(EndpointKind), "parameters"]


def _objects(schema: object, place: str = "") -> list[tuple[str, dict[str, Any]]]:
    found = []
    if isinstance(schema, dict):
        if schema.get("type") == "object":
            found.append((place, schema))
        for key, each in schema.items():
            found += _objects(each, f"{place}/{key}")
    if isinstance(schema, list):
        for index, each in enumerate(schema):
            found += _objects(each, f"{place}/{index}")
    return found


def test_no_mapping_lets_unknown_keys_pass_and_every_key_is_described() -> None:
    objects = _objects(SCHEMA)
    assert len(objects) > 20
    for place, schema in objects:
        assert "additionalProperties" in schema, place
        assert schema["additionalProperties"] is not True, place
        for key, each in schema.get("properties", {}).items():
            target = DEFS[each["$ref"].rpartition("/")[2]] if "$ref" in each else each
            assert target.get("description") or target.get("title"), f"{place}/{key}"


@pytest.mark.parametrize(
    "path",
    sorted((ROOT / "tests/corpus/valid").glob("*.lifecycle.yaml")),
    ids=lambda path: path.name.split(".")[0],
)
def test_an_editor_accepts_what_the_loader_accepts_substitutions_included(path: Path) -> None:
    document = parse(path.read_text(encoding="utf-8-sig"), file=path.name)
    errors = list(jsonschema.Draft202012Validator(SCHEMA).iter_errors(document.root.plain()))
    assert errors == []


def test_an_editor_finds_the_unknown_key_that_the_loader_finds() -> None:
    document = yaml.safe_load("{manifest_version: 1, system: s, nodes: {a: {atach: true}}}")
    messages = [
        each.message for each in jsonschema.Draft202012Validator(SCHEMA).iter_errors(document)
    ]
    assert "Additional properties are not allowed ('atach' was unexpected)" in messages


def test_a_substitution_that_is_left_over_does_not_pass_for_a_number() -> None:
    text = (
        "manifest_version: 1\nsystem: s\nnodes: {a: {attach: true}}\n"
        "discovery: {domain_id: $(arg x)}\n"
    )
    found = [str(each) for _, each in validate(parse(text, file="f"))]
    assert found == [
        "f:4:24: discovery.domain_id: cannot use domain_id '$(arg x)'; it must be an integer"
    ]


def test_a_key_with_a_line_break_at_its_end_does_not_match_a_pattern() -> None:
    text = 'manifest_version: 1\nsystem: s\nnodes: {"a\\n": {attach: true}}\n'
    ((_, only),) = validate(parse(text, file="f"))
    assert str(only) == (
        "f:3:9: nodes[\"a\\n\"]: cannot use 'a\\n' as a key here; "
        "use letters, digits and '_', not a digit first"
    )


def test_more_findings_than_a_person_reads_are_summed_up() -> None:
    keys = "".join(f"k{index}: 1\n" for index in range(1000))
    found = validate(
        parse(f"manifest_version: 1\nsystem: s\nnodes: {{a: {{attach: true}}}}\n{keys}", file="f")
    )
    assert len(found) == 201
    assert str(found[-1][1]) == "f:1:1: cannot list more than 200 findings; fix these first"
