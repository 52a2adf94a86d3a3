"""Stories of bring-ups, of the gate and of how runs end; what is said of each."""

from __future__ import annotations

import pytest
from msgspec.structs import replace

from lifecycle.errors import ExitCode
from lifecycle.manifest.model import (
    Condition,
    Discovery,
    OnFailure,
    RosArguments,
    RunKind,
    Timeouts,
)
from lifecycle.supervisor.control.protocol import ControlRequest
from lifecycle.supervisor.core import messages
from lifecycle.supervisor.core.failure import ALSO_S
from lifecycle.supervisor.run.events import Failure, Notice, RestartScheduled
from tests.builders import plan_of, planned_node
from tests.unit.supervisor.core.playbook import AGAIN, CHAIN, GONE, INTRUDER, Play, chain
from tests.unit.supervisor.session_world import DIALLING

CHANGED = "the system changed before every node was activated"
OVER = "the 30 s of the bring-up are over (--timeout)"
TAKEN_DOWN = "cannot go on: 'robot' is being taken down"
STRANGER = "/intruder (graph.undeclared-node)"
PASSED = f"violated for no longer than 1 s, and not counted: {STRANGER}"

# Bring-up


@pytest.mark.parametrize(
    ("condition", "step", "held"),
    [
        (Condition.STARTED, "a start", "spawn b"),
        (Condition.CONFIGURED, "a configure", "b configure"),
        (Condition.CONNECTED, "a connect", "b connect"),
        (Condition.ACTIVE, "a activate", "b activate"),
    ],
)
def test_a_condition_holds_the_step_that_it_names_and_none_before(
    condition: Condition, step: str, held: str
) -> None:
    plan = plan_of(planned_node("b", after={"a": condition}), planned_node("a"))
    play = Play(plan, ways={step: "hang"})
    steps = ["spawn b", "b start", "b configure", "b connect", "b activate"]
    assert [each for each in steps if each in play.story] == steps[: steps.index(held)]
    assert held in play.finish(step)


def test_a_node_waits_until_another_is_healthy() -> None:
    plan = plan_of(planned_node("a"), planned_node("b", after={"a": Condition.HEALTHY}))
    play = Play(plan)
    assert play.levels == "4 3"
    play.give(messages.Saw(health={"a": True}))
    assert play.levels == "4 4"


def test_a_node_that_died_is_healthy_once_it_says_so_again() -> None:
    plan = plan_of(
        planned_node("a", supervision=replace(AGAIN, on_failure=OnFailure.DEPENDENTS)),
        planned_node("b", after={"a": Condition.HEALTHY}),
    )
    play = Play(plan)
    play.give(messages.Saw(health={"a": True}))
    play.die("a")
    play.wait(5.0)
    assert play.levels == "4 3"
    play.give(messages.Saw(health={"a": True}))
    assert play.levels == "4 4"


def test_nodes_of_one_process_share_it_and_its_start_waits_for_both() -> None:
    both = planned_node("b", process="both", after={"c": Condition.STARTED})
    plan = plan_of(planned_node("a", process="both"), both, planned_node("c"))
    play = Play(plan, ways={"c start": "hang"})
    assert "spawn both" not in play.story
    assert "spawn both" in play.finish("c start")


def test_who_waits_is_named_with_what_it_waits_for_when_it_dies_and_when_time_is_over() -> None:
    waits = {"camera": Condition.CONFIGURED}
    plan = plan_of(planned_node("camera"), planned_node("viewer", after=waits))
    play = Play(plan, ways={"camera configure": "hang"})
    play.die("viewer")
    died = "cannot keep '/viewer' running: pid 1 died while waits to configure until /camera is "
    play.wait(ALSO_S)
    assert play.failures == [("/viewer", f"{died}configured: gone")]
    play = Play(plan, ways={"camera configure": "hang"}, timeout_s=3.0)
    play.wait(4.0)
    late = "cannot bring up 'robot' within 3 s: /camera is still configuring; /viewer waits to "
    assert play.failures == [("/camera", f"{late}configure until /camera is configured")]
    assert play.heard(Failure)[0].process == "camera"


