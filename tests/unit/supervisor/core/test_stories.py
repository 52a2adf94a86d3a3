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
    Restart,
    RunKind,
    Supervision,
)
from lifecycle.plan.build import attached_to
from lifecycle.plan.model import ExpectedParameter, ModeParameters, Plan
from lifecycle.supervisor.control.protocol import ControlRequest
from lifecycle.supervisor.core import inputs
from lifecycle.supervisor.core.reduce import take
from lifecycle.supervisor.core.state import Level, Options, new_run
from lifecycle.supervisor.run.events import (
    Failure,
    GaveUp,
    ManifestApplied,
    Restarted,
    SystemReached,
    VerdictChanged,
)
from lifecycle.verify.verdict import Stage
from tests.builders import HERE, plan_of, planned_node
from tests.unit.supervisor.core.playbook import Play
from tests.unit.supervisor.core.world import READY, verdict

AGAIN = Supervision(restart=Restart.ON_FAILURE, restart_sec=1.0)
CHAIN = plan_of(planned_node("camera"), planned_node("viewer", after={"camera": Condition.ACTIVE}))
INTRUDER = ("graph.undeclared-node", "/intruder")
GONE = ("graph.missing-node", "/camera")


def chain(camera: Supervision = AGAIN, viewer: Supervision = AGAIN) -> Plan:
    return plan_of(
        planned_node("camera", supervision=camera),
        planned_node("viewer", supervision=viewer, after={"camera": Condition.ACTIVE}),
    )


def down(node: str, *, active: bool = True) -> list[str]:
    steps = ["deactivate"] * active + ["disconnect", "cleanup", "shutdown"]
    return [f"{node} {each}" for each in steps]


def up(node: str) -> list[str]:
    return [f"spawn {node}", *(f"{node} {each}" for each in ("start", "configure", "connect"))]


# Bring-up and take-down


def test_a_system_comes_up_along_its_order_and_goes_down_in_reverse() -> None:
    play = Play(CHAIN)
    assert play.levels == "4 4"
    assert play.phase == "active"
    assert play.down() == [
        *(*down("viewer"), "signal viewer 0"),
        *("camera deactivate", "sweep viewer", *down("camera", active=False)),
        *("signal camera 0", "sweep camera"),
    ]
    assert play.code == 0


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


@pytest.mark.parametrize(
    ("options", "levels", "furthest"),
    [
        ({"until": Level.CONNECTED, "hold_s": 0.0}, "3 3", "connected"),
        ({"until": Level.CONNECTED, "verifies": True, "hold_s": 0.0}, "3 3", "verified"),
        ({"hold_s": 0.0}, "4 4", "active"),
    ],
)
def test_a_system_is_brought_as_far_as_asked(
    options: dict[str, Any], levels: str, furthest: str
) -> None:
    play = Play(CHAIN, **{**options, "hold_s": None})
    assert play.levels == levels
    play = Play(CHAIN, **options)
    assert play.run.furthest == furthest
    assert play.code == 0


def test_nothing_is_activated_on_a_violated_verdict_and_what_stays_wrong_ends_the_run() -> None:
    play = Play(CHAIN, ways={"look": "hang"})
    look = play.held.pop()
    play.found = verdict(INTRUDER)
    play.give(inputs.Verified(mark=look.mark, verdict=play.found))
    assert play.levels == "3 3"
    assert play.wait(1.0)[:1] == ["viewer disconnect"]
    assert play.code == 4


def test_what_changes_while_it_is_looked_at_is_looked_at_again() -> None:
    play = Play(CHAIN, ways={"look": "hang"})
    first = play.held.pop()
    assert play.give(inputs.Changed()) == []
    play.give(inputs.Verified(mark=first.mark, verdict=play.found))
    assert play.levels == "3 3"
    again = play.held.pop()
    assert again.mark > first.mark
    play.ways.clear()
    play.give(inputs.Verified(mark=again.mark, verdict=play.found))
    assert play.levels == "4 4"


