"""What the soak expects of a round: every case of the policies that docs/supervision.md names."""

from __future__ import annotations

import pytest

from tests.soak.model import (
    NODES,
    Condition,
    Expectation,
    Fault,
    Kind,
    Manifest,
    Round,
    State,
    follows,
    plan,
)


def _after(
    *faults: Fault,
    state: State | None = None,
    condition: Condition = Condition.NONE,
    orders: tuple[str, ...] = (),
) -> tuple[Expectation, State]:
    done = Round(number=1, condition=condition, faults=faults, orders=orders)
    return follows(state or State(), done)


@pytest.mark.parametrize(
    ("target", "again"),
    [
        ("camera", {"camera"}),
        ("base", {"base", "arm"}),  # on_failure: dependents
        ("vision", {"filter", "detector"}),  # one process
        ("pool", {"pool", "part"}),  # a container with its component
        ("core", set(NODES)),  # on_failure: all
    ],
)
def test_who_is_killed_comes_again_with_whom_its_policy_names(target: str, again: set[str]) -> None:
    expected, _ = _after(Fault(Kind.KILL, target))
    assert expected == Expectation(failed=frozenset({target}), again=frozenset(again))


def test_an_end_that_no_policy_takes_ends_the_run() -> None:
    assert _after(Fault(Kind.KILL, "lone"))[0].exit_codes == {6}  # restart: no
    assert _after(Fault(Kind.EXIT_0, "camera"))[0].exit_codes == {6}  # restart: on-failure
    assert _after(Fault(Kind.EXIT_0, "vision"))[0].exit_codes == set()  # restart: always


def test_a_limit_of_starts_is_reached_over_rounds_or_by_failing_again() -> None:
    killed = Fault(Kind.KILL, "fragile")
    first, state = _after(killed)
    assert (first.exit_codes, state.starts) == (set(), 2)
    last, state = _after(killed, state=state)
    assert (last.exit_codes, state) == ({7}, State())
    assert _after(Fault(Kind.STUMBLE, "fragile", "connect exit9"))[0].exit_codes == {7}


def test_a_start_counts_that_another_s_failure_made_necessary() -> None:
    expected, state = _after(Fault(Kind.KILL, "core"))
    assert (expected.exit_codes, state.starts) == (set(), 2)
    assert _after(Fault(Kind.KILL, "core"), state=state)[0].exit_codes == set()
    assert _after(Fault(Kind.KILL, "fragile"), state=state)[0].exit_codes == {7}
    assert _after(Fault(Kind.KILL, "base"))[1].starts == 1
    ordered = _after(Fault(Kind.KILL, "core"), condition=Condition.STORM, orders=("core",))
    assert ordered[1].starts is None


def test_a_start_that_is_to_fail_may_be_cut_off_by_another_s_failure() -> None:
    stumble = Fault(Kind.STUMBLE, "fragile", "construct sleep")
    pool = Fault(Kind.KILL, "pool")
    assert _after(stumble)[0].goes_on is None
    assert _after(stumble, Fault(Kind.STOP_BRIEFLY, "pool"))[0].goes_on is None
    expected, state = _after(stumble, pool)
    assert (expected.exit_codes, expected.goes_on, state) == ({7}, State(starts=3), State())
    # Killed once more it is given up, whatever would come of its next start.
    assert _after(stumble, pool, state=State(starts=2))[0].goes_on is None
    ends, _ = _after(stumble, Fault(Kind.KILL, "lone"))
    assert (ends.exit_codes, ends.goes_on) == ({6, 7}, None)


def test_who_goes_down_with_another_may_be_down_before_it_would_end_the_run() -> None:
    exits = Fault(Kind.EXIT_0, "base")
    expected, _ = _after(Fault(Kind.KILL, "core"), exits)
    assert (expected.exit_codes, expected.goes_on) == ({6}, State(starts=2))
    assert _after(Fault(Kind.KILL, "camera"), exits)[0].goes_on is None


