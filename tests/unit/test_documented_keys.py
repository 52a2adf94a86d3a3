"""Keys of the manifest are written in documents and messages as the schema has them."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).parents[2]
SCHEMA = json.loads((ROOT / "schemas/manifest.v1.schema.json").read_text(encoding="utf-8"))
BLOCKS = ("data_layer", "discovery", "policy")
_BLOCK = re.compile(rf"\b({'|'.join(BLOCKS)}): (\{{[^{{}}$]*\}})")
_DOTTED = re.compile(rf"\b({'|'.join(BLOCKS)})\.(\w+): (\w+)")


def _written() -> list[tuple[str, str, str]]:
    """Every (file, block, mapping) that is spelled out somewhere."""
    found = []
    places = [ROOT / "README.md", *(ROOT / "docs").glob("*.md"), *ROOT.glob("lifecycle/**/*.py")]
    for path in places:
        text = path.read_text(encoding="utf-8")
        name = str(path.relative_to(ROOT))
        found += [(name, block, mapping) for block, mapping in _BLOCK.findall(text)]
        found += [
            (name, block, f"{{{key}: {value}}}") for block, key, value in _DOTTED.findall(text)
        ]
    return sorted(set(found))


def _properties(block: str) -> dict[str, dict[str, object]]:
    declared = SCHEMA["properties"][block]
    if "$ref" in declared:
        declared = SCHEMA["$defs"][declared["$ref"].rpartition("/")[2]]
    properties: dict[str, dict[str, object]] = declared["properties"]
    return properties


@pytest.mark.parametrize(("file", "block", "mapping"), _written())
def test_a_key_that_is_written_somewhere_is_one(file: str, block: str, mapping: str) -> None:
    properties = _properties(block)
    for key, value in yaml.safe_load(mapping).items():
        assert key in properties, f"{file}: {block}.{key}"
        allowed = properties[key].get("enum")
        assert not isinstance(allowed, list) or value in allowed, f"{file}: {block}.{key}: {value}"
