"""A graph that is followed: when nodes are read, and what discovery makes of them.

And one state for all: what a program is shown of a node is what the verification judges.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from typing import Any

import pytest
from msgspec.structs import replace

from lifecycle.graph.graph import Graph
from lifecycle.graph.loop import GraphLoop
from lifecycle.graph.status import NodeStatus
from lifecycle.manifest.model import EndpointKind
from lifecycle.verify.judge import verify
from lifecycle.verify.observation import EndpointReport, NodeConfiguration, ObservedNode
from lifecycle.verify.verdict import Stage
from tests.unit.graph.test_observer import VIDEO, FakeClients, FakeGraph, configuration, plan
from tests.unit.supervisor.fakes import run

OUT = EndpointReport(
    kind=EndpointKind.PUBLISHER, name="out", resolved="/out", type="std_msgs/msg/String"
)
ITS_OWN = replace(configuration("/it"), endpoints=(OUT,), checksum="1")


class LoopOfItsOwn(GraphLoop):
    """The test's loop, taken for one that has a thread of its own."""

    has_thread = True


class World:
    def __init__(self, *, follows: bool = True) -> None:
        self.graph, self.clients = FakeGraph(), FakeClients()
        loop = (LoopOfItsOwn if follows else GraphLoop)(asyncio.get_running_loop())
        self.observer = Graph(self.graph, self.clients, loop)
        self.state = self.observer.state

    async def show(self, *names: str) -> None:
        """Have discovery show nodes, and wait until what follows is done."""
        self.graph.nodes = tuple(ObservedNode(full_name=each) for each in names)
        self.graph.change()
        await asyncio.sleep(0.5)

    async def say(self, **fields: Any) -> None:
        self.state.put_status(NodeStatus(node="/it", **{"instance": "1", **fields}))
        await asyncio.sleep(0.5)

    def known(self) -> NodeConfiguration | None:
        view = self.state.node("/it")
        return None if view is None else view.configuration


def in_world(main: Callable[[World], Awaitable[None]], *, follows: bool = True) -> None:
    async def made() -> None:
        world = World(follows=follows)
        await main(world)
        world.observer.close()
        await asyncio.sleep(0)  # its tasks end in the loop

    run(made())


def test_a_node_that_reports_is_read_although_its_services_are_not_shown_yet() -> None:
    async def main(world: World) -> None:
        await world.show("/it")
        assert world.state.node("/it") is not None
        world.clients.configurations["/it"] = ITS_OWN
        await world.say(state="inactive", checksum="1")
        assert world.known() == ITS_OWN

    in_world(main)


def test_a_node_is_read_again_when_it_says_something_new_and_else_never() -> None:
    async def main(world: World) -> None:
        world.clients.configurations["/it"] = ITS_OWN
        await world.say(checksum="1")
        assert world.clients.read_configurations == ["/it"]
        await world.say(checksum="1")
        await world.show("/it")
        await asyncio.sleep(100)
        assert world.clients.read_configurations == ["/it"]
        changed = replace(ITS_OWN, endpoints=(), checksum="2")
        world.clients.configurations["/it"] = changed
        await world.say(checksum="2")
        assert world.clients.read_configurations == ["/it"] * 2
        assert world.known() == changed

    in_world(main)


def test_a_node_that_changes_while_it_is_read_is_read_once_more_however_often() -> None:
    async def main(world: World) -> None:
        world.clients.configurations["/it"] = ITS_OWN
        world.clients.answer_s = 0.1
        for number in range(20):
            world.state.put_status(NodeStatus(node="/it", instance="1", checksum=str(number)))
            await asyncio.sleep(0)
        await asyncio.sleep(0.5)
        assert world.clients.read_configurations == ["/it", "/it"]
        assert world.known() == ITS_OWN

    in_world(main)


def test_an_answer_of_the_instance_before_is_not_taken() -> None:
    async def main(world: World) -> None:
        world.clients.configurations["/it"] = ITS_OWN
        world.clients.answer_s = 1.0
        await world.say(instance="1")
        world.clients.configurations["/it"] = None
        await world.say(instance="2")
        await asyncio.sleep(0.5)
        assert world.known() is None

    in_world(main)


def test_a_node_that_does_not_answer_is_read_again_later() -> None:
    async def main(world: World) -> None:
        await world.say(checksum="1")
        assert world.known() is None
        world.clients.configurations["/it"] = ITS_OWN
        await asyncio.sleep(2.0)
        assert world.known() == ITS_OWN

    in_world(main)


def test_a_plain_node_has_what_discovery_shows_of_it() -> None:
    async def main(world: World) -> None:
        world.graph.endpoints = (replace(VIDEO, node="/it"),)
        await world.show("/it", "/_it_net", "/_ros2cli_1", "/other")
        assert [each.name for each in world.state.nodes()] == ["/it", "/other"]
        (end,) = world.state.publishers_of("/video")
        assert (end.node.name, end.endpoint.mapped, end.endpoint.gid) == ("/it", True, "")
        world.graph.endpoints = ()
        await world.show("/it")
        assert (world.state.publishers_of("/video"), world.state.node("/other")) == ((), None)

    in_world(main)


def test_a_node_that_left_is_not_back_because_discovery_still_shows_it() -> None:
    async def main(world: World) -> None:
        await world.show("/it")
        await world.say()
        await world.say(left=True)
        await world.show("/it", "/new")
        assert [each.name for each in world.state.nodes()] == ["/new"]

    in_world(main)


def test_a_node_that_is_not_shown_and_said_no_farewell_is_silent() -> None:
    async def main(world: World) -> None:
        await world.show("/it")
        await world.say()
        await world.show()
        assert [each.silent for each in world.state.nodes()] == [""]
        await asyncio.sleep(1.0)  # no farewell came
        assert [bool(each.silent) for each in world.state.nodes()] == [True]

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
        await asyncio.sleep(0.5)
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
        assert [each.name for each in world.state.nodes()] == ["/put"]
        world.state.drop_configuration("/put")
        assert (await world.observer.observe(plan("put"))).configurations == ()
        assert world.state.nodes() == ()

    in_world(main)