def test_a_hang_is_reported_as_silent_and_then_as_a_failure() -> None:
    expected, _ = _after(Fault(Kind.SPIN, "arm"))
    assert expected.silent == expected.failed == {"arm"}
    briefly, _ = _after(Fault(Kind.STOP_BRIEFLY, "arm"))
    assert (briefly.silent, briefly.failed, briefly.again) == ({"arm"}, set(), set())


@pytest.mark.parametrize(
    ("fault", "consequence", "heal", "codes"),
    [
        (Fault(Kind.ALTER, "camera"), "deactivate", (("resume",),), set()),
        (Fault(Kind.ALTER, "arm"), "pause", (("resume",),), set()),
        (Fault(Kind.ALTER, "lone"), "stop", (), {4}),
        (Fault(Kind.STRAY, "lone"), "mode", (("mode", "normal"),), set()),
    ],
)
def test_a_violation_has_its_consequence(
    fault: Fault, consequence: str, heal: tuple[tuple[str, ...], ...], codes: set[int]
) -> None:
    expected, _ = _after(fault)
    assert (expected.consequence, expected.heal) == (consequence, heal)
    assert (expected.exit_codes, expected.again) == (codes, set())


def test_who_goes_down_with_another_may_be_down_before_it_fails() -> None:
    expected, _ = _after(Fault(Kind.KILL, "base"), Fault(Kind.SLEEP, "arm"))
    assert (expected.failed, expected.silent, expected.may_fail) == ({"base"}, set(), {"arm"})


def test_what_is_restarted_by_hand_as_well_may_come_again_and_begins_anew() -> None:
    expected, state = _after(
        Fault(Kind.KILL, "camera"), condition=Condition.STORM, orders=("pool", "camera")
    )
    assert expected.may_again == {"pool", "part", "camera"}
    assert state.starts == 1
    assert _after(condition=Condition.STORM, orders=("",))[1].starts is None


def test_a_supervisor_that_was_killed_begins_anew() -> None:
    killed = Fault(Kind.KILL, "fragile")
    expected, state = _after(killed, condition=Condition.SUPERVISOR_KILLED, state=State(starts=2))
    assert (expected.exit_codes, state) == (set(), State())


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


def _applied(manifest: Manifest, *faults: Fault, before: Manifest | None = None) -> Expectation:
    done = Round(number=1, condition=Condition.APPLY, faults=faults, manifest=manifest)
    return follows(State(manifest=before or Manifest()), done)[0]


def test_a_manifest_that_is_applied_restarts_only_what_differs() -> None:
    given = _applied(Manifest(tint=1))
    assert (given.outcomes, given.may_again) == ({"applied"}, set())
    restarted = _applied(Manifest(issue=1))
    assert (restarted.outcomes, restarted.may_again) == ({"applied"}, {"filter", "detector"})
    assert _applied(Manifest(tint=1), before=Manifest(tint=1)).outcomes == {"unchanged"}


def test_a_manifest_is_rolled_back_where_a_node_of_it_fails_and_maybe_where_another_does() -> None:
    assert _applied(Manifest(bad="configure raise")).outcomes == {"rolled_back"}
    met = _applied(Manifest(extra=True), Fault(Kind.KILL, "base"))
    assert (met.outcomes, met.again) == ({"applied", "rolled_back"}, {"base", "arm"})


def test_a_node_that_was_added_goes_down_with_all_and_is_in_force_until_the_run_ends() -> None:
    state = State(manifest=Manifest(extra=True))
    everybody, after = _after(Fault(Kind.KILL, "core"), state=state)
    assert everybody.again == {*NODES, "extra"}
    assert after.manifest == Manifest(extra=True)
    assert _after(Fault(Kind.KILL, "lone"), state=state)[1] == State()


def test_setting_the_clock_alone_changes_nothing() -> None:
    assert _after(condition=Condition.CLOCK)[0] == Expectation()
