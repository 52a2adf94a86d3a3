"""State in, verdict out: one changed fact, and exactly the findings that follow from it."""

from __future__ import annotations

import pytest
from msgspec.structs import replace

from lifecycle.manifest.model import EndpointKind, EndpointPolicy, Health, Policy, Run, RunKind
from lifecycle.manifest.qos import History, QosProfile, Reliability
from lifecycle.plan.build import build_plan
from lifecycle.plan.model import Plan
from lifecycle.verify.observation import EndpointReport, HealthReport, Observation
from lifecycle.verify.outcome import Outcome
from lifecycle.verify.rules.catalogue import node_of
from lifecycle.verify.verdict import Finding, Stage
from tests.builders import IMAGE, at, endpoint, node, planned, publisher, subscription, teleop
from tests.unit.verify.edits import (
    Edit,
    add_endpoint,
    add_node,
    both,
    change_announced_qos,
    change_configuration,
    change_endpoint,
    change_node,
    change_report,
    drop_endpoint,
    drop_node,
    drop_report,
)
from tests.unit.verify.lines import verify
from tests.unit.verify.perfect import perfect

PUB, SUB = EndpointKind.PUBLISHER, EndpointKind.SUBSCRIPTION
SERVER, CLIENT = EndpointKind.SERVICE_SERVER, EndpointKind.SERVICE_CLIENT
ACTION_SERVER, ACTION_CLIENT = EndpointKind.ACTION_SERVER, EndpointKind.ACTION_CLIENT
VIDEO, BATTERY, STATUS = "/robot/video", "/robot/battery", "/robot/status"
FLOW = "/robot/video: /robot/camera → /viewer"
ATTACH = Run(kind=RunKind.ATTACH)

PLAN = build_plan(teleop(), environment={})


def findings_after(edit: Edit, *, plan: Plan = PLAN, stage: Stage = Stage.CONNECTED) -> list[str]:
    """All that is found but `flow.unreported`, which has tests of its own."""
    verdict = verify(plan, edit(perfect(plan, stage)), stage=stage)
    return [
        f"{each.outcome.value} {each.rule}: {each.subject}"
        for each in verdict.findings
        if each.rule != "flow.unreported"
    ]


def the_finding(edit: Edit, *, plan: Plan = PLAN, stage: Stage = Stage.CONNECTED) -> Finding:
    found = verify(plan, edit(perfect(plan, stage)), stage=stage).findings
    (finding,) = (each for each in found if each.rule != "flow.unreported")
    return finding


@pytest.mark.parametrize("stage", Stage)
def test_a_system_exactly_as_planned_is_ok(stage: Stage):
    verdict = verify(PLAN, perfect(PLAN, stage), stage=stage)
    assert (verdict.verdict, verdict.blocking, verdict.findings) == (Outcome.OK, False, ())
    assert [flow.outcome for flow in verdict.flows] == [Outcome.OK] * 3


