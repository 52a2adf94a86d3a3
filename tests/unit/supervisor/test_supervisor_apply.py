"""Another manifest for a running system; outlines of runs are compared.

How it is taken, what fails and the way back are told in core/test_changes.py.
"""

from __future__ import annotations

import contextlib
from collections.abc import AsyncIterator
from pathlib import Path

from msgspec.structs import replace

from lifecycle.manifest.model import EndpointPolicy, Policy
from lifecycle.plan.model import Plan
from lifecycle.supervisor.control.protocol import Answer, ControlRequest
from tests.builders import plan_of
from tests.unit.supervisor.core.test_changes import ARM, CAMERA, MORE, VIEWER, rate
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
    before = plan_of(CAMERA, rate(VIEWER, 1.0))
    more = plan_of(CAMERA, rate(VIEWER, 2.0), ARM)
    async with active(tmp_path, before) as world:
        said = await world.apply(more, dry_run=True)
        assert said.exit_code == 4
        assert said.change is not None
        assert (said.change.added, said.change.restarted) == (("/arm",), ())
        assert "nodes.arm: was not declared, is declared" in said.change.differences[0]
        assert world.system.plan == before
        done = await world.apply(more)
        assert _told(done) == "0"
        assert done.change is not None
        assert (done.change.added, done.change.revision) == (("/arm",), 2)
        status = world.status()
        assert (status.phase, status.revision) == ("active", 2)
        for dry_run in (False, True):
            again = await world.apply(more, dry_run=dry_run)
            assert again.change is not None
            assert (again.exit_code, again.change.differences) == (0, ())
        # It is watched as all others are.
        assert await world.order(ControlRequest.RESTART, "arm") == "0"
    assert _since_begun(world)[:12] == [
        "[apply] begun revision 1, added /arm, parameters of /viewer",
        "/viewer set {'rate': 2.0}",
        *("arm start", "/arm configure", "/arm connect"),
        *("[system] connected at 0.0 s", "[system] verified at 0.0 s"),
        *("networks programmed (unverifiable)", "[gate] unverifiable: /arm", "/arm activate"),
        "[system] active at 0.0 s",
        "[apply] applied revision 2, added /arm, parameters of /viewer",
    ]
    assert world.story.count("/camera activate") == 1


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


async def test_what_was_adopted_is_judged_by_another_manifest_and_never_taken_down(
    tmp_path: Path,
) -> None:
    world = SessionWorld(CHAIN, tmp_path, adopt=True)
    world.graph.others["/viewer"] = "active"
    async with world.running("[system] active"):
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
