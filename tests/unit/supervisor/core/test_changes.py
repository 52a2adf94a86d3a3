"""Stories of other manifests, other modes and consequences, and of the way back from each."""

from __future__ import annotations

import random

import pytest
from msgspec.structs import replace

from lifecycle.manifest.model import (
    Condition,
    Consequence,
    EndpointPolicy,
    Mode,
    ModeParameter,
    OnFailure,
    OnViolation,
    ParameterDeclaration,
    Policy,
    Reaction,
    Restart,
    RunKind,
    Supervision,
)
from lifecycle.plan.model import ExpectedParameter, Plan, PlannedNode, in_mode
from lifecycle.supervisor.control.protocol import ControlRequest
from lifecycle.supervisor.core.orders import reaction_of
from lifecycle.supervisor.run.events import (
    ConsequenceTaken,
    ManifestApplied,
    Notice,
    Restarted,
)
from tests.builders import HERE, node, plan_of, planned, planned_node
from tests.unit.supervisor.core.playbook import AGAIN, CHAIN, GONE, INTRUDER, Play, chain
from tests.unit.supervisor.core.world import verdict

CAMERA, VIEWER = CHAIN.nodes
ARM = planned_node("arm", after={"camera": Condition.CONFIGURED})
MORE = plan_of(CAMERA, VIEWER, ARM)
LOUD = replace(VIEWER, log_level="debug")
OTHER = plan_of(CAMERA, LOUD, ARM)
"""Viewer is restarted for it, arm is added."""

PAUSE, RESUME, RESTART = ControlRequest.PAUSE, ControlRequest.RESUME, ControlRequest.RESTART
APPLY, MODE = ControlRequest.APPLY, ControlRequest.MODE
CANNOT = "cannot apply robot.lifecycle.yaml: "
BACK = "\nrobot.lifecycle.yaml is in force again, revision 1, active and verified"


def rate(node: PlannedNode, value: float) -> PlannedNode:
    """Return the node with a parameter."""
    given = ExpectedParameter(name="rate", type="double", value=value, source="parameters", at=HERE)
    return replace(node, parameters=(("rate", value),), expected_parameters=(given,))


def gives(play: Play) -> list[str]:
    return [each for each in play.story if each.startswith("give")]


# Another manifest


@pytest.mark.parametrize(
    ("step", "way", "why"),
    [
        ("arm start", "no such class", "cannot start '/arm': no such class"),
        ("arm configure", "no gripper", "no gripper"),
        ("arm connect", "no cable", "no cable"),
        ("arm activate", "no power", "no power"),
        ("arm configure", "die", "cannot keep '/arm' running: pid 1 died while configuring: gone"),
        ("arm configure", "hang", "cannot bring up '/arm': it was still configuring after 10 s"),
        ("program", "no server", "no server"),
    ],
)
def test_a_manifest_that_fails_is_taken_back_and_what_did_not_differ_is_not_touched(
    step: str, way: str, why: str
) -> None:
    play = Play(CHAIN)
    play.ways[step] = "hang" if step == "program" else way
    play.order(APPLY, plan=OTHER)
    if step == "program":
        play.finish(step, error=way)
    play.wait(60.0)
    assert play.answers[0] == (6, f"{CANNOT}{why}{BACK}")
    assert (play.levels, play.phase, play.run.revision) == ("4 4", "active", 1)
    assert (play.run.first, [*play.run.nodes]) == (CHAIN, ["camera", "viewer"])
    begun, *stages = play.heard(ManifestApplied)
    assert (begun.added, begun.restarted) == (("/arm",), ("/viewer",))
    assert [each.stage for each in stages] == ["rolling_back", "rolled_back"]
    assert "camera deactivate" not in play.story
    play.ways.clear()
    play.order(RESTART)
    assert (play.answers[1][0], play.levels) == (0, "4 4")


