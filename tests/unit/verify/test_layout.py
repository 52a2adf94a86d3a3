"""What is seen, laid beside what is planned: whose it is, and what is left over."""

from __future__ import annotations

import dataclasses

import pytest

from lifecycle.manifest.model import EndpointKind, Policy, Run, RunKind
from lifecycle.manifest.qos import QosProfile
from lifecycle.plan.build import build_plan
from lifecycle.plan.model import ParticipantConnections, Plan
from lifecycle.verify.matcher import lay_out
from lifecycle.verify.observation import (
    EndpointReport,
    Identity,
    NodeConfiguration,
    Observation,
    ObservedEndpoint,
)
from lifecycle.verify.outcome import ConnectionReport
from lifecycle.verify.verdict import Stage
from lifecycle.verify.view import Actual, SeenEndpoint, View
from tests.builders import (
    endpoint,
    node,
    planned,
    publisher,
    subscription,
    teleop,
)
from tests.unit.verify.edits import (
    Edit,
    add_configuration,
    add_endpoint,
    add_node,
    both,
    change_configuration,
    change_endpoint,
    change_node,
    change_report,
    drop_endpoint,
    drop_report,
)
from tests.unit.verify.perfect import perfect

PUB, SUB = EndpointKind.PUBLISHER, EndpointKind.SUBSCRIPTION
SERVER, CLIENT = EndpointKind.SERVICE_SERVER, EndpointKind.SERVICE_CLIENT
ACTION_SERVER = EndpointKind.ACTION_SERVER
STATUS = "/robot/status"
STRING, TRIGGER = "std_msgs/msg/String", "std_srvs/srv/Trigger"
ATTACH = Run(kind=RunKind.ATTACH)
PLAN = build_plan(teleop(), environment={})


def view_after(edit: Edit, plan: Plan = PLAN, **rest: object) -> View:
    return lay_out(plan, edit(perfect(plan)), Stage.CONNECTED, **rest)


def unchanged(seen: Observation) -> Observation:
    return seen


def actual(view: View, kind: EndpointKind, name: str) -> Actual:
    (found,) = (
        each for each in view.actual if (each.planned.kind, each.planned.resolved) == (kind, name)
    )
    return found


# --- nodes


def test_a_node_that_the_graph_lists_twice_counts_all_of_them() -> None:
    view = view_after(both(change_node("/viewer", count=2), add_node("/viewer", count=3)))
    assert view.observed["/viewer"].count == 5
    assert view.observed["/robot/camera"].count == 1


def test_nodes_are_sorted_without_tools_hidden_participants_and_placeholders() -> None:
    view = view_after(
        both(
            add_node("/zed"),
            add_node("/rviz2"),
            add_node("/robot/_camera_net"),
            carried("_camera_net"),
            add_node("/_NODE_NAME_UNKNOWN_"),
            add_node("/an_arm"),
        )
    )
    assert list(view.observed) == ["/an_arm", "/robot/camera", "/viewer", "/zed"]
    assert view.tools == {"/rviz2": "rviz2"}


def test_what_the_policy_tolerates_by_a_hidden_name_is_a_tool_and_no_participant() -> None:
    plan = planned(node("cam", publisher("a")))
    recorder = both(
        add_node("/_cam_recorder_1"), add_endpoint(SUB, "/_cam_recorder_1", "/a", gid="99")
    )
    assert view_after(recorder, plan).tools == {}
    tolerant = dataclasses.replace(plan, policy=Policy(tolerated_nodes=("_cam_recorder_*",)))
    view = view_after(recorder, tolerant)
    assert view.tools == {"/_cam_recorder_1": "_cam_recorder_*"}
    assert (view.undeclared, [each.name for each in view.of_tools]) == ((), ["/a"])


