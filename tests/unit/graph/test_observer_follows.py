"""A graph that is followed: discovery must not undo what messages say, nor the other way round.

And one state for all: what a program is shown of a node is what the verification judges.
"""

from __future__ import annotations

import asyncio
import dataclasses
from collections.abc import Awaitable, Callable

import pytest

from lifecycle.graph.events import GraphEvents
from lifecycle.graph.observer import Observer
from lifecycle.graph.reporter import GraphReporter
from lifecycle.graph.scheduler import LoopScheduler
from lifecycle.manifest.model import EndpointKind
from lifecycle.verify.judge import verify
from lifecycle.verify.observation import EndpointReport, ObservedNode
from lifecycle.verify.verdict import Stage
from tests.unit.graph.simulated import Network, every
from tests.unit.graph.test_observer import FakeClients, FakeGraph, configuration, plan
from tests.unit.supervisor.fakes import run

OUT = EndpointReport(
    kind=EndpointKind.PUBLISHER, name="out", resolved="/out", type="std_msgs/msg/String"
)
ITS_OWN = dataclasses.replace(configuration("/it"), endpoints=(OUT,), checksum="1")


class World:
    def __init__(self, *, follows: bool = True) -> None:
        self.graph, self.clients = FakeGraph(), FakeClients()
        self.scheduler = LoopScheduler()
        self.network = Network(self.scheduler)
        events = GraphEvents(self.network.transport(), self.scheduler)
        self.observer = Observer(self.graph, self.clients, events, follows=follows)
        self.state = self.observer.state

    async def settle(self) -> None:
        await asyncio.sleep(0.5)

    def topics(self) -> tuple[str, ...]:
        return self.state.topics()


def in_world(main: Callable[[World], Awaitable[None]], *, follows: bool = True) -> None:
    async def made() -> None:
        world = World(follows=follows)
        await main(world)
        world.observer.close()

    run(made())


def test_a_node_that_reports_is_asked_although_its_services_are_not_shown_yet() -> None:
    async def main(world: World) -> None:
        world.graph.nodes = (ObservedNode(full_name="/it"),)
        await world.settle()
        seen = world.state.node("/it")
        assert seen is not None
        assert (seen.incarnation, seen.endpoints) == ("", ())

        world.clients.configurations["/it"] = ITS_OWN
        reporter = GraphReporter(
            world.network.transport(), "/it", every=every(world.scheduler), period_s=3600.0
        )
        reporter.joined("inactive", connected=True, checksum="1")
        await world.settle()
        joined = world.state.node("/it")
        assert joined is not None
        assert (joined.incarnation, joined.configuration) == (reporter.incarnation, ITS_OWN)
        reporter.left()

    in_world(main)


@pytest.mark.parametrize("follows", [True, False])
def test_what_is_judged_is_a_snapshot_of_the_state_that_programs_ask(*, follows: bool) -> None:
    async def main(world: World) -> None:
        world.graph.nodes = (
            ObservedNode(full_name="/put", managed=True),
            ObservedNode(full_name="/it", managed=True),
        )
        world.clients.states["/it"] = "inactive"
        world.clients.configurations["/it"] = ITS_OWN
        world.graph.offered = {"/it/get_configuration"}
        put = configuration("/put", state="active")
        world.state.put_configuration(put)
        seen = await world.observer.observe(plan("put", "it", "absent"))
        assert seen == world.state.observation()
        await world.settle()
        views = {each.name: each.configuration for each in world.state.nodes()}
        assert views == {each.name: each for each in seen.configurations}
        verdict = verify(plan("put", "it", "absent"), seen, stage=Stage.ACTIVE)
        assert {(each.rule, each.subject) for each in verdict.findings} >= {
            ("graph.missing-node", "/absent"),
            ("state.wrong-state", "/it"),
        }

    in_world(main, follows=follows)


def test_what_was_put_of_a_node_whose_process_ended_is_judged_no_more() -> None:
    async def main(world: World) -> None:
        world.state.put_configuration(configuration("/put"))
        await asyncio.sleep(0)
        assert [each.name for each in world.state.nodes()] == ["/put"]
        world.state.drop_configuration("/put")
        assert (await world.observer.observe(plan("put"))).configurations == ()
        await asyncio.sleep(0)
        assert world.state.nodes() == ()

    in_world(main)


class _Ahead(LoopScheduler):
    """As in a thread of its own that is faster than who posts."""

    def post(self, call: Callable[[], None]) -> None:
        call()


def test_a_node_that_is_there_at_once_may_be_read_before_the_observer_is_made_to_its_end() -> None:
    async def main() -> None:
        scheduler = _Ahead()
        network = Network(scheduler)
        events = GraphEvents(network.transport(), scheduler)
        events.report_seen("/it")
        clients = FakeClients()
        clients.configurations["/it"] = ITS_OWN
        graph = FakeGraph()
        graph.nodes = (ObservedNode(full_name="/it"),)
        observer = Observer(graph, clients, events, follows=True)
        await asyncio.sleep(0.5)
        view = observer.state.node("/it")
        assert view is not None
        assert view.configuration is not None
        observer.close()

    run(main())
