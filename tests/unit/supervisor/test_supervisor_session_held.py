"""Systems that are held: what ends a hold, and pause, resume and restart through the gate.

As in test_supervisor_session.py whole outlines of whole runs are compared.
"""

from __future__ import annotations

import asyncio
import signal
from pathlib import Path

import pytest
from msgspec.structs import replace

from lifecycle.manifest.model import Discovery
from lifecycle.supervisor.control.protocol import ControlRequest
from tests.unit.supervisor.session_world import (
    ACTIVATED,
    BACK,
    CAMERA_DOWN,
    CHAIN,
    CONNECTED,
    DIALLING,
    DOWN,
    INTRUDED,
    OPENED,
    REFUSED,
    REFUSED_AGAIN,
    VIEWER_DOWN,
    SessionWorld,
    over,
)

ENDING = 1 + len(DOWN) + len(over(0))
"""Lines of an outline from "[stopping]" on."""


# Hold


@pytest.mark.parametrize(
    ("lasts_s", "code", "why"),
    [
        (None, 4, "violated; wrong"),
        (2.0, 4, "violated meanwhile, wrong"),
        (0.2, 0, "; violated for no longer than 1 s, and not counted"),
    ],
)
async def test_a_violation_while_holding_is_told_and_makes_the_end_no_success_unless_it_passes(
    tmp_path: Path, lasts_s: float | None, code: int, why: str
) -> None:
    world = SessionWorld(CHAIN, tmp_path, stop_after_s=10.0)
    async with world.running("[system] active"):
        await asyncio.sleep(3.0)
        world.intrude()
        if lasts_s:
            await asyncio.sleep(lasts_s)
            world.retreat()
    assert world.since("[system] active")[1:] == [
        f"[verdict] active violated {INTRUDED}",
        *(["[verdict] active ok"] if lasts_s else []),
        "[stopping] at 10.0 s: done",
        *DOWN,
        *over(code),
    ]
    assert world.report == (
        f"ended after it was active, exit code {code}: "
        f"done{', but ' if code else ''}{why}: /intruder (graph.undeclared-node)"
    )


@pytest.mark.parametrize("keep_going", [False, True])
async def test_a_process_that_dies_while_holding_ends_the_run_unless_it_is_to_keep_going(
    tmp_path: Path, keep_going: bool
) -> None:
    world = SessionWorld(CHAIN, tmp_path, stop_after_s=10.0, keep_going=keep_going)
    async with world.running("[system] active"):
        await asyncio.sleep(3.0)
        world.kill("camera")
    gone = "graph.missing-node /camera"
    if keep_going:
        held = [
            "[failure] run.process-died /camera, and the run goes on",
            f"[verdict] active violated {gone}",
            "[stopping] at 10.0 s: done",
        ]
    else:
        held = ["[failure] run.process-died /camera", "[stopping] at 3.0 s: rolling back"]
    down = ["/viewer deactivate", *VIEWER_DOWN]
    assert world.since("[system] active")[1:] == [*held, *down, *over(6)]
    assert world.report == (
        "ended after it was active, exit code 6: "
        + ("done, but " if keep_going else "")
        + "failed: /camera (run.process-died)"
    )


# Orders


RESUMED = [
    "[system] verified at 0.0 s",
    "networks programmed (ok)",
    *ACTIVATED[:-1],
    "[system] active at 0.0 s",
]
ORDERS: dict[str, tuple[list[tuple[ControlRequest, str, str]], list[str]]] = {
    "a paused system is inactive until it is judged anew": (
        [
            (
                ControlRequest.RESUME,
                "",
                "2 cannot resume 'robot': it is active; only a paused system can be resumed",
            ),
            (ControlRequest.PAUSE, "", "0"),
            (ControlRequest.RESUME, "", "0"),
        ],
        ["/viewer deactivate", "/camera deactivate", "[system] paused at 0.0 s", *RESUMED],
    ),
    "one node is restarted through the gate and the others stay active": (
        [(ControlRequest.RESTART, "viewer", "0")],
        [
            *("/viewer deactivate", *VIEWER_DOWN),
            *("viewer start", "/viewer configure", "/viewer connect"),
            *("[system] connected at 0.0 s", *RESUMED[:2]),
            *("[gate] ok: /viewer", "/viewer activate", RESUMED[-1]),
        ],
    ),
    "a paused system is restarted as far as it was": (
        [(ControlRequest.PAUSE, "", "0"), (ControlRequest.RESTART, "", "0")],
        [
            *("/viewer deactivate", "/camera deactivate", "[system] paused at 0.0 s"),
            *(*BACK, *CONNECTED, "[system] paused at 0.0 s"),
        ],
    ),
}