def test_a_declared_node_that_is_named_like_a_tool_or_a_hidden_one_is_no_tool() -> None:
    plan = planned(
        node("rviz2", publisher("a")),
        node("cam", publisher("b")),
        node("_cam_net", publisher("c")),
    )
    view = view_after(unchanged, plan)
    assert list(view.observed) == ["/_cam_net", "/cam", "/rviz2"]
    assert view.tools == {}
    assert [each.observed.node for each in view.actual if each.observed] == [
        "/rviz2",
        "/cam",
        "/_cam_net",
    ]


def test_what_belongs_to_nobody_known_and_to_others_is_kept_apart() -> None:
    view = view_after(
        both(
            add_endpoint(PUB, "", "/b", gid="2"),
            add_endpoint(PUB, "_NODE_NAMESPACE_UNKNOWN_/_NODE_NAME_UNKNOWN_", "/a", gid="1"),
            add_endpoint(PUB, "/other", "/c", gid="3"),
            add_endpoint(PUB, "/another", "/d", gid="4"),
        )
    )
    assert [(each.node, each.name, each.gid) for each in view.unattributed] == [
        ("", "/a", "1"),
        ("", "/b", "2"),
    ]
    assert [(each.node, each.name, each.gid) for each in view.foreign] == [
        ("/another", "/d", "4"),
        ("/other", "/c", "3"),
    ]


# --- reports


def twin(node_id: str, **fields: object) -> NodeConfiguration:
    viewer = perfect(PLAN).configurations[1]
    identity = Identity(machine_id="m", process_id=7, node_id=node_id)
    return dataclasses.replace(viewer, identity=identity, **fields)


@pytest.mark.parametrize("names", [("a", "b", "c"), ("c", "b", "a"), ("b", "c", "a")])
def test_of_several_reports_of_one_name_the_first_by_identity_counts(names) -> None:
    edit = both(drop_report("/viewer"), *(add_configuration(twin(each)) for each in names))
    view = view_after(edit)
    assert [each.identity.node_id[:1] for each in view.reported] == ["/", "a", "b", "c"]
    assert view.configurations["/viewer"].identity.node_id == "a"
    assert view.configurations["/viewer"] is actual_report_owner(view)


def actual_report_owner(view: View) -> NodeConfiguration:
    """The report that the viewer's endpoints are taken from."""
    report = actual(view, SUB, STATUS).report
    return next(each for each in view.reported if any(report is end for end in each.endpoints))


# --- whose an endpoint is


def test_an_endpoint_of_a_hidden_participant_is_its_nodes() -> None:
    gid = PREFIX + "00001203"
    extra = add_endpoint(PUB, "/robot/_camera_net", "/extra", gid=gid)
    view = view_after(both(extra, carried("_camera_net")))
    assert view.undeclared == (
        ObservedEndpoint(
            kind=PUB, node="/robot/camera", name="/extra", type=STRING, qos=None, gid=gid
        ),
    )


def test_a_hidden_node_that_its_owner_does_not_report_is_a_stranger() -> None:
    extra = add_endpoint(PUB, "/robot/_camera_net", "/extra", gid=PREFIX + "00001203")
    for edit in (extra, both(extra, carried("_camera_net", prefix="09" * 12))):
        view = view_after(edit)
        assert (view.undeclared, [each.name for each in view.foreign]) == ((), ["/extra"])


def carried(*hidden: str, prefix: str = "") -> Edit:
    """The camera reports further participants."""

    def edit(seen: Observation) -> Observation:
        camera = next(each for each in seen.configurations if each.name == "/robot/camera")
        more = tuple(
            ConnectionReport(name="net", node_name=each, prefix=prefix or PREFIX) for each in hidden
        )
        return change_configuration("/robot/camera", connections=(*camera.connections, *more))(seen)

    return edit


PREFIX = "01" * 12


