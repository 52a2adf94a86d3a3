"""Judging nodes before their gate beside others that an earlier gate let through."""

from __future__ import annotations

from lifecycle.verify.observation import Observation
from lifecycle.verify.outcome import Outcome
from lifecycle.verify.verdict import Stage
from tests.builders import node, planned, publisher, subscription
from tests.unit.verify.edits import both, change_configuration, change_node
from tests.unit.verify.lines import verify
from tests.unit.verify.perfect import perfect

PLAN = planned(node("one", publisher("a")), node("two", subscription("a")))


def _with_active(name: str, state: str = "active") -> Observation:
    edit = both(change_node(name, state=state), change_configuration(name, state=state))
    return edit(perfect(PLAN))


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
    assert (other.observed, other.expected) == ("activating", "inactive, connected")
    (back,) = verify(
        PLAN, _with_active("/one", "deactivating"), stage=Stage.CONNECTED, ahead=ahead
    ).findings
    assert (back.observed, back.expected) == ("deactivating", "inactive, connected or active")