FIRES: dict[str, tuple[Edit, list[str]]] = {
    "nothing of a node is seen": (
        both(
            drop_node("/viewer"),
            drop_report("/viewer"),
            lambda seen: replace(
                seen, endpoints=tuple(e for e in seen.endpoints if e.node != "/viewer")
            ),
        ),
        ["violated graph.missing-node: /viewer", f"violated graph.unmatched-link: {FLOW}"],
    ),
    "a missing publisher of a link": (
        drop_endpoint(PUB, VIDEO),
        [f"violated graph.missing-endpoint: {VIDEO}", f"violated graph.unmatched-link: {FLOW}"],
    ),
    "an undeclared action server": (
        add_endpoint(ACTION_SERVER, "/viewer", "/extra", type="a/action/B"),
        ["violated graph.undeclared-action-server: /extra"],
    ),
    "an undeclared action client": (
        add_endpoint(ACTION_CLIENT, "/viewer", "/extra", type="a/action/B"),
        ["violated graph.undeclared-action-client: /extra"],
    ),
    "a part of an action that is not declared": (
        add_endpoint(PUB, "/viewer", "/lift/_action/feedback", gid="99"),
        ["violated graph.undeclared-publisher: /lift/_action/feedback"],
    ),
    "a publisher in a hidden participant that is not the owner's": (
        add_endpoint(PUB, "/robot/_camera_flow_0", "/extra", gid="99"),
        ["violated graph.undeclared-node: /robot/_camera_flow_0"],
    ),
    "a tool that publishes a part of a declared action": (
        add_endpoint(PUB, "/rviz2", "/robot/dock/_action/feedback"),
        ["violated graph.undeclared-publisher: /robot/dock/_action/feedback"],
    ),
    "a tool that serves a declared node's own service": (
        add_endpoint(SERVER, "/rviz2", "/viewer/get_state", type="lifecycle_msgs/srv/GetState"),
        ["violated graph.undeclared-service-server: /viewer/get_state"],
    ),
    "a node that calls itself one of our observers and publishes": (
        add_endpoint(PUB, "/_lifecycle_observer_1", STATUS, gid="99", qos=QosProfile()),
        [f"violated graph.undeclared-publisher: {STATUS}"],
    ),
    "a node that does not report": (
        drop_report("/robot/camera"),
        [
            "violated graph.undeclared-node: /robot/_camera_flow_0",
            "violated graph.undeclared-node: /robot/_camera_flow_1",
            "violated graph.missing-endpoint: /robot/video",
            "violated graph.missing-endpoint: /robot/battery",
            "unverifiable graph.qos-unverifiable: /robot/camera",
            "violated graph.unmatched-link: /robot/video: /robot/camera → /viewer",
            "violated config.missing-report: /robot/camera",
        ],
    ),
}


@pytest.mark.parametrize("case", FIRES)
def test_a_rule_fires_on(case: str):
    edit, expected = FIRES[case]
    assert findings_after(edit) == expected


SILENT: dict[str, Edit] = {
    "nodes of tools": both(
        add_node("/_ros2cli_42"),
        add_node("/launch_ros_4711"),
        add_node("/rqt_gui_py_node_1"),
        add_node("/rviz2"),
        add_node("/robot/transform_listener_impl_55d0c0ffee"),
    ),
    "a tool that listens with another QoS": both(
        add_node("/_ros2cli_42"),
        add_endpoint(SUB, "/_ros2cli_42", VIDEO, type=IMAGE, gid="99", qos=QosProfile(depth=0)),
    ),
    "endpoints of client libraries": both(
        *(
            add_endpoint(kind, "/viewer", name, type=type_, gid="")
            for kind, name, type_ in (
                (PUB, "/rosout", "rcl_interfaces/msg/Log"),
                (PUB, "/viewer/transition_event", "lifecycle_msgs/msg/TransitionEvent"),
                (SERVER, "/viewer/get_parameters", "rcl_interfaces/srv/GetParameters"),
                (SERVER, "/viewer/get_configuration", "std_srvs/srv/Trigger"),
                (CLIENT, "/robot/camera/change_state", "lifecycle_msgs/srv/ChangeState"),
            )
        )
    ),
    "client library endpoints of a hidden participant": add_endpoint(
        SERVER,
        "/robot/_camera_flow_0",
        "/robot/_camera_flow_0/get_parameters",
        type="rcl_interfaces/srv/GetParameters",
    ),
    "an endpoint whose node is only known by its GID": change_endpoint(PUB, STATUS, node=""),
    "a state that only the report tells": change_node("/viewer", state=None, managed=None),
    "lifecycle services that the graph does not show yet": change_node(
        "/viewer", state=None, managed=False
    ),
    "a state that only the graph tells": change_configuration("/viewer", state=""),
    "a client that is about to go": change_report(
        CLIENT, "/robot/camera/calibrate", mapped=False, server_matched=None
    ),
    "one end that reports no count": change_report(PUB, STATUS, matched=None),
    "a tool that listens": both(
        add_node("/_ros2cli_4711"),
        add_endpoint(SUB, "/_ros2cli_4711", STATUS, gid="99", qos=QosProfile(depth=0)),
        change_report(PUB, STATUS, matched=2),
    ),
    "a tool that asks": add_endpoint(CLIENT, "/rqt_gui_1", "/robot/camera/calibrate"),
    "a tool that publishes what nobody declared": add_endpoint(PUB, "/rviz2", "/goal_pose"),
    "what every node publishes": add_endpoint(PUB, "/rviz2", "/rosout"),
    "infinite durations however spelled": change_announced_qos(
        SUB, STATUS, deadline_ns=2**63 - 1, liveliness_lease_duration_ns=0
    ),
    "a subscription's lifespan, which DDS does not have": change_announced_qos(
        SUB, STATUS, lifespan_ns=5
    ),
}