def test_an_endpoint_of_no_node_is_the_one_that_reported_its_gid() -> None:
    view = view_after(change_endpoint(PUB, STATUS, node=""))
    found = actual(view, PUB, STATUS).observed
    assert found is not None
    assert (found.node, found.gid) == ("/robot/camera", actual(view, PUB, STATUS).report.gid)
    assert view.unattributed == ()


def nameless_service(name: str, kind: EndpointKind = SERVER, type_: str = TRIGGER) -> Edit:
    """A service of an unknown node on the participant of the camera's publishers."""

    def edit(seen: Observation) -> Observation:
        camera = next(each for each in seen.configurations if each.name == "/robot/camera")
        prefix = camera.endpoints[2].gid[:24]
        return add_endpoint(kind, "", name, type=type_, gid=f"{prefix}00001204")(seen)

    return edit


def test_a_service_of_no_node_is_that_of_the_node_on_its_participant_that_declares_it() -> None:
    calibrate = "/robot/camera/calibrate"
    view = view_after(both(drop_endpoint(SERVER, calibrate), nameless_service(calibrate)))
    assert actual(view, SERVER, calibrate).observed == ObservedEndpoint(
        kind=SERVER, node="/robot/camera", name=calibrate, type=TRIGGER
    )
    for other in (nameless_service("/other"), nameless_service(calibrate, CLIENT)):
        (found,) = view_after(other).unattributed
        assert (found.node, found.gid[24:]) == ("", "00001204")


def test_a_part_of_an_action_of_no_node_is_that_of_the_node_that_declares_the_action() -> None:
    dock = "/robot/dock/_action"
    view = view_after(nameless_service(f"{dock}/send_goal", type_="robot/action/Dock_SendGoal"))
    assert (view.unattributed, view.undeclared, view.foreign) == ((), (), ())
    view = view_after(nameless_service("/other/_action/send_goal"))
    assert [each.name for each in view.unattributed] == ["/other/_action/send_goal"]


def test_housekeeping_of_a_stranger_is_left_in_where_it_serves_what_is_declared() -> None:
    of_parameters = "rcl_interfaces/srv/GetParameters"
    serves = both(
        add_endpoint(SERVER, "/guest", "/guest/get_parameters", type=of_parameters),
        add_endpoint(SERVER, "/other", "/other/get_parameters", type=of_parameters),
    )
    asks = endpoint(CLIENT, "/guest/get_parameters", of_parameters, None)
    view = view_after(serves, planned(node("one", asks)))
    assert [each.name for each in view.foreign] == ["/guest/get_parameters"]


def test_a_topic_of_no_node_is_nobodys_although_its_participant_is_known() -> None:
    view = view_after(nameless_service(STATUS, PUB, STRING))
    assert [(each.node, each.name) for each in view.unattributed] == [("", STATUS)]


# --- matching


def test_an_endpoint_of_the_declared_type_is_matched_before_one_of_another() -> None:
    plan = planned(
        node(
            "one", publisher("a"), publisher("/a", "std_msgs/msg/Int32"), run=ATTACH, managed=False
        )
    )
    view = lay_out(plan, reverse(perfect(plan)), Stage.CONNECTED)
    assert [each.observed.type for each in view.actual if each.observed] == [
        STRING,
        "std_msgs/msg/Int32",
    ]
    edit = change_endpoint(PUB, "/a", type="std_msgs/msg/Int32")
    view = lay_out(plan, edit(perfect(plan)), Stage.CONNECTED)
    assert [each.observed is not None for each in view.actual] == [True, True]
    assert view.undeclared == ()


def reverse(seen: Observation) -> Observation:
    return dataclasses.replace(seen, endpoints=seen.endpoints[::-1])


