"""Which topics an observer subscribes to because a manifest asks it to measure them."""

from __future__ import annotations

from collections.abc import Collection

import pytest

from lifecycle.graph.readings import TopicMeasurements
from lifecycle.manifest.model import Machine, Run, RunKind
from lifecycle.plan.model import Plan
from tests.builders import at, link, node, planned, publisher, subscription

FOREIGN = Run(kind=RunKind.COMMAND, command=("other",))


class Clients:
    """Notes what is subscribed to."""

    def __init__(self) -> None:
        self.topics: list[str] = []

    def on_messages(self, topic: str, *_: object) -> None:
        self.topics.append(topic)


def plan(*, measure: bool) -> Plan:
    return planned(
        node("one", publisher("a"), machine="near"),
        node("two", subscription("a"), run=FOREIGN, machine="far"),
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
