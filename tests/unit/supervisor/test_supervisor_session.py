"""Whole runs of the supervisor: what it does in which order, how it ends, and what it reports.

Each test prepares a world, lets a session run in it from its first process to its last, and
compares the whole outline. What must hold in every run (the gate, nothing left, a report) is
checked by `SessionWorld.run` each time.
"""

from __future__ import annotations

import asyncio
import signal
from collections.abc import Callable
from pathlib import Path

import pytest

from lifecycle.manifest.model import Condition, RunKind, Timeouts
from lifecycle.supervisor.control.protocol import ControlRequest
from lifecycle.supervisor.run.options import Until
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
    REFUSED,
    VERIFIED,
    VIEWER_DOWN,
    SessionWorld,
    over,
)

ENDING = 1 + len(DOWN) + len(over(0))
"""Lines of an outline from "[stopping]" on, of what was active."""


def time_over(timeout_s: int) -> str:
    """Return what names the time of a bring-up that is over."""
    return f"the {timeout_s} s of the bring-up are over (--timeout)"


# Bring-up


async def test_a_system_is_brought_up_along_its_order_held_and_taken_down_in_reverse(
    tmp_path: Path,
) -> None:
    plan = plan_of(planned_node("arm", after={"base": Condition.CONNECTED}), planned_node("base"))
    world = SessionWorld(plan, tmp_path, stop_after_s=10.0)
    world.hosts.takes_s["base start"] = 1.0
    world.hosts.takes_s["/base configure"] = 1.0
    world.hosts.takes_s["/base activate"] = 1.0
    await world.run()
    assert world.story == [
        "[process] arm starting",
        "[process] base starting",
        "arm start",
        "base start",
        "[process] arm running",
        "[node] /arm started (unconfigured)",
        "[request] /arm configure",
        "/arm configure",
        "[node] /arm started (inactive)",
        "[node] /arm configured (inactive)",
        "[process] base running",
        "[node] /base started (unconfigured)",
        "[request] /base configure",
        "/base configure",
        "[node] /base started (inactive)",
        "[node] /base configured (inactive)",
        "[request] /base connect",
        "/base connect",
        "[node] /base configured (inactive)",
        "[node] /base connected (inactive)",
        "[request] /arm connect",
        "/arm connect",
        "[node] /arm configured (inactive)",
        "[node] /arm connected (inactive)",
        "[system] connected at 2.0 s",
        "[joined] /arm",
        "[joined] /base",
        "[verdict] connected ok",
        "[system] verified at 2.0 s",
        "networks programmed (ok)",
        "[gate] ok: /arm, /base",
        "[request] /arm activate",
        "[request] /base activate",
        "/arm activate",
        "/base activate",
        "[node] /arm connected (active)",
        "[node] /arm active (active)",
        "[node] /base connected (active)",
        "[node] /base active (active)",
        "[system] active at 3.0 s",
        "[stopping] at 13.0 s: done",
        "[request] /arm deactivate",
        "/arm deactivate",
        "[node] /arm active (inactive)",
        "[node] /arm connected (inactive)",
        "[request] /arm disconnect",
        "/arm disconnect",
        "[node] /arm connected (inactive)",
        "[node] /arm configured (inactive)",
        "[request] /arm cleanup",
        "/arm cleanup",
        "[node] /arm configured (unconfigured)",
        "[node] /arm started (unconfigured)",
        "[request] /arm shutdown",
        "/arm shutdown",
        "[node] /arm started (finalized)",
        "[node] /arm stopped (finalized)",
        "[process] arm stopping",
        "[request] /base deactivate",
        "/base deactivate",
        "[process] arm exited (exit status 0)",
        "[node] /base active (inactive)",
        "[node] /base connected (inactive)",
        "[request] /base disconnect",
        "/base disconnect",
        "[node] /base connected (inactive)",
        "[node] /base configured (inactive)",
        "[request] /base cleanup",
        "/base cleanup",
        "[node] /base configured (unconfigured)",
        "[node] /base started (unconfigured)",
        "[request] /base shutdown",
        "/base shutdown",
        "[node] /base started (finalized)",
        "[node] /base stopped (finalized)",
        "[process] base stopping",
        "[process] base exited (exit status 0)",
        "networks restored",
        "[stopped] 0",
    ]
    assert world.report == "ended after it was active, exit code 0: done"


