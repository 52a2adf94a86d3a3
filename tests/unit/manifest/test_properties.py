"""Whatever a document holds, loading it ends in a manifest or in ManifestError."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import yaml
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from lifecycle.manifest.diagnostics import ManifestError
from lifecycle.manifest.loading import load
from lifecycle.manifest.written import read_schema
from lifecycle.manifest.yaml.source import compose

SLOW = settings(
    max_examples=150,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)

_SCALARS = (
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8)
    | st.sampled_from(["$(arg x)", "$(env HOME)", "$(", "local://x", "sensor_data", "a:B", "/a"])
)  # fmt: skip


def _words(schema: object) -> set[str]:
    """Return every key and enum value of the schema: what random documents are made of."""
    found: set[str] = set()
    if isinstance(schema, dict):
        found |= (
            set(schema.get("properties", {}))
            if isinstance(schema.get("properties"), dict)
            else set()
        )
        found |= {each for each in schema.get("enum", []) if isinstance(each, str)}
        schema = list(schema.values())
    if isinstance(schema, list):
        found = found.union(*(_words(each) for each in schema), set())
    return found


_KEYS = st.sampled_from(sorted(_words(read_schema("manifest.v1.schema.json")))) | st.text(
    max_size=4
)
_VALUES = st.recursive(
    _SCALARS | _KEYS,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(_KEYS, inner, max_size=4),
    max_leaves=12,
)
_NODE = st.fixed_dictionaries(
    {},
    optional={
        "run": _VALUES,
        "attach": st.just(True) | _VALUES,
        "interface": st.dictionaries(_KEYS, st.lists(_VALUES, max_size=2), max_size=3) | _VALUES,
        "flows": _VALUES,
        "parameters": st.dictionaries(_KEYS, _VALUES, max_size=3),
        "after": _VALUES,
        "remap": _VALUES,
        "timeouts": _VALUES,
        "namespace": _VALUES,
        "parameter_files": _VALUES,
    },
)
_DOCUMENT = st.fixed_dictionaries(
    {
        "manifest_version": st.just(1) | _SCALARS,
        "system": st.just("test") | _SCALARS,
        "nodes": st.dictionaries(_KEYS, _NODE, max_size=2) | _VALUES,
    },
    optional=dict.fromkeys(
        ("arguments", "include", "machines", "discovery", "policy", "links", "description"),
        _VALUES,
    ),
)


def _loads(path: Path) -> None:
    """Load a file; whatever is said of it is a sentence at a position."""
    try:
        loaded = load(path, {"x": "1"})
    except ManifestError as error:
        found = error.diagnostics
        assert found
    else:
        found = loaded.warnings
    for each in found:
        assert each.message.startswith("cannot ")
        assert each.at.line >= 1
        assert each.at.column >= 1
    assert len(set(found)) == len(found)
    order = [(each.at.line, each.at.column) for each in found if each.at.file == str(path)]
    assert order == sorted(order)


@SLOW
@given(data=st.binary(max_size=200))
def test_any_bytes(data: bytes, tmp_path: Path) -> None:
    path = tmp_path / "any.lifecycle.yaml"
    path.write_bytes(data)
    _loads(path)


@SLOW
@given(text=st.text(alphabet="ab:-?[]{}&*!|>'\"%@`#,. \n\t<~$()", max_size=60))
def test_any_text_of_yaml_characters(text: str, tmp_path: Path) -> None:
    path = tmp_path / "any.lifecycle.yaml"
    path.write_text(text, encoding="utf-8")
    _loads(path)


@SLOW
@given(document=_DOCUMENT, flow=st.booleans())
def test_any_document_of_the_languages_words(document: object, flow: bool, tmp_path: Path) -> None:
    path = tmp_path / "any.lifecycle.yaml"
    text = yaml.safe_dump(document, default_flow_style=flow, allow_unicode=True)
    path.write_text(text, encoding="utf-8")
    _loads(path)


_ONLY_IN_YAML_1_2 = re.compile(r"0o[0-7]+|[-+]?(\.[0-9]+|[0-9]+\.?[0-9]*)[eE][-+]?[0-9]+")
"""Strings that PyYAML, a writer of YAML 1.1, writes bare although they are numbers in YAML 1.2."""


@example("08")
@example(["-09", "0018"])
@given(
    st.recursive(
        st.text(st.characters(codec="utf-8", categories=["L", "N", "P", "Zs"]), max_size=8).filter(
            lambda text: not _ONLY_IN_YAML_1_2.fullmatch(text)
        )
        | st.integers(-(2**63), 2**63 - 1)
        | st.booleans()
        | st.none(),
        lambda inner: (
            st.lists(inner, max_size=4)
            | st.dictionaries(st.from_regex(r"[a-z]{1,5}", fullmatch=True), inner, max_size=4)
        ),
        max_leaves=20,
    )
)
def test_composing_what_a_yaml_writer_wrote_gives_it_back(value: object) -> None:
    text = yaml.safe_dump({"root": value}, allow_unicode=True)
    document, found = compose(text, file="f")
    assert found == ()
    assert document.root.plain() == {"root": value}


@pytest.mark.parametrize(("text", "number"), [("0o17", 15), ("1e5", 1e5), (".5E3", 500.0)])
def test_what_only_yaml_1_2_counts_among_numbers_is_one(text: str, number: float) -> None:
    assert yaml.safe_dump([text], default_flow_style=True) == f"[{text}]\n"
    document, found = compose(f"a: {text}\nb: '{text}'\n", file="f")
    assert found == ()
    assert document.root.plain() == {"a": number, "b": text}


@pytest.mark.parametrize("loader", ["CSafeLoader", "SafeLoader"])
def test_the_c_parser_and_the_python_parser_agree(
    loader: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(yaml, "CSafeLoader", getattr(yaml, loader))
    text = "a: [1, 'x', &n {b: on}]\nc: *n\nd: |\n  text\ne:\n"
    document, found = compose(text, file="f")
    assert found == ()
    assert document.root.plain() == {
        "a": [1, "x", {"b": "on"}], "c": {"b": "on"}, "d": "text\n", "e": None
    }  # fmt: skip
    assert document.at(("a", 2, "b")).column == 20
