"""Order, duplicates, gaps, restarts and silence."""

from __future__ import annotations

import logging
from typing import Any

import pytest
from simulated import ManualScheduler, Network, configuration, endpoint

from lifecycle.graph.events import GraphEvents
from lifecycle.graph.membership import WINDOW
from lifecycle.graph.messages import GraphMessage, Heartbeat, Joined, Left, StateChanged, encode
from lifecycle.graph.model import EventKind, GraphEvent, NodeLiveliness


class Stage:
    """Events whose messages the test writes itself."""

    def __init__(self) -> None:
        self.scheduler = ManualScheduler()
        network = Network(self.scheduler)
        self._wire = network.transport()
        self.events = GraphEvents(network.transport(), self.scheduler)
        self.told: list[GraphEvent] = []
        self.events.on(EventKind, self.told.append)

    def say(self, type_: type[GraphMessage], sequence: int, **fields: Any) -> None:
        header = {"node": "/a", "incarnation": "5", "sequence": sequence, **fields}
        self._wire.send(encode(type_(**header)))

    @property
    def kinds(self) -> list[tuple[str, EventKind]]:
        return [(each.node, each.kind) for each in self.told]

    def states(self) -> list[str]:
        changed = [each.message for each in self.told if each.kind is EventKind.STATE_CHANGED]
        return [each.state for each in changed if isinstance(each, StateChanged)]

    def liveliness(self, node: str = "/a") -> tuple[NodeLiveliness, str]:
        (found,) = [each for each in self.events.members() if each.node == node]
        return found.liveliness, found.reason


@pytest.fixture
def stage() -> Stage:
    return Stage()


def a(*kinds: EventKind) -> list[tuple[str, EventKind]]:
    return [("/a", kind) for kind in kinds]


def test_messages_that_come_out_of_order_are_told_in_order(stage: Stage) -> None:
    stage.say(Joined, 1)
    stage.say(StateChanged, 4, state="active")
    stage.say(StateChanged, 3, state="activating")
    assert stage.states() == []
    stage.say(StateChanged, 2, state="inactive")
    assert stage.states() == ["inactive", "activating", "active"]
    stage.scheduler.advance(1.0)
    assert stage.kinds == a(EventKind.JOINED, *[EventKind.STATE_CHANGED] * 3)


def test_a_duplicate_is_told_once(stage: Stage) -> None:
    stage.say(Joined, 1)
    stage.say(Joined, 1)
    stage.say(StateChanged, 3, state="active")
    stage.say(StateChanged, 3, state="active")
    stage.say(StateChanged, 2, state="inactive")
    stage.say(StateChanged, 2, state="inactive")
    assert stage.states() == ["inactive", "active"]


def test_what_stays_missing_is_a_gap(stage: Stage) -> None:
    stage.say(Joined, 1)
    stage.say(StateChanged, 3, state="active")
    stage.scheduler.advance(0.19)
    assert stage.kinds == a(EventKind.JOINED)
    stage.scheduler.advance(0.01)
    assert stage.kinds == a(EventKind.JOINED, EventKind.STATE_CHANGED, EventKind.GAP)
    assert stage.told[-1].reason == "message 2 was lost"
    stage.say(StateChanged, 2, state="inactive")
    assert stage.states() == ["active"]


def test_a_heartbeat_shows_that_the_last_message_was_lost(stage: Stage) -> None:
    stage.say(Joined, 1)
    stage.say(Heartbeat, 2, state="active")
    assert stage.kinds == a(EventKind.JOINED)
    stage.scheduler.advance(0.2)
    assert stage.kinds == a(EventKind.JOINED, EventKind.HEARTBEAT, EventKind.GAP)
    assert stage.events.members()[0].state == "active"


def test_a_heartbeat_that_overtook_waits_for_what_it_overtook(stage: Stage) -> None:
    stage.say(Joined, 1)
    stage.say(Heartbeat, 2, state="active")
    stage.say(StateChanged, 2, state="active")
    stage.say(Heartbeat, 1, state="inactive")
    stage.scheduler.advance(1.0)
    assert stage.kinds == a(EventKind.JOINED, EventKind.STATE_CHANGED, EventKind.HEARTBEAT)
    assert stage.events.members()[0].state == "active"


