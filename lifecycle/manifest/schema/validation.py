"""A document against its JSON Schema → diagnostics that people can act on.

Owns: loading the shipped schemas and turning each violation into one `Diagnostic`; the words are
`wording`'s, and `violation` picks the branch that was meant where a choice failed.
Pure but for reading the shipped schemas.
"""

from __future__ import annotations

import functools
import json
from collections.abc import Collection, Iterable, Iterator, Mapping
from importlib import resources
from typing import Any

import jsonschema

from lifecycle.manifest.diagnostics import Diagnostic
from lifecycle.manifest.schema import message_text
from lifecycle.manifest.schema.violation import Violation, violations
from lifecycle.manifest.yaml.document import Document, Place, error
from lifecycle.manifest.yaml.yaml_parser import MAX_FINDINGS

MANIFEST = "manifest.v1.schema.json"
"""The file, in schemas/, that says what a manifest may hold."""

_SUBSTITUTION = {"$ref": "#/$defs/substitution"}


@functools.cache
def read_schema(name: str) -> Mapping[str, Any]:
    """Return a shipped schema as it is in schemas/, for editors and for other programs."""
    # Wheels hold a copy of schemas/; a checkout holds a link to it.
    text = (resources.files("lifecycle") / "_schemas" / name).read_text(encoding="utf-8")
    schema: Mapping[str, Any] = json.loads(text)
    return schema


def validate(
    document: Document, *, definition: str = "", ignore: Collection[Place] = ()
) -> tuple[tuple[Place, Diagnostic], ...]:
    """Check a document whose substitutions are resolved.

    Args:
        document: what to check.
        definition: name under `$defs` of the manifest's schema, for a part of a manifest that
            stands in a file of its own; the whole manifest if empty.
        ignore: values already reported; nothing is said about them or anything inside.

    Returns:
        Every violation and the value it is about, at most `MAX_FINDINGS`, in no particular order.
    """
    found: list[tuple[Place, Diagnostic]] = []
    seen: set[tuple[Place, str]] = set()
    errors = _validator(definition).iter_errors(document.root.plain())
    broken = list(violations(errors))
    enums = {each.place for each in broken if each.keyword == "enum"}
    # The words allowed say more than that they are strings.
    broken = [each for each in broken if not (each.keyword == "type" and each.place in enums)]
    # `required` holds for everything that is no mapping, so that several ways seem to be taken.
    broken = [each for each in broken if isinstance(each.value, dict) or not each.is_way]
    for place, diagnostic in _diagnose(document, broken):
        if (place, diagnostic.message) in seen or _inside(place, ignore):
            continue
        if len(found) == MAX_FINDINGS:
            message = f"cannot list more than {MAX_FINDINGS} findings"
            found.append(
                ((), error("manifest.too-many", document.at(), message, "fix these first"))
            )
            break
        seen.add((place, diagnostic.message))
        found.append((place, diagnostic))
    return tuple(found)


@functools.cache
def _validator(definition: str) -> jsonschema.Draft202012Validator:
    schema = _resolved_only(read_schema(MANIFEST))
    assert isinstance(schema, dict)
    if definition:
        schema = {"$defs": schema["$defs"], "$ref": f"#/$defs/{definition}"}
    return jsonschema.Draft202012Validator(schema)


def _resolved_only(schema: object) -> object:
    """Return the schema of documents without substitutions.

    Editors see the document before substitution, so that the shipped schema lets `$(arg x)` stand
    where a number must; the loader checks what it became.
    """
    if isinstance(schema, list):
        return [_resolved_only(each) for each in schema]
    if not isinstance(schema, dict):
        return schema
    result = {key: _resolved_only(value) for key, value in schema.items()}
    branches = result.get("anyOf")
    if isinstance(branches, list) and _SUBSTITUTION in branches:
        branches = [each for each in branches if each != _SUBSTITUTION]
        del result["anyOf"]
        result.update(branches[0] if len(branches) == 1 else {"anyOf": branches})
    pattern = result.get("pattern")
    if isinstance(pattern, str):
        # Python's `$` also matches before a last line break, ECMA 262's does not.
        result["pattern"] = pattern[:-1] + r"\Z" if pattern.endswith("$") else pattern
    return result


def _inside(place: Place, places: Collection[Place]) -> bool:
    return any(place[: len(each)] == each for each in places)


def _diagnose(document: Document, found: Iterable[Violation]) -> Iterator[tuple[Place, Diagnostic]]:
    for each in found:
        place = each.place
        if each.keyword == "additionalProperties":
            yield from _unknown_keys(document, each)
        elif each.keyword == "required":
            yield from _missing_keys(document, each)
        elif each.is_key:
            place = (*place, str(each.value))
            message, hint = message_text.bad_key(each)
            yield place, error("manifest.key", document.key_at(place), message, hint)
        elif not (
            each.is_way and _misspelt(each) & {k for x in each.operand for k in x["required"]}
        ):
            rule = _RULES.get(each.keyword, "value")
            message, hint = message_text.bad_value(each)
            yield place, error(f"manifest.{rule}", document.at(place), message, hint)


_RULES = {"type": "type", "oneOf": "choice", "anyOf": "choice", "pattern": "pattern"}


def _unknown_keys(document: Document, each: Violation) -> Iterator[tuple[Place, Diagnostic]]:
    known = list(each.schema["properties"])
    for key in each.value:
        if key not in known:
            place = (*each.place, key)
            message, hint = message_text.unknown_key(key, known)
            yield place, error("manifest.unknown-key", document.key_at(place), message, hint)


def _missing_keys(document: Document, each: Violation) -> Iterator[tuple[Place, Diagnostic]]:
    known = each.schema.get("properties", {})
    for key in each.operand:
        if key not in each.value and key not in _misspelt(each):
            message, hint = message_text.missing_key(key, known.get(key, {}))
            at = document.key_at(each.place)
            yield (*each.place, key), error("manifest.missing-key", at, message, hint)


def _misspelt(each: Violation) -> set[str]:
    """Return the known keys that unknown ones stand for: the unknown key is finding enough."""
    known = each.schema.get("properties", {})
    return {message_text.nearest(key, known) for key in each.value if key not in known}
