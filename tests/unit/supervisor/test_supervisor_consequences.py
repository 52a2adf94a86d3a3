"""What is done about violations of an active system: what is nearest, and whole sessions.

As in test_supervisor_session.py outlines of runs are compared.
"""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest
from msgspec.structs import replace

from lifecycle.manifest.model import (
    Condition,
    Consequence,
    Health,
    OnViolation,
    Reaction,
    Supervision,
)
from lifecycle.manifest.model import Restart as RestartWhen
from lifecycle.node.host.control import Event as HostEvent
from lifecycle.plan.model import Plan
from lifecycle.supervisor.control.server import ControlRequest
from lifecycle.supervisor.core.consequences import reaction_of
from lifecycle.supervisor.core.state import Level
from lifecycle.supervisor.nodes.system import System
from lifecycle.supervisor.run.events import Emitter
from lifecycle.verify.observation import HealthReport
from lifecycle.verify.outcome import Outcome
from lifecycle.verify.verdict import Finding
from tests.builders import configuration, plan_of, planned_node
from tests.unit.supervisor.session_world import DOWN, SessionWorld

REPORT, DEACTIVATE, MODE, PAUSE, STOP = Consequence
Said = tuple[tuple[str, Consequence], ...]
TWICE = "graph.duplicate-node"


def _plan(system: Said = (), camera: Said = (), restart: RestartWhen = RestartWhen.NO) -> Plan:
    supervision = Supervision(restart=restart, restart_sec=1.0)
    plan = plan_of(
        replace(planned_node("camera", supervision=supervision), on_violation=_said(camera)),
        planned_node("viewer", after={"camera": Condition.ACTIVE}),
    )
    return replace(plan, on_violation=_said(system))


def _said(pairs: Said) -> OnViolation:
    return tuple(Reaction(rule=rule, what=what) for rule, what in pairs)


# What is asked for


@pytest.mark.parametrize(
    ("system", "camera", "found"),
    [
        ((), (), REPORT),
        ((("default", STOP),), (), STOP),
        ((("default", STOP), ("graph", PAUSE)), (), PAUSE),
        ((("graph", PAUSE), (TWICE, DEACTIVATE)), (), DEACTIVATE),
        (((TWICE, STOP),), (("default", REPORT),), REPORT),
        ((("graph", STOP),), (("param", REPORT),), STOP),
    ],
)
def test_what_is_nearest_counts(system: Said, camera: Said, found: Consequence) -> None:
    finding = _found(TWICE, "/camera", node="/camera")
    assert reaction_of(_plan(system, camera), finding).what is found


def test_of_two_ends_of_a_flow_the_stronger_one_counts() -> None:
    plan = _plan((), (("default", DEACTIVATE),))
    ends = ("/camera", "/viewer")
    pair = _found("flow.not-unique", "/video: /camera → /viewer", ends=ends)
    assert reaction_of(plan, pair).what is DEACTIVATE


def _found(rule: str, subject: str, **rest: object) -> Finding:
    return Finding(
        rule=rule,
        outcome=Outcome.VIOLATED,
        subject=subject,
        expected="",
        observed="",
        message="",
        **rest,  # type: ignore[arg-type]
    )


# Sessions


async def test_a_violated_node_is_deactivated_and_stays_so_until_it_is_resumed(
    tmp_path: Path,
) -> None:
    plan = _plan(camera=((TWICE, DEACTIVATE),))
    world = SessionWorld(plan, tmp_path, stop_after_s=20.0)
    async with world.running("[system] active"):
        world.double("/camera")
        await world.story.until("[node] /camera connected", 2)
        await asyncio.sleep(3.0)
        camera, viewer = world.status().nodes
        why = f"on_violation: deactivate ({TWICE} of /camera); lifecycle resume"
        assert (world.status().phase, camera.doing, viewer.doing) == ("held", why, "")
        assert (await world.order(ControlRequest.RESUME))[0] == "4"
        world.double()
        await asyncio.sleep(3.0)
        assert world.status().nodes[0].doing == why
        assert await world.order(ControlRequest.RESUME) == "0"
        assert world.status().nodes[0].doing == ""
    outline = world.since("[verdict] active violated")
    assert outline[:3] == [
        f"[verdict] active violated {TWICE} /camera",
        f"[consequence] deactivate /camera for {TWICE}",
        "/camera deactivate",
    ]
    assert outline[-len(DOWN) - 8 : -len(DOWN) - 3] == [
        "[system] verified at 6.5 s",
        "networks programmed (ok)",
        "[gate] ok: /camera",
        "/camera activate",
        "[system] active at 6.5 s",
    ]
    assert world.outline.count("/viewer deactivate") == 1
    assert world.story[-1] == "[stopped] 4"


