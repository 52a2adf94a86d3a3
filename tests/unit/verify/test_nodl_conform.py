"""What a conformance test of NoDL v2 tells apart (ros-tooling/nodl, nodl_test), `verify` does too.

A document is fed in by reference, a running node differs from it in one thing. NoDL's comparison
knows missing, extra and of another type, for publishers, subscriptions, services and parameters,
and reliability, history and durability of topics; what it takes for equal because it cannot be seen
is `unverifiable` here.
"""

from __future__ import annotations

from pathlib import Path

import pytest
from msgspec.structs import replace

from lifecycle.export.captured import CapturedParameter, capture
from lifecycle.export.manifest_yaml import to_nodl
from lifecycle.manifest.loading import load
from lifecycle.manifest.model import EndpointKind
from lifecycle.manifest.qos import Durability, History, Reliability
from lifecycle.plan.build import build_plan
from lifecycle.plan.model import Plan
from lifecycle.verify.observation import SERVES_NONE, NodeParameters, Observation, ParameterReport
from lifecycle.verify.outcome import Outcome
from lifecycle.verify.verdict import Stage
from tests.unit.verify.edits import (
    Edit,
    add_endpoint,
    change_announced_qos,
    change_endpoint,
    drop_endpoint,
)
from tests.unit.verify.lines import verify
from tests.unit.verify.perfect import perfect

PUB, SUB = EndpointKind.PUBLISHER, EndpointKind.SUBSCRIPTION
SERVER, CLIENT = EndpointKind.SERVICE_SERVER, EndpointKind.SERVICE_CLIENT
ARM = "/left/arm"
PRIVATE, COMMAND, RESET, OTHER = "/left/arm/state", "/left/command", "/reset", "/other"

DOCUMENT = """
nodl_version: 2
publishers:
  - name: ~/state
    type: std_msgs/msg/String
    qos: {history: KEEP_LAST, depth: 5, reliability: RELIABLE, durability: TRANSIENT_LOCAL}
subscriptions:
  - name: command
    type: std_msgs/msg/String
    qos: {history: KEEP_LAST, depth: 1, reliability: RELIABLE}
service_servers: [{name: /reset, type: std_srvs/srv/Trigger}]
service_clients: [{name: /other, type: std_srvs/srv/SetBool}]
parameters:
  rate: {type: double}
  label: {type: string}
"""
MANIFEST = """
manifest_version: 1
system: conform
policy: {unpublished: ignore, unheard: ignore}
nodes:
  arm:
    attach: true
    managed: false
    namespace: /left
    interface: local://arm.nodl.yaml
"""
HAS = (
    ParameterReport.of("rate", "double", 1.0, read_only=False),
    ParameterReport.of("label", "string", "a", read_only=False),
)


def _plan(folder: Path, document: str = DOCUMENT) -> Plan:
    (folder / "arm.nodl.yaml").write_text(document)
    (folder / "arm.lifecycle.yaml").write_text(MANIFEST)
    return build_plan(load(folder / "arm.lifecycle.yaml").manifest, environment={})


def _seen(plan: Plan, parameters: tuple[ParameterReport, ...] = HAS) -> Observation:
    """What runs: a node that has everything, and whose history is known as well."""
    seen = perfect(plan, Stage.ACTIVE)
    seen = replace(seen, parameters=(NodeParameters(node=ARM, parameters=parameters),))
    for kind, name, depth in ((PUB, PRIVATE, 5), (SUB, COMMAND, 1)):
        seen = change_announced_qos(kind, name, history=History.KEEP_LAST, depth=depth)(seen)
    return seen


def _violated(plan: Plan, seen: Observation) -> list[str]:
    return [
        finding.rule
        for finding in verify(plan, seen, stage=Stage.ACTIVE).findings
        if finding.outcome is Outcome.VIOLATED
    ]


DIFFERENCES: dict[str, tuple[Edit, str]] = {
    "publisher missing": (drop_endpoint(PUB, PRIVATE), "graph.missing-endpoint"),
    "subscription missing": (drop_endpoint(SUB, COMMAND), "graph.missing-endpoint"),
    "server missing": (drop_endpoint(SERVER, RESET), "graph.missing-endpoint"),
    "client missing": (drop_endpoint(CLIENT, OTHER), "graph.missing-endpoint"),
    "publisher extra": (add_endpoint(PUB, ARM, "/x", gid="f1"), "graph.undeclared"),
    "subscription extra": (add_endpoint(SUB, ARM, "/x", gid="f2"), "graph.undeclared"),
    "server extra": (
        add_endpoint(SERVER, ARM, "/x", type="std_srvs/srv/Trigger"),
        "graph.undeclared",
    ),
    "client extra": (
        add_endpoint(CLIENT, ARM, "/x", type="std_srvs/srv/Trigger"),
        "graph.undeclared",
    ),
    "publisher type": (change_endpoint(PUB, PRIVATE, type="std_msgs/msg/Int32"), "graph.type"),
    "server type": (change_endpoint(SERVER, RESET, type="std_srvs/srv/SetBool"), "graph.type"),
    "client type": (change_endpoint(CLIENT, OTHER, type="std_srvs/srv/Trigger"), "graph.type"),
    "reliability": (
        change_announced_qos(PUB, PRIVATE, reliability=Reliability.BEST_EFFORT),
        "qos",
    ),
    "durability": (change_announced_qos(PUB, PRIVATE, durability=Durability.VOLATILE), "qos"),
    "history": (change_announced_qos(SUB, COMMAND, history=History.KEEP_ALL), "qos"),
    "depth": (change_announced_qos(PUB, PRIVATE, depth=10), "qos"),
}


