"""What arrives at subscriptions of our own, made where a manifest asks for it: `measure: true`.

Owns: which topics are measured so, since when, and with which QoS.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Collection, Mapping
from typing import TYPE_CHECKING

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


class TopicMeasurements:
    """Counts what arrives on some topics, from their first message on."""

    def __init__(self, clients: NodeClients) -> None:
        self._clients = clients
        self._since_ns: dict[str, int] = {}
        self._counters: dict[str, Counter] = {}

    def listen(self, plan: Plan, machines: Collection[str] | None) -> None:
        """Measure what a plan asks for at subscriptions on these machines; None for all.

        The same again changes nothing.
        """
        for flow in plan.flows:
            if not flow.measure or flow.topic in self._since_ns:
                continue
            if machines is not None and plan.node(flow.subscription).machine not in machines:
                continue  # its own supervisor does
            self._since_ns[flow.topic] = time.monotonic_ns()
            for end in plan.node(flow.subscription).endpoints:
                is_its = end.kind is EndpointKind.SUBSCRIPTION and end.resolved == flow.topic
                if is_its and end.qos is not None:
                    qos = replace(end.qos, durability=Durability.VOLATILE, depth=_DEPTH)
                    machines = {
                        plan.node(key).machine for key in (flow.publisher, flow.subscription)
                    }
                    self._subscribe(flow.topic, end.type, qos, is_apart=len(machines) > 1)

    def _subscribe(self, topic: str, type_: str, qos: QosProfile, *, is_apart: bool) -> None:
        def arrived(_: bytes, info: Mapping[str, int]) -> None:
            now_ns, wall_ns = time.monotonic_ns(), time.time_ns()
            if topic not in self._counters:
                self._counters[topic] = Counter(now_ns, wall_ns, is_apart=is_apart)
            self._counters[topic].arrived(now_ns, wall_ns, info)

        try:
            self._clients.on_messages(topic, type_, qos, arrived)
        except MiddlewareError as error:
            _logger.warning("cannot measure %s: %s", topic, error)

    def measured(self) -> Measured | None:
        """Return what was counted until now; None where nothing is measured so."""
        if not self._since_ns:
            return None
        now_ns = time.monotonic_ns()
        samples = []
        for topic, since_ns in self._since_ns.items():
            counter, seconds = self._counters.get(topic), (now_ns - since_ns) / 1e9
            empty = Sample(seconds=seconds, silent_s=0.0)
            samples.append((topic, empty if counter is None else counter.sample(now_ns)))
        return Measured(active_s=0.0, samples=tuple(samples))