def test_reports_are_matched_by_their_declared_name_before_their_resolved_one() -> None:
    plan = planned(node("one", publisher("a"), publisher("b")))
    a, b = perfect(plan).configurations[0].endpoints
    swapped = change_configuration("/one", endpoints=(b, a))
    view = view_after(swapped, plan)
    assert [each.report for each in view.actual] == [a, b]
    nameless = dataclasses.replace(a, name="")
    view = view_after(change_configuration("/one", endpoints=(b, nameless)), plan)
    assert [each.report for each in view.actual] == [nameless, b]
    named_otherwise = dataclasses.replace(a, name="c")
    view = view_after(change_configuration("/one", endpoints=(b, named_otherwise)), plan)
    assert [each.report for each in view.actual] == [None, b]


def test_a_nameless_report_of_the_declared_type_is_chosen_before_one_of_another() -> None:
    plan = planned(node("one", publisher("a"), publisher("/a", "std_msgs/msg/Int32")))
    first, second = (
        dataclasses.replace(each, name="") for each in perfect(plan).configurations[0].endpoints
    )
    view = view_after(change_configuration("/one", endpoints=(second, first)), plan)
    assert [each.report for each in view.actual] == [first, second]
    wrong = dataclasses.replace(first, type="std_msgs/msg/Bool")
    seen = change_configuration("/one", endpoints=(wrong, second))(perfect(plan))
    shown = dataclasses.replace(seen.endpoints[0], type="std_msgs/msg/Bool")
    seen = dataclasses.replace(seen, endpoints=(shown, *seen.endpoints[1:]))
    view = lay_out(plan, seen, Stage.CONNECTED)
    assert [each.report for each in view.actual] == [wrong, second]
    assert [each.observed for each in view.actual] == list(seen.endpoints)


def test_a_nameless_report_of_the_declared_type_is_chosen_where_discovery_shows_none() -> None:
    plan = connected("udpv4://10.0.0.1:7911")
    report = perfect(plan).configurations[0].endpoints[0]
    right = dataclasses.replace(report, name="")
    wrong = dataclasses.replace(right, type="std_msgs/msg/Int32", gid="99")
    edit = both(drop_endpoint(PUB, "/a"), change_configuration("/one", endpoints=(wrong, right)))
    view = view_after(edit, plan)
    assert actual(view, PUB, "/a").report == right
    assert actual(view, PUB, "/a").observed.type == STRING
    assert [each.type for each in view.undeclared] == ["std_msgs/msg/Int32"]


def test_a_report_of_another_type_is_not_taken_from_the_endpoint_that_it_is_on() -> None:
    plan = planned(node("one", publisher("a"), publisher("/a", "std_msgs/msg/Int32")))
    second = perfect(plan).configurations[0].endpoints[1]
    nameless = dataclasses.replace(second, name="")
    edit = both(drop_endpoint(PUB, "/a"), change_configuration("/one", endpoints=(nameless,)))
    assert [each.report for each in view_after(edit, plan).actual] == [None, nameless]


def test_of_several_endpoints_of_one_name_the_one_with_the_reported_gid_is_the_declared() -> None:
    seen = perfect(PLAN)
    gid = next(each.gid for each in seen.endpoints if (each.kind, each.name) == (PUB, STATUS))
    for other in ("00", "ff" * 16):
        view = view_after(add_endpoint(PUB, "/robot/camera", STATUS, gid=other, qos=QosProfile()))
        assert actual(view, PUB, STATUS).observed.gid == gid
        assert [each.gid for each in view.undeclared] == [other]


def test_a_service_that_is_seen_by_name_only_stands_for_all_of_its_node() -> None:
    calibrate = "/robot/camera/calibrate"
    view = view_after(add_endpoint(SERVER, "/robot/camera", calibrate, type=TRIGGER))
    assert actual(view, SERVER, calibrate).observed is not None
    assert view.undeclared == ()


def test_nothing_is_left_over_of_two_nodes_of_one_name() -> None:
    extra = add_endpoint(PUB, "/viewer", "/extra", gid="99")
    assert [each.name for each in view_after(extra).undeclared] == ["/extra"]
    assert view_after(both(extra, change_node("/viewer", count=2))).undeclared == ()
    other = both(extra, change_node("/robot/camera", count=2))
    assert [each.name for each in view_after(other).undeclared] == ["/extra"]


