"""Connections, mappings, media and what discovery cannot show: one changed fact, one finding."""

from __future__ import annotations

import msgspec
import pytest
from msgspec.structs import replace

from lifecycle.manifest.model import (
    Discovery,
    DiscoveryMode,
    EndpointKind,
    EndpointPolicy,
    Machine,
    Policy,
    Run,
    RunKind,
)
from lifecycle.manifest.qos import Durability, History, Liveliness, QosProfile, Reliability
from lifecycle.plan.model import ParticipantConnections, Plan, PlannedNode, PlannedParticipant
from lifecycle.verify.outcome import ConnectionReport, Outcome
from lifecycle.verify.verdict import Finding, Stage
from tests.builders import at, link, nfe, node, planned, publisher, subscription
from tests.unit.verify.edits import (
    Edit,
    add_endpoint,
    both,
    change_configuration,
    change_report,
    drop_endpoint,
    drop_node,
    drop_report,
    unchanged,
)
from tests.unit.verify.lines import lines, verify
from tests.unit.verify.perfect import perfect

PUB, SUB = EndpointKind.PUBLISHER, EndpointKind.SUBSCRIPTION
URL = "udpv4://10.77.0.1:7911?multicast=off&peer=10.77.0.2:7910"
FLOW = "/video: /camera → /viewer"


def connected(each: PlannedNode, *urls: str) -> PlannedNode:
    """The node with its first endpoint on a connection `net`."""
    name = f"_{each.name}_net"
    return replace(
        each,
        endpoints=(
            replace(each.endpoints[0], participant=name),
            *each.endpoints[1:],
        ),
        participants=(
            PlannedParticipant(
                name=name,
                dscp=None,
                reason="",
                connection="net",
                connections=ParticipantConnections(urls=urls or (URL,)),
            ),
        ),
    )


def plan_of(*, medium: str = "", linked: bool = False, run: Run | None = None) -> Plan:
    links = [link("/video", "camera", "viewer")] if linked else []
    options = {} if run is None else {"run": run}
    plan = planned(
        node("camera", publisher("video"), machine="robot", **options),
        node("viewer", subscription("video"), machine="operator"),
        links=links,
        machines=(
            Machine(name="robot", address="10.77.0.1", at=at(2)),
            Machine(name="operator", address="10.77.0.2", at=at(2)),
        ),
    )
    return replace(
        plan,
        nodes=(connected(plan.nodes[0]), plan.nodes[1]),
        flows=tuple(replace(each, medium=medium) for each in plan.flows),
    )


PLAN = plan_of()


def findings(edit: Edit, plan: Plan = PLAN, **how: object) -> list[tuple[str, str, str]]:
    verdict = verify(plan, edit(perfect(plan)), stage=Stage.CONNECTED, **how)
    return [(each.rule, each.outcome.value, each.subject) for each in verdict.findings]


def reported(*urls: str, name: str = "net", error: str = "") -> Edit:
    report = ConnectionReport(name=name, urls=urls, node_name="_camera_net", error=error)
    return change_configuration("/camera", connections=(report,))


def test_a_system_wired_as_planned_is_ok() -> None:
    assert findings(unchanged) == []


def test_a_url_may_be_spelled_in_another_order() -> None:
    other = "udpv4://10.77.0.1:7911?peer=10.77.0.2:7910&multicast=off"
    assert findings(reported(other)) == []


def told(edit: Edit, plan: Plan = PLAN) -> Finding:
    """The finding on a connection."""
    (finding,) = (
        each
        for each in verify(plan, edit(perfect(plan)), stage=Stage.CONNECTED).findings
        if each.rule.startswith("connection.")
    )
    return finding


def with_urls(*urls: str, first_port: int = 7910) -> Plan:
    """The plan with these URLs of the connection."""
    return replace(
        PLAN,
        nodes=(connected(PLAN.nodes[0], *urls), PLAN.nodes[1]),
        discovery=msgspec.structs.replace(PLAN.discovery, first_port=first_port),
    )


@pytest.mark.parametrize(
    ("planned_urls", "urls", "spelled"),
    [
        ((URL,), (), "no URL"),
        ((URL,), ("no url at all",), "no url at all"),
        (("shm://", URL), (URL,), URL),
        ((URL,), (URL, "shm://"), f"{URL}, shm://"),
        (("shm://", URL), (URL, "shm://"), f"{URL}, shm://"),
        (("shm://", URL), ("shm://", "udpv4://"), "shm://, udpv4://"),
    ],
)
def test_every_url_must_be_the_planned_one(
    planned_urls: tuple[str, ...], urls: tuple[str, ...], spelled: str
) -> None:
    finding = told(reported(*urls), with_urls(*planned_urls))
    assert (finding.rule, finding.observed) == ("connection.differs", spelled)
    assert finding.observed == spelled


