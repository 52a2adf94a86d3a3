"""Nodes that another supervisor brings up: how far they have come, and who waits for them."""

from __future__ import annotations

import asyncio
import contextlib
import socket
from pathlib import Path
from types import SimpleNamespace

import pytest
from msgspec.structs import replace

from lifecycle.manifest.model import Condition, Machine
from lifecycle.plan.model import Plan
from lifecycle.supervisor.nodes.system import RemoteNode, System, follow_remote
from lifecycle.supervisor.run.failure import ended
from lifecycle.supervisor.run.options import address_that_is_down
from lifecycle.verify.observation import Observation, ObservedNode
from tests.builders import HERE, configuration, plan_of, planned_node
from tests.unit.supervisor.fakes import World, run

STARTED, CONFIGURED, CONNECTED, ACTIVE, HEALTHY = Condition


def _seen(state: str | None, *, connected: bool | None = None) -> Observation:
    reports = ()
    if connected is not None:
        reports = (configuration("/camera", state=state or "", connected=connected),)
    return Observation(
        nodes=(ObservedNode(full_name="/camera", state=state),), configurations=reports
    )


@pytest.mark.parametrize(
    ("observation", "reached"),
    [
        (Observation(), ()),
        (_seen(None), (STARTED,)),
        (_seen("unconfigured", connected=False), (STARTED,)),
        (_seen("inactive", connected=False), (STARTED, CONFIGURED)),
        (_seen("inactive", connected=True), (STARTED, CONFIGURED, CONNECTED)),
        # Without a report it is not one of our nodes, whose data layer is made in configure.
        (_seen("inactive"), (STARTED, CONFIGURED, CONNECTED)),
        # Nothing is asked of its health.
        (_seen("active"), (STARTED, CONFIGURED, CONNECTED, ACTIVE, HEALTHY)),
        (_seen("finalized", connected=False), (STARTED,)),
    ],
)
def test_a_remote_node_has_reached_what_is_seen_of_it(
    observation: Observation, reached: tuple[Condition, ...]
) -> None:
    async def main() -> tuple[Condition, ...]:
        node = RemoteNode(planned_node("camera"))
        node.see(observation)
        return tuple(each for each in Condition if node.has_reached(each))

    assert run(main()) == reached


def test_a_remote_node_that_leaves_has_reached_nothing_any_more() -> None:
    async def main() -> bool:
        node = RemoteNode(planned_node("camera"))
        node.see(_seen("active"))
        node.see(Observation())
        return node.has_reached(STARTED)

    assert not run(main())


class _Graph:
    """A graph that shows the next observation at each change, and what it was asked for."""

    def __init__(self, *observations: Observation) -> None:
        self.observations = list(observations)
        self.asked: list[tuple[str, ...]] = []
        self.count = 0

    async def observe(self, plan: Plan) -> Observation:
        self.asked.append(tuple(node.full_name for node in plan.nodes))
        await asyncio.sleep(0)
        return self.observations[min(self.count, len(self.observations) - 1)]

    async def beyond(self, count: int, timeout_s: float | None) -> bool:
        await asyncio.sleep(0)
        self.count = count + 1
        return True


def test_a_step_that_a_remote_node_holds_goes_on_once_that_is_seen(tmp_path: Path) -> None:
    async def main() -> tuple[str, _Graph]:
        viewer, camera = planned_node("viewer", after={"camera": CONNECTED}), planned_node("camera")
        plan = plan_of(viewer, camera)
        world = World(plan, tmp_path)
        mine = [each for each in plan.processes if "viewer" in each.nodes]
        system = System(plan, emit=world.emit, logs=tmp_path, processes=mine)
        node = system.nodes["viewer"]
        waiting = asyncio.ensure_future(system.reached(node, CONNECTED, "connect"))
        await asyncio.sleep(0)
        doing = node.doing
        graph = _Graph(Observation(), _seen("inactive", connected=False), _seen("active"))
        await follow_remote(system, graph, graph)
        await asyncio.wait_for(waiting, 1.0)
        assert node.doing == ""
        assert system.machines == frozenset({""})
        return doing, graph

    doing, graph = run(main())
    assert doing == "waits to connect until /camera is connected"
    # Only what ours wait for is asked, and nobody once it is active.
    assert graph.asked == [("/camera",)] * 3


def test_a_task_that_loses_a_cancellation_is_ended_all_the_same() -> None:
    lost: list[None] = []

    async def deaf() -> None:
        with contextlib.suppress(asyncio.CancelledError):
            await asyncio.sleep(1000)
        lost.append(None)
        await asyncio.sleep(1000)

    async def main() -> bool:
        task = asyncio.ensure_future(deaf())
        await asyncio.sleep(0)
        await ended(task)
        return task.cancelled()

    assert run(main())
    assert lost == [None]


@pytest.mark.parametrize(
    ("machine", "is_up", "expected"),
    [
        ("left", False, "192.0.2.1"),
        ("", False, "192.0.2.1"),  # that host's own by its address
        ("left", True, ""),
        ("right", False, ""),  # it has no such address: behind a NAT, in a container
    ],
)
def test_a_machine_waits_for_the_interface_with_its_address_where_others_are_to_find_it(
    machine: str, is_up: bool, expected: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    address = SimpleNamespace(address="192.0.2.1", family=socket.AF_INET)
    monkeypatch.setattr("psutil.net_if_addrs", lambda: {"e0": [address]})
    monkeypatch.setattr("psutil.net_if_stats", lambda: {"e0": SimpleNamespace(isup=is_up)})
    nodes = [
        replace(planned_node(key), machine=of)
        for key, of in (("camera", "left"), ("viewer", "right"))
    ]
    machines = tuple(
        Machine(name=each, address=f"192.0.2.{number}", at=HERE)
        for number, each in enumerate(("left", "right"), 1)
    )
    plan = replace(plan_of(*nodes), machines=machines)
    assert address_that_is_down(plan, machine) == expected
    alone = replace(plan, nodes=plan.nodes[:1])
    assert address_that_is_down(alone, "left") == ""
