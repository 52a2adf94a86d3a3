"""Who gives the nodes with `use_sim_time` their time."""

from __future__ import annotations

import pytest
from msgspec.structs import replace

from lifecycle.manifest.model import EndpointKind
from lifecycle.plan.model import ExpectedParameter, Plan
from lifecycle.verify.observation import ParameterReport
from lifecycle.verify.tool_filter import CLOCK, DeclaredNames
from lifecycle.verify.verdict import Stage
from tests.builders import at, endpoint, node, planned, publisher
from tests.unit.verify.edits import (
    Edit,
    add_endpoint,
    add_node,
    both,
    change_configuration,
    change_endpoint,
    unchanged,
)
from tests.unit.verify.lines import verify
from tests.unit.verify.perfect import perfect

PUB = EndpointKind.PUBLISHER


def simulated(plan: Plan) -> Plan:
    given = ExpectedParameter(name="use_sim_time", type="bool", value=True, optional=True, at=at(3))
    first, *rest = plan.nodes
    user = replace(first, expected_parameters=(given,))
    return replace(plan, nodes=(user, *rest))


ALONE = planned(node("user", publisher("a")))
WITH_SIMULATOR = planned(
    node("user", publisher("a")), node("simulator", endpoint(PUB, CLOCK[0], CLOCK[1], None))
)


def plays(name: str = "/rosbag2_player", **fields: object) -> Edit:
    return both(add_node(name), add_endpoint(PUB, name, CLOCK[0], type=CLOCK[1], **fields))


@pytest.mark.parametrize(
    ("plan", "edit", "stage", "expected"),
    [
        (ALONE, unchanged, Stage.CONNECTED, ["time.no-clock"]),
        (ALONE, plays(gid="1"), Stage.CONNECTED, ["time.undeclared-clock"]),
        (
            ALONE,
            both(plays(gid="1"), plays("/rqt_clock", gid="2")),
            Stage.ACTIVE,
            ["time.several-clocks"],
        ),
        (WITH_SIMULATOR, unchanged, Stage.ACTIVE, []),
        (WITH_SIMULATOR, plays(gid="1"), Stage.ACTIVE, ["time.several-clocks"]),
        (WITH_SIMULATOR, change_endpoint(PUB, CLOCK[0], silent=True), Stage.CONNECTED, []),
        (
            WITH_SIMULATOR,
            change_endpoint(PUB, CLOCK[0], silent=True),
            Stage.ACTIVE,
            ["time.silent-clock"],
        ),
    ],
)
def test_who_publishes_the_clock_is_judged(
    plan: Plan, edit: Edit, stage: Stage, expected: list[str]
) -> None:
    plan = simulated(plan)
    found = verify(plan, edit(perfect(plan, stage)), stage=stage).findings
    assert [each.rule for each in found if each.rule.startswith("time.")] == expected


def test_without_simulated_time_it_does_not_matter_who_publishes_it() -> None:
    verdict = verify(ALONE, plays(gid="1")(perfect(ALONE)), stage=Stage.CONNECTED)
    assert verdict.findings == ()
    assert [DeclaredNames.of(each).simulated for each in (ALONE, simulated(ALONE))] == [False, True]


@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [
        ("use_sim_time", True, ["time.no-clock"]),
        ("use_sim_time", False, []),
        ("other", True, []),
    ],
)
def test_a_node_that_reports_to_use_simulated_time_needs_it(
    name: str, value: bool, expected: list[str]
) -> None:
    reports = (ParameterReport.of(name, "bool", value=value, read_only=False),)
    plan = planned(node("user", publisher("a")))
    edit = change_configuration("/user", parameters=reports)
    found = verify(plan, edit(perfect(plan)), stage=Stage.CONNECTED).findings
    assert [each.rule for each in found if each.rule.startswith("time.")] == expected


def test_of_many_nodes_without_a_clock_four_are_named() -> None:
    assert "there is no time for /a, /b, /c, /d and 2 more" in without_clock(6)


def without_clock(count: int) -> str:
    plan = planned(*(node(each, publisher(each)) for each in "abcdef"[:count]))
    given = ExpectedParameter(name="use_sim_time", type="bool", value=True, at=at(7))
    plan = replace(
        plan, nodes=tuple(replace(each, expected_parameters=(given,)) for each in plan.nodes)
    )
    found = verify(plan, perfect(plan), stage=Stage.CONNECTED).findings
    (finding,) = (each for each in found if each.rule == "time.no-clock")
    assert finding.at.endswith(":7:1")
    return finding.message