def test_a_plain_node_declared_as_managed_is_named_after_2_s_with_the_key_that_mends_it() -> None:
    node = planned_node("driver", kind=RunKind.COMMAND, timeouts=Timeouts(start_s=10.0))
    play = Play(plan_of(node), ways={"driver start": "hang"})
    play.wait(1.0)
    assert play.heard(Notice) == []
    play.give(messages.Saw(appeared=frozenset({"driver"})))
    play.wait(1.1)
    waits = "waiting for its lifecycle services"
    mends = "if it is a plain node, write 'managed: false' at nodes.driver"
    said = f"'/driver' is still {waits}, for up to 8 s more; {mends}"
    assert [each.message for each in play.heard(Notice)] == [said]
    play.wait(8.0)
    late = f"cannot bring up '/driver': it was still {waits} after 10 s; {mends}"
    assert play.failures == [("/driver", late)]


def test_that_key_is_named_too_where_the_node_is_given_up_a_moment_before_its_time_is_over() -> (
    None
):
    play = Play(
        plan_of(planned_node("driver", kind=RunKind.COMMAND)), ways={"driver start": "hang"}
    )
    play.give(messages.Saw(appeared=frozenset({"driver"})))
    play.finish("driver start", error="cannot call its service")
    ((_, said),) = play.failures
    assert said.endswith("service; if it is a plain node, write 'managed: false' at nodes.driver")


@pytest.mark.parametrize(
    ("undeclared", "ros_args", "mends"),
    [
        ((), RosArguments.AUTO, "if its code calls it otherwise, write 'name: driver'"),
        (("/arm/joints",), RosArguments.AUTO, "if its code calls it otherwise, write 'name: dri"),
        ((), RosArguments.NONE, "it gets no ROS arguments: write the name that its code gives"),
        (
            ("/lidar",),
            RosArguments.NONE,
            "the graph shows '/lidar', not declared: if it i",
        ),
        (("/lidar",), RosArguments.AUTO, "if it is this one, write 'name: lidar' at nodes.driver"),
        (("/b", "/a"), RosArguments.AUTO, "the graph shows '/a' and '/b', not declared"),
    ],
)
def test_a_node_that_does_not_appear_is_named_with_what_the_graph_shows_instead(
    undeclared: tuple[str, ...], ros_args: RosArguments, mends: str
) -> None:
    node = planned_node("driver", kind=RunKind.COMMAND, timeouts=Timeouts(start_s=10.0))
    node = replace(node, run=replace(node.run, ros_args=ros_args))
    play = Play(plan_of(node), ways={"driver start": "hang"})
    play.give(messages.Saw(undeclared=frozenset(undeclared)))
    play.wait(2.1)
    (said,) = (each.message for each in play.heard(Notice))
    assert said.startswith("'/driver' is still waiting to appear in the graph, for up to 8 s more;")
    assert mends in said
    play.wait(8.0)
    assert mends in play.failures[0][1]


@pytest.mark.parametrize(
    ("status", "kind", "said"),
    [
        (127, RunKind.COMMAND, "gone, as of a program that is not there: 'drive'"),
        (126, RunKind.COMMAND, "gone, as of a program that may not be run: 'drive'"),
        (1, RunKind.COMMAND, "gone"),
        (127, RunKind.PYTHON, "gone"),
    ],
)
def test_a_program_that_cannot_be_run_is_named(status: int, kind: RunKind, said: str) -> None:
    plan = plan_of(planned_node("driver", kind=kind, managed=False))
    process = replace(plan.processes[0], argv=("drive", "--fast"))
    play = Play(replace(plan, processes=(process,)), ways={"driver start": "hang"})
    play.die("driver", status)
    play.wait(ALSO_S)
    ((subject, text),) = play.failures
    assert subject == "/driver"
    assert text.endswith(f": {said}"), text


def test_all_that_fails_side_by_side_is_named_and_no_other_step_begins() -> None:
    ways = dict.fromkeys(("a configure", "c configure", "d configure"), "hang")
    plan = plan_of(*(planned_node(key) for key in "abcd"))
    play = Play(plan, ways={**ways, "b configure": "no camera"})
    assert play.finish("d configure") == []
    play.wait(0.2)
    play.finish("c configure", error="no arm")
    assert play.run.ending is None
    play.wait(ALSO_S)
    assert play.failures == [("/b", "no camera"), ("/c", "no arm")]