@pytest.mark.parametrize(
    ("until", "outline", "report"),
    [
        (
            Until.CONNECTED,
            [*CONNECTED, "[verdict] connected ok"],
            "ended when connected, before it was verified, exit code 0: done",
        ),
        (
            Until.VERIFIED,
            [*CONNECTED, *VERIFIED[:2]],
            "ended when verified, before it was active, exit code 0: done",
        ),
    ],
)
async def test_a_system_that_is_not_to_be_active_gets_no_activate_request(
    tmp_path: Path, until: Until, outline: list[str], report: str
) -> None:
    world = SessionWorld(CHAIN, tmp_path, until=until)
    await world.run()
    assert world.outline == [*outline, "[stopping] at 0.0 s: done", *BACK, *over(0)]
    assert world.report == report


@pytest.mark.parametrize(
    ("way", "failure", "message"),
    [
        (
            "no display",
            "run.transition-failed",
            "cannot connect '/viewer': no display",
        ),
        (
            "die",
            "run.process-died",
            "cannot keep '/viewer' running: pid 5000002 died while connecting: killed by SIGSEGV",
        ),
        (
            "hang",
            "run.deadline",
            "cannot bring up '/viewer': it was still connecting after 4 s",
        ),
    ],
)
async def test_a_node_that_cannot_be_connected_ends_the_run_and_nothing_is_judged_or_activated(
    tmp_path: Path, way: str, failure: str, message: str
) -> None:
    limits = Timeouts(connect_s=4.0)
    after = {"camera": Condition.CONNECTED}
    plan = plan_of(planned_node("camera"), planned_node("viewer", after=after, timeouts=limits))
    world = SessionWorld(plan, tmp_path, stop_after_s=10.0)
    world.hosts.ways["/viewer connect"] = way
    await world.run()
    ended_s = {"hang": 4.5}.get(way, 0.0)
    assert world.since("[failure]") == [
        f"[failure] {failure} /viewer",
        f"[stopping] at {ended_s:.1f} s: rolling back",
        *(VIEWER_DOWN[1:] if way == "no display" else []),
        *CAMERA_DOWN,
        *over(6),
    ]
    assert world.report == (
        f"ended before it was connected, exit code 6: failed: /viewer ({failure})"
    )
    assert world.messages == [message]


async def test_a_process_that_dies_while_its_node_waits_for_another_is_noticed_at_once(
    tmp_path: Path,
) -> None:
    plan = plan_of(
        planned_node("camera"), planned_node("viewer", after={"camera": Condition.CONFIGURED})
    )
    world = SessionWorld(plan, tmp_path)
    world.hosts.takes_s["/camera configure"] = 20.0
    async with world.running("[process] viewer running"):
        await asyncio.sleep(1.0)
        world.kill("viewer")
    assert world.since("[failure]")[:2] == [
        "[failure] run.process-died /viewer",
        "[stopping] at 1.5 s: rolling back",
    ]
    assert world.messages == [
        (
            "cannot keep '/viewer' running: pid 5000002 died while waits to configure until "
            "/camera is configured: killed by SIGSEGV"
        )
    ]


async def test_a_bring_up_that_takes_too_long_names_what_is_missing(tmp_path: Path) -> None:
    plan = plan_of(
        planned_node("camera", timeouts=Timeouts(configure_s=60.0)),
        planned_node("viewer", after={"camera": Condition.CONFIGURED}),
    )
    world = SessionWorld(plan, tmp_path, timeout_s=20.0)
    world.hosts.takes_s["/camera configure"] = 60.0
    await world.run()
    assert world.since("[failure]")[:2] == [
        "[failure] run.deadline /camera",
        "[stopping] at 20.0 s: rolling back",
    ]
    assert world.report == (
        "ended before it was connected, exit code 6: failed: /camera (run.deadline)"
    )
    assert world.messages == [
        (
            "cannot bring up 'robot' within 20 s: /camera is still configuring; "
            "/viewer waits to configure until /camera is configured"
        )
    ]


# The gate