def test_a_node_that_is_not_as_it_was_verified_is_verified_again() -> None:
    play = Play(
        plan_of(planned_node("camera")), ways={"camera activate": "changed", "look": "hang"}
    )
    look = play.held.pop()
    assert play.give(inputs.Verified(mark=look.mark, verdict=play.found))[:2] == [
        "program",
        "camera activate",
    ]
    assert play.levels == "3"
    play.ways.clear()
    again = play.held.pop()
    assert play.give(inputs.Verified(mark=again.mark, verdict=play.found)) == ["camera activate"]
    assert play.levels == "4"


def test_networks_that_cannot_be_programmed_end_the_run_before_anything_is_activated() -> None:
    play = Play(CHAIN, ways={"program": "no nft"})
    play.wait(1.0)
    assert not any(each.endswith(" activate") for each in play.said())
    assert [each.rule for each in play.run.ending.failures] == ["run.not-programmed"]
    assert play.code == 6


def test_a_deadline_that_passed_before_anything_was_started_says_so() -> None:
    run = new_run(CHAIN, Options(timeout_s=2.0))
    take(run, 0.0, inputs.Tick())
    take(run, 9.0, inputs.Tick())
    assert run.failures[0].message.endswith("within 2 s: nothing was started")


def test_all_that_fails_within_a_moment_is_named() -> None:
    plan = plan_of(planned_node("camera"), planned_node("viewer"))
    play = Play(plan, ways={"camera configure": "no device", "viewer configure": "no display"})
    named = [each.subject for each in play.events if isinstance(each, Failure)]
    assert named == ["/camera", "/viewer"]
    assert play.code == 6


def test_a_step_that_hangs_is_late_and_its_time_without_a_processor_is_not_counted() -> None:
    play = Play(plan_of(planned_node("camera")), ways={"camera configure": "hang"})
    play.now_s += 10.0
    play.give(inputs.Tick(waited_s={"camera": 5.0}))
    assert play.wait(5.0) == []
    assert play.wait(1.0) == ["signal camera 0", "sweep camera"]
    assert play.code == 6
    assert play.run.ending.failures[0].rule == "run.deadline"


def test_a_second_interrupt_kills_what_is_left() -> None:
    play = Play(CHAIN, ways={"viewer deactivate": "hang"})
    play.give(inputs.Stop(reason="interrupted", code=ExitCode.INTERRUPTED, hurries=True))
    assert not play.run.is_over
    killed = play.give(inputs.Stop(reason="interrupted", code=ExitCode.INTERRUPTED, hurries=True))
    assert {"signal camera 9", "signal viewer 9"} <= {*killed}
    assert play.code == 130


def test_a_process_that_dies_while_it_is_taken_down_is_in_the_exit_code() -> None:
    play = Play(CHAIN, ways={"viewer deactivate": "die"})
    play.down()
    assert play.code == 6


def test_a_node_of_others_is_configured_and_left_as_it_was_found() -> None:
    plan = plan_of(planned_node("base", kind=RunKind.ATTACH))
    play = Play(plan)
    assert play.levels == "4"
    assert play.down() == ["base deactivate", "base disconnect", "base cleanup"]
    assert play.code == 0


def test_a_node_waits_for_one_that_another_supervisor_brings_up() -> None:
    plan = plan_of(planned_node("far"), planned_node("near", after={"far": Condition.CONFIGURED}))
    play = Play(plan)
    play.run = new_run(plan, Options(), own=frozenset({"near"}))
    play.give(inputs.Tick())
    assert play.levels == "1"
    play.give(inputs.Saw(elsewhere={"far": frozenset({Condition.STARTED, Condition.CONFIGURED})}))
    assert play.levels == "4"


def test_what_ran_before_is_attached_to_before_anything_is_begun() -> None:
    plan = plan_of(planned_node("camera"), planned_node("viewer"), planned_node("far"))
    play = Play(plan)
    play.run = new_run(plan, Options(), own=frozenset({"camera", "viewer"}))
    play.run.adopting = True
    assert play.give(inputs.Tick()) == []
    attached, names = attached_to(plan, {"viewer"}), frozenset({"/viewer"})
    asked = play.give(inputs.Adopted(plan=attached, nodes=names))
    assert [each for each in asked if each.startswith("spawn")] == ["spawn camera"]
    assert (sorted(play.run.nodes), play.levels) == (["camera", "viewer"], "4 4")
    assert (play.run.adopted, play.run.adopting) == (names, False)


