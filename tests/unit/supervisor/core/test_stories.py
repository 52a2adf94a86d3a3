"""What the reducer wants done, story by story: an input, and the effects that follow from it."""

from __future__ import annotations

from typing import Any

import msgspec
import pytest
from msgspec.structs import replace

from lifecycle.errors import ExitCode
from lifecycle.manifest.model import (
    BY_DEFAULT,
    Condition,
    Consequence,
    Mode,
    OnFailure,
    Reaction,
    RunKind,
)
from lifecycle.supervisor.control.protocol import ControlRequest
from lifecycle.supervisor.core import messages
from lifecycle.supervisor.core.advance import wanted
from lifecycle.supervisor.core.reduce import take
from lifecycle.supervisor.core.state import Level, new_run
from lifecycle.supervisor.run.events import (
    ConsequenceTaken,
    Failure,
    SystemReached,
    VerdictChanged,
)
from lifecycle.supervisor.run.options import UpOptions
from lifecycle.verify.verdict import Stage
from tests.builders import HERE, plan_of, planned_node
from tests.unit.supervisor.core.playbook import AGAIN, CHAIN, GONE, INTRUDER, Play, chain
from tests.unit.supervisor.core.world import READY, verdict


def down(node: str, *, active: bool = True) -> list[str]:
    steps = ["deactivate"] * active + ["disconnect", "cleanup", "shutdown"]
    return [f"{node} {each}" for each in steps]


def up(node: str) -> list[str]:
    return [f"spawn {node}", *(f"{node} {each}" for each in ("start", "configure", "connect"))]


# Bring-up and take-down


def test_a_plain_node_that_will_not_deactivate_is_started_anew_and_has_no_level_between() -> None:
    plain = planned_node("camera", kind=RunKind.PYTHON, managed=False, supervision=AGAIN)
    play = Play(plan_of(plain), ways={"camera deactivate": "it failed"})
    play.order(ControlRequest.PAUSE)
    play.wait(5.0)
    assert play.levels == "1"
    play.order(ControlRequest.RESUME)
    assert (play.levels, play.phase) == ("4", "active")
    play.ways.clear()
    play.order(ControlRequest.PAUSE)
    assert play.levels == "1"
    play.order(ControlRequest.RESUME)
    assert (play.levels, play.phase) == ("4", "active")


def test_what_changes_while_it_is_looked_at_is_looked_at_again() -> None:
    play = Play(CHAIN, ways={"look": "hang"})
    first = play.held.pop()
    assert play.give(messages.Changed()) == []
    play.give(messages.Verified(mark=first.mark, verdict=play.found))
    assert play.levels == "3 3"
    again = play.held.pop()
    assert again.mark > first.mark
    play.ways.clear()
    play.give(messages.Verified(mark=again.mark, verdict=play.found))
    assert play.levels == "4 4"


def test_a_node_that_is_not_as_it_was_verified_is_verified_again() -> None:
    play = Play(
        plan_of(planned_node("camera")), ways={"camera activate": "changed", "look": "hang"}
    )
    look = play.held.pop()
    assert play.give(messages.Verified(mark=look.mark, verdict=play.found))[:2] == [
        "program",
        "camera activate",
    ]
    assert play.levels == "3"
    play.ways.clear()
    again = play.held.pop()
    assert play.give(messages.Verified(mark=again.mark, verdict=play.found)) == ["camera activate"]
    assert play.levels == "4"


def test_a_node_that_was_not_activated_as_things_changed_is_nobody_elses_to_activate() -> None:
    ways = {"camera activate": "changed", "look": "hang"}
    play = Play(plan_of(planned_node("camera")), ways=ways)
    play.give(messages.Verified(mark=play.held.pop().mark, verdict=play.found))
    assert play.give(messages.Saw(levels={"camera": Level.ACTIVE})) == ["camera deactivate"]


def test_a_deadline_that_passed_before_anything_was_started_says_so() -> None:
    run = new_run(CHAIN, UpOptions(timeout_s=2.0))
    take(run, 0.0, messages.Tick())
    take(run, 9.0, messages.Tick())
    assert run.failures[0].message.endswith("within 2 s: nothing was started")