def test_a_gate_that_stays_closed_activates_nothing_and_takes_the_manifest_back() -> None:
    play = Play(CHAIN)
    play.ways["arm configure"] = "hang"
    play.order(APPLY, plan=MORE)
    play.see(INTRUDER)
    play.finish("arm configure")
    play.wait(2.0)
    code, error = play.answers[0]
    assert (code, error.splitlines()[0]) == (
        4,
        f"{CANNOT}cannot activate: the verdict is violated",
    )
    assert "in force again, revision 1, but its verdict is violated" in error
    # What was active stays so; the violation is not of the manifest's making.
    assert (play.levels, play.phase) == ("4 4", "active")
    assert not [each for each in play.story if each in ("arm activate", "viewer deactivate")]


def test_what_became_active_on_the_way_back_and_is_wrong_is_named_and_stays_active() -> None:
    play = Play(CHAIN, ways={"arm connect": "no cable"})
    play.ways["viewer activate"] = "hang"
    play.order(APPLY, plan=OTHER)
    play.see(INTRUDER)
    play.finish("viewer activate")
    play.wait(40.0)
    assert "revision 1, but its verdict is violated: /intruder" in play.answers[0][1]
    assert (play.levels, play.phase) == ("4 4", "active")


def test_a_manifest_that_is_the_same_is_answered_and_nothing_is_asked() -> None:
    play = Play(MORE)
    assert play.order(APPLY, plan=MORE) == []
    assert play.answers[0] == (0, "")


@pytest.mark.parametrize("refuses", [False, True])
def test_a_parameter_is_set_while_its_node_runs_and_else_by_a_restart(refuses: bool) -> None:
    plan = plan_of(CAMERA, rate(VIEWER, 2.0))
    set_ = "give viewer {'rate': 2.0}"
    play = Play(plan_of(CAMERA, rate(VIEWER, 1.0)), ways={set_: "read-only"} if refuses else {})
    asked = play.order(APPLY, plan=plan)
    assert asked[0] == set_
    assert (("viewer deactivate" in asked), ("spawn viewer" in asked)) == (refuses, refuses)
    assert (play.answers[0][0], play.levels, play.run.plan) == (0, "4 4", plan)


def test_parameters_that_were_set_are_set_back() -> None:
    play = Play(plan_of(CAMERA, rate(VIEWER, 1.0)), ways={"arm configure": "no gripper"})
    play.order(APPLY, plan=plan_of(CAMERA, rate(VIEWER, 2.0), ARM))
    play.wait(1.0)
    assert play.answers[0][1].endswith(BACK)
    assert gives(play) == ["give viewer {'rate': 2.0}", "give viewer {'rate': 1.0}"]
    assert "viewer deactivate" not in play.story


def test_parameters_that_a_death_kept_us_from_hearing_of_are_set_back_too() -> None:
    camera = replace(CAMERA, supervision=AGAIN)
    play = Play(plan_of(camera, rate(VIEWER, 1.0)), ways={"give viewer {'rate': 2.0}": "hang"})
    play.order(APPLY, plan=plan_of(camera, rate(VIEWER, 2.0)))
    play.die("camera")
    play.finish("give viewer {'rate': 2.0}")
    play.wait(1.0)
    assert "cannot keep '/camera' running" in play.answers[0][1]
    assert gives(play) == ["give viewer {'rate': 2.0}", "give viewer {'rate': 1.0}"]
    assert len(play.heard(Restarted)) == 1


def test_other_orders_are_refused_meanwhile() -> None:
    play = Play(CHAIN, ways={"arm configure": "hang"})
    play.order(APPLY, plan=OTHER)
    asks = {PAUSE: "pause", RESTART: "restart", APPLY: "apply another manifest to"}
    for number, ask in enumerate(asks, 1):
        play.order(ask, id=number)
        why = (
            f"cannot {asks[ask]} 'robot': it is applying, another manifest is being applied to "
            "it; ask again once 'lifecycle apply' has ended; 'lifecycle down' is taken at once"
        )
        assert play.answers[number] == (2, why)
    play.finish("arm configure")
    assert play.answers[0][0] == 0


def test_a_manifest_that_takes_too_long_is_taken_back() -> None:
    play = Play(CHAIN, ways={"arm configure": "hang"})
    play.order(APPLY, plan=MORE, timeout_s=2.0)
    play.wait(3.0)
    late = "cannot bring up 'robot' within 2 s: /arm is still configuring"
    assert play.answers[0] == (6, f"{CANNOT}{late}{BACK}")


