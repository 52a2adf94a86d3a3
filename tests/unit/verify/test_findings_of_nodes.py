"""What is found of nodes, their endpoints, types, states and reports, case by case."""

from __future__ import annotations

from typing import NamedTuple

import pytest
from msgspec.structs import replace

from lifecycle.manifest.model import EndpointKind, EndpointPolicy, Policy, Run, RunKind
from lifecycle.manifest.qos import QosProfile
from lifecycle.plan.build import build_plan
from lifecycle.plan.model import ParticipantConnections, Plan, PlannedParticipant
from lifecycle.verify.observation import Identity, NodeConfiguration
from lifecycle.verify.rules.endpoints import differ
from lifecycle.verify.verdict import Finding, Stage
from tests.builders import node, planned, publisher, subscription, teleop
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
    drop_endpoint_report,
    drop_node,
    drop_report,
)
from tests.unit.verify.lines import lines, verify
from tests.unit.verify.perfect import perfect

PUB, SUB = EndpointKind.PUBLISHER, EndpointKind.SUBSCRIPTION
SERVER, CLIENT = EndpointKind.SERVICE_SERVER, EndpointKind.SERVICE_CLIENT
ACTION_SERVER, ACTION_CLIENT = EndpointKind.ACTION_SERVER, EndpointKind.ACTION_CLIENT
STATUS, CALIBRATE, DOCK = "/robot/status", "/robot/camera/calibrate", "/robot/dock"
TRIGGER = "std_srvs/srv/Trigger"
HERE, OTHER = "RIHS01_" + "a" * 8, "RIHS01_" + "b" * 8

PLAN = build_plan(teleop(), environment={})
OPEN = replace(PLAN, policy=Policy(undeclared_nodes=EndpointPolicy.OPEN))
FOREIGN = planned(
    node("talker", publisher("chatter"), run=Run(kind=RunKind.ATTACH)),
    node("listener", subscription("chatter"), run=Run(kind=RunKind.ATTACH), managed=False),
)


def wired(plan: Plan, key: str, *urls: str) -> Plan:
    """The plan with all endpoints of a node on one connection, which others need not see."""
    nodes = []
    for each in plan.nodes:
        if each.key == key:
            net = PlannedParticipant(
                name=f"_{each.name}_net",
                dscp=None,
                reason="",
                connection="net",
                connections=ParticipantConnections(urls=urls or ("udpv4://10.77.0.1:7911",)),
            )
            each = replace(  # noqa: PLW2901
                each,
                endpoints=tuple(replace(end, participant=net.name) for end in each.endpoints),
                participants=(net,),
            )
        nodes.append(each)
    return replace(plan, nodes=tuple(nodes))


class Case(NamedTuple):
    """What is seen, and of which rule the findings are compared."""

    rule: str
    edit: Edit
    plan: Plan = PLAN
    stage: Stage = Stage.CONNECTED
    machines: frozenset[str] | None = None


def findings_of(case: Case) -> list[Finding]:
    seen = case.edit(perfect(case.plan, case.stage))
    verdict = verify(case.plan, seen, stage=case.stage, machines=case.machines)
    return [each for each in verdict.findings if each.rule == case.rule]


def defined(plan: Plan, installed: str) -> Plan:
    """The plan with this definition of every type installed here."""
    nodes = tuple(
        replace(
            each,
            endpoints=tuple(replace(end, type_hash=installed) for end in each.endpoints),
        )
        for each in plan.nodes
    )
    return replace(plan, nodes=nodes)


def twin(number: int) -> NodeConfiguration:
    """The report of a second node of the camera's name."""
    identity = Identity(machine_id="other", process_id=number, node_id=f"/robot/camera@{number}")
    return replace(perfect(PLAN).configurations[0], identity=identity)


FAR_CAMERA = replace(
    PLAN,
    nodes=(
        replace(PLAN.nodes[0], connections=ParticipantConnections(urls=("shm://",))),
        PLAN.nodes[1],
    ),
)
OPEN_TO_OTHERS = planned(
    node("talker", publisher("chatter")),
    policy=Policy(undeclared_nodes=EndpointPolicy.OPEN),
)


