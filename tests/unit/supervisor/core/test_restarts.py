"""What is restarted by policy: the policy itself, and stories in which things fail."""

from __future__ import annotations

import pytest
from msgspec.structs import replace

from lifecycle.manifest.model import Condition, OnFailure, Restart, RunKind, Supervision
from lifecycle.supervisor.control.protocol import ControlRequest
from lifecycle.supervisor.core.failure import again_at_s, delay_s, is_restarted
from lifecycle.supervisor.core.state import Process, new_run
from lifecycle.supervisor.run.events import (
    GateOpened,
    GaveUp,
    Notice,
    Restarted,
    SystemReached,
    VerdictChanged,
)
from lifecycle.supervisor.run.options import UpOptions
from lifecycle.verify.outcome import Outcome
from tests.builders import plan_of, planned_node
from tests.unit.supervisor.core.playbook import AGAIN, GONE, INTRUDER, Play, chain

# The policy


def _started(how: Supervision) -> Process:
    process = Process(planned=plan_of(planned_node("camera")).processes[0], how=how)
    process.started(0.0)
    return process


def _starts_again(process: Process, now_s: float) -> None:
    process.failed = True
    process.started(now_s)


def test_the_delay_grows_by_one_factor_up_to_its_longest_and_stays() -> None:
    how = Supervision(restart_sec=1.0, restart_steps=4, restart_max_delay_sec=16.0)
    assert [delay_s(how, count) for count in range(1, 8)] == [1.0, 2.0, 4.0, 8.0, 16.0, 16.0, 16.0]
    assert [delay_s(Supervision(restart_sec=2.0), count) for count in (1, 9)] == [2.0, 2.0]


@pytest.mark.parametrize(
    ("restart", "taken"),
    [
        (Restart.NO, {0: False, 1: False, None: False}),
        (Restart.ON_FAILURE, {0: False, 1: True, None: True}),
        (Restart.ALWAYS, {0: True, 1: True, None: True}),
    ],
)
def test_which_ends_are_started_again_after(
    restart: Restart, taken: dict[int | None, bool]
) -> None:
    how = Supervision(restart=restart)
    assert {status: is_restarted(how, status) for status in taken} == taken


def test_it_gives_up_at_the_start_after_the_burst_and_never_without_an_interval() -> None:
    process = _started(Supervision(restart=Restart.ALWAYS))
    found = []
    for at_s in (0.1, 0.3, 0.5, 0.7, 0.9):
        found.append(again_at_s(process, at_s, was_up=True))
        _starts_again(process, at_s + 0.1)
    assert found == [pytest.approx(at_s + 0.1) for at_s in (0.1, 0.3, 0.5, 0.7)] + [None]
    assert process.restarts == 5
    endless = _started(Supervision(restart=Restart.ALWAYS, start_limit_interval_sec=0.0))
    for at_s in range(100):
        assert again_at_s(endless, float(at_s), was_up=True) == at_s + 0.1
        _starts_again(endless, at_s + 0.1)


def test_until_the_system_was_up_a_process_that_fails_late_each_time_is_given_up() -> None:
    how = Supervision(restart=Restart.ON_FAILURE, start_limit_interval_sec=1.0, start_limit_burst=3)
    processes = {was_up: _started(how) for was_up in (True, False)}
    again = {was_up: [] for was_up in processes}
    for now_s in (5.0, 10.0, 15.0):
        for was_up, process in processes.items():
            again[was_up].append(again_at_s(process, now_s, was_up=was_up) is not None)
            _starts_again(process, now_s)
    assert again == {True: [True, True, True], False: [True, True, False]}


def test_after_a_long_run_and_after_a_person_the_delay_begins_anew() -> None:
    how = Supervision(
        restart=Restart.ALWAYS, restart_sec=1.0, restart_steps=2, restart_max_delay_sec=4.0
    )
    process = _started(how)
    for failed_s, again_s in ((1.0, 2.0), (3.0, 5.0), (15.0, 16.0), (17.0, 19.0)):
        assert again_at_s(process, failed_s, was_up=True) == again_s
        _starts_again(process, again_s)
    process.restarted_by_hand()
    process.started(19.0)
    assert again_at_s(process, 20.0, was_up=True) == 21.0


@pytest.mark.parametrize(
    ("how", "group"),
    [
        (OnFailure.NODE, "driver helper part"),
        (OnFailure.DEPENDENTS, "driver helper camera viewer part"),
        (OnFailure.ALL, "driver helper camera viewer other part"),
    ],
)
def test_who_goes_down_with_a_process(how: OnFailure, group: str) -> None:
    supervision = Supervision(restart=Restart.ALWAYS, on_failure=how)
    part = planned_node("part", kind=RunKind.ATTACH)
    nodes = (
        planned_node("driver", process="p", supervision=supervision),
        planned_node("helper", process="p", supervision=supervision),
        planned_node("camera", after={"driver": Condition.STARTED}),
        planned_node("viewer", after={"camera": Condition.ACTIVE}),
        planned_node("other"),
        replace(part, run=replace(part.run, component="parts/Part", container="helper")),
    )
    assert " ".join(new_run(plan_of(*nodes), UpOptions()).group("p")) == group


