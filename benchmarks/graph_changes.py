"""What one change costs in systems of 10 to 10,000 endpoints: `python benchmarks/graph_changes.py`.

One `GraphState` holds a simulated system whose nodes have ten endpoints each. Prints the median
time from a status or a configuration until subscribers have been told, and the time of a query;
each also as a ratio to the smallest system.

Then the CPU time for which a supervisor looks and judges when one endpoint of a system of 5 to 200
nodes, a chain, goes or comes back: what is given of nodes is put into the graph's state, what a
simulated discovery shows is observed, and the observation is judged. What DDS costs is not in it:
`changed_endpoint.py`.
"""

from __future__ import annotations

import asyncio
import functools
import os
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Collection, Iterable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))  # as a script, only its own directory is there

from msgspec.structs import replace

from benchmarks import scale
from lifecycle.graph.graph import Graph
from lifecycle.graph.loop import GraphLoop
from lifecycle.graph.state import GraphState
from lifecycle.graph.status import NodeStatus, decode, encode
from lifecycle.manifest.loading import load
from lifecycle.manifest.model import EndpointKind
from lifecycle.plan.build import build_plan
from lifecycle.plan.model import Plan
from lifecycle.supervisor.nodes.peers import Peers
from lifecycle.supervisor.shell.looks import Looks
from lifecycle.verify.observation import (
    EndpointReport,
    Identity,
    NodeConfiguration,
    Observation,
    ObservedEndpoint,
    ObservedNode,
)
from lifecycle.verify.tool_filter import NO_NAMES, DeclaredNames
from lifecycle.verify.verdict import Stage
from tests.unit.supervisor.fakes import World
from tests.unit.verify.perfect import perfect

SIZES = (10, 100, 1_000, 10_000)
PER_NODE = 10
CHANGES = 400
SUPERVISED = (5, 20, 100, 200)
LOOKS = 20


