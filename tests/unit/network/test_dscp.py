"""DSCP names, numbers and TOS bytes."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lifecycle.network.dscp import code_points, describe, dscp_name, parse_dscp, tos

NAMES = (
    "DF, LE, CS1, AF11, AF12, AF13, CS2, AF21, AF22, AF23, CS3, AF31, AF32, AF33, CS4, AF41, AF42, "
    "AF43, CS5, VA, NQB, EF, CS6, CS7"
)
ALLOWED = "use 0 to 63 or a name such as EF"


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
    assert parse_dscp("EF") == 0x2E == 46
    assert tos(46) == 0xB8 == 184


@pytest.mark.parametrize(
    ("written", "dscp"),
    [
        ("ef", 46),
        (" Ef ", 46),
        ("be", 0),
        ("cs0", 0),
        ("voice-admit", 44),
        ("VOICE_ADMIT", 44),
        ("nqb", 45),
        ("le", 1),
        ("46", 46),
        ("0x2e", 46),
        ("0X2E", 46),
        ("063", 63),
        (0, 0),
        (63, 63),
    ],
)
def test_a_dscp_may_be_written_as_name_alias_or_number(written: str | int, dscp: int) -> None:
    assert parse_dscp(written) == dscp


@pytest.mark.parametrize(
    ("written", "message"),
    [
        (64, f"cannot use DSCP 64; {ALLOWED}; 64 is a TOS byte: DSCP 16 (CS2)"),
        (184, f"cannot use DSCP 184; {ALLOWED}; 184 is a TOS byte: DSCP 46 (EF)"),
        ("0xb8", f"cannot use DSCP 0xb8; {ALLOWED}; 184 is a TOS byte: DSCP 46 (EF)"),
        (
            185,
            f"cannot use DSCP 185; {ALLOWED}; 185 is a TOS byte and sets ECN bits: DSCP 46 (EF)",
        ),
        (252, f"cannot use DSCP 252; {ALLOWED}; 252 is a TOS byte: DSCP 63"),
        (255, f"cannot use DSCP 255; {ALLOWED}; 255 is a TOS byte and sets ECN bits: DSCP 63"),
        (256, "cannot use DSCP 256; use 0 to 63 or a name such as EF"),
        (-1, "cannot use DSCP -1; use 0 to 63 or a name such as EF"),
        ("-1", "cannot use DSCP -1; use 0 to 63 or a name such as EF"),
        (True, "cannot use True as DSCP; use 0 to 63 or a name such as EF"),
        ("AF14", f"cannot use 'AF14' as DSCP; use 0 to 63 or one of {NAMES}; did you mean AF13?"),
        ("eff", f"cannot use 'eff' as DSCP; use 0 to 63 or one of {NAMES}; did you mean EF?"),
        ("9" * 5000, f"cannot use '{'9' * 5000}' as DSCP; use 0 to 63 or one of {NAMES}"),
        ("", f"cannot use '' as DSCP; use 0 to 63 or one of {NAMES}"),
        ("4_6", f"cannot use '4_6' as DSCP; use 0 to 63 or one of {NAMES}"),
        ("٤٦", f"cannot use '٤٦' as DSCP; use 0 to 63 or one of {NAMES}"),
    ],
)
def test_what_is_no_dscp_is_refused_with_what_was_probably_meant(
    written: str | int, message: str
) -> None:
    with pytest.raises(ValueError) as caught:
        parse_dscp(written)
    assert str(caught.value) == message


@given(st.integers(0, 63))
def test_every_dscp_survives_its_name_and_its_tos_byte(dscp: int) -> None:
    assert parse_dscp(dscp_name(dscp)) == dscp
    assert tos(dscp) == dscp << 2
    assert parse_dscp(str(dscp)) == parse_dscp(hex(dscp)) == dscp


@given(st.text())
def test_any_text_is_a_dscp_or_a_cannot_message(text: str) -> None:
    try:
        dscp = parse_dscp(text)
    except ValueError as error:
        message = str(error)
    else:
        assert 0 <= dscp <= 63
        return
    assert message.startswith("cannot use ")


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