def test_a_step_that_hangs_is_late_and_its_time_without_a_processor_is_not_counted() -> None:
    play = Play(plan_of(planned_node("camera")), ways={"camera configure": "hang"})
    play.now_s += 10.0
    play.give(messages.Tick(waited_s={"camera": 5.0}))
    assert play.wait(5.0) == []
    assert play.wait(1.0) == ["signal camera 0", "sweep camera"]
    assert play.code == 6
    assert play.run.ending.failures[0].rule == "run.deadline"


def test_a_process_that_dies_while_it_is_taken_down_is_in_the_exit_code() -> None:
    play = Play(CHAIN, ways={"viewer deactivate": "die"})
    play.down()
    assert play.code == 6


def test_a_node_waits_for_one_that_another_supervisor_brings_up() -> None:
    plan = plan_of(planned_node("far"), planned_node("near", after={"far": Condition.CONFIGURED}))
    play = Play(plan)
    play.run = new_run(plan, UpOptions(), own=frozenset({"near"}))
    play.give(messages.Tick())
    assert play.levels == "1"
    play.give(messages.Saw(elsewhere={"far": frozenset({Condition.STARTED, Condition.CONFIGURED})}))
    assert play.levels == "4"


@pytest.mark.parametrize(("managed", "held"), [(True, "viewer configure"), (False, "spawn viewer")])
def test_a_node_waits_for_what_another_shows_and_again_once_that_has_died(
    managed: bool, held: str
) -> None:
    how = msgspec.structs.replace(AGAIN, on_failure=OnFailure.DEPENDENTS)
    viewer = planned_node("viewer", kind=RunKind.COMMAND, managed=managed, after={"camera": READY})
    play = Play(plan_of(planned_node("camera", supervision=how), viewer))
    shows = messages.Saw(shown={"camera": frozenset({READY})})
    assert held in play.give(shows)
    play.die("camera")
    assert held not in play.wait(5.0)
    assert held in play.give(shows)


def test_the_deadline_names_what_is_waited_for_and_where_that_is_written() -> None:
    play = Play(plan_of(planned_node("camera"), planned_node("viewer", after={"camera": READY})))
    play.wait(30.0)
    (failure,) = [each for each in play.events if isinstance(each, Failure)]
    said = f"/viewer waits to configure until /camera publishes scan ({HERE.spelled})"
    assert (failure.rule, play.code) == ("run.deadline", 6)
    assert said in failure.message


def test_the_end_of_other_hosts_is_no_violation_of_this_one() -> None:
    play = Play(CHAIN, stop_after_s=5.0)
    play.see(GONE)
    play.give(messages.Saw(left=frozenset({"/camera"})))
    play.wait(6.0)
    assert play.code == 0
    for other in (("graph.missing-node", "/viewer"), INTRUDER):
        play = Play(CHAIN, stop_after_s=5.0)
        play.see(GONE, other)
        play.give(messages.Saw(left=frozenset({"/camera"})))
        play.wait(7.0)
        assert play.code == 4


# Failures


def test_a_death_ends_the_run_unless_it_is_to_keep_going() -> None:
    play = Play(CHAIN)
    play.die("camera")
    assert (play.code, play.reason) == (6, "failed: /camera (run.process-died)")
    play = Play(CHAIN, keep_going=True, stop_after_s=10.0)
    play.die("camera")
    assert play.levels == "0 4"
    play.wait(10.0)
    assert (play.code, play.reason) == (6, "done, but failed: /camera (run.process-died)")


def test_a_death_before_the_system_was_up_ends_the_run_also_if_it_is_to_keep_going() -> None:
    play = Play(CHAIN, ways={"viewer configure": "hang"}, keep_going=True)
    play.die("camera")
    play.wait(60.0)
    assert (play.code, play.reason) == (6, "failed: /camera (run.process-died)")


def test_a_node_that_others_activate_is_deactivated_and_at_last_left() -> None:
    play = Play(plan_of(planned_node("base", kind=RunKind.ATTACH)))
    play.order(ControlRequest.PAUSE)
    for _ in range(5):
        assert play.give(messages.Saw(levels={"base": Level.ACTIVE})) == ["base deactivate"]
    assert play.give(messages.Saw(levels={"base": Level.ACTIVE})) == []
    assert play.order(ControlRequest.RESUME) == []
    assert play.answers[1][0] is ExitCode.VIOLATED