@pytest.mark.parametrize("case", SILENT)
def test_no_rule_fires_on(case: str):
    assert findings_after(SILENT[case]) == []


def asking(health: Health) -> Plan:
    """The viewer is asked for its health."""
    nodes = (PLAN.nodes[0], replace(PLAN.nodes[1], health=health))
    assert nodes[1].key == "viewer"
    return replace(PLAN, nodes=nodes)


@pytest.mark.parametrize(
    ("health", "found"),
    [
        (HealthReport(ok=True), ""),
        (
            HealthReport(ok=False, message="no scan"),
            "violated node /viewer is not healthy: no scan",
        ),
        (
            HealthReport(ok=None, message="it is late"),
            "unverifiable nothing shows that node /viewer is healthy: it is late",
        ),
        (
            None,
            (
                "violated node /viewer is not healthy: it reports no health; its class needs a"
                " method 'health'"
            ),
        ),
    ],
)
def test_the_health_that_a_node_reports_is_judged_where_the_manifest_asks_it(
    health: HealthReport | None, found: str
):
    edit = change_configuration("/viewer", health=health)
    assert findings_after(edit) == []
    plan = asking(Health(check=True))
    verdict = verify(plan, edit(perfect(plan, Stage.ACTIVE)), stage=Stage.ACTIVE)
    assert "; ".join(f"{each.outcome.value} {each.message}" for each in verdict.findings) == found
    # What /diagnostics says of it counts as well, once it may publish.
    plan = asking(Health(check=True, diagnostics=("viewer: *",)))
    said = HealthReport(ok=False, message="'viewer: lens': dirty")
    seen = both(edit, change_node("/viewer", health=said))(perfect(plan, Stage.ACTIVE))
    *_, worse = verify(plan, seen, stage=Stage.ACTIVE).findings
    assert (worse.rule, worse.outcome) == ("node.unhealthy", Outcome.VIOLATED)
    assert health is None or worse.message.endswith("'viewer: lens': dirty")
    expected = [f"{found.partition(' ')[0]} node.unhealthy: /viewer"] * bool(found)
    assert findings_after(edit, plan=plan) == expected
    # It is asked from when it is connected.
    early = both(edit, change_configuration("/viewer", connected=False))
    assert findings_after(early, plan=plan) == ["violated state.wrong-state: /viewer"]


def test_a_handler_that_raised_at_its_last_goal_is_unhealthy_though_nobody_asks():
    report = EndpointReport(
        kind=EndpointKind.ACTION_SERVER,
        name="dock",
        resolved="/dock",
        type="nav/action/Dock",
        fault="its handler raised OSError: no such dock",
    )
    seen = perfect(PLAN, Stage.ACTIVE)
    before = next(each for each in seen.configurations if each.name == "/viewer")
    edit = change_configuration("/viewer", endpoints=(*before.endpoints, report))
    findings = verify(PLAN, edit(seen), stage=Stage.ACTIVE).findings
    (unhealthy,) = (each.message for each in findings if each.rule == "node.unhealthy")
    assert unhealthy == (
        "node /viewer is not healthy: action server 'dock': its handler raised "
        "OSError: no such dock"
    )