@pytest.mark.parametrize("stage", ["viewer deactivate", "arm configure", "arm activate"])
@pytest.mark.parametrize("policy", [Restart.NO, Restart.ON_FAILURE])
def test_the_death_of_another_takes_a_manifest_back_and_then_counts_as_ever(
    stage: str, policy: Restart
) -> None:
    camera = replace(CAMERA, supervision=replace(AGAIN, restart=policy))
    play = Play(plan_of(camera, VIEWER))
    play.ways[stage] = "hang"
    play.order(APPLY, plan=plan_of(camera, LOUD, ARM))
    play.found = verdict(GONE)
    play.die("camera")
    play.finish(stage)
    play.wait(60.0 if policy is Restart.NO else 1.0)
    play.see()
    code, error = play.answers[0]
    assert (code, "cannot keep '/camera' running" in error) == (6, True)
    if policy is Restart.NO:
        assert error.endswith("the system is taken down")
        assert play.code == 6
    else:
        assert "is in force again, revision 1, and what failed meanwhile is started again" in error
        assert (play.levels, play.phase, play.run.revision) == ("4 4", "active", 1)
        assert len(play.heard(Restarted)) == 1


def test_a_node_at_the_gate_again_as_another_dies_is_activated_with_that_one() -> None:
    camera = replace(CAMERA, supervision=AGAIN)
    play = Play(plan_of(camera, VIEWER))
    play.ways["arm configure"] = "hang"
    play.order(APPLY, plan=plan_of(camera, LOUD, ARM), timeout_s=2.0)
    play.see(INTRUDER)  # the gate stays closed
    play.wait(2.1)
    assert (play.levels, play.answers) == ("4 3", {})
    play.die("camera")
    play.wait(3.0)
    assert "and what failed meanwhile is started again" in play.answers[0][1]
    play.see()
    assert (play.levels, play.phase, play.run.revision) == ("4 4", "active", 1)


def test_a_node_of_the_manifest_before_that_does_not_come_back_ends_the_run() -> None:
    play = Play(CHAIN)
    play.ways["viewer configure"] = "no display"
    play.order(APPLY, plan=plan_of(CAMERA, LOUD))
    play.wait(1.0)
    back = "cannot go back to robot.lifecycle.yaml: no display; the system is taken down"
    assert play.answers[0] == (6, f"{CANNOT}no display\n{back}")
    assert play.code == 6


def test_a_failing_node_is_started_at_once_by_a_manifest_that_mends_it() -> None:
    slow = replace(AGAIN, restart_sec=1000.0, restart_max_delay_sec=1000.0)
    play = Play(plan_of(CAMERA, replace(VIEWER, supervision=slow)))
    play.die("viewer")
    play.order(APPLY, plan=plan_of(CAMERA, replace(LOUD, supervision=slow)))
    assert (play.answers[0][0], play.levels, play.phase) == (0, "4 4", "active")
    assert play.heard(Restarted) == []
    play.down()
    assert play.code == 0


@pytest.mark.parametrize(
    "stage",
    [
        *("viewer deactivate", "viewer shutdown", "arm configure", "program", "arm activate"),
        "arm shutdown",  # on the way back
    ],
)
def test_an_end_in_the_middle_takes_down_what_is_there(stage: str) -> None:
    back = stage == "arm shutdown"
    play = Play(CHAIN, ways={"arm connect": "no cable"} if back else {})
    play.ways[stage] = "hang"
    play.order(APPLY, plan=OTHER)
    phase = "rolling back" if back else "applying"
    assert play.phase == phase
    play.down()
    assert play.answers[0] == (6, "cannot go on: 'robot' is being taken down")
    play.wait(60.0)
    assert (play.code, play.reason) == (6, f"lifecycle down; the system was {phase}, not active")


