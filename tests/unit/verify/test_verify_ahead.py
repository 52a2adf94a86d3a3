"""Judging nodes before their gate beside others that an earlier gate let through."""

from __future__ import annotations

from msgspec.structs import replace

from lifecycle.verify.outcome import Outcome
from lifecycle.verify.verdict import Stage
from tests.builders import node, planned, publisher, subscription
from tests.unit.verify.lines import verify
from tests.unit.verify.perfect import perfect

PLAN = planned(node("one", publisher("a")), node("two", subscription("a")))


def _with_active(name: str, state: str = "active", stage: Stage = Stage.CONNECTED):
    seen = perfect(PLAN, stage)
    return replace(
        seen,
        nodes=tuple(
            replace(each, state=state) if each.full_name == name else each for each in seen.nodes
        ),
        configurations=tuple(
            replace(each, state=state) if each.name == name else each
            for each in seen.configurations
        ),
    )


def test_a_node_that_an_earlier_gate_let_through_may_be_active_and_no_other() -> None:
    seen = _with_active("/one")
    ahead = frozenset({"/one"})
    assert verify(PLAN, seen, stage=Stage.CONNECTED, ahead=ahead).verdict is Outcome.OK
    other = verify(PLAN, _with_active("/two"), stage=Stage.CONNECTED, ahead=ahead)
    assert [each.subject for each in other.findings] == ["/two"]


def test_a_node_that_an_earlier_gate_let_through_may_be_on_its_way_and_no_other() -> None:
    seen = _with_active("/one", "activating")
    ahead = frozenset({"/one"})
    assert verify(PLAN, seen, stage=Stage.CONNECTED, ahead=ahead).verdict is Outcome.OK
    (other,) = verify(PLAN, seen, stage=Stage.CONNECTED, ahead=frozenset({"/two"})).findings
    assert other.message == ("node /one is activating and must be inactive, connected")
    (back,) = verify(
        PLAN, _with_active("/one", "deactivating"), stage=Stage.CONNECTED, ahead=ahead
    ).findings
    assert back.message == ("node /one is deactivating and must be inactive, connected or active")