def test_a_node_that_has_ended_as_it_may_is_unverifiable_and_not_missing():
    seen = drop_node("/viewer")(perfect(PLAN))
    verdict = verify(PLAN, seen, stage=Stage.CONNECTED, over={"/viewer": "exit status 0"})
    (finding,) = (each for each in verdict.findings if each.node == "/viewer")
    assert (finding.rule, finding.outcome) == ("graph.ended-node", Outcome.UNVERIFIABLE)
    assert finding.observed == "exit status 0"
    from_outside = verify(PLAN, seen, stage=Stage.CONNECTED, over={"/viewer": ""})
    assert [each.observed for each in from_outside.findings if each.node == "/viewer"] == [
        "it has ended, or not started"
    ]
    both_gone = both(drop_node("/robot/camera"), drop_node("/viewer"))(perfect(PLAN))
    verdict = verify(PLAN, both_gone, stage=Stage.CONNECTED, over={"/robot/camera": ""})
    missing = [each.node for each in verdict.findings if each.rule == "graph.missing-node"]
    assert missing == ["/viewer"], "what has ended hides nobody who is missing"


# --- policies


def with_policy(**fields: object) -> Plan:
    return replace(PLAN, policy=Policy(**fields))


def test_an_open_world_tolerates_nodes_and_endpoints_of_others():
    plan = with_policy(undeclared_nodes=EndpointPolicy.OPEN)
    edit = both(
        add_node("/other"),
        add_endpoint(PUB, "/other", "/elsewhere", gid="98"),
        add_endpoint(PUB, "", "/nobody", gid="97"),
    )
    assert findings_after(edit, plan=plan) == []


def test_of_a_foreign_client_it_is_enough_that_its_server_is_there():
    reset = endpoint(CLIENT, "reset", "std_srvs/srv/Trigger", qos=None)
    plan = planned(
        node("base", endpoint(SERVER, "reset", "std_srvs/srv/Trigger", qos=None)),
        node("tool", reset, run=ATTACH, managed=False),
    )
    assert findings_after(lambda seen: seen, plan=plan) == []


# --- nodes that others start


def foreign(**rest: object) -> Plan:
    return planned(
        node("talker", publisher("chatter"), run=ATTACH, **rest),
        node("listener", subscription("chatter"), run=ATTACH, managed=False),
    )


@pytest.mark.parametrize("stage", Stage)
def test_of_a_foreign_system_only_its_flow_is_unverifiable(stage: Stage):
    plan = foreign()
    verdict = verify(plan, perfect(plan, stage), stage=stage)
    assert [(each.rule, each.outcome, each.subject) for each in verdict.findings] == [
        ("flow.unreported", Outcome.UNVERIFIABLE, "/chatter: /talker → /listener")
    ]


def test_all_flows_of_which_nothing_is_reported_are_one_finding():
    plan = planned(
        node("talker", *(publisher(f"t{n}") for n in range(9)), run=ATTACH, managed=False),
        node("listener", *(subscription(f"t{n}") for n in range(9)), run=ATTACH, managed=False),
    )
    (finding,) = verify(plan, perfect(plan, Stage.ACTIVE), stage=Stage.ACTIVE).findings
    assert (finding.rule, finding.subject) == ("flow.unreported", "9 flows")
    assert finding.message.endswith("/t5: /talker → /listener and 3 more")


def test_what_a_manifest_trusts_is_reported_and_does_not_count():
    plan = replace(foreign(), policy=Policy(trust=("flow.unreported",), unverifiable="block"))
    verdict = verify(plan, perfect(plan), stage=Stage.CONNECTED)
    assert (verdict.verdict, verdict.blocking) == (Outcome.OK, False)
    assert [each.rule for each in verdict.findings] == ["flow.unreported"]
    assert [each.outcome for each in verdict.flows] == [Outcome.UNVERIFIABLE]
    violated = verify(plan, drop_node("/talker")(perfect(plan)), stage=Stage.CONNECTED)
    assert violated.blocking