class System:
    """A state and the nodes that it holds."""

    def __init__(self, endpoints: int) -> None:
        self.told = 0
        self.state = GraphState(lambda work: work())
        self.state.on_change(self._count)
        self.names = [f"/robot/node_{number}" for number in range(max(1, endpoints // PER_NODE))]
        for number, name in enumerate(self.names):
            self.state.put_configuration(configuration(name, number))
        assert sum(len(each.endpoints) for each in self.state.nodes()) == endpoints

    def _count(self, _: object) -> None:
        self.told += 1


def configuration(name: str, number: int) -> NodeConfiguration:
    return NodeConfiguration(
        identity=Identity(machine_id="m", process_id=number, node_id=name),
        name=name,
        state="inactive",
        connected=False,
        rmw="rmw_fastrtps_cpp",
        transports=("udpv4",),
        serializations=("cdr",),
        paradigms=("publish-subscribe",),
        endpoints=tuple(
            EndpointReport(
                kind=(EndpointKind.PUBLISHER, EndpointKind.SUBSCRIPTION)[index % 2],
                name=f"e{index}",
                resolved=f"/topic_{number}_{index // 2}",
                type="std_msgs/msg/String",
                mapped=True,
                matched=0,
            )
            for index in range(PER_NODE)
        ),
        checksum="0",
    )


def change_state(system: System, name: str, turn: int) -> None:
    state = ("active", "inactive")[turn // len(system.names) % 2]
    status = NodeStatus(node=name, instance="1", state=state, connected=True)
    system.state.put_status(decode(encode(status)))


def change_configuration(system: System, name: str, turn: int) -> None:
    """One endpoint more, or one less."""
    before = system.state.node(name)
    assert before is not None
    assert before.configuration is not None
    one_more = len(before.endpoints) == PER_NODE
    extra = replace(before.endpoints[0], name="extra", resolved="/extra")
    system.state.learn(
        replace(
            before.configuration,
            endpoints=(*before.endpoints, extra) if one_more else before.endpoints[:PER_NODE],
            checksum=str(turn + 1),
        )
    )


def measure(system: System, make: Callable[[System, str, int], None]) -> float:
    """Return the median microseconds of one change; nodes take turns."""
    before, took_us = system.told, []
    for turn in range(CHANGES):
        began = time.perf_counter()
        make(system, system.names[turn % len(system.names)], turn)
        took_us.append((time.perf_counter() - began) * 1e6)
    assert system.told - before == CHANGES, "a change was not told"
    return statistics.median(took_us)


def measure_query(system: System) -> float:
    took_us = []
    for number in range(CHANGES):
        topic = f"/topic_{number % len(system.names)}_0"
        began = time.perf_counter()
        found = system.state.publishers_of(topic)
        took_us.append((time.perf_counter() - began) * 1e6)
        assert len(found) == 1
    return statistics.median(took_us)


MEASURED: dict[str, Callable[[System], float]] = {
    "state changed": functools.partial(measure, make=change_state),
    "endpoint added or removed": functools.partial(measure, make=change_configuration),
    "who publishes a topic?": measure_query,
}


class Shown:
    """Discovery of a system that shows one endpoint every other time."""

    def __init__(self, seen: Observation) -> None:
        self._nodes = seen.nodes
        self._endpoints = seen.endpoints, seen.endpoints[:-1]
        self.turn = 0
        self.settling = self

    def snapshot(
        self, *, declared: Collection[str] = (), names: DeclaredNames = NO_NAMES
    ) -> tuple[tuple[ObservedNode, ...], tuple[ObservedEndpoint, ...]]:
        """Return what it shows now."""
        del declared, names
        return self._nodes, self._endpoints[self.turn % 2]

    def hosted(self, nodes: Iterable[str]) -> dict[str, bool]:
        """Return that all are in hosts."""
        return dict.fromkeys(nodes, True)

    def left_s(self) -> float:
        """Return that nobody is on the way."""
        return 0.0

    def on_change(self, callback: Callable[[], None]) -> Callable[[], None]:
        """Never call back: each look is asked for."""
        del callback
        return lambda: None


class Supervised:
    """What a supervisor has of a system that it holds: hosts report, discovery is simulated."""

    def __init__(self, plan: Plan, folder: Path) -> None:
        seen = perfect(plan, Stage.ACTIVE)
        self.shown: Any = Shown(seen)
        self._configurations = seen.configurations
        loop = GraphLoop(asyncio.get_running_loop())
        self._graph = Graph(self.shown, None, loop)  # type: ignore[arg-type]
        system: Any = World(plan, folder).system
        peers: Any = Peers(system, None)  # type: ignore[arg-type]
        self.state: Any = self
        self.discovery: Any = self
        self.settling: Any = self
        participant = SimpleNamespace(graph=self)
        means = SimpleNamespace(participant=participant)
        shell: Any = SimpleNamespace(system=system, means=means, authority=None, peers=peers)
        self.looks = Looks(shell)

    async def observe(self, plan: Plan, **_: object) -> Observation:
        """Give what nodes report, and look."""
        for each in self._configurations:
            self.put_configuration(each)
        return await self._graph.observe(plan)

    def expect_newcomers(self, *, everybody: bool = False) -> bool:
        """Return that there are none."""
        del everybody
        return False

    def put_configuration(self, configuration: NodeConfiguration) -> None:
        """Give what a host reports."""
        self._graph.state.put_configuration(configuration)

    async def look(self) -> None:
        """Look and judge after one endpoint has gone or come back."""
        self.shown.turn += 1
        await self.looks.judge(Stage.ACTIVE)


async def measure_look(plan: Plan, folder: Path) -> float:
    """Return the CPU milliseconds of one look and judgement."""
    supervised = Supervised(plan, folder)
    await supervised.look()
    await supervised.look()
    begun = time.process_time()
    for _ in range(LOOKS):
        await supervised.look()
    took_s = time.process_time() - begun
    supervised.looks.close()
    return 1e3 * took_s / LOOKS


def looks() -> None:
    """Print what one changed endpoint costs a supervisor of systems of several sizes."""
    costs: list[float] = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for size in SUPERVISED:
            path = folder / "chain.lifecycle.yaml"
            path.write_text(scale.manifest("chain", size), encoding="utf-8")
            plan = build_plan(load(str(path)).manifest, environment=os.environ)
            costs.append(asyncio.run(measure_look(plan, folder)))
    print(f"\n{'nodes':28}" + "".join(f"{size:>18,}" for size in SUPERVISED))
    print(f"{'ms CPU per change':28}" + "".join(f"{each:18.2f}" for each in costs))


def main() -> int:
    """Print one line for each kind of change."""
    for cost in MEASURED.values():
        cost(System(SIZES[0]))  # what is slow the first time is not to be measured
    costs: dict[str, list[float]] = {title: [] for title in MEASURED}
    for size in SIZES:
        for title, cost in MEASURED.items():
            costs[title].append(cost(System(size)))
    print(f"{'µs per change, system of':28}" + "".join(f"{size:>18,}" for size in SIZES))
    for title, found in costs.items():
        cells = (f"{each:9.1f} ({each / found[0]:5.2f} x)" for each in found)
        print(f"{title:28}" + "".join(f"{cell:>18}" for cell in cells))
    looks()
    return 0


if __name__ == "__main__":
    sys.exit(main())
