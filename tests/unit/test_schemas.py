"""Schemas of results are those of the types: `make schemas` writes them."""

from __future__ import annotations

import json
from pathlib import Path

import jsonschema
import pytest

from tests import result_schemas

FOLDER = Path(__file__).parents[2] / "schemas"
FILES = {each.name.removesuffix(".v1.schema.json"): each for each in FOLDER.glob("*.schema.json")}


def test_a_committed_schema_is_what_its_type_says() -> None:
    committed = {name: file.read_text(encoding="utf-8") for name, file in FILES.items()}
    assert committed == result_schemas.texts(), "run `make schemas`"


@pytest.mark.parametrize("name", sorted(FILES))
def test_every_schema_is_one_of_draft_2020_12_and_knows_its_name(name: str) -> None:
    schema = json.loads(FILES[name].read_text(encoding="utf-8"))
    jsonschema.Draft202012Validator.check_schema(schema)
    assert schema["$id"] == f"urn:ros-lifecycle-manifests:{name}:v1"
