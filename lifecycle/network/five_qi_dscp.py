"""5QI ↔ DSCP mappings: published ones with their provenance, and a user's own.

Owns: reading them and looking up in them. No mapping is the default, because none is normative:
what a network does is configured in that network. Pure.
"""

from __future__ import annotations

import dataclasses
import functools

from lifecycle.codec import from_json
from lifecycle.network.dscp import parse_dscp
from lifecycle.network.five_qi import five_qi_of
from lifecycle.network.tables import read_table


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class DscpMapping:
    """One mapping and where it comes from.

    Attributes:
        source: who published it, where and when; for a user's own, who configured the network.
        status: how complete it is and in which direction it holds.
        values: (5QI, DSCP 0–63) by rising 5QI.
    """

    name: str
    source: str
    status: str
    notes: tuple[str, ...]
    values: tuple[tuple[int, int], ...]

    def dscp_for(self, value: int) -> int | None:
        """Return the DSCP of a 5QI; None if the mapping has none."""
        return next((dscp for each, dscp in self.values if each == value), None)

    def five_qis_for(self, dscp: int) -> tuple[int, ...]:
        """Return the 5QIs that a DSCP may stand for: several share one."""
        return tuple(each for each, code in self.values if code == dscp)


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class _File:
    name: str
    source: str
    status: str = ""
    notes: tuple[str, ...] = ()
    values: dict[int, int | str]


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class _Table:
    mappings: tuple[_File, ...]


@functools.cache
def dscp_mappings() -> tuple[DscpMapping, ...]:
    """Return the published mappings that ship with the package."""
    return tuple(_validated(each) for each in read_table("five_qi_dscp", _Table).mappings)


def dscp_mapping(name: str) -> DscpMapping:
    """Return a published mapping by its name.

    Raises:
        ValueError: no such mapping; says which there are.
    """
    for each in dscp_mappings():
        if each.name == name:
            return each
    known = ", ".join(each.name for each in dscp_mappings())
    raise ValueError(f"cannot find 5QI to DSCP mapping {name!r}; shipped are {known}")


def parse_mapping(text: str | bytes) -> DscpMapping:
    """Read a user's own mapping: `{"name", "source", "status", "notes", "values": {"85": "EF"}}`.

    `name`, `source` and `values` are required; a DSCP may be a name or a number.

    Raises:
        ValueError: not JSON of that shape, an unknown 5QI, or not a DSCP.
    """
    try:
        return _validated(from_json(text, _File))
    except ValueError as error:
        raise ValueError(f"cannot read 5QI to DSCP mapping: {error}") from error


def _validated(file: _File) -> DscpMapping:
    return DscpMapping(
        name=file.name,
        source=file.source,
        status=file.status,
        notes=file.notes,
        values=tuple(
            (five_qi_of(value).value, parse_dscp(file.values[value]))
            for value in sorted(file.values)
        ),
    )
