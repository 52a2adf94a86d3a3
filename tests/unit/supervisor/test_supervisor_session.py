"""Whole runs of the supervisor: what it does in which order, how it ends, and what it reports.

Each test prepares a world, lets a session run in it from its first process to its last, and
compares the outline. What must hold in every run (the gate, nothing left, a report) is checked by
`SessionWorld.run` each time; what is decided in it is told story by story in `core/`.
"""

from __future__ import annotations

import asyncio
import signal
from pathlib import Path
from typing import Any

import pytest

from lifecycle.manifest.model import Condition, Restart, RunKind, Supervision, Timeouts
from lifecycle.plan.model import PlannedNode
from tests.builders import plan_of, planned_node
from tests.unit.supervisor.session_world import (
    ACTIVATED,
    ATTACHED,
    BACK,
    CAMERA_DOWN,
    CHAIN,
    CHANGED,
    CONNECTED,
    DIALLING,
    DOWN,
    INTRUDED,
    KILLED,
    OPENED,
    VERIFIED,
    VIEWER_DOWN,
    SessionWorld,
    over,
)

ENDING = 1 + len(DOWN) + len(over(0))
"""Lines of an outline from "[stopping]" on, of what was active."""

OVER = "the 30 s of the bring-up are over (--timeout)"


def world_of(tmp_path: Path, *nodes: PlannedNode, **options: Any) -> SessionWorld:
    """Return a world of these nodes, which ends once it is active."""
    return SessionWorld(plan_of(*nodes), tmp_path, **{"stop_after_s": 0.0, **options})


# Bring-up


async def test_a_system_is_brought_up_along_its_order_held_and_taken_down_in_reverse(
    tmp_path: Path,
) -> None:
    arm = planned_node("arm", after={"base": Condition.CONNECTED})
    world = world_of(tmp_path, arm, planned_node("base"), stop_after_s=10.0)
    for what in ("base start", "/base configure", "/base activate"):
        world.hosts.takes_s[what] = 1.0
    await world.run()
    assert world.outline == [
        *("arm start", "base start", "/arm configure", "/base configure"),
        *("/base connect", "/arm connect", "[system] connected at 2.0 s"),
        *("[verdict] connected ok", "[system] verified at 2.0 s", "networks programmed (ok)"),
        *("[gate] ok: /arm, /base", "/arm activate", "/base activate"),
        *("[system] active at 3.0 s", "[stopping] at 13.0 s: done", "/arm deactivate"),
        *("/arm disconnect", "/arm cleanup", "/arm shutdown", "/base deactivate"),
        *("/base disconnect", "/base cleanup", "/base shutdown", *over(0)),
    ]
    assert world.report == "ended after it was active, exit code 0: done"
    assert [line for line in world.story if line.startswith(("[process]", "[node] /arm"))] == [
        *("[process] arm starting", "[process] base starting", "[process] arm running"),
        *("[node] /arm started (unconfigured)", "[node] /arm started (inactive)"),
        *("[node] /arm configured (inactive)", "[process] base running"),
        *("[node] /arm configured (inactive)", "[node] /arm connected (inactive)"),
        *("[node] /arm connected (active)", "[node] /arm active (active)"),
        *("[node] /arm active (inactive)", "[node] /arm connected (inactive)"),
        *("[node] /arm connected (inactive)", "[node] /arm configured (inactive)"),
        *("[node] /arm configured (unconfigured)", "[node] /arm started (unconfigured)"),
        *("[node] /arm started (finalized)", "[node] /arm stopped (finalized)"),
        *("[process] arm stopping", "[process] arm exited (exit status 0)"),
        *("[process] base stopping", "[process] base exited (exit status 0)"),
    ]


FAILED, DIED = "run.transition-failed", "run.process-died"
DEATH = "cannot keep '/viewer' running: pid 5000002 died while {}: killed by SIGSEGV"