# Stories

DEPENDENTS = replace(AGAIN, on_failure=OnFailure.DEPENDENTS)
VIEWER_GONE = ("graph.missing-node", "/viewer")
PAIR = plan_of(*(planned_node(each, supervision=AGAIN) for each in ("camera", "viewer")))


def _restarted(play: Play) -> list[str]:
    return [each.process for each in play.heard(Restarted)]


def test_a_process_that_fails_again_and_again_is_given_up_with_its_last_failure() -> None:
    how = replace(AGAIN, restart_sec=0.5, start_limit_burst=2, start_limit_interval_sec=60.0)
    play = Play(chain(how))
    play.ways["camera configure"] = "no device"
    play.die("camera")
    play.wait(3.0)
    assert [each.restarts for each in play.heard(GaveUp)] == [1]
    assert play.code == 7
    _, said = play.failures[-1]
    assert said == (
        "cannot keep 'camera' running: it was started 2 times within 60 s (start_limit_burst, "
        "start_limit_interval_sec) and failed again: no device"
    )


@pytest.mark.parametrize("step", ["start", "configure", "connect"])
def test_a_node_that_dies_during_bring_up_comes_again_while_the_others_wait(step: str) -> None:
    viewer = planned_node("viewer", after={"camera": Condition.CONFIGURED}, supervision=AGAIN)
    plan = plan_of(planned_node("camera", supervision=AGAIN), viewer)
    play = Play(plan, ways={f"camera {step}": "die"})
    play.ways.clear()
    play.wait(1.0)
    assert (play.levels, _restarted(play)) == ("4 4", ["camera"])
    assert play.story.count("spawn viewer") == play.story.count("viewer configure") == 1


def test_a_start_counts_towards_the_limit_also_where_another_s_failure_took_it_down() -> None:
    twice = replace(AGAIN, start_limit_burst=2, start_limit_interval_sec=3600)
    play = Play(chain(DEPENDENTS, twice))
    for _ in range(2):  # more starts than the limit, and no failure of its own
        play.die("camera")
        play.wait(5.0)
    play.die("viewer")
    assert [(each.process, each.restarts) for each in play.heard(GaveUp)] == [("viewer", 0)]
    play.wait(5.0)
    assert play.code == 7


def test_what_fails_while_another_is_restarted_keeps_both_at_the_gate() -> None:
    play = Play(chain())
    play.ways["camera configure"] = "hang"
    play.die("camera")
    play.wait(2.0)
    play.die("viewer")
    play.see(VIEWER_GONE)
    assert play.finish("camera configure") == ["camera connect"]
    play.wait(1.0)
    play.see()
    assert (play.levels, _restarted(play)) == ("4 4", ["camera", "viewer"])
    assert play.heard(GateOpened)[-1].nodes == ("/camera", "/viewer")


def test_a_restarted_node_waits_at_a_closed_gate_says_so_and_passes_once_it_opens() -> None:
    play = Play(chain())
    play.see(INTRUDER)
    play.die("camera")
    play.wait(5.0)
    assert play.levels == "3 4"
    (said,) = play.heard(Notice)
    assert said.message.startswith("cannot activate: the verdict is violated\n  graph.undecl")
    assert play.see() == ["program", "camera activate"]


def test_a_restarted_node_waits_for_one_that_is_away_and_orders_do_not() -> None:
    plan = plan_of(planned_node("camera", supervision=AGAIN), planned_node("viewer"))
    play = Play(plan)
    play.ways["program"] = "hang"
    play.die("camera")
    play.wait(1.0)
    play.see(VIEWER_GONE)
    play.finish("program")
    play.wait(5.0)
    (said,) = play.heard(Notice)
    assert said.message.startswith("cannot activate: the system changed before every node was")
    assert play.order(ControlRequest.PAUSE) == ["viewer deactivate"]
    assert _restarted(play) == ["camera"]
    play.see()
    play.order(ControlRequest.RESUME)
    assert [each[0] for each in play.answers.values()] == [0, 0]
    assert play.levels == "4 4"


def test_orders_in_backoff_are_carried_out_at_once() -> None:
    play = Play(chain())
    play.die("camera")
    assert play.order(ControlRequest.PAUSE) == ["viewer deactivate"]
    assert play.phase == "paused"
    play.wait(1.0)
    assert play.levels == "3 3"
    play.order(ControlRequest.RESUME)
    play.die("viewer")
    play.order(ControlRequest.RESTART, node="viewer")
    assert (play.levels, play.phase) == ("4 4", "active")
    play.die("viewer")
    play.down()
    assert [each[0] for each in play.answers.values()] == [0, 0, 0]
    assert play.code == 4
    assert "down, and to be started again: viewer" in play.reason


