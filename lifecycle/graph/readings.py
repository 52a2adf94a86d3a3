"""What is read of nodes beside discovery: parameters, /diagnostics, messages of their topics.

The parameters of nodes that do not report them are read once when a node is there, again when
`/parameter_events` says that one of them changed, and else rarely: rclpy publishes no event for a
parameter that is undeclared, rclcpp need not publish any, and an event may pass before our
subscription is matched. Topics are measured so where a manifest asks for it (`measure: true`).
"""

from __future__ import annotations

import asyncio
import functools
import logging
import threading
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import TYPE_CHECKING

import msgspec
from msgspec.structs import replace

from lifecycle.errors import MiddlewareError
from lifecycle.graph.loop import set_within
from lifecycle.manifest.model import EndpointKind
from lifecycle.manifest.qos import Durability, QosProfile
from lifecycle.measure.counter import Counter
from lifecycle.measure.sample import Measured, Sample
from lifecycle.plan.model import Plan
from lifecycle.verify.observation import (
    SERVES_NONE,
    HealthReport,
    NodeParameters,
    ParameterReport,
)
from lifecycle.verify.tool_filter import matches

if TYPE_CHECKING:  # it imports rclpy
    from lifecycle.graph.loop import GraphLoop
    from lifecycle.middleware.services.clients import NodeClients

_logger = logging.getLogger(__name__)

ANSWER_S = 3.0
"""A node that spins answers within milliseconds; one that does not may still be on its way."""

UNSHOWN_S = 1.0
"""Discovery shows a node before its services; one whose services are not there then has none."""

AGAIN_S = 1.0
"""Without an event a reading is repeated so long after it, ..."""

AGAIN_AT_MOST_S = 10.0
"""... then twice as long each time, down to this."""

_BETWEEN_S = 0.02
"""At least so long between two readings, however often a parameter changes."""

_NO_ANSWER = f"did not answer its parameter services within {ANSWER_S:g} s"

Names = frozenset[str] | None
"""Of those parameters of a node that are read; None for all that it has."""


class ParameterReadings:
    """The parameters of some nodes, kept as they are. To be used in a graph's loop.

    `wake` is called when they are others than before.
    """

    def __init__(self, clients: NodeClients, loop: GraphLoop, wake: Callable[[], None]) -> None:
        self._clients = clients
        self._loop = loop
        self._wake = wake
        self._nodes: dict[str, _Node] = {}
        self._named: dict[str, Names] = {}

    def listen(self, named: Mapping[str, Names]) -> None:
        """Take each change of a parameter that is named, by node, as a reason to look again."""
        # Looks at a part of the system go on beside those at all of it.
        self._named.update(named)
        if named:
            self._clients.on_parameters(self._arrived)

    async def follow(self, nodes: Collection[str], *, reporting: Collection[str]) -> bool:
        """Read the named parameters of nodes (full names) from now on; return whether it waited.

        It waits for those that were never read, no longer than a node may take to answer. Nodes
        that are `reporting` their parameters themselves now are not read.
        """
        for name in reporting:
            self.forget(name)
        for name in nodes:
            node = self._nodes.get(name)
            if node is None or node.names != self._named[name]:
                self.forget(name)
                node = self._nodes[name] = _Node(name, self._named[name])
                self._begin(node)
            missing = node.latest is not None and node.latest.error == SERVES_NONE
            if missing and self._clients.serves_parameters(name):
                node.due.set()  # the services have come
        unread = [each.is_read.wait() for each in self._nodes.values() if not each.is_read.is_set()]
        await asyncio.gather(*unread)
        return bool(unread)

    @property
    def latest(self) -> tuple[NodeParameters, ...]:
        """What was read last of every node that is followed."""
        return tuple(each.latest for each in self._nodes.values() if each.latest is not None)

    def forget(self, node: str) -> None:
        """Drop what is known of a node that left."""
        known = self._nodes.pop(node, None)
        if known is not None:
            known.task.cancel()
            known.is_read.set()

    def close(self) -> None:
        """Stop reading."""
        for name in tuple(self._nodes):
            self.forget(name)

    def reread(self, node: str | None = None) -> bool:
        """Have the next `follow` wait for readings that begin now; return whether any does."""
        nodes = [each for name, each in self._nodes.items() if node in (None, name)]
        for each in nodes:
            each.task.cancel()
            self._begin(each)
        return bool(nodes)

    def _begin(self, node: _Node) -> None:
        node.is_read.clear()
        node.task = asyncio.ensure_future(self._keep(node))

    def _arrived(self, node: str, names: frozenset[str]) -> None:
        # In a thread of DDS.
        named = self._named.get(node, frozenset())
        if named is None or not names.isdisjoint(named):
            self._loop.post(functools.partial(self._changed, node))

    def _changed(self, node: str) -> None:
        known = self._nodes.get(node)
        if known is not None:
            known.due.set()
        else:
            self._wake()  # it reports them itself, and is asked when there is another look

    async def _keep(self, node: _Node) -> None:
        """Read the parameters of a node again and again."""
        pause_s, unanswered, notified = AGAIN_S, 0, True
        while True:
            node.due.clear()
            found = await self._read(node)
            unanswered = unanswered + 1 if found.error == _NO_ANSWER else 0
            # A node that is busy for a moment, and of which no event says that it has changed,
            # is what it was.
            is_busy = unanswered == 1 and not notified
            if found != node.latest and not is_busy:
                is_first, node.latest = node.latest is None, found
                if not is_first:
                    self._wake()
            node.is_read.set()
            notified = await set_within(node.due, pause_s)
            pause_s = AGAIN_S if notified else min(2 * pause_s, AGAIN_AT_MOST_S)
            await asyncio.sleep(_BETWEEN_S)

    async def _read(self, node: _Node) -> NodeParameters:
        found = None
        if (serves := self._clients.serves_parameters(node.name)) is None:
            found = await self._ask(node, UNSHOWN_S)
            serves = found is not None or self._clients.serves_parameters(node.name)
        if not serves:
            return NodeParameters(node=node.name, error=SERVES_NONE)
        if found is None:
            found = await self._ask(node, ANSWER_S)
        error = _NO_ANSWER if found is None else ""
        return NodeParameters(node=node.name, parameters=found, error=error)

    async def _ask(self, node: _Node, limit_s: float) -> tuple[ParameterReport, ...] | None:
        reading = self._clients.report_parameters(node.name, node.names, timeout_s=limit_s)
        asking = asyncio.ensure_future(reading)
        try:
            await asyncio.wait({asking}, timeout=limit_s)  # not wait_for, see set_within
            return asking.result() if asking.done() else None
        except MiddlewareError as error:
            _logger.info("parameters of %s unknown: %s", node.name, error)
        except Exception:
            # What a foreign node answers must not end the reading of its parameters.
            _logger.exception("parameters of %s unknown", node.name)
        finally:
            asking.cancel()
        return None