def test_a_node_of_others_that_a_manifest_leaves_out_is_left_once_its_step_is_done() -> None:
    base = planned_node("base", kind=RunKind.ATTACH)
    camera = replace(CAMERA, supervision=replace(AGAIN, on_failure=OnFailure.ALL))
    play = Play(plan_of(camera, base))
    play.ways["base configure"] = "hang"
    play.die("camera")
    play.wait(1.0)
    play.order(APPLY, plan=plan_of(camera))
    assert play.answers == {}
    assert play.finish("base configure")[0] == "base cleanup"
    assert play.answers[0][0] == 0


def test_what_waits_at_its_gate_is_let_through_by_a_manifest_or_waits_on() -> None:
    play = Play(CHAIN)
    play.see(INTRUDER)
    play.order(RESTART, node="viewer")
    play.wait(1.0)
    play.see()
    play.ways["arm configure"] = "no gripper"
    play.order(APPLY, plan=MORE)
    play.wait(1.0)
    assert play.answers[1][1].endswith("verified, and held as before: lifecycle resume")
    assert (play.levels, play.phase) == ("4 3", "held")
    play.ways.clear()
    play.order(APPLY, plan=MORE)
    assert (play.answers[2][0], play.levels, play.phase) == (0, "4 4 4", "active")
    assert play.story.count("camera activate") == 1


def test_a_paused_system_takes_a_manifest_and_stays_paused() -> None:
    play = Play(CHAIN)
    play.order(PAUSE)
    play.order(APPLY, plan=MORE)
    assert (play.levels, play.phase) == ("3 3 3", "paused")
    play.ways["viewer configure"] = "hang"
    play.order(APPLY, plan=OTHER)
    play.finish("viewer configure", error="no display")
    play.wait(1.0)
    play.order(RESUME)
    assert [each[0] for each in play.answers.values()] == [0, 0, 6, 0]
    assert play.answers[2][1].endswith("revision 2, paused and verified")
    assert play.levels == "4 4 4"


def test_modes_may_change_and_the_nodes_follow() -> None:
    play = Play(CHAIN)
    quiet = Mode(name="quiet", inactive=("viewer",), at=HERE)
    play.order(APPLY, plan=replace(CHAIN, modes=(quiet,)))
    assert play.levels == "4 3"
    play.order(APPLY, plan=replace(CHAIN, modes=(Mode(name="loud", at=HERE),)))
    assert (play.levels, play.run.mode) == ("4 4", "loud")
    assert play.story.count("spawn viewer") == 1


def test_parameters_of_the_mode_that_the_system_is_in_are_set() -> None:
    def plan(night: float) -> Plan:
        rates = {"day": 1.0, "night": night}
        given = {mode: rate(CAMERA, value).expected_parameters for mode, value in rates.items()}
        camera = replace(rate(CAMERA, 1.0), mode_parameters=given)
        modes = tuple(Mode(name=each, at=HERE) for each in rates)
        open_ = Policy(undeclared_nodes=EndpointPolicy.OPEN) if night > 2.0 else Policy()
        return replace(plan_of(camera, VIEWER), modes=modes, policy=open_)

    play = Play(plan(2.0))
    play.order(MODE, mode="night")
    play.order(APPLY, plan=plan(3.0))
    assert play.run.plan.node("camera").parameters == (("rate", 3.0),)
    play.order(MODE, mode="day")
    play.order(APPLY, plan=plan(4.0))
    assert gives(play) == ["give camera", "give camera {'rate': 3.0}", "give camera"]
    assert [each[0] for each in play.answers.values()] == [0, 0, 0, 0]
    assert "camera deactivate" not in play.story


POOL = (
    CHAIN,
    MORE,
    plan_of(CAMERA),
    OTHER,
    plan_of(replace(CAMERA, log_level="warn"), VIEWER),
    plan_of(*(replace(each, process="both") for each in CHAIN.nodes), ARM),
    plan_of(CAMERA, rate(VIEWER, 1.0)),
    plan_of(CAMERA, rate(VIEWER, 2.0), ARM),
    replace(MORE, policy=Policy(undeclared_nodes=EndpointPolicy.OPEN)),
    replace(MORE, modes=(Mode(name="a", inactive=("arm",), at=HERE), Mode(name="b", at=HERE))),
)
FAULTS = (
    *("arm configure", "arm connect", "arm activate", "arm start", "viewer configure"),
    *("viewer activate", "camera connect", "viewer deactivate", "camera cleanup", "program"),
    *("give viewer {'rate': 2.0}", "give viewer {'rate': 1.0}"),
)


