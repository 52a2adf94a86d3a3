"""Who is started again because TCP did not let it be discovered."""

from __future__ import annotations

import pytest
from msgspec.structs import replace

from lifecycle.supervisor.core.passing import undiscovered
from lifecycle.verify.outcome import Outcome
from tests.unit.supervisor.fakes import verdict

MISSING = ("graph.missing-node", "/listener")
NAMELESS = ("graph.unattributed-endpoint", "/rosout")
TO_LISTENER = ("graph.unmatched-flow", "/chatter: /talker → /listener")
AWAITED = ("graph.missing-node", "/elsewhere")
TO_AWAITED = ("graph.unmatched-flow", "/chatter: /talker → /elsewhere")
WRONG = ("graph.qos-incompatible", "/chatter: /talker → /listener")


@pytest.mark.parametrize(
    ("found", "again"),
    [
        ((MISSING, NAMELESS), {"/listener"}),
        ((TO_LISTENER,), {"/talker", "/listener"}),
        ((MISSING, TO_LISTENER), {"/listener"}),
        ((MISSING, WRONG), set()),
        ((NAMELESS,), set()),
        ((AWAITED, TO_AWAITED), {"/elsewhere"}),
        ((AWAITED, TO_AWAITED, TO_LISTENER), {"/elsewhere", "/talker", "/listener"}),
    ],
)
def test_who_lacks_something_is_started_again_and_nobody_where_more_is_wrong(
    found: tuple[tuple[str, str], ...], again: set[str]
) -> None:
    assert undiscovered(verdict(*found)) == again


@pytest.mark.parametrize("rule", ["state.wrong-state", "config.missing-report"])
def test_who_waits_for_a_node_that_is_on_its_way_is_not_started_again(rule: str) -> None:
    on_its_way = verdict(TO_AWAITED, (rule, "what is said of it"))
    waiting, late = on_its_way.findings
    of = replace(on_its_way, findings=(waiting, replace(late, node="/elsewhere")))
    assert undiscovered(of) == frozenset()
    # The same of a node that nobody lacks: then the match is what is missing.
    of = replace(on_its_way, findings=(waiting, replace(late, node="/other")))
    assert undiscovered(of) == {"/talker", "/elsewhere"}


def test_what_cannot_be_verified_starts_nobody_again() -> None:
    assert undiscovered(verdict(MISSING, outcome=Outcome.UNVERIFIABLE)) == frozenset()
