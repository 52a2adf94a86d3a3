"""Validate a document against its JSON Schema, with diagnostics that people can act on.

Owns: loading the shipped schemas; turning each violation into one `Diagnostic`, for the branch that
was meant where a choice failed; the wording: what is allowed, derived from a schema's keywords, and
the nearest spelling. Every message starts with "cannot" and quotes the value. Also the adapter
around jsonschema's `ValidationError`, whose fields are untyped and optional; and the quick look by
which a document that fits needs no jsonschema. Pure but for reading the shipped schemas.
"""

from __future__ import annotations

import functools
import itertools
import json
from collections.abc import Collection, Iterable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from lifecycle.errors import did_you_mean, nearest
from lifecycle.manifest import written
from lifecycle.manifest.diagnostics import Diagnostic
from lifecycle.manifest.yaml.document import Document, Place, error
from lifecycle.manifest.yaml.yaml_parser import (
    MAX_FINDINGS,
    YAML_1_1_BOOLEANS,
    has_leading_zero,
    quote,
)

if TYPE_CHECKING:  # it costs 60 ms, and who only asks for a similar name needs none of it
    from jsonschema import Draft202012Validator
    from jsonschema.exceptions import ValidationError


class Violation(msgspec.Struct, frozen=True, kw_only=True):
    """A value that breaks one keyword.

    Attributes:
        keyword: the broken keyword, `enum`.
        operand: what the schema has for that keyword.
        schema: the subschema that holds the keyword.
        value: the offending value.
        place: path of that value.
        is_key: the value is a key of the mapping at `place`.
        name: the key, known to the schema, of the value; empty where the user
            chooses keys, and in lists.
        branches: for `anyOf` and `oneOf`, what each branch has against the value.
    """

    keyword: str
    operand: Any
    schema: Mapping[str, Any]
    value: Any
    place: Place
    is_key: bool
    name: str = ""
    branches: tuple[tuple[Violation, ...], ...] = ()

    @property
    def is_way(self) -> bool:
        """A choice between ways to fill a mapping, each a list of required keys."""
        return self.keyword in {"anyOf", "oneOf"} and all("required" in x for x in self.operand)


def violations(errors: Iterable[ValidationError]) -> Iterator[Violation]:
    """Type each error; a failed choice becomes the violations of the branch that was meant."""
    for each in errors:
        violation = _typed(each)
        meant = _meant(violation)
        if meant is None:
            yield violation
        else:
            yield from meant


def _typed(each: ValidationError) -> Violation:
    groups: dict[Any, list[ValidationError]] = {}
    for inner in each.context or ():
        groups.setdefault(inner.relative_schema_path[0], []).append(inner)
    schema = each.schema
    return Violation(
        keyword=str(each.validator),
        operand=each.validator_value,
        schema=schema if isinstance(schema, Mapping) else {},
        value=each.instance,
        place=tuple(each.absolute_path),
        is_key="propertyNames" in each.absolute_schema_path,
        name=_name(each),
        branches=tuple(tuple(violations(group)) for group in groups.values()),
    )


def _name(each: ValidationError) -> str:
    if not each.absolute_path:
        return ""
    last, path = each.absolute_path[-1], list(each.absolute_schema_path)
    known = any(pair == ("properties", last) for pair in itertools.pairwise(path))
    return last if known and isinstance(last, str) else ""


def _meant(choice: Violation) -> tuple[Violation, ...] | None:
    """Return what the one branch violates whose type fits the value; None if no single one fits."""
    fitting = [
        branch
        for branch in choice.branches
        if not any(
            each.keyword in {"type", "required", "not"} and each.place == choice.place
            for each in branch
        )
    ]
    return fitting[0] if len(fitting) == 1 else None


_TYPES = {
    "string": "a string",
    "integer": "an integer",
    "number": "a number",
    "boolean": "true or false",
    "array": "a list",
    "object": "a mapping",
    "null": "null",
}


def unknown_key(key: str, known: Iterable[str]) -> tuple[str, str]:
    """Return message and hint for a key that the schema does not know."""
    words = list(known)
    if key in _GONE:
        why, hint = _GONE[key]
        return f"cannot use {quote(key)} any more: {why}", hint
    message = f"cannot use the unknown key {quote(key)}"
    near = did_you_mean(key, words)
    return (message, near) if near else (f"{message}; allowed: {', '.join(words)}", "")


def missing_key(key: str, schema: Mapping[str, Any]) -> tuple[str, str]:
    """Return message and hint for a key that must be there."""
    example = (schema.get("examples") or [schema.get("const", "…")])[0]
    return f"cannot do without the key {key!r}", f"add '{key}: {example}'"


