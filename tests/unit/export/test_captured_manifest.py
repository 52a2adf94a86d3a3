"""What a graph tells, written as a manifest and as NoDL, and read back."""

from __future__ import annotations

import random
from pathlib import Path

import pytest
from msgspec.structs import replace

from lifecycle.export.captured import CapturedParameter, CapturedSystem, capture
from lifecycle.export.manifest_yaml import to_manifest, to_nodl
from lifecycle.manifest.loading import load
from lifecycle.manifest.model import DiscoveryRange, EndpointKind, Manifest, RunKind
from lifecycle.manifest.qos import Durability, History, QosProfile, Reliability
from lifecycle.network.nfe import UniqueRequirement
from lifecycle.plan.build import build_plan
from lifecycle.verify.judge import verify
from lifecycle.verify.observation import (
    NodeParameters,
    Observation,
    ObservedEndpoint,
    ObservedNode,
    ParameterReport,
)
from lifecycle.verify.outcome import ConnectionReport, Outcome
from lifecycle.verify.verdict import Stage
from tests.builders import configuration, reported

PUBLISHER, SUBSCRIPTION = EndpointKind.PUBLISHER, EndpointKind.SUBSCRIPTION
SERVER, CLIENT = EndpointKind.SERVICE_SERVER, EndpointKind.SERVICE_CLIENT
ANNOUNCED = QosProfile(history=History.UNKNOWN, depth=0)
LATCHED = replace(ANNOUNCED, durability=Durability.TRANSIENT_LOCAL, deadline_ns=500_000_000)


def endpoint(
    kind: EndpointKind, node: str, name: str, type_: str = "std_msgs/msg/String", **rest: object
) -> ObservedEndpoint:
    qos = ANNOUNCED if kind in (PUBLISHER, SUBSCRIPTION) else None
    return ObservedEndpoint(
        **{"kind": kind, "node": node, "name": name, "type": type_, "qos": qos, **rest}
    )


def plain(*names: str) -> tuple[ObservedNode, ...]:
    return tuple(ObservedNode(full_name=name, managed=False) for name in names)


FOREIGN = Observation(
    nodes=(
        *plain("/left/scanner", "/right/scanner", "/on", "/_ros2cli_77", "/launch_ros_4711"),
        ObservedNode(full_name="/left/base", managed=True, state="active"),
    ),
    endpoints=(
        endpoint(PUBLISHER, "/left/scanner", "/left/scan"),
        endpoint(PUBLISHER, "/right/scanner", "/right/scan"),
        endpoint(PUBLISHER, "/left/scanner", "/left/_hidden/map", qos=LATCHED),
        endpoint(SUBSCRIPTION, "/on", "/left/scan"),
        endpoint(SUBSCRIPTION, "/on", "/right/scan"),
        endpoint(SERVER, "/left/base", "/left/lights", "std_srvs/srv/SetBool"),
        endpoint(CLIENT, "/on", "/left/lights", "std_srvs/srv/SetBool"),
        endpoint(PUBLISHER, "/on", "/rosout", "rcl_interfaces/msg/Log"),
        endpoint(SERVER, "/on", "/on/get_parameters", "rcl_interfaces/srv/GetParameters"),
        endpoint(SUBSCRIPTION, "/_ros2cli_77", "/left/scan"),
    ),
)
PARAMETERS = {
    "/left/scanner": (
        CapturedParameter(name="on", type="string", value="08"),
        CapturedParameter(name="text", type="string", value="$(arg x) # no"),
        CapturedParameter(name="limits.low", type="int", value=-3, read_only=True),
        CapturedParameter(name="frames", type="string_array", value=("a", "null")),
        CapturedParameter(name="far", type="double", value=float("inf")),
        CapturedParameter(name="use_sim_time", type="bool", value=False),
        CapturedParameter(name="qos_overrides./x.publisher.depth", type="int", value=1),
        CapturedParameter(name="later", type="", value=None),
    ),
    "/right/scanner": None,
    "/on": (),
    "/left/base": (),
}

