"""Checks of `after`."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lifecycle.manifest.diagnostics import ManifestError
from lifecycle.manifest.model import Condition
from lifecycle.plan.build import dependency_levels
from tests.builders import node

Findings = Callable[..., list[str]]


def circle(edges: dict[str, list[str]]) -> str:
    nodes = [
        node(key, after=[(other, Condition.STARTED) for other in others])
        for key, others in edges.items()
    ]
    try:
        dependency_levels(nodes)
    except ManifestError as problem:
        (found,) = problem.diagnostics
        return found.message.rpartition(": ")[2]
    return ""


def test_a_circle_is_shown_without_the_way_that_leads_to_it() -> None:
    found = circle({"in": ["a"], "a": ["b"], "b": ["a"]})
    assert found in ("a → b → a", "b → a → b")


def test_a_chain_of_ten_thousand_nodes_is_no_problem() -> None:
    edges = {f"n{i}": [f"n{i + 1}"] for i in range(10_000)}
    edges["n10000"] = ["n0"]
    assert circle(edges)


keys = st.sampled_from("abcdef")


@given(st.dictionaries(keys, st.lists(keys, max_size=4, unique=True)))
def test_a_circle_is_found_exactly_when_no_order_exists(edges: dict[str, list[str]]) -> None:
    known = {key: [o for o in others if o in edges and o != key] for key, others in edges.items()}
    left = dict(known)
    while ready := [key for key, others in left.items() if not set(others) & set(left)]:
        for key in ready:
            del left[key]
    assert bool(circle(known)) == bool(left)


@pytest.mark.parametrize(
    ("waiting", "condition", "target", "rule"),
    [
        ("true", "active", "true", []),
        ("false", "started", "false", []),
        ("false", "connected", "true", []),
        ("false", "active", "true", ["check.after-unmanaged"]),
        ("true", "configured", "false", ["check.after-unmanaged"]),
        ("true", "started", "false", []),
    ],
)
def test_nodes_that_are_not_managed_have_only_a_start(
    findings: Findings, waiting: str, condition: str, target: str, rule: list[str]
) -> None:
    found = findings(f"""
        nodes:
          a: {{run: {{command: [a]}}, managed: {waiting}, after: {{b: {condition}}}}}
          b: {{run: {{command: [b]}}, managed: {target}}}
    """)
    assert [each.split()[0] for each in found] == rule