@pytest.mark.parametrize(
    ("step", "way", "failure", "message"),
    [
        ("configure", "no lens", FAILED, "cannot configure '/viewer': no lens"),
        ("connect", "no display", FAILED, "cannot connect '/viewer': no display"),
        ("connect", "die", DIED, DEATH.format("connecting")),
        (
            "connect",
            "hang",
            "run.deadline",
            "cannot bring up '/viewer': it was still connecting after 4 s",
        ),
        ("activate", "no light", FAILED, "cannot activate '/viewer': no light"),
        ("activate", "die", DIED, DEATH.format("activating")),
    ],
)
async def test_a_node_in_which_a_step_fails_has_everything_rolled_back(
    tmp_path: Path, step: str, way: str, failure: str, message: str
) -> None:
    viewer = planned_node(
        "viewer", after={"camera": Condition.ACTIVE}, timeouts=Timeouts(connect_s=4.0)
    )
    world = world_of(tmp_path, planned_node("camera"), viewer)
    world.hosts.ways[f"/viewer {step}"] = way
    await world.run()
    was_active = step == "activate"
    alive = way not in ("die", "hang")
    left = ("activate", "connect", "configure").index(step)
    assert world.since("[failure]") == [
        f"[failure] {failure} /viewer",
        f"[stopping] at {4.5 if way == 'hang' else 0.0:.1f} s: rolling back",
        *(VIEWER_DOWN[left:] if alive else []),
        *(["/camera deactivate"] if was_active else []),
        *CAMERA_DOWN,
        *over(6),
    ]
    place = "when verified, before it was active" if was_active else "before it was connected"
    assert world.report == f"ended {place}, exit code 6: failed: /viewer ({failure})"
    assert world.messages == [message]


