"""Levels, participants, processes, command lines and flows, each alone."""

from __future__ import annotations

import math
import shlex
from pathlib import Path

import pytest
import yaml
from msgspec.structs import replace

from lifecycle.manifest.model import (
    Condition,
    Discovery,
    DiscoveryRange,
    EndpointKind,
    RosArguments,
    Run,
    RunKind,
    UniqueHow,
)
from lifecycle.network.nfe import UniqueRequirement
from lifecycle.plan.build import dependency_levels
from lifecycle.plan.processes import command_line, parameter_text
from tests.builders import link, need, node, planned, publisher, subscription

PUB, SUB = EndpointKind.PUBLISHER, EndpointKind.SUBSCRIPTION
STRICTLY = UniqueRequirement.STRICTLY_REQUIRED
OPTIONALLY = UniqueRequirement.OPTIONALLY_REQUIRED


# --- levels


def after(*keys: str) -> list[tuple[str, Condition]]:
    return [(key, Condition.CONFIGURED) for key in keys]


LEVELS = {
    "nobody": ([], ()),
    "nobody waits": ([node("b"), node("a")], (("b", "a"),)),
    "a chain written backwards": (
        [node("c", after=after("b")), node("b", after=after("a")), node("a")],
        (("a",), ("b",), ("c",)),
    ),
    "the longest path counts": (
        [
            node("d", after=after("a", "c")),
            node("a"),
            node("b", after=after("a")),
            node("c", after=after("b")),
            node("e", after=after("a")),
        ],
        (("a",), ("b", "e"), ("c",), ("d",)),
    ),
}


@pytest.mark.parametrize("case", LEVELS)
def test_a_node_stands_one_level_below_the_last_one_it_waits_for(case: str):
    nodes, expected = LEVELS[case]
    assert dependency_levels(nodes) == expected


# --- participants


def participants(*needs):
    names = list(dict.fromkeys(each.name for each in needs))
    endpoints = [publisher(name) for name in (*names, "plain")]
    (one,) = planned(node("camera", *endpoints, needs=needs)).nodes
    return (
        [(each.name, each.dscp, each.reason) for each in one.participants],
        {each.name: each.participant for each in one.endpoints},
    )


def test_each_unique_publisher_gets_a_participant_of_its_own():
    made, placed = participants(need(PUB, "a", STRICTLY), need(PUB, "b", OPTIONALLY, dscp=46))
    assert made == [
        ("_camera_flow_0", None, "unique publisher a"),
        ("_camera_flow_1", 46, "unique publisher b marked EF = DSCP 46 = TOS 184 (0xb8)"),
    ]
    assert placed == {"a": "_camera_flow_0", "b": "_camera_flow_1", "plain": ""}


def test_a_unique_subscription_needs_no_participant():
    (one,) = planned(node("v", subscription("a"), needs=[need(SUB, "a", STRICTLY)])).nodes
    assert one.participants == ()


# --- processes


def processes(*nodes):
    discovery = Discovery(domain_id=7, range=DiscoveryRange.LOCALHOST)
    return planned(*nodes, discovery=discovery).processes


def test_a_process_is_named_by_its_node_or_as_declared():
    found = processes(node("a"), node("b", process="shared"), node("c", process="shared"))
    assert [(each.name, each.nodes) for each in found] == [("a", ("a",)), ("shared", ("b", "c"))]


def test_a_process_is_told_its_domain_its_range_and_its_nodes_variables():
    run = Run(kind=RunKind.PYTHON, python="m:C", environment={"A": "1", "ROS_DOMAIN_ID": "9"})
    (found,) = processes(node("a", run=run))
    assert found.environment == (
        ("ROS_DOMAIN_ID", "9"),
        ("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST"),
        ("A", "1"),
    )


# --- command lines


def test_a_command_gets_its_namespace_remaps_parameters_and_log_level_as_ros_spells_them():
    one = node(
        "talker",
        run=Run(kind=RunKind.COMMAND, command=("/opt/talker", "--fast")),
        namespace="/robot",
        remap=(("chatter", "/talk"),),
        parameters=(("rate", 2.0), ("name", "1")),
        parameter_files=("/etc/talker.yaml",),
        log_level="debug",
    )
    assert shlex.join(command_line([one], {})) == (
        "/opt/talker --fast --ros-args -r __ns:=/robot -r chatter:=/talk"
        " --params-file /etc/talker.yaml -p rate:=2.0 -p 'name:=\"1\"' --log-level debug"
    )


