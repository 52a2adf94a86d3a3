"""What the network sees of the article's example: destination and source ports, and DSCP.

Every property is looked up in packets that were captured where they leave the host, and each has a
control: the same nodes without the demand, which must show the opposite.
"""

from __future__ import annotations

import dataclasses
import signal
from collections.abc import Mapping
from typing import Any

import pytest

from tests.net.hosts import Hosts
from tests.net.running import UNIQUE, article, up_on_both
from tests.net.wire import Capture, Packet
from tests.ros.supervisor.running import Event

# A host that is slow to activate is a violation for the other meanwhile, and ends with its status.
pytestmark = pytest.mark.alone

_EF = 46
_AF41 = 34
_CS6 = 48

_MARKED: Mapping[str, Any] = {
    "nodes/n1/flows": {
        "publishers": {
            "video": {"unique": "strictly_required", "dscp": "EF"},
            "battery": {},
        }
    },
    # A DataReader's TRANSPORT_PRIORITY, as-is: TOS 0xC0 is CS6.
    "nodes/n2/flows": {"subscriptions": {"battery": {"transport_priority": 0xC0}}},
}
_TWO_MARKS: Mapping[str, Any] = {
    "nodes/n1/flows": {"publishers": {"video": {"dscp": "EF"}, "battery": {"dscp": "AF41"}}},
}


@dataclasses.dataclass(frozen=True)
class Seen:
    """One run as the network saw it, and as the supervisors judged it.

    Attributes:
        video: packets with messages of /video, as they left host A.
        battery: likewise.
        acknowledgements: packets in which the reader of /battery acknowledges, as they reached A.
        packets: everything that left or reached A.
        flows: the last verdict's, by topic.
    """

    video: list[Packet]
    battery: list[Packet]
    acknowledgements: list[Packet]
    packets: list[Packet]
    flows: dict[str, Event]

    def sent_by(self, participant: bytes) -> list[Packet]:
        """Packets that A sent and that belong to one participant."""
        return [each for each in self.packets if each.outgoing and each.participant == participant]


def _observe(
    tmp_path_factory: pytest.TempPathFactory,
    edit: Mapping[str, Any],
    variables: Mapping[str, str] | None = None,
) -> Seen:
    directory = tmp_path_factory.mktemp("wire")
    with Hosts() as hosts:
        left, right = hosts.bridged("A", "B")
        # Else the kernel would give a label to packets whose socket has none, ip-sysctl.
        left.run("sh", "-c", "echo 0 > /proc/sys/net/ipv6/auto_flowlabels")
        manifest = article(directory, left.ipv4, right.ipv4, edit=edit)
        # The capture is there before any process: nothing that is sent escapes it.
        with (
            Capture(left) as capture,
            up_on_both(left, right, manifest, runtime=directory, variables=variables) as ups,
        ):
            for up in ups:
                up.until("system", reached="active")
            video, battery = (capture.wait_data(topic, 20) for topic in ("/video", "/battery"))
            capture.wait(lambda: capture.acknowledgements("/battery", outgoing=False))
            flows = ups[0].of_kind("verdict")[-1]["verdict"]["flows"]
            for up in ups:
                up.signal(signal.SIGTERM)
            assert [up.finish() for up in ups] == [0, 0], [up.verdict for up in ups]
            return Seen(
                video=video,
                battery=battery,
                acknowledgements=capture.acknowledgements("/battery", outgoing=False),
                packets=capture.packets(),
                flows={each["topic"]: each for each in flows},
            )


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Seen:
    """Ordinary ROS 2: nothing is demanded."""
    return _observe(tmp_path_factory, {})


@pytest.fixture(scope="module")
def unique(tmp_path_factory: pytest.TempPathFactory) -> Seen:
    """Every end is unique."""
    return _observe(tmp_path_factory, UNIQUE)


@pytest.fixture(scope="module")
def marked(tmp_path_factory: pytest.TempPathFactory) -> Seen:
    """Video is marked EF, battery is not."""
    return _observe(tmp_path_factory, _MARKED)


@pytest.fixture(scope="module")
def marked_ipv6(tmp_path_factory: pytest.TempPathFactory) -> Seen:
    """Both are marked, each with a value of its own, and all goes by IPv6."""
    ipv6 = {"FASTDDS_BUILTIN_TRANSPORTS": "UDPv6"}
    return _observe(tmp_path_factory, _TWO_MARKS, ipv6)


def _destinations(packets: list[Packet]) -> set[int]:
    return {each.destination_port for each in packets}


def _sources(packets: list[Packet]) -> set[int]:
    return {each.source_port for each in packets}


def test_ordinarily_two_topics_are_one_flow(plain: Seen) -> None:
    assert len({each.flow for each in (*plain.video, *plain.battery)}) == 1
    assert {each.dscp for each in plain.packets} == {0}
    assert [each["unique"] for each in plain.flows.values()] == ["not", "not"]


