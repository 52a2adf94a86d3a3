"""Nodes that no plan has: read where they are wanted, and looked at again when they say so."""

from __future__ import annotations

import asyncio
from typing import Any

from msgspec.structs import replace

from lifecycle.graph.graph import Graph
from lifecycle.graph.status import NodeStatus
from lifecycle.verify.observation import ObservedNode
from tests.unit.graph.test_observer import FakeClients, FakeGraph, configuration, observing, plan
from tests.unit.supervisor.fakes import run


def world() -> tuple[FakeGraph, FakeClients, Graph]:
    graph, clients = FakeGraph(), FakeClients()
    graph.nodes = (
        ObservedNode(full_name="/guest", managed=True),
        ObservedNode(full_name="/foreign", managed=True),
        ObservedNode(full_name="/plain", managed=False),
    )
    clients.configurations = {
        "/guest": replace(configuration("/guest"), checksum="1"),
        "/plain": configuration("/plain"),
    }
    return graph, clients, observing(graph, clients, unplanned=True)


def test_a_guest_is_read_and_followed_and_nobody_else_is() -> None:
    async def main() -> None:
        graph, clients, observer = world()
        seen = await observer.observe(plan())
        assert [each.name for each in seen.configurations] == ["/guest"]
        assert {each.full_name: each.state for each in seen.nodes}["/guest"] == "inactive"
        # Its own interface says the state; a foreign node's services are left alone.
        assert clients.asked == []
        assert list(clients.followed) == ["/guest"]
        graph.nodes = ()
        assert (await observer.observe(plan())).configurations == ()
        assert "/guest" in clients.forgotten

    run(main())


def test_a_status_is_worth_a_look_unless_it_says_what_is_known() -> None:
    async def main() -> None:
        _, _, observer = world()
        woken = observer.changes

        async def wakes(node: str, **fields: Any) -> bool:
            nonlocal woken
            observer.state.put_status(NodeStatus(node=node, instance="1", **fields))
            await asyncio.sleep(0)
            await asyncio.sleep(0)
            before, woken = woken, observer.changes
            return woken > before

        await observer.observe(plan())
        answered = {"state": "inactive", "connected": True, "checksum": "1"}
        assert not await wakes("/guest", **answered)
        assert await wakes("/guest", **answered | {"checksum": "2"})
        assert await wakes("/guest", **answered | {"state": "active"})
        assert await wakes("/guest", **answered, left=True)
        observer.state.put_configuration(configuration("/hosted"))
        assert not await wakes("/hosted", state="active")

    run(main())
