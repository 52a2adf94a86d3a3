"""Another manifest for a running system, applied or rolled back; outlines of runs are compared."""

from __future__ import annotations

import asyncio
import contextlib
import random
from collections.abc import AsyncIterator
from pathlib import Path

import msgspec
import pytest
from msgspec.structs import replace

from lifecycle.manifest.model import Condition, EndpointPolicy, Mode, Policy, Restart, Supervision
from lifecycle.plan.model import ExpectedParameter, ModeParameters, Plan, PlannedNode
from lifecycle.supervisor.control.protocol import Answer, ControlRequest
from lifecycle.verify.outcome import Outcome
from tests.builders import HERE, plan_of, planned_node
from tests.unit.supervisor.session_world import (
    CHAIN,
    DIALLING,
    REFUSED,
    VIEWER_DOWN,
    SessionWorld,
)

CAMERA, VIEWER = CHAIN.nodes
ARM = planned_node("arm", after={"camera": Condition.CONFIGURED})
MORE = plan_of(CAMERA, VIEWER, ARM)
LOUD = replace(VIEWER, log_level="debug")
BACK = "robot.lifecycle.yaml is in force again, revision 1, active and verified"
AGAIN = Supervision(restart=Restart.ON_FAILURE, restart_sec=1.0)


def _rate(node: PlannedNode, value: float) -> PlannedNode:
    rate = ExpectedParameter(name="rate", type="double", value=value, source="parameters", at=HERE)
    return replace(node, parameters=(("rate", value),), expected_parameters=(rate,))


@contextlib.asynccontextmanager
async def active(tmp_path: Path, plan: Plan, *, code: str = "0") -> AsyncIterator[SessionWorld]:
    """A session that is active; it is ended after the body, unless it ends by itself."""
    world = SessionWorld(plan, tmp_path)
    async with world.running("[system] active"):
        yield world
        if code == "0":
            assert await world.order(ControlRequest.DOWN) == code


def _since_begun(world: SessionWorld) -> list[str]:
    outline = world.since("[apply] begun")
    ends = [index for index, line in enumerate(outline) if line.startswith("[stopping]")]
    return outline[: ends[0]]


def _told(answer: Answer) -> str:
    return f"{answer.exit_code} {answer.error}".rstrip()


async def test_an_added_node_goes_through_the_gate_while_the_others_stay_active(
    tmp_path: Path,
) -> None:
    async with active(tmp_path, CHAIN) as world:
        said = await world.apply(MORE, dry_run=True)
        assert said.exit_code == 4
        assert said.change is not None
        assert (said.change.added, said.change.restarted) == (("/arm",), ())
        assert said.change.differences == (
            "robot.lifecycle.yaml:1:1: nodes.arm: was not declared, is declared",
        )
        assert world.system.plan == CHAIN
        done = await world.apply(MORE)
        assert _told(done) == "0"
        assert done.change is not None
        assert (done.change.added, done.change.revision) == (("/arm",), 2)
        status = world.status()
        assert (status.phase, status.revision) == ("active", 2)
        again = await world.apply(MORE)
        assert again.change is not None
        assert (again.exit_code, again.change.differences) == (0, ())
        assert (await world.apply(MORE, dry_run=True)).exit_code == 0
        # It is watched as all others are.
        assert await world.order(ControlRequest.RESTART, "arm") == "0"
    assert _since_begun(world)[:11] == [
        "[apply] begun revision 1, added /arm",
        "arm start",
        "/arm configure",
        "/arm connect",
        "[system] connected at 0.0 s",
        "[system] verified at 0.0 s",
        "networks programmed (ok)",
        "[gate] ok: /arm",
        "/arm activate",
        "[system] active at 0.0 s",
        "[apply] applied revision 2, added /arm",
    ]
    assert world.story.count("/camera activate") == 1


