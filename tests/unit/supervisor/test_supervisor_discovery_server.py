"""The discovery server: when it counts as started, and what is said when it does not."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest
from msgspec.structs import replace

from lifecycle.network.connection_url import parse
from lifecycle.plan.model import ParticipantConnections, Plan, PlannedServer
from lifecycle.supervisor.connections import discovery_server
from lifecycle.supervisor.nodes.system import System
from lifecycle.supervisor.processes.process import ProcessExit
from lifecycle.supervisor.run.events import Event, StepFailedError
from lifecycle.supervisor.run.options import observer_connections, onlooker_connections
from tests.builders import plan_of, planned_node
from tests.unit.supervisor.fakes import FakeForkServer, World

REAL_TIME = True


@pytest.fixture
def listener() -> Iterator[socket.socket]:
    """Something that can listen, as the server would."""
    with socket.socket() as server:
        server.bind(("127.0.0.1", 0))
        yield server


@pytest.fixture
def nobody() -> int:
    """A port at which nobody listens."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        return int(server.getsockname()[1])


def served(port: int, machine: str = "") -> Plan:
    server = PlannedServer(machine=machine, address="127.0.0.1", port=port)
    return replace(plan_of(planned_node("a")), server=server)


def world(plan: Plan, directory: Path) -> tuple[System, FakeForkServer]:
    made = World(plan, directory)
    return made.system, made.hosts


async def test_a_port_that_somebody_has_is_refused_before_the_server_seems_to_run(
    tmp_path: Path, listener: socket.socket
) -> None:
    listener.listen()
    port = listener.getsockname()[1]

    system, spawner = world(served(port), tmp_path)
    with pytest.raises(StepFailedError) as caught:
        await discovery_server.begin(system, spawner)
    assert system.server is None
    assert caught.value.message == (
        f"cannot start the discovery server at tcp 127.0.0.1:{port}: that port is not free on "
        "this host; end who has it (`ss -lnp`), or choose another 'discovery: first_port'"
    )


async def test_one_that_ends_at_once_says_how(tmp_path: Path, nobody: int) -> None:
    system, spawner = world(served(nobody), tmp_path)
    spawner.changed = lambda: spawner.processes["discovery_server"].end(ProcessExit(status=1))
    with pytest.raises(StepFailedError) as caught:
        await discovery_server.begin(system, spawner)
    said: list[Event] = []
    system.emit.listen(said.append)
    for _ in range(2):
        await discovery_server.end(system, asyncio.Event())
    assert [each.kind for each in said] == ["process"]
    assert (caught.value.failure.rule, caught.value.failure.subject) == (
        "run.start-failed",
        "discovery_server",
    )
    assert caught.value.message == (
        f"cannot start the discovery server at tcp 127.0.0.1:{nobody}: exit status 1"
    )


async def test_the_server_of_another_machine_is_waited_for_with_a_deadline(
    tmp_path: Path, nobody: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(discovery_server, "START_S", 0.1)

    system, spawner = world(served(nobody, "base"), tmp_path)
    with pytest.raises(StepFailedError) as caught:
        await discovery_server.begin(system, spawner)
    assert caught.value.failure.rule == "run.deadline"
    assert caught.value.message == (
        "cannot reach the discovery server of machine 'base', whose supervisor starts it, at "
        f"tcp 127.0.0.1:{nobody}: nobody listened for 0.1 s"
    )
    assert spawner.processes == {}


async def test_the_server_of_another_machine_may_come_later(
    tmp_path: Path, listener: socket.socket
) -> None:
    listener.listen()
    system, spawner = world(served(listener.getsockname()[1], "base"), tmp_path)
    await discovery_server.begin(system, spawner)
    assert system.server is None
    assert spawner.processes == {}


def observed(*urls: str, nodes: tuple[str, ...] = ()) -> Plan:
    plan = plan_of(planned_node("a"))
    node = replace(plan.nodes[0], connections=ParticipantConnections(urls=nodes))
    return replace(plan, nodes=(node,), observers=(("", ParticipantConnections(urls=urls)),))


def test_an_onlooker_is_connected_like_the_supervisor_but_on_free_ports() -> None:
    url = "udpv4://127.0.0.1:7912?metatraffic_port=7911&output_port=7913&peer=127.0.0.1:7920"
    plan = observed(url + "&multicast=off")
    (mine,) = onlooker_connections(plan).urls
    parsed = parse(mine)
    assert (parsed.port, parsed.metatraffic_port, parsed.output_port) == (None, None, None)
    assert [str(each) for each in parsed.peers] == ["127.0.0.1:7920"]
    assert not parsed.multicast
    assert observer_connections(plan).urls == (url + "&multicast=off",)


def test_an_onlooker_dials_everybody_who_listens_for_tcp() -> None:
    """Nodes know the supervisor's port and dial it; nobody knows an onlooker's."""
    nodes = ("tcpv4://127.0.0.1:7920?peer=127.0.0.1:7912",)
    plan = observed("tcpv4://127.0.0.1:7912", nodes=nodes)
    assert onlooker_connections(plan).urls == ("tcpv4://127.0.0.1?peer=127.0.0.1:7920",)
    served = observed("tcpv4://127.0.0.1:7912?server=127.0.0.1:7900", nodes=nodes)
    assert onlooker_connections(served).urls == ("tcpv4://127.0.0.1?server=127.0.0.1:7900",)


def test_nodes_that_have_shared_memory_alone_are_looked_at_by_it_alone() -> None:
    mixed = ("shm://", "udpv4://")
    assert observer_connections(observed(*mixed, nodes=("shm://",))).urls == ("shm://",)
    assert observer_connections(observed(*mixed, nodes=("udpv4://",))).urls == mixed