@pytest.mark.parametrize("seed", range(60))
def test_whatever_fails_one_of_two_manifests_is_in_force_as_a_whole(seed: int) -> None:
    chance = random.Random(seed)
    pool = [
        replace(each, nodes=tuple(replace(one, supervision=AGAIN) for one in each.nodes))
        for each in POOL
    ]
    play = Play(pool[0])
    for number in range(4):
        before, plan = play.run.first, chance.choice(pool)
        fault = chance.choice(FAULTS)
        play.ways = {fault: "hang"}
        play.order(APPLY, plan=plan, id=number)
        what = chance.choice(["die", "intrude", "nothing", "nothing"])
        if what == "die":
            process = chance.choice([*play.run.processes])
            play.found = verdict(("graph.missing-node", f"/{process}"))
            play.die(process)
            play.wait(2.0)
        elif what == "intrude":
            play.see(INTRUDER)
            play.wait(chance.choice([0.2, 1.5]))
        play.ways = {}
        errors = [chance.choice(["", "no power"])]
        while play.held:
            play.finish(fault, error=errors.pop() if errors else "")
        play.see()
        play.wait(60.0)
        run, (code, _) = play.run, play.answers[number]
        assert run.first == (plan if code == 0 else before)
        assert run.nodes.keys() == {each.key for each in run.first.nodes}
        assert run.processes.keys() == {each.name for each in run.first.processes}
        for each in run.nodes.values():
            each.refused = False  # as by a resume
        play.see()
        wanted = [4 if each.is_gated else 3 for each in run.nodes.values()]
        assert (play.phase, play.levels) == ("active", " ".join(map(str, wanted)))


# Another mode


def test_a_mode_keeps_its_nodes_inactive_and_the_next_has_them_active_again() -> None:
    plan = modes("normal", "degraded", "blind")
    assert in_mode(plan, "normal").nodes == plan.nodes
    degraded = in_mode(plan, "degraded")
    assert [each.state.value for each in degraded.nodes] == ["active", "inactive"]
    assert degraded.nodes[0] is plan.nodes[0]
    blind = in_mode(degraded, "blind")
    assert [each.state.value for each in blind.nodes] == ["inactive", "active"]
    assert in_mode(blind, "unknown") is blind


def test_a_mode_has_parameters_and_the_next_has_them_as_they_are_declared() -> None:
    speed = ParameterDeclaration(name="speed", type="double", default=1.0, at=HERE)
    base = node("base")
    base = replace(base, interface=replace(base.interface, parameters=(speed,)))
    given = ModeParameter(node="base", name="speed", value=0.2, at=HERE)
    slow = Mode(name="slow", inactive=("camera",), parameters=(given,), at=HERE)
    plan = planned(base, node("camera"), modes=(Mode(name="normal", at=HERE), slow))
    assert plan.nodes[0].parameters == (("speed", 1.0),)
    (expected,) = in_mode(plan, "slow").nodes[0].expected_parameters
    assert (expected.name, expected.value, expected.source) == ("speed", 0.2, "mode slow")
    assert in_mode(plan, "slow").nodes[0].parameters == (("speed", 0.2),)
    assert in_mode(in_mode(plan, "slow"), "normal") == plan


BLIND = Mode(name="blind", inactive=("base",), at=HERE)
DEGRADED = Mode(name="degraded", inactive=("camera",), at=HERE)


def modes(*names: str, how: Supervision = AGAIN) -> Plan:
    """Return two nodes, in the first of these modes; `normal` has both active."""
    known = {"normal": Mode(name="normal", at=HERE), "degraded": DEGRADED, "blind": BLIND}
    plan = plan_of(*(planned_node(each, supervision=how) for each in ("base", "camera")))
    return in_mode(replace(plan, modes=tuple(known[each] for each in names)), names[0])


