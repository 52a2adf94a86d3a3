"""The authority: what it tells each node, in which order, and that what is lost is made again."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from pathlib import Path
from types import SimpleNamespace

import pytest
from msgspec.structs import replace

from lifecycle.manifest.model import (
    Authority,
    Condition,
    DataLayer,
    DataLayerSource,
    EndpointKind,
)
from lifecycle.node.host.control import Event as HostEvent
from lifecycle.node.host.control import Operation
from lifecycle.plan.model import (
    ParticipantConnections,
    Plan,
    PlannedNode,
    PlannedParticipant,
)
from lifecycle.supervisor.connections.authority import (
    TRIES,
    ConnectionAuthority,
    PlannedSource,
)
from lifecycle.supervisor.connections.desired_state import (
    ActualState,
    Instructions,
    steps,
    wired,
)
from lifecycle.supervisor.nodes.bring_up import BringUp
from lifecycle.supervisor.run.events import Notice, WiringChanged
from lifecycle.supervisor.run.failure import StepFailedError
from lifecycle.supervisor.run.shutdown import TakeDown
from lifecycle.verify.observation import NodeConfiguration, Observation
from tests.builders import plan_of, planned_endpoint, planned_node
from tests.unit.supervisor.fakes import World, interface_of, rewired

LIMIT_S = 30.0
URL = "udpv4://127.0.0.1:7911"
NET = ParticipantConnections(urls=(URL,))
CONNECT, MAP, DISCONNECT = Operation.CONNECT_TO, Operation.MAP_TO, Operation.DISCONNECT_FROM


def wired_node(key: str, *, after: Mapping[str, Condition] = {}) -> PlannedNode:
    """A node whose publisher goes by `net` and whose subscription by its own participant."""
    endpoints = tuple(
        planned_endpoint(kind, name, participant=participant)
        for kind, name, participant in (
            (EndpointKind.PUBLISHER, "out", f"_{key}_net"),
            (EndpointKind.SUBSCRIPTION, "in", ""),
        )
    )
    return replace(
        planned_node(key, after=after),
        authority=Authority.SUPERVISOR,
        endpoints=endpoints,
        participants=(
            PlannedParticipant(
                name=f"_{key}_net", dscp=None, reason="", connection="net", connections=NET
            ),
        ),
    )


def wired_plan(*nodes: PlannedNode, **layer: object) -> Plan:
    return replace(
        plan_of(*nodes),
        data_layer=DataLayer(authority=Authority.SUPERVISOR, **layer),  # type: ignore[arg-type]
    )


class ChangingSource(PlannedSource):
    """Instructions that a test changes, as a negotiation would."""

    def __init__(self, plan: Plan) -> None:
        super().__init__(plan)
        self.now = dict(super().instructions({}))
        self.known: list[frozenset[str]] = []
        self.next: tuple[str, ...] = ()

    def instructions(self, known: Mapping[str, NodeConfiguration]) -> Mapping[str, Instructions]:
        self.known.append(frozenset(known))
        self.problems = self.next
        return self.now


class Wiring:
    """A world whose bring-up has an authority."""

    def __init__(self, plan: Plan, directory: Path) -> None:
        self.world = World(plan, directory)
        self.source = ChangingSource(plan)
        self.authority = ConnectionAuthority(
            self.world.system,
            self.source,
            self.world.emit,
            SimpleNamespace(  # type: ignore[arg-type]
                node_interface=lambda name: pytest.fail(f"{name} is nobody that is known")
            ),
        )
        self.world.bring_up = BringUp(
            self.world.system,
            spawner_of=lambda _: self.world.spawner,
            services=lambda _: pytest.fail("nobody is driven through services"),
            appears=lambda _: asyncio.sleep(0),
            recorded=lambda: None,
            wirer=self.authority,
        )
        for node in plan.nodes:
            self.world.spawner.interfaces[node.full_name] = interface_of(
                node.full_name, "publishers/out", "subscriptions/in"
            )

    def told(self, node: str) -> list[str]:
        """What a hosted node was asked, in order."""
        return [each.partition(" ")[2] for each in self.world.log if each.startswith(node)]

    def report(self, node: str) -> None:
        """Let the host tell that the node's configuration changed."""
        configuration = self.world.spawner.interfaces[node]
        self.world.system.on_host_event(
            HostEvent(kind="configuration", node=node, configuration=configuration)
        )

    def lose(self, node: str, connection: str) -> None:
        """Take a connection away from a hosted node, and let the host tell."""
        interfaces = self.world.spawner.interfaces
        interfaces[node] = rewired(interfaces[node], DISCONNECT, connection=connection)
        self.report(node)

    def look(self, *others: NodeConfiguration) -> None:
        """Let the authority see what is there."""
        self.authority.look(Observation(configurations=others))

    async def down(self) -> None:
        await self.authority.close()
        await self.world.bring_up.close()
        await TakeDown(self.world.system, self.world.emit, asyncio.Event()).run()


