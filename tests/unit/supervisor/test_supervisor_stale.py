"""Whose participants are removed from the graph when a process ends, and how often that is said."""

from __future__ import annotations

import asyncio
import dataclasses
from collections.abc import Iterable
from types import SimpleNamespace
from typing import Any, cast

import pytest

from lifecycle.supervisor.control.protocol import ProcessState, Reach
from lifecycle.supervisor.health import process_monitor
from lifecycle.supervisor.health.process_monitor import STARTING_S, StaleNodes
from lifecycle.supervisor.nodes.system import System
from lifecycle.supervisor.run.events import NodeChanged, ProcessChanged
from tests.unit.supervisor.fakes import run

PREFIX = "010f7f015d3c1b4c00000000"
ENDED = ProcessChanged(process="camera", state=ProcessState.EXITED, pid=7)


class Graph:
    """Shows one participant until it was removed often enough."""

    def __init__(self, removals: int) -> None:
        self.asked: list[tuple[int, frozenset[str]]] = []
        self.removed: list[tuple[frozenset[str], tuple[int, ...]]] = []
        self.introduced: list[tuple[tuple[int, ...], tuple[int, ...]]] = []
        self.rediscovers: list[bool] = []
        self.disowned = self.announced = 0
        self._removals = removals

    def participants_of(
        self, pid: int, *, nodes: Iterable[str], reported: Iterable[str]
    ) -> frozenset[str]:
        self.asked.append((pid, frozenset(reported)))
        return frozenset((PREFIX,)) if len(self.removed) < self._removals else frozenset()

    def remove_participants(self, prefixes: Iterable[str], pids: Iterable[int]) -> None:
        self.removed.append((frozenset(prefixes), tuple(pids)))

    def introduce(
        self, newcomers: Iterable[int], pids: Iterable[int], *, rediscover: bool = False
    ) -> None:
        self.introduced.append((tuple(newcomers), tuple(pids)))
        self.rediscovers.append(rediscover)

    def announce_ourselves(self) -> None:
        self.announced += 1

    def disown_ports(self) -> None:
        self.disowned += 1


def system() -> System:
    """A system of one node whose process has ended, and one process that lives."""
    configuration = SimpleNamespace(
        identity=SimpleNamespace(node_id=f"/camera@{PREFIX}"), endpoints=()
    )
    node = SimpleNamespace(name="/camera", configuration=configuration)
    process = SimpleNamespace(pid=7, planned=SimpleNamespace(nodes=("camera",)))
    living = (SimpleNamespace(pid=8),)
    fake: Any = SimpleNamespace(
        nodes={"camera": node}, processes={"camera": process}, living=living
    )
    return cast("System", fake)


def after(graph: Graph, *events: ProcessChanged, seconds: float = 0.0) -> None:
    async def run() -> None:
        stale = StaleNodes(
            system(), SimpleNamespace(discovery=graph), disown_ports=graph.disown_ports
        )
        for event in events:
            stale.on_event(event)
        await asyncio.sleep(seconds)
        stale.close()
        await asyncio.sleep(0)

    asyncio.run(run())


def test_a_process_that_ended_is_removed_by_what_its_nodes_reported() -> None:
    graph = Graph(removals=1)
    after(graph, ENDED)
    assert graph.asked == [(7, frozenset((PREFIX,)))]
    assert graph.removed == [(frozenset((PREFIX,)), (8,))]


def test_it_is_said_again_although_it_is_gone() -> None:
    graph = Graph(removals=1)
    after(graph, ENDED, seconds=0.3)
    assert len(graph.removed) >= 2  # once more after 0.1 s


def test_nobody_is_removed_whom_discovery_does_not_show_or_who_lives() -> None:
    graph = Graph(removals=0)
    running = dataclasses.replace(ENDED, state=ProcessState.RUNNING)
    another = dataclasses.replace(ENDED, pid=6)
    server = dataclasses.replace(ENDED, process="discovery_server")
    after(graph, ENDED, running, another, server)
    assert graph.removed == []
    assert (len(graph.asked), graph.disowned) == (1, 1)


