"""The shipped schema: for editors, for the loader, and in step with the types."""

from __future__ import annotations

import copy
import json
import re
import subprocess
import sys
from collections.abc import Iterator
from importlib import resources
from pathlib import Path
from typing import Any

import jsonschema
import msgspec
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from lifecycle.manifest import written
from lifecycle.manifest.model import EndpointKind
from lifecycle.manifest.qos import PRESETS
from lifecycle.manifest.schema import validate, validator
from lifecycle.manifest.written import MANIFEST, read_schema
from lifecycle.manifest.yaml.source import parse

ROOT = Path(__file__).parents[3]
SCHEMA: Any = read_schema(MANIFEST)
DEFS = SCHEMA["$defs"]
RESOLVED = validator()


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


def test_the_presets_and_the_lists_of_an_interface_are_those_of_the_model() -> None:
    assert sorted(DEFS["TopicEndpoint"]["properties"]["qos"]["anyOf"][0]["enum"]) == sorted(PRESETS)
    lists = list(DEFS["Interface"]["properties"])
    assert lists == [*(each.value for each in EndpointKind), "parameters"]


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
    found = [str(each) for each in validate(parse(text, file="f"))]
    assert found == [
        "f:4:24: discovery.domain_id: cannot use domain_id '$(arg x)'; it must be an integer"
    ]


def test_a_key_with_a_line_break_at_its_end_does_not_match_a_pattern() -> None:
    text = 'manifest_version: 1\nsystem: s\nnodes: {"a\\n": {attach: true}}\n'
    (only,) = validate(parse(text, file="f"))
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
    assert str(found[-1]) == "f:1:1: cannot list more than 200 findings; fix these first"


def _fits(plain: object, *, strict: bool) -> bool:
    try:
        written.read(plain, written.Manifest, strict=strict)
    except msgspec.ValidationError:
        return False
    return True


def _places(value: object, place: tuple[str | int, ...] = ()) -> Iterator[tuple[str | int, ...]]:
    yield place
    inner = (
        value.items()
        if isinstance(value, dict)
        else enumerate(value)
        if isinstance(value, list)
        else ()
    )
    for key, each in inner:
        yield from _places(each, (*place, key))


def _every_key() -> Any:
    text = (ROOT / "tests/corpus/valid/every_key.lifecycle.yaml").read_text(encoding="utf-8")
    text = text.replace("$(arg rate)", "10")
    return yaml.safe_load(re.sub(r"\$\((equals|not) [^)]*\)", "true", text))


EVERY_KEY = _every_key()
VALUES = (
    *(True, -1, 0, 1, 5.0, 1.5, 1e12, "", "x", "a/b", "x\n", "default", "$(arg x)"),
    *([], {}, ["x"], [1], {"mode": "x"}, {"x": "x"}, {"default": "stop"}),
)


def test_every_key_may_be_written() -> None:
    assert _fits(EVERY_KEY, strict=True)
    assert RESOLVED.is_valid(EVERY_KEY)


@settings(max_examples=400, deadline=None)
@given(place=st.sampled_from([*_places(EVERY_KEY)][1:]), value=st.sampled_from([..., *VALUES]))
def test_the_types_and_the_schema_take_and_refuse_the_same(
    place: tuple[str | int, ...], value: object
) -> None:
    document = copy.deepcopy(EVERY_KEY)
    around = document
    for step in place[:-1]:
        around = around[step]
    if value is ...:
        del around[place[-1]]
    else:
        around[place[-1]] = value
    resolved = RESOLVED.is_valid(document)
    assert not _fits(document, strict=True) or resolved
    assert not resolved or _fits(document, strict=False)


def test_a_good_manifest_is_read_without_jsonschema() -> None:
    program = (
        "import sys; from lifecycle.manifest import load; load('manifests/teleop.lifecycle.yaml');"
        "sys.exit('jsonschema' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", program], cwd=ROOT, check=False).returncode == 0
