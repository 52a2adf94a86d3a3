"""A simulated system whose nodes are reported through the real reporters, over a bad network."""

from __future__ import annotations

import dataclasses
import heapq
import itertools
import random
from collections import deque
from collections.abc import Callable, Iterable
from typing import Any

from lifecycle.graph.events import GraphEvents
from lifecycle.graph.reporter import GraphReporter
from lifecycle.graph.scheduler import Remove, Scheduler
from lifecycle.graph.state import Fetch, GraphState
from lifecycle.manifest.model import EndpointKind
from lifecycle.node.configuration import checksum
from lifecycle.verify.observation import EndpointReport, NodeConfiguration
from lifecycle.verify.outcome import ConnectionReport
from tests import builders

PERIOD_S = 2.0
SILENT_AFTER_S = 7.0
ANSWER_S = 0.03
TIMEOUT_S = 1.0
KINDS = (EndpointKind.PUBLISHER, EndpointKind.SUBSCRIPTION, EndpointKind.SERVICE_SERVER)


class ManualScheduler:
    """Time that moves only by `advance`; what is posted runs at once, or after what runs now."""

    def __init__(self) -> None:
        self._now_s = 0.0
        self._timers: list[tuple[float, int, list[Callable[[], None]]]] = []
        self._count = itertools.count()
        self._posted: deque[Callable[[], None]] = deque()
        self._running = False

    def now_s(self) -> float:
        return self._now_s

    def post(self, work: Callable[[], None]) -> None:
        self._posted.append(work)
        if self._running:
            return
        self._running = True
        try:
            while self._posted:
                self._posted.popleft()()
        finally:
            self._running = False
            self._posted.clear()

    def call_at(self, when_s: float, work: Callable[[], None]) -> Remove:
        entry = [work]
        heapq.heappush(self._timers, (when_s, next(self._count), entry))
        return entry.clear

    def advance(self, seconds: float) -> None:
        end_s = self._now_s + seconds
        while self._timers and self._timers[0][0] <= end_s:
            due_s, _, entry = heapq.heappop(self._timers)
            if entry:
                self._now_s = max(self._now_s, due_s)
                self.post(entry.pop())
        self._now_s = end_s


def every(scheduler: Scheduler) -> Callable[[float, Callable[[], None]], Remove]:
    """Return a periodic timer that runs in `scheduler`."""

    def start(period_s: float, work: Callable[[], None]) -> Remove:
        cancel: list[Remove] = []

        def run() -> None:
            cancel[:] = [scheduler.call_at(scheduler.now_s() + period_s, run)]
            work()

        cancel.append(scheduler.call_at(scheduler.now_s() + period_s, run))
        return lambda: [each() for each in cancel] and None

    return start


class Network:
    """Carries messages between its transports; it can lose, double, delay and part them."""

    def __init__(self, scheduler: Scheduler, seed: int = 0) -> None:
        self.scheduler = scheduler
        self.loss = self.duplication = 0.0
        self.delay_s = (0.0, 0.0)
        self.transports: list[Transport] = []
        self.islands: dict[Transport, int] = {}
        self.chance = random.Random(seed)

    def transport(self) -> Transport:
        self.transports.append(Transport(self))
        return self.transports[-1]

    def partition(self, *groups: Iterable[Transport]) -> None:
        self.islands = {each: number for number, group in enumerate(groups, 1) for each in group}

    def heal(self) -> None:
        parted, self.islands = self.islands, {}
        if parted:
            self.meet(self.transports)

    def together(self, one: Transport, other: Transport) -> bool:
        return self.islands.get(one) == self.islands.get(other)

    def meet(self, transports: Iterable[Transport]) -> None:
        for each in tuple(transports):
            self.scheduler.post(lambda each=each: [call() for call in tuple(each.met)] and None)

    def carry(self, sender: Transport, message: bytes) -> None:
        for receiver in [each for each in self.transports if self.together(each, sender)]:
            for _ in range(1 + (self.chance.random() < self.duplication)):
                if not receiver.calls or self.chance.random() < self.loss:
                    continue
                arrive = lambda receiver=receiver: receiver.arrive(message)  # noqa: E731
                due_s = self.scheduler.now_s() + self.chance.uniform(*self.delay_s)
                if self.delay_s[1]:
                    self.scheduler.call_at(due_s, arrive)
                else:
                    self.scheduler.post(arrive)


class Transport:
    """A `GraphTransport`."""

    def __init__(self, network: Network) -> None:
        self.network = network
        self.calls: list[Callable[[bytes], None]] = []
        self.met: list[Callable[[], None]] = []

    def send(self, message: bytes) -> None:
        if self in self.network.transports:
            self.network.carry(self, message)

    def receive(self, callback: Callable[[bytes], None]) -> Remove:
        self.calls.append(callback)
        self.network.meet(
            each
            for each in self.network.transports
            if each is not self and self.network.together(each, self)
        )
        return lambda: self.calls.remove(callback)

    def on_peer(self, callback: Callable[[], None]) -> Remove:
        self.met.append(callback)
        return lambda: self.met.remove(callback) if callback in self.met else None

    def arrive(self, message: bytes) -> None:
        for call in tuple(self.calls):
            call(message)

    def close(self) -> None:
        self.calls.clear()
        self.network.transports.remove(self)


def endpoint(number: int, topic: str, kind: EndpointKind = KINDS[0]) -> EndpointReport:
    return EndpointReport(
        kind=kind,
        name=f"e{number}",
        resolved=topic,
        type="std_msgs/msg/String",
        mapped=True,
        matched=0,
    )


