"""The authority: what it tells each node, in which order, and that what is lost is made again."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Mapping
from pathlib import Path

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
from lifecycle.supervisor.connections import authority
from lifecycle.supervisor.connections.authority import ConnectionAuthority
from lifecycle.supervisor.connections.instructions import (
    Instructions,
    NegotiatedSource,
    by_plan,
    steps,
    wired,
)
from lifecycle.supervisor.control.protocol import ControlRequest
from lifecycle.supervisor.run.events import Failure, Notice, WiringChanged
from lifecycle.verify.observation import NodeConfiguration, Observation
from tests.builders import plan_of, planned_endpoint, planned_node
from tests.unit.supervisor.fakes import interface_of, rewired
from tests.unit.supervisor.session_world import SessionWorld

URL = "udpv4://127.0.0.1:7911"
NET = ParticipantConnections(urls=(URL,))
CONNECT, MAP, DISCONNECT = Operation.CONNECT_TO, Operation.MAP_TO, Operation.DISCONNECT_FROM


def wired_node(key: str, *, after: Mapping[str, Condition] = {}) -> PlannedNode:
    """A node whose publisher goes by `net` and whose subscription by its own participant."""
    net = PlannedParticipant(
        name=f"_{key}_net", dscp=None, reason="", connection="net", connections=NET
    )
    return replace(
        planned_node(key, after=after),
        authority=Authority.SUPERVISOR,
        endpoints=(
            planned_endpoint(EndpointKind.PUBLISHER, "out", participant=net.name),
            planned_endpoint(EndpointKind.SUBSCRIPTION, "in", participant=""),
        ),
        participants=(net,),
    )


def wired_plan(*nodes: PlannedNode, **layer: object) -> Plan:
    return replace(
        plan_of(*nodes),
        data_layer=DataLayer(authority=Authority.SUPERVISOR, **layer),  # type: ignore[arg-type]
    )


class ChangingSource(NegotiatedSource):
    """Instructions that a test changes, as a negotiation would."""

    def __init__(self, plan: Plan) -> None:
        super().__init__(plan)
        self.now = dict(by_plan(plan))
        self.next: tuple[str, ...] = ()

    def instructions(self, known: Mapping[str, NodeConfiguration]) -> Mapping[str, Instructions]:
        self.problems = self.next
        return self.now


class Wiring(SessionWorld):
    """A run whose supervisor connects its nodes as a test says."""

    def __init__(self, plan: Plan, directory: Path) -> None:
        super().__init__(plan, directory)
        self.source = ChangingSource(plan)
        for node in plan.nodes:
            self.hosts.interfaces[node.full_name] = interface_of(
                node.full_name, "publishers/out", "subscriptions/in"
            )

        def prepare() -> None:
            self.authority._negotiated = self.source

        self.prepare = prepare

    @property
    def authority(self) -> ConnectionAuthority:
        assert self.supervisor.authority is not None
        return self.supervisor.authority

    @contextlib.asynccontextmanager
    async def connected(self) -> AsyncIterator[None]:
        """Run to its end; the body acts once all nodes are connected."""
        async with self.running("[system] connected"):
            yield
            await self.order(ControlRequest.DOWN)

    def told(self, node: str) -> list[str]:
        """What a hosted node was asked, in order."""
        lines = (each.partition(" ")[2] for each in self.story if each.startswith(f"{node} "))
        return [each for each in lines if not each.startswith("get_")]

    def report(self, node: str) -> None:
        """Let the host tell that the node's configuration changed."""
        configuration = self.hosts.interfaces[node]
        self.system.on_host_event(
            HostEvent(kind="configuration", node=node, configuration=configuration)
        )

    def lose(self, node: str, connection: str) -> None:
        """Take a connection away from a hosted node, and let the host tell."""
        interfaces = self.hosts.interfaces
        interfaces[node] = rewired(interfaces[node], DISCONNECT, connection=connection)
        self.report(node)

    def look(self) -> None:
        """Let the authority see what is there."""
        self.authority.look(Observation())


async def settle(seconds: float = 0.0) -> None:
    """Let everything happen that happens within so long; the clock jumps."""
    await asyncio.sleep(seconds)
    for _ in range(50):
        await asyncio.sleep(0.0001)


async def test_a_node_is_connected_and_mapped_between_configure_and_connect(tmp_path: Path) -> None:
    wiring = Wiring(wired_plan(wired_node("a")), tmp_path)
    async with wiring.connected():
        assert wiring.told("/a") == [
            "configure",
            "connect_to net",
            "map_to publishers/out net",
            "map_to subscriptions/in",
            "connect",
        ]
    assert wiring.told("/a")[5:] == ["disconnect_from net", "disconnect", "cleanup", "shutdown"]
    assert [
        (each.operation, each.connection, each.endpoint, each.urls, each.error)
        for each in wiring.heard(WiringChanged)[:3]
    ] == [
        (CONNECT, "net", "", (URL,), ""),
        (MAP, "net", "publishers/out", (), ""),
        (MAP, "", "subscriptions/in", (), ""),
    ]


async def test_an_endpoint_that_cannot_be_mapped_ends_bring_up_with_its_node_and_reason(
    tmp_path: Path,
) -> None:
    wiring = Wiring(wired_plan(wired_node("a")), tmp_path)
    why = "the address is not of this host"
    wiring.hosts.ways["/a map_to publishers/out net"] = why
    await wiring.run()
    (failure,) = wiring.heard(Failure)
    message = f"cannot map 'publishers/out' of '/a' to connection 'net': {why}"
    assert (failure.rule, failure.subject, failure.message) == ("run.not-wired", "/a", message)
    assert [each.error for each in wiring.heard(WiringChanged) if each.error] == [message]
    assert "connect" not in wiring.told("/a")