def test_a_node_that_conforms_is_ok(tmp_path: Path) -> None:
    plan = _plan(tmp_path)
    assert verify(plan, _seen(plan), stage=Stage.ACTIVE).findings == ()


@pytest.mark.parametrize("name", DIFFERENCES)
def test_each_difference_is_violated(tmp_path: Path, name: str) -> None:
    plan = _plan(tmp_path)
    edit, rule = DIFFERENCES[name]
    found = _violated(plan, edit(_seen(plan)))
    assert found, name
    assert any(rule in each for each in found), found


@pytest.mark.parametrize(
    ("parameters", "rule"),
    [
        (HAS[:1], "param.missing"),
        ((ParameterReport.of("rate", "int", 1, read_only=False), HAS[1]), "param.type-differs"),
        ((*HAS, ParameterReport.of("gain", "double", 1.0, read_only=False)), "param.undeclared"),
    ],
)
def test_parameters_are_missing_or_extra_or_of_another_type(
    tmp_path: Path, parameters: tuple[ParameterReport, ...], rule: str
) -> None:
    plan = _plan(tmp_path)
    assert _violated(plan, _seen(plan, parameters)) == [rule]


OF_ROS = (
    ParameterReport.of("use_sim_time", "bool", False, read_only=False),
    ParameterReport.of("start_type_description_service", "bool", True, read_only=True),
    ParameterReport.of("qos_overrides./a.publisher.depth", "int", 3, read_only=True),
)
NEVER_SET = ParameterReport.of("later", "", None, read_only=False)
GAIN = ParameterReport.of("gain", "double", 1.0, read_only=False)
LESS = DOCUMENT.partition("parameters:")[0]


@pytest.mark.parametrize(
    ("document", "open_", "found"),
    [
        (DOCUMENT, False, ["gain"]),
        (LESS, False, ["gain", "label", "rate"]),  # a document without any describes a node so
        (DOCUMENT, True, []),
    ],
)
def test_parameters_are_all_declared_but_those_of_ros(
    tmp_path: Path, document: str, found: list[str], *, open_: bool
) -> None:
    plan = _plan(tmp_path, document)
    if open_:
        text = (tmp_path / "arm.lifecycle.yaml").read_text()
        (tmp_path / "arm.lifecycle.yaml").write_text(text + "    endpoints: open\n")
        plan = build_plan(load(tmp_path / "arm.lifecycle.yaml").manifest, environment={})
    seen = _seen(plan, (*HAS, *OF_ROS, NEVER_SET, GAIN))
    findings = verify(plan, seen, stage=Stage.ACTIVE).findings
    shown = {"gain": "gain (double)", "label": "label (string)", "rate": "rate (double)"}
    said = [", ".join(shown[each] for each in found)] if found else []
    assert [each.observed for each in findings] == said


@pytest.mark.parametrize(
    ("known", "outcomes"),
    [
        (NodeParameters(node=ARM, error=SERVES_NONE), []),
        (NodeParameters(node=ARM, error="did not answer"), [Outcome.UNVERIFIABLE]),
    ],
)
def test_that_there_are_no_parameters_is_proven_or_unverifiable(
    tmp_path: Path, known: NodeParameters, outcomes: list[Outcome]
) -> None:
    plan = _plan(tmp_path, LESS)
    seen = replace(_seen(plan), parameters=(known,))
    found = verify(plan, seen, stage=Stage.ACTIVE).findings
    assert [each.outcome for each in found] == outcomes
    assert all("that there are no parameters" in each.message for each in found)


def test_a_captured_document_takes_the_place_of_the_one_that_was_fed_in(tmp_path: Path) -> None:
    plan = _plan(tmp_path)
    seen = _seen(plan)
    has = {
        ARM: tuple(
            CapturedParameter(name=each.name, type=each.type, value=each.value) for each in HAS
        )
    }
    system = capture(seen, has, system="conform", domain_id=0, discovery_range=plan.discovery_range)
    (node,) = system.nodes
    again = _plan(tmp_path, to_nodl(node))
    assert verify(again, seen, stage=Stage.ACTIVE).findings == ()
    for name, (edit, _) in DIFFERENCES.items():
        assert _violated(again, edit(seen)), name
