"""Manifest in, plan out."""

from __future__ import annotations

import json
from pathlib import Path

import jsonschema
import pytest
from msgspec.structs import replace

from lifecycle import codec
from lifecycle.errors import ExitCode, UsageError
from lifecycle.manifest.model import Discovery, DiscoveryRange, EndpointKind, Run, RunKind
from lifecycle.network.nfe import UniqueRequirement
from lifecycle.plan.build import build_plan, started_by_others
from lifecycle.plan.model import Plan
from tests.builders import (
    endpoint,
    manifest,
    node,
    plan_of,
    planned,
    planned_node,
    publisher,
    teleop,
)

SCHEMA = Path(__file__).parents[3] / "schemas" / "plan.v1.schema.json"


def test_names_are_resolved_by_namespace_private_mark_and_remap():
    plan = planned(
        node(
            "camera",
            publisher("video"),
            publisher("~/raw"),
            publisher("/absolute"),
            publisher("chatter"),
            endpoint(EndpointKind.SERVICE_SERVER, "~/calibrate", "std_srvs/srv/Trigger"),
            namespace="/robot",
            remap=(("chatter", "/talk"),),
        )
    )
    assert [each.resolved for each in plan.nodes[0].endpoints] == [
        "/robot/video",
        "/robot/camera/raw",
        "/absolute",
        "/talk",
        "/robot/camera/calibrate",
    ]


def test_needs_go_to_the_endpoint_that_they_name():
    video, battery, status, *_ = build_plan(teleop(), environment={}).nodes[0].endpoints
    strictly = UniqueRequirement.STRICTLY_REQUIRED
    assert (video.unique, video.dscp, video.five_qi, video.participant) == (
        strictly,
        46,
        85,
        "_camera_flow_0",
    )
    assert (battery.unique, battery.dscp, battery.participant) == (
        UniqueRequirement.NOT_REQUIRED,
        8,
        "_camera_flow_1",
    )
    assert (status.dscp, status.participant) == (None, "")


@pytest.mark.parametrize("kind", [RunKind.COMMAND, RunKind.ATTACH])
def test_a_node_that_others_make_is_given_no_participants(kind: RunKind):
    sample = teleop()
    camera = replace(sample.nodes[0], run=Run(kind=kind, command=("camera",)))
    plan = build_plan(replace(sample, nodes=(camera, sample.nodes[1])), environment={})
    assert plan.nodes[0].participants == ()
    assert {each.participant for each in plan.nodes[0].endpoints} == {""}


@pytest.mark.parametrize(
    ("declared", "environment", "expected"),
    [
        (7, {"ROS_DOMAIN_ID": "9"}, 7),
        (0, {"ROS_DOMAIN_ID": "9"}, 0),
        (None, {"ROS_DOMAIN_ID": "9"}, 9),
        (None, {"ROS_DOMAIN_ID": ""}, 0),
        (None, {}, 0),
    ],
)
def test_the_domain_is_the_manifests_else_the_environments_else_zero(
    declared, environment, expected
):
    plan = build_plan(manifest(discovery=Discovery(domain_id=declared)), environment=environment)
    assert plan.domain_id == expected


@pytest.mark.parametrize("text", ["233", "-1", "seven", "1.0", "٣"])
def test_an_illegal_domain_in_the_environment_is_refused(text: str):
    with pytest.raises(UsageError) as error:
        build_plan(manifest(), environment={"ROS_DOMAIN_ID": text})
    assert str(error.value) == (
        f"cannot use ROS_DOMAIN_ID={text!r}: a domain is a number from 0 to 232;"
        " unset it, or set discovery.domain_id in the manifest"
    )


@pytest.mark.parametrize(
    ("declared", "environment", "expected"),
    [
        (DiscoveryRange.SUBNET, {"ROS_AUTOMATIC_DISCOVERY_RANGE": "OFF"}, DiscoveryRange.SUBNET),
        (
            DiscoveryRange.SYSTEM_DEFAULT,
            {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"},
            DiscoveryRange.LOCALHOST,
        ),
        (DiscoveryRange.SYSTEM_DEFAULT, {}, DiscoveryRange.SYSTEM_DEFAULT),
    ],
)
def test_the_discovery_range_is_the_manifests_else_the_environments(
    declared, environment, expected
):
    plan = build_plan(manifest(discovery=Discovery(range=declared)), environment=environment)
    assert plan.discovery_range is expected


def test_an_illegal_discovery_range_in_the_environment_is_refused():
    with pytest.raises(UsageError) as error:
        build_plan(manifest(), environment={"ROS_AUTOMATIC_DISCOVERY_RANGE": "here"})
    assert str(error.value) == (
        "cannot use ROS_AUTOMATIC_DISCOVERY_RANGE='here': it must be one of SUBNET, LOCALHOST, OFF,"
        " SYSTEM_DEFAULT; unset it, or set discovery.range in the manifest"
    )
    assert error.value.exit_code is ExitCode.USAGE


def test_this_process_environment_is_read_when_none_is_given(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("ROS_DOMAIN_ID", "17")
    assert build_plan(manifest()).domain_id == 17


def test_a_plan_survives_json_and_fits_its_schema():
    plan = build_plan(teleop(), environment={})
    text = codec.to_json(plan)
    assert codec.from_json(text, Plan) == plan
    document = json.loads(text)
    validator = jsonschema.Draft202012Validator(json.loads(SCHEMA.read_text(encoding="utf-8")))
    validator.validate(document)
    with pytest.raises(jsonschema.ValidationError):
        validator.validate({**document, "colour": "red"})


def test_nodes_that_others_start_are_waited_for_as_attached_ones() -> None:
    plan = plan_of(
        planned_node("a"), planned_node("b", process="two"), planned_node("c", process="two")
    )
    left = started_by_others(plan, ["/a"])
    assert [each.run.kind for each in left.nodes] == [
        RunKind.ATTACH,
        RunKind.PYTHON,
        RunKind.PYTHON,
    ]
    assert [each.run.kind for each in left.processes] == [RunKind.ATTACH, RunKind.PYTHON]
    with pytest.raises(UsageError, match="its nodes: a, b, c"):
        started_by_others(plan, ["x"])
    with pytest.raises(UsageError, match="cannot leave out 'b' alone: its process runs c, too"):
        started_by_others(plan, ["b"])
    both = started_by_others(plan, ["b", "c"])
    assert [each.run.kind for each in both.processes] == [RunKind.PYTHON, RunKind.ATTACH]