async def test_a_removed_node_is_taken_down_and_not_missed(tmp_path: Path) -> None:
    async with active(tmp_path, CHAIN) as world:
        assert _told(await world.apply(plan_of(CAMERA))) == "0"
        assert [each.node for each in world.status().nodes] == ["/camera"]
        await asyncio.sleep(30.0)
        assert world.status().not_ok == ""
        # Its key is free again.
        assert _told(await world.apply(CHAIN)) == "0"
    assert _since_begun(world)[:9] == [
        "[apply] begun revision 1, removed /viewer",
        "/viewer deactivate",
        *VIEWER_DOWN,
        "[system] connected at 0.0 s",
        "[system] verified at 0.0 s",
        "networks programmed (ok)",
        "[system] active at 0.0 s",
    ]
    assert not any("run.process-died" in line for line in world.story)
    assert world.story.count("/camera activate") == 1


async def test_what_differs_in_a_process_is_restarted_alone(tmp_path: Path) -> None:
    async with active(tmp_path, CHAIN) as world:
        assert _told(await world.apply(plan_of(CAMERA, LOUD))) == "0"
    outline = _since_begun(world)
    assert outline[0] == "[apply] begun revision 1, restarted /viewer"
    assert outline[-1] == "[apply] applied revision 2, restarted /viewer"
    assert not any(line.startswith(("/camera", "camera")) for line in outline)
    assert "viewer start" in outline


@pytest.mark.parametrize("refuses", [False, True])
async def test_a_parameter_is_set_while_its_node_runs_and_else_by_a_restart(
    tmp_path: Path, refuses: bool
) -> None:
    plans = [plan_of(CAMERA, _rate(VIEWER, rate)) for rate in (1.0, 2.0)]
    async with active(tmp_path, plans[0]) as world:
        if refuses:
            world.graph.refuses_live["/viewer"] = "cannot set 'rate' of '/viewer': it is read-only"
        assert _told(await world.apply(plans[1])) == "0"
    outline = _since_begun(world)
    assert outline[:2] == [
        "[apply] begun revision 1, parameters of /viewer",
        "/viewer set {'rate': 2.0}",
    ]
    assert ("viewer start" in outline) is refuses
    assert ("/viewer deactivate" in outline) is refuses
    assert world.system.plan == plans[1]


async def test_rules_alone_are_only_judged_by_and_given_up_where_they_are_violated(
    tmp_path: Path,
) -> None:
    open_ = replace(CHAIN, policy=Policy(undeclared_nodes=EndpointPolicy.OPEN))
    async with active(tmp_path, CHAIN) as world:
        world.intrude()
        await world.story.until("[verdict] active violated")
        assert _told(await world.apply(open_)) == "0"
        assert world.status().not_ok == ""
        answer = await world.apply(CHAIN)
        assert _told(answer) == f"4 cannot apply robot.lifecycle.yaml: {REFUSED}\n" + BACK.replace(
            "revision 1", "revision 2"
        )
        status = world.status()
        assert (status.phase, status.not_ok, status.revision) == ("active", "", 2)
        world.retreat()
        assert _told(await world.apply(CHAIN)) == "0"
        assert world.status().revision == 4
    outline = _since_begun(world)
    assert not any(line.endswith(("start", "activate", "deactivate")) for line in outline)


WAYS = {
    "does not start": ("arm start", "no such class", "cannot start '/arm': no such class"),
    "does not configure": ("/arm configure", "no gripper", "cannot configure '/arm': no gripper"),
    "does not connect": ("/arm connect", "no cable", "cannot connect '/arm': no cable"),
    "does not activate": ("/arm activate", "no power", "cannot activate '/arm': no power"),
    "dies": ("/arm configure", "die", "cannot keep '/arm' running: pid"),
    "hangs": ("/arm configure", "hang", "cannot bring up '/arm': it was still configuring"),
}


@pytest.mark.parametrize("how", WAYS)
async def test_a_node_that_fails_rolls_everything_back(tmp_path: Path, how: str) -> None:
    line, way, why = WAYS[how]
    async with active(tmp_path, CHAIN) as world:
        world.hosts.ways[line] = way
        answer = await world.apply(plan_of(CAMERA, LOUD, ARM))
        assert _told(answer).startswith(f"6 cannot apply robot.lifecycle.yaml: {why}")
        assert answer.error.endswith(BACK)
        status = world.status()
        assert (status.phase, status.not_ok, status.revision) == ("active", "", 1)
        assert [each.node for each in status.nodes] == ["/camera", "/viewer"]
        assert world.system.plan == CHAIN
        assert await world.order(ControlRequest.RESTART) == "0"
    outline = world.since("[apply] begun")
    stages = [line for line in outline if line.startswith("[apply]")]
    assert stages[0] == "[apply] begun revision 1, added /arm, restarted /viewer"
    assert stages[1] == "[apply] rolling_back revision 2"
    assert stages[2] == "[apply] rolled_back revision 1"
    until = outline.index(stages[2])
    assert not any(line.startswith(("/camera", "camera")) for line in outline[:until])
    assert "/viewer activate" in outline[:until]