def configuration(name: str, *endpoints: EndpointReport, **rest: Any) -> NodeConfiguration:
    """What a node says of itself, with its checksum."""
    made = builders.configuration(name, *endpoints, **rest)
    return dataclasses.replace(made, checksum=checksum(made))


class SimulatedNode:
    """One instance of a node: it changes, and its reporter tells."""

    def __init__(self, system: System, name: str, instance: int, endpoints: int) -> None:
        self.system = system
        self.name = name
        self.transport = system.network.transport()
        self.truth = configuration(
            name,
            *(
                endpoint(number, f"/t{(instance + number) % 50}", KINDS[number % len(KINDS)])
                for number in range(endpoints)
            ),
            process_id=instance,
        )
        self._made = endpoints
        self.reporter = GraphReporter(
            self.transport,
            name,
            every=every(system.scheduler),
            period_s=PERIOD_S,
            incarnation=f"{instance:06d}",
        )
        self.reporter.joined(
            self.truth.state, connected=self.truth.connected, checksum=self.truth.checksum
        )

    def change_state(self, state: str) -> None:
        self.truth = dataclasses.replace(self.truth, state=state)
        self.reporter.state_changed(state, connected=True)

    def add_endpoint(self, topic: str) -> None:
        self._made += 1
        self._configure(endpoints=(*self.truth.endpoints, endpoint(self._made, topic)))

    def remove_endpoint(self) -> None:
        self._configure(endpoints=self.truth.endpoints[1:])

    def connect(self, name: str) -> None:
        report = ConnectionReport(name=name, urls=("shm://",), established=True)
        others = tuple(each for each in self.truth.connections if each.name != name)
        self.reporter.connection_established(name, report.urls)
        self._configure(connections=(*others, report))

    def lose_connection(self, name: str) -> None:
        if any(each.name == name for each in self.truth.connections):
            self.reporter.connection_lost(name, error="unplugged")
            self._configure(
                connections=tuple(
                    dataclasses.replace(each, established=False, error="unplugged")
                    if each.name == name
                    else each
                    for each in self.truth.connections
                )
            )

    def disconnect(self, name: str) -> None:
        if any(each.name == name for each in self.truth.connections):
            self.reporter.connection_lost(name)
            self._configure(
                connections=tuple(each for each in self.truth.connections if each.name != name)
            )

    def match(self, matched: int) -> None:
        """A peer more or less: told by an event only, the checksum stays."""
        if self.truth.endpoints:
            first = self.truth.endpoints[0]
            if matched > (first.matched or 0):
                tell = self.reporter.mapping_established
            else:
                tell = self.reporter.mapping_lost
            changed = dataclasses.replace(first, matched=matched)
            self.truth = dataclasses.replace(
                self.truth, endpoints=(changed, *self.truth.endpoints[1:])
            )
            tell(f"{first.kind.value}/{first.name}", "", matched=matched)

    def leave(self) -> None:
        self.reporter.left("asked to")
        self.transport.close()

    def kill(self) -> None:
        """As SIGKILL does: nobody is told."""
        self.transport.close()
        self.reporter.left()

    def _configure(self, **changes: object) -> None:
        changed = dataclasses.replace(self.truth, **changes)  # type: ignore[arg-type]
        self.truth = dataclasses.replace(changed, checksum=checksum(changed))
        self.reporter.configuration_changed(self.truth.checksum)


class Reader:
    """Somebody who keeps the state of the graph."""

    def __init__(self, system: System) -> None:
        self.transport = system.network.transport()
        self.events = GraphEvents(
            self.transport, system.scheduler, silent_after_s=SILENT_AFTER_S, forget_after_s=60.0
        )
        self.state = GraphState(self.events, system.fetch_from(self.transport))


class System:
    """Nodes by name, on one network."""

    def __init__(self, seed: int = 0) -> None:
        self.scheduler = ManualScheduler()
        self.network = Network(self.scheduler, seed)
        self.nodes: dict[str, SimulatedNode] = {}
        self.reads = 0
        self._random = random.Random(seed)
        self._instances = 0

    def start(self, name: str, endpoints: int = 0) -> SimulatedNode:
        """Start a node, or restart it: the old instance is killed."""
        if name in self.nodes:
            self.nodes[name].kill()
        self._instances += 1
        self.nodes[name] = SimulatedNode(self, name, self._instances, endpoints)
        return self.nodes[name]

    def kill(self, name: str) -> None:
        if name in self.nodes:
            self.nodes.pop(name).kill()

    def leave(self, name: str) -> None:
        if name in self.nodes:
            self.nodes.pop(name).leave()

    def fetch_from(self, reader: Transport) -> Fetch:
        """Return how `reader` asks nodes: a while later, from the instance that is there then."""

        def fetch(name: str, done: object) -> None:
            assert callable(done)
            self.reads += 1
            now_s = self.scheduler.now_s()

            def answer() -> None:
                node = self.nodes.get(name)
                lost = self._random.random() < self.network.loss
                if node is None or lost or not self.network.together(node.transport, reader):
                    self.scheduler.call_at(now_s + TIMEOUT_S, lambda: done(None))
                    return
                document = node.truth
                back_s = self.scheduler.now_s() + self._random.uniform(0, ANSWER_S)
                self.scheduler.call_at(back_s, lambda: done(document))

            self.scheduler.call_at(now_s + self._random.uniform(0, ANSWER_S), answer)

        return fetch

    def calm(self) -> None:
        """No more accidents, and time for heartbeats to tell what was lost."""
        self.network.heal()
        self.network.loss = self.network.duplication = 0.0
        self.scheduler.advance(SILENT_AFTER_S + 2 * PERIOD_S + TIMEOUT_S)
