"""What is restarted by policy: the pure policy, and whole sessions in which things fail.

As in test_supervisor_session.py outlines of runs are compared.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Iterator
from pathlib import Path

import msgspec
import pytest
from msgspec.structs import replace

from lifecycle.manifest.model import Condition, OnFailure, Restart, RunKind, Supervision
from lifecycle.plan.model import Plan, PlannedNode
from lifecycle.supervisor.control.server import ControlRequest
from lifecycle.supervisor.core.restart import RestartPolicy, delay_s, is_restarted
from lifecycle.supervisor.core.state import Options, new_run
from lifecycle.supervisor.processes.process import ProcessExit
from tests.builders import plan_of, planned_node
from tests.unit.supervisor.session_world import (
    ACTIVATED,
    CAMERA_DOWN,
    CHANGED,
    CONNECTED,
    DOWN,
    INTRUDED,
    REFUSED,
    VIEWER_DOWN,
    SessionWorld,
    over,
)

ON_FAILURE = Supervision(restart=Restart.ON_FAILURE, restart_sec=1.0)


# The policy


def _started(how: Supervision) -> RestartPolicy:
    policy = RestartPolicy(how)
    policy.reset(0.0)
    return policy


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
    policy = _started(Supervision(restart=Restart.ALWAYS))
    found = []
    for at_s in (0.1, 0.3, 0.5, 0.7, 0.9):
        found.append(policy.failed(at_s))
        policy.started(at_s + 0.1)
    assert found == [pytest.approx(at_s + 0.1) for at_s in (0.1, 0.3, 0.5, 0.7)] + [None]
    assert policy.restarts == 5
    endless = _started(Supervision(restart=Restart.ALWAYS, start_limit_interval_sec=0.0))
    for at_s in range(100):
        assert endless.failed(float(at_s)) == at_s + 0.1
        endless.started(at_s + 0.1)


def test_until_the_system_was_up_a_process_that_fails_late_each_time_is_given_up() -> None:
    how = Supervision(restart=Restart.ON_FAILURE, start_limit_interval_sec=1.0, start_limit_burst=3)
    policies = {was_up: _started(how) for was_up in (True, False)}
    again = {was_up: [] for was_up in policies}
    for now_s in (5.0, 10.0, 15.0):
        for was_up, policy in policies.items():
            again[was_up].append(policy.failed(now_s, was_up=was_up) is not None)
            policy.started(now_s)
    assert again == {True: [True, True, True], False: [True, True, False]}


def test_after_a_long_run_and_after_a_person_the_delay_begins_anew() -> None:
    how = Supervision(
        restart=Restart.ALWAYS, restart_sec=1.0, restart_steps=2, restart_max_delay_sec=4.0
    )
    policy = _started(how)
    assert policy.failed(1.0) == 2.0
    policy.started(2.0)
    assert policy.failed(3.0) == 5.0
    policy.started(5.0)
    assert policy.failed(15.0) == 16.0
    policy.started(16.0)
    assert policy.failed(17.0) == 19.0
    policy.reset(19.0)
    assert policy.failed(20.0) == 21.0


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
    nodes = (
        planned_node("driver", process="p", supervision=supervision),
        planned_node("helper", process="p", supervision=supervision),
        planned_node("camera", after={"driver": Condition.STARTED}),
        planned_node("viewer", after={"camera": Condition.ACTIVE}),
        planned_node("other"),
        _component("part", of="helper"),
    )
    assert " ".join(new_run(plan_of(*nodes), Options()).group("p")) == group


def _component(key: str, *, of: str) -> PlannedNode:
    node = planned_node(key, kind=RunKind.ATTACH)
    run_ = replace(node.run, component="parts/Part", container=of)
    return replace(node, run=run_)


# Sessions

DEPENDENTS = msgspec.structs.replace(ON_FAILURE, on_failure=OnFailure.DEPENDENTS)


def _chain(camera: Supervision = ON_FAILURE, viewer: Supervision = ON_FAILURE) -> Plan:
    return plan_of(
        planned_node("camera", supervision=camera),
        planned_node("viewer", supervision=viewer, after={"camera": Condition.ACTIVE}),
    )


GONE = "graph.missing-node /camera"
VIEWER_GONE = "graph.missing-node /viewer"
UNREPORTED = "state.unverifiable /camera, config.missing-report /camera"


PAIR = plan_of(*(planned_node(each, supervision=ON_FAILURE) for each in ("camera", "viewer")))


@contextlib.contextmanager
def _within(seconds: float) -> Iterator[None]:
    """Take less than so long."""
    began = asyncio.get_running_loop().time()
    yield
    assert asyncio.get_running_loop().time() - began < seconds


def _is_active(world: SessionWorld) -> bool:
    status = world.status()
    return status.phase == "active" and {each.state for each in status.nodes} == {"active"}


def _back(node: str, at_s: float) -> list[str]:
    """The outline of a node that comes again by itself."""
    return [
        f"{node} start",
        f"/{node} configure",
        f"/{node} connect",
        f"[system] connected at {at_s:.1f} s",
        "[verdict] connected ok",
        f"[system] verified at {at_s:.1f} s",
        "networks programmed (ok)",
        f"[gate] ok: /{node}",
        f"/{node} activate",
        f"[system] active at {at_s:.1f} s",
    ]


async def test_a_node_that_crashed_comes_again_through_its_gate_and_the_others_are_not_touched(
    tmp_path: Path,
) -> None:
    world = SessionWorld(_chain(), tmp_path, stop_after_s=10.0)
    async with world.running("[system] active"):
        await asyncio.sleep(3.0)
        world.kill("camera")
    assert world.since("[system] active")[1:] == [
        "[failure] run.process-died /camera, and the run goes on",
        "[backoff] camera in 1.0 s",
        f"[verdict] active violated {GONE}",
        *_back("camera", 4.0),
        "[restarted] camera (1)",
        "[stopping] at 10.0 s: done",
        *DOWN,
        *over(0),
    ]
    assert world.report == (
        "ended after it was active, exit code 0: done; restarted: 'camera' 1 time"
    )


async def test_a_process_that_fails_again_and_again_is_given_up_loudly_with_its_history(
    tmp_path: Path,
) -> None:
    how = msgspec.structs.replace(ON_FAILURE, restart_sec=0.5, start_limit_burst=3)
    world = SessionWorld(_chain(how), tmp_path)
    async with world.running("[system] active"):
        world.hosts.ways["/camera configure"] = "no device"
        world.kill("camera")
    again = ["camera start", "/camera configure"]
    failed = "[failure] run.transition-failed /camera, and the run goes on"
    assert world.since("[verdict] active violated")[1:] == [
        *again,
        failed,
        "[backoff] camera in 0.5 s",
        "/camera shutdown",
        *again,
        failed,
        "[gave_up] camera (3 failures)",
        "[failure] run.gave-up /camera",
        "[stopping] at 1.0 s: rolling back",
        "/viewer deactivate",
        *VIEWER_DOWN,
        "/camera shutdown",
        *over(7),
    ]
    assert world.messages[0] == (
        "cannot keep 'camera' running: it was started 3 times within 10 s (start_limit_burst, "
        "start_limit_interval_sec) and failed again: "
        "at 0.0 s, cannot keep '/camera' running: pid 5000001 died: killed by SIGSEGV; "
        "at 0.5 s, cannot configure '/camera': no device; "
        "at 1.0 s, cannot configure '/camera': no device"
    )


@pytest.mark.parametrize("step", ["start", "/camera configure", "/camera connect"])
async def test_a_node_that_dies_during_bring_up_comes_again_while_the_others_wait(
    tmp_path: Path, step: str
) -> None:
    viewer = planned_node("viewer", after={"camera": Condition.CONFIGURED}, supervision=ON_FAILURE)
    plan = plan_of(planned_node("camera", supervision=ON_FAILURE), viewer)
    world = SessionWorld(plan, tmp_path, stop_after_s=5.0)
    world.hosts.ways[step if step.startswith("/") else "camera start"] = "die"
    async with world.running("[backoff] camera"):
        world.hosts.ways.clear()
    assert "[restarted] camera (1)" in world.outline
    assert world.outline.count("viewer start") == 1
    assert world.outline.count("/viewer configure") == 1
    assert world.story[-1] == "[stopped] 0"


async def test_a_start_counts_towards_the_limit_also_where_another_s_failure_took_it_down(
    tmp_path: Path,
) -> None:
    twice = msgspec.structs.replace(ON_FAILURE, start_limit_burst=2, start_limit_interval_sec=3600)
    world = SessionWorld(_chain(DEPENDENTS, twice), tmp_path, stop_after_s=60.0)
    async with world.running("[system] active"):
        for times in (1, 2):  # more starts than the limit, and no failure of its own
            world.kill("camera")
            await world.story.until("[restarted] camera", times)
        world.kill("viewer")
    assert "[gave_up] viewer (1 failures)" in world.outline
    assert world.outline[-1] == "[stopped] 7"


async def test_a_node_that_fails_to_activate_is_restarted_and_what_is_active_stays_so(
    tmp_path: Path,
) -> None:
    world = SessionWorld(_chain(), tmp_path, stop_after_s=5.0)
    world.hosts.ways["/viewer activate"] = "die"
    async with world.running("[backoff]"):
        world.hosts.ways.clear()
    again = _back("viewer", 1.0)
    assert world.since("/viewer activate") == [
        "/viewer activate",
        "[failure] run.process-died /viewer, and the run goes on",
        "[backoff] viewer in 1.0 s",
        "[verdict] connected violated graph.missing-node /viewer",
        *again,
        "[restarted] viewer (1)",
        "[stopping] at 6.0 s: done",
        *DOWN,
        *over(0),
    ]


async def test_dependents_go_down_in_order_and_come_again_with_it(tmp_path: Path) -> None:
    how = msgspec.structs.replace(ON_FAILURE, on_failure=OnFailure.DEPENDENTS)
    world = SessionWorld(_chain(how, Supervision()), tmp_path, stop_after_s=5.0)
    async with world.running("[system] active"):
        world.kill("camera")
    assert world.since("[failure]") == [
        "[failure] run.process-died /camera, and the run goes on",
        "[backoff] camera in 1.0 s",
        "/viewer deactivate",
        *VIEWER_DOWN,
        f"[verdict] active violated {GONE}, {VIEWER_GONE}",
        *CONNECTED[:-1],
        "[system] connected at 1.0 s",
        "[verdict] connected ok",
        "[system] verified at 1.0 s",
        "networks programmed (ok)",
        *ACTIVATED[:-1],
        "[system] active at 1.0 s",
        "[restarted] camera (1)",
        "[stopping] at 5.0 s: done",
        *DOWN,
        *over(0),
    ]


async def test_what_fails_while_another_is_restarted_keeps_both_at_the_gate(
    tmp_path: Path,
) -> None:
    world = SessionWorld(_chain(), tmp_path, stop_after_s=10.0)
    world.hosts.takes_s["/camera configure"] = 2.0
    async with world.running("[system] active"):
        world.kill("camera")
        await world.story.until("/camera configure", 2)
        await asyncio.sleep(1.0)
        world.kill("viewer")
    assert world.since("[failure] run.process-died /viewer") == [
        "[failure] run.process-died /viewer, and the run goes on",
        "[backoff] viewer in 1.0 s",
        "/camera connect",
        "viewer start",
        "/viewer configure",
        "/viewer connect",
        "[system] connected at 5.0 s",
        "[verdict] connected ok",
        "[system] verified at 5.0 s",
        "networks programmed (ok)",
        "[gate] ok: /camera, /viewer",
        "/camera activate",
        "/viewer activate",
        "[system] active at 5.0 s",
        "[restarted] camera (1)",
        "[restarted] viewer (1)",
        "[stopping] at 12.0 s: done",
        *DOWN,
        *over(0),
    ]


async def test_a_restarted_node_waits_at_a_gate_that_stays_closed_and_passes_once_it_opens(
    tmp_path: Path,
) -> None:
    world = SessionWorld(_chain(), tmp_path, stop_after_s=10.0)
    async with world.running("[system] active"):
        world.intrude()
        world.kill("camera")
        await asyncio.sleep(5.0)
        world.retreat()
    assert world.since("[notice]")[:7] == [
        f"[notice] {REFUSED}",
        "[verdict] connected ok",
        "[system] verified at 5.0 s",
        "networks programmed (ok)",
        "[gate] ok: /camera",
        "/camera activate",
        "[system] active at 5.0 s",
    ]
    assert f"[verdict] connected violated {INTRUDED}" in world.outline


async def test_a_restarted_node_waits_for_one_that_is_away_and_orders_do_not(
    tmp_path: Path,
) -> None:
    plan = plan_of(planned_node("camera", supervision=ON_FAILURE), planned_node("viewer"))
    world = SessionWorld(plan, tmp_path)

    def hide() -> None:
        world.graph.unseen = {"/viewer"}
        world.graph.note()

    async with world.running("[system] active"):
        world.story.in_the_moment["networks programmed"] = hide
        world.kill("camera")
        await world.story.until("networks programmed", 2)
        await world.story.until("[notice]")
        with _within(0.1):
            assert await world.order(ControlRequest.PAUSE) == "0"
        world.graph.unseen.clear()
        world.graph.note()
        assert await world.order(ControlRequest.RESUME) == "0"
        assert await world.order(ControlRequest.DOWN) == "0"
    away = "graph.missing-node: there is no node /viewer in domain 30"
    assert world.since("networks programmed", 2)[1:8] == [
        "[verdict] connected violated graph.missing-node /viewer",
        f"[notice] cannot activate: {CHANGED}, and its verdict now is violated\n  {away}",
        "[restarted] camera (1)",
        "/viewer deactivate",
        "[system] paused at 6.0 s",
        "[verdict] connected ok",
        "[system] verified at 6.0 s",
    ]


async def test_orders_in_backoff_are_carried_out_at_once(tmp_path: Path) -> None:
    world = SessionWorld(_chain(), tmp_path)
    async with world.running("[system] active"):
        world.kill("camera")
        await world.story.until("[backoff]")
        assert await world.order(ControlRequest.PAUSE) == "0"
        assert world.story[-1] == "[system] paused at 0.0 s"
        await world.story.until("[restarted]")
        assert await world.order(ControlRequest.RESUME) == "0"
        world.kill("viewer")
        await world.story.until("[backoff] viewer")
        assert await world.order(ControlRequest.RESTART, "viewer") == "0"
        assert world.story[-1] == "[system] active at 1.0 s"
        world.kill("viewer")
        await world.story.until("[backoff] viewer", 2)
        assert await world.order(ControlRequest.DOWN) == "4"
    assert world.since("[system] paused")[:6] == [
        "[system] paused at 0.0 s",
        f"[verdict] connected violated {GONE}",
        "camera start",
        "/camera configure",
        "/camera connect",
        "[system] connected at 1.0 s",
    ]
    assert world.since("[stopping]") == [
        "[stopping] at 1.0 s: lifecycle down",
        "/camera deactivate",
        *CAMERA_DOWN,
        *over(4),
    ]


async def test_who_is_restarted_by_hand_in_its_backoff_takes_its_dependents_with_it(
    tmp_path: Path,
) -> None:
    """They wait for nothing else; its own gate would stay closed until their delay is over."""

    how = msgspec.structs.replace(ON_FAILURE, on_failure=OnFailure.DEPENDENTS)
    world = SessionWorld(_chain(how, Supervision()), tmp_path, stop_after_s=5.0)
    async with world.running("[system] active"):
        world.kill("camera")
        await world.story.until("[backoff] camera")
        assert await world.order(ControlRequest.RESTART, "camera") == "0"
        assert world.story[-1] == "[system] active at 0.0 s"
    assert world.story.count("viewer start") == 2


async def test_an_order_during_a_restart_waits_neither_for_its_step_nor_for_its_gate(
    tmp_path: Path,
) -> None:
    world = SessionWorld(_chain(), tmp_path, stop_after_s=10.0)
    async with world.running("[system] active"):
        world.intrude()
        world.hosts.takes_s["/camera configure"] = 2.0
        world.kill("camera")
        await world.story.until("/camera configure", 2)
        assert await world.order(ControlRequest.PAUSE) == "0"
        assert world.story[-1] == "[system] paused at 1.0 s"
        await world.story.until("[restarted] camera (1)")
    assert "[gate] ok: /camera" not in world.outline


@pytest.mark.parametrize(("restart", "code"), [(Restart.ON_FAILURE, 6), (Restart.ALWAYS, 0)])
async def test_a_clean_exit_is_started_again_after_only_by_always(
    tmp_path: Path, restart: Restart, code: int
) -> None:
    how = msgspec.structs.replace(ON_FAILURE, restart=restart)
    world = SessionWorld(_chain(how), tmp_path, stop_after_s=5.0)
    async with world.running("[system] active"):
        world.hosts.processes["camera"].end(ProcessExit(status=0))
    assert world.story[-1] == f"[stopped] {code}"


async def test_a_hang_is_ended_by_the_watchdog_and_one_that_passes_is_not(tmp_path: Path) -> None:
    world = SessionWorld(_chain(), tmp_path, stop_after_s=20.0)
    async with world.running("[system] active"):
        process = world.system.processes["camera"]
        for hangs_s in (2.0, 10.0):
            process.on_stop(True)
            await asyncio.sleep(hangs_s)
            process.on_stop(False)
    found = [
        each for each in world.story if each in ("camera SIGKILL", "[backoff] camera in 1.0 s")
    ]
    assert found == ["camera SIGKILL", "[backoff] camera in 1.0 s"]


async def test_status_says_what_failed_and_when_it_is_started_again(tmp_path: Path) -> None:
    world = SessionWorld(_chain(), tmp_path, stop_after_s=5.0)
    async with world.running("[system] active"):
        world.hosts.ways["/camera configure"] = "die"
        world.kill("camera")
        await world.story.until("[backoff]", 2)
        await asyncio.sleep(0.25)
        away, viewer = world.status().nodes
        assert (away.restarts, away.uptime_s, away.next_try_s) == (1, None, 0.75)
        assert away.process_state is not None
        assert (away.process_state.value, away.state) == ("backoff", "")
        assert away.last_failure is not None
        assert away.last_failure.signal == "SIGSEGV"
        assert away.last_failure.stderr == ""
        assert viewer.uptime_s == pytest.approx(1.25, abs=0.01)
        assert (viewer.restarts, viewer.last_failure) == (0, None)
        world.hosts.ways.clear()


async def test_a_death_is_reported_at_once_also_while_another_process_is_taken_down(
    tmp_path: Path,
) -> None:
    plan = plan_of(
        planned_node("camera", supervision=DEPENDENTS),
        planned_node("viewer", supervision=ON_FAILURE, after={"camera": Condition.STARTED}),
        planned_node("other", supervision=ON_FAILURE),
    )
    world = SessionWorld(plan, tmp_path, stop_after_s=20.0)
    async with world.running("[system] active"):
        world.hosts.takes_s["/viewer deactivate"] = 2.0
        world.kill("camera")
        await world.story.until("/viewer deactivate")
        await asyncio.sleep(0.5)
        world.kill("other")
        with _within(0.1):
            await world.story.until("[failure] run.process-died /other")
        await world.story.until("[restarted] other")
    assert sum(each.startswith("[failure]") for each in world.outline) == 2
    assert world.story[-1] == "[stopped] 0"


@pytest.mark.parametrize(
    ("asked", "node"), [(ControlRequest.RESTART, "viewer"), (ControlRequest.RESUME, "")]
)
async def test_an_order_does_not_keep_others_from_coming_again_that_its_gate_waits_for(
    tmp_path: Path, asked: ControlRequest, node: str
) -> None:
    world = SessionWorld(_chain(), tmp_path, stop_after_s=30.0)
    async with world.running("[system] active"):
        if asked is ControlRequest.RESUME:
            assert await world.order(ControlRequest.PAUSE) == "0"
        world.kill("camera")
        await world.story.until("[backoff] camera in 1.0 s")
        with _within(2.0):
            assert await world.order(asked, node) == "0"
        assert _is_active(world)
        await world.story.until("[restarted] camera (1)")


async def test_what_becomes_wrong_while_another_node_is_restarted_is_found_within_a_second(
    tmp_path: Path,
) -> None:
    world = SessionWorld(PAIR, tmp_path, stop_after_s=30.0)
    async with world.running("[system] active"):
        world.hosts.takes_s["/camera configure"] = 5.0
        world.kill("camera")
        await world.story.until("/camera configure", 2)
        await asyncio.sleep(1.0)
        world.intrude()
        with _within(1.0):
            await world.story.until(f"[verdict] connected violated {INTRUDED}")
        world.retreat()
        await world.story.until("[restarted] camera (1)")
    assert "state.wrong-state" not in " ".join(world.outline)


async def test_a_resume_that_a_death_cuts_short_leaves_the_system_paused_and_open_to_orders(
    tmp_path: Path,
) -> None:
    world = SessionWorld(_chain(), tmp_path, stop_after_s=30.0)
    async with world.running("[system] active"):
        assert await world.order(ControlRequest.PAUSE) == "0"
        world.intrude()
        resuming = asyncio.ensure_future(world.order(ControlRequest.RESUME))
        await world.story.until(f"[verdict] connected violated {INTRUDED}")
        world.kill("viewer")
        with _within(0.1):  # no step of its was under way: nobody else knows more about its death
            assert (await resuming).startswith("6 cannot keep '/viewer' running")
        await world.story.until("[restarted] viewer (1)")
        assert world.status().phase == "paused"
        world.retreat()
        assert await world.order(ControlRequest.RESUME) == "0"
        assert world.status().phase == "active"


@pytest.mark.parametrize(
    ("ask", "node", "step", "dies"),
    [
        (ControlRequest.RESTART, "", "/camera configure", "camera"),
        (ControlRequest.RESTART, "camera", "/camera configure", "camera"),
        (ControlRequest.RESUME, "", "/camera activate", "viewer"),  # behind its gate
    ],
)
async def test_an_order_that_a_death_cuts_short_is_finished_once_all_are_back(
    tmp_path: Path, ask: ControlRequest, node: str, step: str, dies: str
) -> None:
    plan = PAIR if ask is ControlRequest.RESTART else _chain()
    world = SessionWorld(plan, tmp_path, stop_after_s=30.0)
    async with world.running("[system] active"):
        if ask is ControlRequest.RESUME:
            assert await world.order(ControlRequest.PAUSE) == "0"
        world.hosts.takes_s[step] = 2.0
        ordered = asyncio.ensure_future(world.order(ask, node))
        await world.story.until(step, 2)
        await asyncio.sleep(0.5)
        world.kill(dies)
        assert (await ordered).startswith(f"6 cannot keep '/{dies}' running")
        await world.story.until(f"[restarted] {dies} (1)")
        assert _is_active(world)
