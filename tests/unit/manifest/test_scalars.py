"""YAML 1.2's core schema, and no other."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lifecycle.manifest.yaml.document import INT64_MAX, INT64_MIN, may_be_any_double, resolve

ANYWHERE = ("parameters",)


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("", None),
        ("~", None),
        ("null", None),
        ("true", True),
        ("FALSE", False),
        ("7", 7),
        ("-7", -7),
        ("-0", 0),
        ("0o17", 15),
        ("0xff", 255),
        ("1.5", 1.5),
        (".5", 0.5),
        ("1.", 1.0),
        ("1e3", 1000.0),
        ("9223372036854775807", INT64_MAX),
        ("-9223372036854775808", INT64_MIN),
    ],
)
def test_the_core_schema(text: str, value: object) -> None:
    resolved = resolve(text, ANYWHERE)
    assert resolved == value
    assert type(resolved) is type(value)


@pytest.mark.parametrize(
    "text",
    [
        "yes",
        "No",
        "on",
        "OFF",
        "y",
        "1:30",
        "017",
        "08",
        "-09",
        "+00",
        "1_000",
        "0b1",
        "0x",
        "1.2.3",
        "+",
        "e3",
        "tRUE",
        "<<",
    ],
)
def test_what_only_yaml_1_1_knows_is_a_string(text: str) -> None:
    assert resolve(text, ANYWHERE) == text


@pytest.mark.parametrize("text", ["1e999", "-1e999"])
def test_numbers_are_finite(text: str) -> None:
    with pytest.raises(ValueError, match=r"^a number must be finite$"):
        resolve(text, ANYWHERE)


@pytest.mark.parametrize(
    ("text", "value"), [(".inf", math.inf), ("-.Inf", -math.inf), ("+.INF", math.inf)]
)
def test_infinities_are_doubles(text: str, value: float) -> None:
    assert resolve(text, ANYWHERE) == value


@pytest.mark.parametrize("text", [".nan", ".NaN", ".NAN"])
def test_what_is_not_a_number_is_a_double(text: str) -> None:
    assert math.isnan(resolve(text, ANYWHERE))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("place", "may"),
    [
        (("parameters", "a"), True),
        (("nodes", "n", "parameters", "a", 0), True),
        (("modes", "m", "parameters", "n", "a"), True),
        (("nodes", "n", "interface", "parameters", "a", "default_value"), True),
        (("groups", "g", "nodes", "n", "parameters", "a"), True),
        (("nodes", "parameters", "timeouts", "start_s"), False),
        (("nodes", "n", "timeouts", "start_s"), False),
    ],
)
def test_only_parameters_may_be_any_double(place: tuple[str | int, ...], may: bool) -> None:
    assert may_be_any_double(place) is may


@pytest.mark.parametrize("text", ["9223372036854775808", "-9223372036854775809", "9" * 5000])
def test_integers_fit_into_64_bits(text: str) -> None:
    with pytest.raises(ValueError, match=r"^an integer must fit into 64 bits"):
        resolve(text, ANYWHERE)


@given(st.integers(min_value=INT64_MIN, max_value=INT64_MAX))
def test_every_int64_reads_back(number: int) -> None:
    assert resolve(str(number), ANYWHERE) == number


@given(st.floats(allow_nan=False, allow_infinity=False))
def test_every_double_reads_back(number: float) -> None:
    resolved = resolve(repr(number), ANYWHERE)
    assert isinstance(resolved, float)
    assert resolved == number
    assert math.copysign(1, resolved) == math.copysign(1, number)


@given(st.text())
def test_any_text_is_a_scalar_or_refused(text: str) -> None:
    try:
        value = resolve(text, ANYWHERE)
    except ValueError:
        return
    assert value is None or isinstance(value, (bool, int, float)) or value == text
