"""5G QoS identifiers (5QIs): standardized classes, checks, proposals, and 5QI → DSCP mappings.

Owns: 3GPP TS 23.501 Table 5.7.4-1 as data with its sources, and the judgement whether a class can
keep what a flow declares; mappings, published ones with their provenance and a user's own. No
mapping is the default, because none is normative. Pure.
"""

from __future__ import annotations

import enum
import functools
from collections.abc import Iterator

import msgspec

from lifecycle.codec import read_table
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


class Needs(msgspec.Struct, frozen=True, kw_only=True):
    """What a flow declares, and a class may keep; each above 0, None if it is not declared.

    Attributes:
        loss: at most 1.
        rate_bps: bits per second that must be guaranteed.
        max_message_size: largest message that must arrive within the delay.
    """

    max_delay_ms: float | None = None
    loss: float | None = None
    rate_bps: float | None = None
    max_message_size: int | None = None


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


def check_class(class_: FiveQi, needs: Needs) -> Iterator[tuple[str, str]]:
    """Yield each need that a class does not keep: its name in `Needs`, and a sentence."""
    budget_ms, burst = class_.packet_delay_budget_ms, class_.max_data_burst_bytes
    delay_ms, loss, rate_bps = needs.max_delay_ms, needs.loss, needs.rate_bps
    if delay_ms is not None and delay_ms < budget_ms:
        which = f"a delay of {delay_ms:g} ms with {class_}"
        yield "max_delay_ms", f"cannot keep {which}: its packet delay budget is {budget_ms} ms"
    if loss is not None and loss < class_.packet_error_rate:
        rate = f"its packet error rate is {class_.packet_error_rate:g}"
        yield "loss", f"cannot keep a loss of {loss:g} with {class_}: {rate}"
    if rate_bps is not None and not class_.resource_type.guarantees_rate:
        why = f"with {class_}: only GBR classes guarantee a rate"
        yield "rate_bps", f"cannot guarantee {rate_bps:g} bit/s {why}"
    if burst is None:
        return
    served = f"with {class_}: by default it serves {burst} bytes in {budget_ms} ms"
    served_bps = burst * 8000 / budget_ms
    if rate_bps is not None and rate_bps > served_bps:
        what = f"cannot keep the delay of {rate_bps:g} bit/s"
        yield "rate_bps", f"{what} {served}, {served_bps:g} bit/s"
    if needs.max_message_size is not None and needs.max_message_size > burst:
        what = f"cannot keep the delay of a message of {needs.max_message_size} bytes"
        yield "max_message_size", f"{what} {served}"


def propose(needs: Needs, gbr: bool | None) -> tuple[FiveQi | None, str]:
    """Propose the least demanding class that keeps what a flow needs; None if none does, and why.

    Least demanding, because a better class than needed wastes what the network has. Classes of
    Release 16 come first, as every network knows them; then the longest delay budget, the highest
    error rate, the least important priority. One with a doubtful cell is never proposed. `gbr`:
    True asks for a guaranteed bit rate, False for none, None for either.
    """
    fitting = [
        each
        for each in five_qis()
        if not each.flagged
        and gbr in (None, each.resource_type.guarantees_rate)
        and not any(check_class(each, needs))
    ]
    asked = ", ".join(
        f"{name} {value:g}"
        for name, value in msgspec.structs.asdict(needs).items()
        if value is not None
    )
    if not fitting:
        return None, f"cannot propose a 5QI: no class keeps {asked}"

    def undemanding(each: FiveQi) -> tuple[object, ...]:
        bounds = (each.packet_delay_budget_ms, each.packet_error_rate, each.priority_level)
        return (each.in_release_16, *bounds, -each.value)

    best = max(fitting, key=undemanding)
    release = 16 if best.in_release_16 else best.first_release
    bounds = f"{best.packet_delay_budget_ms} ms, error rate {best.packet_error_rate:g}"
    why = f"the least demanding class of Release {release} that keeps {asked}"
    return best, f"{best}: delay budget {bounds}; {why}"


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