def test_a_process_is_blamed_once_for_each_node_that_it_cannot_host_and_for_no_other() -> None:
    play = Play(plan_of(*(planned_node(key, process="all") for key in "abc")), {"a start": "hang"})
    reports = (("/b", "no module 'driver'"), ("/c", "cannot import 'm:C'"))
    play.give(messages.Exited(process="all", status=1, text="gone", reports=reports))
    assert play.failures == [
        ("/b", "cannot start '/b': no module 'driver'"),
        ("/c", "cannot import 'm:C'"),
    ]


@pytest.mark.parametrize("kind", [RunKind.PYTHON, RunKind.COMMAND])
def test_a_process_that_is_still_starting_is_ended_at_once_and_not_by_an_interrupt(
    kind: RunKind,
) -> None:
    """SIGINT would have Python print a traceback from the middle of an import."""
    starting = planned_node("a", kind=kind, managed=kind is RunKind.PYTHON)
    plan = plan_of(starting, planned_node("b"))
    play = Play(plan, ways={"a start": "hang", "b configure": "no arm"})
    play.wait(ALSO_S)
    assert [each for each in play.story if each.startswith("signal a")] == ["signal a 15"]
    assert (play.code, play.heard(Notice)) == (6, [])


# The gate


@pytest.mark.parametrize("moment", ["program", "camera activate"])
@pytest.mark.parametrize("found", [GONE, INTRUDER])
def test_what_changes_behind_an_open_gate_and_heals_in_time_ends_no_bring_up(
    moment: str, found: tuple[str, str]
) -> None:
    """A host that is cut off once it was verified may come back; a stranger leaves at once."""
    play = Play(CHAIN, ways={moment: "hang"})
    play.see(found)
    play.finish(moment)
    play.wait(25.0 if found is GONE else 0.4)
    assert "viewer activate" not in play.story
    play.see()
    assert play.levels == "4 4"


@pytest.mark.parametrize("moment", ["program", "camera activate"])
@pytest.mark.parametrize(
    ("found", "wait_s", "why"),
    [
        (INTRUDER, 1.0, f"; {STRANGER}"),
        (GONE, 32.0, f", and {OVER}; /camera (graph.missing-node)"),
    ],
)
def test_what_stays_wrong_behind_an_open_gate_ends_the_bring_up_and_is_named(
    moment: str, found: tuple[str, str], wait_s: float, why: str
) -> None:
    play = Play(CHAIN, ways={moment: "hang"})
    play.see(found)
    play.finish(moment)
    play.wait(wait_s)
    assert (play.code, play.reason) == (4, f"{CHANGED}{why}")
    assert "viewer activate" not in play.story


def test_what_became_active_is_judged_again_and_must_be_what_was_verified() -> None:
    play = Play(CHAIN, ways={"viewer activate": "hang"})
    play.see(INTRUDER)
    play.finish("viewer activate")
    play.wait(1.0)
    why = f"what became active is not what was verified; {STRANGER}"
    assert (play.code, play.reason) == (4, why)


def test_who_comes_again_and_is_not_what_was_verified_once_it_is_active_has_failed_again() -> None:
    play = Play(chain())
    play.ways["camera activate"] = "hang"
    play.die("camera")
    play.wait(1.0)
    play.see(INTRUDER)
    play.finish("camera activate")
    play.wait(1.0)
    text = "cannot keep '/camera' active: what became active is not what was verified; {}"
    assert play.failures[-1] == ("/camera", text.format(STRANGER))
    assert [each.restarts for each in play.heard(RestartScheduled)] == [0, 1]


# Orders


def test_a_paused_system_is_restarted_as_far_as_it_was() -> None:
    play = Play(CHAIN)
    play.order(ControlRequest.PAUSE)
    assert {"spawn camera", "viewer connect"} <= {*play.order(ControlRequest.RESTART)}
    assert (play.levels, play.phase) == ("3 3", "paused")
    assert [each[0] for each in play.answers.values()] == [0, 0]


