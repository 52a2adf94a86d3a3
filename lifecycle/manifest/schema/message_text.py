"""The words of messages about values that do not fit the schema.

Owns: what is allowed, said by a schema's keywords, in a phrase; the nearest spelling. Every
message starts with "cannot" and quotes the value. Pure.
"""

from __future__ import annotations

import difflib
from collections.abc import Collection, Iterable, Mapping
from typing import Any

from lifecycle.manifest.schema.violation import Violation
from lifecycle.manifest.yaml.scalars import YAML_1_1_BOOLEANS, has_leading_zero, quote

_TYPES = {
    "string": "a string",
    "integer": "an integer",
    "number": "a number",
    "boolean": "true or false",
    "array": "a list",
    "object": "a mapping",
    "null": "null",
}


MAX_WORDS = 500
"""Words among which a nearest one is looked for; among more it would take longer than it helps."""


def nearest(word: str, known: Collection[str]) -> str:
    """Return the known word that `word` was most probably meant to be; empty if none is near."""
    if len(known) > MAX_WORDS:
        return ""
    spelled = {each.lower(): each for each in known}
    close = difflib.get_close_matches(word.lower(), spelled, n=1, cutoff=0.6)
    return spelled[close[0]] if close else ""


def did_you_mean(word: str, known: Collection[str]) -> str:
    """Return a question for a hint; empty if no known word is near."""
    found = nearest(word, known)
    return f"did you mean {found!r}?" if found else ""


def unknown_key(key: str, known: Iterable[str]) -> tuple[str, str]:
    """Return message and hint for a key that the schema does not know."""
    words = list(known)
    message = f"cannot use the unknown key {quote(key)}; allowed: {', '.join(words)}"
    return message, did_you_mean(key, words)


def missing_key(key: str, schema: Mapping[str, Any]) -> tuple[str, str]:
    """Return message and hint for a key that must be there."""
    example = (schema.get("examples") or [schema.get("const", "…")])[0]
    return f"cannot do without the key {key!r}", f"add '{key}: {example}'"


def bad_key(each: Violation) -> tuple[str, str]:
    """Return message and hint for a key whose spelling is not allowed."""
    return f"cannot use {quote(each.value)} as a key here", _pattern(each.schema)


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
    """Say what the broken keyword allows, and a hint."""
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
    """Word a failed choice between ways to fill a mapping."""
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
    """Say which types are allowed, and how to get there from `value`."""
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
    lower = f"more than {above}" if above is not None else f"{low}"
    upper = f"at most {high}" if above is not None else f"{high}"
    return f"{lower}, {upper}" if above is not None else f"{lower} to {upper}"


def _closest(value: object, allowed: list[object]) -> str:
    words = [each for each in allowed if isinstance(each, str)]
    return did_you_mean(value, words) if isinstance(value, str) else ""


def _pattern(schema: Mapping[str, Any]) -> str:
    return str(schema.get("patternErrorMessage") or f"it must match {schema.get('pattern')}")


def _spell(values: Iterable[object]) -> str:
    return ", ".join(each if isinstance(each, str) else quote(each) for each in values)


def _listed(types: str | list[str]) -> list[str]:
    return [types] if isinstance(types, str) else types
