"""Which topics an observer subscribes to because a manifest asks it to measure them."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Mapping

import pytest
from msgspec.structs import replace

from lifecycle.errors import MiddlewareError
from lifecycle.graph.readings import TopicMeasurements
from lifecycle.manifest.model import Machine, Run, RunKind
from lifecycle.manifest.qos import QosProfile, Reliability
from lifecycle.plan.model import Plan
from tests.builders import at, link, node, planned, publisher, subscription

FOREIGN = Run(kind=RunKind.COMMAND, command=("other",))


class Clients:
    """Notes what is subscribed to."""

    def __init__(self) -> None:
        self.topics: list[str] = []
        self.arrived: Callable[[bytes, Mapping[str, int]], None] | None = None

    def on_messages(self, topic: str, _: str, __: QosProfile, arrived: Callable[..., None]) -> None:
        self.topics.append(topic)
        self.arrived = arrived

    def no_messages(self, topic: str) -> None:
        self.topics.remove(topic)


def plan(*, measure: bool, **qos: object) -> Plan:
    return planned(
        node("one", publisher("a", **qos), machine="near"),
        node("two", subscription("a", **qos), run=FOREIGN, machine="far"),
        links=[link("/a", "one", "two", measure=measure)],
        machines=tuple(Machine(name=each, at=at(2)) for each in ("near", "far")),
    )


@pytest.mark.parametrize(
    ("measure", "machines", "topics"),
    [
        (True, None, ["/a"]),
        (True, {"far"}, ["/a"]),
        (True, {"near"}, []),
        (False, None, []),
    ],
)
def test_a_topic_is_subscribed_to_once_where_its_subscriber_is_and_the_manifest_asks(
    measure: bool, machines: Collection[str] | None, topics: list[str]
) -> None:
    clients = Clients()
    measurements = TopicMeasurements(clients)  # type: ignore[arg-type]
    for _ in range(2):
        measurements.listen(plan(measure=measure), machines)
    assert clients.topics == topics
    assert (measurements.measured() is not None) == bool(topics)


def test_what_another_plan_asks_for_otherwise_is_subscribed_to_anew() -> None:
    clients = Clients()
    measurements = TopicMeasurements(clients)  # type: ignore[arg-type]
    measurements.listen(plan(measure=True), None)
    before = measurements._topics["/a"]
    other = QosProfile(reliability=Reliability.BEST_EFFORT)
    measurements.listen(plan(measure=True, qos=other), None)
    assert clients.topics == ["/a"]
    assert measurements._topics["/a"] is not before
    measurements.listen(plan(measure=False), None)
    assert (clients.topics, measurements.measured()) == ([], None)


def test_nodes_that_a_plan_leaves_out_for_a_while_are_measured_on() -> None:
    clients = Clients()
    measurements = TopicMeasurements(clients)  # type: ignore[arg-type]
    whole = plan(measure=True)
    measurements.listen(whole, None)
    before = measurements._topics["/a"]
    measurements.listen(replace(whole, nodes=whole.nodes[:1]), None)
    assert measurements._topics["/a"] is before


def test_each_flow_is_measured_on_its_own_subscribers_machine() -> None:
    both = planned(
        node("one", publisher("a"), subscription("b"), run=FOREIGN, machine="near"),
        node("two", subscription("a"), publisher("b"), run=FOREIGN, machine="far"),
        links=[link("/a", "one", "two", measure=True), link("/b", "two", "one", measure=True)],
        machines=tuple(Machine(name=each, at=at(2)) for each in ("near", "far")),
    )
    clients = Clients()
    TopicMeasurements(clients).listen(both, {"far"})  # type: ignore[arg-type]
    assert clients.topics == ["/a"]


@pytest.mark.parametrize("fails", [False, True])
def test_a_topic_is_silent_once_its_publisher_must_be_known_and_never_where_nobody_listens(
    fails: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    clients = Clients()
    if fails:
        monkeypatch.setattr(clients, "on_messages", _cannot)
    measurements = TopicMeasurements(clients)  # type: ignore[arg-type]
    measurements.listen(plan(measure=True), None)
    since_ns = time.monotonic_ns()
    for seconds, silent_s in ((3.0, 0.0), (13.5, 0.0 if fails else 10.0)):
        monkeypatch.setattr(time, "monotonic_ns", lambda s=seconds: since_ns + round(s * 1e9))
        measured = measurements.measured()
        assert measured is not None
        assert measured.samples[0][1].silent_s == pytest.approx(silent_s, abs=0.1)


def _cannot(*_: object) -> None:
    raise MiddlewareError("the type is not installed")


def test_what_waited_while_this_process_stood_still_counts_for_nothing() -> None:
    clients = Clients()
    measurements = TopicMeasurements(clients)  # type: ignore[arg-type]
    measurements.listen(plan(measure=True), None)
    sent_ns = time.time_ns()
    info = {"source_timestamp": sent_ns, "received_timestamp": 0, "publication_sequence_number": 1}

    def messages() -> int:
        measured = measurements.measured()
        assert measured is not None
        return measured.samples[0][1].messages

    for _ in range(2):
        assert clients.arrived is not None
        clients.arrived(b"", info)  # it begins to count
        counter = measurements._topics["/a"].counter
        assert counter is not None
        now_ns = time.monotonic_ns() + 10**9
        counter.arrived(now_ns, sent_ns + 10**9, {**info, "source_timestamp": sent_ns + 10**9})
        assert messages() == 1
        measurements.begin_anew()
        assert messages() == 0