def test_a_heartbeat_that_waited_says_nothing_once_newer_messages_are_told(stage: Stage) -> None:
    stage.say(Joined, 1)
    stage.say(Heartbeat, 2, state="inactive")
    stage.say(StateChanged, 3, state="active")
    stage.say(StateChanged, 2, state="inactive")
    assert stage.kinds == a(EventKind.JOINED, *[EventKind.STATE_CHANGED] * 2)
    assert stage.events.members()[0].state == "active"


def test_too_many_early_messages_are_not_waited_for(stage: Stage) -> None:
    stage.say(Joined, 1)
    for sequence in range(3, 3 + WINDOW):
        stage.say(StateChanged, sequence, state=str(sequence))
    assert len(stage.states()) == WINDOW
    assert stage.kinds[-1] == ("/a", EventKind.GAP)


def test_a_late_joiner_takes_any_first_message(stage: Stage) -> None:
    stage.say(StateChanged, 7, state="active")
    stage.say(StateChanged, 6, state="inactive")
    assert stage.kinds == a(EventKind.JOINED, EventKind.STATE_CHANGED)
    assert stage.states() == ["active"]


def test_a_restart_ends_the_earlier_instance_and_its_late_messages_change_nothing(
    stage: Stage,
) -> None:
    stage.say(Joined, 1)
    stage.say(Joined, 1, incarnation="6")
    stage.say(Heartbeat, 9, incarnation="5")
    assert [(each.kind, each.incarnation, each.reason) for each in stage.told] == [
        (EventKind.JOINED, "5", ""),
        (EventKind.LEFT, "5", "restarted"),
        (EventKind.JOINED, "6", ""),
    ]
    assert stage.events.ignored == 1


def test_an_instance_that_left_does_not_come_back_by_a_late_message(stage: Stage) -> None:
    stage.say(Joined, 1)
    stage.say(Left, 3, reason="bye")
    stage.scheduler.advance(0.2)
    stage.say(StateChanged, 2, state="active")
    stage.say(Heartbeat, 3)
    assert stage.kinds == a(EventKind.JOINED, EventKind.LEFT)
    assert stage.events.members() == ()


def test_a_farewell_that_comes_first_keeps_what_came_before_out(stage: Stage) -> None:
    stage.say(Left, 2)
    stage.say(Joined, 1)
    assert (stage.kinds, stage.events.members()) == ([], ())


def test_after_the_clock_was_set_back_the_next_instance_is_taken_once_the_last_is_silent(
    stage: Stage,
) -> None:
    stage.say(Joined, 1)
    stage.say(Joined, 1, incarnation="4")
    assert stage.events.members()[0].incarnation == "5"
    stage.scheduler.advance(7.0)
    stage.say(Heartbeat, 1, incarnation="4")
    assert stage.kinds == a(
        EventKind.JOINED, EventKind.SILENT, EventKind.LEFT, EventKind.JOINED, EventKind.HEARTBEAT
    )
    assert stage.events.members()[0].incarnation == "4"


def test_a_node_that_is_not_heard_is_silent_then_alive_or_gone(stage: Stage) -> None:
    stage.say(Joined, 1)
    stage.scheduler.advance(6.9)
    stage.say(Heartbeat, 1)
    stage.scheduler.advance(6.9)
    assert stage.liveliness() == (NodeLiveliness.ALIVE, "")
    stage.scheduler.advance(0.2)
    assert stage.liveliness() == (NodeLiveliness.SILENT, "no message for 7 s")
    stage.say(Heartbeat, 1)
    assert stage.liveliness() == (NodeLiveliness.ALIVE, "")
    stage.scheduler.advance(7.0 + 600.0)
    assert stage.kinds == a(
        EventKind.JOINED,
        EventKind.HEARTBEAT,
        EventKind.SILENT,
        EventKind.ALIVE,
        EventKind.HEARTBEAT,
        EventKind.SILENT,
        EventKind.LEFT,
    )
    assert stage.told[-1].reason == "not heard any more"