def test_python_and_attached_nodes_have_no_argv():
    found = processes(node("a"), node("b", run=Run(kind=RunKind.ATTACH)))
    assert [each.argv for each in found] == [(), ()]


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (True, "true"),
        (7, "7"),
        (7.0, "7.0"),
        (1e30, "1e+30"),
        (math.inf, ".inf"),
        (-math.inf, "-.inf"),
        ("true", '"true"'),
        ('a "b"\nc', '"a \\"b\\"\\nc"'),
        (("a", "1"), '["a", "1"]'),
        ((1.5, 2.0), "[1.5, 2.0]"),
        ((True, False), "[true, false]"),
    ],
)
def test_a_parameter_keeps_its_type(value, text: str):
    assert parameter_text(value) == text
    read = yaml.safe_load(text) if value != 1e30 else float(text)  # PyYAML wants 1.0e+30
    assert read == (list(value) if isinstance(value, tuple) else value)
    assert type(read) is (list if isinstance(value, tuple) else type(value))


def test_not_a_number_is_written_as_yaml_does():
    assert math.isnan(yaml.safe_load(parameter_text(math.nan)))


def executable(prefix: Path, package: str, name: str) -> Path:
    path = prefix / "lib" / package / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("#!/bin/sh\n")
    path.chmod(0o755)
    return path


def test_a_process_of_several_nodes_gives_each_its_own_and_a_plain_one_gets_nothing():
    run = Run(kind=RunKind.COMMAND, command=("pair",))
    left = node("left", run=run, process="pair", remap=(("scan", "/scan"),))
    right = node("right", run=run, process="pair", parameters=(("rate", 2.0),))
    assert shlex.join(command_line([left, right], {})) == (
        "pair --ros-args -r left:scan:=/scan -p right:rate:=2.0"
    )
    assert command_line([node("left", run=run)], {}) == ("pair",)
    quiet = replace(run, ros_args=RosArguments.NONE)
    assert command_line([node("right", run=quiet, parameters=(("rate", 2.0),))], {}) == ("pair",)


def packaged(name: str = "talker"):
    return node("t", run=Run(kind=RunKind.COMMAND, package="demo", executable=name))


def test_an_executable_is_found_under_the_first_prefix_that_has_it(tmp_path: Path):
    executable(tmp_path / "three", "demo", "talker")
    found = executable(tmp_path / "two", "demo", "talker")
    prefixes = ":".join(str(tmp_path / each) for each in ("one", "two", "three"))
    assert command_line([packaged()], {"AMENT_PREFIX_PATH": prefixes})[0] == str(found)


# --- flows


def pairs(plan):
    return [(each.topic, each.publisher, each.subscription) for each in plan.flows]


def test_every_publisher_is_paired_with_every_subscription_of_its_topic():
    plan = planned(
        node("a", publisher("x"), publisher("y")),
        node("b", publisher("x"), subscription("x")),
        node("c", subscription("x"), subscription("y"), subscription("z")),
    )
    assert pairs(plan) == [
        ("/x", "a", "b"),
        ("/x", "a", "c"),
        ("/y", "a", "c"),
        ("/x", "b", "b"),
        ("/x", "b", "c"),
    ]


def test_two_endpoints_of_one_node_on_a_topic_are_one_flow():
    plan = planned(node("a", publisher("x"), publisher("/x")), node("b", subscription("x")))
    assert pairs(plan) == [("/x", "a", "b")]


def test_links_add_up_to_the_strongest_demand():
    plan = planned(
        node("a", publisher("x")),
        node("b", subscription("x")),
        node("c", subscription("x")),
        links=[
            link("/x", "a", "b", unique=UniqueHow.WEAKLY, max_delay_ms=50.0),
            link("/x", "a", "b", unique=UniqueHow.STRONGLY),
            link("/x", "a", "b", max_delay_ms=5.0),
            link("/x", "a", "c", unique=UniqueHow.WEAKLY),
        ],
    )
    assert [(each.unique, each.max_delay_ms, each.linked) for each in plan.flows] == [
        (UniqueHow.STRONGLY, 5.0, True),
        (UniqueHow.WEAKLY, None, True),
    ]


def test_a_link_of_two_nodes_is_kept_though_they_declare_nothing():
    plan = planned(node("a"), node("b"), links=[link("/x", "a", "b")])
    assert pairs(plan) == [("/x", "a", "b")]
    assert plan.flows[0].linked
