"""5G QoS identifiers (5QIs): standardized classes, checks, proposals, and 5QI → DSCP mappings.

Owns: 3GPP TS 23.501 Table 5.7.4-1 as data with its sources, and the judgement whether a class can
keep what a flow declares; mappings, published ones with their provenance and a user's own. No
mapping is the default, because none is normative. Pure.
"""

from __future__ import annotations

import enum
import functools

import msgspec

from lifecycle.codec import from_json, read_table
from lifecycle.network.dscp import parse_dscp


class ResourceType(enum.Enum):
    """What a class guarantees; the table's second column."""

    GBR = "GBR"
    NON_GBR = "Non-GBR"
    DELAY_CRITICAL_GBR = "Delay-critical GBR"

    @property
    def guarantees_rate(self) -> bool:
        """Whether a flow of this type has a guaranteed bit rate."""
        return self is not ResourceType.NON_GBR


class FiveQi(msgspec.Struct, frozen=True, kw_only=True):
    """One standardized 5QI and its characteristics.

    Attributes:
        priority_level: 1–127, lower is more important.
        packet_delay_budget_ms: upper bound between device and N6.
        packet_error_rate: upper bound of the share of packets lost or late, 0–1.
        max_data_burst_bytes: default volume served within the delay budget; None if not applicable.
        first_release: 3GPP release.
        flagged: fields on which the sources disagree or that only a weak one supports.
        note: what is doubtful about the row; often empty.
    """

    value: int
    resource_type: ResourceType
    priority_level: int
    packet_delay_budget_ms: int
    packet_error_rate: float
    max_data_burst_bytes: int | None
    first_release: int
    in_release_16: bool
    flagged: tuple[str, ...]
    note: str

    def __str__(self) -> str:
        return f"5QI {self.value} ({self.resource_type.value})"


class ClassIssue(msgspec.Struct, frozen=True, kw_only=True):
    """A declared need, by its name in `check_class`, that a class does not keep."""

    field: str
    message: str


class Proposal(msgspec.Struct, frozen=True, kw_only=True):
    """The answer to `five_qi: auto`; None if no class fits, with the reason either way."""

    five_qi: FiveQi | None
    why: str


class _FiveQiTable(msgspec.Struct, frozen=True, kw_only=True):
    values: tuple[FiveQi, ...]


@functools.cache
def five_qis() -> tuple[FiveQi, ...]:
    """Return the standardized 5QIs by rising value."""
    return read_table("five_qi", _FiveQiTable).values


def five_qi_of(value: int) -> FiveQi:
    """Return one standardized 5QI, flagged or not.

    Raises:
        ValueError: not a standardized value.
    """
    for each in five_qis():
        if each.value == value:
            return each
    known = ", ".join(str(each.value) for each in five_qis())
    raise ValueError(f"cannot use 5QI {value}; standardized are {known}")


def check_class(
    class_: FiveQi,
    *,
    max_delay_ms: float | None = None,
    loss: float | None = None,
    rate_bps: float | None = None,
    message_bytes: int | None = None,
) -> tuple[ClassIssue, ...]:
    """Return what a flow declares and the class does not keep; empty if it keeps all."""
    found: list[ClassIssue] = []

    def issue(field: str, message: str) -> None:
        found.append(ClassIssue(field=field, message=message))

    budget_ms, burst = class_.packet_delay_budget_ms, class_.max_data_burst_bytes
    if max_delay_ms is not None and max_delay_ms < budget_ms:
        issue(
            "max_delay_ms",
            f"cannot keep a delay of {max_delay_ms:g} ms with {class_}: "
            f"its packet delay budget is {budget_ms} ms",
        )
    if loss is not None and loss < class_.packet_error_rate:
        issue(
            "loss",
            f"cannot keep a loss of {loss:g} with {class_}: "
            f"its packet error rate is {class_.packet_error_rate:g}",
        )
    if rate_bps is not None and not class_.resource_type.guarantees_rate:
        issue(
            "rate_bps",
            f"cannot guarantee {rate_bps:g} bit/s with {class_}: only GBR classes guarantee a rate",
        )
    if burst is None:
        return tuple(found)
    served = f"with {class_}: by default it serves {burst} bytes in {budget_ms} ms"
    served_bps = burst * 8000 / budget_ms
    if rate_bps is not None and rate_bps > served_bps:
        issue(
            "rate_bps",
            f"cannot keep the delay of {rate_bps:g} bit/s {served}, {served_bps:g} bit/s",
        )
    if message_bytes is not None and message_bytes > burst:
        issue(
            "message_bytes",
            f"cannot keep the delay of a message of {message_bytes} bytes {served}",
        )
    return tuple(found)