async def settle(seconds: float = 0.0) -> None:
    """Let everything happen that happens within so long; the clock jumps."""
    await asyncio.sleep(seconds)
    for _ in range(50):
        await asyncio.sleep(0.0001)


async def test_a_node_is_connected_and_mapped_between_configure_and_connect(tmp_path: Path) -> None:
    wiring = Wiring(wired_plan(wired_node("a")), tmp_path)
    await wiring.world.bring_up.connect(LIMIT_S)
    assert wiring.told("/a") == [
        "configure",
        "get_configuration",
        "connect_to net",
        "map_to publishers/out net",
        "map_to subscriptions/in",
        "connect",
    ]
    assert [
        (each.operation, each.connection, each.endpoint, each.urls, each.error)
        for each in wiring.world.heard(WiringChanged)
    ] == [
        (CONNECT, "net", "", (URL,), ""),
        (MAP, "net", "publishers/out", (), ""),
        (MAP, "", "subscriptions/in", (), ""),
    ]
    await wiring.down()


@pytest.mark.parametrize(
    ("what", "message"),
    [
        (
            "/a connect_to net",
            f"cannot connect '/a' to 'net' ({URL}): the address is not of this host",
        ),
        (
            "/a map_to publishers/out net",
            (
                "cannot map 'publishers/out' of '/a' to connection 'net': "
                "the address is not of this host"
            ),
        ),
    ],
)
async def test_a_failed_step_ends_bring_up_and_names_node_connection_endpoint_and_reason(
    tmp_path: Path, what: str, message: str
) -> None:
    wiring = Wiring(wired_plan(wired_node("a")), tmp_path)
    wiring.world.spawner.ways[what] = "the address is not of this host"
    with pytest.raises(StepFailedError) as caught:
        await wiring.world.bring_up.connect(LIMIT_S)
    assert (caught.value.rule.id, caught.value.subject) == ("run.not-wired", "/a")
    assert caught.value.message == message
    assert wiring.world.heard(WiringChanged)[-1].error == message
    assert "connect" not in wiring.told("/a")
    await wiring.down()


async def test_a_negotiation_waits_until_everybody_is_configured(tmp_path: Path) -> None:
    plan = wired_plan(wired_node("a"), wired_node("b"), source=DataLayerSource.DYNAMIC)
    wiring = Wiring(plan, tmp_path)
    wiring.world.spawner.takes_s["/b configure"] = 3.0
    await wiring.world.bring_up.connect(LIMIT_S)
    log = wiring.world.log
    assert log.index("/b configure") < log.index("/a connect_to net")
    await wiring.down()


async def test_a_negotiation_does_not_wait_for_what_waits_for_a_connection(tmp_path: Path) -> None:
    late = wired_node("late", after={"plain": Condition.STARTED})
    plain = replace(planned_node("plain", after={"a": Condition.CONNECTED}), managed=False)
    plan = wired_plan(wired_node("a"), plain, late, source=DataLayerSource.DYNAMIC)
    wiring = Wiring(plan, tmp_path)
    await wiring.world.bring_up.connect(LIMIT_S)
    log = wiring.world.log
    assert log.index("/a connect") < log.index("plain start") < log.index("/late configure")
    assert "/late connect" in log
    await wiring.down()