async def test_a_gate_that_stays_closed_activates_nothing_and_rolls_back(tmp_path: Path) -> None:
    async with active(tmp_path, CHAIN) as world:
        world.hosts.takes_s["/arm configure"] = 1.0
        applying = asyncio.ensure_future(world.apply(MORE))
        await world.story.until("/arm configure")
        world.intrude()
        answer = await applying
        assert _told(answer).startswith(f"4 cannot apply robot.lifecycle.yaml: {REFUSED}\n")
        assert "in force again, revision 1, but its verdict is violated" in answer.error
        # What was active stays so; the violation is not of the manifest's making.
        assert world.status().phase == "active"
        world.retreat()
        await asyncio.sleep(1.0)
        assert world.status().not_ok == ""
    assert "/arm activate" not in world.story
    assert not any(line.endswith("deactivate") for line in _since_begun(world))


async def test_parameters_that_were_set_are_set_back(tmp_path: Path) -> None:
    plans = [plan_of(CAMERA, _rate(VIEWER, rate)) for rate in (1.0, 2.0)]
    more = plan_of(*plans[1].nodes, ARM)
    async with active(tmp_path, plans[0]) as world:
        world.hosts.ways["/arm configure"] = "no gripper"
        assert _told(await world.apply(more)).endswith(BACK)
    assert [line for line in world.story if " set " in line] == [
        "/viewer set {'rate': 2.0}",
        "/viewer set {'rate': 1.0}",
    ]
    assert "/viewer deactivate" not in _since_begun(world)


async def test_parameters_that_a_death_kept_us_from_hearing_of_are_set_back_too(
    tmp_path: Path,
) -> None:
    camera = replace(CAMERA, supervision=AGAIN)
    plans = [plan_of(camera, _rate(VIEWER, rate)) for rate in (1.0, 2.0)]
    async with active(tmp_path, plans[0]) as world:
        world.hosts.takes_s["/viewer set"] = 1.0  # it takes them at once, and answers late
        applying = asyncio.ensure_future(world.apply(plans[1]))
        await world.story.until("/viewer set {'rate': 2.0}")
        world.kill("camera")
        assert "cannot keep '/camera' running" in (await applying).error
        await world.story.until("[restarted] camera (1)")
    assert [line for line in world.story if " set " in line] == [
        "/viewer set {'rate': 2.0}",
        "/viewer set {'rate': 1.0}",
    ]


async def test_one_that_takes_too_long_is_rolled_back(tmp_path: Path) -> None:
    async with active(tmp_path, CHAIN) as world:
        world.hosts.takes_s["/arm configure"] = 4.0
        answer = await world.apply(MORE, timeout_s=2.0)
        assert "cannot bring up 'robot' within 2 s: /arm is still configuring" in answer.error
        assert answer.exit_code == 6
        assert answer.error.endswith(BACK)