TCP = "tcpv4://10.77.0.1:{port}?peer=10.77.0.2:{peer}"


@pytest.mark.parametrize(
    ("first_port", "port", "differs"),
    [(6000, 8000, False), (6001, 8000, True), (6001, 8001, False)],
)
def test_what_a_node_has_after_a_restart_is_as_planned(
    first_port: int, port: int, differs: bool
) -> None:
    plan = with_urls(URL, TCP.format(port=6100, peer=6101), first_port=first_port)
    found = findings(reported(URL, TCP.format(port=port, peer=8200)), plan)
    assert [each[0] for each in found] == (["connection.differs"] if differs else [])


def test_every_connection_and_mapping_of_a_node_is_judged() -> None:
    plain = PlannedParticipant(name="_camera_flow_0", dscp=None, reason="")
    (net,) = PLAN.nodes[0].participants
    late = replace(net, name="_camera_late", connection="late")
    camera = replace(PLAN.nodes[0], participants=(plain, net, late))
    plan = replace(PLAN, nodes=(camera, PLAN.nodes[1]))
    edit = both(
        change_configuration("/camera", connections=()),
        change_report(PUB, "/video", connection="other"),
    )
    found = [each for each in findings(edit, plan) if each[0].startswith("connection.")]
    assert found == [
        ("connection.missing", "violated", "/camera"),
        ("connection.missing", "violated", "/camera"),
        ("connection.wrong-mapping", "violated", "/video"),
    ]


def own_urls(*urls: str) -> Plan:
    """The plan with these URLs of the viewer's own participant."""
    viewer = replace(PLAN.nodes[1], connections=ParticipantConnections(urls=urls))
    return replace(PLAN, nodes=(PLAN.nodes[0], viewer))


OTHERS = tuple(ConnectionReport(name=name) for name in ("", "b", "a"))
OWN = (
    ConnectionReport(name="net", urls=("udpv6://",)),
    ConnectionReport(name="", urls=("udpv4://",)),
)
SAYS: dict[str, tuple[Edit, Plan, list[str]]] = {
    "a node has no connection": (
        change_configuration("/camera", connections=()),
        PLAN,
        ["violated connection.missing: /camera, /camera at 3:3"],
    ),
    "a node has other connections": (
        change_configuration("/camera", connections=OTHERS),
        PLAN,
        ["violated connection.missing: /camera, /camera at 3:3"],
    ),
    "a node does not report its connections": (
        unchanged,
        plan_of(run=Run(kind=RunKind.ATTACH)),
        ["unverifiable connection.missing: /camera, /camera at 3:3"],
    ),
    "a connection failed": (
        reported("shm://", URL, error="port 7911 is taken"),
        PLAN,
        ["violated connection.failed: /camera, /camera at 3:3"],
    ),
    "an own participant was connected otherwise": (
        change_configuration("/viewer", connections=OWN),
        own_urls("shm://"),
        ["violated connection.differs: /viewer, /viewer at 3:3"],
    ),
    "a publisher is mapped onto another connection": (
        change_report(PUB, "/video", connection="late"),
        PLAN,
        ["violated connection.wrong-mapping: /video, /camera (publisher) at 10:9"],
    ),
    "a publisher is mapped onto the own participant": (
        change_report(PUB, "/video", connection=""),
        PLAN,
        ["violated connection.wrong-mapping: /video, /camera (publisher) at 10:9"],
    ),
    "a subscription is mapped onto a connection": (
        change_report(SUB, "/video", connection="late"),
        PLAN,
        ["violated connection.wrong-mapping: /video, /viewer (subscription) at 10:9"],
    ),
}


@pytest.mark.parametrize("case", SAYS)
def test_what_is_found_of_a_connection_where(case: str) -> None:
    edit, plan, text = SAYS[case]
    assert lines([told(edit, plan)]) == text


@pytest.mark.parametrize(
    ("planned_urls", "urls"),
    [((), ("udpv4://",)), (("shm://",), ()), (("shm://",), ("shm://",)), ((), ())],
)
def test_an_own_participant_is_compared_where_both_say_what_it_is_connected_to(
    planned_urls: tuple[str, ...], urls: tuple[str, ...]
) -> None:
    own = (ConnectionReport(name="", urls=urls),)
    found = findings(change_configuration("/viewer", connections=own), own_urls(*planned_urls))
    assert [each for each in found if each[0].startswith("connection.")] == []