ASKED = replace(
    FOREIGN,
    parameters=tuple(
        NodeParameters(
            node=node,
            parameters=tuple(
                ParameterReport.of(each.name, each.type, each.value, read_only=each.read_only)
                for each in parameters
            ),
        )
        for node, parameters in PARAMETERS.items()
        if parameters is not None
    ),
)
"""The same system, its nodes asked for their parameters as verification does."""


def captured(observation: Observation = FOREIGN, **rest: object) -> CapturedSystem:
    return capture(
        observation,
        **{
            "parameters": PARAMETERS,
            "system": "found",
            "domain_id": 7,
            "discovery_range": DiscoveryRange.LOCALHOST,
            **rest,
        },
    )


def loaded(system: CapturedSystem, tmp_path: Path, **rest: object):
    path = tmp_path / "found.lifecycle.yaml"
    path.write_text(to_manifest(system, **rest))
    return load(str(path), {})


def test_a_captured_system_is_valid_and_verified_by_what_it_was_captured_from(
    tmp_path: Path,
) -> None:
    manifest = loaded(captured(), tmp_path).manifest
    assert [(node.key, node.name, node.namespace, node.managed) for node in manifest.nodes] == [
        ("base", "base", "/left", True),
        ("left_scanner", "scanner", "/left", False),
        ("on", "on", "/", False),
        ("right_scanner", "scanner", "/right", False),
    ]
    assert {node.run.kind for node in manifest.nodes} == {RunKind.ATTACH}
    verdict = verify(build_plan(manifest, environment={}), ASKED, stage=Stage.ACTIVE)
    # None of the nodes is ours, so that nobody counts what is matched.
    assert [(each.rule, each.outcome) for each in verdict.findings] == [
        ("flow.unreported", Outcome.UNVERIFIABLE)
    ]


def test_what_is_not_told_is_marked_on_its_line(tmp_path: Path) -> None:
    text = to_manifest(captured())
    assert text.startswith(
        "# yaml-language-server: $schema=manifest.v1.schema.json\n"
        "# Captured from domain 7, discovery range localhost. What a graph does not show is "
        "marked: gap.\n"
        "# gap: not ours, so that machine, process, flows, DSCP, history and depth are unknown: "
        "/left/base,\n"
        "# /left/scanner, /on, /right/scanner\n"
        "# gap: remaps cannot be seen: names are those in the graph, not those in the nodes' code\n"
        "manifest_version: 1\n"
    )
    assert "  left_scanner:  # gap: parameters that are declared and not set: later\n" in text
    assert "  right_scanner:  # gap: its parameters are not known: it did not answer\n" in text
    assert (
        "            history: SYSTEM_DEFAULT  # gap: history and depth are not announced\n" in text
    )
    assert "          qos:  # gap: the graph does not show the QoS of services\n" in text
    assert "          type: double  # gap: its value is not finite\n" in text
    assert '          default_value: "08"  # gap: its value now; the default is not known\n' in text
    assert "use_sim_time" not in text
    assert "qos_overrides" not in text


def test_parameters_and_qos_read_back(tmp_path: Path) -> None:
    manifest = loaded(captured(), tmp_path).manifest
    scanner = next(node for node in manifest.nodes if node.key == "left_scanner")
    assert {each.name: (each.type, each.default) for each in scanner.interface.parameters} == {
        "on": ("string", "08"),
        "text": ("string", "$(arg x) # no"),
        "limits.low": ("int", -3),
        "frames": ("string_array", ("a", "null")),
        "far": ("double", None),
    }
    qos = next(e.qos for e in scanner.interface.endpoints if e.name == "/left/_hidden/map")
    assert qos is not None
    assert (qos.history, qos.reliability, qos.durability, qos.deadline_ns) == (
        History.SYSTEM_DEFAULT,
        Reliability.RELIABLE,
        Durability.TRANSIENT_LOCAL,
        500_000_000,
    )