@pytest.mark.parametrize("stage", ["viewer deactivate", "arm configure", "arm activate"])
@pytest.mark.parametrize("policy", [Restart.NO, Restart.ON_FAILURE])
async def test_the_death_of_another_rolls_back_and_then_counts_as_ever(
    tmp_path: Path, stage: str, policy: Restart
) -> None:
    camera = replace(CAMERA, supervision=msgspec.structs.replace(AGAIN, restart=policy))
    plan, other = plan_of(camera, VIEWER), plan_of(camera, LOUD, ARM)
    ends = policy is Restart.NO

    async with active(tmp_path, plan, code="6" if ends else "0") as world:
        world.hosts.takes_s[f"/{stage}"] = 1.0
        applying = asyncio.ensure_future(world.apply(other))
        await world.story.until(f"/{stage}")
        world.kill("camera")
        answer = await applying
        assert answer.exit_code == 6
        assert "cannot keep '/camera' running" in answer.error
        if ends:
            assert answer.error.endswith("the system is taken down")
        else:
            assert "is in force again, revision 1, and what failed meanwhile" in answer.error
            await world.story.until("[restarted] camera")
            status = world.status()
            assert (status.phase, status.not_ok, status.revision) == ("active", "", 1)
            assert [each.state for each in status.nodes] == ["active", "active"]
    assert world.story[-1] == f"[stopped] {6 if ends else 0}"


async def test_a_node_at_the_gate_again_as_another_dies_is_activated_with_that_one(
    tmp_path: Path,
) -> None:
    camera = replace(CAMERA, supervision=AGAIN)
    plan, other = plan_of(camera, VIEWER), plan_of(camera, LOUD, ARM)
    async with active(tmp_path, plan) as world:
        world.hosts.takes_s["/arm configure"] = 4.0
        applying = asyncio.ensure_future(world.apply(other, timeout_s=2.0))
        await world.story.until("/arm configure")
        world.intrude()  # the gate stays closed
        await world.story.until("[apply] rolling_back")
        await world.story.until("/viewer connect", 3)
        await asyncio.sleep(0.1)
        world.kill("camera")
        assert "and what failed meanwhile is started again" in (await applying).error
        world.retreat()
        await world.story.until("[restarted] camera")
        status = world.status()
        assert [each.state for each in status.nodes] == ["active", "active"]
        assert (status.phase, status.not_ok, status.revision) == ("active", "", 1)


async def test_a_node_of_the_manifest_before_that_does_not_come_back_ends_the_run(
    tmp_path: Path,
) -> None:
    async with active(tmp_path, CHAIN, code="6") as world:
        world.hosts.ways["/viewer configure"] = "no display"
        answer = await world.apply(plan_of(CAMERA, LOUD))
        assert _told(answer) == (
            "6 cannot apply robot.lifecycle.yaml: cannot configure '/viewer': no display\n"
            "cannot go back to robot.lifecycle.yaml: cannot configure '/viewer': no display; "
            "the system is taken down"
        )
    assert world.story[-1] == "[stopped] 6"


async def test_a_failing_node_is_started_at_once_by_a_manifest_that_mends_it(
    tmp_path: Path,
) -> None:
    slow = msgspec.structs.replace(AGAIN, restart_sec=1000.0, restart_max_delay_sec=1000.0)
    plan = plan_of(CAMERA, replace(VIEWER, supervision=slow))
    mended = plan_of(CAMERA, replace(LOUD, supervision=slow))
    async with active(tmp_path, plan) as world:
        world.kill("viewer")
        await world.story.until("[backoff] viewer")
        assert _told(await world.apply(mended)) == "0"
        assert world.status().phase == "active"
    assert "[restarted] viewer (0)" not in world.story
    assert world.outline[-1] == "[stopped] 0"


async def test_other_orders_are_refused_meanwhile(tmp_path: Path) -> None:
    async with active(tmp_path, CHAIN) as world:
        world.hosts.takes_s["/arm configure"] = 5.0
        applying = asyncio.ensure_future(world.apply(plan_of(CAMERA, LOUD, ARM)))
        await world.story.until("/arm configure")
        why = (
            "another manifest is being applied to it; ask again once 'lifecycle apply' has ended; "
            "'lifecycle down' is taken at once"
        )
        for order in (ControlRequest.PAUSE, ControlRequest.RESTART):
            said = await world.order(order)
            assert said == f"2 cannot {order.value} 'robot': it is applying, {why}"
        for dry_run in (False, True):
            assert _told(await world.apply(CHAIN, dry_run=dry_run)) == (
                f"2 cannot apply another manifest to 'robot': it is applying, {why}"
            )
        assert _told(await applying) == "0"
        # What no command line sends is refused, too.
        assert (await world.apply(CHAIN, timeout_s=-1.0)).exit_code == 2
        assert (await world.order(ControlRequest.APPLY)).startswith("2 cannot apply a manifest")


