"""Validate a document against its JSON Schema, with diagnostics that people can act on.

Owns: loading the shipped schemas; turning each error of jsonschema into diagnostics, for the branch
that was meant where a choice failed; their wording, from a schema's keywords, and the nearest
spelling. A document that fits is found so by msgspec alone.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Collection, Iterable, Iterator, Mapping
from typing import Any

import msgspec

from lifecycle.errors import did_you_mean, nearest
from lifecycle.manifest import written
from lifecycle.manifest.diagnostics import Diagnostic, error
from lifecycle.manifest.written import MANIFEST, read_schema
from lifecycle.manifest.yaml.document import (
    YAML_1_1_BOOLEANS,
    Document,
    Place,
    has_leading_zero,
    quote,
)
from lifecycle.manifest.yaml.source import MAX_FINDINGS

ValidationError = Any
"""jsonschema's, which has no types for what it holds; it takes 60 ms to import."""

_CHOICES = ("anyOf", "oneOf")


_SUBSTITUTION = {"$ref": "#/$defs/substitution"}


def validate(
    document: Document,
    *,
    definition: str = "",
    ignore: Collection[Place] = (),
) -> tuple[Diagnostic, ...]:
    """Return every violation of the schema, at most `MAX_FINDINGS`, in no particular order.

    Args:
        document: what to check.
        definition: name of a type in `written`, for a part of a manifest; the whole if empty.
        ignore: values already reported; nothing is reported about them or anything inside.
    """
    type_ = getattr(written, definition or "Manifest")
    if not ignore and _fits(document, type_):
        return ()
    errors = list(_meant(validator(definition).iter_errors(document.plain())))
    enums = {_place(each) for each in errors if each.validator == "enum"}
    found: dict[Diagnostic, None] = {}
    for each in errors:
        if each.validator == "type" and _place(each) in enums:
            continue  # the allowed values are more precise than that they are strings
        if _is_way(each) and not isinstance(each.instance, dict):
            continue  # `required` holds for what is no mapping: several ways seem to be taken
        for place, diagnostic in _diagnose(document, each):
            if diagnostic in found or any(place[: len(known)] == known for known in ignore):
                continue
            if len(found) == MAX_FINDINGS:
                message = f"cannot list more than {MAX_FINDINGS} findings"
                many = error("manifest.too-many", document.at(), message, "fix these first")
                return (*found, many)
            found[diagnostic] = None
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
def validator(definition: str = "") -> Any:
    """Return a Draft202012Validator of a part of a manifest; `definition` as in `validate`."""
    from jsonschema import Draft202012Validator

    schema = _resolved_only(read_schema(MANIFEST))
    assert isinstance(schema, dict)
    if definition:
        schema = {"$defs": schema["$defs"], "$ref": f"#/$defs/{definition}"}
    return Draft202012Validator(schema)


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


def _meant(errors: Iterable[ValidationError]) -> Iterator[ValidationError]:
    """Yield each error; of a failed choice those of the one branch whose type fits the value."""
    for choice in errors:
        branches: dict[object, list[ValidationError]] = {}
        for each in choice.context or ():
            branches.setdefault(each.relative_schema_path[0], []).append(each)
        resolved = [list(_meant(each)) for each in branches.values()]
        fitting = [branch for branch in resolved if not any(_is_unlike(choice, x) for x in branch)]
        yield from fitting[0] if len(fitting) == 1 else [choice]


def _is_unlike(choice: ValidationError, each: ValidationError) -> bool:
    """Whether an error says that the branch of a choice is for values of another kind."""
    return each.validator in ("type", "required", "not") and _place(each) == _place(choice)


def _place(each: ValidationError) -> Place:
    return tuple(each.absolute_path)


def _is_way(each: ValidationError) -> bool:
    """Whether it is a choice between ways to fill a mapping, each a list of required keys."""
    return each.validator in _CHOICES and all("required" in x for x in each.validator_value)


