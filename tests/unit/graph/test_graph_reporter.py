"""What a node tells of itself."""

from __future__ import annotations

import logging

import pytest
from simulated import ManualScheduler, Network, Transport, every

from lifecycle.errors import MiddlewareError
from lifecycle.graph.messages import GraphKind, GraphMessage, Heartbeat, decode
from lifecycle.graph.reporter import GraphReporter


class Listener:
    def __init__(self) -> None:
        self.scheduler = ManualScheduler()
        self.network = Network(self.scheduler)
        self.heard: list[GraphMessage] = []
        self.network.transport().receive(lambda data: self.heard.append(decode(data)))

    def reporter(self, transport: Transport | None = None) -> GraphReporter:
        return GraphReporter(
            transport or self.network.transport(),
            "/camera",
            every=every(self.scheduler),
            period_s=2.0,
            incarnation="1",
        )

    @property
    def kinds(self) -> list[tuple[GraphKind, int]]:
        return [(each.kind, each.sequence) for each in self.heard]


def test_every_message_takes_the_next_number_and_a_heartbeat_repeats_the_last() -> None:
    listener = Listener()
    reporter = listener.reporter()
    reporter.joined("inactive", checksum="a")
    listener.scheduler.advance(2.0)
    reporter.state_changed("active", connected=True)
    reporter.configuration_changed("b")
    listener.scheduler.advance(2.0)
    reporter.left("bye")
    listener.scheduler.advance(10.0)
    assert listener.kinds == [
        (GraphKind.JOINED, 1),
        (GraphKind.HEARTBEAT, 1),
        (GraphKind.STATE_CHANGED, 2),
        (GraphKind.CONFIGURATION_CHANGED, 3),
        (GraphKind.HEARTBEAT, 3),
        (GraphKind.LEFT, 4),
    ]
    assert listener.heard[4] == Heartbeat(
        node="/camera", incarnation="1", sequence=3, state="active", connected=True, checksum="b"
    )


def test_what_was_told_already_is_not_told_again() -> None:
    listener = Listener()
    reporter = listener.reporter()
    reporter.joined("inactive", checksum="a")
    reporter.state_changed("inactive", connected=False)
    reporter.configuration_changed("a")
    assert listener.kinds == [(GraphKind.JOINED, 1)]


def test_nothing_is_told_before_joining_or_after_leaving() -> None:
    listener = Listener()
    reporter = listener.reporter()
    reporter.state_changed("inactive", connected=False)
    reporter.connection_lost("net", error="unplugged")
    reporter.announce()
    assert (listener.heard, reporter.is_member) == ([], False)
    reporter.joined("inactive")
    reporter.left()
    reporter.left()
    reporter.joined("inactive")
    reporter.configuration_changed("b")
    assert listener.kinds == [(GraphKind.JOINED, 1), (GraphKind.LEFT, 2)]


def test_somebody_who_comes_later_is_told_at_once() -> None:
    listener = Listener()
    listener.reporter().joined("inactive")
    late: list[GraphMessage] = []
    listener.network.transport().receive(lambda data: late.append(decode(data)))
    assert [each.kind for each in late] == [GraphKind.HEARTBEAT]


def test_who_hears_again_after_a_partition_is_told_at_once() -> None:
    listener = Listener()
    transport = listener.network.transport()
    listener.reporter(transport).joined("inactive")
    listener.network.partition([transport])
    listener.scheduler.advance(20.0)
    listener.heard.clear()
    listener.network.heal()
    assert listener.kinds == [(GraphKind.HEARTBEAT, 1)]


class Refusing:
    """A transport whose context was shut down."""

    def send(self, message: bytes) -> None:
        raise MiddlewareError("cannot publish on /lifecycle/graph: context is invalid")

    def receive(self, callback: object) -> object:
        raise NotImplementedError

    def on_peer(self, callback: object) -> object:
        return lambda: None

    def close(self) -> None:
        raise NotImplementedError


def test_a_node_works_without_the_graph(caplog: pytest.LogCaptureFixture) -> None:
    listener = Listener()
    reporter = listener.reporter(Refusing())  # type: ignore[arg-type]
    with caplog.at_level(logging.WARNING):
        reporter.joined()
    assert caplog.messages == [
        "/camera could not tell joined: cannot publish on /lifecycle/graph: context is invalid"
    ]
