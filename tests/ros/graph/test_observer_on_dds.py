"""The observer on a real graph: discovery, services and what is put in, as one observation."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable, Iterator

import pytest
import rclpy
from managed_node import ManagedNode
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from std_msgs.msg import String

from lifecycle.graph.graph import Graph
from lifecycle.manifest.model import (
    RunKind,
)
from lifecycle.plan.model import Plan
from lifecycle.verify.observation import Observation
from tests.builders import plan_of, planned_node

BOUND_S = 30.0


def plan(domain_id: int, *names: str) -> Plan:
    nodes = (planned_node(name, kind=RunKind.ATTACH) for name in names)
    return plan_of(*nodes, domain_id=domain_id)


@pytest.fixture
def observer(domain_id: int) -> Iterator[Graph]:
    with Graph.in_loop(domain_id) as observer:
        yield observer


@pytest.fixture
def managed(context: rclpy.Context) -> Iterator[ManagedNode]:
    node = ManagedNode("managed", context=context, enable_rosout=False)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    thread = threading.Thread(target=executor.spin)
    thread.start()
    yield node
    executor.shutdown()
    thread.join()
    node.destroy_node()


def states(observation: Observation) -> dict[str, str | None]:
    return {node.full_name: node.state for node in observation.nodes}


async def observed(
    observer: Graph, plan: Plan, holds: Callable[[Observation], bool]
) -> Observation:
    """Look after each change until it holds, as a supervisor does; no polling."""

    async def look() -> Observation:
        while not holds(observation := await observer.observe(plan)):
            # A busy node that did not say its state within the second is asked again.
            if not any(node.managed and node.state is None for node in observation.nodes):
                await observer.wait_change()
        return observation

    try:
        return await asyncio.wait_for(look(), BOUND_S)
    except asyncio.TimeoutError:
        pytest.fail(f"not within {BOUND_S} s; last seen: {await observer.observe(plan)}")


def test_a_managed_nodes_state_is_seen_and_a_transition_wakes(
    observer: Graph,
    managed: ManagedNode,
    domain_id: int,
    wait_until: Callable[..., None],
) -> None:
    system = plan(domain_id, "managed")

    async def follow() -> None:
        await observed(observer, system, lambda seen: states(seen) == {"/managed": "unconfigured"})
        # The endpoints by which the observer asks and listens come first, at the node as well;
        # then only the transition itself can wake it.
        wait_until(lambda: managed.count_subscribers("/managed/transition_event"))
        changing = asyncio.get_running_loop().run_in_executor(None, managed.trigger_configure)
        await observed(observer, system, lambda seen: states(seen) == {"/managed": "inactive"})
        await changing

    asyncio.run(follow())


def test_a_burst_of_changes_wakes_a_few_times_only(
    make_node: Callable[..., Node], domain_id: int
) -> None:
    system = plan(domain_id, "n")
    publishers = 20
    looks = 0

    def all_seen(seen: Observation) -> bool:
        nonlocal looks
        looks += 1
        return len(seen.endpoints) == publishers

    async def follow() -> None:
        # Longer than a busy machine tears one burst apart.
        with Graph.in_loop(domain_id) as observer:
            observer.quiet_s, observer.burst_s = 0.3, BOUND_S
            await observer.observe(system)
            node = make_node("n")
            for number in range(publishers):
                node.create_publisher(String, f"/t{number}", 10)
            await observed(observer, system, all_seen)

    asyncio.run(follow())
    assert looks <= publishers / 4