def test_what_a_process_made_just_before_its_end_is_removed_once_it_is_discovered() -> None:
    class Late(Graph):
        def participants_of(
            self, pid: int, *, nodes: Iterable[str], reported: Iterable[str]
        ) -> frozenset[str]:
            shown = super().participants_of(pid, nodes=nodes, reported=reported)
            return shown if len(self.asked) > 1 else frozenset()

    graph = Late(removals=2)
    after(graph, ENDED, seconds=0.3)
    assert graph.removed[0] == (frozenset((PREFIX,)), (8,))


@pytest.mark.parametrize(("later_s", "announced", "introduced"), [(0.5, 2, []), (5.0, 1, [(9,)])])
def test_who_is_started_with_others_meets_those_that_announce_themselves_no_more(
    later_s: float, announced: int, introduced: list[tuple[int, ...]]
) -> None:
    async def main() -> Graph:
        graph, of = Graph(removals=0), system()
        node, process = cast("Any", of.nodes["camera"]), cast("Any", of.processes["camera"])
        node.process, node.reach = process, Reach.STARTED
        of.__dict__["node_named"] = lambda _: node
        process.__dict__.update(is_restarted=False, joins=False, channel=object(), pid=7)
        stale = StaleNodes(of, graph, disown_ports=lambda: None)
        started = NodeChanged(node="/camera", reach=Reach.STARTED)
        stale.on_event(started)
        await asyncio.sleep(later_s)
        process.pid = 9
        stale.on_event(started)
        await asyncio.sleep(1.0)
        return graph

    graph = run(main())
    assert graph.announced == announced
    assert [newcomers for newcomers, _ in graph.introduced] == introduced


def test_a_command_that_is_started_again_is_introduced_until_its_node_has_started() -> None:
    async def run() -> None:
        graph = Graph(removals=0)
        of = system()
        node, process = cast("Any", of.nodes["camera"]), cast("Any", of.processes["camera"])
        node.process, node.reach = process, Reach.WAITING
        process.__dict__.update(is_restarted=True, joins=False, is_gone=False, channel=None, pid=0)
        stale = StaleNodes(of, graph, disown_ports=lambda: None)
        stale.on_event(dataclasses.replace(ENDED, state=ProcessState.STARTING, pid=0))
        await asyncio.sleep(0)
        assert graph.introduced == []
        process.pid = 7
        await asyncio.sleep(2.5 * STARTING_S)
        assert graph.introduced == [((7,), (8,))] * 2
        node.reach = Reach.STARTED
        await asyncio.sleep(1.5 * STARTING_S)
        assert len(graph.introduced) == 2
        stale.close()

    asyncio.run(run())


def test_who_stays_unknown_is_made_to_discover_the_supervisor_anew(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(process_monitor, "INTRODUCED_AGAIN_S", (0.01, 0.01))
    monkeypatch.setattr(process_monitor, "REDISCOVERED_S", 0.05)

    async def run() -> None:
        graph = Graph(removals=0)
        of = system()
        node, process = cast("Any", of.nodes["camera"]), cast("Any", of.processes["camera"])
        process.__dict__.update(is_restarted=True, joins=False, is_gone=False, channel=None)
        node.process, node.reach = process, Reach.CONNECTED
        node.planned = SimpleNamespace(key="camera", run=SimpleNamespace(container=""))
        part = SimpleNamespace(
            reach=Reach.CONNECTED,
            planned=SimpleNamespace(key="part", run=SimpleNamespace(container="camera")),
        )
        cast("Any", of).__dict__.update(present=frozenset(), node_named={"/camera": node}.get)
        cast("Any", of.nodes)["part"] = part
        stale = StaleNodes(of, graph, disown_ports=graph.disown_ports)
        stale.on_event(NodeChanged(node="/camera", reach=Reach.CONNECTED))
        for _ in range(400):
            await asyncio.sleep(0.05 if len(graph.rediscovers) < 5 else 0)
        assert graph.rediscovers[:5] == [False, False, False, True, True]
        cast("Any", of).present = frozenset(("/camera",))
        asked = len(graph.rediscovers)
        await asyncio.sleep(0.3)
        assert len(graph.rediscovers) == asked
        part.reach = Reach.WAITING  # to be loaded by /camera, which does not answer
        stale.on_event(NodeChanged(node="/camera", reach=Reach.CONNECTED))
        await asyncio.sleep(0.3)
        assert graph.rediscovers[asked:][3:5] == [True, True]
        stale.close()

    asyncio.run(asyncio.wait_for(run(), 10))
