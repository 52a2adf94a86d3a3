"""What a snapshot makes of what rclpy's graph queries return, or raise."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from types import SimpleNamespace

import pytest
from rclpy.qos import QoSProfile
from rclpy.topic_endpoint_info import TopicEndpointInfo

from lifecycle.manifest.model import EndpointKind
from lifecycle.middleware.rcl import graph
from lifecycle.middleware.rcl.graph import GraphObserver
from lifecycle.verify.tool_filter import DeclaredNames

STRING = "std_msgs::msg::dds_::String_"
EVENTS = ("rt/parameter_events", "rcl_interfaces::msg::dds_::ParameterEvent_")
TRIGGER = "std_srvs::srv::dds_::Trigger_{}_"
ONE, TWO = "11" * 12, "22" * 12


@dataclasses.dataclass
class End:
    """A writer or reader of the RMW; `node` in bytes, as it was announced."""

    writes: bool
    topic: bytes
    type: str
    node: bytes
    prefix: str


class Context:
    """Of who looks."""

    def get_domain_id(self) -> int:
        """Return its domain."""
        return 7


@dataclasses.dataclass
class Graph:
    """What rclpy shows: the queries that a snapshot makes, of these ends."""

    ends: list[End]
    context: Context = dataclasses.field(default_factory=Context)

    def get_fully_qualified_name(self) -> str:
        """Return that of the node that looks."""
        return "/looks"

    def resolve_topic_name(self, name: str) -> str:
        """Return a name as it is."""
        return name

    def get_topic_names_and_types(self, *, no_demangle: bool) -> list[tuple[str, list[str]]]:
        """Return DDS's names; raise at one that is no UTF-8."""
        assert no_demangle
        return [(end.topic.decode(), [end.type]) for end in self.ends]

    def _infos(self, writes: bool, topic: str) -> list[TopicEndpointInfo]:
        return [
            TopicEndpointInfo(
                node_name=end.node.decode(),
                node_namespace="/",
                topic_type=end.type,
                endpoint_gid=[*bytes.fromhex(end.prefix), 0, 0, number, 3],
                qos_profile=QoSProfile(depth=1),
            )
            for number, end in enumerate(self.ends)
            if (end.writes, end.topic) == (writes, topic.encode())
        ]

    def get_publishers_info_by_topic(self, topic: str, no_mangle: bool) -> list[TopicEndpointInfo]:
        """Return writers by DDS's name; raise at a node's name that is no UTF-8."""
        assert no_mangle
        return self._infos(True, topic)

    def get_subscriptions_info_by_topic(
        self, topic: str, no_mangle: bool
    ) -> list[TopicEndpointInfo]:
        """Return readers, likewise."""
        assert no_mangle
        return self._infos(False, topic)


Look = Callable[[Graph], GraphObserver]


@pytest.fixture
def look(monkeypatch: pytest.MonkeyPatch) -> Look:
    """Return an observer of what is given, which nothing wakes."""
    guard = SimpleNamespace(failure=None, follow=lambda *_: lambda: None, notify=lambda: False)
    monkeypatch.setattr(graph, "GraphGuard", SimpleNamespace(of=lambda _: guard))
    return GraphObserver.on  # type: ignore[return-value]


def node(name: str, prefix: str = ONE) -> End:
    return End(True, EVENTS[0].encode(), EVENTS[1], name.encode(), prefix)


def server(name: str, service: str, prefix: str = ONE) -> list[End]:
    return [
        End(
            False, f"rq{service}Request".encode(), TRIGGER.format("Request"), name.encode(), prefix
        ),
        End(True, f"rr{service}Reply".encode(), TRIGGER.format("Response"), name.encode(), prefix),
    ]


def talker(name: bytes, topic: bytes = b"rt/chatter", prefix: str = ONE) -> End:
    return End(True, topic, STRING, name, prefix)


def seen(observer: GraphObserver) -> list[tuple[str, str, str]]:
    names = DeclaredNames(names=frozenset({(EndpointKind.PUBLISHER, "/chatter")}))
    return [(each.node, each.name, each.type) for each in observer.snapshot(names=names)[1]]


def test_a_node_of_an_ended_process_is_nobody_while_discovery_shows_it(look: Look) -> None:
    observer = look(Graph([node("one"), node("one", TWO), talker(b"other", prefix=TWO)]))
    assert [(each.full_name, each.count) for each in observer.snapshot()[0]] == [
        ("/one", 2),
        ("/other", 1),
    ]
    observer.ended_participant(TWO)
    assert [(each.full_name, each.count) for each in observer.snapshot()[0]] == [("/one", 1)]
    assert seen(observer) == []


def test_a_node_that_has_nothing_but_a_service_is_one(look: Look) -> None:
    nodes, (endpoint,) = look(Graph(server("lamp", "/on"))).snapshot()
    assert [each.full_name for each in nodes] == ["/lamp"]
    assert (endpoint.node, endpoint.name, endpoint.gid[:24]) == ("/lamp", "/on", ONE)


def test_services_of_an_unknown_node_are_shown_where_they_are_looked_for(look: Look) -> None:
    unknown = "_NODE_NAME_UNKNOWN_"
    observer = look(Graph([*server(unknown, "/on"), *server(unknown, "/off", TWO)]))
    names = DeclaredNames(names=frozenset({(EndpointKind.SERVICE_SERVER, "/on")}))
    (endpoint,) = observer.snapshot(names=names)[1]
    assert (endpoint.node, endpoint.name, endpoint.gid[:24]) == ("", "/on", ONE)


def test_a_topic_that_is_no_utf_8_is_found_and_hides_only_what_was_not_known(look: Look) -> None:
    shown = Graph([node("one"), talker(b"one", b"rt/known"), talker(b"one")])
    bad = talker(b"one", b"rt/f\xffo")
    observer = look(shown)
    known = [("/one", "/chatter", "std_msgs/msg/String"), ("/one", "/known", "std_msgs/msg/String")]
    assert seen(observer) == known
    shown.ends += [bad, talker(b"one", b"rt/late")]
    assert seen(observer) == [("", "/f\\xffo", ""), *known]
    # What is declared is looked for by its name.
    assert seen(look(shown)) == [("", "/f\\xffo", ""), known[0]]


def test_a_topic_on_which_a_node_is_no_utf_8_is_one_of_an_unknown_node(look: Look) -> None:
    shown = Graph([node("one"), talker(b"one", b"rt/sound"), talker(b"one"), talker(b"\xff")])
    assert seen(look(shown)) == [("", "/chatter", ""), ("/one", "/sound", "std_msgs/msg/String")]
