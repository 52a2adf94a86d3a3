"""The 5QI table, the check of a flow against its class, and proposals."""

from __future__ import annotations

import json
from importlib import resources

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lifecycle.network.five_qi import (
    Needs,
    ResourceType,
    check_class,
    five_qi_of,
    five_qis,
    propose,
)

GBR, NON_GBR = ResourceType.GBR, ResourceType.NON_GBR
DELAY_CRITICAL = ResourceType.DELAY_CRITICAL_GBR
ALL = five_qis()


def test_release_16_has_the_26_values_that_the_article_counts() -> None:
    assert [each.value for each in ALL if each.in_release_16] == [
        *range(1, 10),
        *(65, 66, 67, 69, 70, 71, 72, 73, 74, 76, 79, 80),
        *range(82, 87),
    ]
    assert len([each for each in ALL if each.in_release_16]) == 26


def test_later_and_withdrawn_values_are_there_too() -> None:
    assert [each.value for each in ALL if not each.in_release_16] == [10, 75, 87, 88, 89, 90]
    assert len(ALL) == 32


def test_what_is_doubtful_about_a_value_is_said() -> None:
    assert {each.value for each in ALL if each.flagged} == {10, 75, 79, 83}
    assert all(each.note for each in ALL if each.flagged)


@pytest.mark.parametrize(
    ("value", "resource", "priority", "budget_ms", "error_rate"),
    [
        (3, GBR, 30, 50, 1e-3),
        (4, GBR, 50, 300, 1e-6),
        (7, NON_GBR, 70, 100, 1e-3),
        (9, NON_GBR, 90, 300, 1e-6),
        (82, DELAY_CRITICAL, 19, 10, 1e-4),
        (85, DELAY_CRITICAL, 21, 5, 1e-5),
    ],
)
def test_the_articles_table_of_example_5qis(
    value: int, resource: ResourceType, priority: int, budget_ms: int, error_rate: float
) -> None:
    found = five_qi_of(value)
    assert found.resource_type is resource
    assert found.priority_level == priority
    assert found.packet_delay_budget_ms == budget_ms
    assert found.packet_error_rate == error_rate


def test_only_delay_critical_classes_have_a_data_burst_volume() -> None:
    for each in ALL:
        assert (each.max_data_burst_bytes is not None) == (each.resource_type is DELAY_CRITICAL)


def test_every_row_names_sources_that_the_table_describes() -> None:
    file = resources.files("lifecycle.network").joinpath("data").joinpath("five_qi.json")
    table = json.loads(file.read_text(encoding="utf-8"))
    rows = [{*each["sources"]} for each in table["values"]]
    assert all(each and each <= {*table["sources"]} for each in rows)


def test_an_unknown_value_is_refused_with_what_there_is() -> None:
    with pytest.raises(ValueError) as caught:
        five_qi_of(81)
    assert str(caught.value) == (
        "cannot use 5QI 81; standardized are 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 65, 66, 67, 69, 70, "
        "71, 72, 73, 74, 75, 76, 79, 80, 82, 83, 84, 85, 86, 87, 88, 89, 90"
    )


@pytest.mark.parametrize(
    ("value", "needs", "fields"),
    [
        (85, {"max_delay_ms": 5}, ()),  # the article's video link
        (3, {"max_delay_ms": 5}, ("max_delay_ms",)),
        (82, {"loss": 1e-4}, ()),
        (82, {"loss": 1e-5}, ("loss",)),
        (2, {"rate_bps": 2e6}, ()),
        (9, {"rate_bps": 2e6}, ("rate_bps",)),
        (85, {"rate_bps": 408_000, "max_message_size": 255}, ()),
        (85, {"rate_bps": 1e6, "max_message_size": 20_000}, ("rate_bps", "max_message_size")),
    ],
)
def test_each_need_that_a_class_does_not_keep_is_an_issue(
    value: int, needs: dict[str, float], fields: tuple[str, ...]
) -> None:
    found = [*check_class(five_qi_of(value), Needs(**needs))]  # type: ignore[arg-type]
    assert tuple(field for field, _ in found) == fields
    assert all(f"with 5QI {value} (" in message for _, message in found)