def propose(
    max_delay_ms: float,
    loss: float,
    gbr: bool | None,
    *,
    message_bytes: int | None = None,
    rate_bps: float | None = None,
) -> Proposal:
    """Propose the least demanding class that keeps a delay and a loss, with the reason.

    Least demanding, because a better class than needed wastes what the network has. Classes of
    Release 16 come first, as every network knows them; then the longest delay budget, the highest
    error rate, the least important priority. One with a doubtful cell is never proposed.

    Args:
        max_delay_ms: bound of the delay, > 0.
        loss: bound of the loss, > 0 and <= 1.
        gbr: True asks for a guaranteed bit rate, False for none, None for either.
        message_bytes: largest message that must arrive within the delay, > 0.
        rate_bps: bits per second that must be guaranteed, > 0.
    """
    fitting = [
        each
        for each in five_qis()
        if not each.flagged
        and gbr in (None, each.resource_type.guarantees_rate)
        and not check_class(
            each,
            max_delay_ms=max_delay_ms,
            loss=loss,
            message_bytes=message_bytes,
            rate_bps=rate_bps,
        )
    ]
    if not fitting:
        why = f"cannot propose a 5QI: no class keeps a delay of {max_delay_ms:g} ms"
        why += f", a loss of {loss:g}"
        why += "" if message_bytes is None else f", messages of {message_bytes} bytes"
        why += "" if rate_bps is None else f", {rate_bps:g} bit/s"
        return Proposal(five_qi=None, why=why)

    def undemanding(each: FiveQi) -> tuple[object, ...]:
        bounds = (each.packet_delay_budget_ms, each.packet_error_rate, each.priority_level)
        return (each.in_release_16, *bounds, -each.value)

    best = max(fitting, key=undemanding)
    release = "Release 16" if best.in_release_16 else f"Release {best.first_release}"
    return Proposal(
        five_qi=best,
        why=f"{best}: delay budget {best.packet_delay_budget_ms} ms <= {max_delay_ms:g} ms, error "
        f"rate {best.packet_error_rate:g} <= {loss:g}; the least demanding class of {release} "
        f"that fits",
    )


class DscpMapping(msgspec.Struct, frozen=True, kw_only=True):
    """One mapping and its source: `{"name": …, "source": …, "values": {"85": "EF", "9": 0}}`.

    Attributes:
        source: who published it, where and when; for a user's own, who configured the network.
        status: how complete it is and in which direction it holds.
        values: DSCP, by name or number, of each 5QI.
    """

    name: str
    source: str
    status: str = ""
    notes: tuple[str, ...] = ()
    values: dict[int, int | str]

    def __post_init__(self) -> None:
        """Raise ValueError for an unknown 5QI, and for what is no DSCP."""
        for value, dscp in self.values.items():
            five_qi_of(value)
            parse_dscp(dscp)

    def dscp_for(self, value: int) -> int | None:
        """Return the DSCP, 0–63, of a 5QI; None if the mapping has none."""
        return parse_dscp(self.values[value]) if value in self.values else None


class _MappingTable(msgspec.Struct, frozen=True, kw_only=True):
    mappings: tuple[DscpMapping, ...]


@functools.cache
def dscp_mappings() -> tuple[DscpMapping, ...]:
    """Return the published mappings that ship with the package."""
    return read_table("five_qi_dscp", _MappingTable).mappings


def dscp_mapping(name: str) -> DscpMapping:
    """Return a published mapping by its name.

    Raises:
        ValueError: no such mapping; names those that exist.
    """
    for each in dscp_mappings():
        if each.name == name:
            return each
    known = ", ".join(each.name for each in dscp_mappings())
    raise ValueError(f"cannot find 5QI to DSCP mapping {name!r}; shipped are {known}")


def parse_mapping(text: str | bytes) -> DscpMapping:
    """Read a user's own mapping.

    Raises:
        ValueError: not JSON of that shape, an unknown 5QI, or not a DSCP.
    """
    try:
        return from_json(text, DscpMapping)
    except ValueError as error:
        raise ValueError(f"cannot read 5QI to DSCP mapping: {error}") from error