@pytest.mark.parametrize(("managed", "held"), [(True, "viewer configure"), (False, "spawn viewer")])
def test_a_node_waits_for_what_another_shows_and_again_once_that_has_died(
    managed: bool, held: str
) -> None:
    how = msgspec.structs.replace(AGAIN, on_failure=OnFailure.DEPENDENTS)
    viewer = planned_node("viewer", kind=RunKind.COMMAND, managed=managed, after={"camera": READY})
    play = Play(plan_of(planned_node("camera", supervision=how), viewer))
    shows = inputs.Saw(shown={"camera": frozenset({READY})})
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
    play = Play(CHAIN, hold_s=5.0)
    play.see(GONE)
    play.give(inputs.Saw(left=frozenset({"/camera"})))
    play.wait(6.0)
    assert play.code == 0


# Failures


def test_a_node_that_crashed_comes_again_through_its_gate_and_what_it_left_is_swept_first() -> None:
    play = Play(chain())
    assert play.die("camera") == ["sweep camera"]
    assert play.levels == "0 4"
    assert play.wait(1.0) == [*up("camera"), "program", "camera activate"]
    assert [each.process for each in play.events if isinstance(each, Restarted)] == ["camera"]
    play.down()
    assert play.code == 0


def test_a_process_that_fails_again_and_again_is_given_up() -> None:
    how = msgspec.structs.replace(AGAIN, start_limit_burst=2, start_limit_interval_sec=60.0)
    play = Play(chain(how), ways={"camera configure": "no device"})
    play.wait(3.0)
    assert sum(isinstance(each, GaveUp) for each in play.events) == 1
    assert play.code == 7


def test_dependents_go_down_in_order_and_come_again_with_it() -> None:
    play = Play(chain(msgspec.structs.replace(AGAIN, on_failure=OnFailure.DEPENDENTS)))
    assert play.die("camera")[-2:] == ["signal viewer 0", "sweep viewer"]
    play.wait(1.0)
    assert play.levels == "4 4"


def test_a_death_ends_the_run_unless_it_is_to_keep_going() -> None:
    play = Play(CHAIN)
    play.die("camera")
    assert play.code == 6
    play = Play(CHAIN, keep_going=True)
    play.die("camera")
    assert play.levels == "0 4"
    play.down()
    assert play.code == 6


def test_a_hang_is_ended_by_the_watchdog_and_one_that_passes_is_not() -> None:
    how = msgspec.structs.replace(AGAIN, watchdog_sec=2.0)
    play = Play(chain(how))
    play.give(inputs.Silent(node="camera", why="it hangs", hangs=True))
    play.give(inputs.Silent(node="camera"))
    assert play.wait(3.0) == []
    play.give(inputs.Silent(node="camera", why="it hangs", hangs=True))
    assert play.wait(2.0) == ["signal camera 9", "sweep camera"]
    assert "its watchdog ended it" in play.run.processes["camera"].failures[0].message


def test_a_node_that_others_activate_is_deactivated_and_at_last_left() -> None:
    play = Play(plan_of(planned_node("base", kind=RunKind.ATTACH)))
    play.order(ControlRequest.PAUSE)
    for _ in range(5):
        assert play.give(inputs.Saw(levels={"base": Level.ACTIVE})) == ["base deactivate"]
    assert play.give(inputs.Saw(levels={"base": Level.ACTIVE})) == []
    assert play.order(ControlRequest.RESUME) == []
    assert play.answers[1][0] is ExitCode.VIOLATED


@pytest.mark.parametrize(("lasts_s", "code"), [(2.0, 4), (0.2, 0)])
def test_a_violation_that_lasted_is_in_the_exit_code(lasts_s: float, code: int) -> None:
    play = Play(CHAIN, hold_s=10.0)
    play.see(INTRUDER)
    play.wait(lasts_s)
    play.see()
    play.wait(10.0)
    assert play.code == code


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
    assert said == 2 * ["connected", "verified", "active"]