@pytest.mark.parametrize(
    ("lasts_s", "code", "why"),
    [
        (2.0, 4, "done, but violated meanwhile,"),
        (0.2, 0, "done; violated for no longer than 1 s, and not counted:"),
        (20.0, 4, "done, but violated;"),
    ],
)
def test_a_violation_that_lasted_is_in_the_exit_code(lasts_s: float, code: int, why: str) -> None:
    play = Play(CHAIN, stop_after_s=10.0)
    play.see(INTRUDER)
    play.wait(lasts_s)
    play.see()
    play.wait(10.0)
    assert (play.code, play.reason) == (code, f"{why} /intruder (graph.undeclared-node)")


def test_who_needs_a_node_that_is_kept_inactive_is_kept_inactive_too() -> None:
    play = Play(CHAIN, ways={"camera activate": "hang"})
    camera, viewer = (play.run.nodes[key] for key in ("camera", "viewer"))
    assert wanted(play.run, viewer) is Level.ACTIVE
    camera.withheld, camera.request, play.run.passage = "a violation", None, None
    assert wanted(play.run, viewer) is viewer.gate


def test_a_violation_that_lasted_counts_also_where_nothing_is_to_be_activated() -> None:
    play = Play(
        plan_of(planned_node("driver", managed=False, kind=RunKind.COMMAND)), stop_after_s=10.0
    )
    play.see(INTRUDER)
    play.wait(2.0)
    play.see()
    play.wait(10.0)
    assert play.code == 4


# Orders


def test_a_paused_system_is_inactive_until_it_is_judged_anew() -> None:
    play = Play(CHAIN)
    assert play.order(ControlRequest.PAUSE) == ["viewer deactivate", "camera deactivate"]
    assert play.phase == "paused"
    play.see(INTRUDER)
    play.order(ControlRequest.RESUME)
    assert play.wait(1.0) == []
    assert play.answers[1][0] is ExitCode.VIOLATED
    assert play.phase == "paused"
    play.see()
    assert play.order(ControlRequest.RESUME) == ["program", "camera activate", "viewer activate"]
    assert [each[0] for each in play.answers.values()] == [0, 4, 0]


def test_one_node_is_restarted_through_the_gate_and_waits_for_an_order_if_that_stays_closed() -> (
    None
):
    play = Play(CHAIN)
    restarted = play.order(ControlRequest.RESTART, node="viewer")
    assert restarted == [
        *(*down("viewer"), "signal viewer 0", "sweep viewer"),
        *(*up("viewer"), "program", "viewer activate"),
    ]
    play.see(INTRUDER)
    play.order(ControlRequest.RESTART, node="viewer")
    play.wait(1.0)
    assert play.answers[1][0] is ExitCode.VIOLATED
    assert play.phase == "held"
    assert play.see() == []
    play.order(ControlRequest.RESUME)
    assert play.levels == "4 4"


def test_a_plain_process_that_was_restarted_passes_the_gate_and_its_ports_are_programmed() -> None:
    plain = planned_node("driver", managed=False, kind=RunKind.COMMAND, supervision=AGAIN)
    play = Play(plan_of(plain, planned_node("viewer")))
    play.die("driver")
    assert play.wait(5.0) == ["spawn driver", "driver start", "program"]
    said = [each.reached for each in play.events if isinstance(each, SystemReached)]
    assert said == ["connected", *2 * ["verified", "active"]]


def test_a_gate_stays_closed_for_good_only_by_a_verdict_of_what_is_there_now() -> None:
    play = Play(CHAIN, ways={"camera connect": "hang"})
    play.found = verdict(INTRUDER)
    connects = play.held.pop()
    play.ways["look"] = "hang"
    play.give(messages.Replied(node="camera", number=connects.number, level=Level.CONNECTED))
    first = play.held.pop()
    play.give(messages.Changed())  # while it was looked
    play.give(messages.Verified(mark=first.mark, verdict=play.found))
    play.wait(3.0)
    assert play.run.ending is None
    looks = play.held.pop()
    play.ways.clear()
    play.found = verdict()
    play.give(messages.Verified(mark=looks.mark, verdict=play.found))
    assert play.levels == "4 4"


