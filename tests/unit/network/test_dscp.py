"""DSCP names, numbers and TOS bytes."""

from __future__ import annotations

import pytest

from lifecycle.network.dscp import code_points, describe, parse_dscp, tos

NAMES = (
    "DF, LE, CS1, AF11, AF12, AF13, CS2, AF21, AF22, AF23, CS3, AF31, AF32, AF33, CS4, AF41, AF42, "
    "AF43, CS5, VA, NQB, EF, CS6, CS7"
)


def test_the_table_holds_the_24_code_points_in_rising_order() -> None:
    numbers = [each.dscp for each in code_points()]
    assert ", ".join(each.name for each in code_points()) == NAMES
    assert len(numbers) == 24
    assert numbers == sorted(set(numbers))


@pytest.mark.parametrize("selector", range(8))
def test_class_selectors_are_multiples_of_eight_as_in_rfc_2474(selector: int) -> None:
    assert parse_dscp(f"CS{selector}") == 8 * selector


@pytest.mark.parametrize("class_", range(1, 5))
@pytest.mark.parametrize("drop", range(1, 4))
def test_assured_forwarding_is_class_times_8_plus_drop_times_2_as_in_rfc_2597(
    class_: int, drop: int
) -> None:
    assert parse_dscp(f"AF{class_}{drop}") == 8 * class_ + 2 * drop


def test_expedited_forwarding_is_0x2e_as_the_unique_network_flows_article_says() -> None:
    assert parse_dscp("EF") == parse_dscp(46) == 0x2E == 46
    assert tos(46) == 0xB8 == 184


@pytest.mark.parametrize("written", ["AF14", "", "ef", "46", 64, -1, True])
def test_what_is_no_dscp_is_refused_with_what_is_one(written: str | int) -> None:
    with pytest.raises(ValueError, match="use 0 to 63 or one of DF, LE") as caught:
        parse_dscp(written)
    assert str(caught.value).startswith(f"cannot use {written!r} as DSCP")


@pytest.mark.parametrize(
    ("dscp", "text"),
    [
        (46, "EF = DSCP 46 = TOS 184 (0xb8)"),
        (0, "DF = DSCP 0 = TOS 0 (0x00)"),
        (3, "DSCP 3 = TOS 12 (0x0c)"),
    ],
)
def test_dscp_and_tos_are_described_side_by_side(dscp: int, text: str) -> None:
    assert describe(dscp) == text
