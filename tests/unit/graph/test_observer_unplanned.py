"""Nodes that no plan has: read where they are wanted, and looked at again when they say so."""

from __future__ import annotations

import asyncio
import dataclasses

from lifecycle.graph.events import GraphEvents
from lifecycle.graph.messages import GraphMessage, Heartbeat, StateChanged, encode
from lifecycle.graph.observer import Observer
from lifecycle.graph.scheduler import set_within
from lifecycle.verify.observation import ObservedNode
from tests.unit.graph.simulated import ManualScheduler, Network
from tests.unit.graph.test_observer import FakeClients, FakeGraph, configuration, observing, plan
from tests.unit.supervisor.fakes import run


def world(*, unplanned: bool) -> tuple[FakeGraph, FakeClients, Observer]:
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
    return graph, clients, observing(graph, clients, unplanned=unplanned)


def test_a_guest_is_read_and_followed_and_nobody_else_is() -> None:
    async def main() -> None:
        graph, clients, observer = world(unplanned=True)
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
        _, clients, observer = world(unplanned=False)
        assert (await observer.observe(plan())).configurations == ()
        assert clients.followed == {}

    run(main())


def test_a_message_is_worth_a_look_and_a_heartbeat_only_with_a_new_checksum() -> None:
    async def woken(observer: Observer) -> bool:
        waiting = asyncio.Event()
        change = asyncio.ensure_future(observer.wait_change())
        change.add_done_callback(lambda _: waiting.set())
        try:
            return await set_within(waiting, 1.0)
        finally:
            change.cancel()

    async def main() -> None:
        graph, clients, _ = world(unplanned=True)
        network = Network(scheduler := ManualScheduler())
        events = GraphEvents(network.transport(), scheduler)
        observer = Observer(graph, clients, events, unplanned=True)
        sender = network.transport()

        def send(type_: type[GraphMessage], node: str, **fields: str) -> None:
            sender.send(encode(type_(node=node, incarnation="1", sequence=1, **fields)))

        await observer.observe(plan())
        send(Heartbeat, "/guest", checksum="1")
        assert not await woken(observer)
        send(Heartbeat, "/guest", checksum="2")
        assert await woken(observer)
        send(StateChanged, "/guest", state="active")
        assert await woken(observer)
        observer.state.put_configuration(configuration("/hosted"))
        send(StateChanged, "/hosted", state="active")
        assert not await woken(observer)

    run(main())