def test_what_only_a_report_says_is_left_over_with_all_that_it_says() -> None:
    report = EndpointReport(
        kind=PUB,
        name="",
        resolved="/extra",
        type=STRING,
        qos=QosProfile(depth=3),
        gid="99",
        type_hash="RIHS01_aa",
        mapped=True,
    )
    camera = perfect(PLAN).configurations[0]
    edit = change_configuration("/robot/camera", endpoints=(*camera.endpoints, report))
    found = ObservedEndpoint(
        kind=PUB,
        node="/robot/camera",
        name="/extra",
        type=STRING,
        qos=QosProfile(depth=3),
        gid="99",
        type_hash="RIHS01_aa",
    )
    assert view_after(edit).undeclared == (found,)
    shown = both(edit, add_endpoint(PUB, "/robot/camera", "/extra", gid="99"))
    assert [each.qos for each in view_after(shown).undeclared] == [None]


def test_what_client_libraries_bring_along_is_not_left_over_of_a_report_either() -> None:
    rosout = EndpointReport(kind=PUB, name="", resolved="/rosout", type="rcl_interfaces/msg/Log")
    remap = EndpointReport(
        kind=SERVER,
        name="",
        resolved="/robot/camera/remap",
        type="rcl_interfaces/srv/SetParameters",
    )
    own = dataclasses.replace(remap, type=TRIGGER)
    camera = perfect(PLAN).configurations[0]
    for told, left_over in (((rosout, remap), []), ((rosout, own), [own.resolved])):
        edit = change_configuration("/robot/camera", endpoints=(*camera.endpoints, *told))
        assert [each.name for each in view_after(edit).undeclared] == left_over


def test_what_client_libraries_bring_along_hides_nothing_that_is_seen_after_it() -> None:
    seen = perfect(PLAN)
    rosout = ObservedEndpoint(
        kind=PUB, node="/robot/camera", name="/rosout", type="rcl_interfaces/msg/Log", gid="99"
    )
    seen = dataclasses.replace(seen, endpoints=(rosout, *seen.endpoints))
    view = lay_out(PLAN, seen, Stage.CONNECTED)
    assert all(each.observed for each in view.actual)
    assert view.undeclared == ()


def test_parts_of_an_action_that_is_declared_or_seen_are_not_left_over() -> None:
    feedback = "robot/action/Dock_FeedbackMessage"
    part = add_endpoint(
        PUB, "/robot/camera", "/robot/dock/_action/feedback", gid="99", type=feedback
    )
    assert len(view_after(part).undeclared) == 1  # of a second one
    assert view_after(both(part, drop_endpoint(ACTION_SERVER, "/robot/dock"))).undeclared == ()
    other = add_endpoint(PUB, "/robot/camera", "/lift/_action/feedback", gid="99")
    assert [each.name for each in view_after(other).undeclared] == ["/lift/_action/feedback"]
    remote_nodes = add_endpoint(PUB, "/viewer", "/robot/dock/_action/feedback", gid="99")
    assert [each.node for each in view_after(remote_nodes).undeclared] == ["/viewer"]
    lift = add_endpoint(ACTION_SERVER, "/robot/camera", "/lift", type="a/action/B")
    assert [each.name for each in view_after(both(other, lift)).undeclared] == [
        "/lift",
        "/lift/_action/feedback",
    ]


# --- what discovery need not show


def connected(url: str) -> Plan:
    """Two nodes that are told how to connect, each on its machine."""
    plan = planned(
        node("one", publisher("a"), machine="m1"),
        node("two", subscription("a"), subscription("b"), machine="m2"),
    )
    connections = ParticipantConnections(urls=(url,))
    return dataclasses.replace(
        plan, nodes=tuple(dataclasses.replace(each, connections=connections) for each in plan.nodes)
    )