_GONE = {
    "on_supervisor_lost": (
        "nodes whose supervisor is gone are deactivated, and their process ends",
        "remove it",
    ),
    "on_violation": ("a link has none", "write it at one of its nodes, or for the system"),
}
"""Keys of earlier versions: what holds without them, and what to do."""


def bad_key(each: Violation) -> tuple[str, str]:
    """Return message and hint for a key whose spelling is not allowed."""
    meant = _closest(each.value, each.operand) if each.keyword == "enum" else ""
    return f"cannot use {quote(each.value)} as a key here", meant or _pattern(each.schema)


def bad_value(each: Violation) -> tuple[str, str]:
    """Return message and hint for a value that breaks one keyword of its schema."""
    if each.is_way:
        return _way(each)
    name = each.name
    if each.keyword in {"minItems", "minProperties", "minLength"}:
        return f"cannot leave {name or 'this'} empty", ""
    subject = (
        f"cannot use {name} {quote(each.value)}" if name else f"cannot use {quote(each.value)}"
    )
    if isinstance(each.value, (list, dict)) and name:
        subject = f"cannot use {quote(each.value)} as {name}"
    allowed, hint = _allowed(each)
    return f"{subject}; {allowed}" if allowed else subject, hint


def _allowed(each: Violation) -> tuple[str, str]:
    """Return what the broken keyword allows, and a hint."""
    if each.keyword in {"oneOf", "anyOf"}:
        own = [inner for branch in each.branches for inner in branch if inner.place == each.place]
        types = [
            name for inner in own if inner.keyword == "type" for name in _listed(inner.operand)
        ]
        return _types(each.value, types)
    if each.keyword == "type":
        return _types(each.value, _listed(each.operand))
    if each.keyword in {"enum", "const"}:
        allowed = [each.operand] if each.keyword == "const" else each.operand
        return f"allowed: {_spell(allowed)}", _closest(each.value, allowed)
    if each.keyword == "pattern":
        return "", _pattern(each.schema)
    return f"allowed: {_range(each.schema)}", ""


def _way(each: Violation) -> tuple[str, str]:
    """Describe a failed choice between ways to fill a mapping."""
    ways: list[list[str]] = [branch["required"] for branch in each.operand]
    given = [key for key in each.value if any(key in way for way in ways)]
    only = "exactly one" if each.keyword == "oneOf" else "at least one"
    spelled = ", ".join(" with ".join(way) for way in ways)
    whole = [way for way in ways if all(key in given for key in way)]
    if not whole and given:
        missing = next(key for way in ways if given[0] in way for key in way if key not in given)
        return f"cannot use {given[0]} without {missing}", f"add '{missing}: …'"
    if given:
        words = f"{', '.join(given[:-1])} and {given[-1]}"
        return f"cannot use {words} together", f"give {only} of {spelled}"
    return f"cannot do without any of {spelled}", f"give {only} of them"


def _types(value: object, types: list[str]) -> tuple[str, str]:
    """Return which types are allowed, and how to get there from `value`."""
    words = [_TYPES[each] for each in types if not (each == "integer" and "number" in types)]
    words = list(dict.fromkeys(words))
    joined = " or ".join([", ".join(words[:-1]), words[-1]] if len(words) > 1 else words)
    hint = ""
    if types == ["boolean"] and isinstance(value, str) and value in YAML_1_1_BOOLEANS:
        hint = "YAML 1.2 has no other words for them"
    elif isinstance(value, str) and has_leading_zero(value) and {"integer", "number"} & {*types}:
        hint = "write it without the leading 0, which versions of YAML read differently"
    elif types == ["string"] and isinstance(value, (bool, int, float)):
        hint = "put it in quotes"
    return f"it must be {joined}", hint


def _range(schema: Mapping[str, Any]) -> str:
    low, above, high = (schema.get(k) for k in ("minimum", "exclusiveMinimum", "maximum"))
    below = schema.get("exclusiveMaximum")
    lower = f"more than {above}" if above is not None else f"{low}"
    upper = f"less than {below}" if below is not None else f"at most {high}"
    return f"{lower}, {upper}" if above is not None else f"{lower} to {high}"


def _closest(value: object, allowed: list[object]) -> str:
    words = [each for each in allowed if isinstance(each, str)]
    return did_you_mean(value, words) if isinstance(value, str) else ""


def _pattern(schema: Mapping[str, Any]) -> str:
    return str(schema.get("patternErrorMessage") or f"it must match {schema.get('pattern')}")