def test_a_node_that_discovery_shows_is_a_member_and_may_speak_later(stage: Stage) -> None:
    stage.events.report_seen("/a")
    stage.events.report_seen("/a")
    stage.scheduler.advance(100.0)  # it never spoke: its silence means nothing
    stage.say(Joined, 1, state="active")
    stage.events.report_gone("/a")  # discovery forgets the names of nodes that live
    assert stage.kinds == a(EventKind.JOINED, EventKind.HEARTBEAT)
    assert stage.events.members()[0].state == "active"


def test_a_node_that_never_spoke_is_gone_when_discovery_says_so(stage: Stage) -> None:
    stage.events.report_seen("/a")
    stage.events.report_gone("/a", "not shown")
    assert [(each.kind, each.reason) for each in stage.told] == [
        (EventKind.JOINED, ""),
        (EventKind.LEFT, "not shown"),
    ]


def test_publishers_of_a_topic_are_told_those_there_are_and_those_that_come_and_go(
    stage: Stage,
) -> None:
    appeared: list[str] = []
    vanished: list[str] = []
    stage.say(Joined, 1)
    there = configuration("/a", endpoint(1, "/chatter"), endpoint(2, "/other")).endpoints
    stage.events.configuration_read("/a", there)
    remove = stage.events.on_publisher(
        "/chatter",
        lambda event: appeared.append(event.node),
        lambda event: vanished.append(event.node),
    )
    assert appeared == ["/a"]
    stage.say(Joined, 1, node="/b")
    stage.events.configuration_read("/b", there)
    stage.say(Left, 2)
    assert (appeared, vanished) == (["/a", "/b"], ["/a"])
    remove()
    stage.say(Left, 2, node="/b")
    assert vanished == ["/a"]


def test_a_filter_lets_only_its_node_and_kinds_through(stage: Stage) -> None:
    told: list[GraphEvent] = []
    remove = stage.events.on([EventKind.JOINED, EventKind.LEFT], told.append, node="/b")
    stage.say(Joined, 1)
    stage.say(Joined, 1, node="/b")
    stage.say(StateChanged, 2, node="/b", state="active")
    stage.say(Left, 3, node="/b")
    remove()
    stage.say(Joined, 1, node="/b", incarnation="6")
    assert [(each.node, each.kind) for each in told] == [
        ("/b", EventKind.JOINED),
        ("/b", EventKind.LEFT),
    ]


def test_an_exception_of_one_subscriber_spoils_nothing_for_the_next(
    stage: Stage, caplog: pytest.LogCaptureFixture
) -> None:
    def broken(_: GraphEvent) -> None:
        raise ValueError("mine")

    told: list[GraphEvent] = []
    stage.events.on(EventKind.JOINED, broken)
    stage.events.on(EventKind.JOINED, told.append)
    with caplog.at_level(logging.ERROR):
        stage.say(Joined, 1)
    assert len(told) == 1
    assert caplog.messages == ["cannot handle joined of /a"]


def test_what_a_subscriber_causes_is_told_after_all_have_heard_the_event(stage: Stage) -> None:
    told: list[EventKind] = []
    stage.events.on(EventKind.JOINED, lambda event: stage.events.report_gone("/seen"), node="/seen")
    stage.events.on([EventKind.JOINED, EventKind.LEFT], lambda event: told.append(event.kind))
    stage.events.report_seen("/seen")
    assert told == [EventKind.JOINED, EventKind.LEFT]


def test_after_closing_nothing_is_told_and_no_timer_is_left(stage: Stage) -> None:
    stage.say(Joined, 1)
    stage.say(StateChanged, 3, state="active")
    stage.events.close()
    stage.say(StateChanged, 2, state="inactive")
    stage.scheduler.advance(1000.0)
    assert stage.kinds == a(EventKind.JOINED)
