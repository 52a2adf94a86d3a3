"""Judging: when to look again, how long to wait, and when waiting is pointless."""

from __future__ import annotations

import asyncio
import dataclasses
from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import Any

import pytest

from lifecycle.manifest.model import EndpointKind
from lifecycle.node.control import Event
from lifecycle.supervisor.driver import Standing
from lifecycle.supervisor.events import Reach, VerdictChanged
from lifecycle.supervisor.judge import Changes, Judge, without
from lifecycle.supervisor.settling import PASSING_S
from lifecycle.supervisor.watch import Watch
from lifecycle.verify.observation import (
    NodeConfiguration,
    Observation,
    ObservedEndpoint,
    ObservedNode,
)
from lifecycle.verify.verdict import Outcome, Stage, Verdict
from tests.unit.supervisor.fakes import (
    FakeGraph,
    World,
    interface_of,
    plan_of,
    planned_node,
    run,
    verdict_of,
)

OK = verdict_of(Outcome.OK)
MISSING = verdict_of(Outcome.VIOLATED, "graph.missing-node")
UNDECLARED = verdict_of(Outcome.VIOLATED, "graph.undeclared-publisher")
UNMATCHED = verdict_of(Outcome.VIOLATED, "graph.unmatched-link")
UNATTRIBUTED = verdict_of(Outcome.UNVERIFIABLE, "graph.unattributed-endpoint")
UNKNOWN = verdict_of(Outcome.UNVERIFIABLE, "state.unverifiable", blocking=True)


class _Bench:
    """A judge over a graph whose verdicts are given: one for each number of nodes seen."""

    def __init__(self, tmp_path: Path, *verdicts: Verdict) -> None:
        self.world = World(plan_of(planned_node("camera")), tmp_path)
        self.graph = FakeGraph()
        self.verdicts = verdicts
        self.looks: list[float] = []
        self.changes = Changes(self.world.system, self.graph)
        self.judge = Judge(
            self.world.system,
            self.graph,
            self.changes,
            self.world.emit,
            strict=False,
            verify_=self._verify,
        )

    def _verify(
        self,
        plan: object,
        observation: Observation,
        *,
        stage: Stage,
        machines: frozenset[str] | None = None,
        ahead: frozenset[str] = frozenset(),
    ) -> Verdict:
        self.looks.append(self.now)
        return self.verdicts[min(len(observation.nodes), len(self.verdicts) - 1)]

    @property
    def now(self) -> float:
        return asyncio.get_running_loop().time()

    def grow(self) -> None:
        nodes = self.graph.observation.nodes
        added = ObservedNode(full_name=f"/node_{len(nodes)}")
        self.graph.observation = Observation(nodes=(*nodes, added))
        self.graph.changed.set()

    def told(self) -> list[Verdict]:
        return [event.verdict for event in self.world.heard(VerdictChanged)]


def _run(tmp_path: Path, test: Callable[[_Bench], Coroutine[Any, Any, None]], *of: Verdict) -> None:
    async def main() -> None:
        bench = _Bench(tmp_path, *of)
        try:
            await test(bench)
        finally:
            await bench.changes.close()

    run(main())


def test_an_ok_graph_is_judged_once(tmp_path: Path) -> None:
    async def test(bench: _Bench) -> None:
        assert await bench.judge.until_clear(Stage.CONNECTED, 30.0) == OK
        assert bench.looks == [0.0]

    _run(tmp_path, test, OK)


def test_what_is_missing_is_waited_for_and_each_change_of_the_verdict_is_told(
    tmp_path: Path,
) -> None:
    async def test(bench: _Bench) -> None:
        asyncio.get_running_loop().call_later(7.0, bench.grow)
        assert await bench.judge.until_clear(Stage.CONNECTED, 30.0) == OK
        assert bench.now == pytest.approx(7.0, abs=0.1)
        assert bench.told() == [MISSING, OK]

    _run(tmp_path, test, MISSING, OK)


def test_what_stays_missing_is_reported_at_the_deadline_without_looking_in_between(
    tmp_path: Path,
) -> None:
    async def test(bench: _Bench) -> None:
        assert await bench.judge.until_clear(Stage.CONNECTED, 30.0) == MISSING
        assert bench.now == pytest.approx(30.0, abs=0.1)
        assert len(bench.looks) == 2

    _run(tmp_path, test, MISSING)