@pytest.mark.parametrize(("restarts", "code"), [(True, 0), (False, 4)])
def test_an_endpoint_of_nobody_counts_only_where_no_process_is_coming_up(
    restarts: bool, code: int
) -> None:
    play = Play(chain(), stop_after_s=10.0)
    if restarts:
        play.ways["viewer configure"] = "hang"
        play.die("viewer")
        play.wait(2.0)
    play.see(("graph.unattributed-endpoint", "/rosout"))
    play.wait(3.0)
    play.see()
    if restarts:
        play.ways.clear()
        asked = play.held.pop()
        play.give(messages.Replied(node="viewer", number=asked.number, level=Level.CONFIGURED))
    play.wait(1.0)
    assert play.levels == "4 4"
    play.wait(10.0)
    assert play.code == code


def test_an_order_waits_for_the_one_under_way_and_fits_then_or_not() -> None:
    play = Play(CHAIN, ways={"viewer deactivate": "hang"})
    play.order(ControlRequest.PAUSE)
    play.order(ControlRequest.PAUSE)
    assert play.answers == {}
    asked = play.held.pop()
    play.ways.clear()
    play.give(messages.Replied(node="viewer", number=asked.number, level=Level.CONNECTED))
    assert [each[0] for each in play.answers.values()] == [ExitCode.OK, ExitCode.USAGE]


MODES = (Mode(name="all", at=HERE), Mode(name="less", inactive=("camera",), at=HERE))


class _Looked(Play):
    """Notes whether nodes were on their way through the gate when the last look began."""

    on_the_way = True

    def _answer(self, effect: Any) -> Any:
        if isinstance(effect, messages.Look):
            self.on_the_way = self.run.passage is not None
        return super()._answer(effect)


def test_after_each_passage_it_is_looked_again_as_looks_on_the_way_measure_nothing() -> None:
    nodes = (planned_node(each, supervision=AGAIN) for each in ("camera", "viewer"))
    play = _Looked(replace(plan_of(*nodes), modes=MODES))
    for ask, what in (
        (ControlRequest.RESTART, {"node": "viewer"}),
        (ControlRequest.PAUSE, {}),
        (ControlRequest.RESUME, {}),
        (ControlRequest.MODE, {"mode": "less"}),
        (ControlRequest.MODE, {"mode": "all"}),
    ):
        play.on_the_way = ask is not ControlRequest.PAUSE
        play.order(ask, **what)
        assert (play.answers[len(play.answers) - 1], play.on_the_way) == ((0, ""), False), ask
    play.on_the_way = True
    play.die("viewer")
    play.wait(2.0)
    assert (play.levels, play.on_the_way) == ("4 4", False)


@pytest.mark.parametrize(
    ("what", "asked"),
    [
        (Consequence.PAUSE, ["viewer deactivate", "camera deactivate"]),
        (Consequence.STOP, ["viewer deactivate"]),
        (Consequence.REPORT, []),
    ],
)
def test_a_violation_that_lasts_has_its_consequence(what: Consequence, asked: list[str]) -> None:
    plan = replace(CHAIN, on_violation=(Reaction(rule=BY_DEFAULT, what=what),))
    play = Play(plan)
    play.see(INTRUDER)
    found = play.wait(1.0)
    assert found[: len(asked)] == asked
    assert (play.run.ending is not None) == (what is Consequence.STOP)
    if what is Consequence.STOP:
        why = "on_violation: stop (graph.undeclared-node of /intruder)"
        assert (play.code, play.reason.partition(";")[0]) == (4, why)