@pytest.mark.parametrize("case", ORDERS)
async def test_an_order_does_what_it_says(tmp_path: Path, case: str) -> None:
    orders, outline = ORDERS[case]
    world = SessionWorld(CHAIN, tmp_path)
    async with world.running("[system] active"):
        for ask, node, answer in orders:
            assert await world.order(ask, node) == answer
        assert await world.order(ControlRequest.DOWN) == "0"
    down = BACK if outline[-1].startswith("[system] paused") else DOWN
    ends = ["[stopping] at 0.0 s: lifecycle down", *down, *over(0)]
    assert world.since("[system] active")[1:] == [*outline, *ends]


async def test_a_system_that_is_wrong_stays_paused_and_can_be_resumed_once_it_is_right(
    tmp_path: Path,
) -> None:
    world = SessionWorld(CHAIN, tmp_path)
    async with world.running("[system] active"):
        assert await world.order(ControlRequest.PAUSE) == "0"
        world.intrude()
        assert await world.order(ControlRequest.RESUME) == f"4 {REFUSED}"
        assert await world.order(ControlRequest.PAUSE) == (
            "2 cannot pause 'robot': it is paused; only an active system can be paused"
        )
        world.retreat()
        assert await world.order(ControlRequest.RESUME) == "0"
        assert await world.order(ControlRequest.DOWN) == "0"
    assert world.since("[system] paused")[1:-ENDING] == [
        f"[verdict] connected violated {INTRUDED}",
        f"[notice] {REFUSED}",
        "[verdict] connected ok",
        "[system] verified at 0.5 s",
        "networks programmed (ok)",
        *ACTIVATED[:-1],
        "[system] active at 0.5 s",
    ]
    assert world.report == "ended after it was active, exit code 0: lifecycle down"


async def test_what_changes_while_a_system_is_resumed_has_it_paused_again(tmp_path: Path) -> None:
    world = SessionWorld(CHAIN, tmp_path)
    async with world.running("[system] active"):
        assert await world.order(ControlRequest.PAUSE) == "0"
        world.hosts.takes_s["/camera activate"] = 3.0
        resumed = asyncio.ensure_future(world.order(ControlRequest.RESUME))
        await world.story.until("/camera activate", 2)
        await asyncio.sleep(1.0)
        world.intrude()
        assert await resumed == f"4 {REFUSED_AGAIN}"
        world.retreat()
        assert await world.order(ControlRequest.RESUME) == "0"
        assert await world.order(ControlRequest.DOWN) == "0"
    assert world.since("[gate]", 2)[:7] == [
        OPENED,
        "/camera activate",
        f"[verdict] connected violated {INTRUDED}",
        "[notice] the gate closed again: /camera is deactivated",
        f"[notice] {REFUSED_AGAIN}",
        "/camera deactivate",
        "[verdict] connected ok",
    ]
    assert world.since("[gate]", 3)[:4] == [
        OPENED,
        "/camera activate",
        "/viewer activate",
        "[system] active at 6.0 s",
    ]


async def test_a_restart_waits_until_nobody_takes_the_new_node_for_a_second_one_and_is_watched_anew(
    tmp_path: Path,
) -> None:
    world = SessionWorld(CHAIN, tmp_path)
    world.hosts.lingers_s = 2.0
    async with world.running("[system] active"):
        assert await world.order(ControlRequest.RESTART, "viewer") == "0"
        world.kill("viewer")
    assert world.since("viewer start", 2) == [
        "viewer start",
        "/viewer configure",
        "/viewer connect",
        "[system] connected at 2.0 s",
        "[system] verified at 2.0 s",
        "networks programmed (ok)",
        "[gate] ok: /viewer",
        "/viewer activate",
        "[system] active at 2.0 s",
        "[failure] run.process-died /viewer",
        "[stopping] at 2.0 s: rolling back",
        "/camera deactivate",
        *CAMERA_DOWN,
        *over(6),
    ]
    assert world.graph.dropped == ["/viewer"]


async def test_an_order_to_a_system_that_is_not_up_is_refused_and_not_kept(tmp_path: Path) -> None:
    world = SessionWorld(CHAIN, tmp_path)
    world.hosts.takes_s["/camera configure"] = 5.0
    async with world.running("/camera configure"):
        for ask, hint in (
            (ControlRequest.PAUSE, "only an active system can be paused"),
            (ControlRequest.RESTART, "only a system that is active or paused can be restarted"),
        ):
            assert await world.order(ask) == (
                f"2 cannot {ask.value} 'robot': it is connecting; {hint}"
            )
        assert await world.order(ControlRequest.DOWN) == "6"