def waits(most_s: int, what: str = "missing: /viewer (node)") -> str:
    """What is said of a gate that is not open after 2 s."""
    return f"[notice] waits up to {most_s} s more for its gate: {what}"


async def test_nothing_is_activated_before_the_verdict_is_ok(tmp_path: Path) -> None:
    world = SessionWorld(CHAIN, tmp_path, stop_after_s=0.0)
    world.graph.unseen = {"/viewer"}
    async with world.running("[system] connected"):
        await asyncio.sleep(7.0)
        world.graph.unseen.clear()
        world.graph.note()
    assert world.since("[system] connected")[1:6] == [
        "[verdict] connected violated graph.missing-node /viewer",
        waits(28),
        "[verdict] connected ok",
        "[system] verified at 7.0 s",
        "networks programmed (ok)",
    ]
    assert world.report == "ended after it was active, exit code 0: done"


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
        "the verdict keeps the gate closed; wrong: /intruder (graph.undeclared-node)"
    )


async def test_a_node_that_does_not_appear_is_waited_for_as_long_as_there_is_time_and_then_named(
    tmp_path: Path,
) -> None:
    world = SessionWorld(CHAIN, tmp_path, timeout_s=8.0)
    world.hosts.takes_s["/camera configure"] = 3.0
    world.graph.unseen = {"/viewer"}
    await world.run()
    assert world.since("[system] connected")[1:] == [
        "[verdict] connected violated graph.missing-node /viewer",
        waits(3),
        f"[stopping] at 8.0 s: the verdict keeps the gate closed, and {time_over(8)}",
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
    assert judged[0] == "[verdict] connected unverifiable state.unverifiable /base"
    if strict:
        assert judged[1:] == [
            waits(28, "unknown: /base (state.unverifiable)"),
            "[stopping] at 3.5 s: the verdict keeps the gate closed",
            "/base cleanup",
            *CAMERA_DOWN,
            *over(5),
        ]
        assert world.report == (
            "ended when connected, before it was verified, exit code 5: the verdict keeps the "
            "gate closed; unknown: /base (state.unverifiable)"
        )
    else:
        assert judged[1:6] == [
            "[system] verified at 0.0 s",
            "networks programmed (unverifiable)",
            "[gate] unverifiable: /camera, /base",
            "/camera activate",
            "/base activate",
        ]
        assert world.report == (
            "ended after it was active, exit code 0: done; "
            "taken on trust: /base (state.unverifiable)"
        )


async def test_what_changes_while_networks_are_programmed_keeps_the_gate_closed(
    tmp_path: Path,
) -> None:
    world = SessionWorld(CHAIN, tmp_path)
    world.networks.takes_s = 3.0
    async with world.running("networks programmed"):
        await asyncio.sleep(1.0)
        world.intrude()
    assert world.since("networks programmed") == [
        "networks programmed (ok)",
        f"[verdict] connected violated {INTRUDED}",
        f"[stopping] at 1.5 s: {CHANGED}",
        *BACK,
        *over(4),
    ]


async def test_what_changes_while_it_is_looked_at_has_the_verdict_judged_again(
    tmp_path: Path,
) -> None:
    world = SessionWorld(CHAIN, tmp_path)

    def look() -> None:
        world.graph.while_looking = world.intrude

    world.story.in_the_moment["[system] connected"] = look
    await world.run()
    assert world.since("[system] connected")[1:] == [
        *VERIFIED,
        f"[verdict] connected violated {INTRUDED}",
        f"[stopping] at 0.5 s: {CHANGED}",
        *BACK,
        *over(4),
    ]


async def test_networks_that_cannot_be_programmed_keep_the_gate_closed(tmp_path: Path) -> None:
    world = SessionWorld(CHAIN, tmp_path)
    world.networks.fails = "cannot program networks for 'robot': no"
    await world.run()
    assert world.since("networks programmed") == [
        "networks programmed (ok)",
        "[failure] run.not-programmed robot",
        "[stopping] at 0.0 s: rolling back",
        *BACK,
        *over(6),
    ]
    assert world.messages == ["cannot program networks for 'robot': no"]


async def test_what_changes_between_two_requests_has_the_rest_not_asked_and_all_rolled_back(
    tmp_path: Path,
) -> None:
    """The permit of the first node is stale for the second."""

    world = SessionWorld(CHAIN, tmp_path)
    world.hosts.takes_s["/camera activate"] = 3.0
    async with world.running("/camera activate"):
        await asyncio.sleep(1.0)
        world.intrude()
    assert world.since("[gate]") == [
        OPENED,
        "/camera activate",
        f"[verdict] connected violated {INTRUDED}",
        f"[stopping] at 1.5 s: {CHANGED}",
        *VIEWER_DOWN,
        *KILLED,
        *over(4),
    ]
    assert world.report == (
        f"ended when verified, before it was active, exit code 4: {CHANGED}; "
        "wrong: /intruder (graph.undeclared-node)"
    )


async def test_what_changes_between_two_requests_and_heals_is_judged_again_and_then_they_go_on(
    tmp_path: Path,
) -> None:
    world = SessionWorld(CHAIN, tmp_path, stop_after_s=0.0)
    world.hosts.takes_s["/camera activate"] = 3.0
    async with world.running("/camera activate"):
        await asyncio.sleep(2.9)
        world.intrude()
        await world.story.until("[verdict] connected violated")
        world.retreat()
    assert world.since("[gate]")[:6] == [
        OPENED,
        "/camera activate",
        f"[verdict] connected violated {INTRUDED}",
        "[verdict] connected ok",
        "/viewer activate",
        "[system] active at 3.0 s",
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


async def test_the_time_for_which_a_change_is_judged_is_not_that_of_the_node_that_waits_for_it(
    tmp_path: Path,
) -> None:
    after = {"camera": Condition.ACTIVE}
    limits = Timeouts(activate_s=1.0)
    plan = plan_of(planned_node("camera"), planned_node("viewer", after=after, timeouts=limits))
    world = SessionWorld(plan, tmp_path, stop_after_s=0.0)

    def hide() -> None:
        world.graph.unseen = {"/camera"}
        world.graph.note()

    world.story.in_the_moment["/camera activate"] = hide
    async with world.running("[verdict] connected violated"):
        await asyncio.sleep(4.0)
        world.graph.unseen.clear()
        world.graph.note()
    assert world.since("[gate]")[:6] == [
        OPENED,
        "/camera activate",
        "[verdict] connected violated graph.missing-node /camera",
        "[verdict] connected ok",
        "/viewer activate",
        "[system] active at 4.0 s",
    ]


def hiding(world: SessionWorld) -> Callable[[], None]:
    """Return what hides `camera` from the graph, as behind a link that is cut."""

    def hide() -> None:
        world.graph.unseen = {"/camera"}
        world.graph.note()

    return hide


HIDDEN = "[verdict] connected violated graph.missing-node /camera"
LATE = f"{CHANGED}, and {time_over(32)}"


@pytest.mark.parametrize("moment", ["networks programmed", "/camera activate"])
async def test_what_is_away_behind_an_open_gate_may_come_back_for_as_long_as_before_it(
    tmp_path: Path, moment: str
) -> None:
    """A host that is cut off once it was verified ends no bring-up that is within its time."""

    world = SessionWorld(CHAIN, tmp_path, stop_after_s=0.0)

    world.story.in_the_moment[moment] = hiding(world)
    async with world.running(HIDDEN):
        await asyncio.sleep(25.0)
        world.graph.unseen.clear()
        world.graph.note()
    before = [OPENED, "/camera activate"]
    if moment == "networks programmed":
        heals = ["networks programmed (ok)", HIDDEN, "[verdict] connected ok", *before]
    else:
        heals = ["networks programmed (ok)", *before, HIDDEN, "[verdict] connected ok"]
    assert world.since("networks programmed")[: len(heals) + 2] == [
        *heals,
        "/viewer activate",
        "[system] active at 25.0 s",
    ]


@pytest.mark.parametrize("moment", ["networks programmed", "/camera activate"])
async def test_what_stays_away_behind_an_open_gate_is_named_with_the_time_that_is_over(
    tmp_path: Path, moment: str
) -> None:
    world = SessionWorld(CHAIN, tmp_path, timeout_s=32.0)
    world.story.in_the_moment[moment] = hiding(world)
    await world.run()
    assert world.since(HIDDEN)[:2] == [HIDDEN, f"[stopping] at 32.0 s: {LATE}"]
    assert world.outline[-1] == "[stopped] 4"
    assert "/viewer activate" not in world.outline
    assert world.report == (
        f"ended when verified, before it was active, exit code 4: {LATE}; missing: /camera (node)"
    )


async def test_what_changes_before_a_request_to_a_foreign_node_leaves_keeps_it_back(
    tmp_path: Path,
) -> None:
    """It may be long until a service is matched: the verdict of before is not worth it then."""

    world = SessionWorld(ATTACHED, tmp_path)
    world.graph.services.matched_after_s["/base activate"] = 2.0
    async with world.running("[request] /base activate"):
        await asyncio.sleep(1.0)
        world.intrude()
    assert world.since("[gate]") == [
        "[gate] ok: /camera, /base",
        "/camera activate",
        f"[verdict] connected violated {INTRUDED}",
        f"[stopping] at 1.5 s: {CHANGED}",
        "/base cleanup",
        "/camera deactivate",
        *CAMERA_DOWN,
        *over(4),
    ]


async def test_a_foreign_node_is_not_blamed_for_the_time_in_which_its_request_is_kept_back(
    tmp_path: Path,
) -> None:
    limits = Timeouts(activate_s=3.0)
    base = planned_node("base", kind=RunKind.ATTACH, timeouts=limits)
    world = SessionWorld(plan_of(planned_node("camera"), base), tmp_path)
    world.graph.services.matched_after_s["/base activate"] = 1.0
    world.story.in_the_moment["/camera activate"] = hiding(world)
    await world.run()
    assert world.since("[gate]")[:2] == ["[gate] ok: /camera, /base", "/camera activate"]
    # When is a matter of the load of this machine, see `wait_under_load`.
    ends = [each for each in world.outline if each.startswith(("[stopping]", "[failure]"))]
    assert [each.partition(" s: ")[2] for each in ends] == [f"{CHANGED}, and {time_over(30)}"]
    assert "/base activate" not in world.outline


async def test_what_became_active_is_judged_again_and_must_be_what_was_verified(
    tmp_path: Path,
) -> None:
    world = SessionWorld(CHAIN, tmp_path)
    world.story.in_the_moment["[node] /viewer active"] = world.intrude
    await world.run()
    assert world.since("/viewer activate") == [
        "/viewer activate",
        f"[verdict] active violated {INTRUDED}",
        "[stopping] at 0.5 s: what became active is not what was verified",
        *DOWN,
        *over(4),
    ]


# Started again before the gate


UNDISCOVERED = "not discovered over TCP for 5 s (missing: /viewer (node))"


def started_again(attempt: int) -> list[str]:
    """What is reported when `viewer` is not discovered by TCP, and what is done."""
    return [
        f"[notice] '/viewer' is started again on a fresh port: {UNDISCOVERED}; try {attempt} of 3",
        *VIEWER_DOWN,
        "viewer start",
        "/viewer configure",
        "/viewer connect",
        f"[system] connected at {5 * attempt:.1f} s",
    ]


@pytest.mark.parametrize("needed", [1, 3])
async def test_a_node_that_is_not_discovered_over_tcp_is_started_again_on_a_fresh_port(
    tmp_path: Path, needed: int
) -> None:
    world = SessionWorld(DIALLING, tmp_path, stop_after_s=0.0)
    world.graph.unseen.add("/viewer")
    async with world.running("viewer start", needed + 1):
        world.graph.unseen.clear()
    again = [line for attempt in range(needed) for line in started_again(attempt + 1)]
    assert world.since("[system] connected")[1:-ENDING] == [
        "[verdict] connected violated graph.missing-node /viewer",
        waits(28),
        *again,
        "[verdict] connected ok",
        f"[system] verified at {5 * needed:.1f} s",
        "networks programmed (ok)",
        *ACTIVATED[:-1],
        f"[system] active at {5 * needed:.1f} s",
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
    world.graph.unseen.add("/viewer")
    await world.run()
    again = [line for attempt in (1, 2, 3) for line in started_again(attempt)]
    assert world.since("[verdict]")[1:] == [
        waits(28),
        *again,
        f"[stopping] at 30.0 s: the verdict keeps the gate closed, and {time_over(30)}",
        *BACK,
        *over(4),
    ]


async def test_a_node_that_would_get_no_other_port_is_waited_for(tmp_path: Path) -> None:
    world = SessionWorld(DIALLING, tmp_path, stop_after_s=0.0)
    world.graph.unseen.add("/camera")
    async with world.running("[system] connected"):
        await asyncio.sleep(12.0)
        world.graph.unseen.clear()
        world.graph.note()
    assert world.since("[system] connected")[1:5] == [
        "[verdict] connected violated graph.missing-node /camera",
        waits(28, "missing: /camera (node)"),
        "[verdict] connected ok",
        "[system] verified at 12.0 s",
    ]


async def test_nobody_is_started_again_while_something_is_wrong_that_no_port_would_mend(
    tmp_path: Path,
) -> None:
    world = SessionWorld(DIALLING, tmp_path)
    world.graph.unseen.add("/viewer")
    world.graph.others["/intruder"] = ""
    await world.run()
    assert world.since("[system] connected")[1:] == [
        f"[verdict] connected violated graph.missing-node /viewer, {INTRUDED}",
        "[stopping] at 0.5 s: the verdict keeps the gate closed",
        *BACK,
        *over(4),
    ]


@pytest.mark.parametrize(
    ("way", "failure", "message"),
    [
        ("no light", "run.transition-failed", "cannot activate '/viewer': no light"),
        (
            "die",
            "run.process-died",
            "cannot keep '/viewer' running: pid 5000002 died while activating: killed by SIGSEGV",
        ),
    ],
)
async def test_a_node_that_cannot_be_activated_has_everything_rolled_back(
    tmp_path: Path, way: str, failure: str, message: str
) -> None:
    world = SessionWorld(CHAIN, tmp_path)
    world.hosts.ways["/viewer activate"] = way
    await world.run()
    assert world.since("/viewer activate") == [
        "/viewer activate",
        f"[failure] {failure} /viewer",
        "[stopping] at 0.0 s: rolling back",
        *([] if way == "die" else VIEWER_DOWN),
        "/camera deactivate",
        *CAMERA_DOWN,
        *over(6),
    ]
    assert world.messages == [message]
    assert world.report == (
        f"ended when verified, before it was active, exit code 6: failed: /viewer ({failure})"
    )


async def test_a_process_that_dies_while_the_system_is_judged_ends_the_run(tmp_path: Path) -> None:
    world = SessionWorld(CHAIN, tmp_path)
    world.graph.unseen = {"/viewer"}
    async with world.running("[verdict]"):
        await asyncio.sleep(2.0)
        world.kill("camera")
    assert world.since("[failure]") == [
        "[failure] run.process-died /camera",
        "[stopping] at 2.0 s: rolling back",
        *VIEWER_DOWN,
        *over(6),
    ]
    assert world.report == (
        "ended when connected, before it was verified, exit code 6: "
        "failed: /camera (run.process-died)"
    )


# Signals


def _connecting(world: SessionWorld) -> str:
    world.hosts.takes_s["/camera configure"] = 5.0
    return "/camera configure"


def _verifying(world: SessionWorld) -> str:
    world.graph.unseen = {"/viewer"}
    return "[verdict]"


def _programming(world: SessionWorld) -> str:
    world.networks.takes_s = 5.0
    return "networks programmed"


def _activating(world: SessionWorld) -> str:
    world.hosts.takes_s["/camera activate"] = 5.0
    return "/camera activate"


def _active(world: SessionWorld) -> str:
    del world
    return "[system] active"


@pytest.mark.parametrize(
    ("number", "why", "cut_short", "active"),
    [
        (signal.SIGINT, "interrupted", 130, 130),
        (signal.SIGTERM, "terminated", 143, 0),
        (signal.SIGHUP, "the terminal was closed", 129, 0),
    ],
)
@pytest.mark.parametrize(
    ("prepare", "ended", "waits", "down"),
    [
        (
            _connecting,
            "before it was connected",
            "; /camera is still configuring",
            [*VIEWER_DOWN, *KILLED],
        ),
        (
            _verifying,
            "when connected, before it was verified",
            "; missing: /viewer (node)",
            BACK,
        ),
        (_programming, "when verified, before it was active", "", BACK),
        (
            _activating,
            "when verified, before it was active",
            "; /camera is still activating; /viewer waits to activate until /camera is active",
            [*VIEWER_DOWN, *KILLED],
        ),
        (_active, "after it was active", "", DOWN),
    ],
)
async def test_a_signal_ends_the_run_at_every_stage_and_says_what_was_waited_for(
    tmp_path: Path,
    number: int,
    why: str,
    cut_short: int,
    active: int,
    prepare: Callable[[SessionWorld], str],
    ended: str,
    waits: str,
    down: list[str],
) -> None:
    world = SessionWorld(CHAIN, tmp_path)
    begun = prepare(world)
    async with world.running(begun):
        await asyncio.sleep(1.0)
        signal.raise_signal(number)
    exit_code = active if prepare is _active else cut_short
    assert world.since("[stopping]") == [
        f"[stopping] at 1.0 s: {why}",
        *down,
        *over(exit_code),
    ]
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


async def test_a_run_that_is_bound_to_stay_is_cut_short_by_a_signal(tmp_path: Path) -> None:
    world = SessionWorld(CHAIN, tmp_path, stop_after_s=10.0)
    async with world.running("[system] active"):
        signal.raise_signal(signal.SIGTERM)
    assert world.report == (
        "ended after it was active, exit code 143: "
        "terminated; it did not hold for the 10 s of --stop-after"
    )


PASSED = "violated for no longer than 1 s, and not counted: /intruder (graph.undeclared-node)"


@pytest.mark.parametrize(
    ("phase", "report"),
    [
        ("paused", "exit code 0: terminated"),
        (
            "restarting",
            "exit code 143: terminated; the system was restarting, not active",
        ),
        (
            "held",
            f"exit code 4: terminated; held at the gate, and not active; {PASSED}",
        ),
    ],
)
async def test_a_run_is_a_success_only_if_its_system_is_as_it_was_ordered(
    tmp_path: Path, phase: str, report: str
) -> None:
    world = SessionWorld(CHAIN, tmp_path)
    async with world.running("[system] active"):
        ordered = None
        if phase == "paused":
            assert await world.order(ControlRequest.PAUSE) == "0"
        elif phase == "held":
            world.intrude()
            assert await world.order(ControlRequest.RESTART, "viewer") == f"4 {REFUSED}"
            world.retreat()
        else:
            world.hosts.takes_s["/viewer configure"] = 4.0
            ordered = asyncio.ensure_future(world.order(ControlRequest.RESTART, "viewer"))
            await world.story.until("/viewer configure", 2)
        await asyncio.sleep(1.0)
        signal.raise_signal(signal.SIGTERM)
        if ordered is not None:
            assert await ordered == "6 cannot go on: 'robot' is being taken down"
    assert world.report == f"ended after it was active, {report}"


async def test_a_second_interrupt_ends_what_is_left_at_once(tmp_path: Path) -> None:
    world = SessionWorld(CHAIN, tmp_path, stop_after_s=0.0)
    world.hosts.takes_s["/viewer deactivate"] = 4.0
    async with world.running("/viewer deactivate"):
        await asyncio.sleep(1.0)
        signal.raise_signal(signal.SIGINT)
    assert world.since("[stopping]") == [
        "[stopping] at 0.0 s: done",
        "/viewer deactivate",
        "camera SIGKILL",
        "viewer SIGKILL",
        *over(130),
    ]
    assert world.report == (
        "ended after it was active, exit code 130: done; interrupted while it was taken down"
    )


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
        "viewer SIGTERM",
        "viewer SIGKILL",
        "[notice] process 'viewer' had to be ended with SIGKILL",
        "camera SIGINT",
        "camera SIGTERM",
        "[notice] process 'camera' had to be ended with SIGTERM",
        *over(0),
    ]


async def test_what_escaped_is_ended_and_named(tmp_path: Path) -> None:
    world = SessionWorld(CHAIN, tmp_path, stop_after_s=0.0)
    world.hosts.strays = (4711, 4712)
    await world.run()
    assert world.outline[-3:] == [
        "networks restored",
        "[notice] ended processes that were left behind: 4711, 4712",
        "[stopped] 0",
    ]