def test_the_same_graph_in_any_order_gives_the_same_text() -> None:
    whole = to_manifest(captured())
    for seed in range(5):
        shuffle = random.Random(seed)
        nodes, endpoints = list(FOREIGN.nodes), list(FOREIGN.endpoints)
        shuffle.shuffle(nodes)
        shuffle.shuffle(endpoints)
        mixed = Observation(nodes=tuple(nodes), endpoints=tuple(endpoints))
        assert to_manifest(captured(mixed)) == whole


def _without_depth(qos: QosProfile | None) -> object:
    """A profile without its depth: KEEP_LAST's presets differ, and nothing here keeps a depth."""
    return None if qos is None else replace(qos, depth=0)


def test_nodl_documents_stand_in_for_interfaces(tmp_path: Path) -> None:
    system = captured()
    references = {}
    for node in system.nodes:
        (tmp_path / f"{node.key}.nodl.yaml").write_text(to_nodl(node))
        references[node.key] = f"local://{node.key}.nodl.yaml"
    inline = loaded(system, tmp_path).manifest
    by_reference = loaded(system, tmp_path, references=references).manifest

    def interfaces(manifest: Manifest) -> list[object]:
        return [
            (
                node.key,
                [
                    (each.kind, each.name, each.type, _without_depth(each.qos))
                    for each in node.interface.endpoints
                ],
                [
                    (each.name, each.type, each.default, each.description, each.read_only)
                    for each in node.interface.parameters
                ],
            )
            for node in manifest.nodes
        ]

    assert interfaces(by_reference) == interfaces(inline)
    verdict = verify(build_plan(by_reference, environment={}), ASKED, stage=Stage.ACTIVE)
    # A document cannot say that parameters are not known: without any, there are to be none.
    assert [(each.rule, each.subject) for each in verdict.findings] == [
        ("flow.unreported", "2 flows"),
        ("param.unverifiable", "/right/scanner"),
    ]


@pytest.mark.parametrize(
    ("observation", "gap"),
    [
        (
            Observation(nodes=(ObservedNode(full_name="/twin", count=2, managed=False),)),
            "2 nodes are named /twin; they cannot be told apart",
        ),
        (
            Observation(nodes=plain("/a"), endpoints=(endpoint(PUBLISHER, "", "/who"),)),
            "nobody tells whose publisher of /who (std_msgs/msg/String) this is",
        ),
        (
            Observation(
                nodes=plain("/a"), endpoints=(endpoint(PUBLISHER, "/_NODE_NAME_UNKNOWN_", "/who"),)
            ),
            "nobody tells whose publisher of /who (std_msgs/msg/String) this is",
        ),
    ],
)
def test_what_cannot_be_captured_is_named_at_the_top(observation: Observation, gap: str) -> None:
    system = captured(observation)
    assert system.gaps == (gap,)
    assert to_manifest(system).splitlines()[2] == f"# gap: {gap}"


def test_an_endpoint_that_a_manifest_cannot_name_twice_opens_its_node(tmp_path: Path) -> None:
    twice = Observation(
        nodes=plain("/a"),
        endpoints=tuple(endpoint(PUBLISHER, "/a", "/echo", gid=gid) for gid in ("01", "02")),
    )
    system = captured(twice)
    assert (
        "    endpoints: open  # gap: it has several publishers /echo; a manifest names each once\n"
    ) in to_manifest(system)
    plan = build_plan(loaded(system, tmp_path).manifest, environment={})
    assert verify(plan, twice, stage=Stage.ACTIVE).findings == ()