def test_what_time_does_not_heal_fails_after_half_a_second(tmp_path: Path) -> None:
    async def test(bench: _Bench) -> None:
        assert await bench.judge.until_clear(Stage.CONNECTED, 30.0) == UNDECLARED
        assert bench.now == pytest.approx(0.5, abs=0.05)

    _run(tmp_path, test, UNDECLARED)


def test_it_stands_although_the_graph_goes_on_changing(tmp_path: Path) -> None:
    async def test(bench: _Bench) -> None:
        async def noise() -> None:
            while True:
                await asyncio.sleep(0.1)
                bench.graph.changed.set()

        noisy = asyncio.ensure_future(noise())
        assert await bench.judge.until_clear(Stage.CONNECTED, 30.0) == UNDECLARED
        noisy.cancel()
        assert bench.now < 0.8

    _run(tmp_path, test, UNDECLARED)


def test_what_cannot_be_verified_may_be_unseen_for_one_discovery_period(tmp_path: Path) -> None:
    async def test(bench: _Bench) -> None:
        assert await bench.judge.until_clear(Stage.CONNECTED, 30.0) == UNKNOWN
        assert bench.now == pytest.approx(3.5, abs=0.1)

    _run(tmp_path, test, UNKNOWN)


def test_an_unmatched_pair_is_asked_again_because_its_match_changes_no_graph(
    tmp_path: Path,
) -> None:
    async def test(bench: _Bench) -> None:
        def match() -> None:
            bench.verdicts = (OK,)

        asyncio.get_running_loop().call_later(0.1, match)
        assert await bench.judge.until_clear(Stage.CONNECTED, 30.0) == OK
        assert bench.now < 0.3
        assert len(bench.looks) <= 5

    _run(tmp_path, test, UNMATCHED)


def test_a_node_that_tells_of_its_matches_is_not_asked_for_them(tmp_path: Path) -> None:
    finding = dataclasses.replace(UNMATCHED.findings[0], subject="/video: /camera → /viewer")
    unmatched = dataclasses.replace(UNMATCHED, findings=(finding,))

    async def test(bench: _Bench) -> None:
        bench.world.system.nodes["camera"].tells = True

        def match() -> None:
            bench.verdicts = (OK,)
            event = Event(kind="configuration", node="/camera", configuration=None)
            bench.world.system.on_host_event(event)

        asyncio.get_running_loop().call_later(5.0, match)
        assert await bench.judge.until_clear(Stage.CONNECTED, 30.0) == OK
        assert bench.now < 5.1
        assert len(bench.looks) == 2  # the first, and the one after it told

    _run(tmp_path, test, unmatched)


def test_a_reply_does_not_undo_what_was_told_after_it(tmp_path: Path) -> None:
    def of(*, matched: bool) -> NodeConfiguration:
        told = interface_of("/camera", "service_clients/ask")
        (end,) = told.endpoints
        end = dataclasses.replace(end, server_matched=matched)
        return dataclasses.replace(told, endpoints=(end,))

    async def test(bench: _Bench) -> None:
        system = bench.world.system
        node = system.nodes["camera"]
        before, after = of(matched=False), of(matched=True)
        reply = Event(kind="reply", node="/camera", state="inactive", configuration=before)
        system.on_host_event(reply)
        assert node.configuration == before
        system.on_host_event(dataclasses.replace(reply, kind="configuration", configuration=after))
        # Who awaited the reply goes on only now.
        node.advance(Reach.CONNECTED, Standing(state="inactive", configuration=before))
        assert node.configuration is not None
        assert node.configuration.endpoints == after.endpoints

    _run(tmp_path, test, OK)


@pytest.mark.parametrize(("client", "server"), [("/viewer", "/camera"), ("/camera", "/viewer")])
def test_of_a_server_that_is_matched_only_its_client_tells(
    tmp_path: Path, client: str, server: str
) -> None:
    finding = dataclasses.replace(
        UNMATCHED.findings[0],
        rule="graph.unmatched-client",
        subject=f"/calibrate: {client} → {server}",
        node=client,
    )

    async def test(bench: _Bench) -> None:
        bench.world.system.nodes["camera"].tells = True

        def match() -> None:
            bench.verdicts = (OK,)

        def tell() -> None:
            event = Event(kind="configuration", node="/camera", configuration=None)
            bench.world.system.on_host_event(event)

        asyncio.get_running_loop().call_later(0.1, match)
        asyncio.get_running_loop().call_later(5.0, tell)
        assert await bench.judge.until_clear(Stage.CONNECTED, 30.0) == OK
        told = client == "/camera"
        assert (bench.now > 4.9, len(bench.looks) == 2) == (told, told)

    _run(tmp_path, test, dataclasses.replace(UNMATCHED, findings=(finding,)))


