"""Schemas of results are those of the types: `make schemas` writes them."""

from __future__ import annotations

import importlib.util
import json
import sys
from pathlib import Path
from types import ModuleType

import jsonschema
import pytest

FOLDER = Path(__file__).parents[2] / "schemas"
FILES = {each.name.removesuffix(".v1.schema.json"): each for each in FOLDER.glob("*.schema.json")}


def _generator() -> ModuleType:
    spec = importlib.util.spec_from_file_location("schemas_generate", FOLDER / "generate.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # where dataclasses look their annotations up
    spec.loader.exec_module(module)
    return module


GENERATOR = _generator()


def test_each_schema_is_generated_or_written_by_hand_for_a_reason() -> None:
    by_hand = {
        "manifest": "it is what users write; the types are made from it",
        "graph_message": "version and kind stand beside the fields of each message",
    }
    assert by_hand == GENERATOR.BY_HAND
    assert {*FILES} == {*GENERATOR.RESULTS, *by_hand}


@pytest.mark.parametrize("name", sorted(GENERATOR.RESULTS))
def test_a_committed_schema_is_what_its_type_says(name: str) -> None:
    assert FILES[name].read_text(encoding="utf-8") == GENERATOR.generate(name), "run `make schemas`"


@pytest.mark.parametrize("name", sorted(FILES))
def test_every_schema_is_one_of_draft_2020_12_and_knows_its_name(name: str) -> None:
    schema = json.loads(FILES[name].read_text(encoding="utf-8"))
    jsonschema.Draft202012Validator.check_schema(schema)
    assert schema["$id"] == f"urn:ros-lifecycle-manifests:{name}:v1"
