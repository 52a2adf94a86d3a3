"""Tables that ship inside the package: read as what is asked for, or refused."""

from __future__ import annotations

import dataclasses

import pytest

from lifecycle.codec import read_table
from lifecycle.network.five_qi import DscpMapping, dscp_mappings


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class _Names:
    """What of every mapping is text."""

    mappings: tuple[_Name, ...]


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class _Name:
    name: str


def test_a_table_is_read_by_its_name_as_the_type_that_is_asked_for() -> None:
    names = [each.name for each in read_table("five_qi_dscp", _Names).mappings]
    assert names == [each.name for each in dscp_mappings()]


def test_a_table_that_does_not_exist_or_does_not_fit_is_refused() -> None:
    with pytest.raises(FileNotFoundError):
        read_table("no_such_table", _Names)
    with pytest.raises(ValueError, match="name"):
        read_table("five_qi_dscp", DscpMapping)
