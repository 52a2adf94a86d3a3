"""A seed of the soak stands for the same rounds, and its rounds try everything."""

from __future__ import annotations

from tests.soak.model import Condition, Kind, State, follows, plan


def test_a_seed_stands_for_the_same_rounds_whatever_their_number_and_tries_everything() -> None:
    rounds = plan(1, 400)
    assert plan(1, 40) == rounds[:40]
    assert plan(2, 40) != rounds[:40]
    assert {each.condition for each in rounds} == set(Condition)
    assert {fault.kind for each in rounds for fault in each.faults} == set(Kind)
    assert {each.ends for each in rounds} == {"", "down", "term", "interrupt"}
    state, codes = State(), set()
    for each in rounds:
        expected, state = follows(state, each)
        state = State() if each.ends else state
        codes |= expected.exit_codes
    assert codes == {4, 6, 7}