def test_a_mode_that_takes_one_out_and_another_in_waits_for_it_at_the_gate_of_the_mode_before() -> (
    None
):
    play = Play(modes("normal", "degraded", "blind"))
    play.see(INTRUDER)
    assert play.order(MODE, mode="degraded") == ["camera deactivate"]
    play.order(MODE, mode="normal")
    play.wait(1.0)
    assert (play.levels, play.phase, play.run.mode) == ("4 3", "active", "degraded")
    play.order(MODE, mode="blind")
    play.wait(1.0)
    assert [each[0] for each in play.answers.values()] == [0, 4, 4]
    assert (play.levels, play.phase, play.run.mode) == ("3 3", "held", "degraded")
    backs = [each.message for each in play.heard(Notice) if "back to" in each.message]
    assert backs == [
        f"cannot enter mode {each!r}: back to 'degraded'" for each in ("normal", "blind")
    ]
    play.see()
    play.order(RESUME)
    assert (play.levels, play.phase) == ("4 3", "active")
    play.order(MODE, mode="normal")
    assert play.levels == "4 4"


def test_a_paused_system_stays_paused_and_what_is_restarted_comes_back_as_its_mode_says() -> None:
    play = Play(modes("normal", "degraded"))
    play.order(PAUSE)
    play.order(MODE, mode="degraded")
    assert (play.levels, play.phase) == ("3 3", "paused")
    play.order(RESUME)
    play.die("camera")
    play.wait(1.0)
    assert (play.levels, play.phase, len(play.heard(Restarted))) == ("4 3", "active", 1)
    play.order(RESTART)
    assert (play.levels, play.run.mode) == ("4 3", "degraded")
    assert play.story.count("camera activate") == 1


# Consequences

DEACTIVATE = Consequence.DEACTIVATE
DIFFERS = ("param.value-differs", "/camera")


REPORT, _, _, QUIET, STOP = Consequence
TWICE = "graph.duplicate-node"


@pytest.mark.parametrize(
    ("system", "camera", "found"),
    [
        ({}, {}, REPORT),
        ({"default": STOP}, {}, STOP),
        ({"default": STOP, "graph": QUIET}, {}, QUIET),
        ({"graph": QUIET, TWICE: DEACTIVATE}, {}, DEACTIVATE),
        ({TWICE: STOP}, {"default": REPORT}, REPORT),
        ({"graph": STOP}, {"param": REPORT}, STOP),
    ],
)
def test_what_is_nearest_counts_and_of_two_ends_the_stronger_one(
    system: dict[str, Consequence], camera: dict[str, Consequence], found: Consequence
) -> None:
    def said(pairs: dict[str, Consequence]) -> OnViolation:
        return tuple(Reaction(rule=rule, what=what) for rule, what in pairs.items())

    plan = plan_of(replace(CAMERA, on_violation=said(camera)), VIEWER)
    plan = replace(plan, on_violation=said(system))
    (finding,) = verdict((TWICE, "/camera")).findings
    assert reaction_of(plan, finding).what is found
    stops = replace(VIEWER, on_violation=said({"default": STOP}))
    plan = replace(plan, nodes=(plan.nodes[0], stops))
    (pair,) = verdict((TWICE, "/video: /camera → /viewer")).findings
    assert reaction_of(plan, pair).what is STOP


def test_what_passes_has_no_consequence() -> None:
    stop = Reaction(rule="default", what=Consequence.STOP)
    play = Play(replace(CHAIN, on_violation=(stop,)))
    for _ in range(3):
        play.see(DIFFERS)
        play.wait(0.3)
        play.see()
        play.wait(0.3)
    assert play.heard(ConsequenceTaken) == []


def test_what_concerns_no_node_of_the_system_pauses_all_of_it() -> None:
    play = Play(replace(CHAIN, on_violation=(Reaction(rule="graph", what=DEACTIVATE),)))
    play.see(INTRUDER)
    assert play.wait(0.5) == ["viewer deactivate", "camera deactivate"]
    why = "on_violation: pause (graph.undeclared-node of /intruder); lifecycle resume"
    assert (play.phase, {each.withheld for each in play.run.nodes.values()}) == ("paused", {why})
    play.see()
    play.order(RESUME)
    assert (play.levels, len(play.heard(ConsequenceTaken))) == ("4 4", 1)