def test_an_endpoint_that_discovery_need_not_show_is_as_its_node_says() -> None:
    plan = connected("udpv4://10.0.0.1:7911")
    edit = both(
        drop_endpoint(PUB, "/a"),
        change_report(PUB, "/a", qos=QosProfile(depth=3), type_hash="RIHS01_aa"),
    )
    found = actual(view_after(edit, plan), PUB, "/a")
    assert found.unseen
    assert found.observed == ObservedEndpoint(
        kind=PUB,
        node="/one",
        name="/a",
        type=STRING,
        qos=QosProfile(depth=3),
        gid=found.report.gid,
        type_hash="RIHS01_aa",
    )
    (seen,) = (each for each in view_after(edit, plan).seen if each.kind is PUB)
    assert seen == SeenEndpoint(
        kind=PUB,
        node="/one",
        name="/a",
        type=STRING,
        qos=QosProfile(depth=3),
        report=found.report,
        planned=found.planned,
        type_hash="RIHS01_aa",
    )
    for gone in (
        drop_report("/one"),
        change_report(PUB, "/a", mapped=False),
        change_report(PUB, "/a", error="no"),
        change_report(PUB, "/a", resolved="/b"),
    ):
        view = view_after(both(drop_endpoint(PUB, "/a"), gone), plan)
        found = actual(view, PUB, "/a")
        assert (found.unseen, found.observed) == (True, None)
        assert [each.kind for each in view.seen] == [SUB, SUB]
    must_show = view_after(drop_endpoint(PUB, "/a"), planned(node("one", publisher("a"))))
    assert (must_show.actual[0].unseen, must_show.actual[0].observed) == (False, None)


@pytest.mark.parametrize(
    ("url", "machines", "beyond"),
    [
        ("shm://", {"m1"}, ["/two"]),
        ("shm://", {"m2"}, ["/one"]),
        ("shm://", {"m1", "m2"}, []),
        ("shm://", None, []),
        ("udpv4://10.0.0.1:7911", {"m1"}, []),
    ],
)
def test_shared_memory_of_a_machine_that_others_bring_up_is_beyond_reach(
    url: str, machines: set[str] | None, beyond: list[str]
) -> None:
    ours = None if machines is None else frozenset(machines)
    view = view_after(unchanged, connected(url), machines=ours)
    assert list(dict.fromkeys(each.node.full_name for each in view.actual if each.beyond)) == beyond


def test_who_is_beyond_reach_counts_among_what_is_seen_as_it_is_planned() -> None:
    plan = connected("shm://")
    view = lay_out(plan, Observation(), Stage.CONNECTED, machines=frozenset({"m1"}))
    assert view.seen == tuple(
        SeenEndpoint(
            kind=SUB,
            node="/two",
            name=each.resolved,
            type=STRING,
            qos=each.qos,
            report=None,
            planned=each,
        )
        for each in plan.nodes[1].endpoints
    )


# --- what is seen of topics


@pytest.mark.parametrize(
    ("shown", "reported", "known"),
    [
        ("d", "r", "d"),
        ("", "r", "r"),
        (None, "r", "r"),
        (None, "", ""),
        ("", None, ""),
        ("d", None, "d"),
        (None, None, None),
    ],
)
def test_the_hash_that_discovery_shows_wins_over_the_reported_one(shown, reported, known) -> None:
    edit = both(
        change_endpoint(PUB, STATUS, type_hash=shown),
        change_report(PUB, STATUS, type_hash=reported),
    )
    (seen,) = (each for each in view_after(edit).seen if (each.kind, each.name) == (PUB, STATUS))
    assert seen.type_hash == known
    foreign = add_endpoint(PUB, "/guest", "/x", gid="99", type_hash=shown)
    (seen,) = (each for each in view_after(foreign).seen if each.node == "/guest")
    assert seen.type_hash == shown


# --- flows