async def test_what_concerns_no_node_of_the_system_pauses_all_of_it(tmp_path: Path) -> None:
    plan = _plan((("graph", DEACTIVATE),))
    world = SessionWorld(plan, tmp_path, stop_after_s=10.0)
    async with world.running("[system] active"):
        world.intrude()
        await world.story.until("[system] paused")
        await asyncio.sleep(2.0)
        assert world.status().phase == "paused"
        assert "graph.undeclared-node of /intruder" in world.status().nodes[1].doing
        world.retreat()
        assert await world.order(ControlRequest.RESUME) == "0"
    assert world.since("[consequence]")[:4] == [
        "[consequence] pause  for graph.undeclared-node",
        "/viewer deactivate",
        "/camera deactivate",
        "[system] paused at 0.5 s",
    ]
    assert len([each for each in world.outline if each.startswith("[consequence]")]) == 1


async def test_what_a_node_said_of_its_health_while_it_was_inactive_is_no_answer(
    tmp_path: Path,
) -> None:
    plan = plan_of(replace(planned_node("camera"), health=Health(check=True)))
    node = System(plan, emit=Emitter(), logs=tmp_path, processes=plan.processes).nodes["camera"]
    well = configuration("/camera", health=HealthReport(ok=True))
    node.report("inactive", connected=True)
    node.configuration = well
    assert node.is_healthy
    node.core.level = Level.ACTIVE
    node.report("active", connected=True)
    assert not node.is_healthy
    assert node.unhealthy_reason == ": it has not answered since its state changed"
    node.configuration = replace(well, state="active")
    assert node.is_healthy


async def test_a_node_waits_until_another_is_healthy_and_one_that_no_longer_is_has_a_consequence(
    tmp_path: Path,
) -> None:
    camera, viewer = (planned_node(each) for each in ("camera", "viewer"))
    camera = replace(camera, health=Health(check=True))
    viewer = planned_node("viewer", after={"camera": Condition.HEALTHY})
    plan = plan_of(camera, viewer)
    plan = replace(plan, on_violation=_said((("node", DEACTIVATE),)))
    world = SessionWorld(plan, tmp_path, stop_after_s=10.0)
    interfaces = world.hosts.interfaces
    unsaid = HealthReport(ok=None, message="it has not answered")
    interfaces["/camera"] = replace(interfaces["/camera"], health=unsaid)

    def report(health: HealthReport) -> None:
        interfaces["/camera"] = replace(interfaces["/camera"], health=health)
        world.system.on_host_event(
            HostEvent(
                kind="configuration",
                node="/camera",
                state=interfaces["/camera"].state,
                connected=True,
                configuration=interfaces["/camera"],
            )
        )

    async with world.running("/camera activate"):
        await asyncio.sleep(3.0)
        assert "/viewer activate" not in world.story
        report(HealthReport(ok=True))
        await world.story.until("[system] active")
        await asyncio.sleep(1.0)
        report(HealthReport(ok=False, message="too hot"))
    at = world.outline.index("[system] active at 8.0 s")
    assert world.outline[at + 1 : at + 4] == [
        "[verdict] active violated node.unhealthy /camera",
        "[consequence] deactivate /camera for node.unhealthy",
        "/camera deactivate",
    ]
    assert "node /camera is not healthy: too hot" in world.messages
