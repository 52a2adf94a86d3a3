"""One broken keyword of a JSON Schema, typed.

Owns: the adapter around jsonschema's `ValidationError`, whose fields are untyped and optional.
Pure.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from jsonschema.exceptions import ValidationError

from lifecycle.manifest.yaml.document import Place


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Violation:
    """A value that breaks one keyword.

    Attributes:
        keyword: the broken keyword, `enum`.
        operand: what the schema has for that keyword.
        schema: the subschema that holds the keyword.
        value: the offending value.
        place: where that value stands.
        is_key: the value is a key of the mapping at `place`.
        name: the key, known to the schema, that the value stands under; empty where the user
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
    """Return what the one branch says whose type fits the value; None if no single one fits."""
    fitting = [
        branch
        for branch in choice.branches
        if not any(
            each.keyword in {"type", "required"} and each.place == choice.place for each in branch
        )
    ]
    return fitting[0] if len(fitting) == 1 else None