def test_a_gate_stays_closed_for_good_only_by_a_verdict_of_what_is_there_now() -> None:
    play = Play(CHAIN, ways={"camera connect": "hang"})
    play.found = verdict(INTRUDER)
    connects = play.held.pop()
    play.ways["look"] = "hang"
    play.give(inputs.Replied(node="camera", number=connects.number, level=Level.CONNECTED))
    first = play.held.pop()
    play.give(inputs.Changed())  # while it was looked
    play.give(inputs.Verified(mark=first.mark, verdict=play.found))
    play.wait(3.0)
    assert play.run.ending is None
    looks = play.held.pop()
    play.ways.clear()
    play.found = verdict()
    play.give(inputs.Verified(mark=looks.mark, verdict=play.found))
    assert play.levels == "4 4"


@pytest.mark.parametrize(("restarts", "code"), [(True, 0), (False, 4)])
def test_an_endpoint_of_nobody_counts_only_where_no_process_is_coming_up(
    restarts: bool, code: int
) -> None:
    play = Play(chain(), hold_s=10.0)
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
        play.give(inputs.Replied(node="viewer", number=asked.number, level=Level.CONFIGURED))
    play.wait(1.0)
    assert play.levels == "4 4"
    play.wait(10.0)
    assert play.code == code


def test_a_system_is_connected_again_once_its_plain_node_has_appeared() -> None:
    plain = planned_node("driver", managed=False, kind=RunKind.COMMAND, supervision=AGAIN)
    play = Play(plan_of(plain, planned_node("viewer")))
    play.ways["driver start"] = "hang"
    play.see(("graph.missing-node", "/driver"))
    play.die("driver")
    play.wait(5.0)
    appears = play.held.pop()
    said = [each.reached for each in play.events if isinstance(each, SystemReached)]
    assert said == ["connected", "verified", "active"]
    before = len(play.events)
    play.give(inputs.Replied(node="driver", number=appears.number, level=Level.STARTED))
    play.see()
    said = [each.reached for each in play.events[before:] if isinstance(each, SystemReached)]
    assert said == ["connected", "verified", "active"]


def test_an_order_waits_for_the_one_under_way_and_fits_then_or_not() -> None:
    play = Play(CHAIN, ways={"viewer deactivate": "hang"})
    play.order(ControlRequest.PAUSE)
    play.order(ControlRequest.PAUSE)
    assert play.answers == {}
    asked = play.held.pop()
    play.ways.clear()
    play.give(inputs.Replied(node="viewer", number=asked.number, level=Level.CONNECTED))
    assert [each[0] for each in play.answers.values()] == [ExitCode.OK, ExitCode.USAGE]


MODES = (Mode(name="all", at=HERE), Mode(name="less", inactive=("camera",), at=HERE))


def test_a_mode_takes_nodes_out_at_once_and_back_in_through_the_gate() -> None:
    plan = replace(plan_of(planned_node("camera"), planned_node("viewer")), modes=MODES)
    play = Play(plan)
    play.see(INTRUDER)
    assert play.order(ControlRequest.MODE, mode="less") == ["camera deactivate"]
    play.order(ControlRequest.MODE, mode="all")
    play.wait(1.0)
    assert [each[0] for each in play.answers.values()] == [0, 4]
    assert play.run.mode == "less"
    play.see()
    play.order(ControlRequest.MODE, mode="all")
    assert play.levels == "4 4"


def test_a_manifest_is_applied_and_one_whose_node_fails_is_taken_back() -> None:
    plan = plan_of(planned_node("camera"), planned_node("viewer"))
    other = plan_of(planned_node("camera"), planned_node("arm"))
    play = Play(plan)
    play.order(ControlRequest.APPLY, plan=other)
    assert sorted(play.run.nodes) == ["arm", "camera"]
    assert play.levels == "4 4"
    assert play.run.revision == 2
    play.ways["viewer configure"] = "no display"
    play.order(ControlRequest.APPLY, plan=plan)
    assert [each[0] for each in play.answers.values()] == [0, ExitCode.BRING_UP_FAILED]
    assert sorted(play.run.nodes) == ["arm", "camera"]
    assert play.levels == "4 4"
    assert play.run.revision == 2
    stages = [each.stage for each in play.events if isinstance(each, ManifestApplied)]
    assert stages == ["begun", "applied", "begun", "rolling_back", "rolled_back"]


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