def test_who_is_restarted_by_hand_in_its_backoff_takes_its_dependents_with_it() -> None:
    """They wait for nothing else; its own gate would stay closed until their delay is over."""
    play = Play(chain(DEPENDENTS, Supervision()))
    play.die("camera")
    play.order(ControlRequest.RESTART, node="camera")
    assert (play.levels, play.phase) == ("4 4", "active")
    assert play.story.count("spawn viewer") == 2


def test_an_order_during_a_restart_waits_neither_for_its_step_nor_for_its_gate() -> None:
    play = Play(chain())
    play.see(INTRUDER)
    play.ways["camera configure"] = "hang"
    play.die("camera")
    play.wait(1.0)
    play.order(ControlRequest.PAUSE)
    assert (play.answers[0][0], play.heard(SystemReached)[-1].reached) == (0, "paused")
    play.finish("camera configure")
    assert _restarted(play) == ["camera"]
    assert play.story.count("camera activate") == 1


@pytest.mark.parametrize(
    ("restart", "again"), [(Restart.ON_FAILURE, False), (Restart.ALWAYS, True)]
)
def test_a_clean_exit_is_started_again_after_only_by_always(restart: Restart, again: bool) -> None:
    play = Play(chain(replace(AGAIN, restart=restart)))
    play.die("camera", status=0)
    play.wait(5.0)
    assert play.run.is_over is not again
    assert (play.levels if again else str(play.code)) == ("4 4" if again else "6")


def test_a_death_is_said_at_once_also_while_another_process_is_taken_down() -> None:
    viewer = planned_node("viewer", supervision=AGAIN, after={"camera": Condition.STARTED})
    camera, other = (
        planned_node(key, supervision=how)
        for key, how in (("camera", DEPENDENTS), ("other", AGAIN))
    )
    play = Play(plan_of(camera, viewer, other), ways={"viewer deactivate": "hang"})
    play.die("camera")
    play.die("other")
    assert [subject for subject, _ in play.failures] == ["/camera", "/other"]
    play.finish("viewer deactivate")
    play.wait(1.0)
    assert play.levels == "4 4 4"
    assert len(play.failures) == 2


@pytest.mark.parametrize("ask", [ControlRequest.RESTART, ControlRequest.RESUME])
def test_an_order_does_not_keep_others_from_coming_again_that_its_gate_waits_for(
    ask: ControlRequest,
) -> None:
    play = Play(chain())
    if ask is ControlRequest.RESUME:
        play.order(ControlRequest.PAUSE)
    play.die("camera")
    play.see(GONE)
    play.order(ask, node="viewer" if ask is ControlRequest.RESTART else "")
    play.wait(1.0)
    play.see()
    assert {each[0] for each in play.answers.values()} == {0}
    assert (play.levels, play.phase, _restarted(play)) == ("4 4", "active", ["camera"])


def test_what_becomes_wrong_while_another_node_is_restarted_is_found_at_once() -> None:
    play = Play(PAIR)
    play.ways["camera configure"] = "hang"
    play.die("camera")
    play.wait(2.0)
    play.see(INTRUDER)
    found = [each.verdict.verdict for each in play.heard(VerdictChanged)]
    assert found[-1] is Outcome.VIOLATED


def test_a_resume_that_a_death_cuts_short_leaves_the_system_paused_and_open_to_orders() -> None:
    play = Play(chain())
    play.order(ControlRequest.PAUSE)
    play.see(INTRUDER)
    play.order(ControlRequest.RESUME)
    play.die("viewer")  # no step of its was under way: nobody else knows more about its death
    code, error = play.answers[1]
    assert (code, error[:29]) == (6, "cannot keep '/viewer' running")
    play.wait(1.0)
    assert (play.phase, _restarted(play)) == ("paused", ["viewer"])
    play.see()
    play.order(ControlRequest.RESUME)
    assert (play.answers[2][0], play.phase) == (0, "active")


@pytest.mark.parametrize(
    ("ask", "node", "step", "dies"),
    [
        (ControlRequest.RESTART, "", "camera configure", "camera"),
        (ControlRequest.RESTART, "camera", "camera configure", "camera"),
        (ControlRequest.RESUME, "", "camera activate", "viewer"),  # behind its gate
    ],
)
def test_an_order_that_a_death_cuts_short_is_finished_once_all_are_back(
    ask: ControlRequest, node: str, step: str, dies: str
) -> None:
    play = Play(PAIR if ask is ControlRequest.RESTART else chain())
    if ask is ControlRequest.RESUME:
        play.order(ControlRequest.PAUSE)
    play.ways[step] = "hang"
    play.order(ask, node=node)
    play.die(dies)
    code, error = [*play.answers.values()][-1]
    assert (code, error.partition(" running")[0]) == (6, f"cannot keep '/{dies}'")
    play.finish(step)
    play.wait(1.0)
    assert (play.levels, play.phase, _restarted(play)) == ("4 4", "active", [dies])
