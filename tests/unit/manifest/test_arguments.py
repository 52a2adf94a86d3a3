"""Arguments and substitutions."""

from __future__ import annotations

import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from msgspec.structs import replace

from lifecycle.manifest.yaml.arguments import MAX_TEXT, Substituted, substitute
from lifecycle.manifest.yaml.source import parse
from lifecycle.manifest.yaml.substitutions import Surroundings

NONE: dict[str, str] = {}


NOWHERE = Surroundings(environment={}, folder=".", programs=None)


def _substitute(
    text: str, given: dict[str, str] = NONE, environment: dict[str, str] = NONE
) -> Substituted:
    around = replace(NOWHERE, environment=environment)
    return substitute(parse(text, file="f"), given, around)


def _value(written: str, value: str) -> object:
    """Return what `written` becomes with the argument `x` set to `value`."""
    result = _substitute(f"arguments: {{x: {{}}}}\nv: {written}\n", {"x": value})
    assert result.found == []
    found = result.document.find(("v",))
    assert found is not None
    return found.data


@pytest.mark.parametrize(
    ("written", "value", "expected"),
    [
        ("$(arg x)", "7", 7),
        ("$(arg x)", "1.5", 1.5),
        ("$(arg x)", "true", True),
        ("$(arg x)", "yes", "yes"),
        ("$(arg x)", "null", None),
        ("$(arg x)", "", ""),
        ("$(arg x)", "[1, 2]", "[1, 2]"),
        ("$(arg x)", "a: {b: c}", "a: {b: c}"),
        ("$(arg x)", "*alias", "*alias"),
        ('"$(arg x)"', "7", "7"),
        ("'$(arg x)'", "true", "true"),
        ("|-\n  $(arg x)", "7", "7"),
        ("$(arg x)0", "7", "70"),
        ("$(arg x)$(arg x)", "7", "77"),
        ("a$(arg x)b", "7", "a7b"),
        ("$( arg   x )", "7", 7),
        ("$$(arg x)", "7", "$(arg x)"),
        ("$$(arg x) $(arg x)", "7", "$(arg x) 7"),
        ("$HOME", "7", "$HOME"),
        ("$(arg x)", "$(arg x)", "$(arg x)"),
        ("$(env NOT_SET 7)", "", 7),
        ("$(env NOT_SET 'two words')", "", "two words"),
    ],
)
def test_what_a_substitution_becomes(written: str, value: str, expected: object) -> None:
    found = _value(written, value)
    assert found == expected
    assert type(found) is type(expected)


@given(st.text(st.characters(codec="utf-8")))
@example("$(arg x)")
@example("!!python/object:x {}")
def test_a_quoted_substitution_is_the_given_text_and_nothing_else(value: str) -> None:
    assert _value('"$(arg x)"', value) == value
    assert _value('"<$(arg x)>"', value) == f"<{value}>"


@given(st.text(st.characters(codec="utf-8")))
def test_an_unquoted_substitution_never_adds_structure(value: str) -> None:
    result = _substitute("arguments: {x: {}}\nv: $(arg x)\n", {"x": value})
    found = result.document.find(("v",))
    assert found is not None
    assert not isinstance(found.data, (tuple, dict))
    assert found.data == value or not isinstance(found.data, str) or result.broken == [("v",)]


@given(st.text(st.characters(codec="utf-8", exclude_characters="\r\n\0")))
def test_any_text_with_dollars_is_substituted_or_refused(text: str) -> None:
    quoted = "'" + text.replace("'", "''") + "'"
    try:
        document = parse(f"v: {quoted}\n", file="f")
    except Exception:  # noqa: BLE001 - not every character may stand in YAML
        return
    result = substitute(document, {}, NOWHERE)
    if "$(" not in text:
        assert result.document.find(("v",)) == document.find(("v",))
    assert {each.at.path for each in result.found} <= {"v"}
    assert all(each.message.startswith("cannot ") for each in result.found)


def test_a_given_value_wins_over_the_default_and_the_order_is_that_of_declaration() -> None:
    text = "arguments: {a: {default: 1}, b: {default: 1.10}, c: {default: $(arg a)$(env E)}}\n"
    result = _substitute(text, {"a": "2"}, {"E": "e"})
    assert result.found == []
    assert result.arguments == {"a": "2", "b": "1.10", "c": "2e"}


def test_the_environment_wins_over_the_default() -> None:
    result = _substitute("v: $(env ROBOT r1)\n", {}, {"ROBOT": "r2"})
    found = result.document.find(("v",))
    assert found is not None
    assert found.data == "r2"


def test_a_value_that_failed_is_reported_once() -> None:
    result = _substitute("arguments: {a: {default: $(env NOT_SET)}}\nv: $(arg a)\nw: $(arg a)\n")
    (only,) = result.found
    assert str(only) == (
        "f:1:26: arguments.a.default: cannot find the environment variable 'NOT_SET'; "
        "set it, or write $(env NOT_SET DEFAULT)"
    )
    assert result.broken == [("arguments", "a", "default"), ("v",), ("w",)]


def test_bytes_that_are_no_utf8_are_refused() -> None:
    result = _substitute("v: $(env E)\n", {}, {"E": "caf\udce9"})
    assert [str(each) for each in result.found] == [
        "f:1:4: v: cannot use 'caf\\udce9': it is not UTF-8"
    ]


def test_substitutions_cannot_blow_a_document_up() -> None:
    text = "arguments: {x: {}}\nv: [" + "$(arg x)," * 100 + "]\n"
    result = _substitute(text, {"x": "x" * (MAX_TEXT // 10)})
    assert [each.message for each in result.found] == [
        f"cannot substitute more than {MAX_TEXT} characters in one document"
    ]
    assert len(result.broken) == 90