STAGES = {
    "/viewer deactivate": "applying",
    "/viewer shutdown": "applying",
    "/arm configure": "applying",
    "networks programmed": "applying",
    "/arm activate": "applying",
    "[apply] rolling_back": "rolling back",
}


@pytest.mark.parametrize("stage", STAGES)
async def test_an_end_in_the_middle_takes_down_what_is_there(tmp_path: Path, stage: str) -> None:
    async with active(tmp_path, CHAIN, code="6") as world:
        world.hosts.takes_s[stage] = 5.0
        times = 1 + sum(line.startswith(stage) for line in world.story)
        if stage.startswith("["):
            world.hosts.ways["/arm connect"] = "no cable"
            world.hosts.takes_s["/arm shutdown"] = 5.0
        world.networks.takes_s = 5.0
        applying = asyncio.ensure_future(world.apply(plan_of(CAMERA, LOUD, ARM)))
        await world.story.until(stage, times)
        await asyncio.sleep(0.1)
        assert world.status().phase == STAGES[stage]
        assert await world.order(ControlRequest.DOWN) == "6"
        assert _told(await applying) == "6 cannot go on: 'robot' is being taken down"
    assert world.report.endswith(f"the system was {STAGES[stage]}, not active")


async def test_what_waits_at_its_gate_is_let_through_by_a_manifest_or_waits_on(
    tmp_path: Path,
) -> None:
    async with active(tmp_path, CHAIN) as world:
        world.intrude()
        assert (await world.order(ControlRequest.RESTART, "viewer"))[0] == "4"
        world.retreat()
        assert world.status().phase == "held"
        world.hosts.ways["/arm configure"] = "no gripper"
        assert _told(await world.apply(MORE)).endswith(
            "revision 1, verified, and held as before: lifecycle resume"
        )
        assert world.status().phase == "held"
        assert [each.state for each in world.status().nodes] == ["active", "inactive"]
        world.hosts.ways.clear()
        assert _told(await world.apply(MORE)) == "0"
        assert world.status().phase == "active"
    assert world.story.count("/camera activate") == 1
    assert world.story.count("/viewer activate") == 2


async def test_a_network_that_cannot_be_programmed_rolls_back(tmp_path: Path) -> None:
    async with active(tmp_path, CHAIN) as world:
        world.networks.fails = "cannot reach the server"
        world.story.in_the_moment["[apply] rolling_back"] = lambda: setattr(
            world.networks, "fails", ""
        )
        answer = await world.apply(MORE)
        assert _told(answer).startswith("6 cannot apply robot.lifecycle.yaml: cannot reach")
        assert answer.error.endswith(BACK)
    assert "/arm activate" not in world.story


async def test_a_paused_system_takes_a_manifest_and_stays_paused(tmp_path: Path) -> None:
    async with active(tmp_path, CHAIN) as world:
        assert await world.order(ControlRequest.PAUSE) == "0"
        assert _told(await world.apply(MORE)) == "0"
        status = world.status()
        assert (status.phase, {each.state for each in status.nodes}) == ("paused", {"inactive"})
        world.hosts.ways["/viewer configure"] = "no display"
        # The way back fails, too, but a moment later it would not.
        world.story.in_the_moment["[apply] rolling_back"] = world.hosts.ways.clear
        assert _told(await world.apply(plan_of(CAMERA, LOUD, ARM))).endswith(
            "revision 2, paused and verified"
        )
        assert world.status().phase == "paused"
        assert await world.order(ControlRequest.RESUME) == "0"
    assert world.story.count("/arm activate") == 1


async def test_modes_may_change_and_the_nodes_follow(tmp_path: Path) -> None:
    quiet = replace(CHAIN, modes=(Mode(name="quiet", inactive=("viewer",), at=HERE),))
    loud = replace(CHAIN, modes=(Mode(name="loud", at=HERE),))
    async with active(tmp_path, CHAIN) as world:
        assert _told(await world.apply(quiet)) == "0"
        assert [each.state for each in world.status().nodes] == ["active", "inactive"]
        assert _told(await world.apply(loud)) == "0"
        assert world.status().mode == "loud"
        assert [each.state for each in world.status().nodes] == ["active", "active"]
    assert "viewer start" not in _since_begun(world)