def test_a_node_that_was_deactivated_for_a_violation_stays_so_until_it_is_resumed() -> None:
    reaction = Reaction(rule="param", what=Consequence.DEACTIVATE)
    plan = replace(chain(), on_violation=(reaction,))
    play = Play(plan)
    play.see(("param.value-differs", "/viewer"))
    assert play.wait(1.0) == ["viewer deactivate"]
    play.see()
    assert play.levels == "4 3"
    assert play.run.nodes["viewer"].withheld.startswith("on_violation: deactivate")
    play.die("viewer")
    play.wait(2.0)
    assert play.levels == "4 3"
    play.order(ControlRequest.RESUME)
    assert play.levels == "4 4"


def test_a_node_that_others_activate_again_for_ever_has_its_consequence_once() -> None:
    reaction = Reaction(rule="param", what=Consequence.DEACTIVATE)
    play = Play(
        replace(plan_of(planned_node("base", kind=RunKind.ATTACH)), on_violation=(reaction,))
    )
    play.see(("param.value-differs", "/base"))
    assert play.wait(1.0) == ["base deactivate"]
    for _ in range(6):
        play.give(messages.Saw(levels={"base": Level.ACTIVE}))
    play.wait(2.0)
    assert (play.levels, len(play.heard(ConsequenceTaken))) == ("4", 1)


@pytest.mark.parametrize("what", [Consequence.PAUSE, Consequence.DEACTIVATE])
@pytest.mark.parametrize("resumed", [False, True])
def test_a_run_that_ends_while_a_violation_keeps_it_inactive_is_no_success(
    what: Consequence, resumed: bool
) -> None:
    plan = replace(chain(), on_violation=(Reaction(rule="param", what=what),))
    play = Play(plan)
    play.see(("param.value-differs", "/viewer"))
    play.wait(1.0)
    play.see()
    if resumed:
        play.order(ControlRequest.RESUME)
    play.stop("terminated", ExitCode.TERMINATED)
    play.wait(10.0)
    assert play.code == (0 if resumed else 4)


# What is no node's


SERVER_DIED = Failure(rule="run.process-died", subject="the server", message="pid 7 died")


@pytest.mark.parametrize("keep_going", [False, True])
def test_a_server_that_dies_ends_the_run(keep_going: bool) -> None:
    play = Play(CHAIN, keep_going=keep_going)
    play.give(messages.Broken(failure=SERVER_DIED))
    play.wait(5.0)
    (failed,) = (each for each in play.events if isinstance(each, Failure))
    assert (failed.subject, failed.message) == ("the server", "pid 7 died")
    assert play.code == ExitCode.BRING_UP_FAILED


def test_a_server_that_dies_while_the_run_ends_is_passed_over() -> None:
    play = Play(CHAIN, ways={"viewer shutdown": "hang"})
    play.down()
    before = list(play.events)
    play.give(messages.Broken(failure=SERVER_DIED))
    assert not any(isinstance(each, Failure) for each in play.events[len(before) :])


def test_what_is_found_beside_all_looks_ends_the_run_and_is_said() -> None:
    play = Play(CHAIN, ways={"camera connect": "hang"})
    found = verdict(INTRUDER)
    play.give(messages.Refused(verdict=found))
    (said,) = (each for each in play.events if isinstance(each, VerdictChanged))
    assert (said.verdict, said.stage) == (found, Stage.CONNECTED)
    play.wait(30.0)
    assert play.code == ExitCode.VIOLATED


def test_a_stranger_that_stays_while_an_order_is_carried_out_is_in_the_exit_code() -> None:
    play = Play(CHAIN, ways={"viewer deactivate": "hang"}, stop_after_s=9.0)
    play.order(ControlRequest.RESTART, node="/viewer")
    play.see(INTRUDER)
    play.wait(1.5)
    play.see()
    play.ways.clear()
    (held,) = play.held
    play.give(messages.Replied(node="viewer", number=held.number, level=Level.CONNECTED))
    play.wait(2.0)
    assert play.levels == "4 4"
    play.wait(30.0)
    assert play.code == ExitCode.VIOLATED


def test_an_order_to_a_system_that_is_taken_down_is_refused_at_once() -> None:
    play = Play(CHAIN, ways={"viewer deactivate": "hang"})
    play.down()
    play.order(ControlRequest.PAUSE)
    assert play.answers[0] == (6, "cannot go on: 'robot' is being taken down")
