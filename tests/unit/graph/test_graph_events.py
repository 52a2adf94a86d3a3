"""What happens when nodes say something else of themselves: statuses in, events out."""

from __future__ import annotations

import logging
from typing import Any

import pytest

from lifecycle.graph.state import EventKind, GraphEvent, GraphEvents, GraphState
from lifecycle.graph.status import MappingStatus, NodeStatus
from lifecycle.manifest.model import EndpointKind
from lifecycle.verify.observation import EndpointReport
from lifecycle.verify.outcome import ConnectionReport
from tests.builders import configuration


class Stage:
    """A graph whose nodes say what the test has them say."""

    def __init__(self) -> None:
        self.state = GraphState(lambda work: work())
        self.events = GraphEvents(self.state)
        self.told: list[GraphEvent] = []
        self.events.on(EventKind, self.told.append)

    def say(self, node: str = "/a", *, instance: str = "5", **fields: Any) -> None:
        self.state.put_status(NodeStatus(node=node, instance=instance, **fields))

    def read(self, node: str, *topics: str) -> None:
        """Have a node read that publishes topics."""
        self.state.learn(configuration(node, *map(publisher, topics)))

    @property
    def kinds(self) -> list[tuple[str, EventKind]]:
        return [(each.node, each.kind) for each in self.told]


def publisher(topic: str) -> EndpointReport:
    return EndpointReport(
        kind=EndpointKind.PUBLISHER, name="t", resolved=topic, type="std_msgs/msg/String"
    )


@pytest.fixture
def stage() -> Stage:
    return Stage()


def a(*kinds: EventKind) -> list[tuple[str, EventKind]]:
    return [("/a", kind) for kind in kinds]


NET = ConnectionReport(name="net", urls=("shm://",), established=True)
LOST = ConnectionReport(name="net", urls=("shm://",), error="unplugged")
EMPTY = ConnectionReport(name="net", urls=("shm://",))
MAPPED = EventKind.MAPPING_ESTABLISHED


def mapped(matched: int | None, connection: str = "") -> dict[str, Any]:
    of = MappingStatus(endpoint="publishers/video", connection=connection, matched=matched)
    return {"mappings": (of,)}


@pytest.mark.parametrize(
    ("before", "after", "kinds"),
    [
        ({}, {}, []),
        ({"state": "inactive"}, {"state": "active"}, [EventKind.STATE_CHANGED]),
        ({}, {"connected": True}, [EventKind.STATE_CHANGED]),
        ({"checksum": "1"}, {"checksum": "2"}, [EventKind.CONFIGURATION_CHANGED]),
        ({}, {"connections": (NET,)}, [EventKind.CONNECTION_ESTABLISHED]),
        ({"connections": (LOST,)}, {"connections": (NET,)}, [EventKind.CONNECTION_ESTABLISHED]),
        ({"connections": (NET,)}, {"connections": (LOST,)}, [EventKind.CONNECTION_LOST]),
        ({"connections": (NET,)}, {}, [EventKind.CONNECTION_LOST]),
        ({"connections": (LOST,)}, {}, []),
        # What has no peer yet is no loss.
        ({"connections": (NET,)}, {"connections": (EMPTY,), **mapped(0, "net")}, [MAPPED]),
        (
            {"connections": (NET,), **mapped(1, "net")},
            {"connections": (EMPTY,), **mapped(0, "net")},
            [EventKind.CONNECTION_LOST, EventKind.MAPPING_LOST],
        ),
        ({}, mapped(0), [EventKind.MAPPING_ESTABLISHED]),
        ({}, mapped(None), [EventKind.MAPPING_ESTABLISHED]),
        (mapped(0), mapped(2), [EventKind.MAPPING_ESTABLISHED]),
        (mapped(2), mapped(1), [EventKind.MAPPING_LOST]),
        (mapped(2), {}, [EventKind.MAPPING_LOST]),
        (mapped(2), mapped(2, "net"), [EventKind.MAPPING_LOST, EventKind.MAPPING_ESTABLISHED]),
    ],
)
def test_what_happened_is_the_difference_between_two_statuses(
    stage: Stage, before: dict[str, Any], after: dict[str, Any], kinds: list[EventKind]
) -> None:
    stage.say(**before)
    assert stage.kinds == a(EventKind.JOINED)
    stage.say(**after)
    assert stage.kinds[1:] == a(*kinds)
    for each in stage.told[1:]:
        assert (each.connection is not None) == each.kind.value.startswith("connection_")
        assert (each.mapping is not None) == each.kind.value.startswith("mapping_")


def test_an_event_shows_what_was_lost_as_it_is_now_or_was(stage: Stage) -> None:
    stage.say(connections=(NET,), state="inactive")
    stage.say(connections=(LOST,), state="active")
    assert [each.view.state for each in stage.told] == ["inactive", "active", "active"]
    assert stage.told[-1].connection == LOST
    stage.say(connections=(NET,))
    stage.say()
    assert stage.told[-1].connection == NET


