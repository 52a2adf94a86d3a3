"""5QI ↔ DSCP mappings are data with provenance, never a constant."""

from __future__ import annotations

import pytest

from lifecycle.codec import from_json
from lifecycle.network.five_qi import DscpMapping, dscp_mapping, dscp_mappings, five_qis


def _read(text: str) -> DscpMapping:
    """Read a user's own mapping."""
    return from_json(text, DscpMapping)


def test_every_shipped_mapping_says_where_it_comes_from_and_how_complete_it_is() -> None:
    assert [each.name for each in dscp_mappings()] == ["azure_private_5g_core", "gsma_ir34"]
    assert all(each.source and each.status for each in dscp_mappings())


def test_the_azure_table_covers_the_26_values_of_release_16() -> None:
    mapping = dscp_mapping("azure_private_5g_core")
    release_16 = {each.value for each in five_qis() if each.in_release_16}
    assert {*mapping.values} == release_16
    assert mapping.dscp_for(85) == 18
    assert mapping.dscp_for(80) == 34
    assert mapping.dscp_for(90) is None


def test_an_unknown_mapping_is_refused_with_what_there_is() -> None:
    with pytest.raises(ValueError) as caught:
        dscp_mapping("gsma")
    assert str(caught.value) == (
        "cannot find 5QI to DSCP mapping 'gsma'; shipped are azure_private_5g_core, gsma_ir34"
    )


def test_a_user_writes_his_own_with_names_or_numbers() -> None:
    own = _read(
        '{"name": "lab", "source": "our core", "status": "tried", "notes": ["one", "two"],'
        ' "values": {"85": "EF", "9": 0}}'
    )
    assert (own.status, own.notes) == ("tried", ("one", "two"))
    plain = _read('{"name": "lab", "source": "our core", "values": {}}')
    assert (plain.status, plain.notes) == ("", ())
    assert (own.name, own.source) == ("lab", "our core")
    assert (own.dscp_for(9), own.dscp_for(85)) == (0, 46)


@pytest.mark.parametrize(
    ("values", "reason"),
    [
        ('{"81": 46}', "cannot use 5QI 81; standardized are 1, 2, "),
        ('{"85": 184}', "cannot use 184 as DSCP; use 0 to 63 or one of DF"),
        ('{"85": "EFF"}', "cannot use 'EFF' as DSCP; "),
        ("[]", "Expected `object`, got `array` - at `$.values`"),
    ],
)
def test_a_user_s_mistake_is_named(values: str, reason: str) -> None:
    with pytest.raises(ValueError) as caught:
        _read(f'{{"name": "lab", "source": "our core", "values": {values}}}')
    assert str(caught.value).startswith(f"{reason}")


def test_a_mapping_without_provenance_is_refused() -> None:
    with pytest.raises(ValueError) as caught:
        _read('{"name": "lab", "values": {}}')
    assert str(caught.value) == ("Object missing required field `source`")
