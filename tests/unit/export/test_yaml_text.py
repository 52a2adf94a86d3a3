"""YAML that reads back as what was written, here and in YAML 1.1."""

from __future__ import annotations

import math

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from lifecycle.export.manifest_yaml import Noted, comment, scalar, to_yaml
from lifecycle.manifest.yaml.source import parse

TEXTS = st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0"), max_size=20)
SCALARS = st.one_of(
    st.booleans(),
    st.integers(-(2**63), 2**63 - 1),
    st.floats(allow_nan=False, allow_infinity=False),
    TEXTS,
)


@pytest.mark.parametrize(
    ("value", "written"),
    [
        ("on", '"on"'),
        ("No", '"No"'),
        ("y", '"y"'),
        ("08", '"08"'),
        ("1e3", '"1e3"'),
        ("~", '"~"'),
        ("null", '"null"'),
        ("", '""'),
        ("a: b", '"a: b"'),
        ("a #b", '"a #b"'),
        ("-", '"-"'),
        ('say "hi"\n', '"say \\"hi\\"\\n"'),
        ("/left/scan", "/left/scan"),
        ("std_msgs/msg/String", "std_msgs/msg/String"),
        ("\x07\N{GRINNING FACE}\u2028", '"\\x07\N{GRINNING FACE}\\U00002028"'),
        (True, "true"),
        (8, "8"),
        (1e16, "1.0e+16"),
        (0.5, "0.5"),
    ],
)
def test_a_scalar_is_quoted_where_some_yaml_would_read_something_else(
    value: object, written: str
) -> None:
    assert scalar(value) == written
    assert yaml.safe_load(written) == value


@given(st.dictionaries(TEXTS.filter(bool), SCALARS, min_size=1, max_size=5))
def test_scalars_and_keys_read_back_in_both_versions_of_yaml(tree: dict[str, object]) -> None:
    text = to_yaml(tree)
    assert yaml.safe_load(text) == tree
    assert parse(text, file="x.yaml").root.plain() == tree


def test_lists_mappings_and_comments_stand_in_block_style() -> None:
    text = to_yaml(
        {
            "empty": {},
            "flat": ["a", 1],
            "none": [],
            "noted": Noted(value={"x": Noted(value=1, note="why: so\nthere")}, note="gap"),
            "items": [{"name": "first", "deep": {"k": True}}, {"name": "other"}],
        }
    )
    assert text == (
        "empty: {}\n"
        "flat: [a, 1]\n"
        "none: []\n"
        "noted:  # gap\n"
        "  x: 1  # why: so there\n"
        "items:\n"
        "  - name: first\n"
        "    deep:\n"
        "      k: true\n"
        "  - name: other\n"
    )
    assert yaml.safe_load(text)["items"] == [
        {"name": "first", "deep": {"k": True}},
        {"name": "other"},
    ]


@given(TEXTS)
def test_nothing_escapes_from_a_comment(text: str) -> None:
    assert yaml.safe_load(f"a: 1  {comment(text)}\n") == {"a": 1}


@pytest.mark.parametrize("value", [math.inf, math.nan])
def test_a_number_that_is_not_finite_is_refused(value: float) -> None:
    with pytest.raises(ValueError, match=rf"^cannot write {value!r} as YAML: .*finite$"):
        scalar(value)
