"""What a node says of itself, under what its manifest says of it, as a party of a negotiation."""

from __future__ import annotations

import pytest
from msgspec.structs import replace

from lifecycle.manifest.diagnostics import Position
from lifecycle.manifest.model import EndpointKind, FlowTransport
from lifecycle.manifest.qos import QosProfile
from lifecycle.network.connection_url import Peer
from lifecycle.network.medium import CONNECTABLE, RMW_DEFAULT
from lifecycle.network.nfe import UniqueRequirement
from lifecycle.plan.discovery import Contact
from lifecycle.plan.media import Party
from lifecycle.plan.model import (
    ParticipantConnections,
    PlannedEndpoint,
    PlannedNode,
    PlannedParticipant,
)
from lifecycle.supervisor.connections.instructions import party_of
from lifecycle.verify.observation import NodeConfiguration
from lifecycle.verify.outcome import ConnectionReport
from tests.builders import configuration, need, node, planned, publisher, reported, subscription

PUB, SUB = EndpointKind.PUBLISHER, EndpointKind.SUBSCRIPTION
STRING = "std_msgs/msg/String"
URL = "tcpv4://10.0.0.1:5100"
STRICTLY, OPTIONALLY = UniqueRequirement.STRICTLY_REQUIRED, UniqueRequirement.OPTIONALLY_REQUIRED

VIDEO = reported(
    PUB, "video", qos=QosProfile(depth=3), unique=STRICTLY, lossy=True, size_bytes=70_000
)
CAMERA = configuration(
    "/camera",
    VIDEO,
    reported(EndpointKind.SERVICE_SERVER, "reset", "std_srvs/srv/Trigger"),
    process_id=42,
    transports=("udpv4", "tcpv4"),
)


def camera(**changes: object) -> NodeConfiguration:
    return replace(CAMERA, **changes)


def own_endpoint(
    configuration: NodeConfiguration, of: PlannedNode | None = None, **rest: object
) -> PlannedEndpoint:
    (endpoint,) = party_of(configuration, "h", planned=of, **rest).endpoints
    return endpoint


def video(**changes: object) -> NodeConfiguration:
    return camera(endpoints=(replace(VIDEO, **changes),))


def test_a_node_that_no_manifest_declares_takes_part_with_all_that_it_says():
    assert party_of(CAMERA, "10.0.0.1") == Party(
        key="/camera",
        host="10.0.0.1",
        process="42",
        transports=("udpv4", "tcpv4"),
        own=RMW_DEFAULT,
        connectable=True,
        endpoints=(
            PlannedEndpoint(
                kind=PUB,
                name="video",
                resolved="/video",
                type=STRING,
                qos=QosProfile(depth=3),
                unique=STRICTLY,
                lossy=True,
                max_message_size=70_000,
                at=Position(file="", line=1, column=1),
            ),
        ),
    )


def test_a_node_that_names_no_transports_can_be_connected_by_all():
    assert party_of(camera(transports=()), "h").transports == CONNECTABLE


def test_a_node_of_an_rmw_that_we_cannot_connect_has_no_transports_at_all():
    party = party_of(camera(rmw="rmw_cyclonedds_cpp"), "h")
    assert (party.transports, party.own, party.connectable) == ((), (), False)


# --- what the own participant was connected to

OWN = ConnectionReport(name="", urls=(URL,))
CONTACT = Contact(host="h", transport="tcpv4", peer=Peer(address="10.0.0.1", port=5100))


def test_the_own_participant_is_reached_where_the_node_says_that_it_is():
    other = ConnectionReport(name="net", urls=("shm://",))
    party = party_of(camera(connections=(other, OWN)), "h")
    assert (party.own, party.contacts) == (("tcpv4",), (CONTACT,))


def declared(**changes: object) -> PlannedNode:
    """The camera as its manifest declares it."""
    plan = planned(
        node(
            "cam",
            subscription("video"),
            publisher("video", qos=QosProfile(depth=7)),
            needs=[need(PUB, "video", OPTIONALLY)],
            name="camera",
        )
    )
    (only,) = plan.nodes
    return replace(only, **{"participants": (), **changes})


def with_endpoint(**changes: object) -> PlannedNode:
    """The camera with its publisher declared otherwise."""
    only = declared()
    first, last = only.endpoints
    return replace(only, endpoints=(first, replace(last, participant="", **changes)))


@pytest.mark.parametrize(
    ("reported", "own"),
    [((OWN,), ("tcpv4",)), ((ConnectionReport(name=""),), ("shm",)), ((), ("shm",))],
)
def test_planned_urls_of_the_own_participant_hold_until_the_node_reports_its_own(reported, own):
    planned_urls = ParticipantConnections(urls=("shm://",))
    party = party_of(camera(connections=reported), "h", planned=declared(connections=planned_urls))
    assert party.own == own


# --- what the manifest says wins


def test_a_declared_node_takes_part_under_its_key_and_with_what_is_declared_of_its_endpoints():
    party = party_of(CAMERA, "h", planned=with_endpoint(transport=FlowTransport.NETWORK))
    (video,) = party.endpoints
    assert (party.key, video.name, video.qos) == ("cam", "video", QosProfile(depth=7))
    assert (video.unique, video.transport) == (OPTIONALLY, FlowTransport.NETWORK)
    assert (video.lossy, video.max_message_size) == (True, 70_000)


@pytest.mark.parametrize(
    ("reported", "resolved"), [("/stage/video", "/stage/video"), ("", "/video")]
)
def test_a_declared_endpoint_is_where_its_node_says_that_it_is_now(reported, resolved):
    assert own_endpoint(video(resolved=reported), with_endpoint()).resolved == resolved


@pytest.mark.parametrize(
    ("written", "hint", "lossy"), [(None, True, True), (False, True, False), (True, None, True)]
)
def test_that_data_bear_loss_is_the_nodes_hint_only_where_the_manifest_says_nothing(
    written, hint, lossy
):
    assert own_endpoint(video(lossy=hint), with_endpoint(lossy=written)).lossy is lossy


# --- connections that are there already

NET = ConnectionReport(name="net", urls=(URL,))
BARE = ConnectionReport(name="bare")
MAPPED = replace(VIDEO, connection="net", mapped=True)


def connections(party: Party) -> set[str]:
    """Names of connections that are taken."""
    return {each.connection for each in party.participants} - {""}


def test_connections_that_somebody_else_made_are_taken_and_what_is_on_them_stays():
    seen = camera(connections=(OWN, BARE, NET), endpoints=(MAPPED,))
    party = party_of(seen, "h")
    assert connections(party) == {"bare", "net"}
    (video,) = party.endpoints
    assert (party.transports_at(video), party.may_move(video)) == (("tcpv4",), False)


def test_what_a_negotiation_made_before_it_may_unmake():
    seen = camera(connections=(NET, BARE), endpoints=(MAPPED,))
    party = party_of(seen, "h", negotiated={"net"})
    assert connections(party) == {"bare"}
    (video,) = party.endpoints
    assert (party.transports_at(video), party.may_move(video)) == (party.own, True)


def test_names_of_planned_connections_are_taken_beside_those_that_exist():
    carriers = tuple(
        PlannedParticipant(name=f"_camera_{name}", dscp=None, reason="", connection=name)
        for name in ("late", "")
    )
    party = party_of(camera(connections=(NET,)), "h", planned=declared(participants=carriers))
    assert connections(party) == {"late", "net"}