async def test_what_cannot_be_made_again_is_tried_ever_later_and_then_a_finding(
    tmp_path: Path,
) -> None:
    wiring = Wiring(wired_plan(wired_node("a"), events=True), tmp_path)
    await wiring.world.bring_up.connect(LIMIT_S)
    wiring.report("/a")
    wiring.look()
    await settle()
    wiring.world.spawner.ways["/a connect_to net"] = "port 7911 is taken"
    wiring.lose("/a", "net")
    wiring.look()
    loop = asyncio.get_running_loop()
    began = loop.time()
    await settle(60.0)
    failed = [each for each in wiring.world.heard(WiringChanged) if each.error]
    assert [each.attempt for each in failed] == list(range(1, TRIES + 1))
    assert loop.time() - began < 61.0
    (finding,) = wiring.authority.findings()
    assert (finding.rule, finding.subject) == ("run.not-wired", "/a")
    assert finding.message == f"cannot connect '/a' to 'net' ({URL}): port 7911 is taken"
    # The port comes free; the node tells of something: it is tried anew.
    del wiring.world.spawner.ways["/a connect_to net"]
    wiring.lose("/a", "other")
    wiring.look()
    await settle()
    assert wiring.authority.findings() == ()
    assert dict(wired(wiring.world.spawner.interfaces["/a"]).connections) == {"net": (URL,)}
    await wiring.down()


async def test_only_the_difference_is_wired_when_the_negotiation_changes(tmp_path: Path) -> None:
    plan = wired_plan(wired_node("a"), wired_node("b"), source=DataLayerSource.DYNAMIC)
    wiring = Wiring(plan, tmp_path)
    await wiring.world.bring_up.connect(LIMIT_S)
    for node in ("/a", "/b"):
        wiring.report(node)
    wiring.look()
    await settle()
    before = {node: len(wiring.told(node)) for node in ("/a", "/b")}
    wiring.source.now["/b"] = replace(
        wiring.source.now["/b"],
        connections=(("group", ParticipantConnections(urls=("udpm://239.255.1.1:7900",))),),
        mappings=(("publishers/out", "group"), ("subscriptions/in", "")),
    )
    wiring.look()
    await settle()
    assert wiring.told("/a")[before["/a"] :] == []
    assert wiring.told("/b")[before["/b"] :] == [
        "connect_to group",
        "map_to publishers/out group",
        "disconnect_from net",
    ]
    await wiring.down()


async def test_it_is_at_work_until_what_a_node_reports_already_is_done(tmp_path: Path) -> None:
    plan = wired_plan(wired_node("a"), source=DataLayerSource.DYNAMIC)
    wiring = Wiring(plan, tmp_path)
    await wiring.world.bring_up.connect(LIMIT_S)
    wiring.report("/a")
    wiring.look()
    await settle()
    assert not wiring.authority.is_at_work()
    wiring.source.now["/a"] = replace(
        wiring.source.now["/a"], mappings=(("publishers/out", ""), ("subscriptions/in", ""))
    )
    wiring.world.spawner.takes_s["/a map_to publishers/out"] = 2.0
    wiring.look()
    await settle(1.0)
    # As a node does whose old endpoint stays until its peers have found the new one.
    interfaces = wiring.world.spawner.interfaces
    interfaces["/a"] = rewired(interfaces["/a"], MAP, endpoint="publishers/out", connection="")
    wiring.report("/a")
    wiring.look()
    assert wiring.authority.is_at_work()
    await settle(2.0)
    wiring.look()
    await settle()
    assert not wiring.authority.is_at_work()
    await wiring.down()


async def test_a_negotiation_that_fails_while_running_is_a_finding_until_it_succeeds(
    tmp_path: Path,
) -> None:
    wiring = Wiring(wired_plan(wired_node("a"), source=DataLayerSource.DYNAMIC), tmp_path)
    await wiring.world.bring_up.connect(LIMIT_S)
    wiring.source.next = ("cannot link /a → /b on /out: /a has shm; /b has udpv4",)
    wiring.look()
    wiring.look()
    (finding,) = wiring.authority.findings()
    assert finding.message == wiring.source.next[0]
    assert wiring.world.heard(Notice) == [Notice(message=wiring.source.next[0])]
    wiring.source.next = ()
    wiring.look()
    assert wiring.authority.findings() == ()
    await wiring.down()


def test_steps_make_before_they_break_and_spare_what_is_not_ours() -> None:
    wanted = Instructions(
        node="/a",
        connections=(("new", NET),),
        mappings=(("publishers/out", "new"), ("subscriptions/in", "")),
    )
    has = ActualState(
        connections=(("old", (URL,)), ("own", (URL,))),
        mappings=(("publishers/out", "old"), ("subscriptions/in", "")),
    )
    made = steps(wanted, has, ours=("old",))
    assert [(each.operation, each.connection, each.endpoint) for each in made] == [
        (CONNECT, "new", ""),
        (MAP, "new", "publishers/out"),
        (DISCONNECT, "old", ""),
    ]
    for step in made:
        has = has.after(step)
    assert steps(wanted, has, ours=("new",)) == ()