def test_what_changes_while_a_system_is_resumed_has_it_paused_again() -> None:
    play = Play(CHAIN)
    play.order(ControlRequest.PAUSE)
    play.ways["camera activate"] = "hang"
    play.order(ControlRequest.RESUME)
    play.see(INTRUDER)
    play.finish("camera activate")
    play.wait(1.0)
    closed = "the gate closed again: /camera is deactivated"
    refused = (
        f"cannot activate: {CHANGED}, and its verdict now is violated\n"
        "  graph.undeclared-node: graph.undeclared-node /intruder"
    )
    assert [each.message for each in play.heard(Notice)] == [closed, refused]
    assert (play.answers[1], play.levels, play.phase) == ((4, refused), "3 3", "paused")
    play.see()
    play.order(ControlRequest.RESUME)
    assert play.levels == "4 4"


def test_a_restart_for_which_no_port_is_left_ends_the_run() -> None:
    play = Play(replace(DIALLING, discovery=Discovery(first_port=65535)))
    play.order(ControlRequest.RESTART, node="viewer")
    full = "cannot give out 1 more ports: they would begin at 67535, and the highest is 65535"
    assert play.answers[0] == (6, full)
    assert (play.code, play.reason) == (6, "failed: robot (run.start-failed)")


def test_a_restart_in_which_a_step_fails_ends_the_run() -> None:
    play = Play(CHAIN)
    play.ways["viewer configure"] = "no display"
    play.order(ControlRequest.RESTART, node="/viewer")
    assert play.answers[0] == (6, "no display")
    assert (play.code, play.reason) == (6, "failed: /viewer (run.transition-failed)")


# The end


def _pause(play: Play) -> None:
    play.order(ControlRequest.PAUSE)


def _restart(play: Play) -> None:
    play.ways["viewer configure"] = "hang"
    play.order(ControlRequest.RESTART, node="viewer")


def _restart_and_see(play: Play) -> None:
    _restart(play)
    play.see(INTRUDER)
    play.wait(0.5)


def _violate(play: Play) -> None:
    play.see(INTRUDER)
    play.wait(2.0)
    play.see()


def _hold(play: Play) -> None:
    play.see(INTRUDER)
    play.order(ControlRequest.RESTART, node="viewer")
    play.wait(0.5)
    play.see()
    assert play.answers[0][0] == 4


@pytest.mark.parametrize(
    ("before", "code", "why"),
    [
        (lambda _: None, 0, ""),
        (_pause, 0, ""),
        (_restart, 143, "; the system was restarting, not active"),
        (_restart_and_see, 143, f"; the system was restarting, not active; {PASSED}"),
        (_violate, 0, f"; violated meanwhile, {STRANGER}"),
        (_hold, 4, f"; held at the gate, and not active; {PASSED}"),
    ],
)
def test_a_run_is_a_success_only_if_its_system_is_as_it_was_ordered(
    before: object, code: int, why: str
) -> None:
    play = Play(CHAIN)
    before(play)  # type: ignore[operator]
    play.stop("terminated", ExitCode.TERMINATED)
    assert {each for each in play.answers.values() if each[0] == 6} <= {(6, TAKEN_DOWN)}
    play.wait(60.0)
    assert (play.code, play.reason) == (code, f"terminated{why}")


def test_an_interrupt_and_what_cuts_a_run_short_that_is_bound_to_stay_are_no_success() -> None:
    play = Play(CHAIN)
    play.stop("interrupted", ExitCode.INTERRUPTED)
    assert (play.code, play.reason) == (130, "interrupted")
    play = Play(CHAIN, stop_after_s=10.0)
    play.give(messages.Stop(reason="terminated", code=ExitCode.TERMINATED))
    why = "terminated; it did not hold for the 10 s of --stop-after"
    assert (play.code, play.reason) == (143, why)
    play = Play(CHAIN, stop_after_s=10.0)
    play.see(INTRUDER)
    play.stop("terminated", ExitCode.TERMINATED)
    assert (play.code, play.reason[:20]) == (4, "terminated; violated")