# --- what nobody wrote is not required


def hidden(reliability: Reliability, **policies: object) -> Edit:
    """Both ends of /chatter as Fast DDS announces them."""
    return both(
        *(
            change_announced_qos(
                kind,
                "/chatter",
                history=History.UNKNOWN,
                depth=0,
                reliability=reliability,
                **policies,
            )
            for kind in (PUB, SUB)
        )
    )


# --- definitions of types

HERE, OTHER = "RIHS01_" + "a" * 64, "RIHS01_" + "b" * 64


def defined(installed: str) -> Plan:
    """A foreign pair, and what is installed here of its type."""
    plan = foreign()
    nodes = []
    for each in plan.nodes:
        ends = (replace(end, type_hash=installed) for end in each.endpoints)
        nodes.append(replace(each, endpoints=tuple(ends)))
    return replace(plan, nodes=tuple(nodes))


def hashes(publishes: str | None, subscribes: str | None) -> Edit:
    return both(
        change_endpoint(PUB, "/chatter", type_hash=publishes),
        change_endpoint(SUB, "/chatter", type_hash=subscribes),
    )


def test_a_stranger_of_another_definition_does_not_put_declared_ends_in_the_wrong():
    """No definition is installed here, and the stranger comes first by alphabet."""
    plan = replace(defined(""), policy=Policy(undeclared_nodes=EndpointPolicy.OPEN))
    stranger = add_endpoint(PUB, "/a_guest", "/chatter", gid="99", type_hash=OTHER)
    verdict = verify(plan, both(hashes(HERE, HERE), stranger)(perfect(plan)), stage=Stage.CONNECTED)
    differing = [each for each in verdict.findings if each.rule == "graph.type-definition-differs"]
    assert [(each.node, each.observed[-64:]) for each in differing] == [("/a_guest", "b" * 64)]


def test_without_any_hash_there_is_nothing_to_compare():
    assert findings_after(hashes("", ""), plan=defined("")) == []
    assert findings_after(hashes(None, None), plan=defined(HERE)) == []


# --- what findings say


def test_an_endpoint_that_only_the_report_tells_of_is_undeclared_already():
    camera = perfect(PLAN).configurations[0]
    extra = replace(camera.endpoints[2], name="", resolved="/extra", gid="99")
    edit = change_configuration("/robot/camera", endpoints=(*camera.endpoints, extra))
    assert findings_after(edit) == ["violated graph.undeclared-publisher: /extra"]


@pytest.mark.parametrize(
    "placeholder",
    [
        "/_NODE_NAME_UNKNOWN_",
        "_NODE_NAMESPACE_UNKNOWN_/_NODE_NAME_UNKNOWN_",
        "_CREATED_BY_BARE_DDS_APP_/_CREATED_BY_BARE_DDS_APP_",
    ],
)
def test_a_placeholder_for_an_unknown_node_is_not_taken_for_a_name(placeholder: str):
    edit = both(add_node(placeholder), add_endpoint(PUB, placeholder, "/extra", gid="99"))
    assert findings_after(edit) == ["violated graph.unattributed-endpoint: /extra"]
    assert findings_after(change_endpoint(PUB, STATUS, node=placeholder)) == []


def test_what_is_declared_is_no_noise():
    plan = planned(
        node("rviz2", subscription("/clock"), subscription("/one/transition_event")),
        node("one", publisher("/rosout")),
    )
    assert findings_after(lambda seen: seen, plan=plan) == []
    assert findings_after(drop_endpoint(SUB, "/clock"), plan=plan) == [
        "violated graph.missing-endpoint: /clock"
    ]
    assert findings_after(drop_node("/rviz2"), plan=plan) == ["violated graph.missing-node: /rviz2"]


CYCLONE = "0110413d8c753ac053755be800000203"


