"""The capability table per RMW, and the early answers that follow."""

from __future__ import annotations

import dataclasses

import pytest

from lifecycle.network.nfe import UniqueRequirement
from lifecycle.network.rmw_capabilities import (
    Feasibility,
    FlowSide,
    Support,
    capabilities,
    dscp_feasibility,
    feasibility,
    rmw_table,
)

STRICTLY = UniqueRequirement.STRICTLY_REQUIRED
OPTIONALLY = UniqueRequirement.OPTIONALLY_REQUIRED
OTHERS = ("rmw_cyclonedds_cpp", "rmw_zenoh_cpp", "rmw_connextdds")


def test_the_table_has_the_four_rmws_and_every_cell_its_source() -> None:
    assert [each.family for each in rmw_table()] == [
        "rmw_fastrtps",
        "rmw_cyclonedds",
        "rmw_zenoh",
        "rmw_connextdds",
    ]
    for row in rmw_table():
        for cell in (row.unique_subscription, row.unique_publisher, row.getter, row.dscp):
            assert cell.how
            assert cell.source


@pytest.mark.parametrize("requirement", [STRICTLY, OPTIONALLY])
@pytest.mark.parametrize("side", FlowSide)
def test_fast_dds_makes_subscriptions_unique_itself_and_publishers_by_our_participants(
    requirement: UniqueRequirement, side: FlowSide
) -> None:
    row = capabilities("rmw_fastrtps_cpp")
    assert row.unique_subscription.support is Support.SUPPORTED
    assert row.unique_publisher.support is Support.BY_US
    assert feasibility("rmw_fastrtps_dynamic_cpp", side, requirement).feasible is True


@pytest.mark.parametrize("rmw", OTHERS)
def test_no_other_rmw_has_the_getter_or_makes_an_endpoint_unique(rmw: str) -> None:
    row = capabilities(rmw)
    assert row.getter.support is Support.UNSUPPORTED
    for side in FlowSide:
        assert row.unique(side).support is Support.REFUSED
        assert feasibility(rmw, side, STRICTLY).feasible is False


def test_a_refusal_says_what_the_rmw_does_and_which_to_use() -> None:
    assert feasibility("rmw_cyclonedds_cpp", FlowSide.SUBSCRIPTION, STRICTLY).why == (
        "cannot give a subscription NFEs of its own, as strictly_required asks, with "
        "rmw_cyclonedds_cpp: strictly_required: no subscription is made; optionally_required: "
        "silently nothing; use RMW_IMPLEMENTATION=rmw_fastrtps_cpp"
    )


@pytest.mark.parametrize(
    "requirement", [UniqueRequirement.NOT_REQUIRED, UniqueRequirement.SYSTEM_DEFAULT]
)
def test_what_asks_for_nothing_is_feasible_with_any_rmw(requirement: UniqueRequirement) -> None:
    for rmw in ("rmw_fastrtps_cpp", *OTHERS, "rmw_other"):
        for side in FlowSide:
            assert feasibility(rmw, side, requirement) == Feasibility(
                feasible=True, why=f"{requirement.value} asks for nothing"
            )


def test_of_an_rmw_outside_the_table_nothing_can_be_told() -> None:
    assert feasibility("rmw_other", FlowSide.PUBLISHER, OPTIONALLY) == Feasibility(
        feasible=None,
        why="cannot tell whether it can give a publisher NFEs of its own, as optionally_required "
        "asks, with rmw_other: nothing is known of 'rmw_other'; "
        "use RMW_IMPLEMENTATION=rmw_fastrtps_cpp",
    )
    assert dscp_feasibility("rmw_other").feasible is None


def test_whoever_asks_an_rmw_that_cannot_is_told_of_all_that_can(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    able, *others = rmw_table()
    table = (able, dataclasses.replace(able, family="rmw_newdds"), *others)
    monkeypatch.setattr("lifecycle.network.rmw_capabilities.rmw_table", lambda: table)
    for answer in (
        feasibility("rmw_zenoh_cpp", FlowSide.SUBSCRIPTION, STRICTLY),
        dscp_feasibility("rmw_zenoh_cpp"),
    ):
        _, _, to_do = answer.why.rpartition("; ")
        assert to_do == "use RMW_IMPLEMENTATION=rmw_fastrtps_cpp, rmw_newdds_cpp"


def test_only_fast_dds_lets_us_mark_one_publisher() -> None:
    assert dscp_feasibility("rmw_fastrtps_cpp").feasible is True
    assert [dscp_feasibility(rmw).feasible for rmw in OTHERS] == [False, False, False]
    assert dscp_feasibility("rmw_zenoh_cpp").why == (
        "cannot mark one publisher's packets with a DSCP with rmw_zenoh_cpp: #dscp= on an "
        "endpoint, for the whole link, as a raw TOS byte (DSCP times 4); "
        "use RMW_IMPLEMENTATION=rmw_fastrtps_cpp"
    )


def test_of_an_rmw_that_is_not_in_the_table_every_cell_is_unknown_and_says_so() -> None:
    row = capabilities("rmw_new")
    assert row.family == "rmw_new"
    for cell in (row.unique_subscription, row.unique_publisher, row.getter, row.dscp):
        assert cell.support is Support.UNKNOWN
        assert (cell.how, cell.source) == ("nothing is known of 'rmw_new'", "not in the table")
    for side in FlowSide:
        assert feasibility("rmw_new", side, STRICTLY).feasible is None


def test_each_side_of_a_flow_has_a_cell_of_its_own() -> None:
    row = capabilities("rmw_fastrtps_cpp")
    assert row.unique(FlowSide.PUBLISHER) is row.unique_publisher
    assert row.unique(FlowSide.SUBSCRIPTION) is row.unique_subscription
    assert row.unique_publisher != row.unique_subscription
    for side in FlowSide:
        assert feasibility("rmw_fastrtps_cpp", side, STRICTLY).why == row.unique(side).how
    assert dscp_feasibility("rmw_fastrtps_cpp").why == row.dscp.how


def test_a_refusal_names_each_rmw_that_could_once() -> None:
    assert feasibility("rmw_zenoh_cpp", FlowSide.PUBLISHER, STRICTLY).why.endswith(
        "; use RMW_IMPLEMENTATION=rmw_fastrtps_cpp"
    )
