"""RMW capabilities for network flows: unique endpoints, the getter, DSCP, by RMW implementation.

Owns: the capability table, each cell with its source, and the early answer whether a requirement
is feasible. The reality at run time decides; this only fails earlier. Pure.
"""

from __future__ import annotations

import enum
import functools

from lifecycle import dataclasses
from lifecycle.codec import read_table
from lifecycle.network.nfe import UniqueRequirement

DEFAULT_RMW = "rmw_fastrtps_cpp"
"""What ROS 2 Jazzy takes when RMW_IMPLEMENTATION is not set (REP 2000)."""


class Support(enum.Enum):
    """How an RMW supports something."""

    SUPPORTED = "supported"
    BY_US = "by_us"  # this package does it with the RMW as it is
    CONFIGURATION = "configuration"  # in the RMW's own configuration, out of our reach
    REFUSED = "refused"  # asked strictly, the endpoint is not made
    UNSUPPORTED = "unsupported"
    UNKNOWN = "unknown"  # not in the table


class FlowSide(enum.Enum):
    """Which end of a flow."""

    PUBLISHER = "publisher"
    SUBSCRIPTION = "subscription"


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Capability:
    """One cell of the table.

    Attributes:
        how: what happens, a phrase for people.
        source: where that is known from.
    """

    support: Support
    how: str
    source: str


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class RmwCapabilities:
    """One row of the table.

    Attributes:
        family: what the RMW identifiers begin with, `rmw_fastrtps` for `rmw_fastrtps_cpp`.
        unique_subscription: a subscription with NFEs of its own.
        unique_publisher: a publisher with NFEs of its own.
        getter: reading back an endpoint's NFEs.
        dscp: marking the packets of one publisher.
    """

    family: str
    unique_subscription: Capability
    unique_publisher: Capability
    getter: Capability
    dscp: Capability

    def unique(self, side: FlowSide) -> Capability:
        """Return the cell of `unique_…` for one side of a flow."""
        publisher = side is FlowSide.PUBLISHER
        return self.unique_publisher if publisher else self.unique_subscription


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Feasibility:
    """The early answer to a requirement.

    Attributes:
        feasible: None if the table does not know.
        why: for people; starts with "cannot" unless feasible.
    """

    feasible: bool | None
    why: str


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class _CapabilityTable:
    rmws: tuple[RmwCapabilities, ...]


@functools.cache
def rmw_table() -> tuple[RmwCapabilities, ...]:
    """Return the whole table."""
    return read_table("rmw_capabilities", _CapabilityTable).rmws


def capabilities(rmw: str) -> RmwCapabilities:
    """Return what an RMW can do.

    Args:
        rmw: an RMW identifier as in RMW_IMPLEMENTATION, `rmw_fastrtps_cpp`.

    Returns:
        Its row; for an RMW that the table does not know, a row of UNKNOWN cells.
    """
    for each in rmw_table():
        if rmw.startswith(each.family):
            return each
    unknown = Capability(
        support=Support.UNKNOWN, how=f"nothing is known of {rmw!r}", source="not in the table"
    )
    return RmwCapabilities(
        family=rmw,
        unique_subscription=unknown,
        unique_publisher=unknown,
        getter=unknown,
        dscp=unknown,
    )


def feasibility(rmw: str, side: FlowSide, requirement: UniqueRequirement) -> Feasibility:
    """Return whether an endpoint's uniqueness requirement can be met with an RMW.

    NOT_REQUIRED and SYSTEM_DEFAULT ask for nothing that could fail; the latter leaves the decision
    to the RMW and to what is side-loaded into it.
    """
    cell = capabilities(rmw).unique(side)
    if requirement in (UniqueRequirement.NOT_REQUIRED, UniqueRequirement.SYSTEM_DEFAULT):
        return Feasibility(feasible=True, why=f"{requirement.value} asks for nothing")
    if cell.support in (Support.SUPPORTED, Support.BY_US):
        return Feasibility(feasible=True, why=cell.how)
    return _not_feasible(
        rmw, cell, f"give a {side.value} NFEs of its own, as {requirement.value} asks,"
    )


def dscp_feasibility(rmw: str) -> Feasibility:
    """Return whether this package can mark one publisher's packets with an RMW."""
    cell = capabilities(rmw).dscp
    if cell.support in (Support.SUPPORTED, Support.BY_US):
        return Feasibility(feasible=True, why=cell.how)
    return _not_feasible(rmw, cell, "mark one publisher's packets with a DSCP")


def _not_feasible(rmw: str, cell: Capability, wish: str) -> Feasibility:
    able = ", ".join(
        f"{each.family}_cpp"
        for each in rmw_table()
        if each.unique_subscription.support is Support.SUPPORTED
    )
    unknown = cell.support is Support.UNKNOWN
    return Feasibility(
        feasible=None if unknown else False,
        why=f"cannot {'tell whether it can ' if unknown else ''}{wish} with {rmw}: "
        f"{cell.how}; use RMW_IMPLEMENTATION={able}",
    )