def _diagnose(document: Document, each: ValidationError) -> Iterator[tuple[Place, Diagnostic]]:
    """Yield what an error says, and the place of the value that each finding is about."""
    place = _place(each)
    if each.validator == "additionalProperties":
        yield from _unknown_keys(document, each)
    elif each.validator == "required":
        yield from _missing_keys(document, each)
    elif "propertyNames" in each.absolute_schema_path:
        place = (*place, str(each.instance))
        meant = _closest(each.instance, each.validator_value) if each.validator == "enum" else ""
        message, hint = f"cannot use {quote(each.instance)} as a key here", meant or _pattern(each)
        yield place, error("manifest.key", document.key_at(place), message, hint)
    elif not _is_way(each):
        rule = _RULES.get(str(each.validator), "value")
        yield place, error(f"manifest.{rule}", document.at(place), *_value(each))
    elif not _misspelt(each) & {key for way in each.validator_value for key in way["required"]}:
        yield place, error("manifest.choice", document.at(place), *_way(each))


_RULES = {"type": "type", "oneOf": "choice", "anyOf": "choice", "pattern": "pattern"}


def _known(each: ValidationError) -> Mapping[str, Any]:
    """Return the keys that the mapping of an error may have, and their schemas."""
    known: Mapping[str, Any] = each.schema.get("properties", {})
    return known


def _unknown_keys(document: Document, each: ValidationError) -> Iterator[tuple[Place, Diagnostic]]:
    known = _known(each)
    for key in each.instance:
        if key in known:
            continue
        place, message = (*_place(each), key), f"cannot use the unknown key {quote(key)}"
        other = _OTHERS.get(key)
        hint = f"write '{other}'" if other else did_you_mean(key, known)
        value = each.instance[key]
        if "nodes" in known and isinstance(value, dict) and "run" in value:
            hint = "a node is indented below 'nodes:'"
        if not hint:
            message = f"{message}; allowed: {', '.join(known)}"
        yield place, error("manifest.unknown-key", document.key_at(place), message, hint)


_OTHERS = {
    "latched": "durability: TRANSIENT_LOCAL",
    "queue_size": "depth",
    "pkg": "run: {package: …}",
    "exec": "run: {executable: …}",
    "plugin": "run: {component: …}",
    "args": "run: {command: …}",
    "cwd": "run: {working_directory: …}",
    "env": "run: {environment: …}",
    "remappings": "remap",
    "params": "parameters",
    "respawn": "restart: always' beside 'run",
    "respawn_delay": "restart_sec",
}
"""What launch files and client libraries say otherwise, and how a manifest writes it."""


def _missing_keys(document: Document, each: ValidationError) -> Iterator[tuple[Place, Diagnostic]]:
    place, known = _place(each), _known(each)
    for key in each.validator_value:
        if key not in each.instance and key not in _misspelt(each):
            schema = known.get(key, {})
            example = (schema.get("examples") or [schema.get("const", "…")])[0]
            message, hint = f"cannot do without the key {key!r}", f"add '{key}: {example}'"
            at = document.key_at(place)
            yield (*place, key), error("manifest.missing-key", at, message, hint)


def _misspelt(each: ValidationError) -> set[str]:
    """Return the known keys that unknown ones probably mean: the unknown key is finding enough."""
    known = _known(each)
    return {nearest(key, known) for key in each.instance if key not in known}


def _value(each: ValidationError) -> tuple[str, str]:
    """Return message and hint for a value that breaks one keyword of its schema."""
    name, value = _name(each), each.instance
    if each.validator in {"minItems", "minProperties", "minLength"}:
        return f"cannot leave {name or 'this'} empty", ""
    subject = f"cannot use {name} {quote(value)}" if name else f"cannot use {quote(value)}"
    if isinstance(value, (list, dict)) and name:
        subject = f"cannot use {quote(value)} as {name}"
    allowed, hint = _allowed(each)
    return f"{subject}; {allowed}" if allowed else subject, hint