def test_an_issue_names_what_is_asked_for_and_what_the_class_has() -> None:
    needs = Needs(rate_bps=1e6, max_message_size=20_000)
    (_, rate), (_, message) = check_class(five_qi_of(85), needs)
    assert rate == (
        "cannot keep the delay of 1e+06 bit/s with 5QI 85 (Delay-critical GBR): by default it "
        "serves 255 bytes in 5 ms, 408000 bit/s"
    )
    assert "20000 bytes" in message


@pytest.mark.parametrize(
    ("max_delay_ms", "loss", "gbr", "value"),
    [
        (5, 1e-5, True, 85),
        (5, 1e-4, True, 86),
        (300, 1e-6, False, 9),
        (300, 1e-6, True, 4),
        (100, 1e-3, False, 7),
        (50, 1e-3, True, 3),
        (10, 1e-3, True, 82),
        (10, 1e-6, None, 80),
        (1000, 1, None, 76),
        (100, 1e-2, True, 1),  # 5QI 66 differs in nothing that is compared
    ],
)
def test_the_least_demanding_class_that_fits_is_proposed(
    max_delay_ms: float, loss: float, *, gbr: bool | None, value: int
) -> None:
    found, _ = propose(Needs(max_delay_ms=max_delay_ms, loss=loss), gbr)
    assert found is not None
    assert found.value == value


def test_a_proposal_says_why() -> None:
    _, why = propose(Needs(max_delay_ms=10, loss=1e-3), True)
    assert why == (
        "5QI 82 (Delay-critical GBR): delay budget 10 ms, error rate 0.0001; the least demanding "
        "class of Release 16 that keeps max_delay_ms 10, loss 0.001"
    )


def test_a_later_release_is_proposed_where_release_16_has_nothing() -> None:
    found, why = propose(Needs(max_delay_ms=20, loss=1e-3, max_message_size=20_000), True)
    assert found is five_qi_of(90)
    assert "the least demanding class of Release 17" in why


def test_classes_with_a_doubtful_cell_are_not_proposed() -> None:
    found, _ = propose(Needs(max_delay_ms=50, loss=1e-2), False)
    assert found is five_qi_of(80)  # and not 79


def test_where_nothing_fits_all_that_was_asked_for_is_named() -> None:
    needs = Needs(max_delay_ms=5, loss=1e-5, max_message_size=256, rate_bps=1e6)
    assert propose(needs, True) == (
        None,
        (
            "cannot propose a 5QI: no class keeps max_delay_ms 5, loss 1e-05, rate_bps 1e+06, "
            "max_message_size 256"
        ),
    )


@given(
    max_delay_ms=st.floats(0.1, 2000),
    exponent=st.floats(-9, 0),
    gbr=st.sampled_from((True, False, None)),
    max_message_size=st.none() | st.integers(1, 70_000),
)
def test_a_proposed_class_keeps_what_was_asked_and_a_refusal_means_that_none_does(
    max_delay_ms: float, exponent: float, *, gbr: bool | None, max_message_size: int | None
) -> None:
    loss = 10.0**exponent
    needs = Needs(max_delay_ms=max_delay_ms, loss=loss, max_message_size=max_message_size)
    found, _ = propose(needs, gbr)
    keeping = [
        each
        for each in ALL
        if not each.flagged
        and gbr in (None, each.resource_type.guarantees_rate)
        and each.packet_delay_budget_ms <= max_delay_ms
        and each.packet_error_rate <= loss
        and (
            max_message_size is None
            or each.max_data_burst_bytes is None
            or max_message_size <= each.max_data_burst_bytes
        )
    ]
    assert (found is None) == (not keeping)
    assert found is None or found in keeping