async def test_a_restarted_node_stays_inactive_while_the_system_is_wrong_and_can_be_resumed(
    tmp_path: Path,
) -> None:
    world = SessionWorld(CHAIN, tmp_path)
    async with world.running("[system] active"):
        world.intrude()
        assert await world.order(ControlRequest.RESTART, "viewer") == f"4 {REFUSED}"
        world.retreat()
        await asyncio.sleep(1.0)
        assert await world.order(ControlRequest.RESUME) == "0"
        assert await world.order(ControlRequest.DOWN) == "0"
    assert world.since("[system] active")[1:-ENDING] == [
        "/viewer deactivate",
        *VIEWER_DOWN,
        "viewer start",
        "/viewer configure",
        "/viewer connect",
        "[system] connected at 0.0 s",
        f"[verdict] connected violated {INTRUDED}",
        f"[notice] {REFUSED}",
        "[verdict] connected ok",
        "[system] verified at 1.5 s",
        "networks programmed (ok)",
        "[gate] ok: /viewer",
        "/viewer activate",
        "[system] active at 1.5 s",
    ]
    assert world.report == (
        "ended after it was active, exit code 0: lifecycle down; violated for no longer than "
        "1 s, and not counted: /intruder (graph.undeclared-node)"
    )


async def test_a_restart_for_which_no_port_is_left_ends_the_run(tmp_path: Path) -> None:
    full = replace(DIALLING, discovery=Discovery(first_port=65535))
    full_up = "cannot give out 2 more ports: they would begin at 67535, and the highest is 65535"

    world = SessionWorld(full, tmp_path)
    async with world.running("[system] active"):
        assert await world.order(ControlRequest.RESTART, "viewer") == f"6 {full_up}"
    assert "[failure] run.start-failed robot" in world.outline
    assert world.report.startswith("ended after it was active, exit code 6: failed: robot")


async def test_an_order_that_comes_during_another_is_carried_out_after_it(tmp_path: Path) -> None:
    world = SessionWorld(CHAIN, tmp_path)
    world.hosts.takes_s |= {"/viewer deactivate": 3.0, "/viewer configure": 3.0}
    answers = []
    async with world.running("[system] active"):
        for first, second, line, times in (
            (ControlRequest.RESTART, ControlRequest.PAUSE, "/viewer deactivate", 1),
            (ControlRequest.RESTART, ControlRequest.RESUME, "/viewer configure", 3),
            (ControlRequest.PAUSE, ControlRequest.PAUSE, "/viewer deactivate", 3),
        ):
            one = asyncio.ensure_future(world.order(first))
            await world.story.until(line, times)
            other = asyncio.ensure_future(world.order(second))
            await asyncio.wait({one, other}, return_when=asyncio.FIRST_COMPLETED)
            assert one.done()
            answers.append((await one, await other))
        assert await world.order(ControlRequest.DOWN) == "0"
    assert answers == [
        ("0", "0"),
        ("0", "0"),
        # What it has become meanwhile counts.
        ("0", "2 cannot pause 'robot': it is paused; only an active system can be paused"),
    ]


async def test_a_restart_that_cannot_begin_leaves_everything_as_it_is(tmp_path: Path) -> None:
    world = SessionWorld(CHAIN, tmp_path)
    why = "the fork server does not answer within 10 s"
    async with world.running("[system] active"):
        world.hosts.cannot_start = why
        assert await world.order(ControlRequest.RESTART) == (
            f"6 cannot restart 'robot': {why}; everything stays as it is"
        )
        assert await world.order(ControlRequest.DOWN) == "0"
    assert world.since("[system] active")[1:] == [
        "[stopping] at 0.0 s: lifecycle down",
        *DOWN,
        *over(0),
    ]


async def test_a_restart_in_which_a_step_fails_ends_the_run(tmp_path: Path) -> None:
    world = SessionWorld(CHAIN, tmp_path)
    async with world.running("[system] active"):
        world.hosts.ways["/viewer configure"] = "no display"
        assert await world.order(ControlRequest.RESTART, "/viewer") == (
            "6 cannot configure '/viewer': no display"
        )
    assert world.since("viewer start", 2) == [
        "viewer start",
        "/viewer configure",
        "[failure] run.transition-failed /viewer",
        "[stopping] at 0.0 s: rolling back",
        "/viewer shutdown",
        "/camera deactivate",
        *CAMERA_DOWN,
        *over(6),
    ]


async def test_an_order_that_is_open_when_the_system_is_taken_down_is_answered(
    tmp_path: Path,
) -> None:
    world = SessionWorld(CHAIN, tmp_path)
    async with world.running("[system] active"):
        world.hosts.takes_s["/viewer deactivate"] = 2.0
        paused = asyncio.ensure_future(world.order(ControlRequest.PAUSE))
        await world.story.until("/viewer deactivate")
        signal.raise_signal(signal.SIGTERM)
        assert await paused == "6 cannot go on: 'robot' is being taken down"
