"""Connext Micro's mapping: its whole examples table, its sentences, and its properties."""

from __future__ import annotations

import math
from fractions import Fraction

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lifecycle.network.dscp import TransportPriorityMapping, map_priority

MAPPINGS = st.builds(
    lambda mask, ends: TransportPriorityMapping(mask=mask, low=min(ends), high=max(ends)),
    st.integers(1, 0xFFFFFFFF),
    st.tuples(st.integers(0, 255), st.integers(0, 255)),
)


@pytest.mark.parametrize(
    ("priority", "mask", "low", "high", "tos"),
    [
        pytest.param(0xB8, 0xFF, 0, 0xFF, 0xB8, id="no scaling, direct mapping"),
        pytest.param(0x00, 0x03, 0, 0x03, 0x00, id="lowest priority"),
        pytest.param(0x01, 0x03, 0, 0x3F, 0x15, id="priority scaled into range"),
        pytest.param(0x02, 0x03, 0, 0x3F, 0x2A, id="higher priority"),
        pytest.param(0x03, 0x03, 0, 0x3F, 0x3F, id="highest priority"),
    ],
)
def test_the_examples_table_of_section_3_24_3(
    priority: int, mask: int, low: int, high: int, tos: int
) -> None:
    assert map_priority(priority, TransportPriorityMapping(mask=mask, low=low, high=high)) == tos


def test_a_mask_above_16_bits_is_shifted_by_4_until_it_fits() -> None:
    # 0x0ff00000 needs three shifts: 0x0000ff00 -> mask' 0xff00, masked 0xb800.
    assert map_priority(0x0B800000, TransportPriorityMapping(mask=0x0FF00000)) == 0xB8


def test_the_shift_is_of_4_bits_and_not_more() -> None:
    # 0x1ffff needs one shift of 4: mask' 0x1fff, masked 0x1ffe; 8190 * 255 / 8191 is 254.97.
    assert map_priority(0x1FFEF, TransportPriorityMapping(mask=0x1FFFF)) == 254


@pytest.mark.parametrize(("priority", "tos"), [(0, 3), (1, 24), (2, 45), (3, 67)])
def test_the_division_is_that_of_integers_in_c_and_rounds_down(priority: int, tos: int) -> None:
    # 64 / 3 is 21.33 and 128 / 3 is 42.67: rounded to the nearest, or up, either would differ.
    assert map_priority(priority, TransportPriorityMapping(mask=3, low=3, high=67)) == tos


@given(st.integers(0, 0xFFFFFFFF), MAPPINGS)
def test_the_formula_of_section_3_24_1_holds_for_every_priority_and_mapping(
    priority: int, mapping: TransportPriorityMapping
) -> None:
    n = next(n for n in range(5) if not (mapping.mask >> (4 * n)) & 0xFFFF0000)
    masked_prio = (priority & mapping.mask) // 16**n
    mask_ = mapping.mask // 16**n
    exact = Fraction(masked_prio * (mapping.high - mapping.low), mask_) + mapping.low
    assert map_priority(priority, mapping) == math.floor(exact)


@given(priority=st.integers(0, 255))
def test_mask_0xff_with_the_defaults_maps_directly(priority: int) -> None:
    assert map_priority(priority, TransportPriorityMapping(mask=0xFF)) == priority


@given(priority=st.integers(0, 0xFFFFFFFF), mapping=MAPPINGS)
def test_the_result_stays_between_low_and_high_and_both_ends_are_reached(
    priority: int, mapping: TransportPriorityMapping
) -> None:
    tos = map_priority(priority, mapping)
    assert tos is not None
    assert mapping.low <= tos <= mapping.high
    assert map_priority(0, mapping) == mapping.low
    assert map_priority(0xFFFFFFFF, mapping) == mapping.high


@given(priority=st.integers(0, 0xFFFFFFFF), mapping=MAPPINGS)
def test_bits_outside_the_mask_make_no_difference(
    priority: int, mapping: TransportPriorityMapping
) -> None:
    assert map_priority(priority & mapping.mask, mapping) == map_priority(priority, mapping)


@given(
    priorities=st.tuples(st.integers(0, 0xFFFF), st.integers(0, 0xFFFF)),
    width=st.integers(1, 16),
    ends=st.tuples(st.integers(0, 255), st.integers(0, 255)),
)
def test_a_higher_priority_inside_a_mask_without_gaps_never_gets_a_lower_byte(
    priorities: tuple[int, int], width: int, ends: tuple[int, int]
) -> None:
    mask = (1 << width) - 1
    mapping = TransportPriorityMapping(mask=mask, low=min(ends), high=max(ends))
    lower, higher = sorted(each & mask for each in priorities)
    one, other = map_priority(lower, mapping), map_priority(higher, mapping)
    assert one is not None
    assert other is not None
    assert one <= other


def test_a_priority_fits_32_bits_signed_or_not() -> None:
    mapping = TransportPriorityMapping(mask=0xFF)
    for fits, tos in ((-(2**31), 0), (-1, 0xFF), (2**32 - 1, 0xFF)):
        assert map_priority(fits, mapping) == tos


def test_with_mask_0_nothing_is_set() -> None:
    assert map_priority(0xB8, TransportPriorityMapping(mask=0)) is None