@pytest.mark.parametrize(("starves", "after_s"), [(0.0, 2.0), (0.5, 4.0), (3.0, 20.0)])
async def test_a_start_that_hangs_is_noticed_and_time_without_a_processor_does_not_count(
    tmp_path: Path, starves: float, after_s: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    ours = "lifecycle.supervisor.nodes.system.run_delay_s"  # which is real, where time jumps
    monkeypatch.setattr(ours, lambda: 0.0)
    world = world_of(tmp_path, planned_node("a", timeouts=Timeouts(start_s=2.0)))
    world.hosts.ways["a start"] = "hang"
    world.hosts.starves["a"] = starves  # as many of its threads, all the time
    async with world.running("[failure]"):
        took_s = asyncio.get_running_loop().time()
    assert "was still starting after 2 s" in world.messages[0]
    assert took_s == pytest.approx(after_s, abs=1.0)


# The gate


def waits(most_s: int, what: str = "/viewer (graph.missing-node)") -> str:
    """What is said of a gate that is not open after 2 s."""
    return f"[notice] waits up to {most_s} s more for its gate: {what}"


async def test_nothing_is_activated_before_the_verdict_is_ok(tmp_path: Path) -> None:
    world = SessionWorld(CHAIN, tmp_path, stop_after_s=0.0)
    world.hide("/viewer")
    async with world.running("[system] connected"):
        await asyncio.sleep(7.0)
        world.hide()
    assert world.since("[system] connected")[1:6] == [
        "[verdict] connected violated graph.missing-node /viewer",
        waits(28),
        "[verdict] connected ok",
        "[system] verified at 7.0 s",
        "networks programmed (ok)",
    ]


async def test_a_violated_verdict_rolls_everything_back(tmp_path: Path) -> None:
    world = SessionWorld(CHAIN, tmp_path, stop_after_s=10.0)
    world.intrude()
    await world.run()
    assert world.outline == [
        *CONNECTED,
        f"[verdict] connected violated {INTRUDED}",
        "[stopping] at 0.5 s: the verdict keeps the gate closed",
        *BACK,
        *over(4),
    ]
    assert world.report == (
        "ended when connected, before it was verified, exit code 4: "
        "the verdict keeps the gate closed; /intruder (graph.undeclared-node)"
    )


async def test_a_node_that_does_not_appear_is_waited_for_as_long_as_there_is_time_and_then_named(
    tmp_path: Path,
) -> None:
    world = SessionWorld(CHAIN, tmp_path, timeout_s=8.0)
    world.hosts.takes_s["/camera configure"] = 3.0
    world.hide("/viewer")
    await world.run()
    assert world.since("[system] connected")[2:] == [
        waits(3),
        f"[stopping] at 8.0 s: the verdict keeps the gate closed, and {OVER.replace('30', '8')}",
        *BACK,
        *over(4),
    ]
    assert world.messages == ["there is no node /viewer in domain 30"]


@pytest.mark.parametrize("strict", [False, True])
async def test_what_cannot_be_verified_is_taken_on_trust_by_name_or_refused_if_strict(
    tmp_path: Path, strict: bool
) -> None:
    world = SessionWorld(ATTACHED, tmp_path, stop_after_s=0.0, strict=strict)
    world.graph.mute = {"/base"}
    await world.run()
    judged = world.since("[system] connected")[1:]
    assert judged[0] == "[verdict] connected unverifiable state.wrong-state /base"
    if strict:
        assert judged[1:] == [
            waits(28, "/base (state.wrong-state)"),
            "[stopping] at 3.5 s: the verdict keeps the gate closed",
            "/base cleanup",
            *CAMERA_DOWN,
            *over(5),
        ]
        assert "gate closed; /base (state.wrong-state)" in world.report
    else:
        assert judged[2:6] == [
            "networks programmed (unverifiable)",
            "[gate] unverifiable: /camera, /base",
            "/camera activate",
            "/base activate",
        ]
        assert world.report.endswith("done; taken on trust: /base (state.wrong-state)")


@pytest.mark.parametrize(
    ("noticed", "before", "why"),
    [(False, VERIFIED, CHANGED), (True, VERIFIED[:1], "the verdict keeps the gate closed")],
)
async def test_what_changes_while_it_is_looked_at_has_the_verdict_judged_again(
    tmp_path: Path, noticed: bool, before: list[str], why: str
) -> None:
    world = SessionWorld(CHAIN, tmp_path)

    def comes() -> None:
        world.intrude()
        if noticed:
            world.supervisor.catch_up()

    world.story.in_the_moment["[system] connected"] = lambda: setattr(
        world.graph, "while_looking", comes
    )
    await world.run()
    assert world.since("[verdict]")[: len(before) + 2] == [
        *before,
        f"[verdict] connected violated {INTRUDED}",
        f"[stopping] at 0.5 s: {why}",
    ]


async def test_what_changes_in_the_moment_in_which_a_request_leaves_keeps_it_back(
    tmp_path: Path,
) -> None:
    world = SessionWorld(CHAIN, tmp_path)
    world.story.in_the_moment["[request] /viewer activate"] = world.intrude
    await world.run()
    assert world.since("[gate]")[:4] == [
        OPENED,
        "/camera activate",
        f"[verdict] connected violated {INTRUDED}",
        f"[stopping] at 0.5 s: {CHANGED}",
    ]


async def test_what_changes_before_a_request_to_a_foreign_node_leaves_keeps_it_back(
    tmp_path: Path,
) -> None:
    """It may be long until a service is matched: the verdict of before is not worth it then."""
    world = SessionWorld(ATTACHED, tmp_path)
    world.hosts.takes_s["/base activate"] = 2.0
    async with world.running("[request] /base activate"):
        await asyncio.sleep(1.0)
        world.intrude()
    assert world.since("[gate]") == [
        "[gate] ok: /camera, /base",
        "/camera activate",
        f"[verdict] connected violated {INTRUDED}",
        f"[stopping] at 1.5 s: {CHANGED}",
        *("/base cleanup", "/camera deactivate", *CAMERA_DOWN, *over(4)),
    ]


async def test_a_foreign_node_is_not_blamed_for_the_time_in_which_its_request_is_kept_back(
    tmp_path: Path,
) -> None:
    base = planned_node("base", kind=RunKind.ATTACH, timeouts=Timeouts(activate_s=3.0))
    world = world_of(tmp_path, planned_node("camera"), base)
    world.hosts.takes_s["/base activate"] = 1.0
    world.story.in_the_moment["/camera activate"] = lambda: world.hide("/camera")
    await world.run()
    assert world.since("[gate]")[:2] == ["[gate] ok: /camera, /base", "/camera activate"]
    # When is a matter of the load of this machine, see `wait_under_load`.
    ends = [each for each in world.outline if each.startswith(("[stopping]", "[failure]"))]
    assert [each.partition(" s: ")[2] for each in ends] == [f"{CHANGED}, and {OVER}"]
    assert "/base activate" not in world.outline


async def test_nodes_that_are_activated_side_by_side_are_not_judged_one_by_one(
    tmp_path: Path,
) -> None:
    nodes = (planned_node(f"n{index}", process=f"p{index // 2}") for index in range(20))
    world = world_of(tmp_path, *nodes)
    opened: list[int] = []
    world.story.in_the_moment["[gate]"] = lambda: opened.append(world.graph.looks)
    await world.run()
    assert world.outline[-1] == "[stopped] 0"
    assert world.graph.looks - opened[0] <= 4


async def test_networks_that_cannot_be_programmed_keep_the_gate_closed(tmp_path: Path) -> None:
    world = SessionWorld(CHAIN, tmp_path)
    world.hosts.ways["networks programmed"] = "cannot program networks for 'robot': no"
    await world.run()
    failed = ["[failure] run.not-programmed robot", "[stopping] at 0.0 s: rolling back"]
    assert world.since("networks programmed")[1:] == [*failed, *BACK, *over(6)]
    assert world.messages == ["cannot program networks for 'robot': no"]


# Started again before the gate


def started_again(attempt: int) -> list[str]:
    """What is reported when `viewer` is not discovered by TCP, and what is done."""
    why = "not discovered over TCP for 5 s (/viewer (graph.missing-node))"
    return [
        f"[notice] '/viewer' is started again on a fresh port: {why}; try {attempt} of 3",
        *VIEWER_DOWN,
        *("viewer start", "/viewer configure", "/viewer connect"),
    ]


async def test_a_node_that_is_not_discovered_over_tcp_is_started_again_on_a_fresh_port(
    tmp_path: Path,
) -> None:
    world = SessionWorld(DIALLING, tmp_path, stop_after_s=0.0)
    world.hide("/viewer")
    async with world.running("viewer start", 2):
        world.graph.unseen = set()
    assert world.since("[verdict]")[1:-ENDING] == [
        waits(28),
        *started_again(1),
        "[verdict] connected ok",
        "[system] verified at 5.0 s",
        "networks programmed (ok)",
        *ACTIVATED[:-1],
        "[system] active at 5.0 s",
    ]
    camera, viewer = world.system.plan.nodes
    assert camera.connections.urls == ("tcpv4://127.0.0.1:7911",)
    (url,) = viewer.connections.urls
    assert url.endswith("?peer=127.0.0.1:7911")
    assert url not in DIALLING.nodes[1].connections.urls


async def test_a_node_that_is_never_discovered_is_started_three_times_and_then_waited_for(
    tmp_path: Path,
) -> None:
    world = SessionWorld(DIALLING, tmp_path)
    world.hide("/viewer")
    await world.run()
    again = [line for attempt in (1, 2, 3) for line in started_again(attempt)]
    assert world.since("[verdict]")[1:] == [
        waits(28),
        *again,
        f"[stopping] at 30.0 s: the verdict keeps the gate closed, and {OVER}",
        *BACK,
        *over(4),
    ]


async def test_a_node_that_would_get_no_other_port_is_waited_for(tmp_path: Path) -> None:
    world = SessionWorld(DIALLING, tmp_path, stop_after_s=0.0)
    world.hide("/camera")
    async with world.running("[system] connected"):
        await asyncio.sleep(12.0)
        world.hide()
    missing = "/camera (graph.missing-node)"
    assert world.since("[verdict]")[1:3] == [waits(28, missing), "[verdict] connected ok"]


# Restarts


AGAIN = Supervision(restart=Restart.ON_FAILURE, restart_sec=1.0)
PAIR = plan_of(
    planned_node("camera", supervision=AGAIN),
    planned_node("viewer", supervision=AGAIN, after={"camera": Condition.ACTIVE}),
)


async def test_a_node_that_crashed_comes_again_through_its_gate_and_the_others_are_not_touched(
    tmp_path: Path,
) -> None:
    world = SessionWorld(PAIR, tmp_path, stop_after_s=10.0)
    async with world.running("[system] active"):
        await asyncio.sleep(3.0)
        world.kill("camera")
    assert world.since("[system] active")[1:] == [
        "[failure] run.process-died /camera, and the run goes on",
        "[backoff] camera in 1.0 s",
        "[verdict] active violated graph.missing-node /camera",
        *("camera start", "/camera configure", "/camera connect"),
        *("[verdict] connected ok", "[system] verified at 4.0 s"),
        *("networks programmed (ok)", "[gate] ok: /camera", "/camera activate"),
        *("[system] active at 4.0 s", "[restarted] camera (1)", "[stopping] at 10.0 s: done"),
        *(*DOWN, *over(0)),
    ]
    assert world.report.endswith("exit code 0: done; restarted: 'camera' 1 time")


async def test_status_says_what_failed_and_when_it_is_started_again(tmp_path: Path) -> None:
    world = SessionWorld(PAIR, tmp_path, stop_after_s=5.0)
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
        assert (away.last_failure.signal, away.last_failure.stderr) == ("SIGSEGV", "")
        assert viewer.uptime_s == pytest.approx(1.25, abs=0.01)
        assert (viewer.restarts, viewer.last_failure) == (0, None)
        world.hosts.ways.clear()


async def test_a_node_that_hangs_is_not_asked_and_is_ended_by_its_watchdog_unless_that_passes(
    tmp_path: Path,
) -> None:
    world = SessionWorld(PAIR, tmp_path, stop_after_s=20.0)
    async with world.running("[system] active"):
        process = world.system.processes["camera"]
        for hangs_s in (2.0, 10.0):
            process.on_stop(True)
            await world.story.until("[verdict] active violated run.silent-node /camera")
            assert world.graph.asked == ["viewer"]
            await asyncio.sleep(hangs_s)
            process.on_stop(False)
    ends = ("camera SIGKILL", "[backoff] camera in 1.0 s")
    assert [each for each in world.story if each in ends] == [*ends]


# Signals


@pytest.mark.parametrize(
    ("number", "why", "cut_short", "active"),
    [
        (signal.SIGINT, "interrupted", 130, 130),
        (signal.SIGTERM, "terminated", 143, 0),
        (signal.SIGHUP, "the terminal was closed", 129, 0),
    ],
)
@pytest.mark.parametrize(
    ("stage", "ended", "waits", "down"),
    [
        (
            "/camera configure",
            "before it was connected",
            "; /camera is still configuring",
            [*VIEWER_DOWN, *KILLED],
        ),
        (
            "[verdict]",
            "when connected, before it was verified",
            "; /viewer (graph.missing-node)",
            BACK,
        ),
        ("networks programmed", "when verified, before it was active", "", BACK),
        (
            "/camera activate",
            "when verified, before it was active",
            "; /camera is still activating; /viewer waits to activate until /camera is active",
            [*VIEWER_DOWN, *KILLED],
        ),
        ("[system] active", "after it was active", "", DOWN),
    ],
)
async def test_a_signal_ends_the_run_at_every_stage_and_says_what_was_waited_for(
    tmp_path: Path,
    number: int,
    why: str,
    cut_short: int,
    active: int,
    stage: str,
    ended: str,
    waits: str,
    down: list[str],
) -> None:
    world = SessionWorld(CHAIN, tmp_path)
    world.hosts.takes_s[stage] = 5.0
    if stage == "[verdict]":
        world.hide("/viewer")
    async with world.running(stage):
        await asyncio.sleep(1.0)
        signal.raise_signal(number)
    exit_code = active if down is DOWN else cut_short
    assert world.since("[stopping]") == [f"[stopping] at 1.0 s: {why}", *down, *over(exit_code)]
    assert world.report == f"ended {ended}, exit code {exit_code}: {why}{waits}"


async def test_a_signal_that_came_before_the_session_ends_it_at_once(tmp_path: Path) -> None:
    world = SessionWorld(CHAIN, tmp_path)
    with world.ending, world.ending.noted():
        signal.raise_signal(signal.SIGTERM)
    await world.run()
    assert "/camera configure" not in world.story
    assert world.report == (
        "ended before it was connected, exit code 143: "
        "terminated; /camera is still starting; /viewer is still starting"
    )


async def test_a_second_interrupt_ends_what_is_left_at_once(tmp_path: Path) -> None:
    world = SessionWorld(CHAIN, tmp_path, stop_after_s=0.0)
    world.hosts.takes_s["/viewer deactivate"] = 4.0
    async with world.running("/viewer deactivate"):
        await asyncio.sleep(1.0)
        signal.raise_signal(signal.SIGINT)
    killed = ["/viewer deactivate", "camera SIGKILL", "viewer SIGKILL", *over(130)]
    assert world.since("[stopping]")[1:] == killed
    assert world.report.endswith("code 130: done; interrupted while it was taken down")


# Taking down


async def test_nodes_and_processes_that_resist_are_ended_within_limits(tmp_path: Path) -> None:
    world = SessionWorld(CHAIN, tmp_path, stop_after_s=0.0)
    world.hosts.ways["/viewer deactivate"] = "hang"
    world.hosts.ends_at = {"viewer": signal.SIGRTMAX, "camera": signal.SIGTERM}
    await world.run()
    assert world.since("[stopping]") == [
        "[stopping] at 0.0 s: done",
        "/viewer deactivate",
        "[notice] cannot deactivate '/viewer' within 5 s; its process is ended all the same",
        "/camera deactivate",
        *CAMERA_DOWN,
        *("viewer SIGTERM", "viewer SIGKILL"),
        "[notice] process 'viewer' had to be ended with SIGKILL",
        *("camera SIGINT", "camera SIGTERM"),
        "[notice] process 'camera' had to be ended with SIGTERM",
        *over(0),
    ]