async def test_parameters_of_the_mode_that_the_system_is_in_are_set(tmp_path: Path) -> None:
    def plan(rate: float) -> Plan:
        rates = {"day": 1.0, "night": rate}
        camera = _rate(CAMERA, 1.0)
        given = tuple(
            ModeParameters(
                mode=mode,
                parameters=tuple(replace(each, value=value) for each in camera.expected_parameters),
            )
            for mode, value in rates.items()
        )
        camera = replace(camera, mode_parameters=given)
        modes = tuple(Mode(name=each, at=HERE) for each in rates)
        policy = Policy(undeclared_nodes=EndpointPolicy.OPEN) if rate > 2.0 else Policy()
        return replace(plan_of(camera, VIEWER), modes=modes, policy=policy)

    async with active(tmp_path, plan(2.0)) as world:
        assert await world.order(ControlRequest.MODE, mode="night") == "0"
        assert _told(await world.apply(plan(3.0))) == "0"
        assert world.status().mode == "night"
        assert world.system.plan.node("camera").parameters == (("rate", 3.0),)
        assert await world.order(ControlRequest.MODE, mode="day") == "0"
        assert _told(await world.apply(plan(4.0))) == "0"
    assert [line for line in world.story if " set " in line] == ["/camera set {'rate': 3.0}"]
    assert "camera start" not in _since_begun(world)


async def test_what_a_running_supervisor_cannot_change_is_refused_before_anything_is_touched(
    tmp_path: Path,
) -> None:
    others = {
        'system: was "robot", is "other"': replace(CHAIN, system="other"),
        "ROS_DOMAIN_ID: was 30, is 31": replace(CHAIN, domain_id=31),
        "RMW_IMPLEMENTATION: was , is rmw_zenoh_cpp": replace(CHAIN, rmw="rmw_zenoh_cpp"),
    }
    async with active(tmp_path, CHAIN) as world:
        for line, plan in others.items():
            for dry_run in (True, False):
                answer = await world.apply(plan, dry_run=dry_run)
                assert _told(answer) == (
                    "2 cannot apply robot.lifecycle.yaml to 'robot' while it runs: a running "
                    f"supervisor cannot change this:\n{line}; end it and start it anew: "
                    "lifecycle down, then lifecycle up"
                )
    assert not any(line.startswith("[apply]") for line in world.story)


async def test_a_plan_that_does_not_hold_together_is_refused(tmp_path: Path) -> None:
    nobody = replace(MORE.processes[0], nodes=("nobody",))
    broken = [
        replace(MORE, nodes=()),
        replace(MORE, nodes=MORE.nodes * 2),
        replace(MORE, nodes=MORE.nodes[1:]),
        replace(MORE, processes=(nobody, *MORE.processes[1:])),
        replace(MORE, levels=(("nobody",),)),
        replace(MORE, modes=(Mode(name="m", inactive=("nobody",), at=HERE),)),
    ]
    async with active(tmp_path, CHAIN) as world:
        for plan in broken:
            answer = await world.apply(plan)
            assert _told(answer).endswith("its nodes and processes do not fit together")
    assert not any(line.startswith("[apply]") for line in world.story)


async def test_what_was_adopted_is_judged_by_another_manifest_and_never_taken_down(
    tmp_path: Path,
) -> None:
    world = SessionWorld(CHAIN, tmp_path, adopt=True)
    world.graph.others["/viewer"] = "active"
    async with world.running("[system] active"):
        for plan in (plan_of(CAMERA, LOUD), plan_of(CAMERA)):
            assert _told(await world.apply(plan)) == (
                "2 cannot apply robot.lifecycle.yaml to 'robot' while it runs: '/viewer' would "
                "be taken down, and was adopted; who started it ends it; then lifecycle down, "
                "and lifecycle up"
            )
        assert _told(await world.apply(MORE)) == "0"
        assert [each.state for each in world.status().nodes] == ["active"] * 3
        assert await world.order(ControlRequest.DOWN) == "0"
    assert "viewer start" not in world.story
    assert not any(line.startswith("/viewer") for line in world.story)


