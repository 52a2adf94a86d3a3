"""Layer 1 is a door: a broker, a bridge or no master at all, and layers 2 and 3 do not notice.

The transports here are users' programs, written against `GraphTransport` alone, for the systems
that *Topological Discovery and Communication Negotiation* imagines in "Graph Interface".
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

import pytest
from simulated import (
    PERIOD_S,
    SILENT_AFTER_S,
    ManualScheduler,
    Network,
    configuration,
    endpoint,
    every,
)

from lifecycle.graph.events import GraphEvents
from lifecycle.graph.reporter import GraphReporter
from lifecycle.graph.scheduler import Remove
from lifecycle.graph.state import GraphState
from lifecycle.graph.transport import GraphTransport
from lifecycle.verify.observation import NodeConfiguration

NODES = {
    "/a": configuration("/a", endpoint(0, "/foo")),
    "/b": configuration("/b", endpoint(0, "/foo"), endpoint(1, "/bar")),
}


class Master:
    """Each message goes to it alone; it hands it to everybody else."""

    def __init__(self, scheduler: ManualScheduler) -> None:
        self.scheduler = scheduler
        self.clients: list[MasterClient] = []
        self.relayed = 0

    def transport(self) -> MasterClient:
        self.clients.append(MasterClient(self))
        return self.clients[-1]

    def relay(self, sender: MasterClient, message: bytes) -> None:
        self.relayed += 1
        for client in self.clients:
            if client is not sender:
                self.scheduler.post(lambda client=client: client.arrive(message))

    def welcome(self, newcomer: MasterClient) -> None:
        for client in self.clients:
            if client is not newcomer:
                self.scheduler.post(client.peer_joined)


class MasterClient:
    """A node's one connection, to the master."""

    def __init__(self, master: Master) -> None:
        self._master = master
        self._callbacks: list[Callable[[bytes], None]] = []
        self._peer_callbacks: list[Callable[[], None]] = []

    def send(self, message: bytes) -> None:
        self._master.relay(self, message)

    def receive(self, callback: Callable[[bytes], None]) -> Remove:
        self._callbacks.append(callback)
        self._master.welcome(self)
        return lambda: self._callbacks.remove(callback)

    def on_peer(self, callback: Callable[[], None]) -> Remove:
        self._peer_callbacks.append(callback)
        return lambda: self._peer_callbacks.remove(callback)

    def close(self) -> None:
        self._master.clients.remove(self)

    def arrive(self, message: bytes) -> None:
        for callback in tuple(self._callbacks):
            callback(message)

    def peer_joined(self) -> None:
        for callback in tuple(self._peer_callbacks):
            callback()


def bridge(one: GraphTransport, other: GraphTransport) -> None:
    """Carry each message from either side to the other, and none of our own back."""
    ours: deque[bytes] = deque(maxlen=1000)

    def carry(to: GraphTransport) -> Callable[[bytes], None]:
        def arrived(message: bytes) -> None:
            if message in ours:
                ours.remove(message)
            else:
                ours.append(message)
                to.send(message)

        return arrived

    one.receive(carry(other))
    other.receive(carry(one))


class Ways:
    """How two nodes and two observers reach each other."""

    def __init__(self) -> None:
        self.scheduler = ManualScheduler()
        self.left: Callable[[], GraphTransport]
        self.right: Callable[[], GraphTransport]

    @classmethod
    def without_a_master(cls) -> Ways:
        ways = cls()
        ways.left = ways.right = Network(ways.scheduler).transport
        return ways

    @classmethod
    def with_a_master(cls) -> Ways:
        ways = cls()
        ways.left = ways.right = Master(ways.scheduler).transport
        return ways

    @classmethod
    def over_a_bridge(cls) -> Ways:
        ways = cls()
        networks = [Network(ways.scheduler) for _ in range(2)]
        bridge(*(each.transport() for each in networks))
        ways.left, ways.right = (each.transport for each in networks)
        return ways

    def start(self, name: str, transport: GraphTransport) -> GraphReporter:
        truth = NODES[name]
        reporter = GraphReporter(
            transport, name, every=every(self.scheduler), period_s=PERIOD_S, incarnation="1"
        )
        reporter.joined(truth.state, connected=truth.connected, checksum=truth.checksum)
        return reporter

    def observe(self, transport: GraphTransport) -> GraphState:
        events = GraphEvents(
            transport, self.scheduler, silent_after_s=SILENT_AFTER_S, forget_after_s=60.0
        )
        return GraphState(events, self._fetch)

    def _fetch(self, name: str, done: Callable[[NodeConfiguration | None], None]) -> None:
        self.scheduler.post(lambda: done(NODES[name]))


WAYS = pytest.mark.parametrize(
    "ways", [Ways.without_a_master, Ways.with_a_master, Ways.over_a_bridge]
)


@WAYS
def test_everybody_keeps_the_same_state_of_the_graph(ways: Callable[[], Ways]) -> None:
    world = ways()
    here, there = world.observe(world.left()), world.observe(world.right())
    world.start("/a", world.left())
    leaving = world.start("/b", world.right())
    world.scheduler.advance(0.1)
    assert here.nodes() == there.nodes()
    for state in (here, there):
        assert [end.node.name for end in state.publishers_of("/foo")] == ["/a", "/b"]
    leaving.left("asked to")
    world.scheduler.advance(0.1)
    for state in (here, there):
        assert [end.node.name for end in state.publishers_of("/foo")] == ["/a"]


@WAYS
def test_who_joins_late_is_told_at_the_next_heartbeat(ways: Callable[[], Ways]) -> None:
    world = ways()
    world.start("/a", world.left())
    world.start("/b", world.right())
    world.scheduler.advance(60.0)
    late = world.observe(world.right())
    world.scheduler.advance(PERIOD_S)
    assert [each.name for each in late.nodes()] == ["/a", "/b"]


@WAYS
def test_what_changes_is_told_to_everybody_through_any_transport(ways: Callable[[], Ways]) -> None:
    world = ways()
    states = world.observe(world.left()), world.observe(world.right())
    reporter = world.start("/a", world.left())
    reporter.state_changed("active", connected=True)
    reporter.connection_established("net", ("shm://",))
    world.scheduler.advance(0.1)
    for state in states:
        node = state.node("/a")
        assert node is not None
        assert node.state == "active"
        assert [each.name for each in state.connections_of("/a")] == ["net"]


def test_with_a_master_each_message_is_sent_once_to_it() -> None:
    scheduler = ManualScheduler()
    master = Master(scheduler)
    world = Ways()
    world.scheduler = scheduler
    observers = [world.observe(master.transport()) for _ in range(3)]
    world.start("/a", master.transport()).state_changed("active", connected=True)
    scheduler.advance(0.1)
    assert master.relayed == 2
    assert {state.node("/a") is not None for state in observers} == {True}