def _name(each: ValidationError) -> str:
    """Return the key of a value, if the schema knows it; empty where users choose it, in lists."""
    last = each.absolute_path[-1] if each.absolute_path else ""
    steps = itertools.pairwise(each.absolute_schema_path)
    is_known = any(pair == ("properties", last) for pair in steps)
    return last if is_known and isinstance(last, str) else ""


def _allowed(each: ValidationError) -> tuple[str, str]:
    """Return what the broken keyword allows, and a hint."""
    if each.validator in ("type", *_CHOICES):
        own, types = [each], list[str]()
        if each.validator != "type":
            own = [x for x in _meant(each.context or ()) if _place(x) == _place(each)]
        for inner in own:
            listed = inner.validator_value if inner.validator == "type" else []
            types += [listed] if isinstance(listed, str) else listed
        return _types(each, types)
    if each.validator in {"enum", "const"}:
        allowed = [each.validator_value] if each.validator == "const" else each.validator_value
        spelled = ", ".join(x if isinstance(x, str) else quote(x) for x in allowed)
        return f"allowed: {spelled}", _closest(each.instance, allowed)
    if each.validator == "pattern":
        return "", _pattern(each)
    keywords = ("minimum", "exclusiveMinimum", "maximum", "exclusiveMaximum")
    low, above, high, below = map(each.schema.get, keywords)
    is_share = high == 1 and 1 < each.instance <= 100
    hint = f"for {each.instance} % write {each.instance / 100:g}" if is_share else ""
    upper = f"less than {below}" if below is not None else f"at most {high}"
    return (
        f"allowed: {low} to {high}" if above is None else f"allowed: more than {above}, {upper}",
        hint,
    )


def _way(each: ValidationError) -> tuple[str, str]:
    """Describe a failed choice between ways to fill a mapping."""
    ways: list[list[str]] = [branch["required"] for branch in each.validator_value]
    given = [key for key in each.instance if any(key in way for way in ways)]
    only = "exactly one" if each.validator == "oneOf" else "at least one"
    spelled = ", ".join(" with ".join(way) for way in ways)
    whole = [way for way in ways if all(key in given for key in way)]
    if not whole and given:
        missing = next(key for way in ways if given[0] in way for key in way if key not in given)
        return f"cannot use {given[0]} without {missing}", f"add '{missing}: …'"
    if given:
        words = f"{', '.join(given[:-1])} and {given[-1]}"
        return f"cannot use {words} together", f"give {only} of {spelled}"
    return f"cannot do without any of {spelled}", f"give {only} of them"


_TYPES = {
    "string": "a string",
    "integer": "an integer",
    "number": "a number",
    "boolean": "true or false",
    "array": "a list",
    "object": "a mapping",
    "null": "null",
}


def _types(each: ValidationError, types: list[str]) -> tuple[str, str]:
    """Return which types are allowed, and how to get there from the value."""
    value = each.instance
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
    elif isinstance(value, str) and {"integer", "number"} & {*types}:
        hint = _number(value)
    elif types == ["object"] and value is None:
        hint = "indent below it what belongs to it"
    elif _name(each) == "qos" and type(value) is int:
        hint = f"write {{depth: {value}}}"
    elif types == ["object"]:
        key = next(iter((*each.schema.get("required", ()), *_known(each), "NAME")))
        joined += f", as in {{{key}: …}}"
    elif types == ["array"] and isinstance(value, str):
        hint = f"write [{', '.join(value.split())}]"
    elif isinstance(value, dict) and any(key.startswith("-") for key in value):
        hint = "put a text with ': ' in quotes"
    return f"it must be {joined}", hint


def _number(value: str) -> str:
    """Return how to write a number that is in quotes; empty if it is none."""
    try:
        float(value)
    except ValueError:
        return ""
    return f"write {value.strip()}, without quotes"


def _closest(value: object, allowed: list[object]) -> str:
    words = [each for each in allowed if isinstance(each, str)]
    return did_you_mean(value, words) if isinstance(value, str) else ""


def _pattern(each: ValidationError) -> str:
    pattern = each.schema.get("pattern")
    return str(each.schema.get("patternErrorMessage") or f"it must match {pattern}")
