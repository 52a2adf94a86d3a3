"""Nodes that no plan has: read where they are wanted, and looked at again when they say so."""

from __future__ import annotations

import asyncio
import dataclasses

from lifecycle.graph import set_within
from lifecycle.graph.observer import Observer
from lifecycle.verify.observation import ObservedNode
from tests.unit.graph.test_observer import FakeClients, FakeGraph, configuration, plan
from tests.unit.supervisor.fakes import run


def world(*, guests: bool) -> tuple[FakeGraph, FakeClients, Observer]:
    graph, clients = FakeGraph(), FakeClients()
    graph.nodes = (
        ObservedNode(full_name="/guest", managed=True),
        ObservedNode(full_name="/foreign", managed=True),
        ObservedNode(full_name="/plain", managed=False),
    )
    clients.configurations = {
        "/guest": dataclasses.replace(configuration("/guest"), checksum="1"),
        "/plain": configuration("/plain"),
    }
    return graph, clients, Observer(graph, clients, guests=guests)


def test_a_guest_is_read_and_followed_and_nobody_else_is() -> None:
    async def main() -> None:
        graph, clients, observer = world(guests=True)
        seen = await observer.observe(plan())
        assert [each.name for each in seen.configurations] == ["/guest"]
        assert {each.full_name: each.state for each in seen.nodes}["/guest"] == "inactive"
        # Its own interface says the state; a foreign node's services are left alone.
        assert clients.asked == []
        assert list(clients.followed) == ["/guest"]
        graph.nodes = ()
        assert (await observer.observe(plan())).configurations == ()
        assert clients.forgotten == ["/guest"]

    run(main())


def test_without_guests_only_planned_nodes_are_read() -> None:
    async def main() -> None:
        _, clients, observer = world(guests=False)
        assert (await observer.observe(plan())).configurations == ()
        assert clients.followed == {}

    run(main())


def test_word_of_a_change_is_worth_a_look_and_a_heartbeat_only_with_a_new_checksum() -> None:
    async def woken(observer: Observer) -> bool:
        waiting = asyncio.Event()
        change = asyncio.ensure_future(observer.wait_change())
        change.add_done_callback(lambda _: waiting.set())
        try:
            return await set_within(waiting, 1.0)
        finally:
            change.cancel()

    async def main() -> None:
        _, _, observer = world(guests=True)
        await observer.observe(plan())
        observer.hear("/guest", "1")
        assert not await woken(observer)
        observer.hear("/guest", "2")
        assert await woken(observer)
        observer.hear("/guest")
        assert await woken(observer)
        observer.put_configuration(configuration("/hosted"))
        observer.hear("/hosted")
        assert not await woken(observer)

    run(main())