def test_unique_subscriptions_of_one_node_receive_on_ports_of_their_own(unique: Seen) -> None:
    video, battery = _destinations(unique.video), _destinations(unique.battery)
    assert (len(video), len(battery), len(video | battery)) == (1, 1, 2)


def test_a_unique_publisher_sends_from_a_port_of_its_own(unique: Seen) -> None:
    video, battery = _sources(unique.video), _sources(unique.battery)
    assert (len(video), len(battery), len(video | battery)) == (1, 1, 2)


@pytest.mark.parametrize("topic", ["/video", "/battery"])
def test_the_flow_that_is_reported_is_the_flow_that_is_on_the_wire(
    unique: Seen, topic: str
) -> None:
    flow = unique.flows[topic]
    assert flow["unique"] == "strongly"
    packets = unique.video if topic == "/video" else unique.battery
    reported_source = {
        each["transport_port"] for each in flow["source"] if each["internet_address"] == "0.0.0.0"
    }
    reported_destination = {
        (each["internet_address"], each["transport_port"])
        for each in flow["destination"]
        if each["internet_address"]
    }
    assert _sources(packets) == reported_source
    assert {(each.destination, each.destination_port) for each in packets} == reported_destination


def test_nothing_else_is_sent_to_the_port_of_a_unique_subscription(unique: Seen) -> None:
    (port,) = _destinations(unique.video)
    (participant,) = {each.participant for each in unique.video}
    to_it = [each for each in unique.packets if each.outgoing and each.destination_port == port]
    assert {each.participant for each in to_it} == {participant}


def test_a_marked_publisher_carries_its_dscp_and_the_other_carries_none(marked: Seen) -> None:
    assert {each.dscp for each in marked.video} == {_EF}
    assert {each.dscp for each in marked.battery} == {0}
    assert {each.ecn for each in marked.video} == {0}
    assert marked.flows["/video"]["dscp"] == _EF
    assert marked.flows["/battery"]["dscp"] in {0, None}  # nobody asked for it to be read


def test_no_datagram_of_a_marked_publisher_left_unmarked_once_it_had_a_message(
    marked: Seen,
) -> None:
    (participant,) = {each.participant for each in marked.video}
    sent = marked.sent_by(participant)
    # Announcements precede the mark: a participant begins to announce itself as it is made.
    unmarked = [each.at_s for each in sent if each.dscp != _EF]
    assert max(unmarked, default=0.0) < min(each.at_s for each in marked.video)


def test_discovery_of_a_marked_participant_carries_the_mark_as_well(marked: Seen) -> None:
    (participant,) = {each.participant for each in marked.video}
    announced = [each for each in marked.sent_by(participant) if each.discovers]
    assert announced[-1].dscp == _EF
    (other,) = {each.participant for each in marked.battery}
    assert {each.dscp for each in marked.sent_by(other)} == {0}


def test_a_marked_subscription_acknowledges_with_its_dscp_and_the_data_carry_the_publishers(
    plain: Seen, marked: Seen
) -> None:
    assert {each.dscp for each in plain.acknowledgements} == {0}
    assert {(each.dscp, each.ecn) for each in marked.acknowledgements} == {(_CS6, 0)}
    assert {each.dscp for each in marked.battery} == {0}
    assert {topic: each["reader_dscp"] for topic, each in marked.flows.items()} == {
        "/video": None,
        "/battery": _CS6,
    }


def test_the_participant_of_a_marked_subscription_is_shared_with_no_other_reader(
    marked: Seen,
) -> None:
    (participant,) = {each.participant for each in marked.acknowledgements}
    others = {each.dscp for each in marked.packets if not each.outgoing} - {_CS6}
    assert others == {0}
    (reader,) = {
        guid
        for each in marked.acknowledgements
        for guid in each.acknowledges
        if guid[15] & 0xC0 == 0
    }
    assert reader[:12] == participant


def test_ipv6_flows_whose_label_is_shown_as_unset_have_none_on_the_wire(marked_ipv6: Seen) -> None:
    for topic, packets in (("/video", marked_ipv6.video), ("/battery", marked_ipv6.battery)):
        shown = {each["flow_label"] for each in marked_ipv6.flows[topic]["tuples"]}
        assert {each.flow_label for each in packets} == shown == {0}


def test_ipv6_flows_carry_one_dscp_per_publisher(marked_ipv6: Seen) -> None:
    assert {(each.ipv6, each.dscp) for each in marked_ipv6.video} == {(True, _EF)}
    assert {(each.ipv6, each.dscp) for each in marked_ipv6.battery} == {(True, _AF41)}
    assert {each.ecn for each in (*marked_ipv6.video, *marked_ipv6.battery)} == {0}
    assert {topic: each["dscp"] for topic, each in marked_ipv6.flows.items()} == {
        "/video": _EF,
        "/battery": _AF41,
    }
    assert {each["effective_transport"] for each in marked_ipv6.flows.values()} == {"udpv6"}