# --- what discovery cannot show

HIDDEN = both(drop_endpoint(PUB, "/video"), drop_node("/_camera_net"))


def test_an_endpoint_that_discovery_cannot_show_is_proven_by_report_and_matches() -> None:
    assert findings(HIDDEN) == []


@pytest.mark.parametrize(
    ("edit", "expected"),
    [
        (
            change_report(PUB, "/video", matched=None),
            ("graph.unseen-endpoint", "unverifiable", "/video"),
        ),
        (
            change_report(PUB, "/video", mapped=False, gid=""),
            ("graph.missing-endpoint", "violated", "/video"),
        ),
        (
            both(change_report(PUB, "/video", matched=0), change_report(SUB, "/video", matched=0)),
            ("graph.unmatched-flow", "violated", FLOW),
        ),
    ],
)
def test_without_such_a_proof_it_is_never_ok(edit: Edit, expected: tuple[str, str, str]) -> None:
    assert findings(both(HIDDEN, edit)) == [expected]


def test_more_matches_than_the_graph_explains_are_found_beside_it() -> None:
    assert findings(both(HIDDEN, change_report(PUB, "/video", matched=2))) == [
        ("graph.unseen-endpoint", "unverifiable", "/video"),
        ("graph.unknown-peer", "violated", "/video"),
    ]


def test_an_endpoint_on_a_participant_that_anybody_can_see_must_be_seen() -> None:
    assert findings(drop_endpoint(SUB, "/video")) != []
    plain = replace(
        PLAN.nodes[0],
        participants=(),
        endpoints=(replace(PLAN.nodes[0].endpoints[0], participant=""),),
    )
    plan = replace(PLAN, nodes=(plain, PLAN.nodes[1]))
    assert findings(drop_endpoint(PUB, "/video"), plan) == [
        ("graph.missing-endpoint", "violated", "/video")
    ]


BEYOND = replace(
    PLAN,
    discovery=Discovery(mode=DiscoveryMode.STATIC),
    nodes=tuple(
        replace(each, connections=ParticipantConnections(urls=("shm://",))) for each in PLAN.nodes
    ),
)
OPEN = Policy(undeclared_nodes=EndpointPolicy.OPEN)
RELIABLE = QosProfile(
    history=History.KEEP_LAST,
    depth=5,
    reliability=Reliability.RELIABLE,
    durability=Durability.VOLATILE,
    liveliness=Liveliness.AUTOMATIC,
)


def with_qos(plan: Plan, **declared: QosProfile) -> Plan:
    """The plan, in which the first endpoint of each of these nodes declares a profile."""
    return replace(
        plan,
        nodes=tuple(
            replace(each, endpoints=(replace(each.endpoints[0], qos=declared[each.key]),))
            if each.key in declared
            else each
            for each in plan.nodes
        ),
    )


NOTHING_OF_THE_CAMERA = both(HIDDEN, drop_node("/camera"), drop_report("/camera"))


def test_a_node_beyond_reach_is_unverifiable_and_its_flow_proven_by_who_hears_it() -> None:
    here = frozenset({"operator"})
    assert findings(NOTHING_OF_THE_CAMERA, BEYOND, machines=here) == [
        ("graph.missing-node", "unverifiable", "/camera")
    ]
    unheard = both(NOTHING_OF_THE_CAMERA, change_report(SUB, "/video", matched=0))
    assert findings(unheard, BEYOND, machines=here) == [
        ("graph.missing-node", "unverifiable", "/camera"),
        ("graph.unmatched-flow", "violated", FLOW),
    ]


@pytest.mark.parametrize(
    ("edit", "expected"),
    [
        # Neither end counts whom it is matched with.
        (
            drop_report("/viewer"),
            ("flow.unreported", "unverifiable", FLOW),
        ),
        # One match, and two publishers that may be it: what the camera only declares excludes none.
        (
            add_endpoint(PUB, "/other", "/video", qos=RELIABLE),
            ("graph.unmatched-flow", "unverifiable", FLOW),
        ),
    ],
)
def test_qos_that_nobody_observed_proves_no_flow(
    edit: Edit, expected: tuple[str, str, str]
) -> None:
    plan = replace(BEYOND, policy=OPEN)
    plan = with_qos(plan, camera=RELIABLE, viewer=RELIABLE)
    here = frozenset({"operator"})
    assert expected in findings(both(NOTHING_OF_THE_CAMERA, edit), plan, machines=here)
    # As declared the camera could not match: that is not seen, and so it is not left out either.
    plan = with_qos(plan, camera=replace(RELIABLE, reliability=Reliability.BEST_EFFORT))
    assert expected in findings(both(NOTHING_OF_THE_CAMERA, edit), plan, machines=here)