SAYS: dict[str, tuple[Case, list[str]]] = {
    "a node asks a service that it does not declare": (
        Case(
            "graph.undeclared-service-client",
            add_endpoint(CLIENT, "/viewer", "/other", type=TRIGGER),
        ),
        ["violated graph.undeclared-service-client: /other, /viewer (service client) at 3:3"],
    ),
    "a node is missing": (
        Case("graph.missing-node", drop_node("/viewer")),
        ["violated graph.missing-node: /viewer, /viewer at 3:3"],
    ),
    "nodes are missing that others start": (
        Case("graph.missing-node", lambda seen: replace(seen, nodes=()), FOREIGN),
        [
            "violated graph.missing-node: /talker, /talker at 3:3",
            "violated graph.missing-node: /listener, /listener at 3:3",
        ],
    ),
    "a node is out of reach": (
        Case(
            "graph.missing-node",
            both(drop_node("/robot/camera"), drop_node("/robot/_camera_net")),
            FAR_CAMERA,
            machines=frozenset({"operator"}),
        ),
        ["unverifiable graph.missing-node: /robot/camera, /robot/camera at 3:3"],
    ),
    "a node of another machine is missing": (
        Case(
            "graph.missing-node",
            drop_node("/one"),
            planned(node("one", machine="far")),
            machines=frozenset({"near"}),
        ),
        ["violated graph.missing-node: /one, /one at 3:3"],
    ),
    "one name is that of two nodes, and of three reports": (
        Case(
            "graph.duplicate-node",
            both(
                change_node("/robot/camera", count=2),
                add_configuration(twin(1)),
                add_configuration(twin(2)),
            ),
        ),
        ["violated graph.duplicate-node: /robot/camera, /robot/camera at 3:3"],
    ),
    "one name is that of two nodes that nobody declared": (
        Case("graph.duplicate-node", add_node("/spy", count=2), OPEN),
        ["violated graph.duplicate-node: /spy, /spy"],
    ),
    "nodes that nobody declared": (
        Case(
            "graph.undeclared-node",
            both(
                add_node("/spy"),
                *(add_endpoint(PUB, "/nosy", "/b", gid=gid) for gid in ("98", "99")),
                add_endpoint(SUB, "/nosy", "/a", gid="97"),
            ),
        ),
        [
            "violated graph.undeclared-node: /nosy, /nosy",
            "violated graph.undeclared-node: /spy, /spy",
        ],
    ),
    "an endpoint is missing of which its node does not report": (
        Case(
            "graph.missing-endpoint",
            both(drop_endpoint(ACTION_SERVER, DOCK), drop_endpoint_report(ACTION_SERVER, DOCK)),
        ),
        ["violated graph.missing-endpoint: /robot/dock, /robot/camera (action server) at 15:9"],
    ),
    "an endpoint is missing although its node reports it": (
        Case("graph.missing-endpoint", drop_endpoint(SUB, STATUS)),
        ["violated graph.missing-endpoint: /robot/status, /viewer (subscription) at 18:9"],
    ),
    "an endpoint has another type": (
        Case("graph.type-mismatch", change_endpoint(PUB, STATUS, type="std_msgs/msg/Int32")),
        ["violated graph.type-mismatch: /robot/status, /robot/camera (publisher) at 13:9"],
    ),
    "an endpoint has another type of which only its node tells": (
        Case(
            "graph.type-mismatch",
            both(drop_endpoint(PUB, STATUS), change_report(PUB, STATUS, type="std_msgs/msg/Int32")),
        ),
        ["violated graph.type-mismatch: /robot/status, /robot/camera (publisher) at 13:9"],
    ),
    "undeclared ends of a declared service have other types": (
        Case(
            "graph.type-mismatch",
            both(
                add_endpoint(CLIENT, "/other", CALIBRATE, type="std_srvs/srv/Empty"),
                add_endpoint(CLIENT, "", CALIBRATE, type=""),
            ),
            OPEN,
        ),
        [
            "violated graph.type-mismatch: /robot/camera/calibrate, /other (service client)",
            "violated graph.type-mismatch: /robot/camera/calibrate, no node (service client)",
        ],
    ),
    "an undeclared publisher has another type than its topic": (
        Case(
            "graph.type-mismatch",
            add_endpoint(
                PUB, "/other", "/chatter", type="std_msgs/msg/Int32", gid="99", qos=QosProfile()
            ),
            OPEN_TO_OTHERS,
        ),
        ["violated graph.type-mismatch: /chatter, /other (publisher)"],
    ),
    "a node could not make an endpoint": (
        Case(
            "endpoint.error",
            both(
                drop_endpoint(PUB, STATUS),
                change_report(PUB, STATUS, gid="", nfes=None, matched=None, error="not feasible"),
            ),
        ),
        ["violated endpoint.error: /robot/status, /robot/camera (publisher) at 13:9"],
    ),
    "a hidden endpoint is not reported": (
        Case(
            "graph.unseen-endpoint",
            both(drop_endpoint(PUB, "/chatter"), drop_endpoint(SUB, "/chatter")),
            wired(FOREIGN, "talker"),
        ),
        ["unverifiable graph.unseen-endpoint: /chatter, /talker (publisher) at 10:9"],
    ),
    "nobody counts whom a hidden service is matched with": (
        Case("graph.unseen-endpoint", drop_endpoint(SERVER, CALIBRATE), wired(PLAN, "camera")),
        [
            (
                "unverifiable graph.unseen-endpoint: /robot/camera/calibrate, "
                "/robot/camera (service server) at 14:9"
            )
        ],
    ),
    "a hidden endpoint is matched with more than are known": (
        Case(
            "graph.unseen-endpoint",
            both(
                drop_endpoint(PUB, STATUS),
                add_endpoint(SUB, "/rviz2", STATUS, gid="99", qos=QosProfile()),
                add_endpoint(SUB, "/rviz2", "/else", gid="98", qos=QosProfile()),
                change_report(PUB, STATUS, matched=5),
            ),
            wired(PLAN, "camera"),
        ),
        ["unverifiable graph.unseen-endpoint: /robot/status, /robot/camera (publisher) at 13:9"],
    ),
    "parts of a declared action have other types": (
        Case(
            "graph.type-mismatch",
            both(
                add_endpoint(PUB, "/robot/camera", f"{DOCK}/_action/status", gid="98"),
                add_endpoint(PUB, "/robot/camera", f"{DOCK}/_action/feedback", type="", gid="99"),
            ),
        ),
        [
            "violated graph.type-mismatch: /robot/dock, /robot/camera (action server) at 15:9",
            "violated graph.type-mismatch: /robot/dock, /robot/camera (action server) at 15:9",
        ],
    ),
    "an undeclared publisher": (
        Case("graph.undeclared-publisher", add_endpoint(PUB, "/robot/camera", "/extra", gid="99")),
        ["violated graph.undeclared-publisher: /extra, /robot/camera (publisher) at 3:3"],
    ),
    "a tool publishes on a declared topic": (
        Case(
            "graph.undeclared-publisher",
            add_endpoint(PUB, "/rviz2", STATUS, gid="99", qos=QosProfile()),
        ),
        ["violated graph.undeclared-publisher: /robot/status, /rviz2 (publisher)"],
    ),
    "a tool serves a declared service": (
        Case(
            "graph.undeclared-service-server",
            both(
                add_endpoint(CLIENT, "/rviz2", CALIBRATE),
                add_endpoint(SERVER, "/rviz2", CALIBRATE, type=""),
            ),
        ),
        [
            (
                "violated graph.undeclared-service-server: /robot/camera/calibrate, "
                "/rviz2 (service server)"
            )
        ],
    ),
    "endpoints whose node is not known": (
        Case(
            "graph.unattributed-endpoint",
            both(
                add_endpoint(SUB, "", "/a"),
                add_endpoint(PUB, "", "/b", gid="0104" + "0" * 28, address="10.0.0.7"),
                add_endpoint(PUB, "", "/c", gid="0" * 32),
                add_endpoint(PUB, "", "/d", gid="010f" + "0" * 28),
            ),
        ),
        [
            "violated graph.unattributed-endpoint: /a, no node (subscription)",
            "violated graph.unattributed-endpoint: /b, no node (publisher)",
            "violated graph.unattributed-endpoint: /c, no node (publisher)",
            "violated graph.unattributed-endpoint: /d, no node (publisher)",
        ],
    ),
    "endpoints whose node is not known, of which one feeds nothing, after the gate": (
        Case(
            "graph.unattributed-endpoint",
            both(add_endpoint(SUB, "", STATUS, gid="98"), add_endpoint(PUB, "", STATUS, gid="99")),
            stage=Stage.ACTIVE,
        ),
        [
            "violated graph.unattributed-endpoint: /robot/status, no node (publisher)",
            "unverifiable graph.unattributed-endpoint: /robot/status, no node (subscription)",
        ],
    ),
    "a type has another definition than is installed": (
        Case(
            "graph.type-definition-differs",
            change_endpoint(SUB, "/chatter", type_hash=OTHER),
            defined(FOREIGN, HERE),
        ),
        ["violated graph.type-definition-differs: /chatter, /listener (subscription) at 10:9"],
    ),
    "types of services have other definitions": (
        Case(
            "graph.type-definition-differs",
            both(
                change_endpoint(SERVER, CALIBRATE, type_hash=HERE),
                change_endpoint(CLIENT, CALIBRATE, type_hash=OTHER),
                add_endpoint(CLIENT, "", CALIBRATE, type=TRIGGER, type_hash=OTHER),
                add_endpoint(CLIENT, "/other", CALIBRATE, type=TRIGGER, type_hash=OTHER),
                add_endpoint(CLIENT, "/rviz2", CALIBRATE, type=TRIGGER, type_hash=OTHER),
                add_endpoint(
                    ACTION_CLIENT, "/robot/camera", DOCK, type="robot/action/Dock", type_hash=OTHER
                ),
                change_endpoint(ACTION_SERVER, DOCK, type_hash=HERE),
            ),
            defined(OPEN, ""),
        ),
        [
            (
                "violated graph.type-definition-differs: /robot/camera/calibrate, "
                "/viewer (service client) at 19:9"
            ),
            (
                "violated graph.type-definition-differs: /robot/camera/calibrate, "
                "/other (service client)"
            ),
            (
                "violated graph.type-definition-differs: /robot/camera/calibrate, "
                "/rviz2 (service client)"
            ),
            (
                "violated graph.type-definition-differs: /robot/camera/calibrate, "
                "no node (service client)"
            ),
            "violated graph.type-definition-differs: /robot/dock, /robot/camera (action client)",
        ],
    ),
    "nodes announce no hashes": (
        Case(
            "graph.type-definition-differs",
            both(
                add_endpoint(PUB, "", STATUS, gid="99", type_hash="", qos=QosProfile()),
                *(
                    change_endpoint(*each, type_hash="")
                    for each in ((SERVER, CALIBRATE), (PUB, STATUS), (SUB, STATUS))
                ),
            ),
            defined(OPEN, HERE),
        ),
        [
            "unverifiable graph.type-definition-differs: an unknown node, no node",
            "unverifiable graph.type-definition-differs: /robot/camera, /robot/camera at 13:9",
            "unverifiable graph.type-definition-differs: /viewer, /viewer at 18:9",
        ],
    ),
    "a client counts no server": (
        Case("graph.unmatched-client", change_report(ACTION_CLIENT, DOCK, server_matched=False)),
        [
            (
                "violated graph.unmatched-client: /robot/dock: /viewer → /robot/camera, "
                "/viewer (action client) at 20:9"
            )
        ],
    ),
    "a client does not say whether it has a server": (
        Case("graph.unmatched-client", change_report(CLIENT, CALIBRATE, server_matched=None)),
        [
            (
                "unverifiable graph.unmatched-client: /robot/camera/calibrate: "
                "/viewer → /robot/camera, "
                "/viewer (service client) at 19:9"
            )
        ],
    ),
    "a node is in another state": (
        Case("state.wrong-state", change_node("/viewer", state="unconfigured")),
        ["violated state.wrong-state: /viewer, /viewer at 3:3"],
    ),
    "a node is in another state after the gate": (
        Case(
            "state.wrong-state",
            change_configuration("/viewer", state="inactive"),
            stage=Stage.ACTIVE,
        ),
        ["violated state.wrong-state: /viewer, /viewer at 3:3"],
    ),
    "a node of another machine is in another state": (
        Case(
            "state.wrong-state",
            change_node("/talker", state="unconfigured"),
            FOREIGN,
            machines=frozenset({"far"}),
        ),
        ["violated state.wrong-state: /talker, /talker at 3:3"],
    ),
    "a node has not connected": (
        Case("state.wrong-state", change_configuration("/viewer", connected=False)),
        ["violated state.wrong-state: /viewer, /viewer at 3:3"],
    ),
    "a node is no managed node": (
        Case("state.wrong-state", change_node("/talker", state=None, managed=False), FOREIGN),
        ["violated state.wrong-state: /talker, /talker at 3:3"],
    ),
    "a node of ours is no managed node and reports nothing": (
        Case(
            "state.wrong-state",
            both(drop_report("/viewer"), change_node("/viewer", state=None, managed=False)),
            stage=Stage.ACTIVE,
        ),
        ["violated state.wrong-state: /viewer, /viewer at 3:3"],
    ),
    "a state is not known": (
        Case("state.wrong-state", change_node("/talker", state=None, managed=None), FOREIGN),
        ["unverifiable state.wrong-state: /talker, /talker at 3:3"],
    ),
    "a node of ours does not report": (
        Case("config.missing-report", drop_report("/viewer")),
        ["violated config.missing-report: /viewer, /viewer at 3:3"],
    ),
    "a node of ours leaves endpoints out of its report": (
        Case(
            "config.incomplete-report",
            both(drop_endpoint_report(SUB, STATUS), drop_endpoint_report(CLIENT, CALIBRATE)),
        ),
        [
            "violated config.incomplete-report: /robot/status, /viewer (subscription) at 18:9",
            (
                "violated config.incomplete-report: /robot/camera/calibrate, "
                "/viewer (service client) at 19:9"
            ),
        ],
    ),
    "a second publisher where one is declared": (
        Case(
            "graph.undeclared-publisher",
            add_endpoint(PUB, "/robot/camera", STATUS, gid="99", qos=QosProfile()),
        ),
        ["violated graph.undeclared-publisher: /robot/status, /robot/camera (publisher) at 3:3"],
    ),
    "a publisher of nobody known has another definition than the declared end": (
        Case(
            "graph.type-definition-differs",
            both(
                change_endpoint(PUB, STATUS, type_hash=HERE),
                add_endpoint(PUB, "", STATUS, gid="99", type_hash=OTHER, qos=QosProfile()),
            ),
            defined(OPEN, ""),
        ),
        ["violated graph.type-definition-differs: /robot/status, no node (publisher)"],
    ),
}


@pytest.mark.parametrize("case", SAYS)
def test_what_is_found_where(case: str):
    how, expected = SAYS[case]
    assert sorted(lines(findings_of(how))) == sorted(expected)


@pytest.mark.parametrize(
    ("one", "other", "expected"),
    [
        (HERE, HERE, False),
        (HERE, OTHER, True),
        (f"{HERE} {HERE}", f"{HERE} {OTHER}", True),
        (f"{HERE} {HERE}", f"{HERE}\n{HERE}", False),
        (f"{HERE} {HERE}", HERE, True),
        (HERE, f"{HERE} {HERE}", True),
        (HERE, "RIHS02_" + "b" * 8, False),
        (f"{HERE} RIHS02_b", f"{OTHER} RIHS01_b", True),
        ("RIHS01_a_b", HERE, True),
        (HERE, "RIHS01_a_b", True),
    ],
)
def test_hashes_differ_where_those_of_one_version_do(one: str, other: str, expected: bool):
    assert differ(one, other) is expected