def test_a_burst_of_changes_is_one_look(tmp_path: Path) -> None:
    async def test(bench: _Bench) -> None:
        for index in range(10):
            asyncio.get_running_loop().call_later(1.0 + index / 1000, bench.grow)
        await bench.judge.until_clear(Stage.CONNECTED, 2.0)
        assert len(bench.looks) == 3

    _run(tmp_path, test, MISSING)


def test_a_dead_node_is_gone_although_discovery_shows_it_for_the_whole_lease() -> None:
    def of(name: str, count: int = 1) -> ObservedNode:
        return ObservedNode(full_name=name, count=count)

    endpoint = ObservedEndpoint(
        kind=EndpointKind.PUBLISHER, node="/dead", name="/topic", type="std_msgs/msg/String"
    )
    seen = Observation(nodes=(of("/dead"), of("/other"), of("/twice", 2)), endpoints=(endpoint,))
    assert without(seen, frozenset({"/dead", "/twice"})) == Observation(
        nodes=(of("/other"), of("/twice", 1))
    )


def test_while_held_a_passing_violation_is_told_but_does_not_count(tmp_path: Path) -> None:
    async def test(bench: _Bench) -> None:
        watch = Watch(bench.judge, bench.changes, Stage.ACTIVE)
        watching = asyncio.ensure_future(watch.run())
        for delay_s in (1.0, 1.2):
            asyncio.get_running_loop().call_later(delay_s, bench.grow)
        await asyncio.sleep(5.0)
        watching.cancel()
        assert bench.told() == [OK, UNDECLARED, OK]
        assert not watch.violated

    _run(tmp_path, test, OK, UNDECLARED, OK)


def test_while_held_a_violation_that_stands_counts_and_nothing_is_polled(tmp_path: Path) -> None:
    async def test(bench: _Bench) -> None:
        watch = Watch(bench.judge, bench.changes, Stage.ACTIVE)
        watching = asyncio.ensure_future(watch.run())
        asyncio.get_running_loop().call_later(1.0, bench.grow)
        await asyncio.sleep(60.0)
        watching.cancel()
        assert watch.violated
        assert len(bench.looks) == 3

    _run(tmp_path, test, OK, UNDECLARED)


def test_while_held_a_newcomer_that_is_not_known_by_name_yet_is_not_told(tmp_path: Path) -> None:
    async def test(bench: _Bench) -> None:
        watching = asyncio.ensure_future(Watch(bench.judge, bench.changes, Stage.ACTIVE).run())
        for delay_s in (1.0, 1.0 + 0.9 * PASSING_S):
            asyncio.get_running_loop().call_later(delay_s, bench.grow)
        await asyncio.sleep(60.0)
        watching.cancel()
        assert bench.told() == [OK]

    _run(tmp_path, test, OK, UNATTRIBUTED, OK)


def test_while_held_a_newcomer_that_stays_unknown_is_told_after_a_bounded_time(
    tmp_path: Path,
) -> None:
    async def test(bench: _Bench) -> None:
        watching = asyncio.ensure_future(Watch(bench.judge, bench.changes, Stage.ACTIVE).run())
        asyncio.get_running_loop().call_later(1.0, bench.grow)
        await asyncio.sleep(60.0)
        watching.cancel()
        assert bench.told() == [OK, UNATTRIBUTED]
        # At the start, at the change, once its time is over; and then nothing is polled.
        assert bench.looks == pytest.approx([0.0, 1.0, 1.0 + PASSING_S], abs=0.1)

    _run(tmp_path, test, OK, UNATTRIBUTED)


def test_before_the_gate_a_newcomer_that_is_not_known_by_name_is_told_at_once(
    tmp_path: Path,
) -> None:
    async def test(bench: _Bench) -> None:
        await bench.judge.once(Stage.CONNECTED)
        bench.grow()
        assert await bench.judge.once(Stage.CONNECTED) == UNATTRIBUTED

    _run(tmp_path, test, OK, UNATTRIBUTED)
