"""When a system is looked at again, what is kept back for a moment, and what a look leaves out."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from msgspec.structs import replace

from lifecycle.manifest.model import Health, Machine, Quantity
from lifecycle.measure.clock import ClockOffset
from lifecycle.measure.sample import Delays, Measured, Sample
from lifecycle.supervisor.control.protocol import ControlRequest
from lifecycle.supervisor.core.state import Level
from lifecycle.supervisor.nodes.peers import Peers
from lifecycle.supervisor.shell import looks as shell_looks
from lifecycle.supervisor.shell.looks import HEALTH_S, Looks
from lifecycle.supervisor.shell.settling import DISCOVERED_S, PASSING_S
from lifecycle.verify.observation import (
    HealthReport,
    Observation,
)
from lifecycle.verify.outcome import Outcome
from lifecycle.verify.verdict import Stage, Verdict
from tests.builders import (
    at,
    configuration,
    link,
    node,
    plan_of,
    planned,
    planned_node,
    publisher,
    subscription,
)
from tests.unit.supervisor.fakes import World, verdict, verdict_of
from tests.unit.supervisor.session_world import CHAIN, FakeAir, SessionWorld
from tests.unit.verify.perfect import perfect

OK = verdict_of(Outcome.OK)
MISSING = verdict_of(Outcome.VIOLATED, "graph.missing-node")
UNMATCHED = verdict(("graph.unmatched-link", "/video: /base → /tool"))  # none of ours reports it
UNATTRIBUTED = verdict_of(Outcome.UNVERIFIABLE, "graph.unattributed-endpoint")


class Judged(SessionWorld):
    """A run in which each look finds what `found` says; `looks`: when there was one."""

    def __init__(self, tmp_path: Path, **options: Any) -> None:
        super().__init__(CHAIN, tmp_path, **options)
        self.found: Callable[[float], Verdict] = lambda _: OK
        self.looks: list[float] = []
        self.prepare = self._prepare

    def _prepare(self) -> None:
        looks = self.supervisor.looks
        really_judge = looks.judge

        async def judge(stage: Stage) -> Verdict:
            await really_judge(stage)  # which notes what it has seen
            self.looks.append(asyncio.get_running_loop().time())
            return self.found(self.looks[-1])

        looks.judge = judge  # type: ignore[method-assign]


async def test_nodes_are_asked_for_a_match_at_growing_intervals_up_to_half_a_second(
    tmp_path: Path,
) -> None:
    world = Judged(tmp_path, stop_after_s=0.0)
    world.found = lambda now_s: UNMATCHED if now_s < 5.0 else OK
    await world.run()
    waits_s = [b - a for a, b in zip(world.looks, world.looks[1:], strict=False)]
    assert waits_s[:6] == [
        pytest.approx(each, abs=0.02) for each in (0.02, 0.04, 0.08, 0.16, 0.32, 0.5)
    ]
    assert world.outline[-1] == "[stopped] 0"


async def test_what_somebody_reports_is_not_polled_for(tmp_path: Path) -> None:
    world = Judged(tmp_path, timeout_s=20.0)
    world.found = lambda _: MISSING
    await world.run()
    assert len(world.looks) <= 3
    assert world.outline[-1] == "[stopped] 4"


async def test_a_burst_of_changes_is_one_look_and_one_that_does_not_end_is_looked_at(
    tmp_path: Path,
) -> None:
    world = Judged(tmp_path, stop_after_s=10.0)
    async with world.running("[system] active"):
        await asyncio.sleep(1.0)
        before = len(world.looks)
        for _ in range(10):
            world.graph.note()
            await asyncio.sleep(0.001)
        await asyncio.sleep(0.5)
        assert len(world.looks) - before == 1
        before = len(world.looks)
        for _ in range(500):
            world.graph.note()
            await asyncio.sleep(0.002)
        assert 15 <= len(world.looks) - before <= 21


@pytest.mark.parametrize(("lasts_s", "is_said"), [(0.5, False), (3.0, True)])
async def test_while_held_a_newcomer_without_a_name_is_kept_back_for_a_moment(
    tmp_path: Path, lasts_s: float, is_said: bool
) -> None:
    world = Judged(tmp_path, stop_after_s=10.0)
    async with world.running("[system] active"):
        await asyncio.sleep(2.0)
        world.found = lambda _: UNATTRIBUTED
        world.graph.note()
        await asyncio.sleep(lasts_s)
        world.found = lambda _: OK
        world.graph.note()
    said = [each for each in world.story if each.startswith("[verdict] active unverifiable")]
    assert bool(said) is is_said
    assert PASSING_S < 3.0


async def test_before_the_gate_a_newcomer_without_a_name_is_said_at_once(tmp_path: Path) -> None:
    world = Judged(tmp_path, strict=True)
    world.found = lambda _: UNATTRIBUTED
    await world.run()
    assert world.outline[7].startswith("[verdict] connected unverifiable")
    assert world.outline[-1] == "[stopped] 5"


async def test_a_node_that_must_be_healthy_is_given_time_to_say_how_it_is_once(
    tmp_path: Path,
) -> None:
    world = Judged(tmp_path, stop_after_s=0.0)
    world.found = lambda _: verdict_of(Outcome.UNVERIFIABLE, "node.unhealthy")
    await world.run()
    assert f"[system] verified at {HEALTH_S:.1f} s" in world.outline


async def test_what_a_node_said_of_its_health_while_it_was_inactive_is_no_answer(
    tmp_path: Path,
) -> None:
    plan = plan_of(replace(planned_node("camera"), health=Health(check=True)))
    node = World(plan, tmp_path).system.nodes["camera"]
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


async def test_what_a_process_left_in_the_graph_counts_no_more(tmp_path: Path) -> None:
    plan = plan_of(planned_node("camera"), planned_node("viewer"))
    world = SessionWorld(plan, tmp_path, stop_after_s=5.0, keep_going=True)
    world.hosts.lingers_s = 60.0
    async with world.running("[system] active"):
        world.kill("camera")
        await world.story.until("[verdict] active violated graph.missing-node /camera")
    assert world.graph.forgotten[0] == world.hosts.processes["camera"].pid


@pytest.mark.parametrize(
    ("apart_ms", "outcome"), [(500, "violated"), (460, "ok"), (None, "measuring")]
)
async def test_what_clocks_decide_is_judged_once_they_were_compared_after_the_last_message(
    tmp_path: Path, apart_ms: float | None, outcome: str
) -> None:
    number = Quantity(name="max_delay_ms", value=40.0, at=at(9))
    plan = planned(
        node("camera", publisher("/video"), machine="robot"),
        node("viewer", subscription("/video"), machine="desk"),
        links=[link("/video", "camera", "viewer", quantities=(number,))],
        machines=tuple(Machine(name=each, at=at(2)) for each in ("robot", "desk")),
    )
    late = Delays(seconds=5.0, buckets=((-45_000, 300),), apart=True)
    sample = Sample(seconds=6.0, messages=300, used=late, received=late)
    measured = Measured(active_s=6.0, samples=(("/video", sample),))
    seen = perfect(plan, Stage.ACTIVE)
    reports = (replace(each, measured=measured) for each in seen.configurations)
    seen = replace(seen, configurations=tuple(reports))
    compared: list[float | None] = []

    class Compared(Peers):
        """The clocks seemed to be 500 ms apart before they are compared."""

        def clocks(self) -> tuple[tuple[str, ClockOffset], ...]:
            now_ms = compared[-1] if compared else 500
            return () if now_ms is None else (("robot", ClockOffset(offset_ms=now_ms)),)

        async def compare_clocks(self) -> None:
            compared.append(apart_ms)

    async def observe(*_: object, **__: object) -> Observation:
        return seen

    system = World(
        plan, tmp_path, [each for each in plan.processes if each.machine == "desk"]
    ).system
    system.run.held_s, system.run.passage = 0.0, None
    graph: Any = SimpleNamespace(observe=observe)
    air: Any = FakeAir()
    peers = Compared(system, air)
    peers.open()
    shell: Any = SimpleNamespace(
        system=system,
        means=SimpleNamespace(participant=SimpleNamespace(graph=graph)),
        authority=None,
        peers=peers,
    )
    looks = Looks(shell)
    for _ in range(2):  # the second time nothing is new
        (flow,) = (await looks.judge(Stage.ACTIVE)).measured
        assert [each.outcome for each in flow.bounds] == [outcome]
        assert compared == [apart_ms]
    looks.close()
    await peers.close()


async def test_an_unknown_peer_is_said_once_it_had_its_time_to_be_discovered(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    world = SessionWorld(CHAIN, tmp_path)
    said = "[verdict] active violated graph.unknown-peer"
    async with world.running("[system] active"):
        unknown = verdict(("graph.unknown-peer", "/video"))
        monkeypatch.setattr(shell_looks, "verify", lambda *_, **__: unknown)
        world.graph.note()
        await asyncio.sleep(DISCOVERED_S - 0.2)
        assert not any(each.startswith(said) for each in world.story)
        await world.story.until(said)
        assert asyncio.get_running_loop().time() == pytest.approx(DISCOVERED_S, abs=0.3)
        await world.order(ControlRequest.DOWN)