@pytest.mark.parametrize("stage", list(Stage))
def test_a_writer_of_no_node_on_a_declared_topic_is_violated_at_every_stage(stage: Stage):
    edit = add_endpoint(PUB, "", STATUS, gid=CYCLONE, address="10.0.0.7", qos=QosProfile())
    finding = the_finding(edit, stage=stage)
    assert (finding.rule, finding.outcome) == ("graph.unattributed-endpoint", Outcome.VIOLATED)
    assert finding.message == (
        f"no known node has this publisher of {STATUS} (a participant of Cyclone DDS, at 10.0.0.7,"
        f" GID {CYCLONE})"
    )


def test_a_late_name_of_a_service_is_that_of_the_node_on_its_participant_that_declares_it():
    def edit(seen: Observation) -> Observation:
        camera = next(each for each in seen.configurations if each.name == "/robot/camera")
        prefix = next(each.gid for each in camera.endpoints if each.gid)[:24]
        calibrate = "/robot/camera/calibrate"
        nameless = {"type": "std_srvs/srv/Trigger", "gid": f"{prefix}00001204"}
        return add_endpoint(SERVER, "", calibrate, **nameless)(
            drop_endpoint(SERVER, calibrate)(seen)
        )

    assert findings_after(edit) == []


@pytest.mark.parametrize(
    ("tolerated", "name", "expected"),
    [
        (("teleop_*",), "/far/teleop_17", Outcome.OK),
        (("/far/*",), "/far/panel", Outcome.OK),
        (("/far/*",), "/near/panel", Outcome.VIOLATED),
        (("panel?",), "/panel", Outcome.VIOLATED),
        ((), "/rviz2", Outcome.VIOLATED),
        ((), "/_lifecycle_observer_7", Outcome.OK),
    ],
)
def test_the_manifest_says_whose_nodes_may_listen(
    tolerated: tuple[str, ...], name: str, expected: Outcome
):
    plan = replace(PLAN, policy=Policy(tolerated_nodes=tolerated))
    seen = both(add_node(name), add_endpoint(SUB, name, STATUS, gid="99", qos=QosProfile(depth=0)))(
        perfect(plan)
    )
    verdict = verify(plan, seen, stage=Stage.CONNECTED)
    assert verdict.verdict is expected
    if expected is Outcome.OK:
        assert [each.node for each in verdict.tolerated] == [name] * ("_lifecycle_" not in name)


@pytest.mark.parametrize(("subject", "name"), [("/robot/camera", "/robot/camera"), ("host", "")])
def test_a_subject_of_a_run_names_a_node_only_by_its_full_name(subject: str, name: str) -> None:
    assert node_of(subject) == name


COMMAND = Run(kind=RunKind.COMMAND, command=("/bin/talker",))


def test_a_command_that_has_another_name_is_looked_for_among_what_is_not_declared() -> None:
    plan = planned(node("speaker", run=COMMAND, managed=False))
    seen = Observation(nodes=(replace(perfect(plan).nodes[0], full_name="/talker"),))
    missing, undeclared = verify(plan, seen, stage=Stage.ACTIVE).findings
    assert (missing.rule, undeclared.rule) == ("graph.missing-node", "graph.undeclared-node")
    assert missing.hint.startswith("is it /talker?")
    assert undeclared.hint.startswith("if it is /speaker, which is missing, write a `name` there")


def test_a_command_that_is_given_its_name_may_have_given_it_to_each_of_its_nodes() -> None:
    plan = planned(node("talker", run=COMMAND, managed=False, positions={"name": at(4)}))
    assert "__node:=talker" in plan.processes[0].argv
    seen = change_node("/talker", count=2)(perfect(plan, Stage.ACTIVE))
    (finding,) = verify(plan, seen, stage=Stage.ACTIVE).findings
    assert finding.hint.startswith("`name` renames every node of process talker")
    missing = verify(plan, add_node("/other")(Observation()), stage=Stage.ACTIVE).findings[0]
    assert missing.hint.startswith("look at the node's process and its log; compare domain")