async def test_over_tcp_only_what_restarts_nothing_is_applied(tmp_path: Path) -> None:
    rules = replace(DIALLING, policy=Policy(undeclared_nodes=EndpointPolicy.OPEN))
    async with active(tmp_path, DIALLING) as world:
        assert await world.order(ControlRequest.RESTART, "viewer") == "0"
        urls = world.system.plan.node("viewer").connections
        refused = await world.apply(plan_of(*DIALLING.nodes, ARM))
        assert "a TCP port that was used is not connected to again" in refused.error
        assert _told(await world.apply(rules)) == "0"
        # It runs where its restart has put it.
        assert world.system.plan.node("viewer").connections == urls
        assert urls != rules.node("viewer").connections


POOL = (
    CHAIN,
    MORE,
    plan_of(CAMERA),
    plan_of(CAMERA, LOUD, ARM),
    plan_of(replace(CAMERA, log_level="warn"), VIEWER),
    plan_of(*(replace(each, process="both") for each in CHAIN.nodes), ARM),
    plan_of(CAMERA, _rate(VIEWER, 1.0)),
    plan_of(CAMERA, _rate(VIEWER, 2.0), ARM),
    replace(MORE, policy=Policy(undeclared_nodes=EndpointPolicy.OPEN)),
    replace(MORE, modes=(Mode(name="a", inactive=("arm",), at=HERE), Mode(name="b", at=HERE))),
)
FAULTS = (
    *("/arm configure", "/arm connect", "/arm activate", "arm start", "/viewer configure"),
    *("/viewer activate", "/camera connect", "/viewer deactivate", "/camera cleanup"),
)


@pytest.mark.parametrize("seed", range(12))
async def test_whatever_fails_one_of_two_manifests_is_in_force_as_a_whole(
    tmp_path: Path, seed: int
) -> None:
    chance = random.Random(seed)
    pool = [
        replace(each, nodes=tuple(replace(one, supervision=AGAIN) for one in each.nodes))
        for each in POOL
    ]

    async def disturb(world: SessionWorld) -> None:
        await asyncio.sleep(chance.choice([0.0, 0.05, 0.3, 1.1]))
        what = chance.choice(["kill", "intrude", "nothing", "nothing"])
        if what == "intrude":
            world.intrude()
            await asyncio.sleep(chance.choice([0.2, 1.5]))
            world.retreat()
        elif what == "kill" and world.system.processes:
            name = chance.choice(sorted(world.system.processes))
            process = world.hosts.processes.get(name)
            if process is not None and not process.exited.done():
                world.kill(name)

    async with active(tmp_path, pool[0]) as world:
        for line in FAULTS:
            world.hosts.takes_s[line] = chance.choice([0.0, 0.0, 0.2])
        for _ in range(4):
            before, plan = world.system.first, chance.choice(pool)
            if chance.random() < 0.6:
                world.hosts.ways[chance.choice(FAULTS)] = chance.choice(["no power", "die"])
            if chance.random() < 0.2:
                world.graph.refuses_live["/viewer"] = "read-only"
            disturbing = asyncio.ensure_future(disturb(world))
            world.story.in_the_moment["[apply] rolling_back"] = world.hosts.ways.clear
            answer = await world.apply(plan)
            assert world.system.first == (plan if answer.exit_code == 0 else before)
            assert sorted(world.system.nodes) == sorted(
                each.key for each in world.system.first.nodes
            )
            assert world.system.processes.keys() == {
                each.name for each in world.system.first.processes
            }
            world.hosts.ways.clear()
            world.graph.refuses_live.clear()
            await disturbing
            await asyncio.sleep(60.0)
            if world.status().phase == "held":
                assert await world.order(ControlRequest.RESUME) == "0"
            status = world.status()
            # Parameters are not seen in this world.
            assert (status.phase, status.verdict) != ("active", Outcome.VIOLATED), status.not_ok
            assert status.revision == world.system.run.revision
            wanted = {each.name for each in world.system.nodes.values() if each.core.is_gated}
            assert {each.node for each in status.nodes if each.state == "active"} == wanted
