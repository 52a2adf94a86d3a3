"""Another manifest for a running system; outlines of runs are compared.

How it is taken, what fails and the way back are told in core/test_changes.py.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator
from pathlib import Path

import pytest
from msgspec.structs import replace

from lifecycle.manifest.model import EndpointPolicy, Mode, Policy
from lifecycle.plan.model import Plan
from lifecycle.supervisor.control.protocol import Answer, ControlRequest
from tests.builders import HERE, plan_of
from tests.unit.supervisor.core.test_changes import ARM, CAMERA, LOUD, MORE, OTHER, VIEWER, rate
from tests.unit.supervisor.session_world import (
    CHAIN,
    DIALLING,
    REFUSED,
    SessionWorld,
)


@contextlib.asynccontextmanager
async def active(tmp_path: Path, plan: Plan) -> AsyncIterator[SessionWorld]:
    """A session that is active; it is ended after the body."""
    world = SessionWorld(plan, tmp_path)
    async with world.running("[system] active"):
        yield world
        assert await world.order(ControlRequest.DOWN) == "0"


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


@pytest.mark.parametrize("refuses", [False, True])
async def test_a_parameter_is_set_while_its_node_runs_and_else_by_a_restart(
    tmp_path: Path, refuses: bool
) -> None:
    plans = [plan_of(CAMERA, rate(VIEWER, value)) for value in (1.0, 2.0)]
    async with active(tmp_path, plans[0]) as world:
        if refuses:
            why = "cannot set 'rate' of '/viewer': it is read-only"
            world.hosts.ways["/viewer set {'rate': 2.0}"] = why
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
        assert _told(answer) == (
            f"4 cannot apply robot.lifecycle.yaml: {REFUSED}\n"
            "robot.lifecycle.yaml is in force again, revision 2, active and verified"
        )
        status = world.status()
        assert (status.phase, status.not_ok, status.revision) == ("active", "", 2)
        world.retreat()
        assert _told(await world.apply(CHAIN)) == "0"
        assert world.status().revision == 4
    outline = _since_begun(world)
    assert not any(line.endswith(("start", "activate", "deactivate")) for line in outline)


async def test_other_orders_are_refused_meanwhile(tmp_path: Path) -> None:
    async with active(tmp_path, CHAIN) as world:
        world.hosts.takes_s["/arm configure"] = 5.0
        applying = asyncio.ensure_future(world.apply(OTHER))
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
