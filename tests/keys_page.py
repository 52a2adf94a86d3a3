"""Write docs/keys.md, every key of a manifest, from the schema of a manifest: `make schemas`."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs/keys.md"

_Schema = Mapping[str, Any]
_HEAD = """# Keys of a manifest

After reading this page you can look up every key of a manifest: where it may be written, its values
and its default.

This page is made from `schemas/manifest.v1.schema.json`, which editors use.
[manifest.md](manifest.md) has examples. `$(…)` may be written where a value is no
free text. A key without a default may be left out unless it is *required*.
"""
_SIMPLE = {
    "string": "text",
    "integer": "integer",
    "number": "number",
    "boolean": "`true`, `false`",
    "null": "nothing",
    "object": "mapping",
}


def page(schema: _Schema) -> str:
    """Return the text of the page: a section for the document and for each type below it."""
    sections = [_HEAD, *_section("The document", "", schema, schema["description"])]
    for name, where in sorted(_places(schema).items(), key=lambda each: each[1][0]):
        type_ = schema["$defs"][name]
        places = ", ".join(f"`{each}`" for each in where)
        sections += _section(_title(name), f"In {places}.", type_, type_.get("description", ""))
    return "\n".join(sections) + "\n"


def _title(name: str) -> str:
    return name.removesuffix("Keys")


def _section(title: str, where: str, type_: _Schema, text: str) -> Iterator[str]:
    yield f"\n## {title}\n"
    yield f"{where} {text}".strip()
    if "properties" not in type_:
        yield f"\nA value is {_value(type_)}."
        return
    yield "\n| key | value | default | |"
    yield "|---|---|---|---|"
    for key, value in type_["properties"].items():
        default = "*required*" if key in type_.get("required", ()) else _default(value)
        text = value.get("description", "").replace("|", "\\|")
        yield f"| `{key}` | {_value(value)} | {default} | {text} |"


def _default(value: _Schema) -> str:
    return f"`{json.dumps(value['default'])}`" if "default" in value else ""


def _value(value: _Schema) -> str:
    """Return what may be written, in the fewest terms."""
    if "$ref" in value:
        name = value["$ref"].rpartition("/")[2]
        title = _title(name)
        return f"[{title}](#{title.lower()})"
    if "anyOf" in value:
        branches = [each for each in value["anyOf"] if each.get("$ref") != "#/$defs/substitution"]
        return " or ".join(dict.fromkeys(map(_value, branches))) or "text"
    if "const" in value:
        return f"`{value['const']}`"
    if "enum" in value:
        return ", ".join(dict.fromkeys(f"`{each}`" for each in value["enum"]))
    kind = value.get("type", "object")
    if isinstance(kind, list):
        return "scalar"
    if kind == "array":
        return f"list of {_value(value['items'])}"
    if isinstance(value.get("additionalProperties"), Mapping):
        return f"mapping of names to {_value(value['additionalProperties'])}"
    return f"{_SIMPLE[kind]}{_range(value)}"


def _range(value: _Schema) -> str:
    low, high = value.get("minimum"), value.get("maximum")
    above = value.get("exclusiveMinimum")
    parts = [
        *([f"> {above:g}"] if above is not None else []),
        *([f"≥ {low:g}"] if low is not None else []),
        *([f"≤ {high:g}"] if high is not None else []),
    ]
    return f" {', '.join(parts)}" if parts else ""


def _places(schema: _Schema) -> dict[str, list[str]]:
    """Return where each named type may be written, at most three places."""
    found: dict[str, list[str]] = {}
    queue: list[tuple[str, _Schema]] = [("", schema)]
    while queue:
        path, type_ = queue.pop(0)
        for inner, name in _references(path, type_):
            places = found.setdefault(name, [])
            if not places:
                queue.append((inner, schema["$defs"][name]))
            if inner not in places and len(places) < 3:
                places.append(inner)
    return found


def _references(path: str, value: Any) -> Iterator[tuple[str, str]]:
    if isinstance(value, list):
        for each in value:
            yield from _references(path, each)
    if not isinstance(value, Mapping):
        return
    if "$ref" in value and not value["$ref"].endswith("/substitution"):
        yield path or ".", value["$ref"].rpartition("/")[2]
    for key, each in value.get("properties", {}).items():
        yield from _references(f"{path}.{key}".strip("."), each)
    if isinstance(value.get("additionalProperties"), Mapping):
        yield from _references(f"{path}.NAME", value["additionalProperties"])
    if "items" in value:
        yield from _references(f"{path}[]", value["items"])
    yield from _references(path, value.get("anyOf"))


if __name__ == "__main__":
    manifest = ROOT / "schemas/manifest.v1.schema.json"
    PAGE.write_text(page(json.loads(manifest.read_text("utf-8"))), encoding="utf-8")