def test_who_a_consequence_keeps_inactive_stays_so_when_a_manifest_is_taken_back() -> None:
    kept = replace(ARM, on_violation=(Reaction(rule="default", what=DEACTIVATE),))
    play = Play(plan_of(CAMERA, VIEWER, kept))
    play.see(("param.value-differs", "/arm"))
    assert play.wait(0.5) == ["arm deactivate"]
    play.see()
    play.ways["viewer configure"] = "hang"
    play.order(APPLY, plan=plan_of(CAMERA, LOUD, replace(kept, log_level="debug")))
    play.finish("viewer configure", error="no display")
    play.wait(1.0)
    assert (play.answers[0][0], play.levels) == (6, "4 4 3")
    play.order(RESUME)
    assert play.levels == "4 4 4"


def test_a_node_that_is_started_again_has_no_consequence_for_being_away() -> None:
    stop = Reaction(rule="default", what=Consequence.STOP)
    play = Play(replace(chain(), on_violation=(stop,)))
    play.found = verdict(GONE)
    play.die("camera")
    play.wait(1.0)
    play.see()
    play.wait(5.0)
    assert (play.levels, play.heard(ConsequenceTaken)) == ("4 4", [])


def test_who_comes_again_passes_its_gate_while_another_is_held_behind_it() -> None:
    camera = replace(CAMERA, on_violation=(Reaction(rule="param", what=DEACTIVATE),))
    play = Play(plan_of(camera, planned_node("viewer", supervision=AGAIN)))
    play.see(DIFFERS)
    play.wait(0.5)
    play.see()
    play.die("viewer")
    play.wait(1.0)
    assert (play.levels, play.phase, len(play.heard(Restarted))) == ("3 4", "held", 1)
    play.order(RESUME)
    assert (play.levels, play.phase) == ("4 4", "active")


def test_a_violation_enters_a_mode_once_and_one_that_its_gate_refuses_is_left_again() -> None:
    reactions = (
        Reaction(rule="param", what=Consequence.MODE, mode="degraded"),
        Reaction(rule="graph.undeclared-node", what=Consequence.MODE, mode="blind"),
    )
    play = Play(replace(modes("degraded", "blind"), on_violation=reactions))
    play.see(INTRUDER)
    play.wait(5.0)
    assert (play.levels, play.run.mode, play.phase) == ("3 3", "degraded", "held")
    play.see()
    play.order(RESUME)
    play.order(MODE, mode="blind")
    assert (play.levels, play.run.mode) == ("3 4", "blind")
    play.see(("param.value-differs", "/base"))
    play.wait(0.5)
    assert play.run.switch is None
    assert [each.rule for each in play.heard(ConsequenceTaken)] == [
        "graph.undeclared-node",
        "param.value-differs",
    ]


@pytest.mark.parametrize("ordered", [True, False])
def test_a_mode_that_a_node_refuses_is_left_again_with_the_node_s_reason(ordered: bool) -> None:
    given = {"blind": rate(CAMERA, 2.0).expected_parameters}
    what = Reaction(rule="graph", what=Consequence.MODE, mode="blind")
    plan = modes("normal", "blind")
    base, camera = plan.nodes
    camera = replace(camera, mode_parameters=given)
    plan = replace(plan, nodes=(base, camera), on_violation=(what,))
    play = Play(plan, ways={"give camera": "read-only"})
    reason = "cannot enter mode 'blind': read-only"
    back = "cannot enter mode 'blind': back to 'normal'"
    if ordered:
        play.order(MODE, mode="blind")
        assert play.answers[0] == (6, reason)
    else:
        play.see(INTRUDER)
        play.wait(0.6)
    said = [each.message for each in play.heard(Notice)]
    assert said == ([back] if ordered else [back, reason])
    assert (play.run.mode, play.levels) == ("normal", "4 4" if ordered else "3 4")