def test_a_restart_ends_the_earlier_instance_whose_late_words_change_nothing(stage: Stage) -> None:
    stage.say()
    stage.say(instance="6")
    stage.say(instance="5", state="active")
    stage.say(instance="5", left=True)
    assert [(each.kind, each.view.status.instance, each.reason) for each in stage.told] == [
        (EventKind.JOINED, "5", ""),
        (EventKind.LEFT, "5", "restarted"),
        (EventKind.JOINED, "6", ""),
    ]


def test_after_the_clock_was_set_back_the_next_instance_is_taken_once_the_last_is_silent(
    stage: Stage,
) -> None:
    stage.say()
    stage.say(instance="4")
    assert stage.kinds == a(EventKind.JOINED)
    stage.state.hide("/a", "not shown")
    stage.say(instance="4")
    assert stage.kinds[1:] == a(EventKind.SILENT, EventKind.LEFT, EventKind.JOINED)


def test_a_node_that_reports_is_silent_while_discovery_does_not_show_it(stage: Stage) -> None:
    stage.state.show("/a")
    stage.say()
    stage.state.hide("/a", "not shown")
    stage.state.show("/a")
    assert stage.kinds == a(EventKind.JOINED, EventKind.SILENT, EventKind.ALIVE)
    assert [each.reason for each in stage.told] == ["", "not shown", ""]


def test_a_node_that_reports_nothing_comes_and_goes_with_discovery(stage: Stage) -> None:
    stage.state.show("/a")
    stage.state.show("/a")
    stage.state.hide("/a", "not shown")
    stage.state.hide("/a", "not shown")
    assert [(each.kind, each.reason) for each in stage.told] == [
        (EventKind.JOINED, ""),
        (EventKind.LEFT, "not shown"),
    ]


def test_who_said_farewell_is_gone_and_a_farewell_of_nobody_is_no_event(stage: Stage) -> None:
    stage.say(left=True)
    stage.state.show("/a")
    stage.say(left=True)
    stage.say(state="active")
    stage.say(left=True, reason="bye")
    assert stage.kinds == a(EventKind.JOINED, EventKind.LEFT)
    assert stage.told[-1].reason == "bye"


def test_endpoints_come_and_go_with_what_is_read_of_their_node(stage: Stage) -> None:
    stage.say()
    stage.read("/a", "/one", "/two")
    stage.read("/a", "/two", "/three")
    stage.say(left=True)
    assert [(each.kind.value, each.endpoint.resolved) for each in stage.told if each.endpoint] == [
        ("endpoint_added", "/one"),
        ("endpoint_added", "/two"),
        ("endpoint_removed", "/one"),
        ("endpoint_added", "/three"),
        ("endpoint_removed", "/two"),
        ("endpoint_removed", "/three"),
    ]
    assert stage.kinds[-1] == ("/a", EventKind.LEFT)


def test_publishers_of_a_topic_are_told_those_there_are_and_those_that_come_and_go(
    stage: Stage,
) -> None:
    appeared: list[str] = []
    vanished: list[str] = []
    stage.say("/a")
    stage.read("/a", "/chatter", "/other")
    remove = stage.events.on_publisher(
        "/chatter",
        lambda event: appeared.append(event.node),
        lambda event: vanished.append(event.node),
    )
    assert appeared == ["/a"]
    stage.say("/b")
    stage.read("/b", "/chatter")
    stage.say("/a", left=True)
    assert (appeared, vanished) == (["/a", "/b"], ["/a"])
    remove()
    remove()
    stage.say("/b", left=True)
    assert vanished == ["/a"]


def test_a_filter_lets_only_its_node_and_kinds_through(stage: Stage) -> None:
    told: list[GraphEvent] = []
    remove = stage.events.on([EventKind.JOINED, EventKind.LEFT], told.append, node="/b")
    stage.say("/a")
    stage.say("/b")
    stage.say("/b", state="active")
    stage.say("/b", left=True)
    remove()
    stage.say("/b", instance="6")
    assert [(each.node, each.kind) for each in told] == [
        ("/b", EventKind.JOINED),
        ("/b", EventKind.LEFT),
    ]


def test_an_exception_of_one_subscriber_spoils_nothing_for_the_next(
    stage: Stage, caplog: pytest.LogCaptureFixture
) -> None:
    def broken(_: object) -> None:
        raise ValueError("mine")

    told: list[GraphEvent] = []
    stage.events.on(EventKind.JOINED, broken)
    stage.state.on_change(broken)
    stage.events.on(EventKind.JOINED, told.append)
    with caplog.at_level(logging.ERROR):
        stage.say()
    assert len(told) == 1
    assert caplog.messages == ["cannot handle joined of /a", "cannot handle a change of /a"]


def test_after_closing_nothing_is_told() -> None:
    stage = Stage()
    stage.say()
    stage.state.close()
    stage.say(state="active")
    assert stage.kinds == a(EventKind.JOINED)
