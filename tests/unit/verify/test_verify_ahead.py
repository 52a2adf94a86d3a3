"""Judging nodes before their gate beside others that an earlier gate let through."""

from __future__ import annotations

import dataclasses

from lifecycle.verify.judge import verify
from lifecycle.verify.outcome import Outcome
from lifecycle.verify.verdict import Stage
from tests.builders import node, planned, publisher, subscription
from tests.unit.verify.perfect import perfect

PLAN = planned(node("one", publisher("a")), node("two", subscription("a")))


def _with_active(name: str, state: str = "active", stage: Stage = Stage.CONNECTED):
    seen = perfect(PLAN, stage)
    return dataclasses.replace(
        seen,
        nodes=tuple(
            dataclasses.replace(each, state=state) if each.full_name == name else each
            for each in seen.nodes
        ),
        configurations=tuple(
            dataclasses.replace(each, state=state) if each.name == name else each
            for each in seen.configurations
        ),
    )


def test_a_node_that_is_active_before_its_gate_is_violated() -> None:
    verdict = verify(PLAN, _with_active("/one"), stage=Stage.CONNECTED)
    assert [each.message for each in verdict.findings] == [
        "cannot accept node /one: it is active and must be inactive, connected"
    ]


def test_a_node_that_an_earlier_gate_let_through_may_be_active_and_no_other() -> None:
    seen = _with_active("/one")
    ahead = frozenset({"/one"})
    assert verify(PLAN, seen, stage=Stage.CONNECTED, ahead=ahead).verdict is Outcome.OK
    other = verify(PLAN, _with_active("/two"), stage=Stage.CONNECTED, ahead=ahead)
    assert [each.subject for each in other.findings] == ["/two"]


def test_being_ahead_excuses_nothing_else() -> None:
    seen = dataclasses.replace(_with_active("/one"), endpoints=())
    verdict = verify(PLAN, seen, stage=Stage.CONNECTED, ahead=frozenset({"/one"}))
    assert verdict.verdict is Outcome.VIOLATED


def test_a_node_that_an_earlier_gate_let_through_may_be_on_its_way_and_no_other() -> None:
    seen = _with_active("/one", "activating")
    ahead = frozenset({"/one"})
    assert verify(PLAN, seen, stage=Stage.CONNECTED, ahead=ahead).verdict is Outcome.OK
    (other,) = verify(PLAN, seen, stage=Stage.CONNECTED, ahead=frozenset({"/two"})).findings
    assert other.message == (
        "cannot accept node /one: it is activating and must be inactive, connected"
    )
    (back,) = verify(
        PLAN, _with_active("/one", "deactivating"), stage=Stage.CONNECTED, ahead=ahead
    ).findings
    assert back.message == (
        "cannot accept node /one: it is deactivating and must be inactive, connected or active"
    )


def test_once_all_must_be_active_to_be_on_the_way_is_not_enough() -> None:
    """The gates that let nodes through are over, whoever still calls them ahead."""
    seen = _with_active("/one", "activating", Stage.ACTIVE)
    (found,) = verify(PLAN, seen, stage=Stage.ACTIVE, ahead=frozenset({"/one"})).findings
    assert (found.rule, found.message) == (
        "state.wrong-state",
        "cannot accept node /one: it is activating and must be active",
    )