def test_a_type_that_is_no_ros_type_and_a_state_that_verify_refuses_are_gaps() -> None:
    system = captured(
        Observation(
            nodes=(ObservedNode(full_name="/m", managed=True, state="inactive"),),
            endpoints=(endpoint(PUBLISHER, "/m", "/raw", "foo::Bar"),),
        )
    )
    assert system.nodes[0].gaps == (
        "publishers: /raw has no ROS type: foo::Bar",
        "its parameters are not known: it serves none",
    )
    assert system.nodes[0].endpoints == ()
    assert "    state: inactive\n" in to_manifest(system)


def test_nodes_of_ours_tell_depth_uniqueness_dscp_and_their_hidden_participants(
    tmp_path: Path,
) -> None:
    told = QosProfile(depth=3)
    camera = configuration(
        "/robot/camera",
        reported(
            PUBLISHER,
            "video",
            resolved="/robot/video",
            qos=told,
            unique=UniqueRequirement.STRICTLY_REQUIRED,
            participant="_camera_flow_0",
            dscp=46,
        ),
        process_id=42,
        state="active",
        connections=(ConnectionReport(name="net", node_name="_camera_net"),),
    )
    system = captured(
        Observation(
            nodes=(
                ObservedNode(full_name="/robot/camera", managed=True, state="active"),
                *plain("/robot/_camera_flow_0", "/robot/_camera_net"),
            ),
            endpoints=(endpoint(PUBLISHER, "/robot/_camera_flow_0", "/robot/video"),),
            configurations=(camera,),
        ),
        parameters={"/robot/camera": ()},
    )
    assert [node.full_name for node in system.nodes] == ["/robot/camera"]
    text = to_manifest(system)
    assert "  camera:  # pid 42 when it was captured\n" in text
    assert "            history: KEEP_LAST\n            depth: 3\n" in text
    assert (
        "    flows:\n"
        "      publishers:\n"
        "        video:\n"
        "          unique: optionally_required  # gap: it is strictly_required; only a node with "
        "run: python can be asked that\n"
        "          dscp: 46  # EF = DSCP 46 = TOS 184 (0xb8)\n"
    ) in text
    need = loaded(system, tmp_path).manifest.nodes[0].flows[0]
    assert (need.unique, need.dscp) == (UniqueRequirement.OPTIONALLY_REQUIRED, 46)


def test_a_node_that_serves_no_parameters_and_reports_only_those_that_each_has_has_no_gap() -> None:
    def gaps(*names: str) -> tuple[str, ...]:
        reports = tuple(
            ParameterReport.of(name, "bool", value=True, read_only=False) for name in names
        )
        silent = replace(configuration("/silent", state="active"), parameters=reports)
        observation = Observation(
            nodes=(ObservedNode(full_name="/silent", managed=True, state="active"),),
            configurations=(silent,),
        )
        (node,) = captured(observation, parameters={}).nodes
        return node.gaps

    assert gaps("start_type_description_service", "use_sim_time") == ()
    assert gaps("use_sim_time", "fast") == ("its parameters are not known: it serves none",)


def test_names_that_no_manifest_can_declare_are_left_out_and_are_gaps(tmp_path: Path) -> None:
    odd = ("/foo-bar", "/", "bad/x", "/1foo", "/x\n/y", "/a\x1b[2J")
    captured = capture(
        Observation(
            nodes=plain("/good", *odd),
            endpoints=(
                endpoint(PUBLISHER, "/good", "/fine"),
                endpoint(PUBLISHER, "/good", "/not-fine\x1b"),
                endpoint(PUBLISHER, "/foo-bar", "/lost"),
            ),
        ),
        {},
        system="s",
        domain_id=0,
        discovery_range=DiscoveryRange.LOCALHOST,
    )
    assert [each.name for each in loaded(captured, tmp_path).manifest.nodes] == ["good"]
    for name in odd:
        assert any(gap.startswith(f"node {name} is left out: ") for gap in captured.gaps)
    assert any("/not-fine\x1b is left out: " in gap for gap in captured.nodes[0].gaps)
