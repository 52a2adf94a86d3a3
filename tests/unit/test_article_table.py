"""The tables of the nine systems say what the manifests say, and each statement names its test.

The first seven rows are those of *Topological Discovery and Communication Negotiation*, "Summary of
Use Cases", whose marks are transcribed here; what a mark means in a manifest is `IMPLIED`.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable, Mapping
from pathlib import Path

import pytest

from lifecycle.manifest.loading import load
from lifecycle.manifest.model import (
    Authority,
    DataLayerSource,
    DiscoveryMode,
    EndpointPolicy,
    Manifest,
)
from lifecycle.plan.build import build_plan

ROOT = Path(__file__).parents[2]
GUIDE = (ROOT / "docs/nine_systems.md").read_text(encoding="utf-8")
STATEMENTS = (ROOT / "tests/articles/topological_discovery.md").read_text(encoding="utf-8")
TESTS = (ROOT / "tests/net/test_nine_systems.py").read_text(encoding="utf-8")
NAME = re.compile(r"([^:]+): \[(\w+)\]\(\.\./manifests/\2\.lifecycle\.yaml\)")
COLUMNS = (
    "remote node API",
    "node configuration API",
    "data layer events",
    "dynamic discovery",
    "graph API",
)
ARTICLE = {
    "statically configured nodes": ". . . . .",
    "statically configured graph": "✓ . . . .",
    "dynamically configured graph with static discovery": "✓ ✓ . . .",
    "statically configured graph with events": "✓ . ✓ . ✓",
    "dynamically configured graph with events and static discovery": "✓ ✓ ✓ . ✓",
    "dynamically configured graph with dynamic discovery": "✓ ✓ . ✓ ✓",
    "dynamically configured graph with events and dynamic discovery": "✓ ✓ ✓ ✓ ✓",
}
OTHERS = (
    "statically configured nodes with static endpoint discovery",
    "client-server master with point-to-point TCP data only",
    "distributed system with intelligent multicast",
)
"""A variant of the first, and the article's two negotiation systems; it marks none of them."""


def _discovers(system: Manifest) -> bool:
    return system.discovery.mode in (DiscoveryMode.DYNAMIC, DiscoveryMode.SERVER)


IMPLIED: Mapping[str, Callable[[Manifest], bool]] = {
    "remote node API": lambda system: system.data_layer.authority is Authority.SUPERVISOR,
    "node configuration API": lambda system: system.data_layer.source is DataLayerSource.DYNAMIC,
    "data layer events": lambda system: system.data_layer.events,
    "dynamic discovery": _discovers,
    # What is told has to be listened to, and who comes has to say so.
    "graph API": lambda system: system.data_layer.events or _discovers(system),
}


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """A system as a table has it."""

    name: str
    manifest: str
    marks: tuple[bool, ...]


def rows(page: str) -> list[Row]:
    """Read the one table whose columns are the article's; "…" stands for the row above."""
    (table,) = re.findall(r"^\|[^\n]*\| graph API \|.*?(?=^(?!\|))", page, re.MULTILINE | re.DOTALL)
    head, _, *lines = table.splitlines()
    assert tuple(each.strip() for each in head.split("|")[2:7]) == COLUMNS
    found: list[Row] = []
    for line in lines:
        first, *cells = (each.strip() for each in line.strip("|").split("|"))
        named = NAME.fullmatch(first)
        assert named, first
        name = named[1].replace("…", found[-1].name if found else "…")
        assert {*cells[:5]} <= {"✓", "·"}, line
        marks = tuple(each == "✓" for each in cells[:5])
        found.append(Row(name=name, manifest=named[2], marks=marks))
    return found


ROWS = rows(GUIDE)
EACH = pytest.mark.parametrize("row", ROWS, ids=lambda row: row.manifest)


def system(row: Row, **arguments: str) -> Manifest:
    """Load a row's manifest, as it stands or with arguments."""
    path = ROOT / "manifests" / f"{row.manifest}.lifecycle.yaml"
    loaded = load(path, arguments, environment={})
    assert loaded.warnings == ()
    return loaded.manifest


def test_the_first_seven_systems_have_the_articles_names_and_marks() -> None:
    marked = {each.name: each.marks for each in ROWS if each.name not in OTHERS}
    assert list(marked.items()) == [
        (name, tuple(mark == "✓" for mark in marks.split())) for name, marks in ARTICLE.items()
    ]
    assert {each.name for each in ROWS} == {*ARTICLE, *OTHERS}


def test_every_manifest_but_the_two_introductions_is_one_of_these_systems() -> None:
    there = {each.name.split(".")[0] for each in (ROOT / "manifests").iterdir()}
    assert there - {"first_node", "teleop"} == {each.manifest for each in ROWS}


@EACH
def test_a_manifests_keys_imply_exactly_its_marks(row: Row) -> None:
    manifest = system(row)
    assert manifest.system == row.manifest
    assert tuple(IMPLIED[each](manifest) for each in COLUMNS) == row.marks


@EACH
def test_nodes_may_make_endpoints_while_running_where_their_configuration_is_read(row: Row) -> None:
    may = {each.endpoints is EndpointPolicy.OPEN for each in system(row).nodes}
    assert may == {row.marks[COLUMNS.index("node configuration API")]}


@EACH
def test_nodes_that_nobody_declared_may_come_where_they_are_found_and_read(row: Row) -> None:
    may = system(row).policy.undeclared_nodes is EndpointPolicy.OPEN
    marks = dict(zip(COLUMNS, row.marks, strict=True))
    assert may == (marks["dynamic discovery"] and marks["node configuration API"])


@EACH
def test_a_system_is_planned_for_one_computer_and_for_two_where_it_names_them(row: Row) -> None:
    one = system(row)
    build_plan(one, environment={})
    if "left_address" in dict(one.arguments):
        two = system(row, left_address="10.77.0.1", right_address="10.77.0.2")
        build_plan(two, environment={})
        assert {each.address for each in two.machines} == {"10.77.0.1", "10.77.0.2"}


@EACH
def test_a_row_has_a_test_on_the_wire_that_is_named_after_it(row: Row) -> None:
    words = re.sub(r"[^a-z]+", "_", row.name.lower())
    source = re.search(rf"^def test_{words}\(.*?(?=^def |\Z)", TESTS, re.MULTILINE | re.DOTALL)
    assert source
    assert f'"{row.manifest}"' in source[0]


def test_every_statement_of_the_article_has_its_place_and_its_test() -> None:
    head = r"^\| the article \| here \| test \|\n((?:\|.*\n)+)"
    tables = re.findall(head, STATEMENTS, re.MULTILINE)
    lines = [line for table in tables for line in table.splitlines()[1:]]
    assert len(lines) > 60
    assert [each for each in lines if "::test_" not in each.strip("|").split(" | ")[2]] == []
