"""What arrives at subscriptions of our own, made where a manifest asks for it: `measure: true`.

Owns: which topics are measured so, since when, and with which QoS.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Collection, Mapping
from typing import TYPE_CHECKING

import msgspec
from msgspec.structs import replace

from lifecycle.errors import MiddlewareError
from lifecycle.manifest.model import EndpointKind
from lifecycle.manifest.qos import Durability, QosProfile
from lifecycle.measure.counter import Counter
from lifecycle.measure.sample import Measured, Sample
from lifecycle.plan.model import Plan

if TYPE_CHECKING:  # it imports rclpy
    from lifecycle.middleware.services.clients import NodeClients

_logger = logging.getLogger(__name__)

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