def _spell(values: Iterable[object]) -> str:
    return ", ".join(each if isinstance(each, str) else quote(each) for each in values)


def _listed(types: str | list[str]) -> list[str]:
    return [types] if isinstance(types, str) else types


MANIFEST = "manifest.v1.schema.json"
"""The file, in schemas/, that defines what a manifest may hold."""

_SUBSTITUTION = {"$ref": "#/$defs/substitution"}


@functools.cache
def read_schema(name: str) -> Mapping[str, Any]:
    """Return a shipped schema as it is in schemas/, for editors and for other programs."""
    # Wheels hold a copy of schemas/; a checkout holds a link to it.
    # Found as `importlib.resources` finds it, which takes longer to import than to read it.
    text = (Path(__file__).parents[1] / "_schemas" / name).read_text(encoding="utf-8")
    schema: Mapping[str, Any] = json.loads(text)
    return schema


def validate(
    document: Document,
    *,
    definition: str = "",
    ignore: Collection[Place] = (),
    is_resolved: bool = True,
) -> tuple[tuple[Place, Diagnostic], ...]:
    """Check a document.

    Args:
        document: what to check.
        definition: name of a type in `written`, for a part of a manifest; the whole if empty.
        ignore: values already reported; nothing is reported about them or anything inside.
        is_resolved: its substitutions are; of one that is left out they never will be.

    Returns:
        Every violation and the value it is about, at most `MAX_FINDINGS`, in no particular order.
    """
    found: list[tuple[Place, Diagnostic]] = []
    seen: set[tuple[Place, str]] = set()
    type_ = getattr(written, definition or "Manifest")
    if is_resolved and not ignore and _fits(document, type_):
        return ()
    plain = document.plain()
    errors = validator(definition, is_resolved).iter_errors(plain)
    broken = list(violations(errors))
    enums = {each.place for each in broken if each.keyword == "enum"}
    # The allowed values are more precise than that they are strings.
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


_NULL = object()
"""What stands for null where a document is read: no value of a manifest may be that."""


def _fits(document: Document, type_: type) -> bool:
    try:
        written.read(document.root.plain(null=_NULL), type_)
    except msgspec.ValidationError:
        return False
    return True


@functools.cache
def validator(definition: str, is_resolved: bool) -> Draft202012Validator:
    """Return what asks jsonschema about a part of a manifest; the arguments are `validate`'s."""
    from jsonschema import Draft202012Validator

    return Draft202012Validator(_schema(definition, is_resolved))


@functools.cache
def _schema(definition: str, is_resolved: bool) -> Mapping[str, Any]:
    whole = read_schema(MANIFEST)
    schema = _resolved_only(whole) if is_resolved else whole
    assert isinstance(schema, dict)
    if definition:
        schema = {"$defs": schema["$defs"], "$ref": f"#/$defs/{definition}"}
    return schema


def _resolved_only(schema: object) -> object:
    """Return the schema of documents without substitutions.

    Editors see the document before substitution, so that the shipped schema lets `$(arg x)` be
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
            message, hint = bad_key(each)
            yield place, error("manifest.key", document.key_at(place), message, hint)
        elif not (
            each.is_way and _misspelt(each) & {k for x in each.operand for k in x["required"]}
        ):
            rule = _RULES.get(each.keyword, "value")
            message, hint = bad_value(each)
            yield place, error(f"manifest.{rule}", document.at(place), message, hint)


_RULES = {"type": "type", "oneOf": "choice", "anyOf": "choice", "pattern": "pattern"}


def _unknown_keys(document: Document, each: Violation) -> Iterator[tuple[Place, Diagnostic]]:
    known = list(each.schema["properties"])
    for key in each.value:
        if key not in known:
            place = (*each.place, key)
            message, hint = unknown_key(key, known)
            yield place, error("manifest.unknown-key", document.key_at(place), message, hint)


def _missing_keys(document: Document, each: Violation) -> Iterator[tuple[Place, Diagnostic]]:
    known = each.schema.get("properties", {})
    for key in each.operand:
        if key not in each.value and key not in _misspelt(each):
            message, hint = missing_key(key, known.get(key, {}))
            at = document.key_at(each.place)
            yield (*each.place, key), error("manifest.missing-key", at, message, hint)


def _misspelt(each: Violation) -> set[str]:
    """Return the known keys that unknown ones probably mean: the unknown key is finding enough."""
    known = each.schema.get("properties", {})
    return {nearest(key, known) for key in each.value if key not in known}