def test_of_a_node_beyond_reach_its_own_report_counts_and_not_what_it_declares() -> None:
    plan = with_qos(BEYOND, camera=RELIABLE, viewer=RELIABLE)
    here = frozenset({"operator"})
    shown = both(HIDDEN, drop_node("/camera"))
    out_of_reach = ("graph.missing-node", "unverifiable", "/camera")
    assert findings(shown, plan, machines=here) == [out_of_reach]
    otherwise = change_report(
        PUB, "/video", qos=replace(RELIABLE, reliability=Reliability.BEST_EFFORT)
    )
    found = findings(both(shown, otherwise), plan, machines=here)
    assert ("graph.qos-differs", "violated", "/video") in found
    assert ("graph.qos-incompatible", "violated", FLOW) in found
    unknown = change_report(PUB, "/video", qos=None)
    assert ("graph.qos-unverifiable", "unverifiable", "/camera") in findings(
        both(shown, unknown), plan, machines=here
    )


def test_a_node_of_our_own_machine_is_never_beyond_reach() -> None:
    found = findings(NOTHING_OF_THE_CAMERA, BEYOND, machines=frozenset({"robot", "operator"}))
    assert found[0] == ("graph.missing-node", "violated", "/camera")


# --- what carries a flow

WITH_UDP = change_report(PUB, "/video", nfes=(nfe("0.0.0.0", 40000),))


@pytest.mark.parametrize(
    ("medium", "outcome"),
    [("udpv4", None), ("tcpv4", "violated"), ("shm", "violated"), ("", None)],
)
def test_a_negotiated_medium_is_held_to(medium: str, outcome: str | None) -> None:
    expected = [] if outcome is None else [("flow.wrong-medium", outcome, FLOW)]
    assert findings(WITH_UDP, plan_of(medium=medium)) == expected


def test_a_medium_that_nobody_tells_is_unverifiable() -> None:
    unknown = both(change_report(PUB, "/video", nfes=None), change_report(SUB, "/video", nfes=None))
    assert ("flow.wrong-medium", "unverifiable", FLOW) in findings(unknown, plan_of(medium="udpv4"))


def test_a_medium_that_nobody_asked_for_is_only_expected() -> None:
    plan = planned(node("camera", publisher("video")), node("viewer", subscription("video")))
    expected = replace(plan, flows=tuple(replace(each, medium="udpv4") for each in plan.flows))
    assert verify(expected, perfect(expected), stage=Stage.CONNECTED).verdict is Outcome.OK
    asked = replace(expected, positions={"data_layer": at(5)})
    assert verify(asked, perfect(asked), stage=Stage.CONNECTED).verdict is Outcome.VIOLATED


def test_an_endpoint_that_a_node_may_make_is_no_finding() -> None:
    camera = replace(PLAN.nodes[0], endpoint_policy=EndpointPolicy.OPEN)
    plan = replace(PLAN, nodes=(camera, PLAN.nodes[1]))
    seen = add_endpoint(PUB, "/camera", "/news")(perfect(plan))
    verdict = verify(plan, seen, stage=Stage.CONNECTED)
    assert (verdict.verdict, verdict.findings) == (Outcome.OK, ())
    closed = verify(
        PLAN, add_endpoint(PUB, "/camera", "/news")(perfect(PLAN)), stage=Stage.CONNECTED
    )
    assert [each.rule for each in closed.findings] == ["graph.undeclared-publisher"]


REMAPPED = change_report(PUB, "/video", resolved="/stage/video")


@pytest.mark.parametrize("shown", ["shown", "hidden"])
def test_a_publisher_that_was_remapped_is_missing_whether_or_not_discovery_shows_it(shown: str):
    edit = both(REMAPPED, drop_endpoint(PUB, "/video"))
    if shown == "shown":
        gid = next(e.gid for e in perfect(PLAN).endpoints if e.name == "/video" and e.kind is PUB)
        edit = both(edit, add_endpoint(PUB, "/camera", "/stage/video", gid=gid, qos=None))
    assert findings(edit) == [
        ("graph.missing-endpoint", "violated", "/video"),
        ("graph.undeclared-publisher", "violated", "/stage/video"),
    ]
