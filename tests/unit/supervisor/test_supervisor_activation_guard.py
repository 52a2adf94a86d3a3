"""The guard over nodes that others activate: who is deactivated, how often, and what is found."""

from __future__ import annotations

import asyncio
from pathlib import Path

from lifecycle.manifest.model import RunKind
from lifecycle.node.host.control import Operation
from lifecycle.plan.model import Plan
from lifecycle.supervisor.control.protocol import Reach
from lifecycle.supervisor.gate.activation_guard import TRIES, ActivationGuard
from lifecycle.supervisor.nodes.driver import ServiceDriver
from lifecycle.supervisor.nodes.system import NodeRun
from lifecycle.supervisor.run.events import Notice
from lifecycle.verify.observation import Observation, ObservedNode
from tests.builders import plan_of, planned_node
from tests.unit.supervisor.fakes import World, run
from tests.unit.supervisor.test_supervisor_gate import ForeignNode


class _Attached(ForeignNode):
    """A managed node of somebody else's, which does what it is asked."""

    async def change_state(self, node: str, transition: str, **_: object) -> bool:  # type: ignore[override]
        self.requests.append(transition)
        self.state = "inactive"
        return True


class _Bench:
    def __init__(self, tmp_path: Path) -> None:
        self.world = World(plan_of(planned_node("base", kind=RunKind.ATTACH)), tmp_path)
        self.services = _Attached()
        self.guard = ActivationGuard(self.world.system)
        self.node: NodeRun = self.world.system.nodes["base"]
        self.node.driver = ServiceDriver(self.services, self.node.planned)
        self.node.undo = [Operation.CONFIGURE, Operation.CONNECT]
        self.node.advance(Reach.CONNECTED)

    async def looked(self) -> list[str]:
        """What is found when somebody has activated the node, once that was answered."""
        self.services.state = "active"
        self.guard.look(Observation(nodes=(ObservedNode(full_name="/base", state="active"),)))
        found = [each.rule for each in self.guard.findings()]
        for _ in range(20):
            await asyncio.sleep(0)
        return found


async def test_a_node_that_somebody_activates_is_deactivated_at_once_and_found(
    tmp_path: Path,
) -> None:
    bench = _Bench(tmp_path)
    assert await bench.looked() == ["state.activated-at-closed-gate"]
    assert bench.services.requests == ["deactivate"]
    assert bench.guard.findings() == ()
    assert bench.world.system.touched.is_set()
    (notice,) = bench.world.heard(Notice)
    assert notice.message == (
        "'/base' was activated by its own code or another client while the gate is closed: "
        "it is deactivated"
    )


async def test_whoever_activates_it_again_and_again_is_not_fought_for_ever(tmp_path: Path) -> None:
    bench = _Bench(tmp_path)
    for _ in range(TRIES + 3):
        await bench.looked()
    assert bench.services.requests == ["deactivate"] * TRIES
    assert bench.world.heard(Notice)[-1].message.endswith(
        f"it is deactivated for the last time, after {TRIES - 1} times in vain"
    )


async def test_what_the_gate_let_through_is_left_alone_and_so_is_what_was_not_brought_up(
    tmp_path: Path,
) -> None:
    bench = _Bench(tmp_path)
    bench.node.undo.append(Operation.ACTIVATE)
    assert await bench.looked() == []
    bench.node.undo.clear()
    bench.node.advance(Reach.STARTED)
    assert await bench.looked() == []
    assert bench.services.requests == []


class _Graph:
    """An observer and its changes: notes the nodes that it is asked about."""

    def __init__(self) -> None:
        self.count = 0
        self.asked: list[list[str]] = []

    async def observe(self, plan: Plan) -> Observation:
        self.asked.append([each.full_name for each in plan.nodes])
        return Observation()

    async def beyond(self, _count: int, _timeout_s: float | None) -> bool:
        await asyncio.get_running_loop().create_future()
        return True


def _followed(tmp_path: Path, *kinds: RunKind) -> list[list[str]]:
    """Which nodes are asked about, of a system none of whose processes was started yet."""

    async def main() -> list[list[str]]:
        nodes = (planned_node(f"node_{each.value}", kind=each) for each in kinds)
        world = World(plan_of(*nodes), tmp_path)
        graph = _Graph()
        guard = ActivationGuard(world.system)
        following = asyncio.ensure_future(guard.follow(graph, graph))
        await asyncio.sleep(0)
        following.cancel()
        return graph.asked

    return run(main())


def test_a_node_of_a_host_of_ours_that_is_not_started_yet_is_not_asked(tmp_path: Path) -> None:
    assert _followed(tmp_path, RunKind.PYTHON) == []
    assert _followed(tmp_path, RunKind.PYTHON, RunKind.ATTACH) == [["/node_attach"]]