# What is no node's


SERVER_DIED = Failure(rule="run.process-died", subject="the server", message="pid 7 died")


@pytest.mark.parametrize(
    ("finds", "keep_going", "ends"), [(False, True, True), (True, False, True), (True, True, False)]
)
def test_a_server_that_dies_ends_the_run_unless_nodes_only_found_each_other_by_it(
    finds: bool, keep_going: bool, ends: bool
) -> None:
    play = Play(CHAIN, keep_going=keep_going)
    play.give(inputs.Broken(failure=SERVER_DIED, finds=finds))
    play.wait(5.0)
    (failed,) = (each for each in play.events if isinstance(each, Failure))
    assert (failed.subject, failed.message) == ("the server", "pid 7 died")
    assert (failed.rule, failed.ends_run) == ("run.process-died", ends)
    assert play.run.is_over == ends
    if ends:
        assert play.code == ExitCode.BRING_UP_FAILED
    assert play.run.broken == finds


def test_a_server_that_dies_while_the_run_ends_is_passed_over() -> None:
    play = Play(CHAIN, ways={"viewer shutdown": "hang"})
    play.down()
    before = list(play.events)
    play.give(inputs.Broken(failure=SERVER_DIED, finds=True))
    assert not any(isinstance(each, Failure) for each in play.events[len(before) :])


def test_what_is_found_beside_all_looks_ends_the_run_and_is_said() -> None:
    play = Play(CHAIN, ways={"camera connect": "hang"})
    found = verdict(INTRUDER)
    play.give(inputs.Refused(verdict=found))
    (said,) = (each for each in play.events if isinstance(each, VerdictChanged))
    assert (said.verdict, said.stage) == (found, Stage.CONNECTED)
    play.wait(30.0)
    assert play.code == ExitCode.VIOLATED


def test_a_mode_whose_parameters_a_node_refuses_is_left_again_with_the_node_s_reason() -> None:
    modes = Mode(name="day", at=HERE), Mode(name="night", at=HERE)
    rates = [
        ModeParameters(
            mode=mode.name,
            parameters=(ExpectedParameter(name="rate", type="integer", value=value, at=HERE),),
        )
        for mode, value in zip(modes, (10, 5), strict=True)
    ]
    camera = replace(planned_node("camera"), mode_parameters=tuple(rates))
    play = Play(replace(plan_of(camera), modes=modes), ways={"give camera": "rate is read-only"})
    play.order(ControlRequest.MODE, mode="night")
    play.wait(5.0)
    code, error = play.answers[0]
    assert code == ExitCode.BRING_UP_FAILED
    assert "cannot enter mode 'night': rate is read-only" in error
    assert play.run.mode == "day"


def test_a_bring_up_that_takes_too_long_names_the_node_that_it_waits_for_and_its_process() -> None:
    play = Play(CHAIN, ways={"camera configure": "hang"}, timeout_s=3.0)
    play.wait(4.0)
    (failed,) = (each for each in play.events if isinstance(each, Failure))
    assert (failed.subject, failed.process) == ("/camera", "camera")
    play.wait(30.0)
    assert play.code == ExitCode.BRING_UP_FAILED


def test_a_stranger_that_stays_while_an_order_is_carried_out_is_in_the_exit_code() -> None:
    play = Play(CHAIN, ways={"viewer deactivate": "hang"}, hold_s=9.0)
    play.order(ControlRequest.RESTART, node="/viewer")
    play.see(INTRUDER)
    play.wait(1.5)
    play.see()
    play.ways.clear()
    (held,) = play.held
    play.give(inputs.Replied(node="viewer", number=held.number, level=Level.CONNECTED))
    play.wait(2.0)
    assert play.levels == "4 4"
    play.wait(30.0)
    assert play.code == ExitCode.VIOLATED