class _Node:
    """What is known of the parameters of one node, and whether they are to be read again."""

    def __init__(self, name: str, names: Names) -> None:
        self.name = name
        self.names = names
        self.latest: NodeParameters | None = None
        self.task: asyncio.Task[None]
        self.is_read = asyncio.Event()
        self.due = asyncio.Event()


Diagnostic = tuple[str, int, str]
"""Name, level and message of a diagnostic_msgs/DiagnosticStatus."""

_OF_ERROR = 2
"""Level of that; below are OK and WARN, above is STALE."""

STALE_S = 5.0
"""An entry that was not published for so long says nothing any more, as diagnostic_aggregator has
it by default."""

_LONGEST_MESSAGE = 200


class DiagnosticReadings:
    """What /diagnostics says of some nodes.

    Args:
        clients: where it is subscribed to, once there is such a node.
        wake: called, in any thread, when it says something else.
        clock: seconds.
    """

    def __init__(
        self,
        clients: NodeClients,
        wake: Callable[[], None],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._clients = clients
        self._wake = wake
        self._clock = clock
        self._lock = threading.Lock()
        self._patterns: dict[str, tuple[str, ...]] = {}
        self._entries: dict[str, tuple[int, str, float]] = {}
        self._said: dict[str, HealthReport] = {}

    def listen(self, patterns: Mapping[str, tuple[str, ...]]) -> None:
        """Follow the entries of nodes from now on, by patterns of their names."""
        with self._lock:
            # Looks at a part of the system go on beside those at all of it.
            self._patterns.update(patterns)
        if patterns:
            self._clients.on_diagnostics(self._arrived)

    def forget(self, node: str) -> None:
        """Forget what was said of a node: what comes in its place has said nothing yet."""
        with self._lock:
            patterns = self._patterns.get(node, ())
            for name in [one for one in self._entries if any(matches(one, p) for p in patterns)]:
                del self._entries[name]

    def reports(self) -> dict[str, HealthReport]:
        """Return what is known now, by full node name."""
        with self._lock:
            self._said = self._reports()
            return self._said

    def _arrived(self, entries: Sequence[Diagnostic]) -> None:
        with self._lock:
            wanted = {each for patterns in self._patterns.values() for each in patterns}
            for name, level, message in entries:
                if any(matches(name, each) for each in wanted):
                    self._entries[name] = level, message[:_LONGEST_MESSAGE], self._clock()
            changed = self._reports() != self._said
        if changed:
            self._wake()

    def _reports(self) -> dict[str, HealthReport]:
        found = {node: self._report(patterns) for node, patterns in self._patterns.items()}
        return {node: each for node, each in found.items() if each is not None}

    def _report(self, patterns: tuple[str, ...]) -> HealthReport | None:
        wrong, unknown, ok = [], [], False
        for name, (level, message, at_s) in sorted(self._entries.items()):
            if not any(matches(name, each) for each in patterns):
                continue
            said = f": {message}" if message else ""
            if self._clock() - at_s > STALE_S:
                unknown.append(f"{name!r} was not published for {STALE_S:g} s")
            elif level == _OF_ERROR:
                wrong.append(f"{name!r}{said or ' has level ERROR'}")
            elif level > _OF_ERROR:
                unknown.append(f"{name!r} is stale{said}")
            else:
                ok = True
        if wrong or unknown:
            said = "; ".join(wrong or unknown)[:_LONGEST_MESSAGE]
            return HealthReport(ok=False if wrong else None, message=said)
        return HealthReport(ok=True) if ok else None


_DEPTH = 1000
"""So many messages may come while this process does something else."""

_DISCOVERED_S = 3.5
"""A publisher that was there before is discovered within this time: until then its silence is none
of its own."""


class _Listening(msgspec.Struct):
    """A subscription of ours.

    Attributes:
        type: of the topic.
        qos: as it was asked for.
        since_ns: on the monotonic clock.
        fails: it could not be made.
        counter: from its first message on.
    """

    type: str
    qos: QosProfile
    is_apart: bool
    since_ns: int
    fails: bool = False
    counter: Counter | None = None

    def arrived(self, _: bytes, info: Mapping[str, int]) -> None:
        """Count a message."""
        now_ns, wall_ns = time.monotonic_ns(), time.time_ns()
        if self.counter is None:
            self.counter = Counter(now_ns, wall_ns, is_apart=self.is_apart)
        self.counter.arrived(now_ns, wall_ns, info)

    def sample(self, now_ns: int) -> Sample:
        """Return what was counted."""
        if self.counter is not None:
            return self.counter.sample(now_ns)
        seconds = (now_ns - self.since_ns) / 1e9
        silent_s = 0.0 if self.fails else max(0.0, seconds - _DISCOVERED_S)
        return Sample(seconds=seconds, silent_s=silent_s)


class TopicMeasurements:
    """Counts what arrives on some topics, from their first message on."""

    def __init__(self, clients: NodeClients) -> None:
        self._clients = clients
        self._topics: dict[str, _Listening] = {}

    def listen(self, plan: Plan, machines: Collection[str] | None) -> None:
        """Measure what a plan asks for at subscriptions on these machines, and nothing else.

        The same again changes nothing.

        Args:
            plan: whose flows are measured; those of nodes that it leaves out stay as they are.
            machines: None for all.
        """
        nodes = {each.key: each for each in plan.nodes}
        asked: dict[str, tuple[str, QosProfile]] = {}
        left_out, apart = set[str](), set[str]()
        for flow in plan.flows:
            publisher, subscriber = nodes.get(flow.publisher), nodes.get(flow.subscription)
            if publisher is None or subscriber is None:
                left_out.add(flow.topic)
                continue
            if publisher.machine != subscriber.machine:
                apart.add(flow.topic)
            if not flow.measure or (machines is not None and subscriber.machine not in machines):
                continue  # its own supervisor does
            for end in subscriber.endpoints:
                is_its = end.kind is EndpointKind.SUBSCRIPTION and end.resolved == flow.topic
                if is_its and end.qos is not None:
                    qos = replace(end.qos, durability=Durability.VOLATILE, depth=_DEPTH)
                    asked.setdefault(flow.topic, (end.type, qos))
        for topic, each in tuple(self._topics.items()):
            as_now = (each.type, each.qos) == asked.get(topic) and each.is_apart == (topic in apart)
            if not as_now and topic not in left_out:
                self._clients.no_messages(topic)
                del self._topics[topic]
        for topic, (type_, qos) in asked.items():
            if topic not in self._topics:
                self._topics[topic] = of = _Listening(
                    type=type_, qos=qos, is_apart=topic in apart, since_ns=time.monotonic_ns()
                )
                try:
                    self._clients.on_messages(topic, type_, qos, of.arrived)
                except MiddlewareError as error:
                    of.fails = True
                    _logger.warning("cannot measure %s: %s", topic, error)

    def begin_anew(self) -> None:
        """Forget what was counted: messages waited while this process stood still."""
        for each in self._topics.values():
            each.since_ns, each.counter = time.monotonic_ns(), None

    def measured(self) -> Measured | None:
        """Return what was counted until now; None where nothing is measured so."""
        if not self._topics:
            return None
        now_ns = time.monotonic_ns()
        samples = ((topic, each.sample(now_ns)) for topic, each in self._topics.items())
        return Measured(active_s=0.0, samples=tuple(samples))