async def test_a_negotiation_waits_until_everybody_is_configured(tmp_path: Path) -> None:
    plan = wired_plan(wired_node("a"), wired_node("b"), source=DataLayerSource.DYNAMIC)
    wiring = Wiring(plan, tmp_path)
    wiring.hosts.takes_s["/b configure"] = 3.0
    async with wiring.connected():
        log = wiring.story
        assert log.index("/b configure") < log.index("/a connect_to net")


async def test_a_negotiation_does_not_wait_for_what_waits_for_a_connection(tmp_path: Path) -> None:
    plain = replace(planned_node("plain", after={"a": Condition.CONNECTED}), managed=False)
    late = wired_node("late", after={"plain": Condition.STARTED})
    plan = wired_plan(wired_node("a"), plain, late, source=DataLayerSource.DYNAMIC)
    wiring = Wiring(plan, tmp_path)
    async with wiring.connected():
        steps_ = ["/a connect", "plain start", "/late configure", "/late connect"]
        assert [each for each in wiring.story if each in steps_] == steps_


async def test_what_cannot_be_made_again_is_a_finding_and_tried_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(authority, "AGAIN_S", 0.1)
    wiring = Wiring(wired_plan(wired_node("a"), events=True), tmp_path)
    async with wiring.connected():
        await settle()
        wiring.hosts.ways["/a connect_to net"] = "port 7911 is taken"
        wiring.lose("/a", "net")
        wiring.look()
        await wiring.story.until("[verdict] connected violated run.not-wired")
        (finding,) = wiring.authority.findings()
        assert (finding.rule, finding.subject) == ("run.not-wired", "/a")
        assert finding.message == f"cannot connect '/a' to 'net' ({URL}): port 7911 is taken"
        del wiring.hosts.ways["/a connect_to net"]  # the port comes free
        await asyncio.sleep(0.3)
        assert wiring.authority.findings() == ()
        assert dict(wired(wiring.hosts.interfaces["/a"]).connections) == {"net": NET}
        tried = [each.attempt for each in wiring.heard(WiringChanged) if each.operation is CONNECT]
        assert tried == [1, 1, 2]


async def test_only_the_difference_is_wired_when_the_negotiation_changes(tmp_path: Path) -> None:
    plan = wired_plan(wired_node("a"), wired_node("b"), source=DataLayerSource.DYNAMIC)
    wiring = Wiring(plan, tmp_path)
    async with wiring.connected():
        await settle()
        before = {node: len(wiring.told(node)) for node in ("/a", "/b")}
        group = ParticipantConnections(urls=("udpm://239.255.1.1:7900",))
        wiring.source.now["/b"] = replace(
            wiring.source.now["/b"],
            connections=(("group", group),),
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


async def test_it_is_at_work_until_what_a_node_reports_already_is_done(tmp_path: Path) -> None:
    plan = wired_plan(wired_node("a"), source=DataLayerSource.DYNAMIC)
    wiring = Wiring(plan, tmp_path)
    async with wiring.connected():
        await settle()
        assert not wiring.authority.is_at_work()
        wiring.source.now["/a"] = replace(
            wiring.source.now["/a"], mappings=(("publishers/out", ""), ("subscriptions/in", ""))
        )
        wiring.hosts.takes_s["/a map_to publishers/out"] = 2.0
        wiring.look()
        await settle(1.0)
        # As a node does whose old endpoint stays until its peers have found the new one.
        interfaces = wiring.hosts.interfaces
        interfaces["/a"] = rewired(interfaces["/a"], MAP, endpoint="publishers/out", connection="")
        wiring.report("/a")
        wiring.look()
        assert wiring.authority.is_at_work()
        await settle(2.0)
        wiring.look()
        await settle()
        assert not wiring.authority.is_at_work()


async def test_a_negotiation_that_fails_while_running_is_a_finding_until_it_succeeds(
    tmp_path: Path,
) -> None:
    wiring = Wiring(wired_plan(wired_node("a"), source=DataLayerSource.DYNAMIC), tmp_path)
    async with wiring.connected():
        why = "cannot link /a → /b on /out: /a has shm; /b has udpv4"
        wiring.source.next = (why,)
        wiring.look()
        wiring.look()
        (finding,) = wiring.authority.findings()
        assert finding.message == why
        assert wiring.heard(Notice).count(Notice(message=why)) == 1
        wiring.source.next = ()
        wiring.look()
        assert wiring.authority.findings() == ()


def test_steps_make_before_they_break_and_spare_what_is_not_ours() -> None:
    wanted = Instructions(
        node="/a",
        connections=(("new", NET),),
        mappings=(("publishers/out", "new"), ("subscriptions/in", "")),
    )
    has = Instructions(
        node="/a",
        connections=(("old", NET), ("own", NET)),
        mappings=(("publishers/out", "old"), ("subscriptions/in", "")),
    )
    made = steps(wanted, has, ours=("old",))
    assert [(each.operation, each.connection, each.endpoint) for each in made] == [
        (CONNECT, "new", ""),
        (MAP, "new", "publishers/out"),
        (DISCONNECT, "old", ""),
    ]
